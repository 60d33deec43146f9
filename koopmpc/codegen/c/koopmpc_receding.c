/** @file koopmpc_receding.c @brief The start of a plan, and the fallback of a failed step. */
#include <math.h>

#include "koopmpc_bounds.h"
#include "koopmpc_levels.h"
#include "koopmpc_limits.h"
#include "koopmpc_observer.h"
#include "koopmpc_receding.h"
#include "koopmpc_solver.h"

#if KOOPMPC_ESTIMATOR == 1 || KOOPMPC_LATENCY > 0 || (KOOPMPC_ESTIMATOR == 0 && KOOPMPC_GATE)
/** z <- F(z, u) + E w + d; d may be NULL. */
static void advance(koopmpc_real *next, const koopmpc_real *z, const koopmpc_real *u, const koopmpc_real *w,
                    const koopmpc_real *d) {
#if KOOPMPC_IS_STAGED
  koopmpc_map(z, u KOOPMPC_AND(w), next);
#else
  koopmpc_fill(next, 0, KOOPMPC_NZ);
  koopmpc_add(next, koopmpc_A, KOOPMPC_NZ, z, KOOPMPC_NZ);
  koopmpc_add(next, koopmpc_B, KOOPMPC_NZ, u, KOOPMPC_NU);
#endif
  if (KOOPMPC_NW) koopmpc_add(next, koopmpc_E, KOOPMPC_NZ, w, KOOPMPC_NW);
  if (d)
    for (int i = 0; i < KOOPMPC_NZ; i++) next[i] += d[i];
}
#endif

#if KOOPMPC_ESTIMATOR == 1

/** Move d towards the mean of the misfits, by their constant share. */
static void learn(koopmpc_state *s, koopmpc_real *misfit) {
  enum { NZ = KOOPMPC_NZ, NX = KOOPMPC_NX };
  const koopmpc_real weight = s->fresh > KOOPMPC_GAIN ? s->fresh : KOOPMPC_GAIN;
  koopmpc_real states[KOOPMPC_NX], step[KOOPMPC_NX], believed[KOOPMPC_NX], shown[KOOPMPC_NX], varied = 0, most = 0;
  koopmpc_real changed = 0, largest = 0, share, exact;
  for (int i = 0; i < NZ; i++)
    if (i == KOOPMPC_CONSTANT || i >= KOOPMPC_LEARNED) misfit[i] = 0;
  if (!koopmpc_usable(misfit, NZ)) return;
  for (int i = 0; i < NX; i++) states[i] = step[i] = believed[i] = shown[i] = 0;
  koopmpc_add(states, koopmpc_C, NX, misfit, NZ);
  for (int i = 0; i < NZ; i++) s->scratch[i] = s->z[i] - s->from[i];
  koopmpc_add(step, koopmpc_C, NX, s->scratch, NZ);
  koopmpc_add(shown, koopmpc_C, NX, s->z, NZ);
  koopmpc_add(believed, koopmpc_C, NX, s->d, NZ);
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
  changed = KOOPMPC_STEADY * KOOPMPC_STEADY * s->change;
  exact = KOOPMPC_STEADY > 0 && s->learned && changed < largest ? 1 - changed / largest : 0;
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
  for (int i = 0; i < NZ; i++) s->d[i] += share < exact || exact > KOOPMPC_EXACT ? exact * (misfit[i] - s->d[i]) : share * (s->means[i] - s->d[i]);
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

/** Forget the past and all that was learned: the estimate is lost. */
static void forget_estimate(koopmpc_state *s) {
  koopmpc_forget(s);
  s->seen = s->has_z = 0;
}

/* z is without d; with d it stands in `scratch`, and is what `expected` shows. */
void koopmpc_predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected) {
  advance(z, s->from, u, w, 0);
  for (int i = 0; i < KOOPMPC_NZ; i++) s->scratch[i] = z[i] + s->d[i];
  koopmpc_fill(expected, 0, KOOPMPC_NY);
  koopmpc_add(expected, koopmpc_C, KOOPMPC_NX, s->scratch, KOOPMPC_NZ);
}

static int observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
  koopmpc_real misfit[KOOPMPC_NZ], expected[KOOPMPC_NY];
  int opened, learns = s->has_z && !s->stood_in;
  koopmpc_fill(expected, (koopmpc_real)NAN, KOOPMPC_NY);
  if (s->has_z) koopmpc_choose(s, y, u, s->w, misfit, expected);
  s->refused = s->stood_in = koopmpc_refuse(s->gate, y, expected, &opened);
  if (opened == 2) forget_estimate(s);
  koopmpc_observe(s->zeta, &s->seen, s->z, s->refused ? expected : y, u);
  if (!koopmpc_usable(s->z, KOOPMPC_NZ)) { /* the next reading is judged all the same */
    s->has_z = koopmpc_bridge(s->from, s->has_z, &s->bridged, s->z, s->scratch);
    s->stood_in = 1;
    return 0;
  }
  if (opened == 1) { /* what the readings show now is new: the means begin anew */
    s->learned = 0;
    s->fresh = 1;
  } else if (!opened && learns && !s->refused) {
    for (int i = 0; i < KOOPMPC_NZ; i++) misfit[i] = s->z[i] - misfit[i];
    learn(s, misfit);
  }
  s->has_z = koopmpc_bridge(s->from, 1, &s->bridged, s->z, s->z);
  return 1;
}

#elif KOOPMPC_ESTIMATOR == 2

enum { DRIVE = KOOPMPC_NU + KOOPMPC_NW };

/** s <- F s + G [u; w] + f. */
static void move(koopmpc_state *s, koopmpc_real *state, const koopmpc_real *drive) {
  koopmpc_copy(s->scratch, koopmpc_filter_f, KOOPMPC_NS);
  koopmpc_add(s->scratch, koopmpc_filter_F, KOOPMPC_NS, state, KOOPMPC_NS);
  koopmpc_add(s->scratch, koopmpc_filter_G, KOOPMPC_NS, drive, DRIVE);
  koopmpc_copy(state, s->scratch, KOOPMPC_NS);
}

/** expected <- M s + h. */
static void show(const koopmpc_real *state, koopmpc_real *expected) {
  for (int i = 0; i < KOOPMPC_NY; i++)
    expected[i] = koopmpc_filter_h[i] + koopmpc_dot(koopmpc_filter_M + i * KOOPMPC_NS, state, KOOPMPC_NS);
}

void koopmpc_predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected) {
  koopmpc_real drive[DRIVE];
  koopmpc_copy(drive, u, KOOPMPC_NU);
  koopmpc_copy(drive + KOOPMPC_NU, w, KOOPMPC_NW);
  koopmpc_copy(z, s->s, KOOPMPC_NS);
  move(s, z, drive);
  show(z, expected);
}

/** s <- s + P M' S^-1 (y - M s - h) with the outputs that came; S = M P M' + R in units of its diagonal. */
static void correct(koopmpc_state *s, const koopmpc_real *y) {
  int came[KOOPMPC_NY], n = 0;
  koopmpc_real *L = s->factor, *x = s->innovation;
  for (int i = 0; i < KOOPMPC_NY; i++)
    if (koopmpc_abs(y[i]) < KOOPMPC_HUGE) came[n++] = i;
  for (int i = 0; i < n; i++) {
    const int a = came[i];
    x[i] = y[a] - koopmpc_filter_h[a];
    for (int j = 0; j < KOOPMPC_NS; j++) x[i] -= koopmpc_filter_M[a * KOOPMPC_NS + j] * s->s[j];
    x[i] /= koopmpc_filter_unit[a];
    for (int j = 0; j <= i; j++) { /* Cholesky's factor, row by row, and forward substitution with it */
      koopmpc_real sum = koopmpc_filter_S[a * KOOPMPC_NY + came[j]];
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
    for (int j = 0; j < KOOPMPC_NS; j++) s->s[j] += koopmpc_filter_PM[came[i] * KOOPMPC_NS + j] * x[i];
}

/** s <- that of the start, but for the input of the step before. */
static void forget_estimate(koopmpc_state *s) {
  koopmpc_lift(s->zeta, s->z);
  koopmpc_fill(s->s, 0, KOOPMPC_NS - KOOPMPC_HELD);
  for (int i = 0; i < KOOPMPC_KEPT; i++) s->s[i] = s->z[koopmpc_kept[i]];
}

/** s <- that of a plant that has rested at y under u, if all of y has come; else that of the start. */
static void rest_at(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
#if KOOPMPC_SHOWS
  if (koopmpc_usable(y, KOOPMPC_NY)) {
    s->seen = 0;
    koopmpc_observe(s->zeta, &s->seen, s->z, y, u);
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
  koopmpc_real *now = s->scratch + KOOPMPC_NS, largest = 0, expected[KOOPMPC_NY];
  int any = 0, opened;
  if (s->started) {
    koopmpc_real *last = s->queue + s->queued * DRIVE;
    koopmpc_copy(last, u, KOOPMPC_NU);
    koopmpc_copy(last + KOOPMPC_NU, s->w, KOOPMPC_NW);
    s->queued++;
  } else {
    koopmpc_copy(s->s + KOOPMPC_NS - KOOPMPC_HELD, u, KOOPMPC_HELD);
    if (KOOPMPC_RESTS && !s->seen) rest_at(s, y, u);
  }
  if (s->queued > KOOPMPC_DELAY_Y) {
    koopmpc_real ahead[KOOPMPC_NS];
    koopmpc_choose(s, y, s->queue, s->queue + KOOPMPC_NU, ahead, expected);
    koopmpc_copy(s->s, ahead, KOOPMPC_NS);
    s->queued--;
    for (int i = 0; i < s->queued * DRIVE; i++) s->queue[i] = s->queue[i + DRIVE];
  }
  for (int i = 0; i < KOOPMPC_NY; i++) any |= koopmpc_abs(y[i]) < KOOPMPC_HUGE;
  if (s->queued >= KOOPMPC_DELAY_Y) { /* else y was measured before the start */
    show(s->s, expected);
    s->refused = koopmpc_refuse(s->gate, y, expected, &opened);
    if (opened == 2) begin_again(s, y, u);
    if (any && !s->refused) correct(s, y);
  }
  s->missed = any ? 0 : s->missed + 1;
  s->started = 1;
  koopmpc_copy(now, s->s, KOOPMPC_NS);
  for (int k = 0; k < s->queued; k++) move(s, now, s->queue + k * DRIVE);
  koopmpc_copy(s->z, koopmpc_filter_one, KOOPMPC_NZ);
  koopmpc_add(s->z, koopmpc_filter_z, KOOPMPC_NZ, now, KOOPMPC_NS);
  koopmpc_fill(s->d, 0, KOOPMPC_NZ);
  koopmpc_add(s->d, koopmpc_filter_d, KOOPMPC_NZ, now, KOOPMPC_NS);
  for (int i = 0; i < KOOPMPC_NS; i++) {
    const koopmpc_real size = koopmpc_abs(now[i]);
    largest = size <= largest ? largest : size; /* NaN stays */
  }
  return s->missed <= KOOPMPC_PATIENCE && largest < KOOPMPC_HUGE;
}

#else

#if KOOPMPC_GATE
void koopmpc_predict(koopmpc_state *s, const koopmpc_real *u, const koopmpc_real *w, koopmpc_real *z,
                     koopmpc_real *expected) {
  advance(z, s->from, u, w, 0);
  koopmpc_fill(expected, 0, KOOPMPC_NY);
  koopmpc_add(expected, koopmpc_C, KOOPMPC_NX, z, KOOPMPC_NZ);
}
#endif

static int observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *u) {
#if KOOPMPC_GATE
  koopmpc_real next[KOOPMPC_NZ] = {0}, expected[KOOPMPC_NY];
  int opened;
  koopmpc_fill(expected, (koopmpc_real)NAN, KOOPMPC_NY);
  if (s->has_z) koopmpc_choose(s, y, u, s->w, next, expected);
  s->refused = koopmpc_refuse(s->gate, y, expected, &opened);
  if (opened == 2) s->seen = s->has_z = 0; /* the estimate is lost */
  if (s->refused) y = expected;
#endif
  koopmpc_observe(s->zeta, &s->seen, s->z, y, u);
#if KOOPMPC_GATE
  s->has_z = koopmpc_bridge(s->from, s->has_z, &s->bridged, s->z, next);
#endif
  return 1;
}

#endif

/** Store the preview of the measured disturbances. */
static void preview(koopmpc_state *s, const koopmpc_rows *w) {
  for (int k = 0; k < KOOPMPC_N + KOOPMPC_LATENCY; k++) {
    const koopmpc_real *row = w ? koopmpc_row(w, k, KOOPMPC_NW) : 0;
    for (int i = 0; i < KOOPMPC_NW; i++) {
      const koopmpc_real value = row ? row[i] : 0;
      if (k <= KOOPMPC_LATENCY) s->ahead[k * KOOPMPC_NW + i] = value;
      if (k >= KOOPMPC_LATENCY) s->known[KOOPMPC_PREVIEW + (k - KOOPMPC_LATENCY) * KOOPMPC_NW + i] = value;
    }
  }
}

void koopmpc_take(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *applied, const koopmpc_rows *w) {
  const koopmpc_real *acted = s->sent;
  int good;
  if (KOOPMPC_WITH_RATES)
    koopmpc_copy(s->known + KOOPMPC_U_PREV, applied && !KOOPMPC_LATENCY ? applied : s->given, KOOPMPC_NU);
  if (KOOPMPC_NW) preview(s, w);
  for (int i = 0; i < KOOPMPC_LATENCY * KOOPMPC_NU; i++) s->sent[i] = s->sent[i + KOOPMPC_NU];
  koopmpc_copy(s->sent + KOOPMPC_LATENCY * KOOPMPC_NU, s->given, KOOPMPC_NU);
  if (applied && koopmpc_usable(applied, KOOPMPC_NU)) acted = applied;
  good = observe(s, y, acted);
  for (int i = 0; i < KOOPMPC_NW; i++) /* one that is not finite keeps its last value */
    if (koopmpc_abs(s->ahead[i]) < KOOPMPC_HUGE) s->w[i] = s->ahead[i];
#if KOOPMPC_GATE && KOOPMPC_NW
  if (s->doubted) { /* plan with the last w that was not wild; of a preview only the first row changes */
    const int rows = w && w->count > 1 ? 1 : KOOPMPC_N + KOOPMPC_LATENCY;
    for (int k = 0; k < rows; k++) {
      if (k <= KOOPMPC_LATENCY) koopmpc_copy(s->ahead + k * KOOPMPC_NW, s->used_w, KOOPMPC_NW);
      if (k >= KOOPMPC_LATENCY)
        koopmpc_copy(s->known + KOOPMPC_PREVIEW + (k - KOOPMPC_LATENCY) * KOOPMPC_NW, s->used_w, KOOPMPC_NW);
    }
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

void koopmpc_fail(koopmpc_state *s, const koopmpc_real *free_input, const koopmpc_real *applied, koopmpc_real *u,
                  koopmpc_report *report, koopmpc_status status) {
  koopmpc_real before[KOOPMPC_NU];
  const koopmpc_real *chosen = before;
  s->planned = 0;
  s->warm = 0;
  koopmpc_copy(before, applied && koopmpc_usable(applied, KOOPMPC_NU) ? applied : s->given, KOOPMPC_NU);
  report->status = status;
  report->slack = 0;
  if (s->has_kept && s->age + 1 < KOOPMPC_N) {
    s->age++;
#if KOOPMPC_FIRST_ALONE
    if (s->owes) koopmpc_settle(s, s->kept);
    s->owes = 0;
#endif
    chosen = s->kept + KOOPMPC_NU * koopmpc_move_of[s->age];
    report->fallback = KOOPMPC_SHIFTED_PLAN;
  } else {
    s->has_kept = 0;
    report->fallback = free_input ? KOOPMPC_CLIPPED_LQR : KOOPMPC_HOLD;
    if (free_input) chosen = free_input;
  }
  koopmpc_copy(u, chosen, KOOPMPC_NU);
  koopmpc_admit_within(u, KOOPMPC_RATED ? KOOPMPC_RATES_LOW(s) : 0, KOOPMPC_RATES_HIGH(s), before, KOOPMPC_BOX_LOW(s),
                       KOOPMPC_BOX_HIGH(s));
#if KOOPMPC_LEVELED
  koopmpc_round_levels(s, u, before);
#endif
  koopmpc_copy(s->given, u, KOOPMPC_NU);
}

void koopmpc_start(koopmpc_state *s, const koopmpc_real *x0, const koopmpc_real *u_prev) {
  const koopmpc_state empty = {0};
  *s = empty;
#if KOOPMPC_BOUNDS
  koopmpc_reset_bounds(s);
#endif
  for (int i = 0; i < KOOPMPC_NU; i++)
    s->given[i] = u_prev ? u_prev[i] : koopmpc_clip(0, koopmpc_input_low[i], koopmpc_input_high[i]);
#if KOOPMPC_LEVELED
  koopmpc_start_levels(s, s->given);
  if (!u_prev) koopmpc_round_levels(s, s->given, s->given);
  koopmpc_start_levels(s, s->given);
#endif
  for (int k = 0; k <= KOOPMPC_LATENCY; k++) koopmpc_copy(s->sent + k * KOOPMPC_NU, s->given, KOOPMPC_NU);
#if KOOPMPC_ESTIMATOR == 2
  {
    const koopmpc_real zero[KOOPMPC_NX] = {0}, *start = x0 ? x0 : zero;
    for (int i = 0; i < KOOPMPC_NX; i++) s->zeta[i] = start[i];
    for (int i = KOOPMPC_NX; i < KOOPMPC_NZETA; i++) {
      enum { PAST = KOOPMPC_NX + KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS };
      const int place = (i - KOOPMPC_NX) % PAST - KOOPMPC_NU * KOOPMPC_DELAYED_INPUTS;
      s->zeta[i] = place < 0 ? 0 : start[place];
    }
    s->seen = x0 != 0;
    forget_estimate(s);
  }
#else
  (void)x0;
#endif
}
