/**
 * @file koopmpc_stages.c
 * @brief The quadratic program of N stages: Riccati sweeps, and an interior-point method whose steps are such sweeps.
 *
 * Least sum of 0.5 dx'Q dx + q'dx + 0.5 du'R du + r'du with dx_{k+1} = A_k dx_k + B_k du_k + c_k, inside the limits.
 * A barrier adds a diagonal to R and G'wG to Q, so each Newton step is one backward and one forward sweep.
 * Rao, Wright & Rawlings, J. Optim. Theory Appl. 99, 1998; Mehrotra, SIAM J. Optim. 2, 1992.
 */
#include <math.h>

#include "koopmpc_stages_tables.h"
#include "koopmpc_stages.h"

enum { STALLED = 5 }; /* a step is centred if mu has not halved in this many steps */
#define CENTRING ((koopmpc_real)0.3)
#define SHORT_OF ((koopmpc_real)0.995)

koopmpc_real koopmpc_low_of(const koopmpc_state *s, int k, int i) {
  return KOOPMPC_WITH_RATES && k == 0 && i < NV ? s->first_low[i] : KOOPMPC_PLAN_LOW(s)[i * STEPS + k];
}

koopmpc_real koopmpc_high_of(const koopmpc_state *s, int k, int i) {
  return KOOPMPC_WITH_RATES && k == 0 && i < NV ? s->first_high[i] : KOOPMPC_PLAN_HIGH(s)[i * STEPS + k];
}

/** Derivatives at the plan: A, B, c = F - X along it, Q, q, r (Gauss-Newton in the tracked outputs), limits g and G. */
static void linearise(koopmpc_state *s) {
  koopmpc_real dynamics[NS * NS + NS * NV + NS], weighed[NS * NS + NS], seen[NR + NR * NS], limits[NG + NG * NS + 1];
  for (int k = 0; k < STEPS; k++) {
    const koopmpc_real *next = s->S + (k + 1) * NS, *of = seen, *J = seen + NR;
    koopmpc_real *Q = s->Q + k * NS * NS, *q = s->q + k * NS;
    koopmpc_slopes(s->S + k * NS, s->V + k * NV KOOPMPC_AND(koopmpc_w_of(s, k)), dynamics);
    koopmpc_copy(s->A + k * NS * NS, dynamics, NS * NS);
    if (koopmpc_free[k])
      koopmpc_copy(s->B + k * NS * NV, dynamics + NS * NS, NS * NV);
    else
      koopmpc_fill(s->B + k * NS * NV, 0, NS * NV);
    for (int i = 0; i < NS; i++) s->c[k * NS + i] = dynamics[NS * NS + NS * NV + i] - next[i];
    if (KOOPMPC_DISTURBED)
      for (int i = 0; i < KOOPMPC_NZ; i++) s->c[k * NS + i] += s->e[k * KOOPMPC_NZ + i];
    if (k < STEPS - 1) {
      koopmpc_stage(next, s->R + k * NR, weighed);
      koopmpc_copy(Q, weighed, NS * NS);
      koopmpc_copy(q, weighed + NS * NS, NS);
    } else {
      koopmpc_tracked(next, seen);
      koopmpc_fill(Q, 0, NS * NS);
      koopmpc_fill(q, 0, NS);
      for (int row = 0; row < KOOPMPC_END; row++) {
        const koopmpc_real *M = s->end_M + row * NR, *L = s->end_L + row * NS;
        koopmpc_real E[NS], missed = koopmpc_dot(M, of, NR) + koopmpc_dot(L, next, NS) - s->end_m[row];
        koopmpc_copy(E, L, NS);
        for (int i = 0; i < NR; i++)
          for (int m = 0; m < NS; m++) E[m] += M[i] * J[i * NS + m];
        for (int j = 0; j < NS; j++) {
          q[j] += E[j] * missed;
          for (int m = 0; m < NS; m++) Q[j * NS + m] += E[j] * E[m];
        }
      }
    }
    for (int i = 0; i < NV; i++) {
      koopmpc_real sum = 0;
      for (int j = 0; j < NV; j++) sum += koopmpc_R[i * NV + j] * (s->V[k * NV + j] - s->U_r[k * NV + j]);
      s->r[k * NV + i] = sum;
    }
    if (NG) {
      koopmpc_limited(next, limits);
      koopmpc_copy(s->g + k * NG, limits, NG);
      koopmpc_copy(s->G + k * NG * NS, limits + NG, NG * NS);
    }
  }
}

/**
 * The backward sweep: K, the factor of R + B'PB and the gradient of every stage, q + P c, or with a `barrier` (NQ, N)
 * q + Q dX for both ways of a step; NULL for none.
 */
static void factor(koopmpc_state *s, const koopmpc_real *barrier) {
  koopmpc_real P[NS * NS];
  koopmpc_fill(P, 0, NS * NS);
  for (int k = STEPS - 1; k >= 0; k--) {
    const koopmpc_real *R = koopmpc_free[k] ? koopmpc_R : koopmpc_R_held;
    koopmpc_real A[NS * NS], B[NS * NV], K[NV * NS], half[NV * NV], WA[NS * NS], WB[NS * NV], H[NV * NV];
    koopmpc_copy(A, s->A + k * NS * NS, NS * NS); /* on the stack a compiler knows that the arrays do not overlap */
    koopmpc_copy(B, s->B + k * NS * NV, NS * NV);
    for (int i = 0; i < NS * NS; i++) P[i] += s->Q[k * NS * NS + i];
    if (barrier)
      for (int g = 0; g < NG; g++) {
        const koopmpc_real *row = s->G + (k * NG + g) * NS, w = barrier[(NV + g) * STEPS + k];
        for (int i = 0; i < NS; i++)
          for (int j = 0; j < NS; j++) P[i * NS + j] += w * row[i] * row[j];
      }
    koopmpc_fill(WA, 0, NS * NS);
    koopmpc_fill(WB, 0, NS * NV);
    for (int i = 0; i < NS; i++) {
      s->gradient[k * NS + i] = s->q[k * NS + i] + (barrier ? koopmpc_dot(s->Q + (k * NS + i) * NS, s->dX + k * NS, NS)
                                                            : koopmpc_dot(P + i * NS, s->c + k * NS, NS));
      for (int m = 0; m < NS; m++) {
        for (int j = 0; j < NS; j++) WA[i * NS + j] += P[i * NS + m] * A[m * NS + j];
        for (int j = 0; j < NV; j++) WB[i * NV + j] += P[i * NS + m] * B[m * NV + j];
      }
    }
    koopmpc_copy(H, R, NV * NV);
    koopmpc_fill(K, 0, NV * NS);
    for (int m = 0; m < NS; m++)
      for (int i = 0; i < NV; i++) {
        for (int j = 0; j < NV; j++) H[i * NV + j] += B[m * NV + i] * WB[m * NV + j];
        for (int j = 0; j < NS; j++) K[i * NS + j] += B[m * NV + i] * WA[m * NS + j];
      }
    for (int i = 0; i < NV; i++) {
      if (barrier) H[i * NV + i] += barrier[i * STEPS + k];
      s->curvature[k * NV + i] = H[i * NV + i];
    }
    (void)koopmpc_divide(H, half, K, NV, NS);
    for (int i = 0; i < NS; i++) /* P (A - B K) */
      for (int m = 0; m < NV; m++)
        for (int j = 0; j < NS; j++) WA[i * NS + j] -= WB[i * NV + m] * K[m * NS + j];
    koopmpc_fill(P, 0, NS * NS);
    for (int m = 0; m < NS; m++)
      for (int i = 0; i < NS; i++)
        for (int j = 0; j < NS; j++) P[i * NS + j] += A[m * NS + i] * WA[m * NS + j];
    for (int i = 0; i < NS; i++)
      for (int j = 0; j < i; j++) P[i * NS + j] = P[j * NS + i] = (P[i * NS + j] + P[j * NS + i]) / 2;
    koopmpc_copy(s->K + k * NV * NS, K, NV * NS);
    koopmpc_copy(s->half + k * NV * NV, half, NV * NV);
  }
}

/**
 * The sweeps for the gradients of the program, which write its solution into newX and newU. With `push` (NQ, N) on [v; g]
 * they write the way there from dX and dU, which obey the dynamics: its rounding is a share of it, whatever barriers weigh.
 */
static void sweep(koopmpc_state *s, const koopmpc_real *push) {
  koopmpc_real p[NS], x[NS];
  koopmpc_fill(p, 0, NS);
  for (int k = STEPS - 1; k >= 0; k--) {
    const koopmpc_real *A = s->A + k * NS * NS, *B = s->B + k * NS * NV, *K = s->K + k * NV * NS;
    const koopmpc_real *half = s->half + k * NV * NV;
    koopmpc_real h[NS], pulled[NV], *feed = s->feed + k * NV;
    for (int i = 0; i < NS; i++) h[i] = p[i] + s->gradient[k * NS + i];
    koopmpc_copy(pulled, s->r + k * NV, NV);
    if (push) {
      const koopmpc_real *R = koopmpc_free[k] ? koopmpc_R : koopmpc_R_held;
      koopmpc_add(pulled, R, NV, s->dU + k * NV, NV); /* R is symmetric */
      for (int g = 0; g < NG; g++)
        for (int i = 0; i < NS; i++) h[i] += push[(NV + g) * STEPS + k] * s->G[(k * NG + g) * NS + i];
      for (int i = 0; i < NV; i++) pulled[i] += push[i * STEPS + k];
    }
    for (int m = 0; m < NS; m++)
      for (int i = 0; i < NV; i++) pulled[i] += B[m * NV + i] * h[m];
    koopmpc_fill(p, 0, NS);
    for (int m = 0; m < NS; m++)
      for (int i = 0; i < NS; i++) p[i] += A[m * NS + i] * h[m];
    for (int m = 0; m < NV; m++)
      for (int i = 0; i < NS; i++) p[i] -= K[m * NS + i] * pulled[m];
    for (int i = 0; i < NV; i++) {
      feed[i] = -pulled[i];
      for (int m = 0; m < i; m++) feed[i] -= half[i * NV + m] * feed[m];
      feed[i] /= half[i * NV + i];
    }
    for (int i = NV - 1; i >= 0; i--) {
      for (int m = i + 1; m < NV; m++) feed[i] -= half[m * NV + i] * feed[m];
      feed[i] /= half[i * NV + i];
    }
  }
  koopmpc_fill(x, 0, NS);
  if (!push) koopmpc_copy(x, s->start, NS);
  for (int k = 0; k < STEPS; k++) {
    const koopmpc_real *A = s->A + k * NS * NS, *B = s->B + k * NS * NV;
    koopmpc_real *u = s->newU + k * NV, *next = s->newX + k * NS;
    for (int i = 0; i < NV; i++) u[i] = s->feed[k * NV + i] - koopmpc_dot(s->K + (k * NV + i) * NS, x, NS);
    for (int i = 0; i < NS; i++)
      next[i] = koopmpc_dot(A + i * NS, x, NS) + koopmpc_dot(B + i * NV, u, NV) + (push ? 0 : s->c[k * NS + i]);
    koopmpc_copy(x, next, NS);
  }
}

#if KOOPMPC_SIDES > 0

/** Pairs of a limit stand side after side, each over all stages, so that a compiler vectorises the loops. */
enum { PAIRS = SIDES * STEPS, EASED = SOFT * STEPS };

/** How far the quantities that have limits move under a step, one after the other over all stages. */
static void reach_of(koopmpc_state *s, const koopmpc_real *X, const koopmpc_real *U) {
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < NQ; i++) s->reach[i * STEPS + k] = koopmpc_moved(s, k, i, X, U);
}

/** The pull of a soft side's row beside its multiplier, and the part of its slack in it. */
static koopmpc_real soft_pull(const koopmpc_state *s, int i, int soft, koopmpc_real lam, koopmpc_real over) {
  return lam - koopmpc_sides_linear[i - HARD] - koopmpc_sides_quadratic[i - HARD] * s->eps[soft] + over;
}

/** A Newton step to new products t lambda = centre - second, eps nu likewise; writes the step into s->step_*. */
static void newton(koopmpc_state *s, koopmpc_real centre) {
  koopmpc_fill(s->push, 0, STEPS * NQ);
  for (int i = 0; i < SIDES; i++) {
    const koopmpc_real scale = koopmpc_sides_scale[i];
    koopmpc_real *push = s->push + koopmpc_sides_row[i] * STEPS;
    for (int k = 0; k < STEPS; k++) {
      const int at = i * STEPS + k, soft = at - HARD * STEPS;
      const koopmpc_real w = s->lam[at] / s->t[at];
      koopmpc_real ease = 1, given = s->gap[at];
      if (i >= HARD) {
        given += s->kappa[soft] * soft_pull(s, i, soft, s->lam[at], (centre - s->second_eps[soft]) / s->eps[soft]);
        ease += w * s->kappa[soft];
      }
      s->base[at] = s->lam[at] + (-w * given - s->lam[at] + (centre - s->second[at]) / s->t[at]) / ease;
      push[k] -= scale * s->base[at];
    }
  }
  sweep(s, s->push);
  reach_of(s, s->newX, s->newU);
  for (int i = 0; i < SIDES; i++) {
    const koopmpc_real scale = koopmpc_sides_scale[i], *reach = s->reach + koopmpc_sides_row[i] * STEPS;
    for (int k = 0; k < STEPS; k++) {
      const int at = i * STEPS + k, soft = at - HARD * STEPS;
      const koopmpc_real far = scale * reach[k];
      s->step_lam[at] = s->base[at] - s->eased[at] * far - s->lam[at];
      s->step_t[at] = far + s->gap[at];
      if (i >= HARD) {
        const koopmpc_real over = (centre - s->second_eps[soft]) / s->eps[soft];
        s->step_eps[soft] = s->kappa[soft] * (soft_pull(s, i, soft, s->lam[at], over) + s->step_lam[at]);
        s->step_nu[soft] = -(s->nu[soft] / s->eps[soft]) * s->step_eps[soft] - s->nu[soft] + over;
        s->step_t[at] += s->step_eps[soft];
      }
    }
  }
}

static koopmpc_real larger(koopmpc_real a, koopmpc_real b) { return a < b ? b : a; } /* NaN in a stays */

/** The largest of -step / at and `most`; NaN if one is. Four at a time, which do not depend on each other. */
static koopmpc_real toward_zero(const koopmpc_real *step, const koopmpc_real *at, int n, koopmpc_real most) {
  koopmpc_real best[4], sum[4] = {0, 0, 0, 0};
  koopmpc_fill(best, most, 4);
  for (int i = 0; i < n; i++) {
    const koopmpc_real share = -step[i] / at[i];
    best[i % 4] = larger(best[i % 4], share);
    sum[i % 4] += share;
  }
  for (int i = 1; i < 4; i++) {
    best[0] = larger(best[0], best[i]);
    sum[0] += sum[i];
  }
  return koopmpc_abs(sum[0]) < KOOPMPC_HUGE ? best[0] : (koopmpc_real)NAN;
}

/** The largest share by which a pair's step goes towards zero; NaN if one is. */
static koopmpc_real longest(const koopmpc_state *s) {
  koopmpc_real most = toward_zero(s->step_t, s->t, PAIRS, -KOOPMPC_HUGE);
  most = toward_zero(s->step_lam, s->lam, PAIRS, most);
  most = toward_zero(s->step_eps, s->eps, EASED, most);
  return toward_zero(s->step_nu, s->nu, EASED, most);
}

/** The sum of products of pairs after this share of their steps. */
static koopmpc_real product(const koopmpc_real *a, const koopmpc_real *step_a, const koopmpc_real *b,
                            const koopmpc_real *step_b, int n, koopmpc_real share) {
  koopmpc_real sum[4] = {0, 0, 0, 0};
  for (int i = 0; i < n; i++) sum[i % 4] += (a[i] + share * step_a[i]) * (b[i] + share * step_b[i]);
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/** The mean product of the pairs after this share of the step. */
static koopmpc_real products(const koopmpc_state *s, koopmpc_real share) {
  return (product(s->t, s->step_t, s->lam, s->step_lam, PAIRS, share) +
          product(s->eps, s->step_eps, s->nu, s->step_nu, EASED, share)) /
         (koopmpc_real)(PAIRS + EASED);
}

static void add_step(koopmpc_real *to, const koopmpc_real *step, koopmpc_real length, int n) {
  for (int i = 0; i < n; i++) to[i] += length * step[i];
}

/** One predictor-corrector step, or with sigma > 0 one that aims at sigma mu everywhere; its length, NaN if it failed. */
static koopmpc_real interior(koopmpc_state *s, koopmpc_real mu, koopmpc_real sigma) {
  koopmpc_real length, centre = mu * sigma;
  koopmpc_fill(s->barrier, 0, STEPS * NQ);
  reach_of(s, s->dX, s->dU);
  for (int i = 0; i < SIDES; i++) {
    const koopmpc_real scale = koopmpc_sides_scale[i], *reach = s->reach + koopmpc_sides_row[i] * STEPS;
    koopmpc_real *barrier = s->barrier + koopmpc_sides_row[i] * STEPS;
    for (int k = 0; k < STEPS; k++) {
      const int at = i * STEPS + k, soft = at - HARD * STEPS;
      const koopmpc_real w = s->lam[at] / s->t[at];
      s->gap[at] = s->d_side[at] + scale * reach[k] - s->t[at];
      s->eased[at] = w;
      if (i >= HARD) {
        s->kappa[soft] = 1 / (koopmpc_sides_quadratic[i - HARD] + s->nu[soft] / s->eps[soft]);
        s->gap[at] += s->eps[soft];
        s->eased[at] = w / (1 + w * s->kappa[soft]);
      }
      barrier[k] += scale * scale * s->eased[at];
    }
  }
  factor(s, s->barrier);
  koopmpc_fill(s->second, 0, PAIRS);
  koopmpc_fill(s->second_eps, 0, EASED);
  if (!(sigma > 0)) {
    koopmpc_real share, ratio;
    newton(s, 0);
    share = 1 / larger(longest(s), 1);
    ratio = products(s, share) / mu;
    centre = mu * ratio * ratio * ratio;
    for (int i = 0; i < PAIRS; i++) s->second[i] = share * share * s->step_t[i] * s->step_lam[i];
    for (int i = 0; i < EASED; i++) s->second_eps[i] = share * share * s->step_eps[i] * s->step_nu[i];
  }
  newton(s, centre);
  length = 1 / larger(longest(s) / SHORT_OF, 1);
  if (!(length > 0 && koopmpc_usable(s->newX, STEPS * NS) && koopmpc_usable(s->newU, STEPS * NV)))
    return (koopmpc_real)NAN;
  add_step(s->dX, s->newX, length, STEPS * NS);
  add_step(s->dU, s->newU, length, STEPS * NV);
  add_step(s->t, s->step_t, length, PAIRS);
  add_step(s->lam, s->step_lam, length, PAIRS);
  add_step(s->eps, s->step_eps, length, EASED);
  add_step(s->nu, s->step_nu, length, EASED);
  return length;
}

/** The mean curvature of the cost along the span of an input, or its size where it has no limits. */
static koopmpc_real unit_of(const koopmpc_state *s) {
  koopmpc_real span[NV], sum = 0;
  int count = 0;
  koopmpc_copy(span, koopmpc_input_sizes, NV);
  for (int i = 0; i < SIDES; i++)
    if (koopmpc_sides_row[i] < NV) span[koopmpc_sides_row[i]] = koopmpc_sides_span[i];
  for (int k = 0; k < STEPS; k++)
    if (koopmpc_free[k]) {
      count += NV;
      for (int i = 0; i < NV; i++) sum += s->curvature[k * NV + i] * span[i] * span[i];
    }
  sum /= (koopmpc_real)count;
  return larger(sum, (koopmpc_real)1e-30);
}

/** Whether no first input inside its limits leads to a state inside its hard limits, row by row, as after wild readings. */
static int hard_limits_are_out_of_reach(const koopmpc_state *s) {
  koopmpc_real next[NS];
  for (int i = 0; i < NS; i++) next[i] = s->c[i] + koopmpc_dot(s->A + i * NS, s->start, NS);
  for (int row = 0; row < NG; row++) {
    const koopmpc_real *G = s->G + row * NS;
    koopmpc_real least = s->g[row] + koopmpc_dot(G, next, NS), most = least;
    if (!koopmpc_is_hard(row)) continue;
    for (int j = 0; j < NV; j++) {
      koopmpc_real gain = 0, one, other;
      for (int i = 0; i < NS; i++) gain += G[i] * s->B[i * NV + j];
      if (!(gain < 0 || gain > 0)) continue;
      one = gain * (koopmpc_low_of(s, 0, j) - s->V[j]);
      other = gain * (koopmpc_high_of(s, 0, j) - s->V[j]);
      least += one < other ? one : other;
      most += one < other ? other : one;
    }
    if (koopmpc_low_of(s, 0, NV + row) - most > koopmpc_softness_allowance[row] ||
        least - koopmpc_high_of(s, 0, NV + row) > koopmpc_softness_allowance[row])
      return 1;
  }
  return 0;
}

/** Follow the central path from the unconstrained solution. */
static koopmpc_status limited(koopmpc_state *s, int *iterations) {
  const koopmpc_real unit = unit_of(s);
  koopmpc_real least = KOOPMPC_HUGE, worst, start, price = 0, left = 1, initial, best = KOOPMPC_HUGE, mu, most = 0;
  int since = 0, enough = 0, narrow = 0;
  for (int i = 0; i < HARD; i++) /* between two equal limits there is no interior point */
    for (int k = 0; k < STEPS; k++)
      narrow |= !(koopmpc_low_of(s, k, koopmpc_sides_row[i]) < koopmpc_high_of(s, k, koopmpc_sides_row[i]));
  if (KOOPMPC_HARD_OUTPUTS && hard_limits_are_out_of_reach(s)) return KOOPMPC_INFEASIBLE;
  if (s->finishing || narrow) return koopmpc_finish(s, iterations);
  koopmpc_fill(s->step_t, 0, PAIRS);
  koopmpc_fill(s->step_lam, 0, PAIRS);
  koopmpc_fill(s->step_eps, 0, EASED);
  koopmpc_fill(s->step_nu, 0, EASED);
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < SIDES; i++) {
      const int at = i * STEPS + k, row = koopmpc_sides_row[i], up = koopmpc_sides_scale[i] > 0;
      const koopmpc_real end = up ? koopmpc_low_of(s, k, row) : koopmpc_high_of(s, k, row);
      s->d_side[at] = koopmpc_sides_scale[i] * (koopmpc_quantity(s, k, row) - end);
      s->t[at] = koopmpc_sides_scale[i] * (koopmpc_quantity(s, k, row) + koopmpc_moved(s, k, row, s->dX, s->dU) - end);
      if (s->t[at] < least) least = s->t[at];
    }
  worst = larger(-least, (koopmpc_real)1e-3);
  start = worst < 1 ? worst : 1;
  for (int k = 0; k < STEPS; k++)
    for (int i = 0; i < SIDES; i++) {
      const int at = i * STEPS + k, soft = at - HARD * STEPS;
      if (i >= HARD) {
        s->eps[soft] = larger(-s->t[at], start);
        s->nu[soft] = koopmpc_sides_linear[i - HARD] + koopmpc_sides_quadratic[i - HARD] * s->eps[soft];
        price += s->nu[soft];
        s->lam[at] = s->nu[soft] /= 2;
      }
      s->t[at] = larger(s->t[at], start);
      if (i < HARD) s->lam[at] = unit * start * worst / s->t[at];
    }
  if (SOFT) {
    price /= (koopmpc_real)(STEPS * (SOFT ? SOFT : 1));
    for (int i = 0; i < HARD * STEPS; i++) s->lam[i] = price * start / 2 / s->t[i];
  }
  for (int i = 0; i < PAIRS; i++) most = larger(s->lam[i], most);
  initial = larger(worst, most / unit);
  mu = products(s, 0);
  while (*iterations < KOOPMPC_INTERIOR) {
    koopmpc_real good, length;
    const koopmpc_real sigma = since == STALLED ? CENTRING : 0;
    since %= STALLED;
    length = interior(s, mu, sigma);
    ++*iterations;
    if (!(length > 0)) break;
    left *= 1 - length;
    mu = products(s, 0);
    if (mu <= best / 2) {
      best = mu;
      since = 0;
    } else {
      since++;
    }
    most = 0;
    for (int i = 0; i < PAIRS; i++) most = larger(s->lam[i], most);
    good = KOOPMPC_ENOUGH + KOOPMPC_DIGITS * most / unit;
    enough = mu <= good * unit && left * initial <= good;
    if ((mu <= KOOPMPC_PRECISE * unit && left * initial <= KOOPMPC_PRECISE) || length < KOOPMPC_STUCK ||
        (enough && since))
      break;
  }
  if (enough) return KOOPMPC_OPTIMAL;
  factor(s, 0);
  sweep(s, 0);
  koopmpc_fill(s->eps, 0, EASED);
  return koopmpc_finish(s, iterations);
}
#endif

koopmpc_status koopmpc_program(koopmpc_state *s, const koopmpc_real *x, koopmpc_real *first, int *iterations) {
  int inside = 1, good;
  linearise(s);
  for (int i = 0; i < NS; i++) s->start[i] = x[i] - s->S[i];
  factor(s, 0);
  sweep(s, 0);
  koopmpc_copy(s->dX, s->newX, STEPS * NS);
  koopmpc_copy(s->dU, s->newU, STEPS * NV);
  for (int i = 0; i < NV; i++) first[i] = s->V[i] + s->dU[i];
  good = koopmpc_usable(s->dX, STEPS * NS) && koopmpc_usable(s->dU, STEPS * NV);
  for (int k = 0; k < STEPS && inside; k++)
    for (int i = 0; i < NQ; i++) {
      const koopmpc_real value = koopmpc_quantity(s, k, i) + koopmpc_moved(s, k, i, s->dX, s->dU);
      inside &= value >= koopmpc_low_of(s, k, i) && value <= koopmpc_high_of(s, k, i);
    }
  koopmpc_fill(s->eps, 0, STEPS * SOFT);
  if (inside && good) return KOOPMPC_UNCONSTRAINED;
#if KOOPMPC_SIDES > 0
  if (good) {
    const int spent = s->spent;
    const koopmpc_status status = limited(s, iterations);
    if (s->spent == spent) s->spent += *iterations; /* no active-set method has finished it */
    return status;
  }
#else
  (void)iterations;
#endif
  return KOOPMPC_FAILED;
}

koopmpc_real koopmpc_cost(const koopmpc_state *s) {
  koopmpc_real seen[NR + NR * NS], limits[NG + NG * NS + 1], cost = 0;
  for (int k = 0; k < STEPS; k++) {
    const koopmpc_real *next = s->S + (k + 1) * NS;
    koopmpc_tracked(next, seen);
    if (k < STEPS - 1) {
      for (int i = 0; i < NR; i++)
        for (int j = 0; j < NR; j++)
          cost += (seen[i] - s->R[k * NR + i]) * koopmpc_Q[i * NR + j] * (seen[j] - s->R[k * NR + j]);
    } else {
      for (int row = 0; row < KOOPMPC_END; row++) {
        const koopmpc_real missed = koopmpc_dot(s->end_M + row * NR, seen, NR) +
                                    koopmpc_dot(s->end_L + row * NS, next, NS) - s->end_m[row];
        cost += missed * missed;
      }
    }
    for (int i = 0; i < NV; i++)
      for (int j = 0; j < NV; j++)
        cost += (s->V[k * NV + i] - s->U_r[k * NV + i]) * koopmpc_R[i * NV + j] *
                (s->V[k * NV + j] - s->U_r[k * NV + j]);
    if (NG) koopmpc_limited(next, limits);
    for (int i = 0; i < NG; i++) {
      const koopmpc_real under = koopmpc_low_of(s, k, NV + i) - limits[i];
      const koopmpc_real over = limits[i] - koopmpc_high_of(s, k, NV + i), past = under > over ? under : over;
      if (past > 0 && koopmpc_softness_linear[i] < KOOPMPC_HUGE)
        cost += past * (koopmpc_softness_linear[i] + koopmpc_softness_quadratic[i] * past);
    }
  }
  return cost;
}
