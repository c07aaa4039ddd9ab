/* The functions of FMI 3.0 for Model Exchange and Co-Simulation around the heat balance of network.c.
   Every variable is a Float64 whose value reference is its position in `value`:
   time, states, their derivatives, inputs, outputs, parameters, event indicators. */

#include "fmi3Functions.h"
#include "network.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { STATES = 1, RATES = STATES + N_STATES, INPUTS = RATES + N_STATES, OUTPUTS = INPUTS + N_INPUTS };
enum { PARAMETERS = OUTPUTS + N_OUTPUTS, INDICATORS = PARAMETERS + N_PARAMETERS };
enum { N_INDICATORS = 2 * N_RELAYS, N_VARIABLES = INDICATORS + N_INDICATORS };

typedef struct {
    double value[N_VARIABLES];
    double tolerance, step; /* K per step of the integrator, and the step that it would take next */
    int known;              /* whether derivatives and outputs belong to the other values */
    double share[N_RELAYS + 1]; /* of full power that each thermostat has: 1 on, 0 off, or what its memory began with */
} Instance;

/* C arrays of no elements are not allowed: every vector has one more than it needs. */
static void rates_at(const Instance *m, double time, const double *states, double *rates) {
    network_rates(time, states, m->value + INPUTS, m->value + PARAMETERS, m->share, rates);
}

/* ---- Thermostats: a margin below zero calls one on (the first) or off (the second). */

static const double CLOSE_K = 1e-9; /* nearer to a threshold than this is at it */

static void margins(const Instance *m, int k, const double *states, double *margin) {
    const Relay *relay = network_relays + k;
    margin[0] = states[relay->node] - m->value[PARAMETERS + relay->on];
    margin[1] = m->value[PARAMETERS + relay->off] - states[relay->node];
}

/* Switch what lies at or beyond a threshold; return whether anything was switched. */
static int switch_relays(Instance *m, double *states) {
    int any = 0;
    for (int k = 0; k < N_RELAYS; k++) {
        double margin[2], share = m->share[k];
        margins(m, k, states, margin);
        if (margin[0] <= CLOSE_K) share = 1.0;
        else if (margin[1] <= CLOSE_K) share = 0.0;
        if (share == m->share[k]) continue;
        m->share[k] = share;
        states[network_relays[k].memory] = share == 1.0 ? network_relays[k].on_K : network_relays[k].off_K;
        m->known = 0;
        any = 1;
    }
    return any;
}

/* Let every thermostat be as its memory says, unless its temperature says otherwise. */
static void recall(Instance *m) {
    for (int k = 0; k < N_RELAYS; k++) {
        double off = network_relays[k].off_K, on = network_relays[k].on_K;
        double remembered = m->value[STATES + network_relays[k].memory];
        double share = (1.0 + UNSETTLED) * (remembered - off) / (on - off) - 0.5 * UNSETTLED;
        m->share[k] = fmin(fmax(share, 0.0), 1.0);
    }
    m->known = 0;
    switch_relays(m, m->value + STATES);
}

/* Return how far, in K, states lie beyond a threshold that has not switched yet; not above zero: beyond none. */
static double beyond(const Instance *m, const double *states) {
    double farthest = -1e300;
    for (int k = 0; k < N_RELAYS; k++) {
        double margin[2];
        margins(m, k, states, margin);
        if (m->share[k] != 1.0) farthest = fmax(farthest, -margin[0]);
        if (m->share[k] != 0.0) farthest = fmax(farthest, -margin[1]);
    }
    return farthest;
}

static void refresh(Instance *m) {
    if (m->known) return;
    rates_at(m, m->value[0], m->value + STATES, m->value + RATES);
    network_outputs(m->value[0], m->value + STATES, m->value + PARAMETERS, m->value + OUTPUTS);
    for (int k = 0; k < N_RELAYS; k++) {
        double *indicator = m->value + INDICATORS + 2 * k;
        margins(m, k, m->value + STATES, indicator);
        if (m->share[k] == 1.0) indicator[0] = 1.0; /* what is on is not called on again: no event */
        if (m->share[k] == 0.0) indicator[1] = 1.0;
    }
    m->known = 1;
}

static void restart(Instance *m) {
    memset(m, 0, sizeof *m);
    memcpy(m->value + STATES, network_start, N_STATES * sizeof(double));
    memcpy(m->value + INPUTS, network_inputs, N_INPUTS * sizeof(double));
    memcpy(m->value + PARAMETERS, network_parameters, N_PARAMETERS * sizeof(double));
    m->tolerance = 1e-8;
}

/* ---- Co-Simulation: a Rosenbrock method of order four with error control (Kaps and Rentrop, "Generalized Runge-Kutta
   methods of order four with stepsize control for stiff ordinary differential equations", Numer. Math. 33 (1979), with
   the coefficients of Shampine (1982)). Stiff nodes cost no small steps. */

static int factorise(double *a, int *pivot) {
    int n = N_STATES;
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        if (a[best * n + k] == 0.0 || !isfinite(a[best * n + k])) return 0;
        pivot[k] = best;
        if (best != k)
            for (int j = 0; j < n; j++) {
                double swap = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = swap;
            }
        for (int i = k + 1; i < n; i++) {
            double factor = a[i * n + k] /= a[k * n + k];
            if (factor != 0.0)
                for (int j = k + 1; j < n; j++) a[i * n + j] -= factor * a[k * n + j];
        }
    }
    return 1;
}

static void solve(const double *a, const int *pivot, double *b) {
    int n = N_STATES;
    for (int k = 0; k < n; k++) {
        double swap = b[k];
        b[k] = b[pivot[k]];
        b[pivot[k]] = swap;
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++) b[i] -= a[i * n + j] * b[j];
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++) b[i] -= a[i * n + j] * b[j];
        b[i] /= a[i * n + i];
    }
}

typedef struct {
    double *jacobian, *matrix, *begin, *now, *rate, *first, *by_time, *g[4], *error;
    int *pivot;
} Work;

static int allocate(Work *w) {
    size_t n = N_STATES;
    double *all = calloc(2 * n * n + 11 * n, sizeof(double));
    w->pivot = calloc(n + 1, sizeof(int));
    if (!all || !w->pivot) {
        free(all);
        free(w->pivot);
        return 0;
    }
    w->jacobian = all;
    w->matrix = all + n * n;
    double *rest = w->matrix + n * n;
    w->begin = rest, w->now = rest + n, w->rate = rest + 2 * n, w->first = rest + 3 * n, w->by_time = rest + 4 * n;
    for (int k = 0; k < 4; k++) w->g[k] = rest + (5 + k) * n;
    w->error = rest + 9 * n;
    return 1;
}

static void differentiate(const Instance *m, double time, double step, Work *w) {
    int n = N_STATES;
    rates_at(m, time, w->begin, w->first);
    memcpy(w->now, w->begin, n * sizeof(double));
    for (int j = 0; j < n; j++) {
        double by = 1e-4; /* K: rates are smooth over it, and it stands far above rounding */
        w->now[j] = w->begin[j] + by;
        rates_at(m, time, w->now, w->rate);
        w->now[j] = w->begin[j] - by;
        rates_at(m, time, w->now, w->error);
        w->now[j] = w->begin[j];
        for (int i = 0; i < n; i++) w->jacobian[i * n + j] = (w->rate[i] - w->error[i]) / (2.0 * by);
    }
    double by = 1e-3 * step;
    rates_at(m, time + by, w->begin, w->rate);
    for (int i = 0; i < n; i++) w->by_time[i] = (w->rate[i] - w->first[i]) / by;
}

/* Take one step from w->begin to w->now; return its largest error in K, or a negative number where it cannot be taken. */
static double attempt(const Instance *m, double time, double h, Work *w) {
    static const double gamma = 0.5, a[4][3] = {{0}, {2.0}, {48.0 / 25.0, 6.0 / 25.0}, {48.0 / 25.0, 6.0 / 25.0, 0.0}};
    static const double at[4] = {0.0, 1.0, 0.6, 0.6}, by_time[4] = {0.5, -1.5, 2.42, 0.116};
    static const double c[4][3] = {{0}, {-8.0}, {372.0 / 25.0, 2.4}, {-112.0 / 125.0, -54.0 / 125.0, -0.4}};
    static const double b[4] = {19.0 / 9.0, 0.5, 25.0 / 108.0, 125.0 / 108.0};
    static const double e[4] = {17.0 / 54.0, 7.0 / 36.0, 0.0, 125.0 / 108.0};
    int n = N_STATES;
    for (int i = 0; i < n * n; i++) w->matrix[i] = -w->jacobian[i];
    for (int i = 0; i < n; i++) w->matrix[i * n + i] += 1.0 / (gamma * h);
    if (!factorise(w->matrix, w->pivot)) return -1.0;
    for (int k = 0; k < 4; k++) {
        if (k == 0) memcpy(w->rate, w->first, n * sizeof(double));
        if (k == 1 || k == 2) { /* the fourth stage takes the rates of the third */
            for (int i = 0; i < n; i++) {
                w->now[i] = w->begin[i];
                for (int j = 0; j < k; j++) w->now[i] += a[k][j] * w->g[j][i];
            }
            rates_at(m, time + at[k] * h, w->now, w->rate);
        }
        for (int i = 0; i < n; i++) {
            w->g[k][i] = w->rate[i] + h * by_time[k] * w->by_time[i];
            for (int j = 0; j < k; j++) w->g[k][i] += c[k][j] * w->g[j][i] / h;
        }
        solve(w->matrix, w->pivot, w->g[k]);
    }
    double worst = 0.0;
    for (int i = 0; i < n; i++) {
        double sum = 0.0, error = 0.0;
        for (int k = 0; k < 4; k++) sum += b[k] * w->g[k][i], error += e[k] * w->g[k][i];
        w->now[i] = w->begin[i] + sum;
        if (!isfinite(w->now[i])) return -1.0;
        if (fabs(error) > worst) worst = fabs(error);
    }
    return worst;
}

/* Return the part of the step from w->begin to w->now, h long, after which a thermostat's node lies farthest beyond its
   threshold: 1 at the end, less where it turned round on the way (a cubic through both ends and their slopes tells). */
static double farthest_part(const Instance *m, double time, double h, Work *w) {
    double part = 1.0, most = beyond(m, w->now);
    rates_at(m, time + h, w->now, w->rate);
    for (int k = 0; k < N_RELAYS; k++) {
        int node = network_relays[k].node;
        double begin = h * w->first[node], end = h * w->rate[node], gap = w->now[node] - w->begin[node];
        if (begin * end >= 0.0) continue;
        double low = 0.0, high = 1.0, before[2];
        for (int i = 0; i < 40; i++) {
            double s = 0.5 * (low + high);
            double slope = begin * (1.0 - s) * (1.0 - 3.0 * s) + end * s * (3.0 * s - 2.0) + 6.0 * gap * s * (1.0 - s);
            if (slope * begin > 0.0) low = s;
            else high = s;
        }
        double r = 1.0 - low;
        double moved = gap * low * low * (3.0 - 2.0 * low) + begin * low * r * r - end * low * low * r;
        margins(m, k, w->begin, before);
        double past = moved < 0.0 ? -(before[0] + moved) : -(before[1] - moved);
        if (m->share[k] == (moved < 0.0 ? 1.0 : 0.0) || past <= fmax(most, CLOSE_K)) continue;
        part = low;
        most = past;
    }
    return part;
}

/* Shorten the step from w->begin, h long, so that it ends at the first threshold on its way; return its length. */
static double shorten(const Instance *m, double time, double h, Work *w) {
    double low = 0.0, high = h, past = beyond(m, w->now);
    while (past > CLOSE_K && high - low > 1e-14 * fabs(time + high)) {
        double middle = 0.5 * (low + high);
        attempt(m, time, middle, w);
        double there = beyond(m, w->now);
        if (there > 0.0) high = middle, past = there;
        else low = middle;
    }
    attempt(m, time, high, w);
    return high;
}

static fmi3Status march(Instance *m, double stop) {
    Work w;
    if (!allocate(&w)) return fmi3Error;
    double time = m->value[0], least = 1e-13 * fmax(fabs(stop), stop - time);
    fmi3Status status = fmi3OK;
    memcpy(w.begin, m->value + STATES, N_STATES * sizeof(double));
    switch_relays(m, w.begin);
    double h = m->step > 0.0 ? m->step : (stop - time) / 16.0;
    while (stop - time > 0.0) {
        int last = 0;
        if (h >= stop - time) h = stop - time, last = 1;
        differentiate(m, time, h, &w);
        for (;;) {
            double error = attempt(m, time, h, &w);
            if (error >= 0.0 && error <= m->tolerance) {
                double taken = h;
                if (N_RELAYS) {
                    double part = farthest_part(m, time, h, &w);
                    if (part < 1.0) attempt(m, time, taken = part * h, &w);
                    if (beyond(m, w.now) > 0.0) taken = shorten(m, time, taken, &w);
                }
                last &= taken == h;
                time = last ? stop : time + taken;
                memcpy(w.begin, w.now, N_STATES * sizeof(double));
                switch_relays(m, w.begin);
                double grown = error > 0.0 ? 0.9 * h * pow(error / m->tolerance, -0.25) : 4.0 * h;
                if (!last || grown < h) m->step = fmin(grown, 4.0 * h);
                else m->step = fmax(m->step, fmin(grown, 4.0 * h));
                h = m->step;
                break;
            }
            h = error < 0.0 ? 0.25 * h : fmax(0.9 * h * pow(error / m->tolerance, -1.0 / 3.0), 0.25 * h);
            last = 0;
            if (h < least) {
                status = fmi3Error;
                break;
            }
        }
        if (status != fmi3OK) break;
    }
    if (status == fmi3OK) {
        memcpy(m->value + STATES, w.begin, N_STATES * sizeof(double));
        m->value[0] = stop;
        m->known = 0;
    }
    free(w.jacobian);
    free(w.pivot);
    return status;
}

/* ---- FMI 3.0 */

const char *fmi3GetVersion(void) { return "3.0"; }

static fmi3Instance instantiate(fmi3String token) {
    if (!token || strcmp(token, TOKEN) != 0) return NULL;
    Instance *m = malloc(sizeof *m);
    if (m) restart(m);
    return m;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
    return instantiate(token);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference wanted[], size_t n_wanted,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    return instantiate(token);
}

void fmi3FreeInstance(fmi3Instance m) { free(m); }

fmi3Status fmi3SetDebugLogging(fmi3Instance m, fmi3Boolean on, size_t n, const fmi3String categories[]) { return fmi3OK; }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    Instance *m = instance;
    m->value[0] = start;
    m->known = 0;
    return fmi3OK;
}

#define NOTHING_TO_DO(name) \
    fmi3Status name(fmi3Instance m) { return fmi3OK; }
NOTHING_TO_DO(fmi3EnterEventMode)
NOTHING_TO_DO(fmi3Terminate)
NOTHING_TO_DO(fmi3EnterConfigurationMode)
NOTHING_TO_DO(fmi3ExitConfigurationMode)
NOTHING_TO_DO(fmi3EvaluateDiscreteStates)
NOTHING_TO_DO(fmi3EnterContinuousTimeMode)
NOTHING_TO_DO(fmi3EnterStepMode)

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    recall(instance);
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance m) {
    restart(m);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference at[], size_t n, fmi3Float64 values[], size_t size) {
    Instance *m = instance;
    refresh(m);
    if (n != size) return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        if (at[i] >= N_VARIABLES) return fmi3Error;
        values[i] = m->value[at[i]];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference at[], size_t n, const fmi3Float64 values[], size_t size) {
    Instance *m = instance;
    if (n != size) return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference k = at[i];
        int settable = (k >= STATES && k < RATES) || (k >= INPUTS && k < OUTPUTS) || (k >= PARAMETERS && k < N_VARIABLES);
        if (!settable || !isfinite(values[i])) return fmi3Error;
        if (m->value[k] != values[i]) m->known = 0, m->value[k] = values[i];
    }
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    Instance *m = instance;
    m->value[0] = time;
    m->known = 0;
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t n) {
    Instance *m = instance;
    if (n != N_STATES) return fmi3Error;
    memcpy(m->value + STATES, states, n * sizeof(double));
    m->known = 0;
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t n) {
    if (n != N_STATES) return fmi3Error;
    memcpy(states, ((Instance *)instance)->value + STATES, n * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 rates[], size_t n) {
    Instance *m = instance;
    if (n != N_STATES) return fmi3Error;
    refresh(m);
    memcpy(rates, m->value + RATES, n * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance m, fmi3Float64 nominals[], size_t n) {
    for (size_t i = 0; i < n; i++) nominals[i] = 300.0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance m, size_t *n) {
    *n = N_STATES;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance m, size_t *n) {
    *n = N_INDICATORS;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t n) {
    Instance *m = instance;
    if (n != N_INDICATORS) return fmi3Error;
    refresh(m);
    memcpy(indicators, m->value + INDICATORS, n * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance m, fmi3Boolean done, fmi3Boolean *event, fmi3Boolean *terminate) {
    *event = *terminate = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *states, fmi3Boolean *has_next, fmi3Float64 *next) {
    Instance *m = instance;
    *again = *terminate = *nominals = *has_next = fmi3False;
    *states = switch_relays(m, m->value + STATES) ? fmi3True : fmi3False;
    *next = 0.0;
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_return,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    Instance *m = instance;
    *event = *terminate = *early = fmi3False;
    *last = time;
    if (!(step > 0.0) || fabs(time - m->value[0]) > 1e-6 * fmax(1.0, fabs(time))) return fmi3Error;
    fmi3Status status = march(m, time + step);
    *last = m->value[0];
    return status;
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state) {
    if (!*state) *state = malloc(sizeof(Instance));
    if (!*state) return fmi3Error;
    memcpy(*state, instance, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state) {
    memcpy(instance, state, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance m, fmi3FMUState *state) {
    free(*state);
    *state = NULL;
    return fmi3OK;
}
