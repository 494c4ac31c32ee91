/* An oil volume with a cooler, FMI 2.0 for model exchange: the smallest FMU with an input, a parameter and a state.
 *
 *   heat dT/dt = flow (T_in - T) - UA (T - T_air)
 *
 * Compiled by the tests against the headers that fmpy brings along. The functions of FMI that it does not need are
 * there, as the standard asks, and refuse. */
#include <stdlib.h>
#include "fmi2Functions.h"

enum { FLOW, T_IN, T_AIR, UA, HEAT, TEMPERATURE, RATE, RETURN, N };
typedef struct { fmi2Real v[N]; } Tank;

static void reset(Tank *t) {
    const fmi2Real start[N] = { 250.0, 330.0, 295.0, 170.0, 40000.0, 300.0, 0.0, 0.0 };
    for (int i = 0; i < N; i++) t->v[i] = start[i];
}

static void solve(Tank *t) {
    fmi2Real *v = t->v;
    v[RATE] = (v[FLOW] * (v[T_IN] - v[TEMPERATURE]) - v[UA] * (v[TEMPERATURE] - v[T_AIR])) / v[HEAT];
    v[RETURN] = v[TEMPERATURE];
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    Tank *t = type == fmi2ModelExchange ? malloc(sizeof *t) : NULL;
    if (t) reset(t);
    return t;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { reset(c); return fmi2OK; }

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) {
        if (vr[i] == FLOW && value[i] < 0.0) return fmi2Discard;  /* so that a rejected point can be tried */
        ((Tank *)c)->v[vr[i]] = value[i];
    }
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    solve(c);
    for (size_t i = 0; i < n; i++) value[i] = ((Tank *)c)->v[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    ((Tank *)c)->v[TEMPERATURE] = x[0];
    return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    x[0] = ((Tank *)c)->v[TEMPERATURE];
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    solve(c);
    dx[0] = ((Tank *)c)->v[RATE];
    return fmi2OK;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    info->newDiscreteStatesNeeded = info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = info->valuesOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = fmi2False;
    return fmi2OK;
}

/* what needs nothing done */
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String of[]) { return fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d, fmi2Boolean e, fmi2Real f) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2EnterEventMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }

/* what it does not have */
#define REFUSED { return fmi2Error; }
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Integer v[]) REFUSED
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Boolean v[]) REFUSED
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2String v[]) REFUSED
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer v[]) REFUSED
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Boolean v[]) REFUSED
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2String v[]) REFUSED
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) REFUSED
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) REFUSED
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) REFUSED
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) REFUSED
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n) REFUSED
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s) REFUSED
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference u[], size_t n,
                                        const fmi2ValueReference k[], size_t m, const fmi2Real dk[], fmi2Real du[]) REFUSED
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *end) REFUSED
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) REFUSED
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) REFUSED
