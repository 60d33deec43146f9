/** @file koopmpc_bounds.c @brief Limits that move in time: the right-hand sides of a plan from rows of bounds. */
#include "koopmpc_bounds.h"
#include "koopmpc_limits.h"
#include "koopmpc_plan.h"
#include "koopmpc_qp.h"
#include "koopmpc_receding.h"
#include "koopmpc_solver.h"
#include "koopmpc_targets.h"

#if KOOPMPC_BOUNDS
void koopmpc_reset_bounds(koopmpc_state *s) {
  koopmpc_copy(s->low, koopmpc_low, KOOPMPC_NT);
  koopmpc_copy(s->high, koopmpc_high, KOOPMPC_NT);
  for (int j = 0; j < KOOPMPC_MOVES; j++) {
    s->box_low[j] = koopmpc_input_low[j % KOOPMPC_NU];
    s->box_high[j] = koopmpc_input_high[j % KOOPMPC_NU];
  }
  koopmpc_copy(s->rate_low, koopmpc_rate_low, KOOPMPC_NU);
  koopmpc_copy(s->rate_high, koopmpc_rate_high, KOOPMPC_NU);
  for (int k = 0; k <= KOOPMPC_N; k++) {
    koopmpc_copy(s->target_low + k * KOOPMPC_NL, koopmpc_target_low, KOOPMPC_NL);
    koopmpc_copy(s->target_high + k * KOOPMPC_NL, koopmpc_target_high, KOOPMPC_NL);
  }
  s->unpushed = KOOPMPC_UNPUSHED;
}

void koopmpc_set_bounds(koopmpc_state *s, const koopmpc_bounds *b) {
  enum { NU = KOOPMPC_NU, OUT = KOOPMPC_OUTPUTS, OUT1 = OUT > 0 ? OUT : 1, FIRST = KOOPMPC_MOVES * (1 + KOOPMPC_CHANGES) };
  for (int at = 0; at < KOOPMPC_MOVES; at++) { /* the tightest limits of the steps in which a move is held */
    const int i = at % NU;
    koopmpc_real low = -KOOPMPC_HUGE, high = KOOPMPC_HUGE;
    for (int k = 0; k < koopmpc_hold_count[at]; k++) {
      const int row = KOOPMPC_LATENCY + koopmpc_hold_first[at] + k;
      const koopmpc_real below = koopmpc_bound_of(&b->u_low, row, NU, i), above = koopmpc_bound_of(&b->u_high, row, NU, i);
      low = below > low ? below : low;
      high = above < high ? above : high;
    }
    s->box_low[at] = low;
    s->box_high[at] = high;
    s->low[at] = koopmpc_tied[at] ? -KOOPMPC_HUGE : low;
    s->high[at] = koopmpc_tied[at] ? KOOPMPC_HUGE : high;
    if (KOOPMPC_CHANGES) {
      const int row = KOOPMPC_LATENCY + koopmpc_move_start[at / NU];
      s->low[KOOPMPC_MOVES + at] = koopmpc_held[at] ? -KOOPMPC_HUGE : koopmpc_bound_of(&b->du_low, row, NU, i);
      s->high[KOOPMPC_MOVES + at] = koopmpc_held[at] ? KOOPMPC_HUGE : koopmpc_bound_of(&b->du_high, row, NU, i);
    }
  }
  for (int i = 0; i < NU && KOOPMPC_CHANGES; i++) {
    s->rate_low[i] = koopmpc_bound_of(&b->du_low, KOOPMPC_LATENCY, NU, i);
    s->rate_high[i] = koopmpc_bound_of(&b->du_high, KOOPMPC_LATENCY, NU, i);
  }
  for (int j = 0; j < KOOPMPC_N * OUT; j++) {
    const int row = KOOPMPC_LATENCY + j / OUT1 + 1;
    s->low[FIRST + j] = koopmpc_bound_of(&b->x_low, row, OUT, j % OUT1) + koopmpc_inwards[j];
    s->high[FIRST + j] = koopmpc_bound_of(&b->x_high, row, OUT, j % OUT1) - koopmpc_inwards[j];
  }
  for (int i = KOOPMPC_PLANNED; i < KOOPMPC_PLANNED + 2 * KOOPMPC_CHECKED; i++) {
    s->low[i] = -KOOPMPC_HUGE;
    s->high[i] = KOOPMPC_HUGE;
  }
  for (int k = 0; k <= KOOPMPC_N && KOOPMPC_AIMED; k++)
    for (int i = 0; i < NU + OUT; i++) { /* limits of the target of this row */
      const int row = KOOPMPC_LATENCY + k;
      const koopmpc_real below = i < NU ? koopmpc_bound_of(&b->u_low, row, NU, i) : koopmpc_bound_of(&b->x_low, row, OUT, i - NU);
      const koopmpc_real above = i < NU ? koopmpc_bound_of(&b->u_high, row, NU, i) : koopmpc_bound_of(&b->x_high, row, OUT, i - NU);
      s->target_low[k * KOOPMPC_NL + i] = below - koopmpc_target_values[i];
      s->target_high[k * KOOPMPC_NL + i] = above - koopmpc_target_values[i];
    }
#if KOOPMPC_AIMED
  s->unpushed = KOOPMPC_HUGE;
  for (int i = 0; i < NU + OUT; i++) { /* the tightest limits of a target |r| times its gain away from its offset */
    koopmpc_real below = -KOOPMPC_HUGE, above = KOOPMPC_HUGE, room;
    for (int k = 0; k <= KOOPMPC_N; k++) {
      const koopmpc_real low = s->target_low[k * KOOPMPC_NL + i], high = s->target_high[k * KOOPMPC_NL + i];
      below = low > below ? low : below;
      above = high < above ? high : above;
    }
    below = koopmpc_target_shift[i] - below;
    above -= koopmpc_target_shift[i];
    room = below < above ? below : above;
    room = koopmpc_target_gain[i] > 0 ? room / koopmpc_target_gain[i] : room < 0 ? -1 : KOOPMPC_HUGE;
    s->unpushed = room < s->unpushed ? room : s->unpushed;
  }
#endif
  for (int i = 0; i < KOOPMPC_CHECKED; i++) { /* the tightest of them, which a plan is tested by */
    const int at = koopmpc_checked_limit[i];
    koopmpc_real *low = s->low + KOOPMPC_PLANNED + i, *high = s->high + KOOPMPC_PLANNED + KOOPMPC_CHECKED + i;
    const koopmpc_real reach = KOOPMPC_ROUNDING * koopmpc_target_size[at];
    for (int k = 0; k <= KOOPMPC_N; k++) {
      const koopmpc_real below = s->target_low[k * KOOPMPC_NL + at] - reach;
      const koopmpc_real above = s->target_high[k * KOOPMPC_NL + at] + reach;
      *low = below > *low ? below : *low;
      *high = above < *high ? above : *high;
    }
  }
  s->aimed = 0;
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
    if (!koopmpc_hard[i]) continue;
    least = koopmpc_clip(last + s->opened_low[i], s->box_low[i], s->box_high[i]);
    most = koopmpc_clip(last + s->opened_high[i], s->box_low[i], s->box_high[i]);
    for (int at = i + NU; at < MOVED; at += NU) { /* the inputs that can be reached inside all limits */
      least += koopmpc_held[at] ? 0 : s->opened_low[at];
      most += koopmpc_held[at] ? 0 : s->opened_high[at];
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
    if (widest > (koopmpc_real)1e-5 * koopmpc_rate_allowance[i] && widest > conflict) conflict = widest;
  }
#else
  (void)s;
#endif
  return conflict;
}
#endif
