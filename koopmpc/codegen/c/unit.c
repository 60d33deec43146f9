/** @file unit.c @brief A controller as a Functional Mock-up Unit: what FMI 2 and FMI 3 share; never exported alone. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define UNIT __declspec(dllexport)
#elif defined(__GNUC__)
#define UNIT __attribute__((visibility("default")))
#else
#define UNIT
#endif

/** Value references: inputs y, reference and w, parameters x0, outputs u; then the integers. */
enum {
  UNIT_REFERENCE = KOOPMPC_NY,
  UNIT_W = UNIT_REFERENCE + KOOPMPC_NR,
  UNIT_X0 = UNIT_W + KOOPMPC_NW,
  UNIT_U = UNIT_X0 + KOOPMPC_NX,
  UNIT_REALS = UNIT_U + KOOPMPC_NU,
  UNIT_STATUS = UNIT_REALS,
  UNIT_FALLBACK,
  UNIT_ITERATIONS,
  UNIT_TIME
};

typedef struct {
  koopmpc_state state;
  double value[UNIT_REALS], time;
  int report[3]; /* status, fallback, iterations */
  void *owner;
  void *log;
} koopmpc_fmu;

typedef koopmpc_fmu *Unit;
typedef const unsigned *Refs;
typedef const char *const *Texts;
enum { OK = 0, DISCARD = 2, ERROR = 3 };
#define ABSENT(name) UNIT int name(void) { return ERROR; } /* importers load it without a call */

UNIT void FMI(FreeInstance)(Unit unit) { free(unit); }
UNIT int FMI(Reset)(Unit unit) {
  memset(unit->value, 0, sizeof unit->value);
  memset(unit->report, 0, sizeof unit->report);
  unit->time = 0;
  return OK;
}
/** Leave the initialisation: the controller starts with the parameters x0. */
UNIT int FMI(ExitInitializationMode)(Unit unit) {
  koopmpc_real x0[KOOPMPC_NX];
  for (int i = 0; i < KOOPMPC_NX; i++) x0[i] = (koopmpc_real)unit->value[UNIT_X0 + i];
  memset(&unit->state, 0, sizeof unit->state);
  koopmpc_init(&unit->state, x0, 0);
  return OK;
}
UNIT int FMI(Terminate)(Unit unit) { return unit ? OK : ERROR; }

/** Compute u from the inputs of this sample; returns 0 if the step is not one sample. */
static int koopmpc_fmu_step(koopmpc_fmu *unit, double time, double step) {
  koopmpc_real y[KOOPMPC_NY], r[KOOPMPC_NR], w[KOOPMPC_NW + 1], u[KOOPMPC_NU];
  const koopmpc_rows reference = {r, 1}, pushes = {w, 1};
  koopmpc_report report;
  if (!(step > KOOPMPC_DT * (1 - 1e-6) && step < KOOPMPC_DT * (1 + 1e-6))) return 0;
  for (int i = 0; i < KOOPMPC_NY; i++) y[i] = (koopmpc_real)unit->value[i];
  for (int i = 0; i < KOOPMPC_NR; i++) r[i] = (koopmpc_real)unit->value[UNIT_REFERENCE + i];
  for (int i = 0; i < KOOPMPC_NW; i++) w[i] = (koopmpc_real)unit->value[UNIT_W + i];
  koopmpc_step(&unit->state, y, &reference, 0, KOOPMPC_NW ? &pushes : 0, u, &report);
  for (int i = 0; i < KOOPMPC_NU; i++) unit->value[UNIT_U + i] = (double)u[i];
  unit->report[0] = (int)report.status;
  unit->report[1] = (int)report.fallback;
  unit->report[2] = report.iterations;
  unit->time = time + step;
  return 1;
}

static int koopmpc_fmu_get(const koopmpc_fmu *unit, const unsigned *refs, size_t count, double *values) {
  for (size_t i = 0; i < count; i++) {
    if (refs[i] >= (unsigned)UNIT_REALS && refs[i] != (unsigned)UNIT_TIME) return 0;
    values[i] = refs[i] == (unsigned)UNIT_TIME ? unit->time : unit->value[refs[i]];
  }
  return 1;
}

static int koopmpc_fmu_set(koopmpc_fmu *unit, const unsigned *refs, size_t count, const double *values) {
  for (size_t i = 0; i < count; i++) {
    if (refs[i] >= (unsigned)UNIT_U) return 0; /* outputs are computed here */
    unit->value[refs[i]] = values[i];
  }
  return 1;
}

static int koopmpc_fmu_get_whole(const koopmpc_fmu *unit, const unsigned *refs, size_t count, int *values) {
  for (size_t i = 0; i < count; i++) {
    if (refs[i] < (unsigned)UNIT_STATUS || refs[i] > (unsigned)UNIT_ITERATIONS) return 0;
    values[i] = unit->report[refs[i] - (unsigned)UNIT_STATUS];
  }
  return 1;
}

static void koopmpc_fmu_complain(char *text, size_t size, double step) {
  snprintf(text, size, "the step is %g s; this controller takes steps of %g s only", step, (double)KOOPMPC_DT);
}

/** `log` is where the address of the logger stands, NULL without one. */
static koopmpc_fmu *koopmpc_fmu_make(const char *token, void *owner, const void *log) {
  koopmpc_fmu *unit = 0;
  if (token && strcmp(token, KOOPMPC_TOKEN) == 0) unit = calloc(1, sizeof *unit);
  if (!unit) return 0;
  unit->owner = owner;
  if (log) memcpy(&unit->log, log, sizeof unit->log);
  return unit;
}
