"""Coupling of measured frequency responses, removal of known components, and errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray, divisor, flag, instance, mapping
from ..errors import CertificateError, LabelError, ModelError, warn
from ..labels import DofSet
from ..lti import Frf
from ..tolerances import CLOSE, RANK, ROOT, SAME
from .frf_joints import (
    FrfLink,
    channel_rows,
    channels_as_dofs,
    frf_links,
    independent,
    known_places,
    softness,
    warn_of_bending,
)
from .joint import Joint, joint_list


class MeasuredParts(NamedTuple):
    """Block-diagonal responses with their signs, errors and names of channels."""

    data: ComplexArray
    variance: FloatArray | None
    # (n_out, n_out, n_freq), None where all errors are independent
    correlation: ComplexArray | None
    outputs: list[str]
    inputs: list[str]


def joined_parts(frfs: Mapping[str, Frf], signs: Mapping[str, float]) -> MeasuredParts:
    """Return responses in one matrix, with prefixes of the components in channel names."""
    # a response without a variance counts as exact: computed ones have no errors
    outputs = [f"{name}{channel}" for name, frf in frfs.items() for channel in frf.outputs]
    inputs = [f"{name}{channel}" for name, frf in frfs.items() for channel in frf.inputs]
    n_freq = next(iter(frfs.values())).freq.size
    data = np.zeros((len(outputs), len(inputs), n_freq), dtype=np.complex128)
    variance = np.zeros(data.shape)
    correlation = np.repeat(np.eye(len(outputs), dtype=np.complex128)[..., None], n_freq, axis=2)
    row = column = 0
    for name, frf in frfs.items():
        rows, columns = slice(row, row + len(frf.outputs)), slice(column, column + len(frf.inputs))
        data[rows, columns] = signs[name] * frf.data
        variance[rows, columns] = 0.0 if frf.variance is None else frf.variance
        if frf.correlation is not None:
            correlation[rows, rows] = frf.correlation
        row, column = rows.stop, columns.stop
    measured = any(frf.variance is not None for frf in frfs.values())
    correlated = measured and any(frf.correlation is not None for frf in frfs.values())
    return MeasuredParts(
        data, variance if measured else None, correlation if correlated else None, outputs, inputs
    )


def variance_of(
    variance: FloatArray, correlation: ComplexArray | None, left: Any, right: Any
) -> FloatArray:
    """Return E|L dY R|^2 (n_out, n_in, n_freq), dY of independent columns."""
    # L (n_freq, n_out, ...) and R (n_freq, ..., n_in); the errors of different outputs under one
    # input are independent, or correlated
    if correlation is None:
        found = np.abs(left) ** 2 @ np.moveaxis(variance, 2, 0) @ np.abs(right) ** 2
        return np.moveaxis(found, 0, 2)
    between = np.moveaxis(correlation, 2, 0)
    columns = []
    for column in np.moveaxis(variance, 1, 0):
        weighted = left * np.sqrt(column).T[:, None, :]
        columns.append(np.einsum("fia,fab,fib->fi", weighted, between, weighted.conj()).real)
    found = np.stack(columns, axis=2) @ np.abs(right) ** 2
    return np.moveaxis(np.maximum(found, 0.0), 0, 2)


def warn_of_errors(
    data: ComplexArray, error: FloatArray, freq: FloatArray, *, known: bool, done: str
) -> None:
    """Warn of lines at which the total error of all results exceeds the results."""
    # `error` is the variance or, where it is not `known`, the sum of errors as large as the
    # responses
    answer, part = np.sum(np.abs(data) ** 2, axis=(0, 1)), 1.0 if known else CLOSE**2
    hidden = part * np.sum(error, axis=(0, 1)) > answer
    if not hidden.any():
        return
    whose = "by their variances" if known else f"of {100 * CLOSE:.0f} % in each response"
    where = f"{freq[hidden][0]:.5g} to {freq[hidden][-1]:.5g} Hz"
    warn(
        f"errors {whose} exceed the result at {np.count_nonzero(hidden)} of {freq.size} lines "
        f"({where}): {done}. Leave these lines out, average more, or take channels at which the "
        "responses differ more."
    )


#: largest relative gap in a joint of the result
_GAP = SAME
#: prefix of the names of removed components
_KNOWN = "known "


def joined_frfs(
    frfs: Mapping[str, Frf],
    joints: Iterable[Joint] | Joint,
    dofs: Mapping[str, DofSet] | None = None,
) -> Frf:
    """Return the responses of a machine from those of its components; see `joined`."""
    # `Y - Y B_f^T (B Y B_f^T + Z)^-1 B Y`, Y being block-diagonal, B the stretches of the joints
    # from outputs, B_f their forces at inputs and Z their compliance: dual coupling by Lagrange
    # multipliers (LM-FBS). [deKlerk2008]_, [vanderSeijs2013]_
    _same_lines(frfs)
    places, listed = known_places(dofs, frfs), joint_list(joints)
    parts = [channels_as_dofs(name, frf, places.get(name)) for name, frf in frfs.items()]
    links = [link for joint in listed for link in frf_links(joint, parts)]
    warn_of_bending(listed, parts, frfs)
    first = next(iter(frfs.values()))
    prefixed = {f"{name}/": frf for name, frf in frfs.items()}
    Y = joined_parts(prefixed, dict.fromkeys(prefixed, 1.0))
    every = np.arange(len(Y.outputs)), np.arange(len(Y.inputs))
    data, error = _coupled_response(Y, links, first.freq, first.quantity, every)
    variance = None if Y.variance is None else error
    if variance is not None:
        done = "the joints block nearly all motion of a component"
        warn_of_errors(data, variance, first.freq, known=True, done=done)
    units = {f"{name}{x}": unit for name, frf in prefixed.items() for x, unit in frf.units.items()}
    inputs, outputs = Y.inputs, Y.outputs
    return Frf(first.freq, data, inputs, outputs, first.quantity, variance=variance, units=units)


def uncoupled(
    machine: Frf,
    known: Mapping[str, Frf],
    joints: Iterable[Joint] | Joint,
    *,
    dofs: Mapping[str, DofSet] | None = None,
    extended: bool = False,
) -> Frf:
    """Return the responses of a machine without some of its components.

    The responses of each known component are multiplied by -1 and joined to the machine at the
    joints of the component. The remainder then responds as if the component had never been joined.
    This is decoupling by LM-FBS, Lagrange multiplier frequency-based substructuring. A spring
    between the component and the remainder stays attached to the remainder, with a free end.

    The result is a difference of responses. Where the component dominates the machine, errors of
    1 % in the responses may be larger than the result. The variance of the result is computed from
    the variances of the responses to first order. It is assumed that the errors of different
    responses are independent. If no response has a variance, the result has none. The warning below
    then assumes an error of 1 % in each response. For exact responses, set ``variance`` to 0.

    Parameters
    ----------
    machine : Frf
        Responses of the whole machine, with channels named as by `joined`, for example
        "stage/41:z". Along each axis of a joint of a removed component, one channel must be both an
        output and an input. This is the channel of the component. If the joint is rigid, it may
        also be the channel at the other end.
    known : mapping {str: Frf}
        Responses of the components to remove, by name, at the same frequencies.
    joints : Joint or sequence of Joint
        Joints between these components and the remainder.
    dofs : mapping {str: DofSet}, optional
        Positions of the channels of components. They are needed for patches and for joints with
        lever arms.
    extended : bool
        Whether to use more channels than those of the joints: all channels of the known components
        that are also outputs or inputs of the machine. There are then more equations than unknown
        forces, and they are solved by least squares. The solution keeps as many singular values as
        the joints have independent forces. The additional channels help where the channels at the
        joints hardly determine these forces. Each may be only an output or only an input.

    Returns
    -------
    Frf
        Responses between the channels that do not belong to a known component.

    Raises
    ------
    ModelError
        When frequencies or quantities differ, or no channel remains.

    Warns
    -----
    FlexplantWarning
        When the matrix of the joints has such a large condition number that measurement errors
        would hide the result, or when errors exceed the result at some frequencies.

    References
    ----------
    [VoormeerenRixen2012]_ (with extended interfaces).

    Examples
    --------
    Two free masses are joined. Without the frame, the stage responds as before:

    >>> f = np.array([10.0, 20.0])
    >>> free = lambda m: Frf(f, -1 / (m * (2 * np.pi * f) ** 2)[None, None], ["1:x"], ["1:x"])
    >>> both = {"stage": free(2.0), "frame": free(3.0)}
    >>> joint = Joint("stage/1:x", "frame/1:x")
    >>> rest = uncoupled(joined_frfs(both, joint), {"frame": free(3.0)}, joint)
    >>> np.allclose(rest["stage/1:x", "stage/1:x"], free(2.0)[0, 0])
    True
    """
    instance(machine, Frf, "machine", "Pass the responses of the whole.")
    whose = None if isinstance(known, Frf) else known
    mapping(whose, "known", "Pass responses by component: {'frame': frf}.", least=1)
    _same_lines({"the machine": machine, **known})
    links = _taken_out(machine, known, joint_list(joints), dofs)
    kept_out = [i for i, name in enumerate(machine.outputs) if name.partition("/")[0] not in known]
    kept_in = [i for i, name in enumerate(machine.inputs) if name.partition("/")[0] not in known]
    if not kept_out or not kept_in:
        raise ModelError(
            f"no channel remains without {', '.join(known)}: name the channels of the rest like "
            "'stage/41:z', outputs and inputs."
        )
    flag(extended, "extended")
    rest_in = [machine.inputs[i] for i in kept_in]
    rest_out = [machine.outputs[i] for i in kept_out]
    units = {name: unit for name, unit in machine.units.items() if name in {*rest_in, *rest_out}}
    whole = {"": machine, **{f"{_KNOWN}{name}/": frf for name, frf in known.items()}}
    Y = joined_parts(whole, {name: -1.0 if name else 1.0 for name in whole})
    kept = np.array(kept_out), np.array(kept_in)
    more = _shared_rows(Y, known) if extended else None
    data, error = _coupled_response(Y, links, machine.freq, machine.quantity, kept, more)
    variance = None if Y.variance is None else error
    done = "the result is a small difference between the machine and the removed component"
    warn_of_errors(data, error, machine.freq, known=variance is not None, done=done)
    quantity = machine.quantity
    return Frf(machine.freq, data, rest_in, rest_out, quantity, variance=variance, units=units)


def _taken_out(
    machine: Frf,
    known: Mapping[str, Frf],
    joints: Sequence[Joint],
    dofs: Mapping[str, DofSet] | None,
) -> list[FrfLink]:
    """Return rigid joints between the machine and the negatives of known components."""
    labels = [*machine.outputs, *machine.inputs]
    names = dict.fromkeys([*known, *(x.partition("/")[0] for x in labels if "/" in x)])
    places = known_places(dofs, names)
    there = [channels_as_dofs(name, machine, places.get(name), inside=True) for name in names]
    alone = [
        channels_as_dofs(part.name, known[part.name], places.get(part.name))
        if part.name in known
        else part
        for part in there
    ]
    found = []
    for joint in joints:
        links, missing = frf_links(joint, alone), None
        inside = links
        try:
            inside = frf_links(joint, there)
        except LabelError as error:
            missing = error
        for link, same in zip(links, inside, strict=True):
            for i, end in enumerate(link.ends):
                if end.owner not in known:
                    continue
                at = same.ends[i]
                if missing is not None:
                    # both ends of a rigid joint have the same motion
                    if link.stiffness is not None or len(link.ends) == 1:
                        raise missing
                    at = link.ends[1 - i].turned()
                    if at.owner in known:
                        raise missing
                own = end.turned()._replace(owner=f"{_KNOWN}{end.owner}")
                found.append(FrfLink(link.name, (at, own), None, 0.0))
    if not found:
        raise LabelError(
            f"no joint connects {', '.join(known)} to the rest, so that removing it changes "
            "nothing. Pass the joints between it and the rest."
        )
    return found


def _coupled_response(
    parts: MeasuredParts,
    links: Sequence[FrfLink],
    freq: FloatArray,
    quantity: str | None,
    kept: tuple[IntArray, IntArray],
    more: tuple[FloatArray, FloatArray] | None = None,
) -> tuple[ComplexArray, FloatArray]:
    """Return ``Y - Y B_f^T (B Y B_f^T + Z)^-1 B Y`` between kept channels, and its variance."""
    # with `more` rows of B and B_f, for rigid joints only, the inverse has the rank of the joints.
    # To first order an error dY of the parts becomes `(I - Y B_f^T S^-1 B) dY (I - B_f^T S^-1 B Y)`
    # with S the inverted matrix. Where no variance is known, |dY| is as large as Y
    Y, outputs, inputs = parts.data, parts.outputs, parts.inputs
    size_of_error = np.abs(Y) ** 2 if parts.variance is None else parts.variance
    rows, columns = kept
    if not links:
        picked = np.ix_(rows, columns)
        return Y[picked], size_of_error[picked]
    B_out = channel_rows(links, outputs, "outputs")
    B_in = channel_rows(links, inputs, "inputs")
    Z = softness(links, freq, quantity)
    chosen = independent(B_out, links)
    B_out, B_in, Z = B_out[chosen], B_in[chosen], Z[chosen]
    rank = len(chosen)
    give: Any = Z.T[:, :, None] * np.eye(rank)
    if more is not None:
        B_out, B_in = np.vstack([B_out, more[0]]), np.vstack([B_in, more[1]])
        give = 0.0
    lines = np.moveaxis(Y, 2, 0)
    gap, load = B_out @ lines, lines @ B_in.T
    stretch = gap @ B_in.T + give
    # the units differ: displacements and rotations
    if more is None:
        above = below = np.sqrt(np.abs(np.einsum("fii->fi", stretch)))
    else:  # relative to its own motion, since a channel that the joints hardly move is rounding
        own = np.abs(B_out) @ np.abs(lines) @ np.abs(B_in.T)
        most_of = np.sqrt(own.max(axis=(1, 2)))[:, None]
        above, below = own.max(axis=2) / most_of, own.max(axis=1) / most_of
    above, below = (divisor(size) for size in (above, below))
    scaled = stretch / above[:, :, None] / below[:, None, :]
    left_part, values, right_part = np.linalg.svd(scaled, full_matrices=False)
    left_part, values, right_part = left_part[:, :, :rank], values[:, :rank], right_part[:, :rank]
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.nan_to_num(values[:, 0] / values[:, -1], nan=np.inf)
    worst = int(np.argmax(condition))
    if not condition[worst] < 1.0 / ROOT:
        said = (
            f"the interface has the condition {condition[worst]:.2g} at {freq[worst]:.5g} Hz: "
            "errors of the responses are multiplied by it. Join fewer channels, those that move "
            "independently, or leave such frequencies out."
        )
        if not condition[worst] < 1.0 / RANK:
            raise ModelError(said)
        warn(said)
    turned, back = (np.swapaxes(part, 1, 2).conj() for part in (right_part, left_part))
    inverse = (turned / values[:, None]) @ back / below[:, :, None] / above[:, None, :]
    forces = inverse @ gap
    found = lines - load @ forces
    if more is None:
        _check_gap(B_out, lines, load, found, forces, Z)
    motions = load[:, rows] @ inverse
    left_of = np.eye(len(outputs))[rows] - motions @ B_out
    right_of = np.eye(len(inputs))[:, columns] - B_in.T @ forces[:, :, columns]
    error = variance_of(size_of_error, parts.correlation, left_of, right_of)
    return np.moveaxis(found, 0, 2)[np.ix_(rows, columns)], error


def _check_gap(
    B_out: FloatArray, lines: Any, load: Any, found: Any, forces: Any, Z: ComplexArray
) -> None:
    """Refuse joints with a gap beyond the deformation of springs and dampers."""
    left = np.abs(B_out @ found - Z.T[:, :, None] * forces)
    most = np.abs(B_out) @ (np.abs(lines) + np.abs(load) @ np.abs(forces))
    if not np.all(left <= _GAP * most):
        raise CertificateError(
            f"the coupled responses leave a gap of {float((left / most).max()):.2g} in a joint "
            f"(limit {_GAP:g}): the interface is too badly conditioned. Join fewer channels."
        )


def _shared_rows(Y: MeasuredParts, known: Mapping[str, Frf]) -> tuple[FloatArray, FloatArray]:
    """Return rows over outputs and inputs for channels that the machine and its parts share."""

    def rows(names: list[str]) -> FloatArray:
        both = [name for name in names if name.partition("/")[0] in known]
        own = [name for name in both if f"{_KNOWN}{name}" in names]
        one = np.eye(len(names))
        taken = [names.index(f"{_KNOWN}{name}") for name in own]
        return one[[names.index(name) for name in own]] - one[taken]

    return rows(Y.outputs), rows(Y.inputs)


def _same_lines(frfs: Mapping[str, Any]) -> None:
    """Refuse responses with different frequencies or quantities."""
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
