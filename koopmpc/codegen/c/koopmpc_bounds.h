/** @file koopmpc_bounds.h @brief Limits that move in time, and those of the controller where none do. */
#ifndef KOOPMPC_BOUNDS_H
#define KOOPMPC_BOUNDS_H

#include "koopmpc_common.h"

#if KOOPMPC_BOUNDS
#define KOOPMPC_PLAN_LOW(s) (s)->low
#define KOOPMPC_PLAN_HIGH(s) (s)->high
#define KOOPMPC_BOX_LOW(s) (s)->box_low
#define KOOPMPC_BOX_HIGH(s) (s)->box_high
#define KOOPMPC_STAGE_BOX_LOW(s, k) ((s)->box_low + (k) * KOOPMPC_NU)
#define KOOPMPC_STAGE_BOX_HIGH(s, k) ((s)->box_high + (k) * KOOPMPC_NU)

/** Take the limits of the controller itself. */
void koopmpc_reset_bounds(koopmpc_state *s);

/** A bound of a row, at most KOOPMPC_HUGE in size. */
static inline koopmpc_real koopmpc_bound_of(const koopmpc_rows *rows, int k, int width, int i) {
  return koopmpc_clip(koopmpc_row(rows, k, width)[i], -KOOPMPC_HUGE, KOOPMPC_HUGE);
}
#else
#define KOOPMPC_PLAN_LOW(s) koopmpc_low
#define KOOPMPC_PLAN_HIGH(s) koopmpc_high
#define KOOPMPC_BOX_LOW(s) koopmpc_input_low
#define KOOPMPC_BOX_HIGH(s) koopmpc_input_high
#define KOOPMPC_STAGE_BOX_LOW(s, k) koopmpc_input_low
#define KOOPMPC_STAGE_BOX_HIGH(s, k) koopmpc_input_high
#endif

#if KOOPMPC_BOUNDS && !KOOPMPC_IS_STAGED
#define KOOPMPC_RATES_LOW(s) (s)->rate_low
#define KOOPMPC_RATES_HIGH(s) (s)->rate_high

/** Widen hard rates of later moves as far as the limits of the inputs need; return by how much at most. */
koopmpc_real koopmpc_open_rates(koopmpc_state *s);
#else
#define KOOPMPC_RATES_LOW(s) koopmpc_rate_low
#define KOOPMPC_RATES_HIGH(s) koopmpc_rate_high
#endif

#endif
