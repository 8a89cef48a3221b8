"""Universal files (UFF): responses (58, 2414), shapes (55, 2414), nodes (15, 2411)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..arrays import positive
from ..dof_columns import at_nodes
from ..errors import FlexplantError, LabelError, ModelError, counted, require_known
from ..identification import MeasuredModes
from ..labels import DIRECTIONS, DofSet, node_dofs
from ..lti.frequency import ORDERS, Frf
from ..structure.unit_systems import Units
from .coordinate_systems import turned_motions
from .fe_modes import MODE_READERS, FileShapes
from .files import ELSEWHERE, ONCE, Elsewhere, file_path, refused, unread
from .tables import read_nodes_table
from .uff_analysis import NORMAL_MODE, AnalysisData, mode_records, responses_of_model
from .uff_records import (
    KINDS,
    channel_order,
    check_complete,
    coherence_of,
    common_frequencies,
    dataset_types,
    datasets,
    derivative,
    paired_records,
    record_scale,
    record_sides,
    whole_entry,
)
from .uff_systems import is_permutation, turning, uff_nodes

#: names of the factors in dataset 164: numbers divided by these factors are in SI
_FACTORS = ("length", "force")
_UNIVERSAL = (".uff", ".unv", ".uf")


def read_frf_uff(
    path: str | Path,
    *,
    quantity: str | None = None,
    scale: float | None = None,
    coherence: bool = True,
) -> Frf:
    """Return the frequency response functions of a universal file.

    They are read from dataset 58, text or binary, where every record gives the response of one
    output to one input. A direction of -3 means z with the opposite sign. A file without dataset 58
    may hold dataset 2414, with the responses of all nodes of a model to its load sets. These are
    then responses to whole load sets, which are named "load 1" and so on.

    Nodes that move in a coordinate system of dataset 18 or 2420 (the displacement system of
    dataset 15 or 2411) are turned to global directions. System 0 is the global one, and so is
    system 1 where the file does not define it. Systems of 2420 are Cartesian or cylindrical, those
    of 18 Cartesian. `read_modes_uff`, `read_modes` and `read_nodes_uff` do the same.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        Wanted quantity of the outputs. Records that name their quantity are converted; the
        others are assumed to have this quantity. By default all records must have the same
        quantity.
    scale : float, optional
        Factor that brings the numbers to SI (m, m/s or m/s^2 per N), where the file's units are
        not clear; otherwise it follows from the labels of the axes and dataset 164.
    coherence : bool
        Whether to attach the coherence records (function type 6).

    Returns
    -------
    Frf
        Responses with outputs "41:z" and inputs "u 41:z", sorted by node and direction. If a record
        has no direction, the name of its entity is used instead.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged, pairs are missing or doubled, or records are
        over different frequencies; the pairs are listed.
    ModelError
        When units or quantities are not clear, or zero frequency would be integrated. Also when a
        node moves in a coordinate system that is missing or cannot be read, or when it was measured
        in too few local directions to compute a global one.

    Notes
    -----
    Format: Structural Dynamics Research Laboratory, University of Cincinnati, "Universal File
    Formats for Modal Analysis Testing", datasets 15, 18, 58, 2411, 2414, 2420.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np, os, pyuff, tempfile
    >>> record = pyuff.prepare_58(
    ...     func_type=4, binary=0, rsp_node=41, rsp_dir=3, ref_node=7, ref_dir=3,
    ...     x=np.array([1.0, 2.0]), data=np.array([1.0, 2.0j]), abscissa_spec_data_type=18,
    ...     ordinate_spec_data_type=8, ordinate_axis_units_lab="m",
    ...     orddenom_spec_data_type=13, orddenom_axis_units_lab="N",
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "shaker.uff")
    ...     pyuff.UFF(path).write_sets(record, "overwrite")
    ...     frf = fx.io.read_frf_uff(path)
    >>> frf["41:z", "u 7:z"]
    array([1.+0.j, 0.+2.j])
    """
    if quantity is not None:
        require_known("quantity", [quantity], ORDERS)
    if scale is not None:
        scale = positive(scale, "scale")
    sets = datasets(path, (58, 164))
    factors = next((part for part in sets if part["type"] == 164), None)
    records = [part for part in sets if part["type"] == 58]
    responses = [part for part in records if whole_entry(part, "func_type") == 4]
    if not responses:
        nodes = uff_nodes(path)
        computed = responses_of_model(file_path(path), factors, quantity, scale, nodes)
        if computed is not None:
            return computed
        kinds = sorted({whole_entry(part, "func_type") for part in records})
        what = f"{len(records)} records 58 of function types {kinds} (4 is a frequency response)"
        do = "Export these, or estimate them from time records: read_records, estimate_frf."
        raise refused(path, f"holds no frequency response function: {what}", do)
    found = {KINDS.get(whole_entry(part, "ordinate_spec_data_type")) for part in responses}
    if len(found) > 1 and quantity is None:
        said = sorted(str(kind or "unknown") for kind in found)
        do = "One Frf is of one quantity: say which to convert to, quantity='acceleration'."
        raise unread(path, f"holds records of {said}", do)
    target = quantity or found.pop()
    pairs = paired_records(responses, str(path))
    freq = common_frequencies(responses, str(path))
    outputs, inputs = record_sides(pairs)
    check_complete(pairs, outputs, inputs, "frequency responses", str(path), "")
    data = np.empty((len(outputs), len(inputs), freq.size), dtype=np.complex128)
    for (output, name), (sign, part) in pairs.items():
        kind = KINDS.get(whole_entry(part, "ordinate_spec_data_type"))
        factor = sign * (scale or record_scale(part, factors, kind or target, str(path)))
        row = factor * np.asarray(part["data"], dtype=np.complex128)
        row = row * derivative(freq, kind or target, target, path)
        data[outputs.index(output), inputs.index(name)] = row
    measured = (
        [part for part in records if whole_entry(part, "func_type") == 6] if coherence else []
    )
    frf = Frf(
        freq,
        data,
        inputs=inputs,
        outputs=outputs,
        quantity=target,
        coherence=coherence_of(measured, outputs, inputs, freq, str(path)) if measured else None,
    )
    return _in_global_directions(frf, path)


def _in_global_directions(frf: Frf, path: str | Path) -> Frf:
    """Return responses of nodes that move in local directions in global ones."""
    points = [name.removeprefix("u ") for name in frf.inputs]
    nodes = [name.partition(":")[0] for name in (*frf.outputs, *points)]
    axes = uff_nodes(path).axes(np.array([int(node) for node in nodes if node.isdigit()]))
    outputs, left = turning(frf.outputs, axes, str(path))
    inputs, right = turning(points, axes, str(path))
    coherence = frf.coherence
    if coherence is not None:
        if not (is_permutation(left) and is_permutation(right)):
            what = "holds coherences of local directions, which global ones do not follow from"
            raise unread(path, what, "Leave them out: coherence=False.")
        coherence = np.einsum("ab,bcf,dc->adf", np.rint(left) ** 2, coherence, np.rint(right) ** 2)
    rows, columns = (
        np.array(sorted(range(len(names)), key=[channel_order(name) for name in names].__getitem__))
        for names in (outputs, inputs)
    )
    pick = np.ix_(rows, columns)
    outputs = [outputs[i] for i in rows.tolist()]
    inputs = [f"u {inputs[i]}" for i in columns.tolist()]
    return frf.replace(
        data=np.einsum("ab,bcf,dc->adf", left, frf.data, right)[pick],
        outputs=outputs,
        inputs=inputs,
        units={},
        coherence=None if coherence is None else coherence[pick],
    )


def read_modes_uff(path: str | Path, *, modes: Iterable[int] | None = None) -> MeasuredModes:
    """Return poles and mode shapes of a universal file (datasets 55 and 2414).

    Normal and complex modes are read. If a file holds both datasets, the modes of dataset 55 are
    used, because this is the one that test software writes.

    The file numbers the modes in the order of the measurement; `numbered` finds which modes of a
    model they are.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    modes : sequence of int, optional
        Numbers of the modes in the file; by default all.

    Returns
    -------
    MeasuredModes
        Shapes at the DOFs "41:z"; directions that are zero in all modes were not measured and are
        left out.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged or holds no modes, or its modes are not all given
        at the same nodes.
    ModelError
        When a mode has zero frequency (a rigid-body mode), or a pole is not stable; when local
        directions cannot be turned, as for `read_frf_uff`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np, os, pyuff, tempfile
    >>> mode = pyuff.prepare_55(
    ...     model_type=1, analysis_type=2, data_ch=2, spec_data_type=8, data_type=2,
    ...     n_data_per_node=3, load_case=1, mode_n=1, freq=100.0, modal_m=1.0, modal_damp_vis=0.01,
    ...     modal_damp_his=0.0, node_nums=[41], r1=np.zeros(1), r2=np.zeros(1), r3=np.ones(1),
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "modes.uff")
    ...     pyuff.UFF(path).write_sets(mode, "overwrite")
    ...     found = fx.io.read_modes_uff(path)
    >>> found, found.shapes.real
    (<MeasuredModes: 1 pole at 100.0 Hz>, array([[1.]]))
    """
    parts: dict[int, AnalysisData] = {}
    for part in mode_records(file_path(path), measured=True):
        if part.mode in parts:
            raise refused(path, f"holds mode {part.mode} twice", ONCE)
        parts[part.mode] = part
    if not parts:
        what = "datasets 55, or 2414 of displacements at nodes, of modes (normal 2, complex 3, 7)"
        raise refused(path, f"holds no mode shapes: {what}", "Export these.")
    chosen = list(parts) if modes is None else list(modes)
    for number in chosen:
        if number not in parts:
            raise LabelError(f"no mode {number!r} in {str(path)!r}: it holds {list(parts)[:12]}.")
    poles = np.array([parts[number].pole for number in chosen])
    if np.any(poles.imag == 0):
        rigid = [number for number, pole in zip(chosen, poles, strict=True) if pole.imag == 0]
        raise ModelError(
            f"modes {rigid} of {str(path)!r} do not oscillate (rigid-body or overdamped): they "
            f"cannot be compared. Leave them out: modes={[n for n in chosen if n not in rigid]}."
        )
    first = parts[chosen[0]]
    nodes, axes = first.nodes, uff_nodes(path).axes(first.nodes)
    motions = np.stack([part.motions for part in parts.values()], axis=2)  # (node, direction, mode)
    if not first.measured:
        motions, axes = turned_motions(motions, nodes.tolist(), axes), {}
    seen = np.tile(np.any(motions, axis=(0, 2)), (nodes.size, 1))
    for row, node in enumerate(nodes.tolist()):
        if node in axes and np.any(motions[row]):
            seen[row] = np.any(motions[row], axis=1)
    labels = [f"{node}:{direction}" for node in nodes.tolist() for direction in DIRECTIONS]
    keep = seen.ravel()
    local = [label for label, kept in zip(labels, keep, strict=True) if kept]
    names, turn = turning(local, axes, str(path))
    columns = [list(parts).index(number) for number in chosen]
    phi = motions.reshape(keep.size, -1)[keep][:, columns].astype(np.complex128)
    return MeasuredModes(poles, shapes=turn @ phi, dofs=tuple(names))


def read_nodes_uff(path: str | Path, *, directions: Sequence[str] = ("x", "y", "z")) -> DofSet:
    r"""Return the nodes of a universal file (datasets 15 and 2411) as DOFs with coordinates.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    directions : sequence of str
        Directions of the DOFs of each node.

    Returns
    -------
    DofSet
        DOFs with coordinates in metres, converted by dataset 164 where the file has it.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged, or holds no nodes.
    ModelError
        When the coordinates or the directions of motion of a node use a coordinate system that
        cannot be read (see `read_frf_uff`). Also when a node moves in local directions and the file
        holds no results, because results in another file would not be turned with it.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "nodes.uff")
    ...     line = f"{41:10d}{0:10d}{0:10d}{11:10d}{0.1:13.5E}{0.2:13.5E}{0.0:13.5E}"
    ...     _ = file.write_text(f"    -1\n    15\n{line}\n    -1\n")
    ...     dofs = fx.io.read_nodes_uff(file, directions="z")
    >>> dofs.location("41:z").tolist()
    [0.1, 0.2, 0.0]
    """
    nodes = uff_nodes(path)
    xyz = nodes.xyz()
    local = nodes.axes()
    if local and not set(dataset_types(path)) & {55, 58, 2414}:
        what = f"moves {counted(len(local), 'node')} in local directions, the first {min(local)}"
        raise unread(
            path, what, "Results in another file are not turned with them: export both into one."
        )
    return node_dofs(nodes.ids, directions, xyz / _unit_factors(path)[0])


def _unit_factors(path: str | Path) -> tuple[float, float]:
    """Return the factors of length and force: numbers divided by them are in SI."""
    sets = datasets(path, (164,))
    factors = sets[0] if sets else dict.fromkeys(_FACTORS, 1.0)
    length, force = (positive(factors[name], f"{name} of dataset 164") for name in _FACTORS)
    return length, force


ELSEWHERE.append(
    Elsewhere(
        (".unv", ".uff"),
        "results: read_frf_uff, read_modes_uff, read_nodes_uff of flexplant.io, and "
        "read_modes for the modes of a model",
    )
)


def read_uff_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the normal modes of a universal file."""
    parts = [p for p in mode_records(path, measured=False) if p.analysis == NORMAL_MODE]
    if not parts:
        raise FlexplantError(
            f"{str(path)!r} holds no normal modes: displacements at nodes in dataset 2414, or 55, "
            "of analysis type 2. Measured or complex ones are read by read_modes_uff, as "
            "MeasuredModes."
        )
    ids = parts[0].nodes
    where = path if nodes is None else nodes
    whole = where.suffix.lower() in _UNIVERSAL
    systems = uff_nodes(where if whole else path)
    known, xyz = (systems.ids, systems.xyz()) if whole else read_nodes_table(where)
    length, force = factors = _unit_factors(where) if whole else (1.0, 1.0)
    axes = systems.axes(ids)
    dofs = node_dofs(ids, DIRECTIONS, at_nodes(ids, np.asarray(known), xyz, str(where)))
    motions = np.stack([np.real(part.motions) for part in parts], axis=2)
    moved = f"{counted(len(axes), 'node')} moved in local directions: turned into the global ones"
    zeta, masses = np.array([part.zeta for part in parts]), np.array([part.mass for part in parts])
    return FileShapes(
        2 * np.pi * np.array([part.freq for part in parts]),
        turned_motions(motions, ids.tolist(), axes).reshape(6 * ids.size, -1),
        dofs,
        notes=(moved,) if axes else (),
        masses=masses if np.any(masses) else None,
        zeta=zeta if np.any(zeta) else None,
        # numbers over factors are in SI, and mass is force over acceleration
        units=None if factors == (1.0, 1.0) else Units(1 / length, length / force, 1.0),
    )


MODE_READERS |= dict.fromkeys(_UNIVERSAL, read_uff_shapes)
