"""The functions of FMI 2.0 and 3.0 around a system in C: what a unit's library exports."""

from __future__ import annotations

import re

from ..lti.statespace import StateSpace

#: the types are those that the specification names, spelled out where they are pointers or numbers
_COMMON = """\
/* Co-simulation of {name}: samples of {dt:.17g} s, inputs held between communication points. */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include "{name}.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

#define IN {m}
#define OUT {p}
#define DT {dt:.17g}
/* part of a sample by which a communication point may be early */
#define EARLY 1e-6

enum {{ OK = 0, WARNING = 1, ERROR = 3 }};

typedef struct {{
    {name}_t core;
    double in[IN + 1];
    double out[OUT];
    double start;
    double time;
    double done; /* samples */
    int fresh; /* out belongs to in */
}} unit;

static unit *made(const char *token)
{{
    unit *self;
    if (token == NULL || strcmp(token, "@TOKEN@") != 0) {{
        return NULL;
    }}
    self = (unit *)calloc(1, sizeof *self);
    if (self != NULL) {{
        {name}_reset(&self->core);
    }}
    return self;
}}

static int again(unit *self)
{{
    memset(self, 0, sizeof *self);
    {name}_reset(&self->core);
    return OK;
}}

static void computed(unit *self)
{{
    if (!self->fresh) {{
        {name}_output(&self->core, self->in, self->out);
        self->fresh = 1;
    }}
}}

static int read(unit *self, const unsigned int *which, size_t count, double *values)
{{
    size_t k;
    for (k = 0; k < count; ++k) {{
        const unsigned int at = which[k];
        if (at > IN + OUT) {{
            return ERROR;
        }}
        if (at == 0) {{
            values[k] = self->time;
        }} else if (at <= IN) {{
            values[k] = self->in[at - 1];
        }} else {{
            computed(self);
            values[k] = self->out[at - 1 - IN];
        }}
    }}
    return OK;
}}

static int write(unit *self, const unsigned int *which, size_t count, const double *values)
{{
    size_t k;
    for (k = 0; k < count; ++k) {{
        if (which[k] < 1 || which[k] > IN) {{
            return ERROR;
        }}
        self->in[which[k] - 1] = values[k];
        self->fresh = 0;
    }}
    return OK;
}}

static int stepped(unit *self, double time, double step)
{{
    int status = OK;
    self->time = time + step;
    while (self->done + 1.0 <= (self->time - self->start) / DT + EARLY) {{
        computed(self);
        status = self->core.fault ? WARNING : status;
        {name}_update(&self->core, self->in);
        self->done += 1.0;
        self->fresh = 0;
    }}
    return status;
}}

static int kept(const unit *self, void **state)
{{
    if (*state == NULL) {{
        *state = malloc(sizeof *self);
    }}
    if (*state == NULL) {{
        return ERROR;
    }}
    memcpy(*state, self, sizeof *self);
    return OK;
}}

static int dropped(void **state)
{{
    if (state != NULL) {{
        free(*state);
        *state = NULL;
    }}
    return OK;
}}

"""

#: what many functions share in their parameters, and bodies of those that do nothing
_SHORT = {
    "$C": "void *c",
    "$V": "void *c, const unsigned int *v, size_t n",
    "$M": "const char *label, const char *token, const char *place, _Bool visible, _Bool logging",
}
_BODIES = {"": "return ERROR;", "ok": "return OK;", "none": "return n ? ERROR : OK;"}
#: one function a line, int unless another result is written; without a body it is not supported
_TWO = """
const char *GetTypesPlatform(void): return "default";
const char *GetVersion(void): return "2.0";
SetDebugLogging($C, int on, size_t n, const char *const *list): ok
void *Instantiate(const char *label, int kind, const char *token, const char *place, const \
    void *calls, int visible, int logging): return kind == 1 ? made(token) : NULL;
void FreeInstance($C): free(c);
SetupExperiment($C, int tolerant, double tolerance, double start, int ends, double stop): \
    ((unit *)c)->start = ((unit *)c)->time = start; return OK;
EnterInitializationMode($C): ok
ExitInitializationMode($C): ok
Terminate($C): ok
Reset($C): return again((unit *)c);
GetReal($V, double *values): return read((unit *)c, v, n, values);
SetReal($V, const double *values): return write((unit *)c, v, n, values);
GetInteger($V, int  *values): none
SetInteger($V, const int  *values): none
GetBoolean($V, int  *values): none
SetBoolean($V, const int  *values): none
GetString($V, const char * *values): none
SetString($V, const char * *values): none
GetFMUstate($C, void **state): return kept((unit *)c, state);
SetFMUstate($C, void *state): memcpy(c, state, sizeof(unit)); return OK;
FreeFMUstate($C, void **state): return dropped(state);
SerializedFMUstateSize($C, void *state, size_t *size)
SerializeFMUstate($C, void *state, char *bytes, size_t size)
DeSerializeFMUstate($C, const char *bytes, size_t size, void **state)
GetDirectionalDerivative($C, const unsigned int *z, size_t nz, const unsigned int *v, size_t \
    nv, const double *dv, double *dz)
SetRealInputDerivatives($V, const int *order, const double *values)
GetRealOutputDerivatives($V, const int *order, double *values)
DoStep($C, double time, double step, int keeps): return stepped((unit *)c, time, step);
CancelStep($C)
GetStatus($C, int which, int *value)
GetRealStatus($C, int which, double *value)
GetIntegerStatus($C, int which, int *value)
GetBooleanStatus($C, int which, int *value)
GetStringStatus($C, int which, const char * *value)
"""
_THREE = """
const char *GetVersion(void): return "3.0";
SetDebugLogging($C, _Bool on, size_t n, const char *const *list): ok
void *InstantiateModelExchange($M, void *owner, void (*log)(void)): return NULL;
void *InstantiateCoSimulation($M, _Bool events, _Bool early, const unsigned int *between, \
    size_t n, void *owner, void (*log)(void), void (*update)(void)): return made(token);
void *InstantiateScheduledExecution($M, void *owner, void (*log)(void), void (*clock)(void), \
    void (*lock)(void), void (*unlock)(void)): return NULL;
void FreeInstance($C): free(c);
EnterInitializationMode($C, _Bool tolerant, double tolerance, double start, _Bool ends, double \
    stop): ((unit *)c)->start = ((unit *)c)->time = start; return OK;
ExitInitializationMode($C): ok
Terminate($C): ok
EnterStepMode($C): ok
Reset($C): return again((unit *)c);
GetFloat64($V, double *values, size_t count): return count < n ? ERROR : read((unit *)c, v, n, \
    values);
SetFloat64($V, const double *values, size_t count): return count < n ? ERROR : write((unit \
    *)c, v, n, values);
GetFloat32($V, float *values, size_t count): none
SetFloat32($V, const float *values, size_t count): none
GetInt8($V, signed char *values, size_t count): none
SetInt8($V, const signed char *values, size_t count): none
GetUInt8($V, unsigned char *values, size_t count): none
SetUInt8($V, const unsigned char *values, size_t count): none
GetInt16($V, short *values, size_t count): none
SetInt16($V, const short *values, size_t count): none
GetUInt16($V, unsigned short *values, size_t count): none
SetUInt16($V, const unsigned short *values, size_t count): none
GetInt32($V, int *values, size_t count): none
SetInt32($V, const int *values, size_t count): none
GetUInt32($V, unsigned int *values, size_t count): none
SetUInt32($V, const unsigned int *values, size_t count): none
GetInt64($V, long long *values, size_t count): none
SetInt64($V, const long long *values, size_t count): none
GetUInt64($V, unsigned long long *values, size_t count): none
SetUInt64($V, const unsigned long long *values, size_t count): none
GetBoolean($V, _Bool *values, size_t count): none
SetBoolean($V, const _Bool *values, size_t count): none
GetString($V, const char *const *values, size_t count): none
SetString($V, const char *const *values, size_t count): none
GetBinary($V, size_t *sizes, const unsigned char **values, size_t count): none
SetBinary($V, const size_t *sizes, const unsigned char *const *values, size_t count): none
GetClock($V, _Bool *values): none
SetClock($V, const _Bool *values): none
GetNumberOfVariableDependencies($C, unsigned int variable, size_t *count)
GetVariableDependencies($C, unsigned int variable, size_t *to, unsigned int *from, size_t *of, \
    int *kinds, size_t n)
GetFMUState($C, void **state): return kept((unit *)c, state);
SetFMUState($C, void *state): memcpy(c, state, sizeof(unit)); return OK;
FreeFMUState($C, void **state): return dropped(state);
SerializedFMUStateSize($C, void *state, size_t *size)
SerializeFMUState($C, void *state, unsigned char *bytes, size_t size)
DeserializeFMUState($C, const unsigned char *bytes, size_t size, void **state)
GetDirectionalDerivative($C, const unsigned int *z, size_t nz, const unsigned int *v, size_t \
    nv, const double *seed, size_t ns, double *found, size_t nf)
GetAdjointDerivative($C, const unsigned int *z, size_t nz, const unsigned int *v, size_t nv, \
    const double *seed, size_t ns, double *found, size_t nf)
EnterEventMode($C)
EnterConfigurationMode($C)
ExitConfigurationMode($C)
EvaluateDiscreteStates($C)
EnterContinuousTimeMode($C)
GetIntervalDecimal($V, double *intervals, int *kinds)
GetIntervalFraction($V, unsigned long long *counters, unsigned long long *resolutions, int *kinds)
GetShiftDecimal($V, double *shifts)
GetShiftFraction($V, unsigned long long *counters, unsigned long long *resolutions)
SetIntervalFraction($V, const unsigned long long *counters, const unsigned long long *resolutions)
SetShiftFraction($V, const unsigned long long *counters, const unsigned long long *resolutions)
SetIntervalDecimal($V, const double *values)
SetShiftDecimal($V, const double *values)
UpdateDiscreteStates($C, _Bool *more, _Bool *end, _Bool *nominals, _Bool *values, _Bool *next, \
    double *at)
CompletedIntegratorStep($C, _Bool final, _Bool *event, _Bool *end)
SetTime($C, double time)
SetContinuousStates($C, const double *x, size_t n)
GetContinuousStateDerivatives($C, double *x, size_t n)
GetEventIndicators($C, double *x, size_t n)
GetContinuousStates($C, double *x, size_t n)
GetNominalsOfContinuousStates($C, double *x, size_t n)
GetNumberOfEventIndicators($C, size_t *n): *n = 0; return OK;
GetNumberOfContinuousStates($C, size_t *n): *n = 0; return OK;
GetOutputDerivatives($V, const int *orders, double *values, size_t count)
DoStep($C, double time, double step, _Bool keeps, _Bool *event, _Bool *end, _Bool *early, \
    double *last): *event = *end = *early = 0; *last = time + step; return stepped((unit *)c, \
    time, step);
ActivateModelPartition($C, unsigned int clock, double time)
"""


def interface(K: StateSpace, name: str, version: str) -> str:
    """Return the source of the functions of one version, all that the specification lists."""
    prefix, listed = ("fmi3", _THREE) if version == "3.0" else ("fmi2", _TWO)
    common = _COMMON.format(name=name, dt=K.dt, m=len(K.inputs), p=len(K.outputs))
    return common + "\n".join(_function(line, prefix) for line in listed.strip().splitlines())


def _function(line: str, prefix: str) -> str:
    """Return one function; without a body it answers that it is not supported."""
    for short, long in _SHORT.items():
        line = line.replace(short, long)
    head, _, body = (line if "): " in line else f"{line}: ").partition("): ")
    head, _, given = head.partition("(")
    result, name = re.fullmatch(r"(.*?)(\w+)", head).groups()  # type: ignore[union-attr]
    parts = [part.split("(*")[-1].split(")")[0] for part in given.split(", ")]
    names = [part.replace("*", " ").split()[-1] for part in parts]
    unused = "" if names == ["void"] else "".join(f"    (void){one};\n" for one in names)
    lines = _BODIES.get(body, body).replace("; ", ";\n    ")
    head = f"{result or 'int '}{prefix}{name}({given})"
    return f"EXPORT {head};\n{head}\n{{\n{unused}    {lines}\n}}\n"
