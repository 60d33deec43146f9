/** @file koopmpc_receding.h @brief Predictive controllers: the start of a plan, and the fallback of a failed step. */
#ifndef KOOPMPC_RECEDING_H
#define KOOPMPC_RECEDING_H

#include "koopmpc_common.h"

/** Where the parts of `known` start. */
enum {
  KOOPMPC_U_PREV = KOOPMPC_NZ,
  KOOPMPC_PREVIEW = KOOPMPC_NZ + KOOPMPC_NU * KOOPMPC_WITH_RATES,
  KOOPMPC_DRIFT = KOOPMPC_PREVIEW + KOOPMPC_N * KOOPMPC_NW,
  KOOPMPC_DRIVEN = KOOPMPC_KNOWN - KOOPMPC_PREVIEW
};

/** Forget all earlier steps. */
void koopmpc_start(koopmpc_state *s, const koopmpc_real *x0, const koopmpc_real *u_prev);

/** Write the start of the plan into `known`; z is NaN if y cannot be used. */
void koopmpc_take(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *applied, const koopmpc_rows *w);

#if KOOPMPC_ESTIMATOR == 1
/** Forget the disturbance and all misfits, but not the last state. */
void koopmpc_forget(koopmpc_state *s);
#endif

#if KOOPMPC_FIRST_ALONE
/** Write all inputs of a plan of which a step needed the first alone. */
void koopmpc_settle(const koopmpc_state *s, koopmpc_real *kept);
#endif

/** Write the fallback of a failed step; `free_input` is the unconstrained optimum, NULL if it is not known. */
void koopmpc_fail(koopmpc_state *s, const koopmpc_real *free_input, const koopmpc_real *applied, koopmpc_real *u,
                  koopmpc_report *report, koopmpc_status status);

#endif
