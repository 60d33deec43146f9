/**
 * @file koopmpc_observe.c
 * @brief Where a plan starts: the past of a model, the estimates of its state and of a disturbance, wild readings.
 */
#include <math.h>

#include "koopmpc_observe_tables.h"
#include "koopmpc_step.h"

/** Move zeta = [x_k, u_{k-1}, x_{k-1}, ...] on by a step that led to x under u, and write z = psi(zeta). */
static void remember(koopmpc_state *s, const koopmpc_real *x, const koopmpc_real *u) {
  koopmpc_real *zeta = s->zeta, size = 0;
#if KOOPMPC_DELAYS
  enum { PAST = KOOPMPC_NX + KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS, FIRST = KOOPMPC_NX };
  int known = 1;
  for (int i = 0; i < KOOPMPC_NX; i++) known &= isfinite(x[i]) != 0;
  if (!s->seen) { /* the first measurement stands in for what was before it */
    for (int k = 0; k < KOOPMPC_DELAYS; k++) {
      koopmpc_real *past = zeta + FIRST + k * PAST;
      if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(past, u, KOOPMPC_NU);
      koopmpc_copy(past + PAST - KOOPMPC_NX, x, KOOPMPC_NX);
    }
    s->seen = known;
  } else {
    for (int i = FIRST + KOOPMPC_DELAYS * PAST - 1; i >= FIRST + PAST; i--) zeta[i] = zeta[i - PAST];
    koopmpc_copy(zeta + FIRST + PAST - KOOPMPC_NX, zeta, KOOPMPC_NX);
    if (KOOPMPC_DELAYED_INPUTS) koopmpc_copy(zeta + FIRST, u, KOOPMPC_NU);
  }
  if (known || !s->seen)
    koopmpc_copy(zeta, x, KOOPMPC_NX);
  else { /* a missed state is NaN in its own step; afterwards the last one that was measured stands in */
    koopmpc_fill(s->z, (koopmpc_real)NAN, KOOPMPC_NZ);
    return;
  }
#else
  (void)u;
  koopmpc_copy(zeta, x, KOOPMPC_NX);
#endif
  for (int i = 0; i < KOOPMPC_NZETA; i++) size += koopmpc_abs(zeta[i]);
  if (size < KOOPMPC_HUGE)
    koopmpc_lift(zeta, s->z);
  else
    koopmpc_fill(s->z, (koopmpc_real)NAN, KOOPMPC_NZ);
}

#if KOOPMPC_ESTIMATOR == 1 || KOOPMPC_LATENCY > 0 || (KOOPMPC_ESTIMATOR == 0 && KOOPMPC_GATE)
/** z <- F(z, u) + E w + d; d may be NULL. */
static void advance(koopmpc_real *next, const koopmpc_real *z, const koopmpc_real *u, const koopmpc_real *w,
                    const koopmpc_real *d) {
#if KOOPMPC_IS_STAGED
  koopmpc_map(z, u KOOPMPC_AND(w), next);
  if (KOOPMPC_NW) koopmpc_add(next, koopmpc_E, KOOPMPC_NZ, w, KOOPMPC_NW);
#else
  koopmpc_fill(next, 0, KOOPMPC_NZ);
  koopmpc_add(next, koopmpc_model_A, KOOPMPC_NZ, z, KOOPMPC_NZ);
  koopmpc_add(next, koopmpc_model_B, KOOPMPC_NZ, u, KOOPMPC_NU);
  if (KOOPMPC_NW) koopmpc_add(next, koopmpc_model_E, KOOPMPC_NZ, w, KOOPMPC_NW);
#endif
  if (d)
    for (int i = 0; i < KOOPMPC_NZ; i++) next[i] += d[i];
}
#endif

#if KOOPMPC_GATE && KOOPMPC_ESTIMATOR < 2
/** The states of z. */
static void show(const koopmpc_real *z, koopmpc_real *states) {
#if KOOPMPC_IS_STAGED
  koopmpc_copy(states, z, KOOPMPC_NX);
#else
  koopmpc_fill(states, 0, KOOPMPC_NX);
  koopmpc_add(states, koopmpc_model_C, KOOPMPC_NX, z, KOOPMPC_NZ);
#endif
}

/** The z that u and w lead to by the model, and the reading that it shows: with d, which z is without. */
static void predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                    koopmpc_real *expected) {
  advance(z, s->from, u, w, 0);
  for (int i = 0; i < KOOPMPC_NZ; i++) s->scratch[i] = z[i] + s->d[i];
  show(s->scratch, expected);
}
#endif

#if KOOPMPC_ESTIMATOR == 2
enum { FILTERED = KOOPMPC_ESTIMATOR_F_LENGTH, DRIVE = KOOPMPC_NU + KOOPMPC_NW };

/** s <- F s + G [u; w] + f. */
static void move(koopmpc_state *s, koopmpc_real *state, const koopmpc_real *drive) {
  koopmpc_copy(s->scratch, koopmpc_estimator_f, FILTERED);
  koopmpc_add(s->scratch, koopmpc_estimator_F, FILTERED, state, FILTERED);
  koopmpc_add(s->scratch, koopmpc_estimator_G, FILTERED, drive, DRIVE);
  koopmpc_copy(state, s->scratch, FILTERED);
}

/** expected <- M s + h. */
static void show(const koopmpc_real *state, koopmpc_real *expected) {
  for (int i = 0; i < KOOPMPC_NY; i++) {
    expected[i] = koopmpc_estimator_h[i];
    for (int j = 0; j < FILTERED; j++) expected[i] += koopmpc_estimator_M[j * KOOPMPC_NY + i] * state[j];
  }
}

static void predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected) {
  koopmpc_real drive[DRIVE];
  koopmpc_copy(drive, u, KOOPMPC_NU);
  koopmpc_copy(drive + KOOPMPC_NU, w, KOOPMPC_NW);
  koopmpc_copy(z, s->s, FILTERED);
  move(s, z, drive);
  show(z, expected);
}

#endif

#if KOOPMPC_GATE
/** Whether y is too far from its prediction to be used, and with `keep` remember it; NaN in `predicted` is no prediction. */
static int refuse(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *predicted, int keep, int *opened) {
  koopmpc_real result[KOOPMPC_GATE + 2];
  koopmpc_gate(y, predicted, s->gate, result);
  if (keep) koopmpc_copy(s->gate, result + 2, KOOPMPC_GATE);
  *opened = (int)result[1];
  return result[0] > 0;
}

#if KOOPMPC_NW
static int is_beyond(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *predicted) {
  int opened;
  return refuse(s, y, predicted, 0, &opened) || opened == 2;
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

/** What u and w predict; where y denies that, with the last w that was used, which `w` is then: w was wild. */
static void choose(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u, koopmpc_real *w, koopmpc_real *z,
                    koopmpc_real *expected) {
  predict(s, u, w, z, expected);
#if KOOPMPC_NW
  int wild = 0;
  if (is_doubtful(s, y, w, expected)) {
    koopmpc_real without[KOOPMPC_NY], moved[KOOPMPC_NY];
    predict(s, u, s->used_w, z, without);
    for (int i = 0; i < KOOPMPC_NY; i++) moved[i] = koopmpc_abs(y[i]) < KOOPMPC_HUGE ? expected[i] : without[i];
    wild = is_beyond(s, moved, without) && !is_beyond(s, y, without);
    if (wild)
      koopmpc_copy(expected, without, KOOPMPC_NY);
    else
      predict(s, u, w, z, expected);
  }
  s->doubted = wild ? s->doubted + 1 : 0;
  koopmpc_copy(wild ? w : s->used_w, wild ? s->used_w : w, KOOPMPC_NW);
#else
  (void)y;
#endif
}

#endif

#if KOOPMPC_GATE && KOOPMPC_ESTIMATOR < 2
/** from <- z, from which the next reading is predicted; for some missed readings its prediction. */
static void bridge(koopmpc_state *s, const koopmpc_real *expected, int known) {
  const int bridges = !known && s->has_z && s->bridged < KOOPMPC_BRIDGED;
  koopmpc_copy(s->from, bridges ? expected : s->z, KOOPMPC_NZ);
  s->bridged = bridges ? s->bridged + 1 : 0;
  s->has_z = known || bridges;
}
#endif

#if KOOPMPC_ESTIMATOR == 1
/** Move d towards the mean of the misfits, by their constant share. */
static void learn(koopmpc_state *s, koopmpc_real *misfit) {
  enum { NZ = KOOPMPC_NZ, NX = KOOPMPC_NX };
  const koopmpc_real weight = s->fresh > KOOPMPC_ESTIMATOR_GAIN ? s->fresh : KOOPMPC_ESTIMATOR_GAIN;
  koopmpc_real states[KOOPMPC_NX], step[KOOPMPC_NX], believed[KOOPMPC_NX], shown[KOOPMPC_NX], varied = 0, most = 0;
  koopmpc_real changed = 0, largest = 0, share, exact;
  for (int i = 0; i < NZ; i++)
    if (koopmpc_estimator_known[i]) misfit[i] = 0;
  if (!koopmpc_usable(misfit, NZ)) return;
  for (int i = 0; i < NZ; i++) s->scratch[i] = s->z[i] - s->from[i];
  show(misfit, states);
  show(s->scratch, step);
  show(s->z, shown);
  show(s->d, believed);
  for (int i = 0; i < NX; i++) {
    const koopmpc_real square = states[i] * states[i], moved = step[i] * step[i];
    const koopmpc_real change = states[i] - s->newest[NZ + i];
    const koopmpc_real least = KOOPMPC_AT_REST * KOOPMPC_AT_REST * shown[i] * shown[i];
    koopmpc_real size = square > moved ? square : moved;
    if (size < least) size = least;
    if (size > s->sizes[i]) {
      s->sizes[i] = size;
      s->weights[i] = 1 / size;
    }
    s->newest[NZ + NX + i] = s->learned ? square - (koopmpc_real)0.5 * change * change : square;
    s->newest[NZ + i] = states[i];
    changed += change * change * s->weights[i];
    largest += (square > believed[i] * believed[i] ? square : believed[i] * believed[i]) * s->weights[i];
  }
  if (s->learned) s->change = s->learned > 1 ? s->change + weight * (changed - s->change) : changed;
  changed = KOOPMPC_ESTIMATOR_REACH * KOOPMPC_ESTIMATOR_REACH * s->change;
  exact = KOOPMPC_ESTIMATOR_REACH > 0 && s->learned && changed < largest ? 1 - changed / largest : 0;
  if (s->learned < 2) s->learned++;
  koopmpc_copy(s->newest, misfit, NZ);
  for (int i = 0; i < NZ + 2 * NX; i++) s->means[i] += weight * (s->newest[i] - s->means[i]);
  s->fresh /= 1 + s->fresh;
  for (int i = 0; i < NX; i++) {
    const koopmpc_real mean = s->means[NZ + i] * s->means[NZ + i], square = believed[i] * believed[i];
    const koopmpc_real spread = s->means[NZ + NX + i] - mean;
    varied += (spread > 0 ? spread : 0) * s->weights[i];
    most += (mean > square ? mean : square) * s->weights[i];
  }
  share = varied < most ? 1 - varied / most : 0;
  for (int i = 0; i < NZ; i++)
    s->d[i] += share < exact || exact > KOOPMPC_EXACT ? exact * (misfit[i] - s->d[i]) : share * (s->means[i] - s->d[i]);
}

void koopmpc_forget(koopmpc_state *s) {
  koopmpc_fill(s->d, 0, KOOPMPC_NZ);
  koopmpc_fill(s->newest, 0, KOOPMPC_NZ + 2 * KOOPMPC_NX);
  koopmpc_fill(s->means, 0, KOOPMPC_NZ + 2 * KOOPMPC_NX);
  koopmpc_fill(s->sizes, 0, KOOPMPC_NX);
  koopmpc_fill(s->weights, 0, KOOPMPC_NX);
  s->fresh = s->change = 0;
  s->learned = 0;
}
#endif

#if KOOPMPC_ESTIMATOR < 2
static int observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
#if KOOPMPC_GATE
  koopmpc_real ahead[KOOPMPC_NZ], expected[KOOPMPC_NY];
  int opened, known;
  koopmpc_fill(expected, (koopmpc_real)NAN, KOOPMPC_NY);
  if (s->has_z) choose(s, y, u, s->w, ahead, expected);
  s->refused = refuse(s, y, expected, 1, &opened);
#if KOOPMPC_ESTIMATOR
  const int learns = s->has_z && !s->stood_in && !s->refused && !opened;
  if (opened == 2) koopmpc_forget(s);
#endif
  if (opened == 2) s->seen = s->has_z = 0; /* the estimate is lost */
  remember(s, s->refused ? expected : y, u);
  known = koopmpc_usable(s->z, KOOPMPC_NZ);
#if KOOPMPC_ESTIMATOR
  s->stood_in = s->refused || !known; /* the next reading is judged all the same */
  if (known && opened == 1) { /* what the readings show now is new: the means begin anew */
    s->learned = 0;
    s->fresh = 1;
  } else if (known && learns) {
    for (int i = 0; i < KOOPMPC_NZ; i++) ahead[i] = s->z[i] - ahead[i];
    learn(s, ahead);
  }
#endif
  bridge(s, s->scratch, known);
  return known || !KOOPMPC_ESTIMATOR;
#else
  remember(s, y, u);
  return 1;
#endif
}

#else
/** s <- s + P M' S^-1 (y - M s - h) with the outputs that came; S = M P M' + R in units of its diagonal. */
static void correct(koopmpc_state *s, const koopmpc_real *y) {
  int came[KOOPMPC_NY], n = 0;
  koopmpc_real *L = s->factor, *x = s->innovation;
  for (int i = 0; i < KOOPMPC_NY; i++)
    if (koopmpc_abs(y[i]) < KOOPMPC_HUGE) came[n++] = i;
  for (int i = 0; i < n; i++) {
    const int a = came[i];
    x[i] = y[a] - koopmpc_estimator_h[a];
    for (int j = 0; j < FILTERED; j++) x[i] -= koopmpc_estimator_M[j * KOOPMPC_NY + a] * s->s[j];
    x[i] /= koopmpc_estimator_unit[a];
    for (int j = 0; j <= i; j++) { /* Cholesky's factor, row by row, and forward substitution with it */
      koopmpc_real sum = koopmpc_estimator_S[a * KOOPMPC_NY + came[j]];
      for (int k = 0; k < j; k++) sum -= L[i * KOOPMPC_NY + k] * L[j * KOOPMPC_NY + k];
      L[i * KOOPMPC_NY + j] = i == j ? KOOPMPC_SQRT(sum) : sum / L[j * KOOPMPC_NY + j];
    }
    for (int k = 0; k < i; k++) x[i] -= L[i * KOOPMPC_NY + k] * x[k];
    x[i] /= L[i * KOOPMPC_NY + i];
  }
  for (int i = n - 1; i >= 0; i--) {
    for (int k = i + 1; k < n; k++) x[i] -= L[k * KOOPMPC_NY + i] * x[k];
    x[i] /= L[i * KOOPMPC_NY + i];
  }
  for (int i = 0; i < n; i++)
    for (int j = 0; j < FILTERED; j++) s->s[j] += koopmpc_estimator_PM[came[i] * FILTERED + j] * x[i];
}

/** s <- that of the start, but for the input of the step before. */
static void forget_estimate(koopmpc_state *s) {
  koopmpc_lift(s->zeta, s->z);
  koopmpc_fill(s->s, 0, FILTERED - KOOPMPC_ESTIMATOR_HELD);
  for (int i = 0; i < KOOPMPC_ESTIMATOR_KEPT_LENGTH; i++) s->s[i] = s->z[koopmpc_estimator_kept[i]];
}

/** s <- that of a plant that has rested at y under u, if all of y has come; else that of the start. */
static void rest_at(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
#if KOOPMPC_ESTIMATOR_SHOWS
  if (koopmpc_usable(y, KOOPMPC_NY)) {
    s->seen = 0;
    remember(s, y, u);
  }
#else
  (void)y;
  (void)u;
#endif
  forget_estimate(s);
}

/** Begin a lost estimate again at y, and keep the start of the run. */
static void begin_again(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
  koopmpc_real start[KOOPMPC_NZETA];
  koopmpc_copy(start, s->zeta, KOOPMPC_NZETA);
  rest_at(s, y, u);
  koopmpc_copy(s->zeta, start, KOOPMPC_NZETA);
}

static int observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
  koopmpc_real *now = s->scratch + FILTERED, largest = 0, expected[KOOPMPC_NY];
  int any = 0, opened;
  if (s->started) {
    koopmpc_real *last = s->queue + s->queued * DRIVE;
    koopmpc_copy(last, u, KOOPMPC_NU);
    koopmpc_copy(last + KOOPMPC_NU, s->w, KOOPMPC_NW);
    s->queued++;
  } else {
    koopmpc_copy(s->s + FILTERED - KOOPMPC_ESTIMATOR_HELD, u, KOOPMPC_ESTIMATOR_HELD);
    if (KOOPMPC_ESTIMATOR_RESTS && !s->seen) rest_at(s, y, u);
  }
  if (s->queued > KOOPMPC_ESTIMATOR_DELAY) {
    koopmpc_real ahead[FILTERED];
    choose(s, y, s->queue, s->queue + KOOPMPC_NU, ahead, expected);
    koopmpc_copy(s->s, ahead, FILTERED);
    s->queued--;
    for (int i = 0; i < s->queued * DRIVE; i++) s->queue[i] = s->queue[i + DRIVE];
  }
  for (int i = 0; i < KOOPMPC_NY; i++) any |= koopmpc_abs(y[i]) < KOOPMPC_HUGE;
  if (s->queued >= KOOPMPC_ESTIMATOR_DELAY) { /* else y was measured before the start */
    show(s->s, expected);
    s->refused = refuse(s, y, expected, 1, &opened);
    if (opened == 2) begin_again(s, y, u);
    if (any && !s->refused) correct(s, y);
  }
  s->missed = any ? 0 : s->missed + 1;
  s->started = 1;
  koopmpc_copy(now, s->s, FILTERED);
  for (int k = 0; k < s->queued; k++) move(s, now, s->queue + k * DRIVE);
  koopmpc_copy(s->z, koopmpc_estimator_one, KOOPMPC_NZ);
  koopmpc_add(s->z, koopmpc_estimator_to_z, KOOPMPC_NZ, now, FILTERED);
  koopmpc_fill(s->d, 0, KOOPMPC_NZ);
  koopmpc_add(s->d, koopmpc_estimator_to_d, KOOPMPC_NZ, now, FILTERED);
  for (int i = 0; i < FILTERED; i++) {
    const koopmpc_real size = koopmpc_abs(now[i]);
    largest = size <= largest ? largest : size; /* NaN stays */
  }
  return s->missed <= KOOPMPC_ESTIMATOR_PATIENCE && largest < KOOPMPC_HUGE;
}

#endif

/** Store rows of measured disturbances from this step on, the last one repeated. */
static void preview(koopmpc_state *s, const koopmpc_rows *w, int count) {
  for (int k = 0; k < count; k++) {
    const koopmpc_real *row = koopmpc_row(w, k, KOOPMPC_NW);
    if (k <= KOOPMPC_LATENCY) koopmpc_copy(s->ahead + k * KOOPMPC_NW, row, KOOPMPC_NW);
    if (k >= KOOPMPC_LATENCY)
      koopmpc_copy(s->known + KOOPMPC_PREVIEW + (k - KOOPMPC_LATENCY) * KOOPMPC_NW, row, KOOPMPC_NW);
  }
}

void koopmpc_observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *applied, const koopmpc_rows *w) {
  const koopmpc_real *acted = s->sent, none[KOOPMPC_NW1] = {0};
  const koopmpc_rows still = {none, 1};
  int good;
  if (KOOPMPC_WITH_RATES)
    koopmpc_copy(s->known + KOOPMPC_U_PREV, applied && !KOOPMPC_LATENCY ? applied : s->given, KOOPMPC_NU);
  if (KOOPMPC_NW) preview(s, w ? w : &still, KOOPMPC_N + KOOPMPC_LATENCY);
  for (int i = 0; i < KOOPMPC_LATENCY * KOOPMPC_NU; i++) s->sent[i] = s->sent[i + KOOPMPC_NU];
  koopmpc_copy(s->sent + KOOPMPC_LATENCY * KOOPMPC_NU, s->given, KOOPMPC_NU);
  if (applied && koopmpc_usable(applied, KOOPMPC_NU)) acted = applied;
  good = observe(s, y, acted);
  for (int i = 0; i < KOOPMPC_NW; i++) /* one that is not finite keeps its last value */
    if (koopmpc_abs(s->ahead[i]) < KOOPMPC_HUGE) s->w[i] = s->ahead[i];
#if KOOPMPC_GATE && KOOPMPC_NW
  if (s->doubted) { /* plan with the last w that was not wild; of a preview only the first row changes */
    const koopmpc_rows used = {s->used_w, 1};
    preview(s, &used, w && w->count > 1 ? 1 : KOOPMPC_N + KOOPMPC_LATENCY);
  }
#endif
  if (good)
    koopmpc_copy(s->known, s->z, KOOPMPC_NZ);
  else
    koopmpc_fill(s->known, (koopmpc_real)NAN, KOOPMPC_NZ);
#if KOOPMPC_LATENCY > 0
  for (int i = 0; i < KOOPMPC_LATENCY; i++) {
    koopmpc_real next[KOOPMPC_NZ];
    advance(next, s->known, s->sent + (i + 1) * KOOPMPC_NU, s->ahead + i * KOOPMPC_NW,
            KOOPMPC_ESTIMATOR ? s->d : 0);
    koopmpc_copy(s->known, next, KOOPMPC_NZ);
  }
#endif
  if (KOOPMPC_ESTIMATOR) koopmpc_copy(s->known + KOOPMPC_DRIFT, s->d, KOOPMPC_NZ);
}

void koopmpc_start_observer(koopmpc_state *s, const koopmpc_real *x0) {
#if KOOPMPC_ESTIMATOR == 2
  enum { PAST = KOOPMPC_NX + KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS };
  const koopmpc_real zero[KOOPMPC_NX] = {0}, *start = x0 ? x0 : zero;
  koopmpc_copy(s->zeta, start, KOOPMPC_NX);
  for (int i = KOOPMPC_NX; i < KOOPMPC_NZETA; i++) {
    const int place = (i - KOOPMPC_NX) % PAST - KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS;
    s->zeta[i] = place < 0 ? 0 : start[place];
  }
  s->seen = x0 != 0;
  forget_estimate(s);
#else
  (void)s;
  (void)x0;
#endif
}
