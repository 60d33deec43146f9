/** @file koopmpc_bounds.c @brief Limits that move in time: the right-hand sides of a plan from rows of bounds. */
#include "koopmpc_bounds_tables.h"
#include "koopmpc_step.h"

#if KOOPMPC_BOUNDS
void koopmpc_reset_bounds(koopmpc_state *s) {
  koopmpc_copy(s->low, koopmpc_low, KOOPMPC_NT);
  koopmpc_copy(s->high, koopmpc_high, KOOPMPC_NT);
  for (int j = 0; j < KOOPMPC_MOVES; j++) {
    s->box_low[j] = koopmpc_inputs_low[j % KOOPMPC_NU];
    s->box_high[j] = koopmpc_inputs_high[j % KOOPMPC_NU];
  }
  koopmpc_copy(s->now_low, koopmpc_inputs_low, KOOPMPC_NU);
  koopmpc_copy(s->now_high, koopmpc_inputs_high, KOOPMPC_NU);
  koopmpc_copy(s->rate_low, koopmpc_rates_low, KOOPMPC_NU);
  koopmpc_copy(s->rate_high, koopmpc_rates_high, KOOPMPC_NU);
  for (int k = 0; k <= KOOPMPC_N; k++) {
    koopmpc_copy(s->target_low + k * KOOPMPC_NL, koopmpc_targets_low, KOOPMPC_NL);
    koopmpc_copy(s->target_high + k * KOOPMPC_NL, koopmpc_targets_high, KOOPMPC_NL);
  }
  s->unpushed = KOOPMPC_UNPUSHED;
}

/** Rows `first` to `first + count - 1` of some limits, no larger than numbers are; the last row holds. */
static void read_rows(koopmpc_real *to, const koopmpc_rows *rows, int first, int count, int width) {
  const int given = rows->count > first ? rows->count - first : 0, there = given < count ? given : count;
  const koopmpc_real *from = rows->values + first * width, *last = rows->values + (rows->count - 1) * width;
  for (int j = 0; j < there * width; j++) to[j] = koopmpc_clip(from[j], -KOOPMPC_HUGE, KOOPMPC_HUGE);
  for (int k = there; k < count; k++)
    for (int i = 0; i < width; i++) to[k * width + i] = koopmpc_clip(last[i], -KOOPMPC_HUGE, KOOPMPC_HUGE);
}

/** The tighter of two limits: of lower ones (end 0) the larger, of upper ones (end 1) the smaller. */
static inline koopmpc_real tighter(koopmpc_real a, koopmpc_real b, int end) { return (end ? b < a : b > a) ? b : a; }

void koopmpc_set_bounds(koopmpc_state *s, const koopmpc_bounds *b) {
  enum { NU = KOOPMPC_NU, OUT = KOOPMPC_OUTPUTS, OUT1 = OUT > 0 ? OUT : 1, FIRST = KOOPMPC_MOVES * (1 + KOOPMPC_CHANGES) };
  enum { LATE = KOOPMPC_LATENCY, AHEAD = KOOPMPC_N + 1, NL = KOOPMPC_NL };
  const koopmpc_rows *of_u[2] = {&b->u_low, &b->u_high}, *of_du[2] = {&b->du_low, &b->du_high};
  const koopmpc_rows *of_x[2] = {&b->x_low, &b->x_high};
  koopmpc_real *plans[2] = {s->low, s->high}, *boxes[2] = {s->box_low, s->box_high}, *now[2] = {s->now_low, s->now_high};
  koopmpc_real *rates[2] = {s->rate_low, s->rate_high}, *targets[2] = {s->target_low, s->target_high};
  koopmpc_real tightest[2][NL + 1], *below = tightest[0], *above = tightest[1]; /* of a target */
  for (int end = 0; end < 2; end++) {
    const koopmpc_real open = end ? KOOPMPC_HUGE : -KOOPMPC_HUGE;
    koopmpc_real u[AHEAD * NU], x[AHEAD * OUT1], *plan = plans[end], *box = boxes[end], *target = targets[end];
    read_rows(u, of_u[end], LATE, AHEAD, NU);
    if (OUT > 0) read_rows(x, of_x[end], LATE, AHEAD, OUT);
    koopmpc_copy(now[end], u, NU);
#if KOOPMPC_HELD_ONCE
    koopmpc_copy(box, u, KOOPMPC_MOVES);
#else
    for (int at = 0; at < KOOPMPC_MOVES; at++) { /* the tightest limits of the steps in which a move is held */
      box[at] = open;
      for (int k = 0; k < koopmpc_bounds_count[at]; k++)
        box[at] = tighter(box[at], u[(koopmpc_bounds_first[at] + k) * NU + at % NU], end);
    }
#endif
    for (int at = 0; at < KOOPMPC_MOVES; at++) plan[at] = koopmpc_bounds_tied[at] ? open : box[at];
    for (int at = 0; at < KOOPMPC_MOVES && KOOPMPC_CHANGES; at++) {
      const int row = LATE + koopmpc_bounds_start[at / NU];
      plan[KOOPMPC_MOVES + at] = koopmpc_bounds_held[at] ? open : koopmpc_bound_of(of_du[end], row, NU, at % NU);
    }
    for (int i = 0; i < NU && KOOPMPC_CHANGES; i++) rates[end][i] = koopmpc_bound_of(of_du[end], LATE, NU, i);
    for (int k = 0; k < KOOPMPC_N; k++)
      for (int i = 0; i < OUT; i++) {
        const koopmpc_real margin = koopmpc_bounds_margin[i * KOOPMPC_N + k];
        plan[FIRST + k * OUT + i] = x[(k + 1) * OUT + i] + (end ? -margin : margin);
      }
    for (int k = 0; k < AHEAD && KOOPMPC_AIMED; k++) { /* limits of the target of this row */
      for (int i = 0; i < NU; i++) target[k * NL + i] = u[k * NU + i] - koopmpc_bounds_values[i];
      for (int i = 0; i < OUT; i++) target[k * NL + NU + i] = x[k * OUT + i] - koopmpc_bounds_values[NU + i];
    }
    koopmpc_copy(tightest[end], target, NL);
    for (int k = 1; k < AHEAD; k++)
      for (int i = 0; i < NL; i++) tightest[end][i] = tighter(tightest[end][i], target[k * NL + i], end);
  }
#if KOOPMPC_AIMED
  const koopmpc_real before = s->unpushed;
  s->unpushed = KOOPMPC_HUGE;
  for (int i = 0; i < NU + OUT; i++) { /* a target is |r| times its gain away from its offset, at most */
    const koopmpc_real down = koopmpc_targets_shift[i] - below[i], up = above[i] - koopmpc_targets_shift[i];
    koopmpc_real room = down < up ? down : up;
    room = koopmpc_targets_gain[i] > 0 ? room / koopmpc_targets_gain[i] : room < 0 ? -1 : KOOPMPC_HUGE;
    s->unpushed = room < s->unpushed ? room : s->unpushed;
  }
  if (!KOOPMPC_DISTURBANCE_WIDTH && !(s->peak <= before && s->peak <= s->unpushed)) s->aimed = 0; /* else no target moves */
#endif
  for (int i = 0; i < KOOPMPC_CHECKED_COUNT; i++) { /* which a plan is tested by */
    const int at = koopmpc_bounds_checked[i];
    const koopmpc_real reach = KOOPMPC_ROUNDING * koopmpc_targets_size[at];
    s->low[KOOPMPC_PLANNED + i] = koopmpc_clip(below[at] - reach, -KOOPMPC_HUGE, KOOPMPC_HUGE);
    s->high[KOOPMPC_PLANNED + i] = KOOPMPC_HUGE;
    s->low[KOOPMPC_PLANNED + KOOPMPC_CHECKED_COUNT + i] = -KOOPMPC_HUGE;
    s->high[KOOPMPC_PLANNED + KOOPMPC_CHECKED_COUNT + i] = koopmpc_clip(above[at] + reach, -KOOPMPC_HUGE, KOOPMPC_HUGE);
  }
}

koopmpc_real koopmpc_open_rates(koopmpc_state *s) {
  koopmpc_real conflict = 0;
#if KOOPMPC_CHANGES
  enum { NU = KOOPMPC_NU, MOVED = KOOPMPC_MOVES };
  koopmpc_copy(s->opened_low, s->low + MOVED, MOVED);
  koopmpc_copy(s->opened_high, s->high + MOVED, MOVED);
  for (int i = 0; i < NU; i++) {
    koopmpc_real widest = 0;
    if (!koopmpc_bounds_hard[i]) continue;
    for (int end = 0; end < 2; end++) { /* the least, and the most, that can be reached inside all limits */
      koopmpc_real *rate = end ? s->opened_high : s->opened_low;
      koopmpc_real reached = koopmpc_clip(s->known[KOOPMPC_U_PREV + i] + rate[i], s->box_low[i], s->box_high[i]);
      for (int at = i + NU; at < MOVED; at += NU) {
        reached += koopmpc_bounds_held[at] ? 0 : rate[at];
        const koopmpc_real lacks = end ? s->box_low[at] - reached : reached - s->box_high[at];
        if (lacks > 0) rate[at] += end ? lacks : -lacks;
        if (lacks > widest) widest = lacks;
        reached = koopmpc_clip(reached, s->box_low[at], s->box_high[at]);
      }
    }
    if (widest > (koopmpc_real)1e-5 * koopmpc_bounds_allowance[i] && widest > conflict) conflict = widest;
  }
#else
  (void)s;
#endif
  return conflict;
}
#endif
