/** @file koopmpc_target.c @brief The equilibrium nearest to a reference row, inside the limits. */
#include "koopmpc_step.h"
#include "koopmpc_target_tables.h"

#if KOOPMPC_TARGET_SOLVERS
/* inside all limits, or inside those of the inputs alone */
static const koopmpc_qp qps[2] = {
    {KOOPMPC_TARGET_SOLVERS_0_VARIABLES, KOOPMPC_TARGET_SOLVERS_0_COUNT, 0, 0, koopmpc_target_solvers_0_M, koopmpc_target_solvers_0_scaling,
     KOOPMPC_TARGET_SOLVERS_0_RINV_LENGTH ? koopmpc_target_solvers_0_rinv : 0, koopmpc_target_solvers_0_sense, 0, 0},
    {KOOPMPC_TARGET_SOLVERS_1_VARIABLES, KOOPMPC_TARGET_SOLVERS_1_COUNT, 0, 0, koopmpc_target_solvers_1_M, koopmpc_target_solvers_1_scaling,
     KOOPMPC_TARGET_SOLVERS_1_RINV_LENGTH ? koopmpc_target_solvers_1_rinv : 0, koopmpc_target_solvers_1_sense, 0, 0}};
static const koopmpc_real *const units[2] = {koopmpc_target_solvers_0_rows, koopmpc_target_solvers_1_rows};
#endif

void koopmpc_nearest(const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha) {
  koopmpc_copy(alpha, koopmpc_targets_offset, KOOPMPC_NA);
  koopmpc_add(alpha, koopmpc_targets_from_reference, KOOPMPC_NA, r, KOOPMPC_NR);
  if (e) koopmpc_add(alpha, koopmpc_targets_from_disturbance, KOOPMPC_NA, e, KOOPMPC_NZ);
}

int koopmpc_target_within(koopmpc_state *s, int k, const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha) {
  const koopmpc_real *least = KOOPMPC_TARGET_LOW(s, k), *most = KOOPMPC_TARGET_HIGH(s, k);
  koopmpc_real low[KOOPMPC_NL + 1], high[KOOPMPC_NL + 1], value[KOOPMPC_NL + 1];
  int outside = 0;
  (void)s, (void)k; /* where no limit moves, or nothing is solved */
  koopmpc_nearest(r, e, alpha);
  koopmpc_fill(value, 0, KOOPMPC_NL);
  koopmpc_add(value, koopmpc_targets_rows, KOOPMPC_NL, alpha, KOOPMPC_NA);
  koopmpc_fill(low, 0, KOOPMPC_NL);
  if (e) koopmpc_add(low, koopmpc_targets_rows_disturbance, KOOPMPC_NL, e, KOOPMPC_NZ);
  for (int i = 0; i < KOOPMPC_NL; i++) {
    const koopmpc_real pushed = low[i];
    const koopmpc_real reach = KOOPMPC_ROUNDING * (koopmpc_abs(value[i]) + koopmpc_targets_size[i]);
    low[i] = least[i] - pushed;
    high[i] = most[i] - pushed;
    outside |= value[i] < low[i] - reach || value[i] > high[i] + reach;
  }
  if (!outside) return 0;
#if KOOPMPC_TARGET_SOLVERS
  for (int which = 0; which < 2; which++) {
    const koopmpc_qp *qp = &qps[which];
    koopmpc_qp_memory mem = koopmpc_qp_on(qp, s->target_reals, s->target_ints);
    for (int i = 0; i < qp->m; i++) {
      mem.low[i] = koopmpc_clip(low[i] - value[i], -KOOPMPC_HUGE, KOOPMPC_HUGE) * units[which][i];
      mem.high[i] = koopmpc_clip(high[i] - value[i], -KOOPMPC_HUGE, KOOPMPC_HUGE) * units[which][i];
    }
    for (int wider = 0; wider < 2; wider++) /* infeasible only if it is so with limits a tolerance wider */
      if (koopmpc_qp_solve(qp, &mem, 0, wider ? KOOPMPC_WIDER : 0, 0).flag > 0) {
        for (int i = 0; i < KOOPMPC_NA; i++) alpha[i] += mem.primal[i];
        return 1;
      }
  }
#endif
  koopmpc_fill(alpha, 0, KOOPMPC_NA);
  return 1;
}
