/** @file koopmpc_stage_bounds.c @brief Limits that move in time: those of the stages from rows of bounds. */
#include "koopmpc_stage_bounds_tables.h"
#include "koopmpc_stages.h"

#if KOOPMPC_BOUNDS
enum { OUT = KOOPMPC_OUTPUTS, INPUTS = KOOPMPC_WITH_RATES * NV, LAST = NQ - OUT };

void koopmpc_reset_bounds(koopmpc_state *s) {
  koopmpc_copy(s->low, koopmpc_stage_limits_low, STEPS * NQ);
  koopmpc_copy(s->high, koopmpc_stage_limits_high, STEPS * NQ);
  for (int k = 0; k < STEPS; k++) {
    koopmpc_copy(s->box_low + k * NV, koopmpc_inputs_low, NV);
    koopmpc_copy(s->box_high + k * NV, koopmpc_inputs_high, NV);
  }
}

/** Set the limits of entry i of stage k; one that a row does not have is `far` beyond the controller's. */
static void set(koopmpc_state *s, int k, int i, koopmpc_real low, koopmpc_real high, koopmpc_real inwards,
                koopmpc_real far) {
  const int at = i * STEPS + k;
  const koopmpc_real below = low > -KOOPMPC_HUGE ? low + inwards : koopmpc_stage_limits_low[at] - far;
  const koopmpc_real above = high < KOOPMPC_HUGE ? high - inwards : koopmpc_stage_limits_high[at] + far;
  s->low[at] = koopmpc_clip(below, -KOOPMPC_HUGE, KOOPMPC_HUGE);
  s->high[at] = koopmpc_clip(above, -KOOPMPC_HUGE, KOOPMPC_HUGE);
}

void koopmpc_set_bounds(koopmpc_state *s, const koopmpc_bounds *b) {
  for (int k = 0; k < STEPS; k++) {
    const int row = KOOPMPC_LATENCY + k;
    for (int i = 0; i < NV; i++) {
      const koopmpc_real low = koopmpc_bound_of(&b->u_low, row, NV, i), high = koopmpc_bound_of(&b->u_high, row, NV, i);
      set(s, k, INPUTS + i, low, high, 0, koopmpc_bounds_far_inputs[i]);
      s->box_low[k * NV + i] = low > -KOOPMPC_HUGE ? low : koopmpc_inputs_low[i];
      s->box_high[k * NV + i] = high < KOOPMPC_HUGE ? high : koopmpc_inputs_high[i];
    }
    for (int j = 0; j < OUT; j++)
      set(s, k, LAST + j, koopmpc_bound_of(&b->x_low, row + 1, OUT, j), koopmpc_bound_of(&b->x_high, row + 1, OUT, j),
          koopmpc_bounds_margin[j * STEPS + k], koopmpc_bounds_far_outputs[j]);
  }
}
#endif
