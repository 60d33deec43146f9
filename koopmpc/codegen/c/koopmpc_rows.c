/**
 * @file koopmpc_rows.c
 * @brief The target of a reference row that the table lacks: its equilibrium, and what the end of the horizon costs there.
 *
 * The equilibrium is sought from that of the nearest known row, on the straight line between both rows where one go
 * does not lead to it. Around it a Riccati recursion gives the cost of a tail. Found rows are kept for later steps.
 */
#include <math.h>

#include "koopmpc_rows_tables.h"
#include "koopmpc_stages.h"

enum {
  ROW = KOOPMPC_NR,
  TAILED = KOOPMPC_GOAL - KOOPMPC_NR, /* entries of the tail's state: x, and the last input where its changes are weighed */
  HALVINGS = 40,                      /* pieces of the line between two rows, at most */
  PATIENCE = 5,                       /* times as many steps at its end, where the pieces lead nowhere else */
  RESTING = TAILED < 50 ? TAILED : 50 /* steps for which a gain that has settled must rest */
};
#define BESIDE ((koopmpc_real)0.3) /* rows are close to each other within this share of a row's size */

/** Whether a target is that of this row. */
static int is_row(const koopmpc_real *target, const koopmpc_real *row) {
  return koopmpc_same(target, row, ROW);
}

/** The squared distance of two rows by the weights of the cost. */
static koopmpc_real apart(const koopmpc_real *a, const koopmpc_real *b) {
  koopmpc_real sum = 0;
  for (int i = 0; i < ROW; i++) {
    koopmpc_real part = 0;
    for (int j = 0; j < ROW; j++) part += koopmpc_rest_weight[i * ROW + j] * (a[j] - b[j]);
    sum += part * part;
  }
  return sum;
}

/** The known target whose row is nearest; one without an equilibrium only if all are. NULL without any. Of another row
 * alone with `others`. */
static const koopmpc_real *nearest(const koopmpc_state *s, const koopmpc_real *row, int others_alone) {
  const koopmpc_real *found = 0, *others = s->made;
  koopmpc_real least = 0;
  int count = s->made_count;
#if KOOPMPC_SCHEDULED /* of w = 0 */
  others = s->still;
  count = s->has_still;
#endif
  for (int good = 1; good >= 0 && !found; good--)
    for (int i = 0; i < s->target_count + count; i++) {
      const int made = i - s->target_count;
      const koopmpc_real *each = made < 0 ? s->targets + i * KOOPMPC_TARGET : others + made * KOOPMPC_MADE_SIZE;
      const int known = each[made < 0 ? TARGET_FOUND : TARGET_M] > 0;
      const koopmpc_real far = apart(row, each);
      if (known != good || (found && !(far < least)) || (others_alone && is_row(each, row))) continue;
      least = far;
      found = each;
    }
  return found;
}

#if !KOOPMPC_SCHEDULED
int koopmpc_is_alone(const koopmpc_state *s, const koopmpc_real *row, const koopmpc_real *target) {
  const koopmpc_real nothing[ROW] = {0}, none[KOOPMPC_NW1] = {0}, *beside = nearest(s, row, 1);
  koopmpc_real at[KOOPMPC_LOCAL], size = apart(row, nothing);
  (void)none;
  koopmpc_local(target + TARGET_X, target + TARGET_U KOOPMPC_AND(none), at);
  if (apart(row, at + LOCAL_OF) <= KOOPMPC_HELD * (1 + size)) return 1;
  return beside && apart(row, beside) <= BESIDE * BESIDE * (size > 1 ? size : 1);
}
#endif

/** Walk from an equilibrium of w = 0 to that of another row, and of w, in one go or in pieces. */
static int walk(const koopmpc_real *from, const koopmpc_real *row, const koopmpc_real *w, int careful, koopmpc_real *x,
                koopmpc_real *u, koopmpc_real *active) {
  koopmpc_real none[NX], there[ROW], now[KOOPMPC_NW1], done = 0, stride = 1;
  koopmpc_fill(none, 0, NX);
  for (int tries = 0; tries < HALVINGS; tries++) {
    const koopmpc_real share = done + stride < 1 ? done + stride : 1;
    for (int i = 0; i < ROW; i++) there[i] = share < 1 ? from[i] + share * (row[i] - from[i]) : row[i];
    for (int i = 0; i < KOOPMPC_NW; i++) now[i] = share * w[i];
    if (koopmpc_near(x, u, active, there, now, none, KOOPMPC_HELD, careful)) {
      done = share;
      if (!(done < 1)) return 1;
      stride *= 2;
    } else {
      stride /= 2;
    }
  }
  return careful && koopmpc_near(x, u, active, row, w, none, KOOPMPC_HELD, PATIENCE);
}

/** du/de of an equilibrium without active limits. */
static void slope_of(const koopmpc_real *at, koopmpc_real *slope) {
  koopmpc_real H[(NX + NV) * NX], T[(NX + NV) * (ROW + NX + NV)];
  koopmpc_factors(at, H, T);
  for (int i = 0; i < NV; i++)
    for (int j = 0; j < NX; j++)
      slope[i * NX + j] =
          KOOPMPC_HOLDS ? H[(NX + i) * NX + j] * koopmpc_rest_size[NX + i] / koopmpc_rest_size[j] : 0;
}

#if KOOPMPC_SCHEDULED
/** The equilibrium of a row for w = 0: of the table, or found from the nearest one; NULL without any. */
static const koopmpc_real *still_of(koopmpc_state *s, const koopmpc_real *row) {
  const koopmpc_real *from = nearest(s, row, 0), none[KOOPMPC_NW1] = {0};
  koopmpc_real own[KOOPMPC_MADE_SIZE];
  if (!from || is_row(from, row)) return from;
  koopmpc_copy(own, from, TARGET_M);
  own[TARGET_M] = (koopmpc_real)walk(from, row, none, 0, own + TARGET_X, own + TARGET_U, own + TARGET_ACTIVE);
  koopmpc_copy(own, row, ROW);
  koopmpc_copy(s->still, own, KOOPMPC_MADE_SIZE);
  s->has_still = 1;
  return s->still;
}

int koopmpc_is_free(koopmpc_state *s, const koopmpc_real *row) {
  const koopmpc_real *still = still_of(s, row), none[KOOPMPC_NW1] = {0}, nothing[ROW] = {0};
  koopmpc_real at[KOOPMPC_LOCAL];
  if (!still) return 0;
  koopmpc_local(still + TARGET_X, still + TARGET_U KOOPMPC_AND(none), at);
  if (!(apart(row, at + LOCAL_OF) <= KOOPMPC_HELD * apart(row, nothing))) return 0; /* several may come as near */
  return !koopmpc_is_limited(still + TARGET_ACTIVE) && still[still == s->still ? TARGET_M : TARGET_FOUND] > 0;
}

/** Move the equilibrium of a row with w: from that of the last step, or of w = 0. */
static int move_on(koopmpc_state *s, const koopmpc_real *row, const koopmpc_real *w, koopmpc_real *own) {
  koopmpc_real none[NX];
  int moved = 0;
  koopmpc_fill(none, 0, NX);
  for (int i = 0; i < KOOPMPC_NW; i++) moved |= w[i] < 0 || w[i] > 0;
  if (moved && s->has_last_end && is_row(s->last_end, row) && !koopmpc_is_limited(s->last_end + TARGET_ACTIVE)) {
    koopmpc_copy(own, s->last_end, TARGET_M);
    if (koopmpc_near(own + TARGET_X, own + TARGET_U, own + TARGET_ACTIVE, row, w, none, KOOPMPC_HELD, 0) &&
        !koopmpc_is_limited(own + TARGET_ACTIVE))
      return 1;
  }
  koopmpc_copy(own, still_of(s, row), TARGET_M);
  return walk(row, row, w, 1, own + TARGET_X, own + TARGET_U, own + TARGET_ACTIVE);
}
#endif

/** Find the equilibrium of a row and keep it; NULL if there is no table to start from. */
static const koopmpc_real *make(koopmpc_state *s, const koopmpc_real *row) {
  const koopmpc_real *from = nearest(s, row, 0);
  koopmpc_real at[KOOPMPC_LOCAL], own[KOOPMPC_MADE_SIZE];
  const koopmpc_real *w = koopmpc_end_w(s);
  int found;
  if (!from) return 0;
#if KOOPMPC_SCHEDULED
  found = move_on(s, row, w, own);
#else
  koopmpc_copy(own, from, TARGET_M);
  found = walk(from, row, w, 0, own + TARGET_X, own + TARGET_U, own + TARGET_ACTIVE);
#endif
  own[TARGET_M] = (koopmpc_real)found;
  koopmpc_copy(own, row, ROW);
  for (int i = 0; i < NV; i++) {
    if (!(own[TARGET_M] > 0)) own[TARGET_U + i] = koopmpc_clip(0, koopmpc_inputs_low[i], koopmpc_inputs_high[i]);
    own[TARGET_INPUT + i] = KOOPMPC_HOLDS ? own[TARGET_U + i] : 0;
  }
  koopmpc_fill(own + TARGET_SLOPE, 0, NV * NX);
  if (own[TARGET_M] > 0 && KOOPMPC_DISTURBED) {
    koopmpc_local(own + TARGET_X, own + TARGET_U KOOPMPC_AND(w), at);
    slope_of(at, own + TARGET_SLOPE);
  }
  koopmpc_copy(s->made + s->made_next * KOOPMPC_MADE_SIZE, own, KOOPMPC_MADE_SIZE);
  from = s->made + s->made_next * KOOPMPC_MADE_SIZE;
  if (s->made_count <= s->made_next) s->made_count = s->made_next + 1;
  s->made_next = s->made_next + 1 < KOOPMPC_MADE ? s->made_next + 1 : 0;
  return from;
}

void koopmpc_weigh_row(koopmpc_real *target, const koopmpc_real *root) {
  koopmpc_fill(target + TARGET_M, 0, TARGET_FOUND - TARGET_M);
  koopmpc_copy(target + TARGET_M, root, ROW * ROW);
  koopmpc_multiply(target + TARGET_GOAL, root, target, ROW, ROW, 1, 0);
}

#if KOOPMPC_STAGE_END == 1

/** One step of the tail, x+ = A x + B u at the cost of Q and R; row after row, in the sizes of x and u. */
typedef struct {
  koopmpc_real A[TAILED * TAILED], B[TAILED * NV], Q[TAILED * TAILED], R[NV * NV];
} tail_step;

/** P of the step before, and its gain K; 0 if R + B'PB is not positive definite. */
static int before(const tail_step *t, koopmpc_real *P, koopmpc_real *K) {
  koopmpc_real BP[NV * TAILED], S[NV * NV], L[NV * NV], closed[TAILED * TAILED], PC[TAILED * TAILED];
  koopmpc_multiply(BP, t->B, P, NV, TAILED, TAILED, 1);
  koopmpc_multiply(S, BP, t->B, NV, TAILED, NV, 0);
  koopmpc_multiply(K, BP, t->A, NV, TAILED, TAILED, 0);
  for (int i = 0; i < NV; i++) {
    for (int j = 0; j < NV; j++) S[i * NV + j] += t->R[i * NV + j];
    for (int j = NX; j < TAILED; j++) K[i * TAILED + j] -= koopmpc_tail_R_delta[i * NV + j - NX];
  }
  if (!koopmpc_divide(S, L, K, NV, TAILED)) return 0;
  koopmpc_multiply(closed, t->B, K, TAILED, NV, TAILED, 0);
  for (int i = 0; i < TAILED * TAILED; i++) closed[i] = t->A[i] - closed[i];
  koopmpc_multiply(PC, P, closed, TAILED, TAILED, TAILED, 0);
  koopmpc_multiply(P, t->A, PC, TAILED, TAILED, TAILED, 1);
  for (int i = 0; i < TAILED; i++)
    for (int j = 0; j < TAILED; j++) {
      P[i * TAILED + j] += t->Q[i * TAILED + j];
      for (int m = 0; m < NV && i >= NX; m++)
        P[i * TAILED + j] += koopmpc_tail_R_delta[(i - NX) * NV + m] * K[m * TAILED + j];
    }
  for (int i = 0; i < TAILED; i++)
    for (int j = 0; j < i; j++)
      P[i * TAILED + j] = P[j * TAILED + i] = (P[i * TAILED + j] + P[j * TAILED + i]) / 2;
  return koopmpc_usable(P, TAILED * TAILED);
}

/** P of the whole tail: of KOOPMPC_TAIL_STEPS steps, or until its gain rests. */
static int sum_tail(const tail_step *t, koopmpc_real *P) {
  koopmpc_real K[NV * TAILED], last[NV * TAILED];
  int rested = 0;
  koopmpc_copy(P, t->Q, TAILED * TAILED);
  koopmpc_fill(last, 0, NV * TAILED);
  for (int i = NX; i < TAILED && KOOPMPC_TAIL_STEPS; i++) koopmpc_fill(P + i * TAILED + NX, 0, TAILED - NX);
  for (int k = 0; k < (KOOPMPC_TAIL_STEPS ? KOOPMPC_TAIL_STEPS : 10 * STEPS); k++) {
    koopmpc_real moved = 0;
    if (!before(t, P, K)) return 0;
    for (int i = 0; i < NV * TAILED; i++) moved = koopmpc_most(moved, K[i] - last[i]);
    koopmpc_copy(last, K, NV * TAILED);
    rested = moved <= KOOPMPC_RESTED * koopmpc_largest(K, NV * TAILED) ? rested + 1 : 0;
    if (!KOOPMPC_TAIL_STEPS && rested >= RESTING) break;
  }
  return 1;
}

/** S with S'S = P, by Cholesky's factor; rows of pivots that are rounding are zero. */
static void root_of(const koopmpc_real *P, koopmpc_real *S) {
  koopmpc_fill(S, 0, TAILED * TAILED);
  for (int i = 0; i < TAILED; i++) {
    koopmpc_real pivot = P[i * TAILED + i];
    for (int m = 0; m < i; m++) pivot -= S[m * TAILED + i] * S[m * TAILED + i];
    if (!(pivot > KOOPMPC_RANK * P[i * TAILED + i])) continue;
    for (int j = i; j < TAILED; j++) {
      koopmpc_real sum = P[i * TAILED + j];
      for (int m = 0; m < i; m++) sum -= S[m * TAILED + i] * S[m * TAILED + j];
      S[i * TAILED + j] = sum / KOOPMPC_SQRT(pivot);
    }
  }
}

/** Write M, L, V and the goal of a target whose equilibrium is known; 0 if the recursion fails. */
static int add_tail(koopmpc_real *target, const koopmpc_real *w) {
  koopmpc_real at[KOOPMPC_LOCAL], J[ROW * NX], QJ[ROW * NX], work[ROW * NX], back[NX * ROW], seen[NX * NX];
  koopmpc_real inverse[NX * NX], copied[NX * NX], P[TAILED * TAILED], S[TAILED * TAILED], mean = 0;
  koopmpc_real reached[ROW * ROW];
  koopmpc_real *M = target + TARGET_M, *L = target + TARGET_L, *V = target + TARGET_V;
  const koopmpc_real *size = koopmpc_rest_size, scale = KOOPMPC_SQRT((koopmpc_real)KOOPMPC_TAIL_SCALE);
  tail_step t;
  int blind;
  (void)w;
  koopmpc_local(target + TARGET_X, target + TARGET_U KOOPMPC_AND(w), at);
  for (int i = 0; i < ROW; i++)
    for (int j = 0; j < NX; j++) J[i * NX + j] = at[LOCAL_J + i * NX + j] * size[j] / koopmpc_tail_row_size[i];
  koopmpc_multiply(QJ, koopmpc_tail_Q, J, ROW, ROW, NX, 0);
  koopmpc_multiply(seen, J, QJ, NX, ROW, NX, 1);
  koopmpc_fill(t.A, 0, TAILED * TAILED);
  koopmpc_fill(t.B, 0, TAILED * NV);
  koopmpc_fill(t.Q, 0, TAILED * TAILED);
  for (int i = 0; i < NX; i++) {
    for (int j = 0; j < NX; j++) {
      t.A[i * TAILED + j] = at[LOCAL_A + i * NX + j] * size[j] / size[i];
      t.Q[i * TAILED + j] = seen[i * NX + j];
    }
    for (int j = 0; j < NV; j++) t.B[i * NV + j] = at[LOCAL_B + i * NV + j] * size[NX + j] / size[i];
  }
  koopmpc_copy(t.R, koopmpc_tail_R, NV * NV);
  for (int i = NX; i < TAILED; i++) {
    t.B[i * NV + i - NX] = 1;
    for (int j = 0; j < NV; j++) {
      t.Q[i * TAILED + NX + j] = koopmpc_tail_R_delta[(i - NX) * NV + j];
      t.R[(i - NX) * NV + j] += koopmpc_tail_R_delta[(i - NX) * NV + j];
    }
  }
  if (!sum_tail(&t, P)) return 0;
  root_of(P, S);
  koopmpc_copy(work, J, ROW * NX);
  (void)koopmpc_inverse(work, ROW, NX, KOOPMPC_PSEUDO, back, 0);
  koopmpc_copy(copied, seen, NX * NX);
  (void)koopmpc_inverse(copied, NX, NX, KOOPMPC_PSEUDO, inverse, 0);
  koopmpc_copy(copied, seen, NX * NX);
  blind = koopmpc_inverse(copied, NX, NX, KOOPMPC_TURN * NX, seen, 0);
  for (int i = 0; i < NX; i++)
    for (int j = 0; j < NX; j++) mean += P[i * TAILED + j] * inverse[i * NX + j];
  mean /= (koopmpc_real)(blind < NX ? NX - blind : 1);
  mean = KOOPMPC_SQRT(mean > 1 ? mean : 1);
  koopmpc_fill(M, 0, TARGET_FOUND - TARGET_M);
  for (int i = 0; i < TAILED; i++) {
    koopmpc_real through[ROW], shown[NX];
    koopmpc_multiply(through, S + i * TAILED, back, 1, NX, ROW, 0);
    koopmpc_multiply(shown, through, J, 1, ROW, NX, 0);
    for (int r = 0; r < ROW; r++) M[i * ROW + r] = scale * through[r] / koopmpc_tail_row_size[r];
    for (int j = 0; j < NX; j++) L[i * NX + j] = scale * (S[i * TAILED + j] - shown[j]) / size[j];
    for (int j = NX; j < TAILED; j++) V[i * NV + j - NX] = scale * S[i * TAILED + j] / size[j];
  }
  koopmpc_multiply(reached, J, back, ROW, NX, ROW, 0);
  for (int i = 0; i < ROW; i++)
    for (int r = 0; r < ROW; r++) {
      koopmpc_real sum = koopmpc_Q_root[i * ROW + r];
      for (int b = 0; b < ROW; b++)
        sum -= koopmpc_Q_root[i * ROW + b] * koopmpc_tail_row_size[b] * reached[b * ROW + r] / koopmpc_tail_row_size[r];
      M[(TAILED + i) * ROW + r] = mean * sum;
    }
  for (int i = 0; i < KOOPMPC_GOAL; i++)
    target[TARGET_GOAL + i] = koopmpc_dot(M + i * ROW, at + LOCAL_OF, ROW) +
                              koopmpc_dot(L + i * NX, target + TARGET_X, NX) +
                              koopmpc_dot(V + i * NV, target + TARGET_INPUT, NV);
  return 1;
}
#endif

const koopmpc_real *koopmpc_find_row(koopmpc_state *s, const koopmpc_real *row, int whole) {
  const koopmpc_real *found = 0;
  koopmpc_real *target = s->made_end;
  for (int k = 0; k < s->made_count && !found; k++) {
    const koopmpc_real *each = s->made + k * KOOPMPC_MADE_SIZE;
    if (is_row(each, row)) found = each;
  }
  if (whole && s->has_made_end && is_row(target, row)) return target; /* the end may outlive its row's place */
  if (!found) found = make(s, row);
  if (!found || !whole) return found;
  koopmpc_copy(target, found, TARGET_M);
  target[TARGET_FOUND] = found[TARGET_M];
  s->has_made_end = 1;
#if KOOPMPC_STAGE_END == 1
  if (found[TARGET_M] > 0 && add_tail(target, koopmpc_end_w(s))) {
    target[TARGET_FOUND] = found[TARGET_M];
    return target;
  }
#endif
  koopmpc_weigh_row(target, KOOPMPC_STAGE_END ? koopmpc_Q_root : koopmpc_tail_end);
  target[TARGET_FOUND] = found[TARGET_M];
  return target;
}
