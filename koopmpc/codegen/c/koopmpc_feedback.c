/** @file koopmpc_feedback.c @brief u = feedforward - K [psi(x); u_{k-1}], inside the limits of the inputs. */
#include "koopmpc_feedback_tables.h"
#include "koopmpc_step.h"

void koopmpc_decide(koopmpc_state *s, const koopmpc_rows *reference, const koopmpc_real *applied, koopmpc_real *u,
                    koopmpc_report *report) {
  enum { NU = KOOPMPC_NU, NW = KOOPMPC_NW, NR = KOOPMPC_NR };
  const koopmpc_real *last = applied && koopmpc_usable(applied, NU) ? applied : s->given;
  koopmpc_real driving[NW + NR + NU], *r = driving + NW, *u_r = r + NR, pull[NU], free_input[NU];
  int clipped = 0, good;
  koopmpc_copy(driving, s->known + KOOPMPC_PREVIEW, NW);
  koopmpc_copy(r, reference->values, NR);
  good = koopmpc_usable(driving, NW + NR);
#if KOOPMPC_GIVEN
  koopmpc_give_input(s, 0, u_r);
  if (s->row + 1 < KOOPMPC_GIVEN_LENGTH) s->row++;
#else
  koopmpc_fill(u_r, 0, NU);
  if (good) {
    koopmpc_real alpha[KOOPMPC_NA + 1], e[KOOPMPC_NZ];
    koopmpc_fill(e, 0, KOOPMPC_NZ);
    if (NW) koopmpc_add(e, koopmpc_model_E, KOOPMPC_NZ, driving, NW);
    koopmpc_target_within(s, 0, r, NW ? e : 0, alpha);
    koopmpc_copy(u_r, koopmpc_targets_u0, NU);
    koopmpc_add(u_r, koopmpc_targets_W, NU, alpha, KOOPMPC_NA);
    if (NW) koopmpc_add(u_r, koopmpc_targets_u_disturbance, NU, e, KOOPMPC_NZ);
  }
#endif
  koopmpc_fill(free_input, 0, NU);
  koopmpc_fill(pull, 0, NU);
  koopmpc_add(free_input, koopmpc_feedforward, NU, driving, NW + NR + NU);
  koopmpc_add(pull, koopmpc_K, NU, s->known, KOOPMPC_NZ);
  if (KOOPMPC_WITH_RATES) koopmpc_add(pull, koopmpc_K_rate, NU, last, NU);
  for (int i = 0; i < NU; i++) free_input[i] -= pull[i];
  if (!good || !koopmpc_usable(free_input, NU)) {
    koopmpc_fail(s, 0, applied, u, report, KOOPMPC_BAD_MEASUREMENT);
    return;
  }
  koopmpc_copy(u, free_input, NU);
  koopmpc_admit(s, u, KOOPMPC_RATES ? koopmpc_rates_low : 0, koopmpc_rates_high, last);
  for (int i = 0; i < NU; i++) clipped |= u[i] < free_input[i] || u[i] > free_input[i];
  koopmpc_copy(s->given, u, NU);
  report->status = clipped ? KOOPMPC_SATURATED : KOOPMPC_UNCONSTRAINED;
}
