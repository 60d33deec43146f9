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

void koopmpc_set_bounds(koopmpc_state *s, const koopmpc_bounds *b) {
  enum { NU = KOOPMPC_NU, OUT = KOOPMPC_OUTPUTS, OUT1 = OUT > 0 ? OUT : 1, FIRST = KOOPMPC_MOVES * (1 + KOOPMPC_CHANGES) };
  enum { LATE = KOOPMPC_LATENCY, AHEAD = KOOPMPC_N + 1 };
  koopmpc_real u_low[AHEAD * NU], u_high[AHEAD * NU], x_low[AHEAD * OUT1], x_high[AHEAD * OUT1];
  read_rows(u_low, &b->u_low, LATE, AHEAD, NU);
  read_rows(u_high, &b->u_high, LATE, AHEAD, NU);
  if (OUT > 0) {
    read_rows(x_low, &b->x_low, LATE, AHEAD, OUT);
    read_rows(x_high, &b->x_high, LATE, AHEAD, OUT);
  }
  koopmpc_copy(s->now_low, u_low, NU);
  koopmpc_copy(s->now_high, u_high, NU);
#if KOOPMPC_HELD_ONCE
  koopmpc_copy(s->box_low, u_low, KOOPMPC_MOVES);
  koopmpc_copy(s->box_high, u_high, KOOPMPC_MOVES);
#else
  for (int at = 0; at < KOOPMPC_MOVES; at++) { /* the tightest limits of the steps in which a move is held */
    koopmpc_real low = -KOOPMPC_HUGE, high = KOOPMPC_HUGE;
    for (int k = 0; k < koopmpc_bounds_count[at]; k++) {
      const int row = (koopmpc_bounds_first[at] + k) * NU + at % NU;
      low = u_low[row] > low ? u_low[row] : low;
      high = u_high[row] < high ? u_high[row] : high;
    }
    s->box_low[at] = low;
    s->box_high[at] = high;
  }
#endif
  for (int at = 0; at < KOOPMPC_MOVES; at++) {
    s->low[at] = koopmpc_bounds_tied[at] ? -KOOPMPC_HUGE : s->box_low[at];
    s->high[at] = koopmpc_bounds_tied[at] ? KOOPMPC_HUGE : s->box_high[at];
  }
  for (int at = 0; at < KOOPMPC_MOVES && KOOPMPC_CHANGES; at++) {
    const int row = LATE + koopmpc_bounds_start[at / NU], i = at % NU;
    s->low[KOOPMPC_MOVES + at] = koopmpc_bounds_held[at] ? -KOOPMPC_HUGE : koopmpc_bound_of(&b->du_low, row, NU, i);
    s->high[KOOPMPC_MOVES + at] = koopmpc_bounds_held[at] ? KOOPMPC_HUGE : koopmpc_bound_of(&b->du_high, row, NU, i);
  }
  for (int i = 0; i < NU && KOOPMPC_CHANGES; i++) {
    s->rate_low[i] = koopmpc_bound_of(&b->du_low, LATE, NU, i);
    s->rate_high[i] = koopmpc_bound_of(&b->du_high, LATE, NU, i);
  }
  for (int k = 0; k < KOOPMPC_N; k++)
    for (int i = 0; i < OUT; i++) {
      const int j = k * OUT + i;
      s->low[FIRST + j] = x_low[OUT + j] + koopmpc_bounds_margin[i * KOOPMPC_N + k];
      s->high[FIRST + j] = x_high[OUT + j] - koopmpc_bounds_margin[i * KOOPMPC_N + k];
    }
  for (int k = 0; k <= KOOPMPC_N && KOOPMPC_AIMED; k++) { /* limits of the target of this row */
    koopmpc_real *low = s->target_low + k * KOOPMPC_NL, *high = s->target_high + k * KOOPMPC_NL;
    for (int i = 0; i < NU; i++) {
      low[i] = u_low[k * NU + i] - koopmpc_bounds_values[i];
      high[i] = u_high[k * NU + i] - koopmpc_bounds_values[i];
    }
    for (int i = 0; i < OUT; i++) {
      low[NU + i] = x_low[k * OUT + i] - koopmpc_bounds_values[NU + i];
      high[NU + i] = x_high[k * OUT + i] - koopmpc_bounds_values[NU + i];
    }
  }
  koopmpc_real below[KOOPMPC_NL + 1], above[KOOPMPC_NL + 1]; /* the tightest limits of a target */
  koopmpc_copy(below, s->target_low, KOOPMPC_NL);
  koopmpc_copy(above, s->target_high, KOOPMPC_NL);
  for (int k = 1; k < AHEAD; k++)
    for (int i = 0; i < KOOPMPC_NL; i++) {
      const koopmpc_real low = s->target_low[k * KOOPMPC_NL + i], high = s->target_high[k * KOOPMPC_NL + i];
      below[i] = low > below[i] ? low : below[i];
      above[i] = high < above[i] ? high : above[i];
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
    koopmpc_real least, most, widest = 0;
    const koopmpc_real last = s->known[KOOPMPC_U_PREV + i];
    if (!koopmpc_bounds_hard[i]) continue;
    least = koopmpc_clip(last + s->opened_low[i], s->box_low[i], s->box_high[i]);
    most = koopmpc_clip(last + s->opened_high[i], s->box_low[i], s->box_high[i]);
    for (int at = i + NU; at < MOVED; at += NU) { /* the inputs that can be reached inside all limits */
      least += koopmpc_bounds_held[at] ? 0 : s->opened_low[at];
      most += koopmpc_bounds_held[at] ? 0 : s->opened_high[at];
      if (most < s->box_low[at]) {
        s->opened_high[at] += s->box_low[at] - most;
        if (s->box_low[at] - most > widest) widest = s->box_low[at] - most;
      }
      if (least > s->box_high[at]) {
        s->opened_low[at] -= least - s->box_high[at];
        if (least - s->box_high[at] > widest) widest = least - s->box_high[at];
      }
      least = koopmpc_clip(least, s->box_low[at], s->box_high[at]);
      most = koopmpc_clip(most, s->box_low[at], s->box_high[at]);
    }
    if (widest > (koopmpc_real)1e-5 * koopmpc_bounds_allowance[i] && widest > conflict) conflict = widest;
  }
#else
  (void)s;
#endif
  return conflict;
}
#endif
