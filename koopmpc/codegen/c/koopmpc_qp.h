/**
 * @file koopmpc_qp.h
 * @brief Quadratic programs in the form that DAQP solves; its sources are in daqp/, unchanged, under their own licence.
 */
#ifndef KOOPMPC_QP_H
#define KOOPMPC_QP_H

#include "koopmpc.h"

/** Least 0.5 |v|^2 with low <= M v / scaling <= high, v = R x: rows of M have length 1. */
typedef struct {
  int n, m, soft;              /**< variables, rows, and how many rows may give way */
  const koopmpc_real *M;       /**< (m, n) */
  const koopmpc_real *scaling; /**< (m) */
  const koopmpc_real *rinv;    /**< inverse of R, its upper triangle row by row; NULL for the identity */
  const int *sense;            /**< (m) 8 for a soft row, else 0 */
  const koopmpc_real *linear;  /**< (m) linear price of a soft row's violation */
  const koopmpc_real *rho;     /**< (m) reciprocal of the price's slope */
} koopmpc_qp;

/** The solver's memory: limits, answer, and the rows that it ended with, in two arrays of the caller. */
typedef struct {
  koopmpc_real *low, *high;         /**< (m) limits of this solve */
  koopmpc_real *dlow, *dhigh;       /**< (m) these limits in the scale of the solver */
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

/**
 * Solve within mem->low and mem->high, made `wider` by this share of 1 + their size.
 * The solution is mem->primal, its multipliers mem->dual; both are zero where there is none.
 * @param resume whether to continue from the active rows of the last solve of this problem
 * @param push  (m) the solve starts from the rows whose multipliers are not zero; NULL for none
 */
koopmpc_qp_end koopmpc_qp_solve(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push,
                                koopmpc_real wider, int resume);

/** Solve, and check the answer where rows give way; `good` says whether it is the solution. */
koopmpc_qp_end koopmpc_qp_attempt(const koopmpc_qp *problem, koopmpc_qp_memory *qp, const koopmpc_real *push,
                                  koopmpc_real wider, int resume, int *good);

#endif
