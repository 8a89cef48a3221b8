"""write_c: a sampled controller as one C99 file with its header, without allocation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray, short
from ...errors import CertificateError, LabelError, ModelError
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.minimal import minimal
from ...lti.statespace import StateSpace, as_statespace

_HEADER = """\
/* {title}
 * Sampling time {dt:.17g} s, {n} states. Inputs, in order: {inputs}.
 * Outputs, in order: {outputs}. SI units; u = K y, the sign of the feedback is in it.
 * Call {name}_reset once, then in every sample {name}_step; or {name}_output as soon as the inputs
 * are there and {name}_update after the outputs have been applied.
 */
#ifndef {guard}_H
#define {guard}_H

#define {guard}_STATES {n}
#define {guard}_INPUTS {m}
#define {guard}_OUTPUTS {p}

typedef struct {{
    double x[{room}];
}} {name}_t;

void {name}_reset({name}_t *self);
void {name}_output(const {name}_t *self, const double in[{m}], double out[{p}]);
void {name}_update({name}_t *self, const double in[{m}]);
void {name}_step({name}_t *self, const double in[{m}], double out[{p}]);

#endif
"""

_SOURCE = """\
/* {title}: x[k+1] = A x[k] + B in[k], out[k] = C x[k] + D in[k]. */
#include "{name}.h"

{tables}
void {name}_reset({name}_t *self)
{{
    int i;
    for (i = 0; i < {room}; ++i) {{
        self->x[i] = 0.0;
    }}
}}

void {name}_output(const {name}_t *self, const double in[{m}], double out[{p}])
{{
    int i;
    (void)self;
    for (i = 0; i < {p}; ++i) {{
        out[i] = 0.0;
    }}
{output}}}

void {name}_update({name}_t *self, const double in[{m}])
{{
    double next[{room}] = {{0.0}};
    int i;
    (void)in;
{update}    for (i = 0; i < {room}; ++i) {{
        self->x[i] = next[i];
    }}
}}

void {name}_step({name}_t *self, const double in[{m}], double out[{p}])
{{
    {name}_output(self, in, out);
    {name}_update(self, in);
}}
"""

#: words that C takes for itself
_RESERVED = frozenset(
    """auto break case char const continue default do double else enum extern float for goto if
    inline int long register restrict return short signed sizeof static struct switch typedef
    union unsigned void volatile while main""".split()  # noqa: SIM905 - words, not data
)


def write_c(controller: Any, path: Any, *, name: str | None = None) -> tuple[Path, Path]:
    """Write a sampled controller as C99: one source file and its header, no allocation.

    Entries of the matrices that are zero are not stored: modal forms cost what their blocks cost.
    Numbers are written with 17 digits, which is exact.

    Parameters
    ----------
    controller : StateSpace or Controller
        Sampled; from `anti_windup_form` its inputs hold the applied commands: call `_output`,
        apply and limit, then `_update`.
    path : path
        Of the source; the header stands beside it.
    name : str, optional
        Prefix of the functions; the file's own when not given.

    Returns
    -------
    (Path, Path)
        The source and the header.

    Raises
    ------
    LabelError
        When the name is no C identifier.
    ModelError
        When the controller is continuous, or the path no `.c` file.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = fx.synthesis.write_c(servo, os.path.join(folder, "servo.c"))
    ...     sorted(os.listdir(folder))
    ['servo.c', 'servo.h']
    """
    K = as_statespace(controller)
    if not K.dt and K.n_states:
        raise ModelError(
            "a computer runs a sampled controller: discretise_controller(plant, controller) first."
        )
    try:
        source = Path(path)
    except TypeError as error:
        raise ModelError(
            f"path must be a file name, got {short(path)}. Pass one such as 'stage.c'."
        ) from error
    if source.suffix != ".c":
        raise ModelError(
            f"path must end in .c, got {short(str(path))}. Pass a name such as 'stage.c'."
        )
    prefix = source.stem if name is None else name
    valid = isinstance(prefix, str) and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix)
    if not valid or prefix in _RESERVED:
        raise LabelError(
            f"{short(prefix)} is no name that C allows for functions. Pass name= with letters, "
            "digits and underscores."
        )
    if source.with_suffix(".c").stem != prefix:
        source = source.with_name(f"{prefix}.c")
    header = source.with_suffix(".h")
    fields = _fields(K, prefix)
    header.write_text(_HEADER.format(**fields), encoding="ascii")
    source.write_text(_SOURCE.format(**fields), encoding="ascii")
    return source, header


def _fields(K: StateSpace, name: str) -> dict[str, Any]:
    """Return what the templates are filled with."""
    tables, calls = [], {}
    for key, matrix in (("A", K.A), ("B", K.B), ("C", K.C), ("D", K.D)):
        table, loop = _table(key, matrix)
        tables.append(table)
        calls[key] = loop
    return {
        "title": _ascii(K.name or name),
        "name": name,
        "guard": name.upper(),
        "dt": K.dt,
        "n": K.n_states,
        "room": max(K.n_states, 1),
        "m": len(K.inputs),
        "p": len(K.outputs),
        "inputs": _ascii(", ".join(K.inputs)),
        "outputs": _ascii(", ".join(K.outputs)),
        "tables": "".join(tables),
        "output": calls["C"].format(to="out", of="self->x") + calls["D"].format(to="out", of="in"),
        "update": calls["A"].format(to="next", of="self->x")
        + calls["B"].format(to="next", of="in"),
    }


def _table(key: str, matrix: FloatArray) -> tuple[str, str]:
    """Return the entries of a matrix that are not zero, and the loop that applies them."""
    rows, columns = np.nonzero(matrix)
    count = rows.size
    if not count:
        return "", ""
    values = _wrapped([f"{value:.17g}" for value in matrix[rows, columns]])
    text = f"static const double {key}_value[{count}] = {{\n{values}\n}};\n"
    for part, numbers in (("row", rows), ("column", columns)):
        listed = _wrapped([str(i) for i in numbers.tolist()])
        text += f"static const int {key}_{part}[{count}] = {{\n{listed}\n}};\n"
    loop = (
        f"    for (i = 0; i < {count}; ++i) {{{{\n"
        f"        {{to}}[{key}_row[i]] += {key}_value[i] * {{of}}[{key}_column[i]];\n"
        "    }}\n"
    )
    return text, loop


def _wrapped(parts: list[str]) -> str:
    lines = [", ".join(parts[i : i + 4]) for i in range(0, len(parts), 4)]
    return ",\n".join(f"    {line}" for line in lines)


def _ascii(text: str) -> str:
    """Return text that cannot end a comment."""
    return text.encode("ascii", "replace").decode().replace("*/", "* /").replace("\n", " ")


#: largest difference of the responses, relative to the largest gain of a channel
_AGREEMENT = 1e-6


def second_order_sections(controller: Any) -> Mapping[tuple[str, str], FloatArray]:
    """Return each channel of a sampled controller as second-order sections.

    ::

        K_ij(z) = prod_k (b0 + b1 z^-1 + b2 z^-2) / (1 + a1 z^-1 + a2 z^-2)

    Poles and zeros are those of the channel's minimal states; the product is compared with the
    channel over all frequencies.

    Parameters
    ----------
    controller : StateSpace or Controller
        Sampled.

    Returns
    -------
    mapping {(output, input): (k, 6) array}
        Rows [b0, b1, b2, 1, a1, a2], the form of `scipy.signal.sosfilt`; the gain is in the first.

    Raises
    ------
    CertificateError
        When the sections differ from the channel by more than 1e-6 of its largest gain, as where
        the rate is so high above a pole that rounded coefficients move it.
    ModelError
        When the controller is continuous.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> list(fx.synthesis.second_order_sections(servo))
    [('u1', 'die:ref'), ('u1', 'die:hat')]
    """
    K = as_statespace(controller)
    if not K.dt and K.n_states:
        raise ModelError(
            "sections are of a sampled controller: discretise_controller(plant, controller) first."
        )
    return {(output, name): _sections(K[output, name]) for output in K.outputs for name in K.inputs}


def _sections(g: StateSpace) -> FloatArray:
    """Return the sections of one channel."""
    from scipy.signal import zpk2sos

    small = minimal(g) if g.n_states else g
    poles: Any = small.poles()
    zeros: Any = small.zeros()
    grid = resonance_grid(poles, g.dt or 1.0, points=100)
    wanted = frequency_response(g.replace(dt=g.dt or 1.0), grid).data[0, 0]
    size = float(np.abs(wanted).max(initial=0.0))
    if not size:
        return np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    back = np.expm1(-2j * np.pi * grid * (g.dt or 1.0))  # 1/z - 1
    shape = _product(poles, zeros, back)
    at = int(np.argmax(np.abs(wanted)))
    gain = float((wanted[at] / shape[at]).real)
    # with a zero at z = 0 for each that is missing: so many samples too early
    sections = np.asarray(zpk2sos(zeros, poles, gain, pairing="nearest"), dtype=np.float64)
    late = len(poles) - len(zeros)
    for row in sections:
        while late and not row[2]:
            row[:3], late = [0.0, *row[:2]], late - 1
    off = float(np.abs(_response(sections, back) - wanted).max()) / size
    if not off <= _AGREEMENT:
        exact = float(np.abs(gain * shape - wanted).max()) / size
        raise CertificateError(
            f"the sections of {g.outputs[0]!r} from {g.inputs[0]!r} differ from it by {off:.1e} of "
            f"its largest gain: {_cause(exact, poles, g.dt)}, or export its states (write_c)."
        )
    return sections


def _product(poles: ComplexArray, zeros: ComplexArray, back: ComplexArray) -> ComplexArray:
    """Return ``prod (z - zeros) / prod (z - poles)`` at 1/z - 1 = back."""
    z = 1.0 / (1.0 + back)
    rise = -back * z  # z - 1
    found = np.ones(z.size, dtype=np.complex128)
    for root in zeros:
        found *= rise + (1.0 - root)
    for root in poles:
        found /= rise + (1.0 - root)
    return found


def _response(sections: FloatArray, back: ComplexArray) -> ComplexArray:
    """Return the response of sections: in powers of 1/z - 1, small where coefficients cancel."""
    found = np.ones(back.size, dtype=np.complex128)
    for row in sections:
        above, below = (
            (c0 + c1 + c2) + (c1 + 2.0 * c2) * back + c2 * back**2
            for c0, c1, c2 in (row[:3], row[3:])
        )
        found *= above / below
    return found


def _cause(exact: float, poles: ComplexArray, dt: float) -> str:
    """Return why sections differ, and what helps: the product of their factors differs less."""
    if exact > _AGREEMENT:
        return (
            "poles and zeros of so many states are lost to rounding. Reduce the controller first "
            "(reduce_controller)"
        )
    slow = float(np.abs(poles - 1.0).min()) / (2.0 * np.pi * dt)
    return (
        f"a pole at {slow:.3g} Hz is so near z = 1 at a rate of {1.0 / dt:g} Hz that coefficients "
        "in double precision cannot hold it: 1 + a1 + a2 is (w dt)^2. Lower the rate"
    )
