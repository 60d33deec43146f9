/** @file koopmpc_step.c @brief The way of a step, the fallback of a failed one, and what all files share. */
#include "koopmpc_step.h"
#include "koopmpc_step_tables.h"

#if KOOPMPC_MOVE_OF
#define MOVE_OF(k) koopmpc_move_of[k]
#else
#define MOVE_OF(k) (k)
#endif

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

void koopmpc_init(koopmpc_state *s, const koopmpc_real *x0, const koopmpc_real *u_prev) {
  const koopmpc_state empty = {0};
  *s = empty;
#if KOOPMPC_BOUNDS
  koopmpc_reset_bounds(s);
#endif
  for (int i = 0; i < KOOPMPC_NU; i++)
    s->given[i] = u_prev ? u_prev[i] : koopmpc_clip(0, koopmpc_inputs_low[i], koopmpc_inputs_high[i]);
#if KOOPMPC_LEVELS
  koopmpc_start_levels(s, s->given);
  if (!u_prev) koopmpc_round_levels(s, s->given, s->given);
  koopmpc_start_levels(s, s->given);
#endif
  for (int k = 0; k <= KOOPMPC_LATENCY; k++) koopmpc_copy(s->sent + k * KOOPMPC_NU, s->given, KOOPMPC_NU);
#if KOOPMPC_IS_STAGED
  koopmpc_use_targets(s, koopmpc_table, KOOPMPC_TARGETS);
#endif
  koopmpc_start_observer(s, x0);
}

void koopmpc_step(koopmpc_state *s, const koopmpc_real *y, const koopmpc_rows *reference, const koopmpc_real *applied,
                  const koopmpc_rows *w, koopmpc_real *u, koopmpc_report *report) {
  koopmpc_report own;
  if (!report) report = &own;
  report->fallback = KOOPMPC_NONE;
  report->iterations = 0;
  report->slack = report->gap = 0;
  koopmpc_observe(s, y, applied, w);
  report->refused = s->refused;
  koopmpc_decide(s, reference, applied, u, report);
}

void koopmpc_fail(koopmpc_state *s, const koopmpc_real *free_input, const koopmpc_real *applied, koopmpc_real *u,
                  koopmpc_report *report, koopmpc_status status) {
  koopmpc_real before[KOOPMPC_NU];
  const koopmpc_real *chosen = before;
  s->planned = 0;
  s->warm = 0;
  koopmpc_copy(before, applied && koopmpc_usable(applied, KOOPMPC_NU) ? applied : s->given, KOOPMPC_NU);
  report->status = status;
  report->slack = 0;
  if (s->has_kept && s->age + 1 < KOOPMPC_N) {
    s->age++;
#if KOOPMPC_FIRST_ALONE
    if (s->owes) koopmpc_settle(s, s->kept);
    s->owes = 0;
#endif
    chosen = s->kept + KOOPMPC_NU * MOVE_OF(s->age);
    report->fallback = KOOPMPC_SHIFTED_PLAN;
  } else {
    s->has_kept = 0;
    report->fallback = free_input ? KOOPMPC_CLIPPED_LQR : KOOPMPC_HOLD;
    if (free_input) chosen = free_input;
  }
  koopmpc_copy(u, chosen, KOOPMPC_NU);
  koopmpc_admit(s, u, KOOPMPC_RATES ? KOOPMPC_RATES_LOW(s) : 0, KOOPMPC_RATES_HIGH(s), before);
#if KOOPMPC_LEVELS
  koopmpc_round_levels(s, u, before);
#endif
  koopmpc_copy(s->given, u, KOOPMPC_NU);
}

void koopmpc_keep(koopmpc_state *s, const koopmpc_real *plan, koopmpc_real *u, koopmpc_report *report,
                  koopmpc_status status) {
  koopmpc_copy(s->kept, plan, KOOPMPC_MOVES);
  koopmpc_copy(s->given, plan, KOOPMPC_NU);
  koopmpc_copy(u, plan, KOOPMPC_NU);
#if KOOPMPC_FIRST_ALONE
  s->owes = 0;
#endif
  s->has_kept = s->planned = 1;
  s->age = 0;
  report->status = status;
}

int koopmpc_plan(const koopmpc_state *s, koopmpc_real *U) {
  koopmpc_real kept[KOOPMPC_MOVES];
  if (!s->planned) return 0;
  koopmpc_copy(kept, s->kept, KOOPMPC_MOVES);
#if KOOPMPC_FIRST_ALONE
  if (s->owes) koopmpc_settle(s, kept);
#endif
  for (int k = 0; k < KOOPMPC_N; k++) koopmpc_copy(U + k * KOOPMPC_NU, kept + KOOPMPC_NU * MOVE_OF(k), KOOPMPC_NU);
  return 1;
}

void koopmpc_admit(const koopmpc_state *s, koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high,
                   const koopmpc_real *last) {
  (void)s;
  for (int i = 0; i < KOOPMPC_NU; i++) {
    if (low) u[i] = koopmpc_clip(u[i], last[i] + low[i], last[i] + high[i]);
    u[i] = koopmpc_clip(u[i], KOOPMPC_BOX_LOW(s)[i], KOOPMPC_BOX_HIGH(s)[i]);
  }
}

#if KOOPMPC_GIVEN
void koopmpc_give_input(const koopmpc_state *s, int k, koopmpc_real *u) {
  const int ahead = s->row + KOOPMPC_LATENCY + k, row = ahead < KOOPMPC_GIVEN_LENGTH ? ahead : KOOPMPC_GIVEN_LENGTH - 1;
  for (int i = 0; i < KOOPMPC_NU; i++) u[i] = koopmpc_given[i * KOOPMPC_GIVEN_LENGTH + row];
}
#endif
