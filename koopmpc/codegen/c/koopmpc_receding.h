/** @file koopmpc_receding.h @brief What predictive controllers share: where a plan starts, and what a failed step does. */
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

/** Write down in `known` where the plan starts; z is NaN where y cannot be used. */
void koopmpc_take(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *applied, const koopmpc_rows *w);

/** Write what stands in for a failed step; `free_input` is the unconstrained optimum, NULL where it is not known. */
void koopmpc_fail(koopmpc_state *s, const koopmpc_real *free_input, const koopmpc_real *applied, koopmpc_real *u,
                  koopmpc_report *report, koopmpc_status status);

#endif
