/** @file koopmpc_step.h @brief What the files of a controller share: vectors, limits, the solver, and the parts of a step. */
#ifndef KOOPMPC_STEP_H
#define KOOPMPC_STEP_H

#include "koopmpc.h"
#include "koopmpc_tables.h"

#define KOOPMPC_HUGE ((koopmpc_real)1e30)

static inline koopmpc_real koopmpc_abs(koopmpc_real a) { return a < 0 ? -a : a; }

/** Whether all entries are numbers below 1e30 in size. */
static inline int koopmpc_usable(const koopmpc_real *a, int n) {
  int good = 1;
  for (int i = 0; i < n; i++) good &= koopmpc_abs(a[i]) < KOOPMPC_HUGE;
  return good;
}

/** The larger of `most` and |value|; NaN stays. */
static inline koopmpc_real koopmpc_most(koopmpc_real most, koopmpc_real value) {
  value = koopmpc_abs(value);
  return value <= most || !(most >= 0) ? most : value;
}

/** The largest of |a|. */
static inline koopmpc_real koopmpc_largest(const koopmpc_real *a, int n) {
  koopmpc_real most = 0;
  for (int i = 0; i < n; i++) most = koopmpc_most(most, a[i]);
  return most;
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

/** Whether all entries are equal; NaN equals nothing. */
static inline int koopmpc_same(const koopmpc_real *a, const koopmpc_real *b, int n) {
  int same = 1;
  for (int i = 0; i < n; i++) same &= a[i] == b[i];
  return same;
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

/** Where the parts of `known` start. */
enum {
  KOOPMPC_U_PREV = KOOPMPC_NZ,
  KOOPMPC_PREVIEW = KOOPMPC_NZ + KOOPMPC_NU * KOOPMPC_WITH_RATES,
  KOOPMPC_DRIFT = KOOPMPC_PREVIEW + KOOPMPC_N * KOOPMPC_NW,
  KOOPMPC_DRIVEN = KOOPMPC_KNOWN - KOOPMPC_PREVIEW
};

#if KOOPMPC_GATE
/** [whether y is refused; whether readings are used again; the new memory]. */
void koopmpc_gate(const koopmpc_real *y, const koopmpc_real *predicted, const koopmpc_real *memory,
                  koopmpc_real *result);
#endif

/** Begin the estimates of a state and of a disturbance at x0; NULL for zero. */
void koopmpc_start_observer(koopmpc_state *s, const koopmpc_real *x0);

/** Write the start of the plan into `known`; z is NaN if y cannot be used. */
void koopmpc_observe(koopmpc_state *s, const koopmpc_real *y, const koopmpc_real *applied, const koopmpc_rows *w);

#if KOOPMPC_ESTIMATOR == 1
/** Forget the disturbance and all misfits, but not the last state. */
void koopmpc_forget(koopmpc_state *s);
#endif

/** Find the input of a step from `known`, by the law of the controller. */
void koopmpc_decide(koopmpc_state *s, const koopmpc_rows *reference, const koopmpc_real *applied, koopmpc_real *u,
                    koopmpc_report *report);

#if KOOPMPC_FIRST_ALONE
/** Write all inputs of a plan of which a step needed the first alone. */
void koopmpc_settle(const koopmpc_state *s, koopmpc_real *kept);
#endif

#if KOOPMPC_GIVEN
/** Write the input target of the k-th step from now. */
void koopmpc_give_input(const koopmpc_state *s, int k, koopmpc_real *u);
#endif

/** Keep a plan, and take its first input. */
void koopmpc_keep(koopmpc_state *s, const koopmpc_real *plan, koopmpc_real *u, koopmpc_report *report,
                  koopmpc_status status);

/** Write the fallback of a failed step; `free_input` is the unconstrained optimum, NULL if it is not known. */
void koopmpc_fail(koopmpc_state *s, const koopmpc_real *free_input, const koopmpc_real *applied, koopmpc_real *u,
                  koopmpc_report *report, koopmpc_status status);

/** Clip the change of u since `last` to (low, high), unless `low` is NULL; then clip u to the limits of this step. */
void koopmpc_admit(const koopmpc_state *s, koopmpc_real *u, const koopmpc_real *low, const koopmpc_real *high,
                   const koopmpc_real *last);

/** Coordinates of the target nearest to r, without limits; disturbances add e to z, NULL for none. */
void koopmpc_nearest(const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha);

/** The same inside the limits of row k; 1 if they moved it. */
int koopmpc_target_within(koopmpc_state *s, int k, const koopmpc_real *r, const koopmpc_real *e, koopmpc_real *alpha);

/** The limits of a step: those that move in time, or those of the controller. */
#if KOOPMPC_BOUNDS
#define KOOPMPC_PLAN_LOW(s) (s)->low
#define KOOPMPC_PLAN_HIGH(s) (s)->high
#if KOOPMPC_IS_STAGED
#define KOOPMPC_BOX_LOW(s) (s)->box_low
#define KOOPMPC_BOX_HIGH(s) (s)->box_high
#else
#define KOOPMPC_BOX_LOW(s) (s)->now_low
#define KOOPMPC_BOX_HIGH(s) (s)->now_high
#endif
#define KOOPMPC_STAGE_BOX_LOW(s, k) ((s)->box_low + (k) * KOOPMPC_NU)
#define KOOPMPC_STAGE_BOX_HIGH(s, k) ((s)->box_high + (k) * KOOPMPC_NU)
#define KOOPMPC_TARGET_LOW(s, k) ((s)->target_low + (k) * KOOPMPC_NL)
#define KOOPMPC_TARGET_HIGH(s, k) ((s)->target_high + (k) * KOOPMPC_NL)

/** Take the limits of the controller itself. */
void koopmpc_reset_bounds(koopmpc_state *s);

/** A bound of a row, at most KOOPMPC_HUGE in size. */
static inline koopmpc_real koopmpc_bound_of(const koopmpc_rows *rows, int k, int width, int i) {
  return koopmpc_clip(koopmpc_row(rows, k, width)[i], -KOOPMPC_HUGE, KOOPMPC_HUGE);
}
#else
#if KOOPMPC_IS_STAGED
#define KOOPMPC_PLAN_LOW(s) koopmpc_stage_limits_low
#define KOOPMPC_PLAN_HIGH(s) koopmpc_stage_limits_high
#else
#define KOOPMPC_PLAN_LOW(s) koopmpc_low
#define KOOPMPC_PLAN_HIGH(s) koopmpc_high
#endif
#define KOOPMPC_BOX_LOW(s) koopmpc_inputs_low
#define KOOPMPC_BOX_HIGH(s) koopmpc_inputs_high
#define KOOPMPC_STAGE_BOX_LOW(s, k) koopmpc_inputs_low
#define KOOPMPC_STAGE_BOX_HIGH(s, k) koopmpc_inputs_high
#define KOOPMPC_TARGET_LOW(s, k) koopmpc_targets_low
#define KOOPMPC_TARGET_HIGH(s, k) koopmpc_targets_high
#endif

#if KOOPMPC_BOUNDS && !KOOPMPC_IS_STAGED
#define KOOPMPC_RATES_LOW(s) (s)->rate_low
#define KOOPMPC_RATES_HIGH(s) (s)->rate_high

/** Widen hard rates of later moves as far as the limits of the inputs need; return by how much at most. */
koopmpc_real koopmpc_open_rates(koopmpc_state *s);
#else
static inline koopmpc_real koopmpc_open_rates(koopmpc_state *s) { return (void)s, (koopmpc_real)0; }
#define KOOPMPC_RATES_LOW(s) koopmpc_rates_low
#define KOOPMPC_RATES_HIGH(s) koopmpc_rates_high
#endif

#if KOOPMPC_LEVELS
/** Start at the input u, from which each input may change at once. */
void koopmpc_start_levels(koopmpc_state *s, const koopmpc_real *u);

/** Count one step of the input u that acted. */
void koopmpc_count_levels(koopmpc_state *s, const koopmpc_real *u);

/** Put u on the nearest levels that dwell times and the rates since `before` allow; the limits of u win. */
void koopmpc_round_levels(const koopmpc_state *s, koopmpc_real *u, const koopmpc_real *before);

/** Whether the plan t is on levels and keeps its dwell times; its moves are then put on them. */
int koopmpc_accept_levels(koopmpc_state *s);

/**
 * Put the moves of t on the best sequence of levels.
 * @param s      the state; t is the plan without limits
 * @param low    limits of the rows of the program, less what they are for t
 * @param high   the same of the upper ends
 * @param report takes the sequences that were looked at, the gap, and how far a limit gave way
 */
koopmpc_status koopmpc_search_levels(koopmpc_state *s, const koopmpc_real *low, const koopmpc_real *high,
                                     koopmpc_report *report);
#endif

/** Least 0.5 |v|^2 with low <= M v / scaling <= high, v = R x: rows of M have length 1. */
typedef struct {
  int n, m, soft;              /**< variables, rows, and how many rows may give way */
  int doubtful;                /**< whether rows may be so nearly dependent that no solution found proves nothing */
  const koopmpc_real *M;       /**< (m, n) */
  const koopmpc_real *scaling; /**< (m) */
  const koopmpc_real *rinv;    /**< inverse of R, its upper triangle row by row; NULL for the identity */
  const int *sense;            /**< (m) 8 for a soft row, else 0 */
  const koopmpc_real *linear;  /**< (m) linear price of a soft row's violation */
  const koopmpc_real *rho;     /**< (m) reciprocal of the price's slope */
} koopmpc_qp;

/** The solver's memory: limits, answer, and the rows that it ended with, in two arrays of the caller. */
typedef struct {
  koopmpc_real *low, *high;         /**< (m) limits */
  int hard_alone;                   /**< whether soft rows have none in a solve */
  koopmpc_real *dlow, *dhigh;       /**< (m) those of a solve, in its scale */
  koopmpc_real *product, *dual;     /**< (m) M v, and multipliers */
  koopmpc_real *primal, *u;         /**< (n) */
  koopmpc_real *lam, *lam_star, *D; /**< (k), k = n + soft + 1 */
  koopmpc_real *xldl, *zldl, *L;    /**< (k), and k (k + 1) / 2 */
  int *held;                        /**< (3) active rows, singular one, whether lam and lam_star changed places */
  int *sense, *WS;                  /**< (m) and (k) */
} koopmpc_qp_memory;

/** Share out 6 m + 2 n + 5 k + k (k + 1) / 2 numbers and m + k + 3 integers. */
koopmpc_qp_memory koopmpc_qp_on(const koopmpc_qp *qp, koopmpc_real *reals, int *ints);

/** How a solve ended. */
typedef struct {
  int flag;       /**< DAQP's exit flag: 1 and 2 are solutions, -1 no solution, -4 too many iterations */
  int iterations; /**< of this solve */
} koopmpc_qp_end;

/** The status of a solve without a solution. */
static inline koopmpc_status koopmpc_qp_status(koopmpc_qp_end end) {
  return end.flag == -1 ? KOOPMPC_INFEASIBLE : end.flag == -4 ? KOOPMPC_MAX_ITERATIONS : KOOPMPC_FAILED;
}

/**
 * Solve within mem->low and mem->high, made `wider` by this share of 1 + their size.
 * The solution is mem->primal, its multipliers mem->dual; both are zero where there is none.
 * @param resume whether to continue from the active rows of the last solve of this problem
 * @param push  (m) the solve starts from the rows whose multipliers are not zero; NULL for none
 */
koopmpc_qp_end koopmpc_qp_solve(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push,
                                koopmpc_real wider, int resume);

/**
 * Solve, and again with limits a tolerance wider where that finds no solution, unless the hard rows contradict each
 * other: mem->hard_alone says so then. Answers are checked where rows give way; `good` is 0 if it is no solution, 1 or 2 by the solve that found it.
 */
koopmpc_qp_end koopmpc_qp_find(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push, int resume,
                               int *good);

/** Whether the hard rows alone have no point in common; mem->hard_alone is the same. */
int koopmpc_qp_contradicts(const koopmpc_qp *qp, koopmpc_qp_memory *mem);

#endif
