/* A pendulum as an FMI 2 unit, model exchange and co-simulation: theta'' = -g sin(theta) - 0.1 theta' + tau. It refuses
   communication steps above 0.2 s, and ends the simulation where theta is above 100. Compiled with -DDRIVEN its torque
   depends on time; numbers of variables: 0 theta, 1 omega, 2 its derivative, 3 tau, 4 g, 5 reach. */
#include <math.h>
#include <stdlib.h>
#include "fmi2Functions.h"

typedef struct {
  double v[6], t;
  const fmi2CallbackFunctions *call;
} Unit;

static void start(Unit *m) {
  const double v[6] = {0.3, 0, 0, 0, 9.81, 0};
  for (int i = 0; i < 6; i++) m->v[i] = v[i];
  m->t = 0;
}
static void derive(Unit *m) {
  m->v[2] = -m->v[4] * sin(m->v[0]) - 0.1 * m->v[1] + m->v[3];
#ifdef DRIVEN
  m->v[2] += sin(m->t);
#endif
  m->v[5] = m->v[0] + m->v[3];
}
fmi2Component fmi2Instantiate(fmi2String n, fmi2Type k, fmi2String g, fmi2String r, const fmi2CallbackFunctions *f,
                              fmi2Boolean v, fmi2Boolean l) {
  Unit *m = calloc(1, sizeof(Unit));
  (void)n, (void)k, (void)g, (void)r, (void)v, (void)l;
  m->call = f;
  start(m);
  return m;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { start(c); return fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real t, fmi2Boolean d, fmi2Real e) {
  (void)a, (void)b, (void)d, (void)e;
  ((Unit *)c)->t = t;
  return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[]) {
  derive(c);
  for (size_t i = 0; i < n; i++) v[i] = ((Unit *)c)->v[r[i]];
  return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[]) {
  for (size_t i = 0; i < n; i++) ((Unit *)c)->v[r[i]] = v[i];
  return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean b) {
  Unit *m = c;
  (void)t, (void)b;
  if (h > 0.2) {
    m->call->logger(m->call->componentEnvironment, "pendulum", fmi2Discard, "step", "at most 0.2 s");
    return fmi2Discard;
  }
  for (int k = 0; k < 1000; k++) { /* semi-implicit Euler */
    derive(m);
    m->v[1] += h / 1000 * m->v[2];
    m->v[0] += h / 1000 * m->v[1];
    m->t += h / 1000;
  }
  return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { ((Unit *)c)->t = t; return fmi2OK; }
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
  for (size_t i = 0; i < n; i++) ((Unit *)c)->v[i] = x[i];
  return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
  for (size_t i = 0; i < n; i++) x[i] = ((Unit *)c)->v[i];
  return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real d[], size_t n) {
  Unit *m = c;
  (void)n;
  derive(m);
  d[0] = m->v[1];
  d[1] = m->v[2];
  return fmi2OK;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *e) {
  (void)c;
  e->newDiscreteStatesNeeded = e->terminateSimulation = fmi2False;
  e->nominalsOfContinuousStatesChanged = e->valuesOfContinuousStatesChanged = e->nextEventTimeDefined = fmi2False;
  return fmi2OK;
}
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean b, fmi2Boolean *e, fmi2Boolean *t) {
  (void)c, (void)b;
  *e = *t = fmi2False;
  return fmi2OK;
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { (void)c, (void)z, (void)n; return fmi2OK; }
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
  (void)c;
  for (size_t i = 0; i < n; i++) x[i] = 1;
  return fmi2OK;
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

/* what this unit does not need to do */
#define QUIET(name, ...) fmi2Status name(fmi2Component c, ##__VA_ARGS__) { (void)c; return fmi2OK; }
#define ABSENT(name, ...) fmi2Status name(fmi2Component c, __VA_ARGS__) { (void)c; return fmi2Error; }
QUIET(fmi2EnterInitializationMode)
QUIET(fmi2ExitInitializationMode)
QUIET(fmi2Terminate)
QUIET(fmi2EnterEventMode)
QUIET(fmi2EnterContinuousTimeMode)
typedef const fmi2ValueReference *Refs;
ABSENT(fmi2SetDebugLogging, fmi2Boolean b, size_t n, const fmi2String s[])
ABSENT(fmi2GetInteger, Refs r, size_t n, fmi2Integer v[])
ABSENT(fmi2GetBoolean, Refs r, size_t n, fmi2Boolean v[])
ABSENT(fmi2GetString, Refs r, size_t n, fmi2String v[])
ABSENT(fmi2SetInteger, Refs r, size_t n, const fmi2Integer v[])
ABSENT(fmi2SetBoolean, Refs r, size_t n, const fmi2Boolean v[])
ABSENT(fmi2SetString, Refs r, size_t n, const fmi2String v[])
ABSENT(fmi2GetFMUstate, fmi2FMUstate *s)
ABSENT(fmi2SetFMUstate, fmi2FMUstate s)
ABSENT(fmi2FreeFMUstate, fmi2FMUstate *s)
ABSENT(fmi2SerializedFMUstateSize, fmi2FMUstate s, size_t *n)
ABSENT(fmi2SerializeFMUstate, fmi2FMUstate s, fmi2Byte b[], size_t n)
ABSENT(fmi2DeSerializeFMUstate, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, Refs z, size_t nz, Refs v, size_t nv, const fmi2Real dv[],
                                        fmi2Real dz[]) {
  const double *x = ((Unit *)c)->v;
  for (size_t i = 0; i < nz; i++) {
    dz[i] = 0;
    for (size_t j = 0; j < nv; j++) {
      if (z[i] == v[j]) dz[i] += dv[j];
      if (z[i] == 2) dz[i] += dv[j] * (v[j] == 0 ? -x[4] * cos(x[0]) : v[j] == 1 ? -0.1 : v[j] == 3 ? 1 : 0);
      if (z[i] == 5) dz[i] += dv[j] * (v[j] == 0 || v[j] == 3);
    }
  }
  return fmi2OK;
}
ABSENT(fmi2SetRealInputDerivatives, Refs r, size_t n, const fmi2Integer o[], const fmi2Real v[])
ABSENT(fmi2GetRealOutputDerivatives, Refs r, size_t n, const fmi2Integer o[], fmi2Real v[])
QUIET(fmi2CancelStep)
ABSENT(fmi2GetStatus, const fmi2StatusKind k, fmi2Status *v)
ABSENT(fmi2GetRealStatus, const fmi2StatusKind k, fmi2Real *v)
ABSENT(fmi2GetIntegerStatus, const fmi2StatusKind k, fmi2Integer *v)
ABSENT(fmi2GetBooleanStatus, const fmi2StatusKind k, fmi2Boolean *v)
ABSENT(fmi2GetStringStatus, const fmi2StatusKind k, fmi2String *v)
