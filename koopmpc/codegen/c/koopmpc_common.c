/** @file koopmpc_common.c @brief Vectors, limits of inputs, and the history of delays: what all controllers share. */
#include <math.h>

#include "koopmpc_common.h"
#include "koopmpc_limits.h"
#include "koopmpc_solver.h"

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

void koopmpc_observe(koopmpc_real *zeta, int *seen, koopmpc_real *z, const koopmpc_real *x, const koopmpc_real *u) {
#if KOOPMPC_DELAYS
  enum { PAST = KOOPMPC_NX + KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS, FIRST = KOOPMPC_NX };
  int known = 1;
  for (int i = 0; i < KOOPMPC_NX; i++) known &= isfinite(x[i]) != 0;
  if (!*seen) { /* the first measurement stands in for what was before it */
    for (int k = 0; k < KOOPMPC_DELAYS; k++) {
      koopmpc_real *past = zeta + FIRST + k * PAST;
      if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(past, u, KOOPMPC_NU);
      koopmpc_copy(past + PAST - KOOPMPC_NX, x, KOOPMPC_NX);
    }
    *seen = known;
  } else {
    for (int i = FIRST + KOOPMPC_DELAYS * PAST - 1; i >= FIRST + PAST; i--) zeta[i] = zeta[i - PAST];
    koopmpc_copy(zeta + FIRST + PAST - KOOPMPC_NX, zeta, KOOPMPC_NX);
    if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(zeta + FIRST, u, KOOPMPC_NU);
  }
  if (known || !*seen)
    koopmpc_copy(zeta, x, KOOPMPC_NX);
  else { /* a missed state is NaN in its own step; afterwards the last one that was measured stands in */
    koopmpc_fill(z, (koopmpc_real)NAN, KOOPMPC_NZ);
    return;
  }
#else
  (void)seen;
  (void)u;
  koopmpc_copy(zeta, x, KOOPMPC_NX);
#endif
  koopmpc_real size = 0;
  for (int i = 0; i < KOOPMPC_NZETA; i++) size += koopmpc_abs(zeta[i]);
  if (size < KOOPMPC_HUGE)
    koopmpc_lift(zeta, z);
  else
    koopmpc_fill(z, (koopmpc_real)NAN, KOOPMPC_NZ);
}

#if KOOPMPC_GATE
int koopmpc_refuse(koopmpc_real *memory, const koopmpc_real *y, const koopmpc_real *predicted, int *opened) {
  koopmpc_real result[KOOPMPC_GATE + 2];
  koopmpc_gate(y, predicted, memory, result);
  koopmpc_copy(memory, result + 2, KOOPMPC_GATE);
  *opened = (int)result[1];
  return result[0] > 0;
}

#if KOOPMPC_NW
static int is_beyond(const koopmpc_real *memory, const koopmpc_real *y, const koopmpc_real *predicted) {
  koopmpc_real result[KOOPMPC_GATE + 2];
  koopmpc_gate(y, predicted, memory, result);
  return result[0] > 0 || result[1] == 2;
}

/** Whether w is to be tried against the last one: it is another, and y is not near what it predicts. */
static int is_doubtful(const koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *w,
                       const koopmpc_real *predicted) {
  int differs = 0, agrees = 1; /* the memory begins with the quantiles of the misfits; NaN agrees */
  for (int i = 0; i < KOOPMPC_NW; i++) differs |= w[i] != s->used_w[i];
  for (int i = 0; i < KOOPMPC_NY; i++) agrees &= !(koopmpc_abs(y[i] - predicted[i]) > KOOPMPC_AGREES * s->gate[i]);
  return differs && !agrees && s->doubted < KOOPMPC_BRIDGED;
}
#endif

void koopmpc_choose(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u, koopmpc_real *w, koopmpc_real *z,
                    koopmpc_real *expected) {
  koopmpc_predict(s, u, w, z, expected);
#if KOOPMPC_NW
  int wild = 0;
  if (is_doubtful(s, y, w, expected)) {
    koopmpc_real without[KOOPMPC_NY], moved[KOOPMPC_NY];
    koopmpc_predict(s, u, s->used_w, z, without);
    for (int i = 0; i < KOOPMPC_NY; i++) moved[i] = koopmpc_abs(y[i]) < KOOPMPC_HUGE ? expected[i] : without[i];
    wild = is_beyond(s->gate, moved, without) && !is_beyond(s->gate, y, without);
    if (wild)
      koopmpc_copy(expected, without, KOOPMPC_NY);
    else
      koopmpc_predict(s, u, w, z, expected);
  }
  s->doubted = wild ? s->doubted + 1 : 0;
  koopmpc_copy(wild ? w : s->used_w, wild ? s->used_w : w, KOOPMPC_NW);
#else
  (void)y;
#endif
}

int koopmpc_bridge(koopmpc_real *from, int has, int *bridged, const koopmpc_real *z, const koopmpc_real *expected) {
  const int known = koopmpc_usable(z, KOOPMPC_NZ), bridges = !known && has && *bridged < KOOPMPC_BRIDGED;
  koopmpc_copy(from, bridges ? expected : z, KOOPMPC_NZ);
  *bridged = bridges ? *bridged + 1 : 0;
  return known || bridges;
}
#endif

void koopmpc_admit_within(koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high, const koopmpc_real *last,
                          const koopmpc_real *least, const koopmpc_real *most) {
  for (int i = 0; i < KOOPMPC_NU; i++) {
    if (low) u[i] = koopmpc_clip(u[i], last[i] + low[i], last[i] + high[i]);
    u[i] = koopmpc_clip(u[i], least[i], most[i]);
  }
}

void koopmpc_admit(koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high, const koopmpc_real *last) {
  koopmpc_admit_within(u, low, high, last, koopmpc_input_low, koopmpc_input_high);
}
