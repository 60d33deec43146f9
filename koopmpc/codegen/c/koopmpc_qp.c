/** @file koopmpc_qp.c @brief DAQP on memory that belongs to the caller. */
#include "koopmpc_names.h"
#include "koopmpc_step.h"

#include "daqp/daqp.h"

#ifdef KOOPMPC_FLOAT
enum { REFINEMENTS = 2 }; /* floats leave active rows off by their rounding */
#else
enum { REFINEMENTS = 1 };
#endif

/** Whether rounding may have left active rows off by more than the tolerance, as DAQP judges it. */
static int rounded(const DAQPWorkspace *work, int transformed) {
  koopmpc_real least = 1, off = (koopmpc_real)(DAQP_REFINE_GAIN * 2.3e-16);
  if (transformed || REFINEMENTS > 1) return 1;
  for (int i = 0; i < work->n_active; i++) {
    if (work->D[i] < least) least = work->D[i];
    if (work->sense[work->WS[i]] & DAQP_SOFT) return 0;
  }
  return off * off * work->fval > KOOPMPC_SETTINGS_PRIMAL_TOL * KOOPMPC_SETTINGS_PRIMAL_TOL * least * least;
}

enum { ROWS_CHANGED = 2 };
enum { ACTIVE_ROWS, SINGULAR_ROW, SWAPPED };

static koopmpc_real *share(koopmpc_real **reals, int n) {
  koopmpc_real *mine = *reals;
  *reals += n;
  return mine;
}

koopmpc_qp_memory koopmpc_qp_on(const koopmpc_qp *qp, koopmpc_real *reals, int *ints) {
  const int n = qp->n, m = qp->m, k = n + qp->soft + 1;
  koopmpc_qp_memory mem;
  mem.hard_alone = 0;
  mem.low = share(&reals, m);
  mem.high = share(&reals, m);
  mem.dlow = share(&reals, m);
  mem.dhigh = share(&reals, m);
  mem.product = share(&reals, m);
  mem.dual = share(&reals, m);
  mem.primal = share(&reals, n);
  mem.u = share(&reals, n);
  mem.lam = share(&reals, k);
  mem.lam_star = share(&reals, k);
  mem.D = share(&reals, k);
  mem.xldl = share(&reals, k);
  mem.zldl = share(&reals, k);
  mem.L = reals;
  mem.held = ints;
  mem.sense = ints + 3;
  mem.WS = mem.sense + m;
  return mem;
}

/** Mark the rows from which to start, and rows with two equal limits; 0 if limits cross. */
static int marked(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push, int resume) {
  const int one = DAQP_ACTIVE | DAQP_IMMUTABLE | DAQP_AUTO_EQUALITY;
  int result = 1, narrow = 0, known = 0;
  for (int i = 0; i < qp->m; i++) narrow |= !(mem->dhigh[i] - mem->dlow[i] >= KOOPMPC_SETTINGS_ZERO_TOL);
  if (resume && !push && !narrow) {
    for (int i = 0; i < qp->m; i++) known |= mem->sense[i];
    if (!(known & DAQP_AUTO_EQUALITY)) return 1;
  }
  for (int i = 0; i < qp->m; i++) {
    const koopmpc_real width = mem->dhigh[i] - mem->dlow[i];
    int sense = resume ? mem->sense[i] : qp->sense[i];
    if (push && push[i] > 0) sense |= DAQP_ACTIVE;
    if (push && push[i] < 0) sense |= DAQP_ACTIVE | DAQP_LOWER;
    if (!(width >= -KOOPMPC_SETTINGS_PRIMAL_TOL)) return 0;
    if (width < KOOPMPC_SETTINGS_ZERO_TOL && !(sense & DAQP_SOFT)) {
      if ((sense & one) != one) result = ROWS_CHANGED;
      sense |= one;
    } else if (sense & DAQP_AUTO_EQUALITY) {
      result = ROWS_CHANGED;
      sense &= ~one;
    }
    mem->sense[i] = sense;
  }
  return result;
}

koopmpc_qp_end koopmpc_qp_solve(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push,
                                koopmpc_real wider, int resume) {
  const DAQPWorkspace empty = {0};
  DAQPSettings settings = KOOPMPC_SETTINGS;
  DAQPWorkspace work = empty;
  koopmpc_qp_end end = {DAQP_EXIT_INFEASIBLE, 0};
  const int n = qp->n, m = qp->m;
  int rows;

  for (int j = 0; j < n; j++) mem->primal[j] = mem->u[j] = 0;
  for (int i = 0; i < m; i++) mem->dual[i] = 0;
  koopmpc_copy(mem->dlow, mem->low, m);
  koopmpc_copy(mem->dhigh, mem->high, m);
  for (int i = 0; i < m && wider > 0; i++) {
    mem->dlow[i] -= wider * (1 + koopmpc_abs(mem->low[i]));
    mem->dhigh[i] += wider * (1 + koopmpc_abs(mem->high[i]));
  }
  for (int i = 0; i < m && mem->hard_alone; i++)
    if (qp->sense[i]) mem->dlow[i] = -KOOPMPC_HUGE, mem->dhigh[i] = KOOPMPC_HUGE;
  rows = marked(qp, mem, push, resume);
  if (!rows) return end;
  for (int i = 0; i < m; i++) {
    mem->dlow[i] *= qp->scaling[i];
    mem->dhigh[i] *= qp->scaling[i];
  }
  work.settings = &settings;
  work.n = n;
  work.m = m;
  work.M = (koopmpc_real *)qp->M; /* DAQP reads it only */
  work.scaling = (koopmpc_real *)qp->scaling;
  work.Rinv = 0; /* rows of M hold it; the solution is transformed back below */
  work.dlower = mem->dlow;
  work.dupper = mem->dhigh;
  work.sense = mem->sense;
  work.x = work.u = mem->u;
  work.lam = mem->held[SWAPPED] && resume ? mem->lam_star : mem->lam;
  work.lam_star = mem->held[SWAPPED] && resume ? mem->lam : mem->lam_star;
  work.D = mem->D;
  work.L = mem->L;
  work.xldl = mem->xldl;
  work.zldl = mem->zldl;
  work.WS = mem->WS;
  work.Mu = mem->product;
  work.outer_iter = 1;
  if (qp->soft) {
    work.rho_ls = work.rho_us = (koopmpc_real *)qp->rho;
    work.w_ls = work.w_us = (koopmpc_real *)qp->linear;
  }
  reset_daqp_workspace(&work);
  if (resume) {
    work.n_active = mem->held[ACTIVE_ROWS];
    work.sing_ind = mem->held[SINGULAR_ROW];
  }
  if (!resume || rows == ROWS_CHANGED || !work.n_active) {
    reset_daqp_workspace(&work);
    end.flag = daqp_activate_constraints(&work);
    if (end.flag < 0) return end;
  }
  end.flag = daqp_ldp(&work);
  mem->held[ACTIVE_ROWS] = work.n_active;
  mem->held[SINGULAR_ROW] = work.sing_ind;
  mem->held[SWAPPED] = work.lam == mem->lam_star;
  end.iterations = work.iterations;
  if (end.flag <= 0) return end;
  if (work.n_active > 0 && work.sing_ind == DAQP_EMPTY_IND && rounded(&work, qp->rinv != 0))
  {
    for (int pass = 0; pass < REFINEMENTS; pass++) daqp_refine_active(&work);
    daqp_compute_Mu(&work);
  }
  for (int i = 0; i < work.n_active; i++)
    mem->dual[work.WS[i]] = work.lam_star[i] * qp->scaling[work.WS[i]];
  if (qp->rinv) {
    const koopmpc_real *r = qp->rinv;
    for (int i = 0; i < n; i++)
      for (int j = i; j < n; j++) mem->primal[i] += *r++ * work.u[j];
  } else {
    for (int j = 0; j < n; j++) mem->primal[j] = work.u[j];
  }
  return end;
}

/** Whether x + M' lambda = 0 and low <= M x <= high hold, and soft rows give way at their price. */
static int accurate(const koopmpc_qp *problem, const koopmpc_qp_memory *qp) {
  const int n = problem->n, m = problem->m;
  koopmpc_real stationarity = 0, size = 1, near;
  koopmpc_real *pull = qp->u; /* the solution is in primal, too */
  koopmpc_fill(pull, 0, n);
  for (int i = 0; i < m; i++) {
    if (qp->dual[i] < 0 || qp->dual[i] > 0) {
      const koopmpc_real push = qp->dual[i] / problem->scaling[i], *row = problem->M + i * n;
      for (int j = 0; j < n; j++) pull[j] += push * row[j];
    }
  }
  for (int j = 0; j < n; j++) {
    size = koopmpc_most(koopmpc_most(size, pull[j]), qp->primal[j]);
    stationarity = koopmpc_most(stationarity, pull[j] + qp->primal[j]);
  }
#ifdef KOOPMPC_FLOAT
  size = koopmpc_most(size, koopmpc_largest(qp->dual, m)); /* the sum above is rounded by a share of its largest term */
#endif
  if (!(stationarity <= KOOPMPC_ACCURACY * size)) return 0;
  near = KOOPMPC_ACCURACY * koopmpc_most(koopmpc_largest(qp->product, m), 1);
  for (int i = 0; i < m; i++) {
    const koopmpc_real over = qp->product[i] - qp->dhigh[i] / problem->scaling[i];
    const koopmpc_real under = qp->dlow[i] / problem->scaling[i] - qp->product[i];
    const koopmpc_real outside = over > under ? over : under, push = koopmpc_abs(qp->dual[i]);
    if (outside <= near && !(push > 0)) continue;
    if (!problem->sense[i]) {
      if (!(outside <= near)) return 0;
    } else {
      const koopmpc_real linear = problem->linear[i], curved = 1 / problem->rho[i];
      const koopmpc_real slack = outside > 0 ? outside : 0, price = linear + curved * slack;
      const koopmpc_real little = KOOPMPC_ACCURACY * (size + linear);
      if (!(push - price <= little + curved * near)) return 0;
      if (slack > near && !(price - push - curved * near <= little)) return 0;
      if (push > KOOPMPC_ACCURACY * size && !(-(qp->dual[i] > 0 ? over : under) <= near)) return 0;
    }
  }
  return 1;
}

static koopmpc_qp_end attempt(const koopmpc_qp *problem, koopmpc_qp_memory *qp, const koopmpc_real *push,
                              koopmpc_real wider, int resume, int *good) {
  const koopmpc_qp_end end = koopmpc_qp_solve(problem, qp, push, wider, resume);
  if (end.flag > 0)
    for (int i = 0; i < problem->m; i++) qp->product[i] /= problem->scaling[i]; /* DAQP's last product M u */
  *good = end.flag == 1 || (end.flag > 1 && accurate(problem, qp));
  return end;
}

int koopmpc_qp_contradicts(const koopmpc_qp *qp, koopmpc_qp_memory *mem) {
  int good, proved;
  mem->hard_alone = 1;
  proved = attempt(qp, mem, 0, 0, 0, &good).flag == -1 && !good;
  if (proved) proved = attempt(qp, mem, 0, KOOPMPC_WIDER, 0, &good).flag == -1 && !good;
  return mem->hard_alone = proved;
}

koopmpc_qp_end koopmpc_qp_find(const koopmpc_qp *qp, koopmpc_qp_memory *mem, const koopmpc_real *push, int resume,
                               int *good) {
  const koopmpc_qp_end first = attempt(qp, mem, push, 0, resume, good);
  const int none = first.flag == -1, mixed = qp->soft > 0 && qp->soft < qp->m;
  koopmpc_qp_end end;
  if (*good || (none && (qp->doubtful || (mixed && koopmpc_qp_contradicts(qp, mem))))) return first;
  end = attempt(qp, mem, 0, KOOPMPC_WIDER, 0, good);
  end.iterations += first.iterations;
  *good *= 2;
  return end;
}
