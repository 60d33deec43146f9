/**
 * @file koopmpc_condensed.c
 * @brief A predictive controller: the unconstrained plan first, a quadratic program only where a limit is active.
 *
 * t = M [z; u_{-1}; w; d] + (a part of the reference) is the unconstrained plan. If it meets every limit it is the
 * optimum. Otherwise DAQP finds the least deviation from it inside the limits; if that fails a fallback acts.
 */
#include <math.h>

#include "koopmpc_condensed_tables.h"
#include "koopmpc_step.h"

#if KOOPMPC_BOUNDS
#define UNPUSHED(s) (s)->unpushed
#define MOVE_LOW(s) (s)->box_low
#define MOVE_HIGH(s) (s)->box_high
#else
#define UNPUSHED(s) KOOPMPC_UNPUSHED
#define MOVE_LOW(s) koopmpc_low
#define MOVE_HIGH(s) koopmpc_high
#endif
#define MOVES KOOPMPC_MOVES
#define PLANNED KOOPMPC_PLANNED
#define ROWS KOOPMPC_QP_M

/* sums and maxima side by side, where a processor does several at once; others lose time with it */
#if defined(__SSE2__) || defined(_M_X64) || defined(__ARM_NEON) || defined(__aarch64__)
enum { LANES = 8 };
#else
enum { LANES = 1 };
#endif

/** The largest of |a|. */
static koopmpc_real largest(const koopmpc_real *a, int n) {
  koopmpc_real most[LANES] = {0}, result = 0;
  int j = 0;
  for (; j + LANES <= n; j += LANES)
    for (int i = 0; i < LANES; i++) most[i] = koopmpc_abs(a[j + i]) > most[i] ? koopmpc_abs(a[j + i]) : most[i];
  for (; j < n; j++) result = koopmpc_abs(a[j]) > result ? koopmpc_abs(a[j]) : result;
  for (int i = 0; i < LANES; i++) result = most[i] > result ? most[i] : result;
  return result;
}

enum { MOVING = 1, HELD }; /* whether the rows of the last reference were the same */

/**
 * Write the reference's part of the plan: all NaN if a row is not finite.
 *
 * Of a long preview write that of its first row alone, as if it were held, and return 1, and in `reach` the largest
 * distance of a row from it: a step may need no more.
 */
static int aim(koopmpc_state *s, const koopmpc_rows *reference, koopmpc_real *reach) {
  enum { NR = KOOPMPC_NR, SIZE = (KOOPMPC_N + 1) * NR };
  const int moves_on = s->row + 1 < KOOPMPC_GIVEN_LENGTH;
  const int last = reference->count - 1, after = last - KOOPMPC_LATENCY, there = after < KOOPMPC_N ? after : KOOPMPC_N;
  int good = 1, same = 1, held = 1; /* held: all rows are the same */
  int first_alone = 0;
  koopmpc_real peak, ahead[SIZE];
  *reach = 0;
  if (s->aimed == HELD && reference->count == 1 && koopmpc_same(reference->values, s->reference, NR)) return 0;
  for (int j = 0; j < (there + 1) * NR; j++) ahead[j] = reference->values[KOOPMPC_LATENCY * NR + j];
  for (int k = there < 0 ? 0 : there + 1; k <= KOOPMPC_N; k++)
    koopmpc_copy(ahead + k * NR, reference->values + last * NR, NR);
  for (int j = 0; j < SIZE; j++) same &= s->reference[j] == ahead[j];
  for (int j = 0; j < SIZE; j++) good &= koopmpc_abs(ahead[j]) < KOOPMPC_HUGE;
  for (int j = NR; j < SIZE; j++) held &= ahead[j] == ahead[j - NR];
  koopmpc_copy(s->reference, ahead, SIZE);
  peak = largest(ahead, SIZE);
#if KOOPMPC_FIRST_ALONE
  for (int k = 0; k <= KOOPMPC_N && !held; k++)
    for (int i = 0; i < NR; i++) s->apart[k * NR + i] = ahead[k * NR + i] - ahead[i];
  if (!held) *reach = largest(s->apart, SIZE);
#endif
#if KOOPMPC_BOUNDS
  s->peak = peak;
#endif
  if (!same || !s->aimed) {
    first_alone = KOOPMPC_FIRST_ALONE && good && !held && !same && peak <= UNPUSHED(s);
    s->aimed = !good || moves_on || first_alone ? 0 : held ? HELD : MOVING;
    if (!good) {
      koopmpc_fill(s->column, (koopmpc_real)NAN, KOOPMPC_NT);
    } else {
      /* of given input targets the table holds each step's share, with the offset */
      koopmpc_copy(s->column, KOOPMPC_GIVEN_TABLED ? koopmpc_from_given + s->row * PLANNED : koopmpc_offset, PLANNED);
      if (held || first_alone)
        koopmpc_add(s->column, koopmpc_from_held, PLANNED, s->reference, KOOPMPC_NR);
      else
        koopmpc_add(s->column, koopmpc_from_reference, PLANNED, s->reference, (KOOPMPC_N + 1) * KOOPMPC_NR);
#if KOOPMPC_GIVEN && !KOOPMPC_GIVEN_TABLED
      for (int k = 0; k <= KOOPMPC_N; k++) {
        koopmpc_real given[KOOPMPC_NU];
        koopmpc_give_input(s, k, given);
        koopmpc_add(s->column, koopmpc_from_given + k * KOOPMPC_NU * PLANNED, PLANNED, given, KOOPMPC_NU);
      }
#endif
#if KOOPMPC_AIMED
      koopmpc_real nearest[KOOPMPC_NA + 1];
#if !KOOPMPC_DISTURBANCE_WIDTH
      koopmpc_real alpha[KOOPMPC_NA + 1];
      int moved = 0; /* whether a limit moves the target of this row, which the column holds as if there were none */
#endif
      /* no limit moves a target of rows as small as this */
      const int rows = !KOOPMPC_DISTURBANCE_WIDTH && peak <= UNPUSHED(s) ? 0 : KOOPMPC_N + 1;
      for (int k = 0; k < rows; k++) {
        const koopmpc_real *row = s->reference + k * KOOPMPC_NR;
        const int repeated = k > 0 && koopmpc_same(row, row - NR, NR);
#if KOOPMPC_DISTURBANCE_WIDTH /* checked when the disturbance is known */
        if (!repeated) koopmpc_nearest(row, 0, nearest);
#else
        if ((KOOPMPC_BOUNDS || !repeated) && (moved = koopmpc_target_within(s, k, row, 0, alpha))) {
          koopmpc_nearest(row, 0, nearest);
          for (int i = 0; i < KOOPMPC_NA; i++) alpha[i] -= nearest[i];
        }
        if (moved) koopmpc_add(s->column, koopmpc_from_target + k * KOOPMPC_NA * PLANNED, PLANNED, alpha, KOOPMPC_NA);
#endif
#if KOOPMPC_CHECKED_COUNT
        koopmpc_real value[KOOPMPC_NL] = {0}, *lowest = s->column + PLANNED, *highest = lowest + KOOPMPC_CHECKED_COUNT;
        koopmpc_add(value, koopmpc_targets_rows, KOOPMPC_NL, nearest, KOOPMPC_NA);
        for (int i = 0; i < KOOPMPC_NL; i++) {
          if (!koopmpc_checked[i]) continue;
          *lowest = k > 0 && *lowest < value[i] ? *lowest : value[i];
          *highest = k > 0 && *highest > value[i] ? *highest : value[i];
          lowest++;
          highest++;
        }
#endif
      }
#endif
    }
  }
  if (moves_on) s->row++;
  return first_alone;
}

/** Whether entries first ... last - 1 of the plan are within their limits; NaN is not. */
static int within(const koopmpc_state *s, int first, int last) {
  const koopmpc_real *t = s->t, *low = KOOPMPC_PLAN_LOW(s), *high = KOOPMPC_PLAN_HIGH(s);
  int broken = 0;
  for (int i = first; i < last; i++) broken |= !(t[i] >= low[i]) | !(t[i] <= high[i]);
  return !broken;
}

static void evaluate(koopmpc_state *s) {
  koopmpc_copy(s->t, s->column, KOOPMPC_NT);
  koopmpc_add(s->t, koopmpc_M, KOOPMPC_NT, s->known, KOOPMPC_KNOWN);
}

#if KOOPMPC_FIRST_ALONE
void koopmpc_settle(const koopmpc_state *s, koopmpc_real *kept) {
  for (int j = KOOPMPC_NR; j < (KOOPMPC_N + 1) * KOOPMPC_NR; j++)
    for (int i = KOOPMPC_NU; i < MOVES; i++) kept[i] += s->moved[j] * koopmpc_from_reference[j * PLANNED + i];
}

static koopmpc_real sum_products(const koopmpc_real *a, const koopmpc_real *b) {
  enum { SIZE = KOOPMPC_N * KOOPMPC_NR };
  koopmpc_real sums[LANES] = {0}, result = 0;
  int j = 0;
  for (; j + LANES <= SIZE; j += LANES)
    for (int i = 0; i < LANES; i++) sums[i] += a[j + i] * b[j + i];
  for (; j < SIZE; j++) result += a[j] * b[j];
  for (int i = 0; i < LANES; i++) result += sums[i];
  return result;
}

/** Whether a plan for the first row meets all limits wherever the others are within `reach` of it; then its input. */
static int certain(koopmpc_state *s, koopmpc_real reach) {
  const koopmpc_real *low = KOOPMPC_PLAN_LOW(s), *high = KOOPMPC_PLAN_HIGH(s);
  koopmpc_real first[KOOPMPC_NU];
  int broken = 0;
  for (int i = 0; i < PLANNED; i++) {
    const koopmpc_real by = reach * koopmpc_shares[i];
    broken |= !(s->t[i] - by >= low[i]) | !(s->t[i] + by <= high[i]);
  }
  koopmpc_copy(first, s->t, KOOPMPC_NU);
  for (int i = 0; i < KOOPMPC_NU && !broken; i++)
    first[i] += sum_products(s->apart + KOOPMPC_NR, koopmpc_first_shares + i * KOOPMPC_N * KOOPMPC_NR);
  for (int i = 0; i < KOOPMPC_NU; i++) broken |= !(first[i] >= low[i]) | !(first[i] <= high[i]);
  if (!broken) koopmpc_copy(s->t, first, KOOPMPC_NU);
  return !broken;
}
#endif

/** Whether a plan that meets all limits is on levels, where its inputs have some. */
#if KOOPMPC_LEVELS
static int rests(koopmpc_state *s) { return koopmpc_accept_levels(s); }
#else
static int rests(const koopmpc_state *s) { return (void)s, 1; }
#endif

static void unconstrained(koopmpc_state *s, koopmpc_real *u, koopmpc_report *report) {
  s->warm = 0;
  koopmpc_keep(s, s->t, u, report, KOOPMPC_UNCONSTRAINED);
}

#if KOOPMPC_QP_M > 0

static const koopmpc_qp problem = {MOVES, ROWS, KOOPMPC_QP_SOFT, KOOPMPC_STEEP, koopmpc_solver_M,
                                   koopmpc_solver_scaling, 0, koopmpc_solver_sense, koopmpc_solver_linear,
                                   koopmpc_solver_rho};

/** The limits of row i of the QP. */
#if KOOPMPC_BOUNDS
static koopmpc_real row_limit(const koopmpc_real *plan, const koopmpc_real *opened, int i) {
  const int at = koopmpc_qp_source[i], change = KOOPMPC_CHANGES && at >= MOVES && at < 2 * MOVES;
  return (change ? opened[at - MOVES] : plan[at]) * koopmpc_qp_scale[i];
}
static koopmpc_real row_low(const koopmpc_state *s, int i) { return row_limit(s->low, s->opened_low, i); }
static koopmpc_real row_high(const koopmpc_state *s, int i) { return row_limit(s->high, s->opened_high, i); }
#else
static koopmpc_real row_low(const koopmpc_state *s, int i) { return (void)s, koopmpc_qp_low[i]; }
static koopmpc_real row_high(const koopmpc_state *s, int i) { return (void)s, koopmpc_qp_high[i]; }
#endif

/** Set the limits of a solve: distances from the plan. A rate limit widens if it excludes the input limits. */
static koopmpc_real set_limits(const koopmpc_state *s, koopmpc_qp_memory *qp) {
  koopmpc_real conflict = 0;
  for (int i = 0; i < ROWS; i++) {
    qp->low[i] = row_low(s, i);
    qp->high[i] = row_high(s, i);
  }
#if KOOPMPC_HARD_RATES
  for (int j = 0; j < KOOPMPC_QP_RATE_ROWS_LENGTH; j++) { /* hard, but the limit of the input has precedence */
    const int i = koopmpc_qp_rate_rows[j], which = koopmpc_qp_rate_inputs[j];
    const koopmpc_real last = s->known[KOOPMPC_U_PREV + which], scale = koopmpc_qp_scale[i];
    const koopmpc_real highest = (KOOPMPC_BOX_HIGH(s)[which] - last) * scale;
    const koopmpc_real lowest = (KOOPMPC_BOX_LOW(s)[which] - last) * scale;
    koopmpc_real past = 0;
    if (highest < qp->low[i]) past += qp->low[i] - highest, qp->low[i] = highest;
    if (lowest > qp->high[i]) past += lowest - qp->high[i], qp->high[i] = lowest;
    past /= scale;
    if (past > (koopmpc_real)1e-5 * koopmpc_qp_softness_allowance[i] && past > conflict) conflict = past;
  }
#endif
  for (int i = 0; i < ROWS; i++) {
    const koopmpc_real moved = s->t[koopmpc_qp_source[i]] * koopmpc_qp_scale[i];
    qp->low[i] = koopmpc_clip(qp->low[i] - moved, -KOOPMPC_HUGE, KOOPMPC_HUGE) * koopmpc_solver_rows[i];
    qp->high[i] = koopmpc_clip(qp->high[i] - moved, -KOOPMPC_HUGE, KOOPMPC_HUGE) * koopmpc_solver_rows[i];
  }
  return conflict;
}

#if KOOPMPC_LEVELS
/** Put the plan on the best sequence of levels; writes how far a limit gave way. */
static koopmpc_status solve(koopmpc_state *s, koopmpc_qp_memory *qp, koopmpc_report *report) {
  const koopmpc_real opened = koopmpc_open_rates(s);
  const koopmpc_real conflict = set_limits(s, qp);
  report->slack = conflict > opened ? conflict : opened;
  return koopmpc_search_levels(s, qp->low, qp->high, report);
}
#else
#if KOOPMPC_STEEP
/**
 * Solve by proximal points: x <- least 0.5 |x|^2 + 0.5 c |A (x - last)|^2 within the limits, A the hard rows.
 *
 * In plans of unstable plants some combinations of hard rows need an x a million times as large as others; DAQP then
 * mistakes independent rows for dependent ones. The added weight makes the rows alike, and two or three steps lead to
 * the solution. In the basis V of A'A, x = V a, each of these problems is a least-distance problem.
 */
static koopmpc_status approach(koopmpc_state *s, koopmpc_qp_memory *qp, const koopmpc_real *push, int *iterations) {
  enum { PASSES = 20 };
  koopmpc_real *M = s->eased, *scaling = M + ROWS * MOVES, *linear = scaling + ROWS, *rho = linear + ROWS;
  koopmpc_real *rows = rho + ROWS, weight = (koopmpc_real)1e7, least = 0, missed = KOOPMPC_HUGE, unit = 1;
  koopmpc_real stretch[MOVES], centre[MOVES], pull[MOVES], a[MOVES];
  const koopmpc_qp eased = {MOVES, ROWS, KOOPMPC_QP_SOFT, 1, M, scaling, 0, koopmpc_solver_sense, linear, rho};
  koopmpc_status status = KOOPMPC_INFEASIBLE;
  int active = 0;
  koopmpc_copy(rows, push, ROWS);
  koopmpc_fill(centre, 0, MOVES);
  for (int pass = 0; pass < PASSES; pass++) {
    koopmpc_qp_end end;
    unit = 1 + weight;
    for (int j = 0; j < MOVES; j++) {
      stretch[j] = KOOPMPC_SQRT(unit / (1 + weight * koopmpc_solver_lambda[j]));
      pull[j] = -stretch[j] * weight * koopmpc_solver_lambda[j] * centre[j] / unit;
    }
    for (int i = 0; i < ROWS; i++) {
      koopmpc_real square = 0;
      for (int j = 0; j < MOVES; j++) {
        M[i * MOVES + j] = koopmpc_solver_MV[i * MOVES + j] * stretch[j];
        square += M[i * MOVES + j] * M[i * MOVES + j];
      }
      scaling[i] = square < (koopmpc_real)1e-11 ? 1 : 1 / KOOPMPC_SQRT(square);
      for (int j = 0; j < MOVES; j++) M[i * MOVES + j] *= scaling[i];
      linear[i] = koopmpc_solver_linear[i] / unit;
      rho[i] = koopmpc_solver_rho[i] * unit;
    }
    (void)set_limits(s, qp);
    for (int i = 0; i < ROWS; i++) {
      const koopmpc_real shift = koopmpc_dot(M + i * MOVES, pull, MOVES) / scaling[i];
      qp->low[i] += shift;
      qp->high[i] += shift;
    }
    end = koopmpc_qp_solve(&eased, qp, rows, 0, 0);
    *iterations += end.iterations;
    if (end.flag <= 0) {
      end = koopmpc_qp_solve(&eased, qp, 0, KOOPMPC_WIDER, 0);
      *iterations += end.iterations;
    }
    if (end.flag > 0) {
      koopmpc_real before = missed, size = (koopmpc_real)1e-30;
      for (int j = 0; j < MOVES; j++) a[j] = stretch[j] * (qp->primal[j] - pull[j]);
      missed = 0;
      for (int i = 0; i < MOVES; i++) {
        koopmpc_real x = 0, moved = 0, pushed = 0;
        for (int j = 0; j < MOVES; j++) {
          x += koopmpc_solver_V[i * MOVES + j] * a[j];
          moved += koopmpc_solver_V[i * MOVES + j] * koopmpc_solver_lambda[j] * (a[j] - centre[j]);
        }
        for (int k = 0; k < ROWS; k++)
          if (qp->dual[k] < 0 || qp->dual[k] > 0)
            pushed += qp->dual[k] * unit * koopmpc_solver_M[k * MOVES + i] / koopmpc_solver_scaling[k];
        qp->primal[i] = x;
        if (koopmpc_abs(moved) > missed) missed = koopmpc_abs(moved);
        if (koopmpc_abs(x) > size) size = koopmpc_abs(x);
        if (koopmpc_abs(pushed) > size) size = koopmpc_abs(pushed);
      }
      missed *= weight / size;
      status = missed <= KOOPMPC_ACCURACY ? KOOPMPC_OPTIMAL : KOOPMPC_MAX_ITERATIONS;
      if (status == KOOPMPC_OPTIMAL) break;
      koopmpc_copy(centre, a, MOVES);
      koopmpc_copy(rows, qp->dual, ROWS);
      if (missed > (koopmpc_real)0.1 * before) weight = weight / 10 > least ? weight / 10 : least;
    } else {
      status = koopmpc_qp_status(end);
      if (weight > (koopmpc_real)1e9) break;
      least = weight *= 10;
    }
  }
  for (int i = 0; i < ROWS; i++) {
    qp->dual[i] *= unit;
    active += qp->dual[i] < 0 || qp->dual[i] > 0;
    qp->product[i] = koopmpc_dot(koopmpc_solver_M + i * MOVES, qp->primal, MOVES) / koopmpc_solver_scaling[i];
  }
  s->far = status == KOOPMPC_OPTIMAL && 2 * active > MOVES;
  return status;
}
#endif

/** The multiplier of row i in the last answer, shifted by one step. */
static koopmpc_real shifted(const koopmpc_state *s, int i) {
  return s->warm && koopmpc_qp_shift_dual[i] < ROWS ? s->dual[koopmpc_qp_shift_dual[i]] : 0;
}

/** Whether few rows are active, or few change where a step moves them on; then DAQP goes on from those that it holds. */
static int lasts(const koopmpc_state *s) {
  int active = 0, changed = 0;
  for (int i = 0; i < ROWS; i++) active += s->dual[i] < 0 || s->dual[i] > 0;
  if (active <= KOOPMPC_FEW) return 1;
  for (int i = 0; i < ROWS; i++) {
    const koopmpc_real now = s->dual[i], next = shifted(s, i);
    changed += (now > 0) != (next > 0) || (now < 0) != (next < 0);
  }
  return changed <= KOOPMPC_MOVED;
}

/**
 * Put the moves that hard limits or rates determine where these say: soft rows missed by far push by 1e12 and more, and
 * rounding of their sum would be 1e-4 of an input's range.
 */
static void meet_limits(koopmpc_state *s, const koopmpc_real *dual) {
  koopmpc_real change[MOVES] = {0};
  int known[MOVES] = {0}, follows[MOVES] = {0};
  for (int i = 0; i < ROWS; i++) {
    const int at = koopmpc_qp_source[i];
    if (!(dual[i] < 0 || dual[i] > 0)) continue;
    if (at < MOVES) {
      s->t[at] = (dual[i] > 0 ? KOOPMPC_PLAN_HIGH(s) : KOOPMPC_PLAN_LOW(s))[at];
      known[at] = 1;
    } else if (KOOPMPC_HARD_RATES && at < 2 * MOVES && !koopmpc_solver_sense[i]) {
      change[at - MOVES] = (dual[i] > 0 ? row_high(s, i) : row_low(s, i)) / koopmpc_qp_scale[i];
      follows[at - MOVES] = 1;
    }
  }
  for (int j = 0; j < MOVES; j++) {
    if (!follows[j] || known[j] || !(j < KOOPMPC_NU || known[j - KOOPMPC_NU])) continue;
    s->t[j] = (j < KOOPMPC_NU ? s->known[KOOPMPC_U_PREV + j] : s->t[j - KOOPMPC_NU]) + change[j];
    known[j] = 1;
  }
  for (int j = MOVES - 1; j >= KOOPMPC_NU; j--) {
    if (!follows[j] || !known[j] || known[j - KOOPMPC_NU]) continue;
    s->t[j - KOOPMPC_NU] = s->t[j] - change[j];
    known[j - KOOPMPC_NU] = 1;
  }
}

/** Find the least deviation from the plan inside the limits; writes how far a limit gave way. */
static koopmpc_status solve(koopmpc_state *s, koopmpc_qp_memory *qp, koopmpc_report *report) {
  koopmpc_real push[KOOPMPC_QP_M1], conflict;
  const int resume = s->warm && s->resumes && lasts(s);
  koopmpc_status status = KOOPMPC_FAILED;
  int good = 0;
#if KOOPMPC_SETTINGS_COLD_START
  s->far = s->unmet = 0;
#endif
  s->resumes = 0;
  for (int i = 0; i < ROWS; i++) push[i] = resume ? 0 : shifted(s, i);
  const koopmpc_real opened = koopmpc_open_rates(s);
  conflict = set_limits(s, qp);
  if (!resume && s->unmet) {
    s->unmet = koopmpc_qp_contradicts(&problem, qp);
    if (s->unmet) return KOOPMPC_INFEASIBLE;
  }
  if (resume || !s->far) {
    const koopmpc_qp_end end = koopmpc_qp_find(&problem, qp, resume ? 0 : push, resume, &good);
    report->iterations += end.iterations;
    s->resumes = good == 1;
    s->unmet = qp->hard_alone;
    status = koopmpc_qp_status(end);
  }
#if KOOPMPC_STEEP
  if (!good) {
    status = approach(s, qp, push, &report->iterations);
    good = status == KOOPMPC_OPTIMAL;
  }
#endif
  if (!good) return status;
  report->slack = conflict > opened ? conflict : opened;
  for (int i = 0; i < ROWS; i++) {
    const koopmpc_real dual = qp->dual[i];
    if (koopmpc_solver_sense[i] && (dual < 0 || dual > 0) && koopmpc_abs(dual) >= (1 - KOOPMPC_ROUNDING) * koopmpc_solver_linear[i]) {
      const koopmpc_real unit = koopmpc_solver_rows[i] * koopmpc_qp_scale[i];
      const koopmpc_real value = qp->product[i] / unit + s->t[koopmpc_qp_source[i]];
      const koopmpc_real over = value - row_high(s, i) / koopmpc_qp_scale[i];
      const koopmpc_real under = row_low(s, i) / koopmpc_qp_scale[i] - value;
      const koopmpc_real past = over > under ? over : under;
      if (past > koopmpc_qp_softness_allowance[i] && past > report->slack) report->slack = past;
    }
  }
  koopmpc_copy(s->dual, qp->dual, ROWS);
  s->warm = !KOOPMPC_SETTINGS_COLD_START;
  return KOOPMPC_OPTIMAL;
}
#endif
#endif

/** A step in which the plan or its target breaks a limit, or something is not finite. */
static void limited(koopmpc_state *s, const koopmpc_real *applied, koopmpc_real *u, koopmpc_report *report) {
  int changed = KOOPMPC_WITH_RATES && !koopmpc_usable(s->known + KOOPMPC_U_PREV, KOOPMPC_NU);
  if (changed) { /* the applied input was reported as NaN or huge: take the last one returned instead */
    koopmpc_copy(s->known + KOOPMPC_U_PREV, s->given, KOOPMPC_NU);
    evaluate(s);
  }
  if (!koopmpc_usable(s->t, KOOPMPC_NT)) {
    koopmpc_fail(s, 0, applied, u, report, KOOPMPC_BAD_MEASUREMENT);
    return;
  }
#if KOOPMPC_CHECKED_COUNT
  if (!within(s, PLANNED, KOOPMPC_NT)) { /* the disturbance moves a target outside its limits: take the nearest one inside */
    koopmpc_real e[KOOPMPC_NZ], alpha[KOOPMPC_NA + 1], nearest[KOOPMPC_NA + 1];
    koopmpc_fill(e, 0, KOOPMPC_NZ);
    koopmpc_add(e, koopmpc_disturbance, KOOPMPC_NZ, s->known + KOOPMPC_PREVIEW, KOOPMPC_DRIVEN);
    for (int k = 0; k <= KOOPMPC_N; k++) {
      const koopmpc_real *row = s->reference + k * KOOPMPC_NR;
      const int repeated = k > 0 && koopmpc_same(row, row - KOOPMPC_NR, KOOPMPC_NR);
      if (KOOPMPC_BOUNDS || !repeated) {
        koopmpc_nearest(row, e, nearest);
        koopmpc_target_within(s, k, row, e, alpha);
        for (int i = 0; i < KOOPMPC_NA; i++) alpha[i] -= nearest[i];
      }
      koopmpc_add(s->t, koopmpc_from_target + k * KOOPMPC_NA * PLANNED, PLANNED, alpha, KOOPMPC_NA);
    }
    changed = 1;
  }
#endif
  if (changed && within(s, 0, PLANNED) && rests(s)) {
    unconstrained(s, u, report);
    return;
  }
#if KOOPMPC_QP_M > 0
  {
    koopmpc_qp_memory qp = koopmpc_qp_on(&problem, s->qp_reals, s->qp_ints);
    const koopmpc_status status = solve(s, &qp, report);
    if (status != KOOPMPC_OPTIMAL) {
      koopmpc_real free_input[KOOPMPC_NU];
      koopmpc_copy(free_input, s->t, KOOPMPC_NU);
      koopmpc_fail(s, free_input, applied, u, report, status);
      return;
    }
#if KOOPMPC_LEVELS
    koopmpc_keep(s, s->t, u, report, report->gap > 0 ? KOOPMPC_TIME_LIMIT : report->slack > 0 ? KOOPMPC_SOFTENED : KOOPMPC_OPTIMAL);
    return;
#else
    koopmpc_add(s->t, koopmpc_deviation, MOVES, qp.primal, MOVES);
    if (report->slack > 0) meet_limits(s, qp.dual);
    for (int i = 0; i < MOVES; i++) s->t[i] = koopmpc_clip(s->t[i], MOVE_LOW(s)[i], MOVE_HIGH(s)[i]);
#if KOOPMPC_HARD_RATES && KOOPMPC_BOUNDS
    koopmpc_real low[KOOPMPC_NU], high[KOOPMPC_NU];
    for (int i = 0; i < KOOPMPC_NU; i++) {
      low[i] = koopmpc_bounds_hard[i] ? s->rate_low[i] : -KOOPMPC_HUGE;
      high[i] = koopmpc_bounds_hard[i] ? s->rate_high[i] : KOOPMPC_HUGE;
    }
    koopmpc_admit(s, s->t, low, high, s->known + KOOPMPC_U_PREV);
#elif KOOPMPC_HARD_RATES
    koopmpc_admit(s, s->t, koopmpc_hard_rates_low, koopmpc_hard_rates_high, s->known + KOOPMPC_U_PREV);
#endif
    koopmpc_keep(s, s->t, u, report, report->slack > 0 ? KOOPMPC_SOFTENED : KOOPMPC_OPTIMAL);
#endif
  }
#else
  koopmpc_fail(s, s->t, applied, u, report, KOOPMPC_FAILED);
#endif
}

void koopmpc_decide(koopmpc_state *s, const koopmpc_rows *reference, const koopmpc_real *applied, koopmpc_real *u,
                    koopmpc_report *report) {
  koopmpc_real reach;
  const int first_alone = aim(s, reference, &reach);
#if KOOPMPC_LEVELS
  koopmpc_count_levels(s, applied && !KOOPMPC_LATENCY && koopmpc_usable(applied, KOOPMPC_NU) ? applied : s->given);
#endif
  evaluate(s);
#if KOOPMPC_FIRST_ALONE
  if (first_alone && certain(s, reach)) {
    unconstrained(s, u, report);
    koopmpc_copy(s->moved, s->apart, (KOOPMPC_N + 1) * KOOPMPC_NR);
    s->owes = 1;
    return;
  }
  if (first_alone) { /* a limit may be met: the whole plan */
    koopmpc_add(s->column, koopmpc_from_reference + KOOPMPC_NR * PLANNED, PLANNED, s->apart + KOOPMPC_NR,
                KOOPMPC_N * KOOPMPC_NR);
    evaluate(s);
  }
#else
  (void)first_alone;
#endif
  if (within(s, 0, KOOPMPC_NT) && rests(s))
    unconstrained(s, u, report);
  else
    limited(s, applied, u, report);
}
