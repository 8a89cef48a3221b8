"""Measured frequency responses coupled by joints, and a known component taken out of a machine."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import CertificateError, FlexplantWarning, LabelError, ModelError
from ..lti import Frf
from ..values import ComplexArray, FloatArray, instance
from .frf_joints import FrfLink, channel_rows, frf_links, independent, softness
from .joint import Joint

#: condition of the interface beyond which errors of a measurement hide the answer
_CONDITION = 1e8
#: and beyond which there is none
_SINGULAR = 1e14
#: largest gap in a joint of the answer, relative
_GAP = 1e-9


def joined_frfs(frfs: Mapping[str, Frf], joints: Iterable[Joint] | Joint) -> Frf:
    """Return the responses of a machine from those of its components; see `joined`.

    ``Y - Y B^T (B Y B^T + Z)^-1 B Y``, Y being block-diagonal, B the stretches of the joints and Z
    what they give way: dual coupling by Lagrange multipliers (LM-FBS).

    References
    ----------
    [deKlerk2008]_.
    """
    _same_lines(frfs)
    links = frf_links(_listed(joints), {name: _collocated(frf) for name, frf in frfs.items()})
    outputs = [f"{name}/{channel}" for name, frf in frfs.items() for channel in frf.outputs]
    inputs = [f"{name}/{channel}" for name, frf in frfs.items() for channel in frf.inputs]
    first = next(iter(frfs.values()))
    Y = np.zeros((len(outputs), len(inputs), first.freq.size), dtype=np.complex128)
    row = column = 0
    for frf in frfs.values():
        rows, columns = len(frf.outputs), len(frf.inputs)
        Y[row : row + rows, column : column + columns] = frf.data
        row, column = row + rows, column + columns
    coupled = _coupled(Y, outputs, inputs, links, first.freq, first.quantity)
    units = {
        f"{name}/{channel}": unit
        for name, frf in frfs.items()
        for channel, unit in frf.units.items()
    }
    return Frf(first.freq, coupled, inputs, outputs, first.quantity, units=units)


def uncoupled(machine: Frf, known: Mapping[str, Frf], joints: Iterable[Joint] | Joint) -> Frf:
    """Return the responses of a machine without some of its components.

    The negative of a known component is coupled to the machine where its joints are: what is left
    answers as if it had never been joined (LM-FBS decoupling). Of a component on springs, the
    springs stay at the rest, with loose ends.

    Parameters
    ----------
    machine : Frf
        Of the whole, with channels named "stage/41:z", as those of `joined` are. At the joints of
        what is taken out, channels that are both outputs and inputs: its own, or, of a rigid
        joint, those of the other end.
    known : mapping {str: Frf}
        The components that are taken out, on the same frequencies.
    joints : Joint or sequence of Joint
        How they are joined to the rest.

    Returns
    -------
    Frf
        The channels of the machine that belong to no known component.

    Raises
    ------
    LabelError
        When a channel at a joint is missing.
    ModelError
        When frequencies or quantities differ, or nothing is left.

    Warns
    -----
    FlexplantWarning
        When the interface is so badly conditioned that errors of a measurement would hide the
        answer.

    References
    ----------
    [VoormeerenRixen2012]_.

    Examples
    --------
    >>> f = np.array([10.0, 20.0])
    >>> free = lambda m: Frf(f, -1 / (m * (2 * np.pi * f) ** 2)[None, None], ["1:x"], ["1:x"])
    >>> both = {"stage": free(2.0), "frame": free(3.0)}
    >>> joint = Joint("stage/1:x", "frame/1:x")
    >>> rest = uncoupled(joined_frfs(both, joint), {"frame": free(3.0)}, joint)
    >>> np.allclose(rest["stage/1:x", "stage/1:x"], free(2.0)[0, 0])
    True
    """
    instance(machine, Frf, "machine", "Pass the responses of the whole.")
    if isinstance(known, Frf) or not isinstance(known, Mapping) or not known:
        raise ModelError("known must be a mapping of responses by component: {'frame': frf}.")
    _same_lines({"the machine": machine, **known})
    ends = _interface(_collocated(machine), known, _listed(joints))
    outputs = [*machine.outputs, *(f"known {name}" for name, _, _ in ends)]
    inputs = [*machine.inputs, *(f"known {name}" for name, _, _ in ends)]
    n_out, n_in = len(machine.outputs), len(machine.inputs)
    Y = np.zeros((len(outputs), len(inputs), machine.freq.size), dtype=np.complex128)
    Y[:n_out, :n_in] = machine.data
    for i, (_, owner, channel) in enumerate(ends):
        for j, (_, other, source) in enumerate(ends):
            if owner == other:
                Y[n_out + i, n_in + j] = -known[owner][channel, source]
    links = [FrfLink(name, f"known {name}", None, 0.0) for name, _, _ in ends]
    coupled = _coupled(Y, outputs, inputs, links, machine.freq, machine.quantity)
    kept_out = [i for i, name in enumerate(machine.outputs) if name.partition("/")[0] not in known]
    kept_in = [i for i, name in enumerate(machine.inputs) if name.partition("/")[0] not in known]
    if not kept_out or not kept_in:
        raise ModelError(
            f"no channel is left without {', '.join(known)}: name those of the rest 'stage/41:z', "
            "outputs and inputs."
        )
    rest_in = [machine.inputs[i] for i in kept_in]
    rest_out = [machine.outputs[i] for i in kept_out]
    units = {name: unit for name, unit in machine.units.items() if name in {*rest_in, *rest_out}}
    data = coupled[np.ix_(kept_out, kept_in)]
    return Frf(machine.freq, data, rest_in, rest_out, machine.quantity, units=units)


def _interface(
    there: Sequence[str], known: Mapping[str, Frf], joints: Sequence[Any]
) -> list[tuple[str, str, str]]:
    """Return (channel of the machine, component, its channel) at each joint of known components."""
    channels = {name: _collocated(frf) for name, frf in known.items()}
    for label in there:
        name, _, channel = label.partition("/")
        if name not in known:
            channels[name] = (*channels.get(name, ()), channel)
    found: dict[str, tuple[str, str, str]] = {}
    for link in frf_links(joints, channels):
        for end, other in ((link.first, link.second), (link.second, link.first)):
            owner, _, channel = (end or "").partition("/")
            if owner not in known or end is None:
                continue
            at = end if end in there else other if link.stiffness is None else None
            if at is None or at not in there:
                raise LabelError(
                    f"the machine has no channel {end!r} that is both an output and an input: "
                    "measure it there, where the component is joined."
                )
            found.setdefault(end, (at, owner, channel))
    if not found:
        raise LabelError(
            f"no joint holds {', '.join(known)}: the machine without it would be the machine. Pass "
            "the joints between it and the rest."
        )
    return list(found.values())


def _coupled(
    Y: ComplexArray,
    outputs: Sequence[str],
    inputs: Sequence[str],
    links: Sequence[FrfLink],
    freq: FloatArray,
    quantity: str | None,
) -> ComplexArray:
    """Return ``Y - Y B^T (B Y B^T + Z)^-1 B Y`` (n_out, n_in, n_freq), frequency by frequency."""
    if not links:
        return Y
    B_out, B_in = channel_rows(links, outputs), channel_rows(links, inputs)
    Z = softness(links, freq, quantity)
    kept = independent(B_out, links)
    B_out, B_in, Z = B_out[kept], B_in[kept], Z[kept]
    lines = np.moveaxis(Y, 2, 0)
    gap, load = B_out @ lines, lines @ B_in.T
    stretch = gap @ B_in.T + Z.T[:, :, None] * np.eye(len(kept))
    # of unlike units: displacements and rotations
    size = np.sqrt(np.abs(np.einsum("fii->fi", stretch)))
    size = np.where(size > 0, size, 1.0)
    scaled = stretch / size[:, :, None] / size[:, None, :]
    condition = np.linalg.cond(scaled)
    worst = int(np.argmax(condition))
    if not condition[worst] < _CONDITION:
        said = (
            f"the interface has the condition {condition[worst]:.2g} at {freq[worst]:.5g} Hz: "
            "errors of the responses are multiplied by it. Join fewer channels, those that move "
            "independently, or leave such frequencies out."
        )
        if not condition[worst] < _SINGULAR:
            raise ModelError(said)
        warnings.warn(said, FlexplantWarning, 4)
    forces = np.linalg.solve(scaled, gap / size[:, :, None]) / size[:, :, None]
    found = lines - load @ forces
    # what opens is what springs and dampers give way, and nothing of rigid joints
    left = np.abs(B_out @ found - Z.T[:, :, None] * forces)
    most = np.abs(B_out) @ (np.abs(lines) + np.abs(load) @ np.abs(forces))
    if not np.all(left <= _GAP * most):
        raise CertificateError(
            f"the coupled responses leave a gap of {float((left / most).max()):.2g} in a joint "
            f"(limit {_GAP:g}): the interface is too badly conditioned. Join fewer channels."
        )
    return np.asarray(np.moveaxis(found, 0, 2))


def _collocated(frf: Frf) -> tuple[str, ...]:
    return tuple(name for name in frf.outputs if name in frf.inputs)


def _listed(joints: Any) -> list[Any]:
    if isinstance(joints, Joint):
        return [joints]
    return list(instance(joints, Iterable, "joints", "Pass Joint(...) in [...]."))


def _same_lines(frfs: Mapping[str, Any]) -> None:
    """Refuse responses that were not measured alike."""
    for name, frf in frfs.items():
        instance(frf, Frf, f"component {name!r}", "Join responses with responses, an Frf each.")
    first = next(iter(frfs.values()))
    for name, frf in frfs.items():
        if not np.array_equal(frf.freq, first.freq):
            raise ModelError(
                f"the frequencies of {name!r} are not those of {next(iter(frfs))!r}: joints couple "
                "responses line by line. Measure, or select, the same lines."
            )
        if frf.quantity != first.quantity:
            raise ModelError(
                f"{name!r} measures {frf.quantity!r}, {next(iter(frfs))!r} {first.quantity!r}. "
                "Convert them: frf.converted('displacement')."
            )
