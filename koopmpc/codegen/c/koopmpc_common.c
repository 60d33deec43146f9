/** @file koopmpc_common.c @brief Vectors, the history of delays, and targets: what all controllers share. */
#include <math.h>

#include "koopmpc_common.h"
#include "koopmpc_limits.h"
#include "koopmpc_solver.h"
#include "koopmpc_targets.h"

void koopmpc_add(koopmpc_real *restrict to, const koopmpc_real *restrict map, int rows, const koopmpc_real *restrict x,
                 int columns) {
  int j = 0;
  for (; j + 3 < columns; j += 4, map += 4 * rows) {
    const koopmpc_real a = x[j], b = x[j + 1], c = x[j + 2], d = x[j + 3];
    for (int i = 0; i < rows; i++)
      to[i] += (a * map[i] + b * map[rows + i]) + (c * map[2 * rows + i] + d * map[3 * rows + i]);
  }
  for (; j < columns; j++, map += rows) {
    const koopmpc_real a = x[j];
    for (int i = 0; i < rows; i++) to[i] += a * map[i];
  }
}

void koopmpc_observe(koopmpc_real *zeta, int *seen, koopmpc_real *z, const koopmpc_real *x, const koopmpc_real *u) {
#if KOOPMPC_DELAYS
  enum { PAST = KOOPMPC_NX + KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS, FIRST = KOOPMPC_NX };
  int known = 1;
  for (int i = 0; i < KOOPMPC_NX; i++) known &= isfinite(x[i]) != 0;
  if (!*seen) { /* the first measurement stands in for what was before it */
    for (int k = 0; k < KOOPMPC_DELAYS; k++) {
      koopmpc_real *past = zeta + FIRST + k * PAST;
      if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(past, u, KOOPMPC_NU);
      koopmpc_copy(past + PAST - KOOPMPC_NX, x, KOOPMPC_NX);
    }
    *seen = known;
  } else {
    for (int i = FIRST + KOOPMPC_DELAYS * PAST - 1; i >= FIRST + PAST; i--) zeta[i] = zeta[i - PAST];
    koopmpc_copy(zeta + FIRST + PAST - KOOPMPC_NX, zeta, KOOPMPC_NX);
    if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(zeta + FIRST, u, KOOPMPC_NU);
  }
  if (known || !*seen)
    koopmpc_copy(zeta, x, KOOPMPC_NX);
  else { /* a missed state is NaN in its own step; afterwards the last one that was measured stands in */
    koopmpc_fill(z, (koopmpc_real)NAN, KOOPMPC_NZ);
    return;
  }
#else
  (void)seen;
  (void)u;
  koopmpc_copy(zeta, x, KOOPMPC_NX);
#endif
  koopmpc_real size = 0;
  for (int i = 0; i < KOOPMPC_NZETA; i++) size += koopmpc_abs(zeta[i]);
  if (size < KOOPMPC_HUGE)
    koopmpc_lift(zeta, z);
  else
    koopmpc_fill(z, (koopmpc_real)NAN, KOOPMPC_NZ);
}

void koopmpc_nearest(const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha) {
  koopmpc_copy(alpha, koopmpc_target_offset, KOOPMPC_NA);
  koopmpc_add(alpha, koopmpc_target_reference, KOOPMPC_NA, r, KOOPMPC_NR);
  if (e) koopmpc_add(alpha, koopmpc_target_disturbance, KOOPMPC_NA, e, KOOPMPC_NZ);
}

int koopmpc_target(koopmpc_state *s, const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha) {
  koopmpc_real low[KOOPMPC_NL], high[KOOPMPC_NL], value[KOOPMPC_NL];
  int outside = 0;
  koopmpc_nearest(r, e, alpha);
  koopmpc_fill(value, 0, KOOPMPC_NL);
  koopmpc_add(value, koopmpc_target_rows, KOOPMPC_NL, alpha, KOOPMPC_NA);
  koopmpc_fill(low, 0, KOOPMPC_NL);
  if (e) koopmpc_add(low, koopmpc_target_rows_disturbance, KOOPMPC_NL, e, KOOPMPC_NZ);
  for (int i = 0; i < KOOPMPC_NL; i++) {
    const koopmpc_real pushed = low[i];
    const koopmpc_real reach = KOOPMPC_ROUNDING * (koopmpc_abs(value[i]) + koopmpc_target_size[i]);
    low[i] = koopmpc_target_low[i] - pushed;
    high[i] = koopmpc_target_high[i] - pushed;
    outside |= value[i] < low[i] - reach || value[i] > high[i] + reach;
  }
  if (!outside) return 0;
  for (int which = 0; which < 2; which++) { /* inside all limits, or inside those of the inputs alone */
    const koopmpc_qp *qp = &koopmpc_target_qps[which];
    koopmpc_qp_memory mem = koopmpc_qp_on(qp, s->target_reals, s->target_ints);
    for (int wider = 0; wider < 2; wider++) { /* believed to have no solution only with limits a tolerance wider */
      for (int i = 0; i < qp->m; i++) {
        mem.low[i] = koopmpc_clip(low[i] - value[i], -KOOPMPC_HUGE, KOOPMPC_HUGE) * koopmpc_target_unit[which][i];
        mem.high[i] = koopmpc_clip(high[i] - value[i], -KOOPMPC_HUGE, KOOPMPC_HUGE) * koopmpc_target_unit[which][i];
      }
      if (koopmpc_qp_solve(qp, &mem, 0, wider ? KOOPMPC_WIDER : 0, 0).flag > 0) {
        for (int i = 0; i < KOOPMPC_NA; i++) alpha[i] += mem.primal[i];
        return 1;
      }
    }
  }
  koopmpc_fill(alpha, 0, KOOPMPC_NA);
  return 1;
}

void koopmpc_admit(koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high, const koopmpc_real *last) {
  for (int i = 0; i < KOOPMPC_NU; i++) {
    if (low) u[i] = koopmpc_clip(u[i], last[i] + low[i], last[i] + high[i]);
    u[i] = koopmpc_clip(u[i], koopmpc_input_low[i], koopmpc_input_high[i]);
  }
}
