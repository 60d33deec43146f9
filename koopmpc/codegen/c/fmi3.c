/** @file fmi3.c @brief The functions of FMI 3.0 for co-simulation; follows unit.c. Types as the standard defines them. */
#include <stdbool.h>
#include <stdint.h>

typedef void (*Logger)(void *, int, const char *, const char *);

UNIT const char *fmi3GetVersion(void) { return "3.0"; }

UNIT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                       bool logging, bool events, bool early, Refs intermediate, size_t count,
                                       void *environment, Logger logger, void *update) {
  (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
  (void)intermediate, (void)count, (void)update;
  return koopmpc_fmu_make(token, environment, &logger);
}
UNIT void *fmi3InstantiateModelExchange(void) { return 0; } /* whatever its arguments */
UNIT void *fmi3InstantiateScheduledExecution(void) { return 0; }
UNIT int fmi3EnterInitializationMode(Unit unit, bool defined, double tolerance, double start, bool ends, double stop) {
  (void)defined, (void)tolerance, (void)ends, (void)stop;
  unit->time = start;
  return OK;
}
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
ABSENT(fmi3GetBinary) ABSENT(fmi3SetBinary) ABSENT(fmi3GetClock) ABSENT(fmi3SetClock)
ABSENT(fmi3GetNumberOfVariableDependencies) ABSENT(fmi3GetVariableDependencies) ABSENT(fmi3GetFMUState)
ABSENT(fmi3SetFMUState) ABSENT(fmi3FreeFMUState) ABSENT(fmi3SerializedFMUStateSize) ABSENT(fmi3SerializeFMUState)
ABSENT(fmi3DeserializeFMUState) ABSENT(fmi3GetDirectionalDerivative) ABSENT(fmi3GetAdjointDerivative)
ABSENT(fmi3GetIntervalDecimal) ABSENT(fmi3GetIntervalFraction) ABSENT(fmi3GetShiftDecimal)
ABSENT(fmi3GetShiftFraction) ABSENT(fmi3SetIntervalDecimal) ABSENT(fmi3SetIntervalFraction)
ABSENT(fmi3SetShiftDecimal) ABSENT(fmi3SetShiftFraction) ABSENT(fmi3UpdateDiscreteStates)
ABSENT(fmi3GetOutputDerivatives) ABSENT(fmi3ActivateModelPartition) ABSENT(fmi3EnterContinuousTimeMode)
ABSENT(fmi3CompletedIntegratorStep) ABSENT(fmi3SetTime) ABSENT(fmi3SetContinuousStates)
ABSENT(fmi3GetContinuousStateDerivatives) ABSENT(fmi3GetEventIndicators) ABSENT(fmi3GetContinuousStates)
ABSENT(fmi3GetNominalsOfContinuousStates) ABSENT(fmi3GetNumberOfEventIndicators)
ABSENT(fmi3GetNumberOfContinuousStates)
