/** @file koopmpc_lqr.c @brief u = feedforward - K [psi(x); u_{k-1}], inside the limits of the inputs. */
#include <math.h>

#include "koopmpc_common.h"
#include "koopmpc_limits.h"
#include "koopmpc_plan.h"

/** Write the feedforward of a reference and a disturbance; 0 where one of them cannot be used. */
static int feedforward(koopmpc_state *s, const koopmpc_real *reference, const koopmpc_rows *w, koopmpc_real *u) {
  enum { TOLD = KOOPMPC_NW + KOOPMPC_NR + KOOPMPC_NU };
  koopmpc_real told[KOOPMPC_NW + KOOPMPC_NR + KOOPMPC_NU], *u_r = told + KOOPMPC_NW + KOOPMPC_NR;
  int good = koopmpc_usable(reference, KOOPMPC_NR);
  if (w) good &= koopmpc_usable(w->values, KOOPMPC_NW);
  for (int i = 0; i < KOOPMPC_NW; i++) told[i] = w ? w->values[i] : 0;
  koopmpc_copy(told + KOOPMPC_NW, reference, KOOPMPC_NR);
#if KOOPMPC_GIVEN
  koopmpc_copy(u_r, koopmpc_given + KOOPMPC_NU * s->row, KOOPMPC_NU);
#else
  if (good) {
    koopmpc_real alpha[KOOPMPC_NA], e[KOOPMPC_NZ];
    koopmpc_fill(e, 0, KOOPMPC_NZ);
    if (KOOPMPC_NW) koopmpc_add(e, koopmpc_E, KOOPMPC_NZ, told, KOOPMPC_NW);
    koopmpc_target(s, reference, w && KOOPMPC_NW ? e : 0, alpha);
    koopmpc_copy(u_r, koopmpc_target_input, KOOPMPC_NU);
    koopmpc_add(u_r, koopmpc_target_span, KOOPMPC_NU, alpha, KOOPMPC_NA);
    koopmpc_add(u_r, koopmpc_target_push, KOOPMPC_NU, e, KOOPMPC_NZ);
  }
#endif
  koopmpc_fill(u, 0, KOOPMPC_NU);
  if (good) koopmpc_add(u, koopmpc_feedforward, KOOPMPC_NU, told, TOLD);
  return good;
}

void koopmpc_init(koopmpc_state *s, const koopmpc_real *x0, const koopmpc_real *u_prev) {
  const koopmpc_state empty = {0};
  (void)x0;
  *s = empty;
  for (int i = 0; i < KOOPMPC_NU; i++)
    s->last[i] = u_prev ? u_prev[i] : koopmpc_clip(0, koopmpc_input_low[i], koopmpc_input_high[i]);
}

#if KOOPMPC_GATE
void koopmpc_predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected) {
  koopmpc_fill(z, 0, KOOPMPC_NZ);
  koopmpc_add(z, koopmpc_A, KOOPMPC_NZ, s->from, KOOPMPC_NZ);
  koopmpc_add(z, koopmpc_B, KOOPMPC_NZ, u, KOOPMPC_NU);
  if (KOOPMPC_NW) koopmpc_add(z, koopmpc_E, KOOPMPC_NZ, w, KOOPMPC_NW);
  koopmpc_fill(expected, 0, KOOPMPC_NY);
  koopmpc_add(expected, koopmpc_C, KOOPMPC_NX, z, KOOPMPC_NZ);
}
#endif

void koopmpc_step(koopmpc_state *s, const koopmpc_real *y, const koopmpc_rows *reference, const koopmpc_real *applied,
                  const koopmpc_rows *w, koopmpc_real *u, koopmpc_report *report) {
  koopmpc_real free_input[KOOPMPC_NU];
  int good, clipped = 0, refused = 0;
  koopmpc_status status = KOOPMPC_UNCONSTRAINED;
  koopmpc_fallback fallback = KOOPMPC_NONE;
  good = feedforward(s, reference->values, w, free_input);
  if (applied && koopmpc_usable(applied, KOOPMPC_NU)) koopmpc_copy(s->last, applied, KOOPMPC_NU);
#if KOOPMPC_GATE
  koopmpc_real next[KOOPMPC_NZ] = {0}, expected[KOOPMPC_NY];
  int opened;
  koopmpc_fill(expected, (koopmpc_real)NAN, KOOPMPC_NY);
  if (s->has_z) koopmpc_choose(s, y, s->last, s->w, next, expected);
  refused = koopmpc_refuse(s->gate, y, expected, &opened);
  if (opened == 2) s->seen = s->has_z = 0; /* the estimate is lost */
  if (refused) y = expected;
  for (int i = 0; i < KOOPMPC_NW; i++) /* one that is not finite keeps its last value */
    if (!w || koopmpc_abs(w->values[i]) < KOOPMPC_HUGE) s->w[i] = w ? w->values[i] : 0;
  if (s->doubted) {
    const koopmpc_rows held = {s->used_w, 1};
    good = feedforward(s, reference->values, &held, free_input);
  }
#endif
  if (s->row + 1 < KOOPMPC_GIVEN) s->row++;
  koopmpc_observe(s->zeta, &s->seen, s->z, y, s->last);
#if KOOPMPC_GATE
  s->has_z = koopmpc_bridge(s->from, s->has_z, &s->bridged, s->z, next);
#endif
  koopmpc_add(free_input, koopmpc_gain, KOOPMPC_NU, s->z, KOOPMPC_NZ);
  if (KOOPMPC_WITH_RATES) koopmpc_add(free_input, koopmpc_gain_rate, KOOPMPC_NU, s->last, KOOPMPC_NU);
  if (good && koopmpc_usable(free_input, KOOPMPC_NU)) {
    koopmpc_copy(u, free_input, KOOPMPC_NU);
  } else {
    koopmpc_copy(u, s->last, KOOPMPC_NU);
    status = KOOPMPC_BAD_MEASUREMENT;
    fallback = KOOPMPC_HOLD;
  }
  koopmpc_admit(u, KOOPMPC_RATED ? koopmpc_rate_low : 0, koopmpc_rate_high, s->last);
  for (int i = 0; i < KOOPMPC_NU; i++) clipped |= u[i] < free_input[i] || u[i] > free_input[i];
  if (fallback == KOOPMPC_NONE && clipped) status = KOOPMPC_SATURATED;
  koopmpc_copy(s->last, u, KOOPMPC_NU);
  if (report) {
    report->status = status;
    report->fallback = fallback;
    report->iterations = 0;
    report->slack = report->gap = 0;
    report->refused = refused;
  }
}

int koopmpc_plan(const koopmpc_state *s, koopmpc_real *U) {
  (void)s;
  (void)U;
  return 0;
}
