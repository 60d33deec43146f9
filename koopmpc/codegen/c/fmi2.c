/** @file fmi2.c @brief The functions of FMI 2.0 for co-simulation; follows unit.c. Types as the standard defines them. */
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
  Logger logger;
  void *allocate, *release, *finished;
  void *environment;
} Callbacks;

UNIT const char *fmi2GetTypesPlatform(void) { return "default"; }
UNIT const char *fmi2GetVersion(void) { return "2.0"; }

UNIT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                           const Callbacks *callbacks, int visible, int logging) {
  (void)name, (void)resources, (void)visible, (void)logging;
  if (type != 1) return 0;
  return koopmpc_fmu_make(guid, callbacks ? callbacks->environment : 0, callbacks ? &callbacks->logger : 0);
}
UNIT int fmi2SetupExperiment(Unit unit, int defined, double tolerance, double start, int ends, double stop) {
  (void)defined, (void)tolerance, (void)ends, (void)stop;
  unit->time = start;
  return OK;
}
UNIT int fmi2EnterInitializationMode(Unit unit) { return unit ? OK : ERROR; }

UNIT int fmi2GetReal(Unit unit, Refs refs, size_t count, double values[]) {
  return koopmpc_fmu_get(unit, refs, count, values) ? OK : ERROR;
}
UNIT int fmi2SetReal(Unit unit, Refs refs, size_t count, const double values[]) {
  return koopmpc_fmu_set(unit, refs, count, values) ? OK : ERROR;
}
UNIT int fmi2GetInteger(Unit unit, Refs refs, size_t count, int values[]) {
  return koopmpc_fmu_get_whole(unit, refs, count, values) ? OK : ERROR;
}

UNIT int fmi2DoStep(Unit unit, double time, double step, int keeps) {
  (void)keeps;
  if (koopmpc_fmu_step(unit, time, step)) return OK;
  if (unit->log) {
    Logger logger;
    char text[120];
    memcpy(&logger, &unit->log, sizeof logger);
    koopmpc_fmu_complain(text, sizeof text, step);
    logger(unit->owner, "koopmpc", DISCARD, "logStatusDiscard", "%s", text);
  }
  return DISCARD;
}
UNIT int fmi2SetDebugLogging(Unit unit, int on, size_t count, Texts categories) {
  (void)on, (void)count, (void)categories;
  return unit ? OK : ERROR;
}

#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
/* What this unit does not offer: calls with arguments succeed only if they ask for nothing. */
#define NOTHING(name, kind) \
  UNIT int name(Unit unit, Refs refs, size_t count, kind values) { \
    (void)unit, (void)refs, (void)values; \
    return count ? ERROR : OK; \
  }
NOTHING(fmi2GetBoolean, int *)
NOTHING(fmi2GetString, const char **)
NOTHING(fmi2SetInteger, const int *)
NOTHING(fmi2SetBoolean, const int *)
NOTHING(fmi2SetString, Texts)
ABSENT(fmi2CancelStep) ABSENT(fmi2GetFMUstate) ABSENT(fmi2SetFMUstate) ABSENT(fmi2FreeFMUstate)
ABSENT(fmi2SerializedFMUstateSize) ABSENT(fmi2SerializeFMUstate) ABSENT(fmi2DeSerializeFMUstate)
ABSENT(fmi2GetDirectionalDerivative) ABSENT(fmi2SetRealInputDerivatives) ABSENT(fmi2GetRealOutputDerivatives)
ABSENT(fmi2GetStatus) ABSENT(fmi2GetRealStatus) ABSENT(fmi2GetIntegerStatus) ABSENT(fmi2GetBooleanStatus)
ABSENT(fmi2GetStringStatus)
