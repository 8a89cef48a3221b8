"""write_fmu: a sampled plant or controller as a functional mock-up unit (FMI 2.0 and 3.0)."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from ..arrays import one_of
from ..errors import LabelError, ModelError, warn
from ..lti.statespace import StateSpace
from ..plant import AnyPlant
from ..store import named_file, written
from .c_code import c_name, c_program
from .c_text import CText

#: types of the specification, written out where they are pointers or numbers
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

#: abbreviations of parameters, and of bodies below, that many functions share
_SHORT = {
    "$C": "void *c",
    "$V": "void *c, const unsigned int *v, size_t n",
    "$M": "const char *label, const char *token, const char *place, _Bool visible, _Bool logging",
}
_BODIES = {"": "return ERROR;", "ok": "return OK;", "none": "return n ? ERROR : OK;"}
#: functions of FMI 2.0, one a line. They return int unless another type is written; a function
#: without a body is not supported
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
#: types of variables of FMI 3.0 that the exported units do not use, and their types in C
_NUMBERS_OF_THREE = {
    "Float32": "float", "Int8": "signed char", "UInt8": "unsigned char", "Int16": "short",
    "UInt16": "unsigned short", "Int32": "int", "UInt32": "unsigned int", "Int64": "long long",
    "UInt64": "unsigned long long", "Boolean": "_Bool",
}  # fmt: skip
_THREE = (
    "".join(
        f"Get{kind}($V, {number} *values, size_t count): none\n"
        f"Set{kind}($V, const {number} *values, size_t count): none\n"
        for kind, number in _NUMBERS_OF_THREE.items()
    )
    + """
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
)


def interface(K: StateSpace, name: str, version: str) -> str:
    """Return the source of all functions that one version of the specification lists."""
    prefix, listed = ("fmi3", _THREE) if version == "3.0" else ("fmi2", _TWO)
    common = _COMMON.format(name=name, dt=K.dt, m=len(K.inputs), p=len(K.outputs))
    return common + "\n".join(_function(line, prefix) for line in listed.splitlines() if line)


def _function(line: str, prefix: str) -> str:
    """Return one function; without a body it returns the error of an unsupported function."""
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


#: base units of FMI, and named units as products of other units
_BASE = ("kg", "m", "s", "A", "rad")
_NAMED = {
    "N": "kg m s^-2", "Pa": "N m^-2", "J": "N m", "W": "J s^-1", "V": "W A^-1", "Hz": "s^-1",
    "T": "V s m^-2",
}  # fmt: skip
_FACTOR = re.compile(r"([A-Za-z]+)(?:\^(-?\d+))?")
#: folders of the library in FMI 2.0 and 3.0, and its suffix, by operating system
_FOLDERS = {
    "linux": ("linux{bits}", "{cpu}-linux", ".so"),
    "darwin": ("darwin{bits}", "{cpu}-darwin", ".dylib"),
    "win32": ("win{bits}", "{cpu}-windows", ".dll"),
}
_COMPILERS = ("cc", "gcc", "clang")


def write_fmu(
    system: Any,
    path: str | Path,
    *,
    version: str = "3.0",
    limits: Any = None,
    anti_windup: float | None = None,
    schedule: str | None = None,
) -> Path:
    """Write a sampled plant or controller as a functional mock-up unit for co-simulation (FMI).

    Simulink, Dymola, OpenModelica and other programs import it. It contains C sources (those of
    `write_c` and the interface) and, if a C compiler is found, a library for this computer. Time
    advances in samples: in each communication step all samples within this step are computed with
    constant inputs. Outputs that depend on inputs of the same sample are computed when they are
    read.

    Parameters
    ----------
    system : StandardPlant, GeneralizedPlant, StateSpace, Controller or ClosedLoop
        Sampled system. The functional mock-up unit of a plant has w and u as inputs, and z and y as
        outputs. For a ClosedLoop, its controller is written, as by `write_c`.
    path : str or Path
        Path such as "stage.fmu". The file is written completely or not at all. Its name becomes the
        name of the model.
    version : str
        "3.0" or "2.0".
    limits, anti_windup, schedule
        Limits of a controller, as for `write_c`.

    Returns
    -------
    Path
        Path of the file. Channels keep their names and units. If a channel is both an input and an
        output, ``|y`` is added to the name of the output.

    Raises
    ------
    LabelError
        When the file's name is not a C identifier, or a channel has a name that is not allowed for
        variables.
    ModelError
        When the system is continuous, the path does not end in .fmu, or the version is unknown.
    OSError
        When the file cannot be written.

    Warns
    -----
    FlexplantWarning
        When no C compiler is found. The file then contains only sources, which the importing
        program must compile.

    References
    ----------
    [Modelica2022]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile, zipfile
    >>> plant = fx.testbeds.three_masses()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = fx.export.write_fmu(plant, os.path.join(folder, "masses.fmu"))
    ...     sorted(name for name in zipfile.ZipFile(made).namelist() if name.endswith(".c"))
    ['sources/masses.c', 'sources/masses_fmi.c']
    """
    target = named_file(path)
    if target.suffix != ".fmu":
        raise ModelError(f"path must end in .fmu, got {str(target)!r}. Such as 'stage.fmu'.")
    one_of(version, "version", ("2.0", "3.0"))
    name, is_plant = target.stem, isinstance(system, AnyPlant)
    if is_plant and not system.dt:
        raise ModelError(
            "a unit for co-simulation advances in samples, but the plant is continuous: pass "
            "plant.discretized(rate)."
        )
    program = c_program(
        system.system if is_plant else system,
        c_name(name),
        limits=limits,
        anti_windup=anti_windup,
        schedule=schedule,
        driven=not is_plant,
    )
    sources = {
        f"{name}.h": program.header,
        f"{name}.c": program.source,
        f"{name}_fmi.c": interface(program.system, name, version),
    }
    token = "{" + str(uuid.uuid5(uuid.NAMESPACE_OID, "".join(sources.values()))) + "}"
    sources[f"{name}_fmi.c"] = sources[f"{name}_fmi.c"].replace("@TOKEN@", token)
    files: dict[str, str | bytes] = {f"sources/{one}": text for one, text in sources.items()}
    files["modelDescription.xml"] = _description(program, name, version, token, list(sources)[1:])
    if version == "3.0":
        files["sources/buildDescription.xml"] = _build(name, list(sources)[1:])
    binary = _compiled(sources, name, version)
    if binary is not None:
        files[binary[0]] = binary[1]
    with written(target) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for one, content in files.items():
            # a fixed date: the same system gives the same file
            archive.writestr(zipfile.ZipInfo(one, (1980, 1, 1, 0, 0, 0)), content)
    return target


def _compiled(sources: dict[str, str], name: str, version: str) -> tuple[str, bytes] | None:
    """Return place and content of the library for this computer; None without a compiler."""
    own = os.environ.get("CC", "")
    found = next((one for one in (own, *_COMPILERS) if one and shutil.which(one)), None)
    if found is None or sys.platform not in _FOLDERS:
        warn(
            f"no C compiler was found ({', '.join(_COMPILERS)}): {name}.fmu holds sources only, "
            "and runs in tools that compile them. Install one, or set CC."
        )
        return None
    cpu = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower())
    two, three, end = _FOLDERS[sys.platform]
    bits = 64 if sys.maxsize > 2**32 else 32
    folder = (three if version == "3.0" else two).format(
        cpu=cpu or platform.machine().lower(), bits=bits
    )
    with tempfile.TemporaryDirectory() as place:
        for one, text in sources.items():
            Path(place, one).write_text(text, encoding="ascii")
        library = Path(place, name + end)
        parts = [one for one in sources if one.endswith(".c")]
        command = [found, "-std=c99", "-O2", "-shared", "-fPIC", *parts, "-o", str(library)]
        run = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        if run.returncode:
            warn(
                f"{found} cannot make a library ({run.stderr.strip()[:200]}): {name}.fmu holds "
                "sources only."
            )
            return None
        return f"binaries/{folder}/{name}{end}", library.read_bytes()


def variable_names(K: StateSpace) -> tuple[list[str], list[str]]:
    """Return the names of inputs and outputs as variables, all different."""
    for name in (*K.inputs, *K.outputs):
        if name == "time" or not name.isprintable():
            raise LabelError(
                f"a channel is named {name!r}, which is not allowed in a functional mock-up "
                "unit: time is reserved, and line feeds end a name. Rename the channel."
            )
    outputs = [f"{name}|y" if name in K.inputs else name for name in K.outputs]
    return list(K.inputs), outputs


def _description(
    program: CText, name: str, version: str, token: str, sources: Sequence[str]
) -> str:
    """Return modelDescription.xml."""
    K = program.system
    inputs, outputs = variable_names(K)
    units = [K.units.get(one) for one in (*K.inputs, *K.outputs)]
    head = f'modelName={_quoted(K.name or name)} generationTool="flexplant"'
    shared = f'modelIdentifier={_quoted(name)} canHandleVariableCommunicationStepSize="true"'
    three = version == "3.0"
    states = "canGetAndSetFMUState" if three else "canGetAndSetFMUstate"
    shared += f' {states}="true"'
    if three:
        first = f'fmiVersion="3.0" {head} instantiationToken="{token}"'
        side = f'  <CoSimulation {shared} fixedInternalStepSize="{K.dt:.17g}"/>'
    else:
        first = f'fmiVersion="2.0" {head} guid="{token}" variableNamingConvention="flat"'
        listed = "".join(f'<File name="{one}"/>' for one in sources)
        side = f"  <CoSimulation {shared}><SourceFiles>{listed}</SourceFiles></CoSimulation>"
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<fmiModelDescription {first}>", side]
    known = sorted({unit for unit in units if unit})
    if known:
        lines += ["  <UnitDefinitions>", *map(_unit_definition, known), "  </UnitDefinitions>"]
    lines += [f'  <DefaultExperiment startTime="0" stepSize="{K.dt:.17g}"/>', "  <ModelVariables>"]
    if three:
        lines.append(
            '    <Float64 name="time" valueReference="0" causality="independent" '
            'variability="continuous"/>'
        )
    sides = ["input"] * len(inputs) + ["output"] * len(outputs)
    for number, (one, causality, unit) in enumerate(
        zip((*inputs, *outputs), sides, units, strict=True), 1
    ):
        common = f'name={_quoted(one)} valueReference="{number}" causality="{causality}"'
        common += ' variability="discrete"' + (
            "" if causality == "input" else ' initial="calculated"'
        )
        own = (f" unit={_quoted(unit)}" if unit else "") + (
            ' start="0"' if causality == "input" else ""
        )
        lines.append(
            f"    <Float64 {common}{own}/>"
            if three
            else f"    <ScalarVariable {common}><Real{own}/></ScalarVariable>"
        )
    lines += ["  </ModelVariables>", "  <ModelStructure>"]
    rows = [
        (len(inputs) + i, " ".join(str(j + 1) for j, d in enumerate(row) if d))
        for i, row in enumerate(K.D, 1)
    ]
    if three:
        for kind in ("Output", "InitialUnknown"):
            lines += [f'    <{kind} valueReference="{at}" dependencies="{on}"/>' for at, on in rows]
    else:
        for kind in ("Outputs", "InitialUnknowns"):
            listed = "".join(f'<Unknown index="{at}" dependencies="{on}"/>' for at, on in rows)
            lines.append(f"    <{kind}>{listed}</{kind}>")
    return "\n".join([*lines, "  </ModelStructure>", "</fmiModelDescription>", ""])


def _unit_definition(unit: str) -> str:
    """Return the definition of a unit, with its exponents of base units where these are known."""
    over, _, under = unit.partition("/")
    powers, below = _exponents(over), _exponents(under)
    if powers is None or below is None:
        return f"    <Unit name={_quoted(unit)}/>"
    powers.subtract(below)
    base = " ".join(f'{key}="{powers[key]}"' for key in _BASE if powers[key])
    return f"    <Unit name={_quoted(unit)}><BaseUnit {base}/></Unit>"


def _exponents(product: str) -> Counter[str] | None:
    """Return the exponents of the base units in a product of units, None where one is unknown."""
    found: Counter[str] = Counter()
    for factor in product.split():
        match = _FACTOR.fullmatch(factor)
        if match is None or match[1] not in (*_BASE, *_NAMED):
            return None
        name, power = match[1], int(match[2] or 1)
        for key, own in (_exponents(_NAMED.get(name, "")) or {name: 1}).items():
            found[key] += power * own
    return found


def _build(name: str, sources: Sequence[str]) -> str:
    """Return buildDescription.xml of FMI 3.0."""
    listed = "".join(f'<SourceFile name="{one}"/>' for one in sources)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{name}">\n    <SourceFileSet language="C99">'
        f"{listed}</SourceFileSet>\n  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )


def _quoted(text: str) -> str:
    """Return the quoted value of an attribute; xml.sax.saxutils would import network modules."""
    return f'"{escape(text)}"'
