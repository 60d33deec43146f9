/** @file koopmpc_daqp.c @brief The three sources of DAQP that solve a problem, in this controller's precision. */
#include "koopmpc_names.h"
#include "koopmpc_sizes.h"

#include "daqp/types.h"

/* Floats keep DAQP's own product, four rows at a time: a Cortex-M4F has no vectors, and loads less there. */
#ifndef KOOPMPC_FLOAT
/** M u, as DAQP's own daqp_compute_Mu, but by eight sums a row, so that compilers may use vectors. */
static void koopmpc_daqp_product(DAQPWorkspace *work) {
  const int n = work->n, rows = work->m - work->ms;
  for (int i = 0; i < rows; i++) {
    const c_float *a = work->M + i * n, *u = work->u;
    c_float s0 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0, s5 = 0, s6 = 0, s7 = 0;
    int j = 0;
    for (; j + 7 < n; j += 8) {
      s0 += a[j] * u[j];
      s1 += a[j + 1] * u[j + 1];
      s2 += a[j + 2] * u[j + 2];
      s3 += a[j + 3] * u[j + 3];
      s4 += a[j + 4] * u[j + 4];
      s5 += a[j + 5] * u[j + 5];
      s6 += a[j + 6] * u[j + 6];
      s7 += a[j + 7] * u[j + 7];
    }
    for (; j < n; j++) s0 += a[j] * u[j];
    work->Mu[i] = ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7));
  }
}

/* A call daqp_compute_Mu(work) becomes one of the function above; definition and declaration keep their name. */
#undef daqp_compute_Mu
#define daqp_compute_Mu(of) KOOPMPC_MU_##of)
#define KOOPMPC_MU_work koopmpc_daqp_product(work
#define KOOPMPC_MU_DAQPWorkspace koopmpc_daqp_compute_Mu(DAQPWorkspace
#endif

#include "daqp/auxiliary.c"
#include "daqp/daqp.c"
#include "daqp/factorization.c"
