"""The C99 text of a system in blocks of two states: header, tables, functions."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import counted
from ..lti.statespace import StateSpace
from ..synthesis.aftercare.forms import LANES, TwoStateForm

_HEADER = """\
/* {title}
 * Sampling time {dt:.17g} s; {what}.
 * Inputs, in order: {inputs}.
 * Outputs, in order: {outputs}. SI units; u = K y, the sign of the feedback is in it.
 * Call {name}_reset once, or {name}_start with the inputs and the commands that act now. Then in
 * every sample {name}_step; or {name}_output as soon as the inputs are there and {name}_update
 * after the outputs have been applied (where an actuator applied something else than out, put it
 * into self->applied before).
 * When an input or a result is not finite, the last outputs are held, the states rest,
 * self->fault is 1 in that sample and self->faults counts it.
 */
#ifndef {guard}_H
#define {guard}_H

#define {guard}_STATES {n}
#define {guard}_INPUTS {m}
#define {guard}_OUTPUTS {p}
#define {guard}_DRIVEN {driven}

#ifdef __cplusplus
extern "C" {{
#endif

typedef struct {{
    {real} x[{room}];
    {real} out[{p}];
    {real} command[{u_room}];
    {real} applied[{u_room}];
    unsigned long faults;
    int fault;
}} {name}_t;

void {name}_reset({name}_t *self);
{start_head}void {name}_output({name}_t *self, const {real} *in, {real} *out);
void {name}_update({name}_t *self, const {real} *in);
void {name}_step({name}_t *self, const {real} *in, {real} *out);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """\
/* {title}: x[k+1] = A x[k] + B in[k], out[k] = C x[k] + D in[k]; A of {pairs} blocks of two
 * states (first halves, then second halves) and a rest of {rest}. Stored is A - I. */
#include "{name}.h"

#ifdef __FAST_MATH__
#error "values that are not finite are found by comparisons: compile without -ffast-math"
#endif

{tables}
{functions}
static int finite_all(const {real} *v, int count)
{{
    {real} sum = {zero};
    int i;
    for (i = 0; i < count; ++i) {{
        sum += v[i] * {zero}; /* NaN when v[i] is infinite or NaN */
    }}
    return sum >= {zero};
}}

void {name}_reset({name}_t *self)
{{
    static const {name}_t zero;
    *self = zero;
}}

{start}void {name}_output({name}_t *restrict self, const {real} *restrict in, {real} *restrict out)
{{
    int i;
    self->fault = !finite_all(in, {m});
    if (!self->fault) {{
{outputs_at}        self->fault = !finite_all(out, {p});
    }}
    if (self->fault) {{
        ++self->faults;
        for (i = 0; i < {p}; ++i) {{
            out[i] = self->out[i];
        }}
        return;
    }}
{limit}    for (i = 0; i < {p}; ++i) {{
        self->out[i] = out[i];
    }}
}}

void {name}_update({name}_t *restrict self, const {real} *restrict in)
{{
    if (self->fault) {{
        return;
    }}
{update}}}

void {name}_step({name}_t *restrict self, const {real} *restrict in, {real} *restrict out)
{{
    {name}_output(self, in, out);
    {name}_update(self, in);
}}
"""

_COMMAND = """\
static void outputs_of(const {real} *restrict x, const {real} *restrict in,
                       {real} *restrict out, int first)
{{
    int i, j{k};
    for (i = 0; i < {p}; ++i) {{
        {real} direct = {zero};
{sum}        for (j = 0; j < {m}; ++j) {{
            direct += D[first + i][j] * in[j];
        }}
        out[i] = {seen}direct;
    }}
    (void)x;
}}
"""

#: code with several partial sums, which a compiler may vectorise without -ffast-math
_SUM = """\
        {real} s[{lanes}] = {{{zero}}};
        const {real} *restrict row = C[first + i];
        for (k = 0; k < {room}; k += {lanes}) {{
{steps}
        }}
"""

_ADVANCE = """\
static void advance({real} *restrict x, const {real} *restrict in)
{{
    int k;
{locals}{pairs}{rest}}}
"""

_PAIRS = """\
    {{
        {real} *restrict a = x;
        {real} *restrict b = x + {N};
        for (k = 0; k < {N}; ++k) {{
            const {real} p = a[k], q = b[k];
            a[k] = p + ((aa[k] * p + ab[k] * q) + ({Ba}));
            b[k] = q + ((ba[k] * p + bb[k] * q) + ({Bb}));
        }}
    }}
"""

_REST = """\
    {{
        {real} *restrict r = x + {before};
        {real} move[{R}] = {{{zero}}};
        int j;
        for (j = 0; j < {R}; ++j) {{
            for (k = 0; k < {R}; ++k) {{
                move[k] += rest[j][k] * r[j];
            }}
        }}
        for (k = 0; k < {R}; ++k) {{
            r[k] += move[k] + ({Br});
        }}
    }}
"""

#: code that interpolates linearly between the matrices of two places, entry by entry
_MOVING = """\
static void advance({real} *restrict x, const {real} *restrict in, int q, {real} part)
{{
    {real} move[{R}] = {{{zero}}};
    int j, k;
    for (j = 0; j < {R}; ++j) {{
        for (k = 0; k < {R}; ++k) {{
            move[k] += (rest[q][j][k] + part * (rest[q + 1][j][k] - rest[q][j][k])) * x[j];
        }}
    }}
    for (j = 0; j < {m}; ++j) {{
        for (k = 0; k < {R}; ++k) {{
            move[k] += (B[q][j][k] + part * (B[q + 1][j][k] - B[q][j][k])) * in[j];
        }}
    }}
    for (k = 0; k < {R}; ++k) {{
        x[k] += move[k];
    }}
}}
"""

_MOVED = """\
    {{
        {real} part;
        const int q = place_of(in[{at}], &part);
        advance(self->x, in, q, part);
    }}
"""

_BACK = """\
    {{
        int j, k;
        for (j = 0; j < {driven}; ++j) {{
            const {real} miss = self->applied[j] - self->command[j];
            if (miss < {zero} || miss > {zero}) {{
                for (k = 0; k < {room}; ++k) {{
                    self->x[k] += back[j][k] * miss;
                }}
            }}
        }}
    }}
"""

_PLACE = """\
static int place_of({real} at, {real} *part)
{{
    int q = 0;
    while (q < {last} && at >= place[q + 1]) {{
        ++q;
    }}
    *part = (at - place[q]) / (place[q + 1] - place[q]);
    *part = *part < {zero} ? {zero} : *part > {one} ? {one} : *part;
    return q;
}}
"""

_BETWEEN = """\
        {real} part, next[{p}];
        const int q = place_of(in[{at}], &part);
        outputs_of(self->x, in, out, {p} * q);
        outputs_of(self->x, in, next, {p} * (q + 1));
        for (i = 0; i < {p}; ++i) {{
            out[i] += part * (next[i] - out[i]);
        }}
"""

_LIMIT = """\
    for (i = 0; i < {driven}; ++i) {{
        self->command[i] = out[i];
{clamp}        self->applied[i] = out[i];
    }}
"""

_CLAMP = """\
        out[i] = out[i] < low[i] ? low[i] : out[i] > high[i] ? high[i] : out[i];
"""

_START = """\
void {name}_start({name}_t *self, const {real} *in, const {real} *applied)
{{
    int i;
{begin}    {name}_reset(self);
{states}    for (i = 0; i < {driven}; ++i) {{
        self->out[i] = self->command[i] = self->applied[i] = applied[i];
    }}
}}

"""

_STATES = """\
    for (i = 0; i < {room}; ++i) {{
        {real} sum = {zero};
        int j;
        for (j = 0; j < {m}; ++j) {{
            sum += {table}[i][j] * in[j];
        }}
        for (j = 0; j < {driven}; ++j) {{
            sum += {table}[i][{m} + j] * applied[j];
        }}
        self->x[i] = sum;
    }}
"""


class CText:
    """The text of a system in C: `header` and `source`."""

    def __init__(
        self,
        name: str,
        K: StateSpace,
        form: TwoStateForm,
        driven: int,
        limits: FloatArray | None,
        places: FloatArray,
        at: int,
        single: bool,
    ) -> None:
        self.system, self.form, self.single, self.limits = K, form, single, limits
        self.states, self.m, self.p = form.B.shape[-2], len(K.inputs), len(K.outputs)
        self.driven, self.places, self.count = driven, places, max(places.size, 1)
        #: whether A and B also depend on the place
        self.moving = form.rest.ndim == 3
        rest, precision = form.rest.shape[-1], "single" if single else "double"
        error = f"blocks within {form.error:.1e} of the largest gain of each channel"
        self.fields: dict[str, Any] = {
            "title": _ascii(K.name or name), "name": name, "guard": name.upper(), "dt": K.dt,
            "n": K.n_states,
            "what": f"{counted(K.n_states, 'state')} in {precision} precision, {error}",
            "m": self.m, "p": self.p, "room": max(self.states, 1), "driven": driven,
            "u_room": max(driven, 1), "inputs": _ascii(", ".join(K.inputs)),
            "outputs": _ascii(", ".join(K.outputs)), "real": "float" if single else "double",
            "zero": self.number(0.0), "one": self.number(1.0), "N": form.lanes,
            "pairs": form.lanes, "rest": rest, "R": rest, "before": 2 * form.lanes,
            "lanes": LANES, "at": at, "last": self.count - 2,
        }  # fmt: skip

    def number(self, value: float) -> str:
        """Return a number as an exact C literal of the type in which the code computes."""
        digits = f"{value:.9g}" if self.single else f"{value:.17g}"
        digits = digits if any(mark in digits for mark in ".en") else f"{digits}.0"
        return f"{digits}F" if self.single else digits

    def table(self, name: str, values: FloatArray) -> str:
        """Return a constant array of one, two or three axes."""
        if not values.size:
            return ""
        size = "".join(f"[{count}]" for count in values.shape)
        return f"static const {self.fields['real']} {name}{size} = {self._braced(values)};\n"

    def _braced(self, values: FloatArray) -> str:
        if values.ndim > 1:
            return "{\n" + ",\n".join(self._braced(part) for part in values) + "\n}"
        parts = [self.number(value) for value in values.tolist()]
        lines = [", ".join(parts[i : i + 4]) for i in range(0, len(parts), 4)]
        return "{\n" + ",\n".join(f"    {line}" for line in lines) + "\n}"

    def filled(self, template: str, **more: Any) -> str:
        """Return a template with its fields."""
        return template.format(**{**self.fields, **more})

    @property
    def header(self) -> str:
        """The header file."""
        real, name = self.fields["real"], self.fields["name"]
        head = f"void {name}_start({name}_t *self, const {real} *in, const {real} *applied);\n"
        return self.filled(_HEADER, start_head=head if self.driven else "")

    @property
    def source(self) -> str:
        """The source file."""
        functions = [self._outputs_of()]
        functions += [self.filled(_PLACE)] if self.count > 1 else []
        functions += [self._advance()] if self.states else []
        back = self.form.B.shape[-1] > self.m and self.states
        clamp = _CLAMP if self.limits is not None else ""
        update = "    advance(self->x, in);\n" if self.states else "    (void)in;\n"
        update = self.filled(_MOVED) if self.moving else update
        outputs = "        outputs_of(self->x, in, out, 0);\n"
        return self.filled(
            _SOURCE,
            tables=self._tables(),
            functions="\n".join(functions),
            start=self._start() if self.driven else "",
            outputs_at=self.filled(_BETWEEN) if self.count > 1 else outputs,
            limit=self.filled(_LIMIT, clamp=clamp) if self.driven else "",
            update=update + (self.filled(_BACK) if back else ""),
        )

    def _tables(self) -> str:
        form, m = self.form, self.m
        pairs = zip(("aa", "ab", "ba", "bb"), form.pairs.reshape(4, -1), strict=True)
        found = [
            *(self.table(name, entries) for name, entries in pairs),
            self.table("rest", form.rest.swapaxes(-1, -2)),
            self.table("B", form.B[..., :m].swapaxes(-1, -2)),
            self.table("back", form.B[..., m:].swapaxes(-1, -2)),
            self.table("C", form.C),
            self.table("D", form.D[:, :m]),
            self.table("place", self.places),
        ]
        if self.driven and self.states:
            found.append(self.table("start", form.start))
        if self.limits is not None:
            most = float(np.finfo(np.float32 if self.single else np.float64).max)
            low, high = np.clip(self.limits, -most, most)
            found += [self.table("low", low), self.table("high", high)]
        return "".join(found)

    def _outputs_of(self) -> str:
        if not self.states:
            return self.filled(_COMMAND, k="", sum="", seen="")
        places = ["k", *(f"k + {i}" for i in range(1, LANES))]
        steps = "\n".join(
            f"            s[{i}] += row[{at}] * x[{at}];" for i, at in enumerate(places)
        )
        half = LANES // 2
        added = " + ".join(f"(s[{i}] + s[{i + half}])" for i in range(half))
        total = self.filled(_SUM, steps=steps)
        return self.filled(_COMMAND, k=", k", sum=total, seen=f"({added}) + ")

    def _advance(self) -> str:
        if self.moving:
            return self.filled(_MOVING)
        real, N, m = self.fields["real"], self.form.lanes, self.m
        values = "".join(f"    const {real} v{j} = in[{j}];\n" for j in range(m))

        def driven(at: str) -> str:
            return " + ".join(f"B[{j}][{at}] * v{j}" for j in range(m)) or self.number(0.0)

        pairs = self.filled(_PAIRS, Ba=driven("k"), Bb=driven(f"{N} + k")) if N else ""
        rest = self.filled(_REST, Br=driven(f"{2 * N} + k")) if len(self.form.rest) else ""
        return self.filled(_ADVANCE, locals=values, pairs=pairs, rest=rest)

    def _start(self) -> str:
        if not self.states:
            return self.filled(_START, begin="    (void)in;\n", states="")
        if self.count == 1:
            return self.filled(_START, begin="", states=self.filled(_STATES, table="start[0]"))
        begin = self.filled(
            "    {real} part;\n    int q = place_of(in[{at}], &part);\n"
            "    q += part > {half} ? 1 : 0; /* the nearer place */\n",
            half=self.number(0.5),
        )
        return self.filled(_START, begin=begin, states=self.filled(_STATES, table="start[q]"))


def _ascii(text: str) -> str:
    """Return text without the marks that begin or end a comment."""
    plain = text.encode("ascii", "replace").decode().replace("\n", " ")
    return plain.replace("*/", "* /").replace("/*", "/ *")
