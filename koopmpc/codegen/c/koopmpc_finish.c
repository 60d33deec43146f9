/**
 * @file koopmpc_finish.c
 * @brief The program of the stages in condensed form, for an active-set method that ends where interior points fail.
 *
 * With dx = dx_free + x and du_k = du_free,k - K_k x_k + L_k^-T w_k, R + B'PB = L_k L_k', the cost is that of the
 * program without limits and 0.5 |w|^2: the Hessian is the identity also where the plant is unstable.
 */
#include <math.h>

#include "koopmpc_finish_tables.h"
#include "koopmpc_stages.h"

#if KOOPMPC_FINISH_ROWS > 0

enum {
  COUNT = KOOPMPC_FINISH_ROWS,
  WIDTH = KOOPMPC_FINISH_WIDTH,
  FINISHED = 150 /* about as many interior-point steps take as long; how many iterations there are rounding decides */
};

/** Write the trajectory that w leads to, newX and newU: u = -K x + L^-T w of each stage. */
static void deviation(koopmpc_state *s, const koopmpc_real *w) {
  koopmpc_real x[NS];
  koopmpc_fill(x, 0, NS);
  for (int k = 0; k < STEPS; k++) {
    const koopmpc_real *half = s->half + k * NV * NV;
    koopmpc_real *u = s->newU + k * NV, *next = s->newX + k * NS;
    for (int i = NV - 1; i >= 0; i--) {
      u[i] = koopmpc_free[k] ? w[koopmpc_finish_at[k] * NV + i] : 0;
      for (int j = i + 1; j < NV; j++) u[i] -= half[j * NV + i] * u[j];
      u[i] /= half[i * NV + i];
    }
    for (int i = 0; i < NV; i++) u[i] -= koopmpc_dot(s->K + (k * NV + i) * NS, x, NS);
    for (int i = 0; i < NS; i++)
      next[i] = koopmpc_dot(s->A + (k * NS + i) * NS, x, NS) + koopmpc_dot(s->B + (k * NS + i) * NV, u, NV);
    koopmpc_copy(x, next, NS);
  }
}

/** Rows of length 1, and prices of the soft ones; 0 if the recursion has lost all digits. */
static int condense(koopmpc_state *s) {
  koopmpc_real w[WIDTH];
  int good = 1;
  for (int j = 0; j < WIDTH; j++) {
    koopmpc_fill(w, 0, WIDTH);
    w[j] = 1;
    deviation(s, w);
    for (int i = 0; i < COUNT; i++)
      s->finish_M[i * WIDTH + j] = koopmpc_moved(s, koopmpc_finish_row[i] / NQ, koopmpc_finish_row[i] % NQ, s->newX, s->newU);
  }
  for (int i = 0; i < COUNT; i++) {
    koopmpc_real *row = s->finish_M + i * WIDTH, size = KOOPMPC_SQRT(koopmpc_dot(row, row, WIDTH));
    const int which = koopmpc_finish_row[i] % NQ;
    good &= size < KOOPMPC_HUGE;
    if (!(size > 0)) size = 1;
    for (int j = 0; j < WIDTH; j++) row[j] /= size;
    s->finish_size[i] = size;
    s->finish_scaling[i] = 1;
    s->finish_linear[i] = s->finish_rho[i] = 0;
    if (koopmpc_finish_sense[i]) { /* half of the prices, as of the cost */
      const koopmpc_real linear = koopmpc_softness_linear[which - NV] * size / 2;
      const koopmpc_real curvature = koopmpc_softness_quadratic[which - NV] * size * size;
      s->finish_linear[i] = linear;
      s->finish_rho[i] = 1 / (curvature < (koopmpc_real)1e-6 * linear ? (koopmpc_real)1e-6 * linear : curvature);
    }
  }
  return good;
}

koopmpc_status koopmpc_finish(koopmpc_state *s, int *iterations) {
  const koopmpc_qp problem = {WIDTH, COUNT, KOOPMPC_FINISH_SOFT, 0, s->finish_M, s->finish_scaling, 0,
                              koopmpc_finish_sense, s->finish_linear, s->finish_rho};
  koopmpc_qp_memory qp = koopmpc_qp_on(&problem, s->finish_reals, s->finish_ints);
  koopmpc_qp_end end;
  int good = 0;
  s->spent += FINISHED;
  for (int r = 0; r < COUNT; r++) { /* the program without limits is in newX and newU */
    const int k = koopmpc_finish_row[r] / NQ, i = koopmpc_finish_row[r] % NQ;
    s->finish_free[r] = koopmpc_moved(s, k, i, s->newX, s->newU) + koopmpc_quantity(s, k, i);
  }
  koopmpc_copy(s->dX, s->newX, STEPS * NS);
  koopmpc_copy(s->dU, s->newU, STEPS * NV);
  if (!condense(s)) return KOOPMPC_FAILED;
  if (!s->finishing) koopmpc_fill(s->finish_dual, 0, COUNT);
  s->finishing = 0;
  for (int r = 0; r < COUNT; r++) { /* distances from the plan without limits, in units of the rows */
    const int k = koopmpc_finish_row[r] / NQ, i = koopmpc_finish_row[r] % NQ;
    const koopmpc_real at = s->finish_free[r], size = s->finish_size[r];
    qp.low[r] = koopmpc_clip((koopmpc_low_of(s, k, i) - at) / size, -KOOPMPC_HUGE, KOOPMPC_HUGE);
    qp.high[r] = koopmpc_clip((koopmpc_high_of(s, k, i) - at) / size, -KOOPMPC_HUGE, KOOPMPC_HUGE);
  }
  end = koopmpc_qp_find(&problem, &qp, s->finish_dual, 0, &good);
  *iterations += end.iterations;
  if (!good)
    return end.flag == -1 && KOOPMPC_HARD_OUTPUTS ? KOOPMPC_INFEASIBLE : KOOPMPC_FAILED;
  koopmpc_copy(s->finish_dual, qp.dual, COUNT);
  s->finishing = 1;
  deviation(s, qp.primal);
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < SOFT; i++) {
      const int row = koopmpc_sides_row[HARD + i];
      const koopmpc_real moved = koopmpc_moved(s, k, row, s->newX, s->newU);
      const koopmpc_real now = koopmpc_quantity(s, k, row) + koopmpc_moved(s, k, row, s->dX, s->dU);
      const koopmpc_real low = koopmpc_low_of(s, k, row), high = koopmpc_high_of(s, k, row);
      const koopmpc_real past = koopmpc_sides_scale[HARD + i] > 0 ? low - now - moved : now + moved - high;
      s->eps[i * STEPS + k] = past > 0 ? past / koopmpc_sides_span[HARD + i] : 0;
    }
  for (int i = 0; i < STEPS * NS; i++) s->dX[i] += s->newX[i];
  for (int i = 0; i < STEPS * NV; i++) s->dU[i] += s->newU[i];
  return KOOPMPC_OPTIMAL;
}
#else
typedef int koopmpc_no_limits; /* C forbids an empty file */
#endif
