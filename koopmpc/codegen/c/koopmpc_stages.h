/** @file koopmpc_stages.h @brief The quadratic program of a plan's stages, and the model and the targets behind it. */
#ifndef KOOPMPC_STAGES_H
#define KOOPMPC_STAGES_H

#include <math.h>

#include "koopmpc_step.h"

/** Sizes: the model's x, a stage's state s and input v, tracked and limited outputs, the sides of the limits, rows of the end's cost. */
enum {
  NX = KOOPMPC_NZ,
  NS = KOOPMPC_NS,
  NV = KOOPMPC_NU,
  NR = KOOPMPC_TRACKED,
  NG = KOOPMPC_LIMITED,
  NQ = KOOPMPC_NU + KOOPMPC_LIMITED,
  SIDES = KOOPMPC_SIDES,
  SOFT = KOOPMPC_SOFT,
  HARD = KOOPMPC_SIDES - KOOPMPC_SOFT,
  STEPS = KOOPMPC_N
};

/** Parts of a target: its row, equilibrium (x, u), active limits, u_r, du_r/de, and |M of(x) + L x + V u - m|^2. */
enum {
  TARGET_X = KOOPMPC_NR,
  TARGET_U = TARGET_X + KOOPMPC_NZ,
  TARGET_ACTIVE = TARGET_U + KOOPMPC_NU,
  TARGET_INPUT = TARGET_ACTIVE + KOOPMPC_NU + KOOPMPC_BOX,
  TARGET_SLOPE = TARGET_INPUT + KOOPMPC_NU,
  TARGET_M = TARGET_SLOPE + KOOPMPC_NU * KOOPMPC_NZ,
  TARGET_L = TARGET_M + KOOPMPC_GOAL * KOOPMPC_NR,
  TARGET_V = TARGET_L + KOOPMPC_GOAL * KOOPMPC_NZ,
  TARGET_GOAL = TARGET_V + KOOPMPC_GOAL * KOOPMPC_NU,
  TARGET_FOUND = TARGET_GOAL + KOOPMPC_GOAL
};

/** Parts of koopmpc_local at (x, u): F, its derivatives A and B, of and J, the limited g and G. */
enum {
  LOCAL_A = KOOPMPC_NZ,
  LOCAL_B = LOCAL_A + KOOPMPC_NZ * KOOPMPC_NZ,
  LOCAL_OF = LOCAL_B + KOOPMPC_NZ * KOOPMPC_NU,
  LOCAL_J = LOCAL_OF + KOOPMPC_NR,
  LOCAL_G = LOCAL_J + KOOPMPC_NR * KOOPMPC_NZ,
  LOCAL_DG = LOCAL_G + KOOPMPC_BOX,
  KOOPMPC_LOCAL = LOCAL_DG + KOOPMPC_BOX * KOOPMPC_NZ
};

/** to (m, n) = a b, or a' b if `turned`; a is (m, k), or (k, m), and b (k, n), all row after row. */
static inline void koopmpc_multiply(koopmpc_real *to, const koopmpc_real *a, const koopmpc_real *b, int m, int k, int n,
                                    int turned) {
  for (int i = 0; i < m; i++)
    for (int j = 0; j < n; j++) {
      koopmpc_real sum = 0;
      for (int q = 0; q < k; q++) sum += (turned ? a[q * m + i] : a[i * k + q]) * b[q * n + j];
      to[i * n + j] = sum;
    }
}

/** K (n, m) <- H^-1 K by the lower factor of H, which is written to L; 0 if H is not positive definite. */
static inline int koopmpc_divide(const koopmpc_real *H, koopmpc_real *L, koopmpc_real *K, int n, int m) {
  int good = 1;
  for (int i = 0; i < n; i++) {
    for (int j = 0; j <= i; j++) {
      koopmpc_real sum = (H[i * n + j] + H[j * n + i]) / 2;
      for (int k = 0; k < j; k++) sum -= L[i * n + k] * L[j * n + k];
      L[i * n + j] = i == j ? KOOPMPC_SQRT(sum) : sum / L[j * n + j];
      if (i == j) good &= sum > 0;
    }
    for (int j = 0; j < m; j++) {
      for (int k = 0; k < i; k++) K[i * m + j] -= L[i * n + k] * K[k * m + j];
      K[i * m + j] /= L[i * n + i];
    }
  }
  for (int i = n - 1; i >= 0; i--)
    for (int j = 0; j < m; j++) {
      for (int k = i + 1; k < n; k++) K[i * m + j] -= L[k * n + i] * K[k * m + j];
      K[i * m + j] /= L[i * n + i];
    }
  return good;
}

/** Slopes: A and B of a stage, row after row, and its next state. Stage map: the next state alone. */
void koopmpc_slopes(const koopmpc_real *s, const koopmpc_real *v KOOPMPC_AND(const koopmpc_real *w), koopmpc_real *out);
void koopmpc_stage_map(const koopmpc_real *s, const koopmpc_real *v KOOPMPC_AND(const koopmpc_real *w),
                       koopmpc_real *next);

/** The measured disturbance of stage k. */
static inline const koopmpc_real *koopmpc_w_of(const koopmpc_state *s, int k) {
  return s->known + KOOPMPC_PREVIEW + k * KOOPMPC_NW;
}

/** The measured disturbance that holds at the end of the horizon, and for which targets are sought. */
static inline const koopmpc_real *koopmpc_end_w(const koopmpc_state *s) {
#if KOOPMPC_SCHEDULED
  return s->aimed_w;
#else
  return koopmpc_w_of(s, STEPS - 1);
#endif
}

/** Tracked outputs of a stage and their derivative, row after row; limited outputs and theirs. */
void koopmpc_tracked(const koopmpc_real *s, koopmpc_real *out);
void koopmpc_limited(const koopmpc_real *s, koopmpc_real *out);

/** Q, row after row, and q of a stage that tracks r, by Gauss-Newton. */
void koopmpc_stage(const koopmpc_real *s, const koopmpc_real *r, koopmpc_real *out);

/** F, A, B, of, J, g and G at (x, u), for the search of an equilibrium. */
void koopmpc_local(const koopmpc_real *x, const koopmpc_real *u KOOPMPC_AND(const koopmpc_real *w), koopmpc_real *out);

/** Whether a limited output is hard; the first ones are inputs where their changes count. */
static inline int koopmpc_is_hard(int row) {
  return row >= KOOPMPC_NU * KOOPMPC_WITH_RATES && !(koopmpc_softness_linear[row] < KOOPMPC_HUGE);
}

/** Entry i of [v_k; g(s_{k+1})] of the plan, and how far a step moves it. */
static inline koopmpc_real koopmpc_quantity(const koopmpc_state *s, int k, int i) {
  return i < NV ? s->V[k * NV + i] : s->g[k * NG + i - NV];
}
static inline koopmpc_real koopmpc_moved(const koopmpc_state *s, int k, int i, const koopmpc_real *X,
                                         const koopmpc_real *U) {
  return i < NV ? U[k * NV + i] : koopmpc_dot(s->G + (k * NG + i - NV) * NS, X + k * NS, NS);
}

/** The lower and the upper limit of that entry. */
koopmpc_real koopmpc_low_of(const koopmpc_state *s, int k, int i);
koopmpc_real koopmpc_high_of(const koopmpc_state *s, int k, int i);

/**
 * Solve the program along the plan for the state x: the step is s->dX and s->dU, soft limits give way by s->eps.
 * @param first (KOOPMPC_NU) becomes the first input of the program without limits
 */
koopmpc_status koopmpc_program(koopmpc_state *s, const koopmpc_real *x, koopmpc_real *first, int *iterations);

/** Solve the program of newX and newU, its solution without limits, and their Riccati recursion, by an active set. */
koopmpc_status koopmpc_finish(koopmpc_state *s, int *iterations);

/** The cost of the plan, with the price of violated soft limits. */
koopmpc_real koopmpc_cost(const koopmpc_state *s);

/**
 * The pseudo-inverse (n, m) of E (m, n), and a basis of its null space in the columns of `null` (n, n), by one-sided
 * Jacobi rotations of E's columns: E V = B has orthogonal columns. E is overwritten, and may not be `result`; returns the
 * null space's size.
 */
int koopmpc_inverse(koopmpc_real *E, int m, int n, koopmpc_real rank, koopmpc_real *result, koopmpc_real *null);

/**
 * Gauss-Newton steps to the equilibrium of a row, of w where that multiplies x or u, and of a disturbance e: a violated
 * limit is added, one with a wrong sign released. The last step is at most a share `enough` of (x, u); 0, and nothing
 * written, if they fail. `careful` steps end at the first limit, and are shorter where they would swing; there may be
 * `careful` times as many.
 */
int koopmpc_near(koopmpc_real *x, koopmpc_real *u, koopmpc_real *active, const koopmpc_real *row, const koopmpc_real *w,
                 const koopmpc_real *e, koopmpc_real enough, int careful);

/** Whether a limit of a target is active. */
int koopmpc_is_limited(const koopmpc_real *active);

/** The factors of a Gauss-Newton step at `koopmpc_local` without active limits: H of F + e - x, T of the residuals. */
void koopmpc_factors(const koopmpc_real *at, koopmpc_real *H, koopmpc_real *T);

/**
 * The target of a row that the table lacks: all of it, or with whole = 0 the parts before TARGET_M, after which stands
 * whether an equilibrium was found. NULL if the table is empty.
 */
const koopmpc_real *koopmpc_find_row(koopmpc_state *s, const koopmpc_real *row, int whole);

#if !KOOPMPC_SCHEDULED
/** Whether a target holds its row, or was found from another row close by: else other equilibria may be as near. */
int koopmpc_is_alone(const koopmpc_state *s, const koopmpc_real *row, const koopmpc_real *target);
#endif

#if KOOPMPC_SCHEDULED
/** Whether an equilibrium holds a row for w = 0 that is known, or found from a known one, without active limits. */
int koopmpc_is_free(koopmpc_state *s, const koopmpc_real *row);
#endif

/** Weigh the end of the horizon by a matrix alone: |root (of(x_N) - r)|^2, r the row of the target. */
void koopmpc_weigh_row(koopmpc_real *target, const koopmpc_real *root);

/** Move the end to where a reference that moves at its last row asks for it, or drop its tail; one that rests moves nothing. */
void koopmpc_move_end(koopmpc_state *s, koopmpc_real *end);

/** Move the equilibrium of a target, and its cost, to where x = F(x, u) + e. */
void koopmpc_rest(koopmpc_state *s, const koopmpc_real *target, const koopmpc_real *e);

#endif
