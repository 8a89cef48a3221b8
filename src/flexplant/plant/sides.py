"""Which channels of a system made elsewhere are w, u, z and y, by their names."""

from __future__ import annotations

from ..errors import LabelError
from ..labels import DIRECTIONS
from ..lti.statespace import StateSpace

#: what to type for a system whose names do not show its channels
TYPE_THIS = "StandardPlant.from_statespace(sys, w=[...], u=[...], z=[...], y=[...], asd={...})"


def sides_of(g: StateSpace) -> tuple[list[str], list[str], list[str], list[str]]:
    """Return w, u, z, y of a system whose channels are named like those of an assembled plant."""
    # each actuator `u1` has its effort `u1:effort` among the outputs: these inputs are u, the
    # others w. Outputs that are efforts, errors (`die:error`) or motions of POIs (`die:z`) are z;
    # the others are y: references (`die:ref`, an input too), outputs with a noise `y1:noise` in w,
    # and plain names
    efforts = [name.removesuffix(":effort") for name in g.outputs if name.endswith(":effort")]
    u = [name for name in g.inputs if name in efforts]
    noisy = [name.removesuffix(":noise") for name in g.inputs if name.endswith(":noise")]
    references = [name for name in g.inputs if name.endswith(":ref")]
    if not u:
        raise _untold("no input has an effort among the outputs, such as 'u1:effort' for 'u1'")
    z, y = [], []
    for name in g.outputs:
        ending = name.rpartition(":")[2] if ":" in name else ""
        if name in noisy or name in references or not ending:
            y.append(name)
        elif ending in ("effort", "error", *DIRECTIONS):
            z.append(name)
        else:
            raise _untold(f"the output {name!r} may be a measurement or a performance")
    for name, listed, what in (
        *((name, g.inputs, "effort") for name in efforts),
        *((name, y, "noise") for name in noisy),
    ):
        if name not in listed:
            raise _untold(f"{name + ':' + what!r} is there, {name!r} is not")
    if not y:
        raise _untold("no output is a measurement")
    return [name for name in g.inputs if name not in u], u, z, y


def _untold(why: str) -> LabelError:
    return LabelError(
        f"the names of the channels do not show which are w, u, z and y: {why}. Type {TYPE_THIS}."
    )
