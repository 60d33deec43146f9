/**
 * @file koopmpc.h
 * @brief One controller as C99: no heap, no file, no clock, no library but math.h, no global variable.
 *
 * The state of a controller is one koopmpc_state, which the caller owns; copy it by assignment. Two states may be
 * stepped by two threads at once. Arrays hold one value after the other; matrices and previews hold row after row.
 */
#ifndef KOOPMPC_H
#define KOOPMPC_H

#include "koopmpc_sizes.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef KOOPMPC_FLOAT
typedef float koopmpc_real;
#else
typedef double koopmpc_real;
#endif

/** An argument that only models have in which measured disturbances multiply the state or the inputs. */
#if KOOPMPC_SCHEDULED
#define KOOPMPC_AND(w) , w
#else
#define KOOPMPC_AND(w)
#endif

/** How a step ended. The first four are regular; the others come with a fallback. */
typedef enum {
  KOOPMPC_UNCONSTRAINED = 0,   /**< the unconstrained optimum meets every limit */
  KOOPMPC_OPTIMAL = 1,         /**< the QP was solved */
  KOOPMPC_SOFTENED = 2,        /**< solved, and a soft limit or a rate gave way by more than its tolerance */
  KOOPMPC_SATURATED = 3,       /**< a feedback law was clipped to the input limits */
  KOOPMPC_MAX_ITERATIONS = 4,  /**< the solver met its bound of iterations */
  KOOPMPC_TIME_LIMIT = 5,      /**< solved, but a search over levels met its bound of nodes: see `gap` */
  KOOPMPC_INFEASIBLE = 6,      /**< no plan meets the hard limits */
  KOOPMPC_BAD_MEASUREMENT = 7, /**< NaN, inf or beyond 1e30 in y, the reference or w; the model overflows from y */
  KOOPMPC_FAILED = 8           /**< the solver gave no usable answer */
} koopmpc_status;

/** The input that replaces the answer of a failed step; always inside the input limits. */
typedef enum {
  KOOPMPC_NONE = 0,         /**< the answer of the step */
  KOOPMPC_SHIFTED_PLAN = 1, /**< the last good plan, moved on by one step */
  KOOPMPC_CLIPPED_LQR = 2,  /**< the unconstrained optimum, clipped to the input limits */
  KOOPMPC_HOLD = 3          /**< the last input again */
} koopmpc_fallback;

/** Rows of a preview from this step on. If there are fewer than the horizon has steps, the last one is repeated. */
typedef struct {
  const koopmpc_real *values; /**< row after row */
  int count;                  /**< number of rows, at least 1 */
} koopmpc_rows;

/** How a step ended, and the work of the QP solver. */
typedef struct {
  koopmpc_status status;
  koopmpc_fallback fallback;
  int iterations;     /**< iterations of the QP solver, or nodes of a search over levels */
  koopmpc_real slack; /**< the largest violation of a soft limit, in its unit; 0 unless SOFTENED */
  int refused;        /**< 1 if y was too far from its prediction, which stood in */
  koopmpc_real gap;   /**< the share of its cost by which a better plan on levels may be cheaper; 0 for the best */
} koopmpc_report;

#if KOOPMPC_BOUNDS
/** Limits from this step on: rows as those of a preview, row 0 that of this step; +-1e30 where there is no limit. */
typedef struct {
  koopmpc_rows u_low, u_high;   /**< KOOPMPC_NU numbers a row: of the inputs */
  koopmpc_rows du_low, du_high; /**< KOOPMPC_NU numbers a row: of their changes; read if KOOPMPC_CHANGES is 1 */
  koopmpc_rows x_low, x_high;   /**< KOOPMPC_OUTPUTS numbers a row: of the states, then the observables, with a limit */
} koopmpc_bounds;
#endif

/** The state of the controller between two steps. */
typedef struct {
  koopmpc_real known[KOOPMPC_KNOWN + 1];   /**< [z; u_{-1}; w_0 ...; d], where the plan starts */
  koopmpc_real reference[(KOOPMPC_N + 1) * KOOPMPC_NR]; /**< rows of the last step */
  koopmpc_real kept[KOOPMPC_MOVES];        /**< inputs of the last good plan */
#if KOOPMPC_FIRST_ALONE
  koopmpc_real apart[(KOOPMPC_N + 1) * KOOPMPC_NR]; /**< rows less their first one */
  koopmpc_real moved[(KOOPMPC_N + 1) * KOOPMPC_NR]; /**< rows less their first one, if `kept` still is without them */
  int owes;
#endif
  koopmpc_real given[KOOPMPC_NU];          /**< the last input returned */
  koopmpc_real sent[(KOOPMPC_LATENCY + 1) * KOOPMPC_NU]; /**< computed inputs that have not acted yet */
  koopmpc_real ahead[(KOOPMPC_LATENCY + 1) * KOOPMPC_NW1];
  koopmpc_real w[KOOPMPC_NW1];
  koopmpc_real zeta[KOOPMPC_NZETA];
  koopmpc_real z[KOOPMPC_NZ], d[KOOPMPC_NZ];
  koopmpc_real scratch[2 * (KOOPMPC_NZ + KOOPMPC_ESTIMATOR_F_LENGTH) + 2];
#if KOOPMPC_ESTIMATOR == 1
  koopmpc_real newest[KOOPMPC_NZ + 2 * KOOPMPC_NX], means[KOOPMPC_NZ + 2 * KOOPMPC_NX];
  koopmpc_real sizes[KOOPMPC_NX], weights[KOOPMPC_NX], fresh, change;
  int learned, stood_in;
#elif KOOPMPC_ESTIMATOR == 2
  koopmpc_real s[KOOPMPC_ESTIMATOR_F_LENGTH];
  koopmpc_real queue[(KOOPMPC_ESTIMATOR_DELAY + 1) * (KOOPMPC_NU + KOOPMPC_NW1)];
  koopmpc_real innovation[KOOPMPC_NY], factor[KOOPMPC_NY * KOOPMPC_NY];
  int queued, started, missed;
#endif
#if KOOPMPC_GATE
  koopmpc_real gate[KOOPMPC_GATE]; /**< memory of the test of readings */
  koopmpc_real from[KOOPMPC_NZ];   /**< what the next reading is predicted from */
  koopmpc_real used_w[KOOPMPC_NW1]; /**< the last w that was not wild */
  int has_z, bridged, doubted;     /**< doubted: wild w in sequence */
#endif
#if !KOOPMPC_IS_STAGED
  koopmpc_real target_reals[KOOPMPC_TARGET_REALS]; /**< memory of the solver of targets */
  int target_ints[KOOPMPC_TARGET_INTS];
#endif
#if KOOPMPC_IS_STAGED
  koopmpc_real S[(KOOPMPC_N + 1) * KOOPMPC_NS], V[KOOPMPC_MOVES];         /**< the plan: states, inputs of stages */
  koopmpc_real bestS[(KOOPMPC_N + 1) * KOOPMPC_NS], bestV[KOOPMPC_MOVES]; /**< the best plan of several starts */
  koopmpc_real draftX[(KOOPMPC_N + 1) * KOOPMPC_NZ], draftU[KOOPMPC_MOVES];
  koopmpc_real R[KOOPMPC_N * KOOPMPC_TRACKED], U_r[KOOPMPC_MOVES], u_r[KOOPMPC_MOVES]; /**< targets of the stages */
  koopmpc_real end_M[KOOPMPC_END * KOOPMPC_TRACKED], end_L[KOOPMPC_END * KOOPMPC_NS], end_m[KOOPMPC_END];
#if KOOPMPC_BEYOND
  koopmpc_real beyond[KOOPMPC_BEYOND * KOOPMPC_NR]; /**< rows after those of the reference that moves */
#endif
  koopmpc_real rest[KOOPMPC_NZ]; /**< the equilibrium that the plan leads to */
  koopmpc_real A[KOOPMPC_N * KOOPMPC_NS * KOOPMPC_NS], B[KOOPMPC_MOVES * KOOPMPC_NS]; /**< the program */
  koopmpc_real Q[KOOPMPC_N * KOOPMPC_NS * KOOPMPC_NS], G[KOOPMPC_N * KOOPMPC_LIMITED1 * KOOPMPC_NS];
  koopmpc_real c[KOOPMPC_N * KOOPMPC_NS], q[KOOPMPC_N * KOOPMPC_NS], r[KOOPMPC_MOVES];
  koopmpc_real g[KOOPMPC_N * KOOPMPC_LIMITED1], start[KOOPMPC_NS];
  koopmpc_real K[KOOPMPC_MOVES * KOOPMPC_NS], half[KOOPMPC_MOVES * KOOPMPC_NU]; /**< its Riccati recursion */
  koopmpc_real gradient[KOOPMPC_N * KOOPMPC_NS], feed[KOOPMPC_MOVES], curvature[KOOPMPC_MOVES];
  koopmpc_real dX[KOOPMPC_N * KOOPMPC_NS], dU[KOOPMPC_MOVES], newX[KOOPMPC_N * KOOPMPC_NS], newU[KOOPMPC_MOVES];
  koopmpc_real t[KOOPMPC_PAIRS], lam[KOOPMPC_PAIRS], d_side[KOOPMPC_PAIRS]; /**< its limits */
  koopmpc_real gap[KOOPMPC_PAIRS], eased[KOOPMPC_PAIRS], base[KOOPMPC_PAIRS], second[KOOPMPC_PAIRS];
  koopmpc_real step_t[KOOPMPC_PAIRS], step_lam[KOOPMPC_PAIRS];
  koopmpc_real eps[KOOPMPC_EASED], nu[KOOPMPC_EASED], kappa[KOOPMPC_EASED], second_eps[KOOPMPC_EASED];
  koopmpc_real step_eps[KOOPMPC_EASED], step_nu[KOOPMPC_EASED];
  koopmpc_real barrier[KOOPMPC_N * (KOOPMPC_NU + KOOPMPC_LIMITED)], push[KOOPMPC_N * (KOOPMPC_NU + KOOPMPC_LIMITED)];
  koopmpc_real reach[KOOPMPC_N * (KOOPMPC_NU + KOOPMPC_LIMITED)];
  koopmpc_real first_low[KOOPMPC_NU], first_high[KOOPMPC_NU]; /**< limits of the first change of the inputs */
#if KOOPMPC_BOUNDS
  koopmpc_real low[KOOPMPC_N * (KOOPMPC_NU + KOOPMPC_LIMITED)], high[KOOPMPC_N * (KOOPMPC_NU + KOOPMPC_LIMITED)];
  koopmpc_real box_low[KOOPMPC_MOVES], box_high[KOOPMPC_MOVES]; /**< limits of the stages, and of their inputs */
#endif
  koopmpc_real without_limits[KOOPMPC_NU], defects[KOOPMPC_NS], length, slack, best_slack;
  koopmpc_real e[KOOPMPC_PUSHES]; /**< E w + d of the stages */
#if KOOPMPC_FINISH_ROWS
  koopmpc_real finish_M[KOOPMPC_FINISH_ROWS * KOOPMPC_FINISH_WIDTH], finish_reals[KOOPMPC_FINISH_REALS];
  koopmpc_real finish_size[KOOPMPC_FINISH_ROWS], finish_scaling[KOOPMPC_FINISH_ROWS]; /**< the active-set method */
  koopmpc_real finish_linear[KOOPMPC_FINISH_ROWS], finish_rho[KOOPMPC_FINISH_ROWS];
  koopmpc_real finish_free[KOOPMPC_FINISH_ROWS], finish_dual[KOOPMPC_FINISH_ROWS];
  int finish_ints[KOOPMPC_FINISH_INTS];
#endif
#if KOOPMPC_DISTURBED
  koopmpc_real rest_u[KOOPMPC_NU], rest_active[KOOPMPC_NU + KOOPMPC_BOX];
  koopmpc_real rest_goal[KOOPMPC_GOAL], rest_input[KOOPMPC_NU];
  koopmpc_real chord_s[KOOPMPC_NZ + KOOPMPC_NU], chord_H[(KOOPMPC_NZ + KOOPMPC_NU) * KOOPMPC_NZ];
  koopmpc_real chord_T[(KOOPMPC_NZ + KOOPMPC_NU) * (KOOPMPC_NR + KOOPMPC_NZ + KOOPMPC_NU)];
  koopmpc_real chord_G[(KOOPMPC_BOX + 1) * KOOPMPC_NZ];
  int has_rest, has_chord;
#endif
  koopmpc_real made[KOOPMPC_MADE * KOOPMPC_MADE_SIZE]; /**< equilibria of rows that the table lacks */
  koopmpc_real made_end[KOOPMPC_TARGET];               /**< the target of the last row, if the table lacks it */
  int made_count, made_next, has_made_end;
#if KOOPMPC_SCHEDULED
  koopmpc_real aimed_w[KOOPMPC_NW1]; /**< the w for which targets were found; those of the table are for zero */
  koopmpc_real last_end[KOOPMPC_MADE_SIZE]; /**< equilibrium of the last row of the last step */
  koopmpc_real still[KOOPMPC_MADE_SIZE];    /**< of the last row that the table lacks, for w = 0 */
  int has_last_end, has_still;
#endif
  const koopmpc_real *targets; /**< the table of targets, see koopmpc_use_targets */
  int finishing;               /**< whether the active-set method finished the last program of this step */
  int spent;                   /**< the effort of the solver in this step, in interior-point steps */
  int target_count, found;     /**< number of its rows, and the row that was found last */
  int moved_on;                /**< whether the disturbance or the row of given input targets has moved */
#elif !KOOPMPC_IS_LQR
  koopmpc_real t[KOOPMPC_NT];              /**< the plan of this step, and the extreme values of its targets */
  koopmpc_real column[KOOPMPC_NT];         /**< the reference's part of the plan */
  koopmpc_real dual[KOOPMPC_QP_M1];        /**< multipliers of the last solve, from which the next one starts */
  koopmpc_real qp_reals[KOOPMPC_QP_REALS]; /**< memory of the QP solver, and the rows that it ended with */
  int qp_ints[KOOPMPC_QP_INTS];
#if KOOPMPC_STEEP
  koopmpc_real eased[KOOPMPC_QP_M * KOOPMPC_MOVES + 4 * KOOPMPC_QP_M]; /**< rows of the problem with an added weight */
#endif
#if KOOPMPC_BOUNDS
  koopmpc_real low[KOOPMPC_NT], high[KOOPMPC_NT]; /**< limits of the plan, of its inputs, of targets */
  koopmpc_real box_low[KOOPMPC_MOVES], box_high[KOOPMPC_MOVES], rate_low[KOOPMPC_NU], rate_high[KOOPMPC_NU];
  koopmpc_real now_low[KOOPMPC_NU], now_high[KOOPMPC_NU]; /**< limits of the input of this step alone */
  koopmpc_real opened_low[KOOPMPC_MOVES], opened_high[KOOPMPC_MOVES];
  koopmpc_real target_low[(KOOPMPC_N + 1) * KOOPMPC_NL + 1], target_high[(KOOPMPC_N + 1) * KOOPMPC_NL + 1];
  koopmpc_real unpushed; /**< no limit moves a target of rows that are no larger */
  koopmpc_real peak;     /**< the largest number of the last reference */
#endif
#if KOOPMPC_LEVELS
  int level[KOOPMPC_NU], level_steps[KOOPMPC_NU]; /**< level of each input, and for how many steps it has held it */
  int level_begins;                               /**< whether no input has acted yet: the first change is free */
  int plan_levels[KOOPMPC_MOVES], has_levels;     /**< levels of the last plan */
  int most_nodes; /**< nodes of a search, at most; koopmpc_init sets KOOPMPC_NODES, and it may be changed after */
#endif
  int far;        /**< whether the last solution took proximal points */
  int resumes;    /**< whether the next solve continues from the active rows of this one */
  int unmet;      /**< whether the hard limits of the last solve contradicted each other */
#endif
  int aimed;      /**< whether the targets are those of `reference`; 2 if its rows are the same */
  int row;        /**< row of given input targets */
  int warm;       /**< whether the next step starts from the last one */
  int has_kept, age, planned;
  int seen;       /**< whether zeta holds a past; only for models with delays */
  int refused;    /**< whether the last y was refused */
} koopmpc_state;

/**
 * Forget all earlier steps.
 * @param s      the state
 * @param x0     KOOPMPC_NX numbers, the state that a filter starts at; NULL for zero
 * @param u_prev KOOPMPC_NU numbers, the input that acted last; NULL for zero moved inside the limits
 */
void koopmpc_init(koopmpc_state *s, const koopmpc_real *x0, const koopmpc_real *u_prev);

/**
 * Compute the input of one step; call it once every KOOPMPC_DT seconds.
 * @param s         the state
 * @param y         KOOPMPC_NY measurements; NaN is a missed one
 * @param reference rows of KOOPMPC_NR numbers from this step on, up to KOOPMPC_HORIZON + 1 of them are read
 * @param applied   KOOPMPC_NU numbers, the input that acted last; NULL for the last u returned
 * @param w         rows of KOOPMPC_NW measured disturbances from this step on; NULL for zero
 * @param u         KOOPMPC_NU numbers, the input to apply; always inside its limits
 * @param report    how the step ended; may be NULL
 */
void koopmpc_step(koopmpc_state *s, const koopmpc_real *y, const koopmpc_rows *reference, const koopmpc_real *applied,
                  const koopmpc_rows *w, koopmpc_real *u, koopmpc_report *report);

#if KOOPMPC_BOUNDS
/**
 * Set the limits of the next steps, until it is called again; koopmpc_init takes those of the controller.
 * @param s      the state
 * @param bounds the limits from this step on; lower ones must not be above upper ones
 */
void koopmpc_set_bounds(koopmpc_state *s, const koopmpc_bounds *bounds);
#endif

/**
 * Write the inputs of the last plan.
 * @param s the state
 * @param U KOOPMPC_N rows of KOOPMPC_NU inputs
 * @return 1; 0 if the last step had no plan: then U is not written
 */
int koopmpc_plan(const koopmpc_state *s, koopmpc_real *U);

/** z = psi(x), the lifting; zeta is the state, or the state and its past. */
void koopmpc_lift(const koopmpc_real *zeta, koopmpc_real *z);

#if KOOPMPC_IS_STAGED
/**
 * Write the states of the last plan.
 * @param s the state
 * @param X KOOPMPC_N + 1 rows of KOOPMPC_NX states
 * @return as koopmpc_plan
 */
int koopmpc_plan_states(const koopmpc_state *s, koopmpc_real *X);

/**
 * Take the targets of reference rows from another table than koopmpc_table. The target of a row that the
 * table lacks is found by the step that meets it, from the nearest one of the table.
 * @param s       the state
 * @param targets `count` rows of KOOPMPC_TARGET numbers; the memory must stay valid
 * @param count   number of rows, at least 1
 */
void koopmpc_use_targets(koopmpc_state *s, const koopmpc_real *targets, int count);

/**
 * Find the targets of reference rows before the step that meets them, which does the same otherwise.
 * @param s         the state
 * @param reference as in koopmpc_step
 * @return number of rows that the table lacks, and for which no equilibrium inside all limits was found
 */
int koopmpc_find_targets(koopmpc_state *s, const koopmpc_rows *reference);

/** next = F(x, u), the model, or F(x, u, w) where w multiplies x or u; x is the state, or the state and its past. */
void koopmpc_map(const koopmpc_real *x, const koopmpc_real *u KOOPMPC_AND(const koopmpc_real *w), koopmpc_real *next);
#endif

#ifdef __cplusplus
}
#endif

#endif
