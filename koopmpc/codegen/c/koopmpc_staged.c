/**
 * @file koopmpc_staged.c
 * @brief Real-time iteration: linearise along the plan, solve the program of its stages, add the step.
 *
 * Diehl, Bock & Schloeder, SIAM J. Control Optim. 43, 2005. Without rates a stage is s = x and v = u. Where changes of
 * inputs are weighed or limited, or moves are blocked, s = [x; u_{k-1}; v_{k-1}] and v is the change of u.
 */
#include <math.h>

#include "koopmpc_staged_tables.h"
#include "koopmpc_stages.h"

enum { EACH = 12, AGAIN = 10, ENDINGS = 20, SPENT = 300, PLAN_S = (STEPS + 1) * NS, PLAN_V = STEPS * NV };
#define NEAR_OF ((koopmpc_real)0.2)      /* F may differ from its linearisation by this share of a change */
#define SHORTEST ((koopmpc_real)0.001)   /* shortest length of a step */
#define FOLLOWED ((koopmpc_real)0.02)    /* a plan follows the model if its defects are below this share of a range */
#define BROKEN ((koopmpc_real)1e-4)      /* a hard limit is broken by more than this share of its size */
#define NEARLY ((koopmpc_real)1e-2)      /* plans are compared once an iteration moves them by less than this share */
#define FAR_OFF ((koopmpc_real)3)        /* the plan restarts if y is more than this many state sizes from the prediction */

static int is_good(koopmpc_status status) { return status <= KOOPMPC_SOFTENED; }

/** Input i of stage k inside its limits. */
static koopmpc_real clip_input(const koopmpc_state *s, int k, int i, koopmpc_real u) {
  (void)s, (void)k; /* where no limit moves */
  return koopmpc_clip(u, KOOPMPC_STAGE_BOX_LOW(s, k)[i], KOOPMPC_STAGE_BOX_HIGH(s, k)[i]);
}

/** Write states X (N+1, nx) and inputs U (N, nu) as the plan: inputs inside their limits and held in each block. */
static void enter(koopmpc_state *s, const koopmpc_real *X, const koopmpc_real *U, const koopmpc_real *u_prev) {
  for (int k = 0; k <= STEPS; k++) koopmpc_copy(s->S + k * NS, X + k * NX, NX);
  for (int i = 0; i < NV && KOOPMPC_WITH_RATES; i++) s->S[NX + i] = u_prev[i];
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < NV; i++) {
      const int from = KOOPMPC_WITH_RATES ? koopmpc_held_from[k] : k;
      const koopmpc_real u = clip_input(s, k, i, U[from * NV + i]);
      s->V[k * NV + i] = KOOPMPC_WITH_RATES ? u - s->S[k * NS + NX + i] : u;
      if (KOOPMPC_WITH_RATES) s->S[(k + 1) * NS + NX + i] = u;
    }
  for (int k = 0; k <= STEPS; k++)
    for (int i = 0; i < KOOPMPC_SOFT_RATES_LENGTH; i++)
      s->S[k * NS + NX + NV + i] = k ? s->V[(k - 1) * NV + koopmpc_soft_rates[i]] : 0;
}

/** Write the states and the inputs of the plan, the inputs inside their limits. */
static void trajectory(const koopmpc_state *s, koopmpc_real *X, koopmpc_real *U) {
  for (int k = 0; k <= STEPS; k++) koopmpc_copy(X + k * NX, s->S + k * NS, NX);
  for (int i = 0; i < NV; i++) {
    koopmpc_real u = KOOPMPC_WITH_RATES ? s->S[NX + i] : 0;
    for (int k = 0; k < STEPS; k++) {
      const koopmpc_real v = s->V[k * NV + i];
      u = !KOOPMPC_WITH_RATES ? v : koopmpc_free[k] ? u + v : u;
      U[k * NV + i] = clip_input(s, k, i, u);
    }
  }
}

/** Add the disturbance of step k of the plan to x. */
static void push(const koopmpc_state *s, int k, koopmpc_real *x) {
  for (int i = 0; i < NX && KOOPMPC_DISTURBED; i++) x[i] += s->e[k * NX + i];
}

/** One step of the model from a stage, with the disturbance of the plan. */
static void follow(const koopmpc_state *s, int k, const koopmpc_real *x, const koopmpc_real *v, koopmpc_real *next) {
  koopmpc_stage_map(x, v KOOPMPC_AND(koopmpc_w_of(s, k)), next);
  push(s, k, next);
}

/** Add the step to the plan: all of it, or the half, quarter, ... along which F is near its linearisation. */
static void add_program(koopmpc_state *s, const koopmpc_real *x) {
  koopmpc_real reach[NS], gap[NS], *left = s->c;
  int fits = 0;
  for (int i = 0; i < NS; i++) left[i] += koopmpc_dot(s->A + i * NS, s->start, NS); /* dx_0 has no step length */
  for (int i = 0; i < NS; i++) {
    koopmpc_real change = 0, size = 0;
    gap[i] = 0;
    for (int k = 0; k < STEPS; k++) {
      gap[i] = koopmpc_most(gap[i], left[k * NS + i]);
      change = koopmpc_most(change, s->dX[k * NS + i]);
      size = koopmpc_most(size, s->S[(k + 1) * NS + i]);
    }
    reach[i] = NEAR_OF * (change > gap[i] ? change : gap[i]) + KOOPMPC_REACH * (koopmpc_stage_sizes[i] + size);
  }
  for (s->length = 1;; s->length /= 2) {
    const koopmpc_real length = s->length;
    koopmpc_real found[NS], before[NS], error[NS];
    if (length < SHORTEST) break;
    fits = 1;
    koopmpc_copy(before, x, NS);
    koopmpc_fill(error, 0, NS);
    for (int k = 0; k < STEPS && fits; k++) {
      koopmpc_real *next = s->newX + k * NS, *u = s->newU + k * NV;
      for (int i = 0; i < NS; i++) next[i] = s->S[(k + 1) * NS + i] + length * s->dX[k * NS + i];
      for (int i = 0; i < NV; i++) u[i] = s->V[k * NV + i] + length * s->dU[k * NV + i];
      follow(s, k, before, u, found);
      for (int i = 0; i < NS; i++) {
        const koopmpc_real off = found[i] - next[i];
        error[i] = koopmpc_most(error[i], off);
        fits &= koopmpc_abs(off - (1 - length) * left[k * NS + i]) <= length * reach[i];
      }
      koopmpc_copy(before, next, NS);
    }
    if (fits) {
      koopmpc_copy(gap, error, NS);
      break;
    }
  }
  koopmpc_copy(s->defects, gap, NS);
  if (!fits) { /* F is nowhere near its linearisation: the plan stays as it was */
    s->length = 0;
  } else {
    koopmpc_copy(s->S, x, NS);
    koopmpc_copy(s->S + NS, s->newX, STEPS * NS);
    koopmpc_copy(s->V, s->newU, STEPS * NV);
  }
  s->slack = 0;
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < SOFT; i++) {
      const koopmpc_real past = s->eps[i * STEPS + k] * koopmpc_sides_span[HARD + i];
      if (past > koopmpc_softness_allowance[koopmpc_sides_row[HARD + i] - NV] && past > s->slack) s->slack = past;
    }
}

/** The largest defect that the last step has left, as a share of the range of its state in the plan. */
static koopmpc_real gap_of(const koopmpc_state *s) {
  koopmpc_real most = 0;
  for (int i = 0; i < NS; i++) {
    koopmpc_real low = s->S[i], high = s->S[i];
    for (int k = 1; k <= STEPS; k++) {
      if (s->S[k * NS + i] < low) low = s->S[k * NS + i];
      if (s->S[k * NS + i] > high) high = s->S[k * NS + i];
    }
    most = koopmpc_most(most, s->defects[i] / (high - low + KOOPMPC_REACH * (koopmpc_stage_sizes[i] + koopmpc_abs(s->S[i]))));
  }
  return most;
}

/** Whether no input and no state moved by more than this share of its size and the plan's. */
static int rests(const koopmpc_state *s, koopmpc_real settled) {
  koopmpc_real moved = 0, size = 0, plan = 0, input = 0;
  for (int k = 0; k <= STEPS; k++)
    for (int i = 0; i < NS; i++) {
      if (k) moved = koopmpc_most(moved, s->dX[(k - 1) * NS + i] / koopmpc_stage_sizes[i]);
      size = koopmpc_most(size, s->S[k * NS + i] / koopmpc_stage_sizes[i]);
    }
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < NV; i++) {
      input = koopmpc_most(input, s->dU[k * NV + i] / koopmpc_input_sizes[i]);
      plan = koopmpc_most(plan, s->V[k * NV + i] / koopmpc_input_sizes[i]);
    }
  return moved <= settled * (1 + size) && input <= settled * (1 + plan);
}

/** Iterate at most this many times from the plan, up to the effort `until`; returns how the last iteration ended. */
static koopmpc_status improve(koopmpc_state *s, const koopmpc_real *x, const koopmpc_real *u_prev, int most,
                              koopmpc_real settled, int until, int *iterations) {
  koopmpc_status status = KOOPMPC_FAILED;
  for (int k = 0; k < most; k++) {
    int taken = 0;
    if (k && s->spent >= until) break;
    const koopmpc_status found = koopmpc_program(s, x, s->without_limits, &taken);
    *iterations += taken;
    if (!is_good(found)) return found;
    add_program(s, x);
    if (!(s->length > 0)) return gap_of(s) < NEAR_OF ? found : KOOPMPC_FAILED;
    trajectory(s, s->draftX, s->draftU);
    enter(s, s->draftX, s->draftU, u_prev);
    status = s->slack > 0 ? KOOPMPC_SOFTENED : found;
    if (k + 1 < most && ((KOOPMPC_AFFINE && s->length >= 1) || rests(s, settled))) break;
  }
  return status;
}

/** Make the plan of the last step the start of this one; its last stage is one step of the model. */
static void shift(koopmpc_state *s, const koopmpc_real *u_prev) {
  koopmpc_real *X = s->draftX, *U = s->draftU;
  trajectory(s, X, U);
  for (int i = 0; i < STEPS * NX; i++) X[i] = X[i + NX];
  for (int i = 0; i < (STEPS - 1) * NV; i++) U[i] = U[i + NV];
  koopmpc_map(X + (STEPS - 1) * NX, U + (STEPS - 1) * NV KOOPMPC_AND(koopmpc_w_of(s, STEPS - 1)), X + STEPS * NX);
  push(s, STEPS - 1, X + STEPS * NX);
  enter(s, X, U, u_prev);
}

/** Write u = 0, or u_prev where its changes count, inside the limits. */
static void hold(const koopmpc_real *u_prev, koopmpc_real *u) {
  for (int i = 0; i < NV; i++)
    u[i] = koopmpc_clip(KOOPMPC_WITH_RATES ? u_prev[i] : 0, koopmpc_inputs_low[i], koopmpc_inputs_high[i]);
}

/** Write start `which` as the plan: rest at x, the line from x to the equilibrium, the motion from x; 0 if it leaves. */
static int begin(koopmpc_state *s, int which, const koopmpc_real *x, const koopmpc_real *u_prev) {
  koopmpc_real *X = s->draftX, *U = s->draftU;
  for (int k = 0; k < STEPS; k++) hold(u_prev, U + k * NV);
  for (int k = 0; k <= STEPS; k++)
    for (int i = 0; i < NX; i++) {
      const koopmpc_real share = (koopmpc_real)k / (koopmpc_real)STEPS;
      X[k * NX + i] = which == 1 ? x[i] + share * (s->rest[i] - x[i]) : x[i];
    }
  if (which == 2) {
    for (int k = 0; k < STEPS; k++) {
      koopmpc_map(X + k * NX, U + k * NV KOOPMPC_AND(koopmpc_w_of(s, k)), X + (k + 1) * NX);
      push(s, k, X + (k + 1) * NX);
    }
    if (!koopmpc_usable(X, (STEPS + 1) * NX)) return 0;
  }
  enter(s, X, U, u_prev);
  return 1;
}

/** Whether a state of the model grows beyond NO_DIGITS of its sizes within the horizon, from x with u = 0 or u_prev. */
static int runs_away(const koopmpc_state *s, const koopmpc_real *x, const koopmpc_real *u_prev) {
  koopmpc_real at[NX], next[NX], u[NV];
  koopmpc_copy(at, x, NX);
  hold(u_prev, u);
  for (int k = 0; k <= STEPS; k++) {
    for (int i = 0; i < NX; i++)
      if (koopmpc_abs(at[i]) >= KOOPMPC_NO_DIGITS * koopmpc_stage_sizes[i]) return 1; /* not for NaN */
    for (int i = 0; i < NX; i++)
      if (!(koopmpc_abs(at[i]) < KOOPMPC_NO_DIGITS * koopmpc_stage_sizes[i])) return 0; /* NaN, which a model may have */
    if (k < STEPS) {
      koopmpc_map(at, u KOOPMPC_AND(koopmpc_w_of(s, k)), next);
      koopmpc_copy(at, next, NX);
    }
  }
  (void)s; /* where no disturbance is measured */
  return 0;
}

/** Keep the plan, or restore the kept one. */
static void save(koopmpc_state *s) {
  koopmpc_copy(s->bestS, s->S, PLAN_S);
  koopmpc_copy(s->bestV, s->V, PLAN_V);
  s->best_slack = s->slack;
}

static void restore(koopmpc_state *s) {
  koopmpc_copy(s->S, s->bestS, PLAN_S);
  koopmpc_copy(s->V, s->bestV, PLAN_V);
  s->slack = s->best_slack;
}

/** By how much the state after stage k breaks a hard limit, in units of what counts as broken; at least `past`. */
static koopmpc_real past_of(const koopmpc_state *s, int k, const koopmpc_real *next, koopmpc_real past) {
  koopmpc_real outputs[NG + NG * NS + 1];
  koopmpc_limited(next, outputs);
  for (int row = 0; row < NG; row++) {
    const koopmpc_real under = (koopmpc_low_of(s, k, NV + row) - outputs[row]) / koopmpc_softness_allowance[row];
    const koopmpc_real over = (outputs[row] - koopmpc_high_of(s, k, NV + row)) / koopmpc_softness_allowance[row];
    if (!koopmpc_is_hard(row)) continue;
    if (!(under <= past)) past = under;
    if (!(over <= past)) past = over;
  }
  return past;
}

/** The same of the states to which the plan's inputs lead; if they keep the limits and the plan's do not, they replace them. */
static koopmpc_real excess_of(koopmpc_state *s) {
  koopmpc_real before[NS], next[NS], past = 0, planned = 0;
  koopmpc_copy(before, s->S, NS);
  for (int k = 0; k < STEPS; k++) {
    follow(s, k, before, s->V + k * NV, next);
    if (!koopmpc_usable(next, NS)) return KOOPMPC_HUGE;
    past = past_of(s, k, next, past);
    planned = past_of(s, k, s->S + (k + 1) * NS, planned);
    koopmpc_copy(before, next, NS);
  }
  for (int k = 0; k < STEPS && past <= 1 && !(planned <= 1); k++)
    follow(s, k, s->S + k * NS, s->V + k * NV, s->S + (k + 1) * NS);
  return past;
}

/** Iterate on until the plan keeps its hard limits; returns how it ended. */
static koopmpc_status meet_limits(koopmpc_state *s, koopmpc_status status, const koopmpc_real *x,
                                  const koopmpc_real *u_prev, int *iterations) {
  for (int k = 0; k < ENDINGS; k++) {
    if (!KOOPMPC_HARD_OUTPUTS || !is_good(status) || excess_of(s) <= 1) return status;
    status = improve(s, x, u_prev, 1, KOOPMPC_SETTLED, 0, iterations);
  }
  return !is_good(status) || excess_of(s) <= 1 ? status : KOOPMPC_MAX_ITERATIONS;
}

/** Choose the cheapest plan of several starts; plans that follow the model come first. */
static koopmpc_status begin_anew(koopmpc_state *s, const koopmpc_real *x, const koopmpc_real *u_prev,
                                 int *iterations) {
  koopmpc_status status = KOOPMPC_FAILED, polished;
  koopmpc_real best = KOOPMPC_HUGE;
  const int until = s->spent + SPENT;
  int best_kind = 3, done = 0;
  save(s);
  s->best_slack = 0;
  for (int which = 0; which < 2 + KOOPMPC_GIVEN_MAP && !done; which++) {
    koopmpc_status ended;
    koopmpc_real value = 0;
    int kind = 2;
    if (!begin(s, which, x, u_prev)) continue;
    ended = improve(s, x, u_prev, EACH, NEARLY, until, iterations);
    if (is_good(ended)) {
      const koopmpc_real gap = gap_of(s);
      const koopmpc_real excess = KOOPMPC_HARD_OUTPUTS ? BROKEN * excess_of(s) : 0;
      kind = gap < FOLLOWED && excess <= FOLLOWED ? 0 : 1;
      value = kind == 0 ? koopmpc_cost(s) : gap > excess ? gap : excess;
    }
    if (kind < best_kind || (kind == best_kind && value < best)) {
      best_kind = kind;
      best = value;
      status = ended;
      save(s);
    }
    done = s->spent >= until || (KOOPMPC_AFFINE && best_kind == 0);
  }
  restore(s);
  if (!is_good(status) || done) return status;
  polished =
      improve(s, x, u_prev, KOOPMPC_ITERATIONS > AGAIN ? KOOPMPC_ITERATIONS : AGAIN, KOOPMPC_SETTLED, until, iterations);
  if (!is_good(polished)) {
    restore(s);
    return status;
  }
  return polished;
}

#if KOOPMPC_SCHEDULED
/** Have the targets found for another w, which holds at the end of the horizon. */
static void aim_at(koopmpc_state *s, const koopmpc_real *w) {
  koopmpc_copy(s->aimed_w, w, KOOPMPC_NW);
  s->made_count = s->made_next = s->has_made_end = s->has_rest = s->has_chord = s->aimed = 0;
}
#endif

/** Store e_k = E w_k + d; returns whether it is finite. */
static int disturb(koopmpc_state *s) {
#if KOOPMPC_DISTURBED
  koopmpc_real last[NX];
  int good = 1;
  for (int k = 0; k < STEPS && good; k++) {
    koopmpc_real e[NX];
    koopmpc_fill(e, 0, NX);
    if (KOOPMPC_NW) koopmpc_add(e, koopmpc_E, NX, s->known + KOOPMPC_PREVIEW + k * KOOPMPC_NW, KOOPMPC_NW);
    if (KOOPMPC_ESTIMATOR)
      for (int i = 0; i < NX; i++) e[i] += s->known[KOOPMPC_DRIFT + i];
    good = koopmpc_usable(e, NX);
    koopmpc_copy(s->draftX + k * NX, e, NX);
  }
#if KOOPMPC_SCHEDULED
  good = good && koopmpc_usable(koopmpc_w_of(s, 0), STEPS * KOOPMPC_NW);
#endif
  if (!good) return 0;
  koopmpc_copy(last, s->e + (STEPS - 1) * NX, NX);
  koopmpc_copy(s->e, s->draftX, STEPS * NX);
  s->moved_on |= !koopmpc_same(last, s->e + (STEPS - 1) * NX, NX);
#if KOOPMPC_SCHEDULED
  if (!koopmpc_same(s->aimed_w, koopmpc_w_of(s, STEPS - 1), KOOPMPC_NW)) aim_at(s, koopmpc_w_of(s, STEPS - 1));
#endif
#else
  (void)s;
#endif
  return 1;
}

/** The target of a reference row in the table, which is that of w = 0; NULL where it is not there. */
static const koopmpc_real *find_in_table(koopmpc_state *s, const koopmpc_real *row) {
  for (int tried = 0; tried < s->target_count; tried++) {
    const koopmpc_real *target = s->targets + s->found * KOOPMPC_TARGET;
    if (koopmpc_same(target, row, KOOPMPC_NR)) return target;
    s->found = s->found + 1 < s->target_count ? s->found + 1 : 0;
  }
  return 0;
}

/** The target of a reference row, without its cost unless `whole`; the search starts at the last one found. */
static const koopmpc_real *target_of(koopmpc_state *s, const koopmpc_real *row, int whole) {
  const koopmpc_real *target = 0;
#if KOOPMPC_SCHEDULED
  const koopmpc_real none[KOOPMPC_NW1] = {0};
  if (koopmpc_same(s->aimed_w, none, KOOPMPC_NW))
#endif
    target = find_in_table(s, row);
  return target ? target : koopmpc_find_row(s, row, whole);
}

/** Find the targets of the stages where the reference or the disturbance moved; 0 where a row has none. */
static int aim(koopmpc_state *s, const koopmpc_rows *reference) {
  const koopmpc_real *end = 0, *last = s->reference + STEPS * KOOPMPC_NR;
  koopmpc_real own[KOOPMPC_TARGET], *u_end = own + TARGET_INPUT;
  int same = s->aimed, trajectory_ends = 0;
  for (int k = 0; k <= STEPS; k++) {
    const koopmpc_real *row = koopmpc_row(reference, k + KOOPMPC_LATENCY, KOOPMPC_NR);
    same &= koopmpc_same(s->reference + k * KOOPMPC_NR, row, KOOPMPC_NR);
    koopmpc_copy(s->reference + k * KOOPMPC_NR, row, KOOPMPC_NR);
  }
  if (same && !s->moved_on) return 1;
  s->aimed = 0;
  if (!koopmpc_usable(s->reference, (STEPS + 1) * KOOPMPC_NR)) return 0;
  for (int k = 0; k <= STEPS; k++) {
    const koopmpc_real *row = s->reference + k * KOOPMPC_NR;
    const int repeated = k > 0 && koopmpc_same(row, row - KOOPMPC_NR, KOOPMPC_NR);
    if (k < STEPS && !KOOPMPC_HOLDS) { /* only the last row counts */
      koopmpc_fill(s->u_r + k * NV, 0, NV);
      continue;
    }
    if (!repeated || k == STEPS) end = target_of(s, row, k == STEPS);
    if (!end) return 0;
    if (k < STEPS) {
      koopmpc_copy(s->u_r + k * NV, end + TARGET_INPUT, NV);
      if (KOOPMPC_DISTURBED)
        for (int i = 0; i < NV; i++)
          s->u_r[k * NV + i] += koopmpc_dot(end + TARGET_SLOPE + i * NX, s->e + (STEPS - 1) * NX, NX);
    }
  }
  koopmpc_copy(own, end, KOOPMPC_TARGET);
#if KOOPMPC_SCHEDULED
  koopmpc_copy(s->last_end, own, TARGET_M);
  s->has_last_end = own[TARGET_FOUND] > 0;
#endif
#if KOOPMPC_DISTURBED
  koopmpc_rest(s, own, s->e + (STEPS - 1) * NX);
  koopmpc_copy(own + TARGET_X, s->rest, NX);
  koopmpc_copy(own + TARGET_U, s->rest_u, NV);
  koopmpc_copy(u_end, s->rest_input, NV);
  koopmpc_copy(own + TARGET_GOAL, s->rest_goal, KOOPMPC_GOAL);
#else
  koopmpc_copy(s->rest, end + TARGET_X, NX);
#endif
  for (int k = 0; k < STEPS; k++) {
    const int held = koopmpc_same(s->reference + k * KOOPMPC_NR, last, KOOPMPC_NR);
    if (k == STEPS - 1) trajectory_ends = KOOPMPC_GIVEN && !held;
    if (!KOOPMPC_DISTURBED) continue;
    for (int i = 0; i < NV; i++)
      s->u_r[k * NV + i] = held ? u_end[i] : koopmpc_clip(s->u_r[k * NV + i], koopmpc_inputs_low[i], koopmpc_inputs_high[i]);
  }
  s->moved_on = 0;
#if KOOPMPC_GIVEN
  for (int k = 0; k <= STEPS; k++) { /* row k of a given u_target counts at the k-th step */
    koopmpc_give_input(s, k, k < STEPS ? s->u_r + k * NV : u_end);
  }
  for (int i = 0; i < KOOPMPC_GOAL; i++)
    own[TARGET_GOAL + i] += koopmpc_dot(own + TARGET_V + i * NV, u_end, NV);
  s->moved_on = s->row + 1 < KOOPMPC_GIVEN_LENGTH;
  s->row += s->moved_on;
#endif
  if (KOOPMPC_STAGE_END == 2 || (KOOPMPC_STAGE_END == 1 && trajectory_ends))
    koopmpc_weigh_row(own, koopmpc_Q_root); /* no tail */
#if KOOPMPC_BEYOND
  koopmpc_move_end(s, own);
#endif
  koopmpc_fill(s->end_M, 0, KOOPMPC_END * NR);
  koopmpc_fill(s->end_L, 0, KOOPMPC_END * NS);
  for (int i = 0; i < KOOPMPC_GOAL; i++) {
    koopmpc_copy(s->end_M + i * NR, own + TARGET_M + i * KOOPMPC_NR, KOOPMPC_NR);
    koopmpc_copy(s->end_L + i * NS, own + TARGET_L + i * NX, NX);
    if (KOOPMPC_WITH_RATES) koopmpc_copy(s->end_L + i * NS + NX, own + TARGET_V + i * NV, NV);
    s->end_m[i] = own[TARGET_GOAL + i];
  }
#if KOOPMPC_WITH_RATES
  for (int i = 0; i < NV; i++) {
    koopmpc_real *row = s->end_L + (KOOPMPC_GOAL + i) * NS + NX;
    koopmpc_copy(row, koopmpc_R_root + i * NV, NV);
    s->end_m[KOOPMPC_GOAL + i] = koopmpc_dot(row, s->u_r + (STEPS - 1) * NV, NV);
  }
#endif
  for (int k = 0; k < STEPS; k++) {
    koopmpc_copy(s->R + k * NR, s->reference + (k + 1) * KOOPMPC_NR, KOOPMPC_NR);
    if (KOOPMPC_WITH_RATES) {
      koopmpc_copy(s->R + k * NR + KOOPMPC_NR, s->u_r + k * NV, NV);
      koopmpc_fill(s->U_r + k * NV, 0, NV);
    } else {
      koopmpc_copy(s->U_r + k * NV, s->u_r + k * NV, NV);
    }
  }
  s->aimed = 1;
  return 1;
}

/** Write s_0 and the limits of v_0; returns whether rates widened because they exclude the limits of u. */
static int first_stage(koopmpc_state *s, const koopmpc_real *u_prev, koopmpc_real *stage) {
  int conflict = 0;
  koopmpc_fill(stage, 0, NS);
  koopmpc_copy(stage, s->known, NX);
#if KOOPMPC_WITH_RATES
  koopmpc_copy(stage + NX, u_prev, NV);
  for (int i = 0; i < NV; i++) {
    const koopmpc_real low = koopmpc_v_limits_low[i], high = koopmpc_v_limits_high[i];
    const koopmpc_real most = KOOPMPC_BOX_HIGH(s)[i] - u_prev[i], least = KOOPMPC_BOX_LOW(s)[i] - u_prev[i];
    const koopmpc_real reach = KOOPMPC_REACH * (koopmpc_abs(u_prev[i]) + koopmpc_input_sizes[i]);
    s->first_low[i] = low < most ? low : most;
    s->first_high[i] = high > least ? high : least;
    conflict |= s->first_low[i] < low - reach || s->first_high[i] > high + reach;
  }
#else
  (void)u_prev;
#endif
  return conflict;
}

/** The plan from `stage` on. */
static koopmpc_status solve(koopmpc_state *s, const koopmpc_real *stage, const koopmpc_real *u_prev, int *iterations) {
  koopmpc_status status = KOOPMPC_FAILED;
  s->finishing = s->spent = 0;
  if (s->warm) {
    int near = 1;
    for (int i = 0; i < NX; i++) near &= koopmpc_abs(stage[i] - s->S[NS + i]) <= FAR_OFF * koopmpc_stage_sizes[i];
    if (near) {
      shift(s, u_prev);
      status = improve(s, stage, u_prev, KOOPMPC_ITERATIONS, KOOPMPC_SETTLED, SPENT, iterations);
      status = meet_limits(s, status, stage, u_prev, iterations);
    }
  }
  if (!is_good(status)) {
    status = begin_anew(s, stage, u_prev, iterations);
    status = meet_limits(s, status, stage, u_prev, iterations);
  }
  return status;
}

/** Whether the target of a row is in the table, or was found without active limits; of a scheduled w, that of w = 0. */
static int is_found(koopmpc_state *s, const koopmpc_real *row, int whole) {
#if KOOPMPC_SCHEDULED
  (void)whole;
  return find_in_table(s, row) || koopmpc_is_free(s, row);
#else
  const koopmpc_real *target = target_of(s, row, whole), *known = s->targets + s->target_count * KOOPMPC_TARGET;
  if (!target || (target >= s->targets && target < known)) return target != 0;
  return !koopmpc_is_limited(target + TARGET_ACTIVE) &&
         target[target == s->made_end ? TARGET_FOUND : TARGET_M] > 0 && koopmpc_is_alone(s, row, target);
#endif
}

int koopmpc_find_targets(koopmpc_state *s, const koopmpc_rows *reference) {
  int missed = 0;
  for (int k = KOOPMPC_HOLDS ? 0 : STEPS; k <= STEPS; k++) {
    const koopmpc_real *row = koopmpc_row(reference, k + KOOPMPC_LATENCY, KOOPMPC_NR);
    if (koopmpc_usable(row, KOOPMPC_NR)) missed += !is_found(s, row, k == STEPS);
  }
  return missed;
}

void koopmpc_use_targets(koopmpc_state *s, const koopmpc_real *targets, int count) {
  s->targets = targets;
  s->target_count = count;
  s->found = s->made_count = s->made_next = s->has_made_end = 0;
}

void koopmpc_decide(koopmpc_state *s, const koopmpc_rows *reference, const koopmpc_real *applied, koopmpc_real *u,
                    koopmpc_report *report) {
  koopmpc_real stage[NS], u_prev[NV], *told = s->known + KOOPMPC_U_PREV;
  koopmpc_status status = KOOPMPC_BAD_MEASUREMENT;
  int conflict, known;
  koopmpc_copy(u_prev, KOOPMPC_WITH_RATES && koopmpc_usable(told, NV) ? told : s->given, NV);
  if (KOOPMPC_WITH_RATES) koopmpc_copy(told, u_prev, NV);
  conflict = first_stage(s, u_prev, stage);
  known = koopmpc_usable(s->known, NX) && disturb(s) && aim(s, reference);
  if (known) status = solve(s, stage, u_prev, &report->iterations);
  if (!is_good(status)) {
    koopmpc_real free_input[NV];
    for (int i = 0; i < NV; i++) free_input[i] = s->without_limits[i] + (KOOPMPC_WITH_RATES ? u_prev[i] : 0);
    koopmpc_fail(s, known && koopmpc_usable(free_input, NV) ? free_input : 0, applied, u, report, status);
#if KOOPMPC_ESTIMATOR == 1
    if (status == KOOPMPC_FAILED && !s->refused) koopmpc_forget(s);
#endif
    if (status == KOOPMPC_FAILED && runs_away(s, stage, u_prev)) report->status = KOOPMPC_BAD_MEASUREMENT;
    return;
  }
  s->warm = 1;
  report->slack = s->slack;
  trajectory(s, s->draftX, s->kept);
  if (KOOPMPC_HARD_RATES) {
    koopmpc_admit(s, s->kept, koopmpc_hard_rates_low, koopmpc_hard_rates_high, u_prev);
    for (int i = 0; i < NV && conflict; i++) {
      const koopmpc_real change = s->kept[i] - u_prev[i];
      const koopmpc_real over = change - koopmpc_hard_rates_high[i], under = koopmpc_hard_rates_low[i] - change;
      if (over > report->slack) report->slack = over;
      if (under > report->slack) report->slack = under;
    }
  } else {
    conflict = 0;
  }
  koopmpc_keep(s, s->kept, u, report, conflict ? KOOPMPC_SOFTENED : status);
}

int koopmpc_plan_states(const koopmpc_state *s, koopmpc_real *X) {
  for (int k = 0; k <= STEPS && s->planned; k++) koopmpc_copy(X + k * KOOPMPC_NX, s->S + k * NS, KOOPMPC_NX);
  return s->planned;
}
