/**
 * @file koopmpc_motion.c
 * @brief A reference that goes on as it moved: its rows beyond the preview, and the end of the plan that they ask for.
 */
#include <math.h>

#include "koopmpc_motion_tables.h"
#include "koopmpc_stages.h"

#if KOOPMPC_BEYOND
/* rows beyond the preview, rows of the preview, terms of a recurrence; rows of the end's cost, tracked outputs, [x; u] */
enum { FURTHER = KOOPMPC_BEYOND, ROWS = STEPS + 1, MOST_TERMS = KOOPMPC_MOST_TERMS };
enum { GOAL = KOOPMPC_GOAL, RN = KOOPMPC_NR, LEAST = NX + NV };

/** Whether r_k = sum c_i r_{k-n+i} has a root beyond 1 + GROWS, by the Schur-Cohn recursion. */
static int grows(const koopmpc_real *c, int n) {
  koopmpc_real a[MOST_TERMS], next[MOST_TERMS], scale = 1;
  for (int i = 0; i < n; i++) {
    scale /= 1 + KOOPMPC_GROWS;
    a[i] = -c[n - 1 - i] * scale;
  }
  for (; n > 0; n--) {
    const koopmpc_real last = a[n - 1];
    if (!(koopmpc_abs(last) < 1)) return 1;
    for (int i = 0; i < n - 1; i++) next[i] = (a[i] - last * a[n - 2 - i]) / (1 - last * last);
    koopmpc_copy(a, next, n - 1);
  }
  return 0;
}

/** Whether the last rows of column `j` are equal. */
static int stands(const koopmpc_state *s, int j) {
  const koopmpc_real end = s->reference[STEPS * RN + j];
  int rests = 1;
  for (int k = 1; k < KOOPMPC_RESTS && k < ROWS; k++) {
    const koopmpc_real value = s->reference[(STEPS - k) * RN + j];
    rests &= !(value < end || value > end);
  }
  return rests;
}

/** Write column `j` of the rows beyond the preview, and whether it drifts; 0 if it obeys no linear recurrence. */
static int extend(koopmpc_state *s, int j, int *drifts) {
  koopmpc_real z[ROWS], past[ROWS * MOST_TERMS], inverse[MOST_TERMS * ROWS], c[MOST_TERMS];
  koopmpc_real low = s->reference[j], high = low, spread;
  const koopmpc_real end = s->reference[STEPS * RN + j];
  for (int k = 0; k < ROWS; k++) {
    const koopmpc_real value = s->reference[k * RN + j];
    low = value < low ? value : low;
    high = value > high ? value : high;
  }
  spread = high - low;
  if (stands(s, j) ||
      spread <= KOOPMPC_STILL * (koopmpc_abs(low) > koopmpc_abs(high) ? koopmpc_abs(low) : koopmpc_abs(high))) {
    for (int k = 0; k < FURTHER; k++) s->beyond[k * RN + j] = end;
    return 1;
  }
  for (int k = 0; k < ROWS; k++) z[k] = (s->reference[k * RN + j] - end) / spread;
  for (unsigned which = 0; which < sizeof koopmpc_orders / sizeof koopmpc_orders[0]; which++) {
    const int order = koopmpc_orders[which], terms = order + 1, rows = ROWS - order;
    koopmpc_real most = 0, sum = 0, last[MOST_TERMS];
    int drifting;
    if (rows < order + 2) return 0;
    for (int k = 0; k < rows; k++) {
      koopmpc_copy(past + k * terms, z + k, order);
      past[k * terms + order] = 1;
    }
    (void)koopmpc_inverse(past, rows, terms, KOOPMPC_TERMS, inverse, 0);
    for (int i = 0; i < terms; i++) c[i] = koopmpc_dot(inverse + i * rows, z + order, rows);
    for (int k = 0; k < rows; k++)
      most = koopmpc_most(most, koopmpc_dot(c, z + k, order) + c[order] - z[k + order]);
    if (!(most <= KOOPMPC_FITS) || grows(c, order)) continue;
    koopmpc_copy(last, z + rows, order);
    for (int i = 0; i < order; i++) sum += c[i];
    drifting = koopmpc_abs(1 - sum) < KOOPMPC_DRIFTS;
    *drifts |= drifting;
    for (int k = 0; k < FURTHER; k++) { /* what drifts goes on for one horizon, and rests then */
      const koopmpc_real value = drifting && k >= STEPS ? last[order - 1] : koopmpc_dot(c, last, order) + c[order];
      s->beyond[k * RN + j] = end + spread * value;
      for (int i = 0; i < order - 1; i++) last[i] = last[i + 1];
      last[order - 1] = value;
    }
    return 1;
  }
  return 0;
}

/** Whether equilibria hold what the rows move through; `by` is d(x, u)/dr and J dof/dx by the sizes of x and u. */
static int can_drift(const koopmpc_state *s, const koopmpc_real *by, const koopmpc_real *J) {
  koopmpc_real d[RN], x[NX], missed[RN], off[RN], way[RN];
  for (int j = 0; j < RN; j++) d[j] = s->reference[STEPS * RN + j] - s->reference[j];
  koopmpc_multiply(x, by, d, NX, RN, 1, 0);
  koopmpc_multiply(missed, J, x, RN, NX, 1, 0);
  for (int j = 0; j < RN; j++) missed[j] -= d[j];
  koopmpc_multiply(off, koopmpc_Q_root, missed, RN, RN, 1, 0);
  koopmpc_multiply(way, koopmpc_Q_root, d, RN, RN, 1, 0);
  return koopmpc_dot(off, off, RN) <= KOOPMPC_FOLLOWS * KOOPMPC_FOLLOWS * koopmpc_dot(way, way, RN);
}

void koopmpc_move_end(koopmpc_state *s, koopmpc_real *end) {
  const koopmpc_real *last = s->reference + STEPS * RN, *sx = koopmpc_rest_size, *su = koopmpc_rest_size + NX;
  koopmpc_real at[KOOPMPC_LOCAL], *A = at + LOCAL_A, *B = at + LOCAL_B, *J = at + LOCAL_J;
  koopmpc_real S[GOAL * NX], SA[GOAL * NX], SB[GOAL * NV], R[NV * NV], inner[NV * NV], inverse[NV * NV], gain[NV * NX];
  koopmpc_real K[NV * NX], BK[NX * NX], weighed[RN * NX], push[NX * RN], held[NX * RN], back[NX * GOAL];
  koopmpc_real H[LEAST * NX], T[LEAST * (RN + LEAST)], by[LEAST * RN];
  koopmpc_real p[NX], next[NX], constant[NX], rest_input[NV], power[NX * NX], squared[NX * NX], left[RN * NX];
  int moves = 0, drifts = 0, goes_on = 1;
  for (int j = 0; j < RN; j++) moves |= !stands(s, j);
  if (!moves || !(end[TARGET_FOUND] > 0)) return;
  for (int j = 0; j < RN && goes_on; j++) goes_on = extend(s, j, &drifts);
  koopmpc_local(end + TARGET_X, end + TARGET_U KOOPMPC_AND(koopmpc_end_w(s)), at);
  koopmpc_factors(at, H, T);
  for (int i = 0; i < LEAST; i++) /* the equilibrium that comes nearest to a row, by its size */
    koopmpc_multiply(by + i * RN, T + i * (RN + LEAST), koopmpc_rest_weight, 1, RN, RN, 0);
  for (int i = 0; i < NX; i++) { /* all by the sizes of x and u */
    for (int j = 0; j < NX; j++) A[i * NX + j] *= sx[j] / sx[i];
    for (int j = 0; j < NV; j++) B[i * NV + j] *= su[j] / sx[i];
    for (int j = 0; j < RN; j++) J[j * NX + i] *= sx[i];
  }
  if (drifts && !can_drift(s, by, J)) goes_on = 0;
  koopmpc_multiply(S, end + TARGET_M, J, GOAL, RN, NX, 0);
  for (int i = 0; i < GOAL * NX; i++) S[i] += end[TARGET_L + i] * sx[i % NX];
  koopmpc_multiply(SA, S, A, GOAL, NX, NX, 0);
  koopmpc_multiply(SB, S, B, GOAL, NX, NV, 0);
  koopmpc_multiply(R, koopmpc_R_root, koopmpc_R_root, NV, NV, NV, 1);
  koopmpc_multiply(inner, SB, SB, NV, GOAL, NV, 1);
  for (int i = 0; i < NV * NV; i++) {
    R[i] *= su[i / NV] * su[i % NV];
    inner[i] += R[i];
  }
  (void)koopmpc_inverse(inner, NV, NV, KOOPMPC_FLAT, inverse, 0);
  koopmpc_multiply(gain, SB, SA, NV, GOAL, NX, 1);
  koopmpc_multiply(K, inverse, gain, NV, NV, NX, 0);
  koopmpc_multiply(BK, B, K, NX, NV, NX, 0);
  for (int i = 0; i < NX * NX; i++) A[i] -= BK[i];
  koopmpc_multiply(gain, R, K, NV, NV, NX, 0);
  koopmpc_multiply(weighed, koopmpc_Q_root, J, RN, RN, NX, 0);
  koopmpc_multiply(push, weighed, koopmpc_Q_root, NX, RN, RN, 1);
  koopmpc_multiply(held, gain, by + NX * RN, NX, NV, RN, 1);
  for (int i = 0; i < NV; i++) rest_input[i] = KOOPMPC_HOLDS ? 0 : end[TARGET_U + i] / su[i];
  koopmpc_multiply(constant, gain, rest_input, NX, NV, 1, 1);
  for (int i = 0; i < NX * RN && KOOPMPC_HOLDS; i++) push[i] -= held[i];
  koopmpc_copy(power, A, NX * NX);
  for (int k = 1; k < KOOPMPC_REST_STEPS; k *= 2) { /* (A - B K) to the power REST_STEPS */
    koopmpc_multiply(squared, power, power, NX, NX, NX, 0);
    koopmpc_copy(power, squared, NX * NX);
  }
  koopmpc_fill(p, 0, NX);
  for (int k = FURTHER; k >= 0 && goes_on; k--) { /* p = push (r - of) + constant + (A - B K)' p */
    koopmpc_multiply(next, A, p, NX, NX, 1, 1);
    for (int i = 0; i < NX; i++) {
      const koopmpc_real *row = k ? s->beyond + (k - 1) * RN : last;
      next[i] += constant[i];
      for (int j = 0; j < RN; j++) next[i] += push[i * RN + j] * (row[j] - at[LOCAL_OF + j]);
    }
    koopmpc_copy(p, next, NX);
  }
  koopmpc_multiply(left, weighed, power, RN, NX, NX, 0);
  int rests = koopmpc_usable(p, NX);
  for (int j = 0; j < RN * NX; j += NX)
    rests &= koopmpc_dot(left + j, left + j, NX) <= KOOPMPC_LEFT * KOOPMPC_LEFT * koopmpc_dot(weighed + j, weighed + j, NX);
  if (!rests) {
    koopmpc_weigh_row(end, koopmpc_Q_root); /* errors of a tracked output do not come to rest: no tail */
    return;
  }
  if (!goes_on) { /* the last row takes the place of what the equilibrium gives */
    for (int i = 0; i < GOAL; i++)
      for (int j = 0; j < RN; j++) end[TARGET_GOAL + i] += end[TARGET_M + i * RN + j] * (last[j] - at[LOCAL_OF + j]);
    return;
  }
  (void)koopmpc_inverse(S, GOAL, NX, KOOPMPC_SEEN, back, 0);
  for (int i = 0; i < GOAL; i++)
    for (int j = 0; j < NX; j++) end[TARGET_GOAL + i] += back[j * GOAL + i] * p[j];
}
#endif
