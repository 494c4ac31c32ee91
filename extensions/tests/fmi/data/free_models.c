/* Models without inputs, FMI 2.0 for model exchange, after equations that are public:
 *
 *   MODEL 1, Van der Pol (1926):       dx0/dt = x1,  dx1/dt = mu (1 - x0^2) x1 - x0
 *   MODEL 2, Dahlquist's test (1963):  dx/dt = -k x
 *   MODEL 3, a ball that bounces:      dh/dt = v,    dv/dt = g,  and v = -e v where h falls through 0; it lies still
 *                                      once it bounces at less than SLOWEST
 *   MODEL 4, stairs:                   no state; a count from 1 goes up every second, and ends it all at 10
 *
 * The last two have events: by an indicator, and by time. Both remember something that is no state: that the ball lies,
 * and the count. Compiled by the tests against the headers of fmpy. */
#include <float.h>
#include <stdlib.h>
#include "fmi2Functions.h"

enum { FIRST, SECOND, RATE_1, RATE_2, CONSTANT, OTHER, N };
typedef struct { fmi2Real v[N], time; int count, lies; } Model;

#define SLOWEST 0.1
#define LAST_COUNT 10
#if MODEL == 1
static const fmi2Real START[N] = { 2.0, 0.0, 0.0, 0.0, 1.0, 0.0 };
#elif MODEL == 2
static const fmi2Real START[N] = { 1.0, 0.0, 0.0, 0.0, 1.0, 0.0 };
#elif MODEL == 3
static const fmi2Real START[N] = { 1.0, 0.0, 0.0, 0.0, -9.81, 0.7 };
#else
static const fmi2Real START[N] = { 0.0 };
#endif
enum { STATES = MODEL == 1 || MODEL == 3 ? 2 : MODEL == 2 ? 1 : 0 };

static void reset(Model *m) {
    for (int i = 0; i < N; i++) m->v[i] = START[i];
    m->time = 0.0; m->count = 1; m->lies = 0;
}
static void solve(Model *m) {
    fmi2Real *v = m->v;
    (void)v;
#if MODEL == 1
    v[RATE_1] = v[SECOND];
    v[RATE_2] = v[CONSTANT] * (1.0 - v[FIRST] * v[FIRST]) * v[SECOND] - v[FIRST];
#elif MODEL == 2
    v[RATE_1] = -v[CONSTANT] * v[FIRST];
#elif MODEL == 3
    v[RATE_1] = v[SECOND];
    v[RATE_2] = m->lies ? 0.0 : v[CONSTANT];
#endif
}
#if MODEL == 3
static fmi2Boolean happens(Model *m) {
    fmi2Real *v = m->v;
    if (v[FIRST] > 0.0 || v[SECOND] >= 0.0) return fmi2False;
    v[FIRST] = DBL_MIN; v[SECOND] *= -v[OTHER];
    if (v[SECOND] < SLOWEST) { v[SECOND] = 0.0; m->lies = 1; }
    return fmi2True;
}
#elif MODEL == 4
static fmi2Boolean happens(Model *m) {
    if (m->time < m->count - 1e-9) return fmi2False;
    m->count++;
    return fmi2False;
}
#else
static fmi2Boolean happens(Model *m) { return fmi2False; }
#endif

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    Model *m = malloc(sizeof *m);
    if (m) reset(m);
    return m;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { reset(c); return fmi2OK; }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) ((Model *)c)->v[vr[i]] = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    solve(c);
    for (size_t i = 0; i < n; i++) value[i] = ((Model *)c)->v[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[]) {
    for (size_t i = 0; i < n; i++) value[i] = ((Model *)c)->count;
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    for (size_t i = 0; i < n; i++) ((Model *)c)->v[FIRST + i] = x[i];
    return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = ((Model *)c)->v[FIRST + i];
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    solve(c);
    for (size_t i = 0; i < n; i++) dx[i] = ((Model *)c)->v[RATE_1 + i];
    return fmi2OK;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    Model *m = c;
    info->valuesOfContinuousStatesChanged = happens(m);
    info->newDiscreteStatesNeeded = info->nominalsOfContinuousStatesChanged = fmi2False;
    info->terminateSimulation = MODEL == 4 && m->count >= LAST_COUNT ? fmi2True : fmi2False;
    info->nextEventTimeDefined = MODEL == 4 ? fmi2True : fmi2False;
    info->nextEventTime = m->count;
    return fmi2OK;
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
    if (n) z[0] = ((Model *)c)->lies ? 1.0 : ((Model *)c)->v[FIRST];
    return fmi2OK;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = 1.0;
    return fmi2OK;
}
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *end) {
    *event = *end = fmi2False;
    return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { ((Model *)c)->time = time; return fmi2OK; }

/* what needs nothing done */
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String of[]) { return fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d, fmi2Boolean e, fmi2Real f) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2EnterEventMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }

/* what it does not have */
#define REFUSED { return fmi2Error; }
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
