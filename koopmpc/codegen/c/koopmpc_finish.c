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

/** x and u = -K x + L^-T w of a stage, w its part of `all`; NULL for zero. */
static void deviate(const koopmpc_state *s, int k, const koopmpc_real *all, const koopmpc_real *x, koopmpc_real *u,
                    koopmpc_real *next) {
  const koopmpc_real *half = s->half + k * NV * NV;
  for (int i = NV - 1; i >= 0; i--) {
    u[i] = koopmpc_free[k] && all ? all[koopmpc_finish_at[k] * NV + i] : 0;
    for (int j = i + 1; j < NV; j++) u[i] -= half[j * NV + i] * u[j];
    u[i] /= half[i * NV + i];
  }
  for (int i = 0; i < NV; i++) u[i] -= koopmpc_dot(s->K + (k * NV + i) * NS, x, NS);
  for (int i = 0; i < NS; i++)
    next[i] = koopmpc_dot(s->A + (k * NS + i) * NS, x, NS) + koopmpc_dot(s->B + (k * NS + i) * NV, u, NV);
}

/** Write the trajectory that w leads to: newX and newU. */
static void deviation(koopmpc_state *s, const koopmpc_real *w) {
  koopmpc_real x[NS];
  koopmpc_fill(x, 0, NS);
  for (int k = 0; k < STEPS; k++) {
    deviate(s, k, w, x, s->newU + k * NV, s->newX + k * NS);
    koopmpc_copy(x, s->newX + k * NS, NS);
  }
}

static koopmpc_real moved_by(const koopmpc_state *s, int place) {
  const int k = place / NQ, i = place % NQ;
  return i < NV ? s->newU[k * NV + i] : koopmpc_dot(s->G + (k * NG + i - NV) * NS, s->newX + k * NS, NS);
}

/** Rows of length 1, and prices of the soft ones; 0 if the recursion has lost all digits. */
static int condense(koopmpc_state *s) {
  koopmpc_real w[WIDTH];
  int good = 1;
  for (int j = 0; j < WIDTH; j++) {
    koopmpc_fill(w, 0, WIDTH);
    w[j] = 1;
    deviation(s, w);
    for (int i = 0; i < COUNT; i++) s->finish_M[i * WIDTH + j] = moved_by(s, koopmpc_finish_row[i]);
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

/** Set the limits: distances from the plan without limits, in units of the rows. */
static void room(const koopmpc_state *s, koopmpc_qp_memory *qp, int hard_alone) {
  for (int r = 0; r < COUNT; r++) {
    const int k = koopmpc_finish_row[r] / NQ, i = koopmpc_finish_row[r] % NQ, off = hard_alone && koopmpc_finish_sense[r];
    const koopmpc_real at = s->finish_free[r], size = s->finish_size[r];
    const koopmpc_real low = koopmpc_low_of(s, k, i) - at, high = koopmpc_high_of(s, k, i) - at;
    qp->low[r] = off ? -KOOPMPC_HUGE : koopmpc_clip(low / size, -KOOPMPC_HUGE, KOOPMPC_HUGE);
    qp->high[r] = off ? KOOPMPC_HUGE : koopmpc_clip(high / size, -KOOPMPC_HUGE, KOOPMPC_HUGE);
  }
}

static koopmpc_qp_end again(const koopmpc_state *s, const koopmpc_qp *problem, koopmpc_qp_memory *qp,
                            const koopmpc_real *push, int hard_alone, int wider, int *good) {
  room(s, qp, hard_alone);
  return koopmpc_qp_attempt(problem, qp, push, wider ? KOOPMPC_WIDER : 0, 0, good);
}

koopmpc_status koopmpc_finish(koopmpc_state *s, int *iterations) {
  const koopmpc_qp problem = {WIDTH,           COUNT, KOOPMPC_FINISH_SOFT,   s->finish_M,     s->finish_scaling, 0,
                              koopmpc_finish_sense, s->finish_linear, s->finish_rho};
  koopmpc_qp_memory qp = koopmpc_qp_on(&problem, s->finish_reals, s->finish_ints);
  koopmpc_qp_end end;
  int good = 0, unmet = 0;
  s->spent += FINISHED;
  for (int r = 0; r < COUNT; r++) { /* the program without limits is in newX and newU */
    const int k = koopmpc_finish_row[r] / NQ, i = koopmpc_finish_row[r] % NQ;
    s->finish_free[r] = moved_by(s, koopmpc_finish_row[r]) + (i < NV ? s->V[k * NV + i] : s->g[k * NG + i - NV]);
  }
  koopmpc_copy(s->dX, s->newX, STEPS * NS);
  koopmpc_copy(s->dU, s->newU, STEPS * NV);
  if (!condense(s)) return KOOPMPC_FAILED;
  if (!s->finishing) koopmpc_fill(s->finish_dual, 0, COUNT);
  s->finishing = 0;
  end = again(s, &problem, &qp, s->finish_dual, 0, 0, &good);
  *iterations += end.iterations;
  if (!good && end.flag == -1 && KOOPMPC_FINISH_SOFT > 0 && KOOPMPC_FINISH_SOFT < COUNT) {
    const koopmpc_qp_end hard = again(s, &problem, &qp, 0, 1, 0, &unmet);
    unmet = !unmet && hard.flag == -1;
    if (unmet) unmet = again(s, &problem, &qp, 0, 1, 1, &good).flag == -1 && !good;
    good = 0;
  }
  if (!good && !unmet) {
    end = again(s, &problem, &qp, 0, 0, 1, &good);
    *iterations += end.iterations;
  }
  if (!good)
    return end.flag == -1 && KOOPMPC_HARD_OUTPUTS ? KOOPMPC_INFEASIBLE : KOOPMPC_FAILED;
  koopmpc_copy(s->finish_dual, qp.dual, COUNT);
  s->finishing = 1;
  deviation(s, qp.primal);
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < SOFT; i++) {
      const int row = koopmpc_sides_row[HARD + i];
      const koopmpc_real moved = moved_by(s, k * NQ + row);
      const koopmpc_real now = row < NV ? s->V[k * NV + row] + s->dU[k * NV + row]
                                        : s->g[k * NG + row - NV] +
                                              koopmpc_dot(s->G + (k * NG + row - NV) * NS, s->dX + k * NS, NS);
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
