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
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from ..checks import one_of
from ..errors import LabelError, ModelError, warn
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..store import written
from ..synthesis.aftercare.c_code import CProgram, c_name, c_program
from .fmi_text import interface
from .paths import file_path

#: exponents of kg, m, s, A, rad of the units that name a quantity by itself
_NAMED = {
    "kg": (1, 0, 0, 0, 0), "m": (0, 1, 0, 0, 0), "s": (0, 0, 1, 0, 0), "A": (0, 0, 0, 1, 0),
    "rad": (0, 0, 0, 0, 1), "N": (1, 1, -2, 0, 0), "V": (1, 2, -3, -1, 0), "Hz": (0, 0, -1, 0, 0),
    "W": (1, 2, -3, 0, 0), "J": (1, 2, -2, 0, 0), "Pa": (1, -1, -2, 0, 0), "T": (1, 0, -2, -1, 0),
}  # fmt: skip
_FACTOR = re.compile(r"([A-Za-z]+)(?:\^(-?\d+))?")
#: where the binary of a system lies, by version of FMI; how a shared library ends
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
    """Write a sampled plant or controller as a unit for co-simulation (FMI).

    Simulink, Dymola, OpenModelica and others import it. It holds C sources (those of `write_c` and
    the interface) and a library for this machine, where a C compiler is found. Time goes on in
    samples: a communication step does as many as fall into it, with the inputs held. Outputs that
    depend on inputs of the same sample are computed when they are read.

    Parameters
    ----------
    system : StandardPlant, StateSpace, Controller or ClosedLoop
        Sampled. Of a plant all of w, u, z and y; of a ClosedLoop its controller, as for `write_c`.
    path : str or Path
        Such as "stage.fmu", written atomically; its name is that of the model.
    version : str
        "3.0" or "2.0".
    limits, anti_windup, schedule
        Of a controller, as for `write_c`.

    Returns
    -------
    Path
        The file. Channels keep names and units; one that is both input and output has
        ``|y`` after its name as output.

    Raises
    ------
    LabelError
        When the file's name is no C identifier, or a channel's no variable of a unit.
    ModelError
        When the system is continuous, the path ends in anything but .fmu, or the version is
        unknown.
    OSError
        When the file cannot be written.

    Warns
    -----
    FlexplantWarning
        When no C compiler is found: the unit holds sources only, for tools that compile them.

    References
    ----------
    [Modelica2022]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile, zipfile
    >>> plant = fx.testbeds.three_masses()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = fx.io.write_fmu(plant, os.path.join(folder, "masses.fmu"))
    ...     sorted(name for name in zipfile.ZipFile(made).namelist() if name.endswith(".c"))
    ['sources/masses.c', 'sources/masses_fmi.c']
    """
    target = file_path(path)
    if target.suffix != ".fmu":
        raise ModelError(f"path must end in .fmu, got {str(target)!r}. Such as 'stage.fmu'.")
    one_of(version, "version", ("2.0", "3.0"))
    name, is_plant = target.stem, isinstance(system, StandardPlant)
    if is_plant and not system.dt:
        raise ModelError(
            "a unit for co-simulation goes on in samples, and the plant is continuous: pass "
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
    """Return where the library for this machine lies and what it holds; None without compiler."""
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
                f"a channel is named {name!r}, which no variable of a functional mock-up may be: "
                "time is its own, and line feeds end a name. Rename the channel."
            )
    outputs = [f"{name}|y" if name in K.inputs else name for name in K.outputs]
    return list(K.inputs), outputs


def _description(
    program: CProgram, name: str, version: str, token: str, sources: Sequence[str]
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
    total = [0] * 5
    for side, part in zip((1, -1), unit.split("/"), strict=False):
        for factor in part.split():
            match = _FACTOR.fullmatch(factor)
            if match is None or match[1] not in _NAMED or unit.count("/") > 1:
                return f"    <Unit name={_quoted(unit)}/>"
            power = side * int(match[2] or 1)
            total = [a + power * b for a, b in zip(total, _NAMED[match[1]], strict=True)]
    named = zip(("kg", "m", "s", "A", "rad"), total, strict=True)
    base = " ".join(f'{key}="{power}"' for key, power in named if power)
    return f"    <Unit name={_quoted(unit)}><BaseUnit {base}/></Unit>"


def _build(name: str, sources: Sequence[str]) -> str:
    """Return buildDescription.xml of FMI 3.0."""
    listed = "".join(f'<SourceFile name="{one}"/>' for one in sources)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{name}">\n    <SourceFileSet language="C99">'
        f"{listed}</SourceFileSet>\n  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )


def _quoted(text: str) -> str:
    """Return an attribute's value; what XML's own module has for it loads the network's."""
    return f'"{escape(text)}"'
