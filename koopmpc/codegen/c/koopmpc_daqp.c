/** @file koopmpc_daqp.c @brief The three sources of DAQP that solve a problem, in this controller's precision. */
#include "koopmpc_names.h"
#include "koopmpc_sizes.h"

#include "daqp/types.h"

enum { LANES = 8 };

/** M u, as DAQP's own daqp_compute_Mu, but with several sums a row, so that compilers may use vectors. */
static void koopmpc_daqp_product(DAQPWorkspace *work) {
  const int n = work->n, rows = work->m - work->ms;
  for (int i = 0; i < rows; i++) {
    const c_float *row = work->M + i * n, *u = work->u;
    c_float sums[LANES] = {0}, sum = 0;
    int j = 0;
    for (; j + LANES <= n; j += LANES)
      for (int k = 0; k < LANES; k++) sums[k] += row[j + k] * u[j + k];
    for (; j < n; j++) sum += row[j] * u[j];
    for (int k = 0; k < LANES; k++) sum += sums[k];
    work->Mu[i] = sum;
  }
}

/* A call daqp_compute_Mu(work) becomes one of the function above; definition and declaration keep their name. */
#undef daqp_compute_Mu
#define daqp_compute_Mu(of) KOOPMPC_MU_##of)
#define KOOPMPC_MU_work koopmpc_daqp_product(work
#define KOOPMPC_MU_DAQPWorkspace koopmpc_daqp_compute_Mu(DAQPWorkspace

#include "daqp/auxiliary.c"
#include "daqp/daqp.c"
#include "daqp/factorization.c"
