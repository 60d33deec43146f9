/** @file fmi3.c @brief The functions of FMI 3.0 for co-simulation; follows unit.c. Types as the standard defines them. */
#include <stdbool.h>
#include <stdint.h>

typedef koopmpc_fmu *Unit;
typedef void (*Logger)(void *, int, const char *, const char *);
typedef const unsigned *Refs;
typedef const char *const *Texts;
enum { OK = 0, DISCARD = 2, ERROR = 3 };

UNIT const char *fmi3GetVersion(void) { return "3.0"; }

UNIT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                       bool logging, bool events, bool early, Refs intermediate, size_t count,
                                       void *environment, Logger logger, void *update) {
  Unit unit = koopmpc_fmu_make(token, environment, 0);
  (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
  (void)intermediate, (void)count, (void)update;
  if (unit) memcpy(&unit->log, &logger, sizeof unit->log);
  return unit;
}
UNIT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
                                        bool logging, void *environment, Logger logger) {
  (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
  return 0;
}
UNIT void *fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *resources, bool visible,
                                             bool logging, void *environment, Logger logger, void *clock, void *lock,
                                             void *unlock) {
  (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
  (void)clock, (void)lock, (void)unlock;
  return 0;
}
UNIT void fmi3FreeInstance(Unit unit) { free(unit); }
UNIT int fmi3Reset(Unit unit) {
  koopmpc_fmu_reset(unit);
  return OK;
}
UNIT int fmi3EnterInitializationMode(Unit unit, bool defined, double tolerance, double start, bool ends, double stop) {
  (void)defined, (void)tolerance, (void)ends, (void)stop;
  unit->time = start;
  return OK;
}
UNIT int fmi3ExitInitializationMode(Unit unit) {
  koopmpc_fmu_start(unit);
  return OK;
}
UNIT int fmi3Terminate(Unit unit) { return unit ? OK : ERROR; }
UNIT int fmi3EnterStepMode(Unit unit) { return unit ? OK : ERROR; }
UNIT int fmi3EnterEventMode(Unit unit) { return unit ? ERROR : ERROR; }
UNIT int fmi3EnterConfigurationMode(Unit unit) { return unit ? OK : ERROR; }
UNIT int fmi3ExitConfigurationMode(Unit unit) { return unit ? OK : ERROR; }
UNIT int fmi3EvaluateDiscreteStates(Unit unit) { return unit ? OK : ERROR; }

UNIT int fmi3GetFloat64(Unit unit, Refs refs, size_t count, double values[], size_t size) {
  return size == count && koopmpc_fmu_get(unit, refs, count, values) ? OK : ERROR;
}
UNIT int fmi3SetFloat64(Unit unit, Refs refs, size_t count, const double values[], size_t size) {
  return size == count && koopmpc_fmu_set(unit, refs, count, values) ? OK : ERROR;
}
UNIT int fmi3GetInt32(Unit unit, Refs refs, size_t count, int32_t values[], size_t size) {
  return size == count && koopmpc_fmu_get_whole(unit, refs, count, values) ? OK : ERROR;
}

UNIT int fmi3DoStep(Unit unit, double time, double step, bool keeps, bool *event, bool *ends, bool *early, double *last) {
  (void)keeps;
  *event = *ends = *early = false;
  *last = time;
  if (koopmpc_fmu_step(unit, time, step)) {
    *last = time + step;
    return OK;
  }
  if (unit->log) {
    Logger logger;
    char text[120];
    memcpy(&logger, &unit->log, sizeof logger);
    koopmpc_fmu_complain(text, sizeof text, step);
    logger(unit->owner, DISCARD, "logStatusDiscard", text);
  }
  return DISCARD;
}
UNIT int fmi3SetDebugLogging(Unit unit, bool on, size_t count, Texts categories) {
  (void)on, (void)count, (void)categories;
  return unit ? OK : ERROR;
}

#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
/* What this unit does not offer: calls with arguments succeed only if they ask for nothing. */
#define NOTHING(name, kind) \
  UNIT int name(Unit unit, Refs refs, size_t count, kind values, size_t size) { \
    (void)unit, (void)refs, (void)values, (void)size; \
    return count ? ERROR : OK; \
  }
#define NONE_OF(name, type) NOTHING(fmi3Get##name, type *) NOTHING(fmi3Set##name, const type *)
NONE_OF(Float32, float)
NONE_OF(Int8, int8_t)
NONE_OF(UInt8, uint8_t)
NONE_OF(Int16, int16_t)
NONE_OF(UInt16, uint16_t)
NONE_OF(UInt32, uint32_t)
NONE_OF(Int64, int64_t)
NONE_OF(UInt64, uint64_t)
NONE_OF(Boolean, bool)
NOTHING(fmi3SetInt32, const int32_t *)
NOTHING(fmi3GetString, const char **)
NOTHING(fmi3SetString, Texts)
#define ABSENT(name, ...) \
  UNIT int name(Unit unit, __VA_ARGS__) { return unit ? ERROR : ERROR; }
ABSENT(fmi3GetBinary, Refs refs, size_t count, size_t sizes[], const uint8_t *values[], size_t size)
ABSENT(fmi3SetBinary, Refs refs, size_t count, const size_t sizes[], const uint8_t *const values[], size_t size)
ABSENT(fmi3GetClock, Refs refs, size_t count, bool values[])
ABSENT(fmi3SetClock, Refs refs, size_t count, const bool values[])
ABSENT(fmi3GetNumberOfVariableDependencies, unsigned ref, size_t *count)
ABSENT(fmi3GetVariableDependencies, unsigned ref, size_t a[], unsigned b[], size_t c[], int d[], size_t count)
ABSENT(fmi3GetFMUState, void **state)
ABSENT(fmi3SetFMUState, void *state)
ABSENT(fmi3FreeFMUState, void **state)
ABSENT(fmi3SerializedFMUStateSize, void *state, size_t *size)
ABSENT(fmi3SerializeFMUState, void *state, uint8_t bytes[], size_t size)
ABSENT(fmi3DeserializeFMUState, const uint8_t bytes[], size_t size, void **state)
ABSENT(fmi3GetDirectionalDerivative, Refs z, size_t nz, Refs v, size_t nv, const double s[], size_t ns, double d[], size_t nd)
ABSENT(fmi3GetAdjointDerivative, Refs z, size_t nz, Refs v, size_t nv, const double s[], size_t ns, double d[], size_t nd)
ABSENT(fmi3GetIntervalDecimal, Refs refs, size_t count, double intervals[], int qualifiers[])
ABSENT(fmi3GetIntervalFraction, Refs refs, size_t count, uint64_t counters[], uint64_t resolutions[], int qualifiers[])
ABSENT(fmi3GetShiftDecimal, Refs refs, size_t count, double shifts[])
ABSENT(fmi3GetShiftFraction, Refs refs, size_t count, uint64_t counters[], uint64_t resolutions[])
ABSENT(fmi3SetIntervalDecimal, Refs refs, size_t count, const double intervals[])
ABSENT(fmi3SetIntervalFraction, Refs refs, size_t count, const uint64_t counters[], const uint64_t resolutions[])
ABSENT(fmi3SetShiftDecimal, Refs refs, size_t count, const double shifts[])
ABSENT(fmi3SetShiftFraction, Refs refs, size_t count, const uint64_t counters[], const uint64_t resolutions[])
ABSENT(fmi3UpdateDiscreteStates, bool *a, bool *b, bool *c, bool *d, bool *e, double *f)
ABSENT(fmi3GetOutputDerivatives, Refs refs, size_t count, const int32_t orders[], double values[], size_t size)
ABSENT(fmi3ActivateModelPartition, unsigned clock, double time)
/* Model exchange, which importers load without a call. */
ABSENT(fmi3EnterContinuousTimeMode, void *none)
ABSENT(fmi3CompletedIntegratorStep, bool keeps, bool *event, bool *ends)
ABSENT(fmi3SetTime, double time)
ABSENT(fmi3SetContinuousStates, const double states[], size_t count)
ABSENT(fmi3GetContinuousStateDerivatives, double slopes[], size_t count)
ABSENT(fmi3GetEventIndicators, double indicators[], size_t count)
ABSENT(fmi3GetContinuousStates, double states[], size_t count)
ABSENT(fmi3GetNominalsOfContinuousStates, double sizes[], size_t count)
ABSENT(fmi3GetNumberOfEventIndicators, size_t *count)
ABSENT(fmi3GetNumberOfContinuousStates, size_t *count)
