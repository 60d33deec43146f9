/** @file door.c @brief The functions by which Python calls a controller; appended to its C before compiling, never exported. */
#ifdef _WIN32
#define DOOR __declspec(dllexport)
#else
#define DOOR
#endif
typedef struct {
  koopmpc_state *state;
  koopmpc_real *y;
  koopmpc_rows reference;
  koopmpc_real *applied;
  koopmpc_rows w;
  koopmpc_real *u;
  koopmpc_report report;
  const void *bounds; /* the limits of this step, where they have rows in time */
} koopmpc_frame;
DOOR void koopmpc_call(koopmpc_frame *f) {
#if KOOPMPC_BOUNDS
  if (f->bounds) koopmpc_set_bounds(f->state, (const koopmpc_bounds *)f->bounds);
#endif
  koopmpc_step(f->state, f->y, &f->reference, f->applied, f->w.count ? &f->w : 0, f->u, &f->report);
}
DOOR long koopmpc_state_size(void) { return (long)sizeof(koopmpc_state); }

/* A whole run: the controller and the plant step by step, with a clock around the controller. */
typedef struct {
  long steps;
  int nx, ny, preview, measured;
  void (*step)(const double *x, const double *u, double *next);
  void (*measure)(const double *x, double *y);
  const koopmpc_real *rows, *W;
  double *X, *Y, *U, *slack, *times;
  int *reports;
} koopmpc_whole;
#ifndef KOOPMPC_FLOAT
static double koopmpc_now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
DOOR void koopmpc_run(koopmpc_frame *f, const koopmpc_whole *run) {
  for (long k = 0; k < run->steps; k++) {
    const koopmpc_rows reference = {run->rows + k * KOOPMPC_NR, run->preview ? KOOPMPC_HORIZON + 1 : 1};
    const koopmpc_rows w = {run->measured ? run->W + k * KOOPMPC_NW : 0,
                            run->preview && KOOPMPC_HORIZON > 0 ? KOOPMPC_HORIZON : 1};
    double *x = run->X + k * run->nx, *u = run->U + k * KOOPMPC_NU;
    const double start = run->times ? koopmpc_now() : 0;
    koopmpc_step(f->state, run->Y + k * run->ny, &reference, k ? u - KOOPMPC_NU : 0, run->measured ? &w : 0, u,
                 &f->report);
    if (run->times) run->times[k] = koopmpc_now() - start;
    run->reports[4 * k] = (int)f->report.status;
    run->reports[4 * k + 1] = (int)f->report.fallback;
    run->reports[4 * k + 2] = f->report.iterations;
    run->reports[4 * k + 3] = f->report.refused;
    run->slack[k] = f->report.slack;
    run->step(x, u, x + run->nx);
    run->measure(x + run->nx, run->Y + (k + 1) * run->ny);
  }
}
/* One step of many controllers side by side, each with a state of its own; `which` names those that take it. */
typedef struct {
  long count, size, stride;
  int first, measured;
  const long *which;
  char *states;
  const double *Y, *rows, *W;
  double *U;
  int *reports;
} koopmpc_abreast;
DOOR void koopmpc_step_abreast(const koopmpc_abreast *all) {
  const koopmpc_rows w = {all->W, KOOPMPC_HORIZON > 0 ? KOOPMPC_HORIZON : 1};
  for (long i = 0; i < all->count; i++) {
    const long e = all->which[i];
    const koopmpc_rows reference = {all->rows + e * all->stride, KOOPMPC_HORIZON + 1};
    double *u = all->U + e * KOOPMPC_NU, applied[KOOPMPC_NU];
    koopmpc_report report;
    for (int j = 0; j < KOOPMPC_NU; j++) applied[j] = u[j];
    koopmpc_step((koopmpc_state *)(all->states + e * all->size), all->Y + e * KOOPMPC_NY, &reference,
                 all->first ? 0 : applied, all->measured ? &w : 0, u, &report);
    all->reports[2 * e] = (int)report.status;
    all->reports[2 * e + 1] = (int)report.fallback;
  }
}
#endif
