/** @file koopmpc_common.h @brief Vectors, limits of inputs, and the history of delays: what all controllers share. */
#ifndef KOOPMPC_COMMON_H
#define KOOPMPC_COMMON_H

#include "koopmpc.h"

#define KOOPMPC_HUGE ((koopmpc_real)1e30)

static inline koopmpc_real koopmpc_abs(koopmpc_real a) { return a < 0 ? -a : a; }

/** Whether all entries are numbers below 1e30 in size. */
static inline int koopmpc_usable(const koopmpc_real *a, int n) {
  int good = 1;
  for (int i = 0; i < n; i++) good &= koopmpc_abs(a[i]) < KOOPMPC_HUGE;
  return good;
}

static inline koopmpc_real koopmpc_dot(const koopmpc_real *a, const koopmpc_real *b, int n) {
  koopmpc_real sum = 0;
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

static inline void koopmpc_copy(koopmpc_real *to, const koopmpc_real *from, int n) {
  for (int i = 0; i < n; i++) to[i] = from[i];
}

static inline void koopmpc_fill(koopmpc_real *to, koopmpc_real value, int n) {
  for (int i = 0; i < n; i++) to[i] = value;
}

static inline koopmpc_real koopmpc_clip(koopmpc_real a, koopmpc_real low, koopmpc_real high) {
  a = a < low ? low : a;
  return a > high ? high : a;
}

/** Row k of a preview, the last one repeated. */
static inline const koopmpc_real *koopmpc_row(const koopmpc_rows *rows, int k, int width) {
  return rows->values + width * (k < rows->count ? k : rows->count - 1);
}

/** to += map x for a matrix (rows, columns) that is stored column after column. */
void koopmpc_add(koopmpc_real *to, const koopmpc_real *map, int rows, const koopmpc_real *x, int columns);

/** Move zeta = [x_k, u_{k-1}, x_{k-1}, ...] on by a step that led to x under u, and write z = psi(zeta). */
void koopmpc_observe(koopmpc_real *zeta, int *seen, koopmpc_real *z, const koopmpc_real *x, const koopmpc_real *u);

#if KOOPMPC_GATE
/** [whether y is refused; whether readings are used again; the new memory]. */
void koopmpc_gate(const koopmpc_real *y, const koopmpc_real *predicted, const koopmpc_real *memory,
                  koopmpc_real *result);

/** Whether y is too far from its prediction to be used; NaN in `predicted` is no prediction. */
int koopmpc_refuse(koopmpc_real *memory, const koopmpc_real *y, const koopmpc_real *predicted, int *opened);

/** The z that u and w lead to by the controller's model, and the reading that it shows. */
void koopmpc_predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected);

/** What u and w predict; where y denies that, with the last w that was used, which `w` is then: w was wild. */
void koopmpc_choose(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u, koopmpc_real *w, koopmpc_real *z,
                    koopmpc_real *expected);

/** from <- z, from which the next reading is predicted; for some missed readings its prediction. Return whether it is. */
int koopmpc_bridge(koopmpc_real *from, int has, int *bridged, const koopmpc_real *z, const koopmpc_real *expected);
#endif

/** Coordinates of the target nearest to r, without limits; disturbances add e to z, NULL for none. */
void koopmpc_nearest(const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha);

/** Coordinates of the nearest target inside the limits; 1 if a limit moved it. */
int koopmpc_target(koopmpc_state *s, const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha);

/** The same inside the limits `least` and `most` of KOOPMPC_NL values. */
int koopmpc_target_within(koopmpc_state *s, const koopmpc_real *r, const koopmpc_real *e, const koopmpc_real *least,
                          const koopmpc_real *most, koopmpc_real *alpha);

/** Clip the change of u since `last` to (low, high), unless `low` is NULL; then clip u to `least` and `most`. */
void koopmpc_admit_within(koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high, const koopmpc_real *last,
                          const koopmpc_real *least, const koopmpc_real *most);

/** Clip the change of u since `last` to (low, high), unless `low` is NULL; then clip u to its limits. */
void koopmpc_admit(koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high, const koopmpc_real *last);

#endif
