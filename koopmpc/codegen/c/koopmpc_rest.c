/**
 * @file koopmpc_rest.c
 * @brief The equilibrium x = F(x, u) + e that holds a reference or comes nearest to it, by Gauss-Newton steps.
 *
 * The equilibria of the undisturbed rows stand in the table. A disturbance moves one: by a step with the factors of an
 * earlier one (a chord), or by steps that hold the active limits. Where these lead to none, that of the table stays.
 */
#include <math.h>

#include "koopmpc_rest_tables.h"
#include "koopmpc_stages.h"

enum {
  BOX = KOOPMPC_BOX,
  ROWS_R = KOOPMPC_NR,
  SIZE = NX + NV,
  LEFT = ROWS_R + SIZE,
  LIMITS = NV + BOX,
  MOST_ROWS = LEFT > NX + LIMITS ? LEFT : NX + LIMITS,
  NEWTON = 20,
  SHORTENED = 40,
  WIDEST = SIZE > KOOPMPC_MOST_TERMS ? SIZE : KOOPMPC_MOST_TERMS /* the recurrence of a reference has so many */
};
#define RANK ((koopmpc_real)KOOPMPC_RANK)
#define CLOSE ((koopmpc_real)1e-2)
#define BENT ((koopmpc_real)0.25) /* where the cost bends by this share beyond its Gauss-Newton part, steps are shorter */
#define AWAY ((koopmpc_real)2)
#define LEAST_LENGTH ((koopmpc_real)0.05)

/** Turn two columns of n numbers. */
static void turn(koopmpc_real *left, koopmpc_real *right, koopmpc_real cosine, koopmpc_real sine, int n) {
  for (int i = 0; i < n; i++) {
    const koopmpc_real a = left[i], b = right[i];
    left[i] = cosine * a - sine * b;
    right[i] = sine * a + cosine * b;
  }
}

int koopmpc_inverse(koopmpc_real *E, int m, int n, koopmpc_real rank, koopmpc_real *result, koopmpc_real *null) {
  koopmpc_real V[WIDEST * WIDEST], size[WIDEST], largest = 0, nothing = 0;
  int count = 0;
  for (int j = 0; j < n; j++) /* columns one after the other, so that a compiler vectorises what runs along them */
    for (int i = 0; i < m; i++) result[j * m + i] = E[i * n + j];
  koopmpc_copy(E, result, m * n);
  for (int i = 0; i < n * n; i++) V[i] = i % (n + 1) == 0 ? 1 : 0;
  for (int j = 0; j < n; j++) {
    size[j] = koopmpc_dot(E + j * m, E + j * m, m);
    nothing += 16 * KOOPMPC_TURN * KOOPMPC_TURN * size[j];
  }
  for (int sweep = 0, turned = 1; sweep < 40 && turned; sweep++) {
    turned = 0;
    for (int p = 0; p < n; p++)
      for (int q = p + 1; q < n; q++) {
        koopmpc_real *left = E + p * m, *right = E + q * m, zeta, t, cosine, sine;
        const koopmpc_real c = koopmpc_dot(left, right, m);
        if (!(size[p] > nothing && size[q] > nothing)) continue; /* a column of rounding would turn on and on */
        if (!(koopmpc_abs(c) > 0) || !(koopmpc_abs(c) > KOOPMPC_TURN * KOOPMPC_SQRT(size[p] * size[q]))) continue;
        turned = 1;
        zeta = (size[q] - size[p]) / (2 * c);
        t = (zeta < 0 ? -1 : 1) / (koopmpc_abs(zeta) + KOOPMPC_SQRT(1 + zeta * zeta));
        cosine = 1 / KOOPMPC_SQRT(1 + t * t);
        sine = cosine * t;
        turn(left, right, cosine, sine, m);
        turn(V + p * n, V + q * n, cosine, sine, n);
        size[p] = koopmpc_dot(left, left, m);
        size[q] = koopmpc_dot(right, right, m);
      }
  }
  for (int j = 0; j < n; j++)
    if (size[j] > largest) largest = size[j];
  koopmpc_fill(result, 0, n * m);
  for (int j = 0; j < n; j++) {
    if (size[j] > rank * rank * largest && size[j] > 0) {
      for (int i = 0; i < n; i++) {
        const koopmpc_real share = V[j * n + i] / size[j];
        for (int k = 0; k < m; k++) result[i * m + k] += share * E[j * m + k];
      }
    } else {
      for (int i = 0; i < n && null; i++) null[i * n + count] = V[j * n + i];
      count++;
    }
  }
  return count;
}

/** Rows of the residuals on (x, u) by sizes: of(x) first, then (x, u) with a small weight. */
static void residuals(const koopmpc_real *at, koopmpc_real *W) {
  koopmpc_fill(W, 0, LEFT * SIZE);
  for (int i = 0; i < ROWS_R; i++)
    for (int m = 0; m < ROWS_R; m++)
      for (int j = 0; j < NX; j++)
        W[i * SIZE + j] += koopmpc_rest_weight[i * ROWS_R + m] * at[LOCAL_J + m * NX + j] * koopmpc_rest_size[j];
  for (int i = 0; i < SIZE; i++) W[(ROWS_R + i) * SIZE + i] = KOOPMPC_SMALL;
}

/** Rows A - I, B by sizes: the conditions of an equilibrium. */
static void holding(const koopmpc_real *at, koopmpc_real *E) {
  for (int i = 0; i < NX; i++)
    for (int j = 0; j < SIZE; j++) {
      const koopmpc_real value = j < NX ? at[LOCAL_A + i * NX + j] - (i == j) : at[LOCAL_B + i * NV + j - NX];
      E[i * SIZE + j] = value * koopmpc_rest_size[j] / koopmpc_rest_size[i];
    }
}

/** The residuals at s. */
static void residual(const koopmpc_real *row, const koopmpc_real *of, const koopmpc_real *s, koopmpc_real *left) {
  for (int i = 0; i < ROWS_R; i++) {
    left[i] = 0;
    for (int j = 0; j < ROWS_R; j++) left[i] += koopmpc_rest_weight[i * ROWS_R + j] * (row[j] - of[j]);
  }
  for (int i = 0; i < SIZE; i++) left[ROWS_R + i] = -KOOPMPC_SMALL * s[i];
}

/** to = least |W (free to') - left|, to = free to': (SIZE) from left (LEFT); `back` (SIZE, LEFT) is that map. */
static void least(const koopmpc_real *W, const koopmpc_real *null, int count, koopmpc_real *back) {
  koopmpc_real turned[LEFT * SIZE], inverted[SIZE * LEFT];
  const koopmpc_real rounding = RANK * koopmpc_largest(W, LEFT * SIZE); /* else the residual of the outputs would move inputs along rounding */
  for (int i = 0; i < LEFT; i++)
    for (int j = 0; j < count; j++) {
      turned[i * count + j] = 0;
      for (int m = 0; m < SIZE; m++) turned[i * count + j] += W[i * SIZE + m] * null[m * SIZE + j];
      if (i < ROWS_R && koopmpc_abs(turned[i * count + j]) < rounding) turned[i * count + j] = 0;
    }
  koopmpc_fill(back, 0, SIZE * LEFT);
  if (!count) return;
  (void)koopmpc_inverse(turned, LEFT, count, KOOPMPC_TURN, inverted, 0);
  for (int i = 0; i < SIZE; i++)
    for (int j = 0; j < count; j++)
      for (int m = 0; m < LEFT; m++) back[i * LEFT + m] += null[i * SIZE + j] * inverted[j * LEFT + m];
}

/** (x, u) in their sizes. */
static void scaled(const koopmpc_real *x, const koopmpc_real *u, koopmpc_real *s) {
  for (int i = 0; i < SIZE; i++) s[i] = (i < NX ? x[i] : u[i - NX]) / koopmpc_rest_size[i];
}

int koopmpc_is_limited(const koopmpc_real *active) {
  int limited = 0;
  for (int i = 0; i < LIMITS; i++) limited |= active[i] < 0 || active[i] > 0;
  return limited;
}

void koopmpc_factors(const koopmpc_real *at, koopmpc_real *H, koopmpc_real *T) {
  koopmpc_real E[MOST_ROWS * SIZE], gain[SIZE * MOST_ROWS], null[SIZE * SIZE], W[LEFT * SIZE], through[LEFT * NX];
  int count;
  holding(at, E);
  count = koopmpc_inverse(E, NX, SIZE, RANK, gain, null);
  residuals(at, W);
  least(W, null, count, T);
  koopmpc_multiply(through, W, gain, LEFT, SIZE, NX, 0);
  koopmpc_multiply(H, T, through, SIZE, LEFT, NX, 0);
  for (int i = 0; i < SIZE * NX; i++) H[i] -= gain[i];
}

#if KOOPMPC_DISTURBED
/** One step with the factors of an earlier equilibrium close by; 0 if the step leads far. */
static int chord(koopmpc_state *k, koopmpc_real *x, koopmpc_real *u, const koopmpc_real *row, const koopmpc_real *e) {
  koopmpc_real s[SIZE], at[KOOPMPC_LOCAL], left[LEFT], step[SIZE], missed[NX], close, far = 0;
  scaled(x, u, s);
  close = CLOSE * (1 + koopmpc_largest(s, SIZE));
  koopmpc_local(x, u KOOPMPC_AND(koopmpc_end_w(k)), at);
  for (int i = 0; i < SIZE; i++) far = koopmpc_most(far, s[i] - k->chord_s[i]);
  if (!k->has_chord || far > close) {
    koopmpc_factors(at, k->chord_H, k->chord_T);
    koopmpc_copy(k->chord_G, at + LOCAL_DG, BOX * NX);
    koopmpc_copy(k->chord_s, s, SIZE);
    k->has_chord = 1;
  }
  residual(row, at + LOCAL_OF, s, left);
  for (int i = 0; i < NX; i++) missed[i] = (at[i] + e[i] - x[i]) / koopmpc_rest_size[i];
  for (int i = 0; i < SIZE; i++)
    step[i] = koopmpc_dot(k->chord_H + i * NX, missed, NX) + koopmpc_dot(k->chord_T + i * LEFT, left, LEFT);
  if (!(koopmpc_largest(step, SIZE) <= close)) return 0;
  for (int i = 0; i < LIMITS; i++) {
    koopmpc_real reached;
    if (i < NV) {
      reached = u[i] + step[NX + i] * koopmpc_rest_size[NX + i];
    } else {
      reached = at[LOCAL_G + i - NV];
      for (int j = 0; j < NX; j++) reached += k->chord_G[(i - NV) * NX + j] * step[j] * koopmpc_rest_size[j];
    }
    if (reached > koopmpc_rest_high[i] || reached < koopmpc_rest_low[i]) return 0;
  }
  for (int i = 0; i < NX; i++) x[i] = (s[i] + step[i]) * koopmpc_rest_size[i];
  for (int i = 0; i < NV; i++) u[i] = (s[NX + i] + step[NX + i]) * koopmpc_rest_size[NX + i];
  return 1;
}

#endif

/** The length of a Gauss-Newton step by Barzilai and Borwein (1988): below 1 where the cost bent more along the last one. */
static koopmpc_real length_of(const koopmpc_real *taken, const koopmpc_real *last, const koopmpc_real *now) {
  koopmpc_real bend = 0;
  const koopmpc_real size = koopmpc_dot(taken, taken, SIZE);
  for (int i = 0; i < SIZE; i++) bend += taken[i] * (last[i] - now[i]);
  if (!(bend > (1 + BENT) * size)) return 1;
  return size / bend > LEAST_LENGTH ? size / bend : LEAST_LENGTH;
}

/**
 * The limit that a step breaks first, i + 1 if an upper and -i - 1 if a lower one, and the share of the step up to it; 0
 * without one. If not `careful`, or where values are outside already, the one that is broken most, and the whole step.
 */
static int find_hit(const koopmpc_real *value, const koopmpc_real *rows, const koopmpc_real *step,
                    const koopmpc_real *held, int careful, koopmpc_real *length) {
  koopmpc_real worst = 0, least = KOOPMPC_HUGE;
  int first = 0, farthest = 0, outside = !careful;
  for (int i = 0; i < LIMITS; i++) {
    const koopmpc_real moved = koopmpc_dot(rows + i * SIZE, step, SIZE);
    const koopmpc_real high = koopmpc_rest_high[i] / koopmpc_rest_limit_size[i], low = koopmpc_rest_low[i] / koopmpc_rest_limit_size[i];
    const koopmpc_real over = value[i] + moved - high, under = low - value[i] - moved;
    const koopmpc_real rounding = KOOPMPC_REACH * (1 + koopmpc_abs(value[i]));
    const koopmpc_real past = (over > under ? over : under) - rounding;
    const koopmpc_real room = over > under ? high - value[i] : value[i] - low;
    const koopmpc_real share = (room > 0 ? room : 0) / koopmpc_abs(moved);
    if (held[i] > 0 || held[i] < 0 || !(past > 0)) continue;
    outside |= room < -rounding;
    if (past > worst) {
      worst = past;
      farthest = over > under ? i + 1 : -i - 1;
    }
    if (!(share < least)) continue;
    least = share;
    first = over > under ? i + 1 : -i - 1;
  }
  if (first && !outside) *length = least;
  return outside ? farthest : first;
}

int koopmpc_near(koopmpc_real *x, koopmpc_real *u, koopmpc_real *active, const koopmpc_real *row, const koopmpc_real *w,
                 const koopmpc_real *e, koopmpc_real enough, int careful) {
  koopmpc_real s[SIZE], held_now[LIMITS], taken[SIZE], last[SIZE];
  int going = 0; /* whether `taken` and `last` are those of the last step, with the same limits */
  (void)w;
  scaled(x, u, s);
  koopmpc_copy(held_now, active, LIMITS);
  for (int pass = 0; pass < (careful ? careful * SHORTENED : NEWTON); pass++) {
    koopmpc_real at[KOOPMPC_LOCAL], E[MOST_ROWS * SIZE], kept[MOST_ROWS * SIZE], gain[SIZE * MOST_ROWS], null[SIZE * SIZE];
    koopmpc_real W[LEFT * SIZE], back[SIZE * LEFT], left[LEFT], missed[MOST_ROWS], step[SIZE], rows[LIMITS * SIZE];
    koopmpc_real value[LIMITS], here[NX], input[NV], reach, pull[LEFT], turned[SIZE], least_pull = 0;
    koopmpc_real most_pull = 0, off = 0, along[SIZE], whole[SIZE], length, close = enough;
    koopmpc_real pulls[LIMITS];
    int held[LIMITS], n = 0, count, release = -1;
    for (int i = 0; i < NX; i++) here[i] = s[i] * koopmpc_rest_size[i];
    for (int i = 0; i < NV; i++) input[i] = s[NX + i] * koopmpc_rest_size[NX + i];
    koopmpc_local(here, input KOOPMPC_AND(w), at);
    koopmpc_fill(rows, 0, LIMITS * SIZE);
    for (int i = 0; i < LIMITS; i++) {
      if (i < NV) {
        rows[i * SIZE + NX + i] = 1;
        value[i] = input[i] / koopmpc_rest_limit_size[i];
      } else {
        value[i] = at[LOCAL_G + i - NV] / koopmpc_rest_limit_size[i];
        for (int j = 0; j < NX; j++)
          rows[i * SIZE + j] = at[LOCAL_DG + (i - NV) * NX + j] * koopmpc_rest_size[j] / koopmpc_rest_limit_size[i];
      }
      if (held_now[i] > 0 || held_now[i] < 0) held[n++] = i;
    }
    holding(at, E);
    for (int i = 0; i < NX; i++) missed[i] = (at[i] + e[i] - here[i]) / koopmpc_rest_size[i];
    for (int i = 0; i < n; i++) {
      const koopmpc_real end = held_now[held[i]] > 0 ? koopmpc_rest_high[held[i]] : koopmpc_rest_low[held[i]];
      koopmpc_copy(E + (NX + i) * SIZE, rows + held[i] * SIZE, SIZE);
      missed[NX + i] = value[held[i]] - end / koopmpc_rest_limit_size[held[i]];
    }
    koopmpc_copy(kept, E, (NX + n) * SIZE);
    count = koopmpc_inverse(E, NX + n, SIZE, RANK, gain, null);
    residuals(at, W);
    residual(row, at + LOCAL_OF, s, left);
    for (int i = 0; i < SIZE; i++) step[i] = -koopmpc_dot(gain + i * (NX + n), missed, NX + n);
    least(W, null, count, back);
    for (int i = 0; i < LEFT; i++) pull[i] = left[i] - koopmpc_dot(W + i * SIZE, step, SIZE);
    for (int i = 0; i < SIZE; i++) {
      along[i] = koopmpc_dot(back + i * LEFT, pull, LEFT);
      whole[i] = step[i] + along[i];
    }
    length = careful && going ? length_of(taken, last, along) : 1;
    going = 1;
    for (int i = 0; i < SIZE; i++) {
      taken[i] = length * along[i];
      last[i] = along[i];
      step[i] += taken[i];
    }
    if (!koopmpc_usable(step, SIZE)) return 0;
    reach = 1 + koopmpc_largest(s, SIZE);
    for (int i = 0; i < LEFT; i++) pull[i] = left[i] - koopmpc_dot(W + i * SIZE, step, SIZE);
    for (int j = 0; j < SIZE; j++) {
      turned[j] = 0;
      for (int i = 0; i < LEFT; i++) turned[j] += W[i * SIZE + j] * pull[i];
    }
    for (int i = 0; i < n; i++) { /* a limit that holds has a positive multiplier */
      koopmpc_real multiplier = 0;
      for (int j = 0; j < SIZE; j++) multiplier += gain[j * (NX + n) + NX + i] * turned[j];
      multiplier *= held_now[held[i]];
      pulls[i] = multiplier;
      most_pull = koopmpc_most(most_pull, multiplier);
      if (multiplier < least_pull) {
        least_pull = multiplier;
        release = held[i];
      }
    }
    if (least_pull < -KOOPMPC_REACH * most_pull) {
      held_now[release] = 0;
      going = 0;
    } else {
      koopmpc_real share = 1;
      const int hit = find_hit(value, rows, step, held_now, careful, &share);
      if (hit && careful && !count) { /* a corner: for the new limit another one gives way */
        const koopmpc_real *row = rows + (hit > 0 ? hit - 1 : -1 - hit) * SIZE;
        koopmpc_real least_share = KOOPMPC_HUGE;
        for (int i = 0; i < n; i++) {
          koopmpc_real push = 0, needed;
          for (int j = 0; j < SIZE; j++) push += gain[j * (NX + n) + NX + i] * row[j];
          push *= hit > 0 ? held_now[held[i]] : -held_now[held[i]];
          if (!(push > RANK)) continue;
          needed = (pulls[i] > 0 ? pulls[i] : 0) / push;
          if (!(needed < least_share)) continue;
          least_share = needed;
          release = held[i];
        }
        if (!(least_share < KOOPMPC_HUGE)) return 0;
        held_now[release] = 0;
      }
      if (hit) {
        held_now[hit > 0 ? hit - 1 : -1 - hit] = hit > 0 ? 1 : -1;
        going = 0;
        for (int i = 0; i < SIZE; i++) step[i] *= share;
      }
    }
    for (int i = 0; i < SIZE; i++) s[i] += step[i];
    if (length < 1 || length > 1) close = KOOPMPC_HELD; /* steps that swing leave more than their square */
    if (going && koopmpc_largest(whole, SIZE) <= close * reach) {
      for (int i = 0; i < NX + n; i++)
        off = koopmpc_most(off, koopmpc_dot(kept + i * SIZE, step, SIZE) + missed[i]);
      if (!(off <= KOOPMPC_HELD * reach)) return 0;
      for (int i = 0; i < NX; i++) x[i] = s[i] * koopmpc_rest_size[i];
      for (int i = 0; i < NV; i++)
        u[i] = koopmpc_clip(s[NX + i] * koopmpc_rest_size[NX + i], koopmpc_inputs_low[i], koopmpc_inputs_high[i]);
      koopmpc_copy(active, held_now, LIMITS);
      return 1;
    }
  }
  return 0;
}

#if KOOPMPC_DISTURBED
/** Whether an equilibrium at limits is several sizes of the state from that of the row, which meets them. */
static int is_far(const koopmpc_real *x, const koopmpc_real *active, const koopmpc_real *target) {
  koopmpc_real away = 0;
  for (int i = 0; i < NX; i++) away = koopmpc_most(away, (x[i] - target[TARGET_X + i]) / koopmpc_rest_size[i]);
  return koopmpc_is_limited(active) && !koopmpc_is_limited(target + TARGET_ACTIVE) && away > AWAY;
}

void koopmpc_rest(koopmpc_state *s, const koopmpc_real *target, const koopmpc_real *e) {
  koopmpc_real x[NX], u[NV], active[LIMITS], at[KOOPMPC_LOCAL];
  int found;
  koopmpc_copy(x, s->has_rest ? s->rest : target + TARGET_X, NX);
  koopmpc_copy(u, s->has_rest ? s->rest_u : target + TARGET_U, NV);
  koopmpc_copy(active, s->has_rest ? s->rest_active : target + TARGET_ACTIVE, LIMITS);
  found = (!koopmpc_is_limited(active) && chord(s, x, u, target, e)) ||
          koopmpc_near(x, u, active, target, koopmpc_end_w(s), e, CLOSE, 0);
  if (!(target[TARGET_FOUND] > 0) || is_far(x, active, target)) found = 0;
  if (!found) {
    koopmpc_copy(x, target + TARGET_X, NX);
    koopmpc_copy(u, target + TARGET_U, NV);
    koopmpc_copy(active, target + TARGET_ACTIVE, LIMITS);
  }
  s->has_rest = 1;
  koopmpc_copy(s->rest, x, NX);
  koopmpc_copy(s->rest_u, u, NV);
  koopmpc_copy(s->rest_active, active, LIMITS);
  koopmpc_copy(s->rest_goal, target + TARGET_GOAL, KOOPMPC_GOAL);
  koopmpc_copy(s->rest_input, target + TARGET_INPUT, NV);
  if (!found) return;
  for (int i = 0; i < NV; i++) s->rest_input[i] = KOOPMPC_HOLDS ? u[i] : 0;
  if (KOOPMPC_STAGE_END) {
    koopmpc_local(x, u KOOPMPC_AND(koopmpc_end_w(s)), at);
    for (int i = 0; i < KOOPMPC_GOAL; i++)
      s->rest_goal[i] = koopmpc_dot(target + TARGET_M + i * KOOPMPC_NR, at + LOCAL_OF, KOOPMPC_NR) +
                        koopmpc_dot(target + TARGET_L + i * NX, x, NX) +
                        koopmpc_dot(target + TARGET_V + i * NV, s->rest_input, NV);
  }
}
#endif
