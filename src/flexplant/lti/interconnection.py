"""Systems from systems: series, parallel, feedback, append, lft, and connection by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import csgraph

from ..errors import LabelError, ModelError, ShapeError, unknown_label
from ..values import FloatArray
from .scaling import balanced_matrix
from .statespace import StateSpace, System, as_statespace


def append(*systems: System) -> StateSpace:
    """Return the block-diagonal system: inputs and outputs of all, in order.

    Parameters
    ----------
    *systems : StateSpace
        Any number.

    Raises
    ------
    LabelError
        When two share a channel name: rename one.
    ModelError
        When sampling times differ.
    """
    parts = [as_statespace(sys) for sys in systems]
    return StateSpace(
        _stacked([p.A for p in parts]),
        _stacked([p.B for p in parts]),
        _stacked([p.C for p in parts]),
        _stacked([p.D for p in parts]),
        common_dt(parts),
        inputs=[name for p in parts for name in p.inputs],
        outputs=[name for p in parts for name in p.outputs],
        states=_state_names(parts),
        blocks=_joined_blocks(parts),
    )


def series(first: System, second: System) -> StateSpace:
    """Return second * first: the outputs of `first` drive the inputs of `second`, in order.

    Parameters
    ----------
    first, second : StateSpace
        As many outputs of the first as inputs of the second; their names need not agree.

    Raises
    ------
    ShapeError
        When the numbers of channels differ.
    """
    g1, g2 = as_statespace(first), as_statespace(second)
    if len(g1.outputs) != len(g2.inputs):
        raise ShapeError(
            f"series needs as many outputs of the first system as inputs of the second, got "
            f"{len(g1.outputs)} ({_short(g1.outputs)}) and {len(g2.inputs)} ({_short(g2.inputs)})."
        )
    # the second system's states first: A stays block upper triangular
    n1, n2 = g1.n_states, g2.n_states
    return StateSpace(
        np.block([[g2.A, g2.B @ g1.C], [np.zeros((n1, n2)), g1.A]]),
        np.vstack([g2.B @ g1.D, g1.B]),
        np.hstack([g2.C, g2.D @ g1.C]),
        g2.D @ g1.D,
        common_dt([g1, g2]),
        inputs=g1.inputs,
        outputs=g2.outputs,
        states=_state_names([g2, g1]),
        blocks=_joined_blocks([g2, g1]),
    )


def parallel(first: System, second: System) -> StateSpace:
    """Return first + second: same inputs, outputs added, channel by channel.

    Parameters
    ----------
    first, second : StateSpace
        With the same channel names.

    Raises
    ------
    LabelError
        When the channel names differ.
    """
    g1, g2 = as_statespace(first), as_statespace(second)
    if g1.inputs != g2.inputs or g1.outputs != g2.outputs:
        raise LabelError(
            f"parallel needs the same channels, got {_short(g1.inputs)} -> {_short(g1.outputs)} "
            f"and {_short(g2.inputs)} -> {_short(g2.outputs)}. Rename or select them first."
        )
    return StateSpace(
        _stacked([g1.A, g2.A]),
        np.vstack([g1.B, g2.B]),
        np.hstack([g1.C, g2.C]),
        g1.D + g2.D,
        common_dt([g1, g2]),
        inputs=g1.inputs,
        outputs=g1.outputs,
        states=_state_names([g1, g2]),
        blocks=_joined_blocks([g1, g2]),
    )


def lft(P: System, K: System) -> StateSpace:
    """Return the lower linear fractional transformation of P with ``u = K y``.

    ``F_l(P, K) = P11 + P12 K (I - P22 K)^-1 P21``, connected by name: the inputs of K are outputs
    of P, the outputs of K inputs of P; what remains of P stays open, in order.

    Parameters
    ----------
    P : StateSpace
        ``[w; u] -> [z; y]``.
    K : StateSpace
        ``y -> u``; the sign of the feedback is in K.

    Returns
    -------
    StateSpace
        w -> z, states of P then of K.

    Raises
    ------
    LabelError
        When a channel of K is not one of P.
    ModelError
        When the loop is ill-posed (I - D22 DK singular) or sampling times differ.
    """
    plant, controller = as_statespace(P), as_statespace(K)
    y, u = plant.output_index(controller.inputs), plant.input_index(controller.outputs)
    z = np.setdiff1d(np.arange(len(plant.outputs)), y)
    w = np.setdiff1d(np.arange(len(plant.inputs)), u)
    D22, DK = plant.D[np.ix_(y, u)], controller.D
    B1, B2, C1, C2 = plant.B[:, w], plant.B[:, u], plant.C[z], plant.C[y]
    D11, D12, D21 = plant.D[np.ix_(z, w)], plant.D[np.ix_(z, u)], plant.D[np.ix_(y, w)]
    # u = R (DK C2 x + CK xk + DK D21 w) with R = (I - DK D22)^-1; y = S (C2 x + D22 CK xk + D21 w)
    R, S = _well_posed(DK @ D22), _well_posed(D22 @ DK)
    u_x, u_k, u_w = R @ DK @ C2, R @ controller.C, R @ DK @ D21
    y_x, y_k, y_w = S @ C2, S @ D22 @ controller.C, S @ D21
    return StateSpace(
        np.block(
            [
                [plant.A + B2 @ u_x, B2 @ u_k],
                [controller.B @ y_x, controller.A + controller.B @ y_k],
            ]
        ),
        np.vstack([B1 + B2 @ u_w, controller.B @ y_w]),
        np.hstack([C1 + D12 @ u_x, D12 @ u_k]),
        D11 + D12 @ u_w,
        common_dt([plant, controller]),
        inputs=[plant.inputs[i] for i in w],
        outputs=[plant.outputs[i] for i in z],
        states=_state_names([plant, controller]),
        name=plant.name,
    )


def feedback(forward: System, back: System | None = None, *, sign: int = -1) -> StateSpace:
    """Return ``(I - sign G H)^-1 G``: G in the forward path, H (or one) in the return path.

    Parameters
    ----------
    forward, back : StateSpace
        G and H, connected in order of their channels.
    sign : {-1, +1}
        Negative feedback unless told otherwise.

    Raises
    ------
    ShapeError
        When the numbers of channels do not match.
    ModelError
        When the loop is ill-posed.
    """
    g = as_statespace(forward)
    h = as_statespace(np.eye(len(g.outputs)) if back is None else back)
    if len(h.inputs) != len(g.outputs) or len(h.outputs) != len(g.inputs):
        raise ShapeError(
            f"feedback needs H with {len(g.outputs)} inputs and {len(g.inputs)} outputs, got "
            f"{len(h.inputs)} and {len(h.outputs)}."
        )
    if sign not in (-1, 1):
        raise ModelError(f"sign must be -1 or +1, got {sign!r}.")
    # G with its inputs and outputs twice: once open, once for the loop
    inner_in = [f"{name}|loop" for name in g.inputs]
    inner_out = [f"{name}|loop" for name in g.outputs]
    doubled = StateSpace(
        g.A,
        np.hstack([g.B, g.B]),
        np.vstack([g.C, g.C]),
        np.block([[g.D, g.D], [g.D, g.D]]),
        g.dt,
        inputs=[*g.inputs, *inner_in],
        outputs=[*g.outputs, *inner_out],
        states=g.states,
        name=g.name,
    )
    loop = h.replace(C=sign * h.C, D=sign * h.D, inputs=inner_out, outputs=inner_in)
    if not loop.n_states:
        loop = loop.replace(dt=g.dt)
    return lft(doubled, loop)


def connect(
    systems: Sequence[System],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    adding: Iterable[str] = (),
) -> StateSpace:
    """Return the interconnection of systems by name.

    A system's input is driven by the output or the outer input of the same name.

    Parameters
    ----------
    systems : sequence of StateSpace
        The blocks.
    inputs : sequence of str
        Outer inputs; each drives every block input of its name.
    outputs : sequence of str
        Outer outputs, each the output of a block or an outer input.
    adding : iterable of str
        Names that several blocks may drive; their outputs add.

    Returns
    -------
    StateSpace
        With exactly these inputs and outputs, states of the blocks in order.

    Raises
    ------
    LabelError
        When a block input is driven by nothing, or a name is driven twice.
    ModelError
        When the loop is ill-posed or sampling times differ.
    """
    parts = [as_statespace(sys) for sys in systems]
    produced = [name for part in parts for name in part.outputs]
    needed = [name for part in parts for name in part.inputs]
    outer = list(inputs)
    known = [*produced, *outer]
    may_add = set(adding)
    for name in sorted({n for n in known if known.count(n) > 1} - may_add):
        raise LabelError(
            f"{name!r} is driven {known.count(name)} times: two blocks (or a block and an outer "
            "input) produce it. Rename one, or add them in a block of their own."
        )
    for name in [*needed, *outputs]:
        if name not in known:
            raise unknown_label("signal to connect", name, known)
    route = np.array([[float(a == b) for b in produced] for a in needed]).reshape(
        len(needed), len(produced)
    )
    enter = np.array([[float(a == b) for b in outer] for a in needed]).reshape(
        len(needed), len(outer)
    )
    leave = np.array([[float(a == b) for b in produced] for a in outputs]).reshape(
        len(outputs), len(produced)
    )
    through = np.array([[float(a == b) for b in outer] for a in outputs]).reshape(
        len(outputs), len(outer)
    )
    A, B, C, D = (_stacked([getattr(p, part) for p in parts]) for part in "ABCD")
    # block outputs v = C x + D e with e = route v + enter w  =>  v = X (C x + D enter w)
    X = _well_posed(D @ route)
    v_x, v_w = X @ C, X @ D @ enter
    return StateSpace(
        A + B @ route @ v_x,
        B @ (route @ v_w + enter),
        leave @ v_x,
        leave @ v_w + through,
        common_dt(parts),
        inputs=outer,
        outputs=list(outputs),
        states=_state_names(parts),
    )


def common_dt(systems: Iterable[StateSpace]) -> float:
    """Return the sampling time that systems share; static gains fit any.

    Raises
    ------
    ModelError
        When they differ.
    """
    found = {sys.dt for sys in systems if sys.n_states} or {sys.dt for sys in systems}
    if len(found) > 1 and not np.allclose(list(found), next(iter(found)), rtol=1e-12, atol=0):
        raise ModelError(
            f"systems with sampling times {sorted(found)} s cannot be connected (0 is continuous). "
            "Discretise them to one rate first."
        )
    return found.pop() if found else 0.0


def _well_posed(loop: FloatArray) -> FloatArray:
    """Return (I - loop)^-1, refusing an algebraic loop that has no solution.

    Only channels that depend on themselves can be ill-posed, whatever their units: each strongly
    connected part is judged after balancing.
    """
    count, part = csgraph.connected_components(loop != 0, connection="strong")
    for i in range(count):
        inside = np.flatnonzero(part == i)
        balanced = balanced_matrix(loop[np.ix_(inside, inside)])
        condition = float(np.linalg.cond(np.eye(inside.size) - balanced))
        if condition > 1e12:
            raise ModelError(
                f"the algebraic loop is ill-posed: I - D D has condition {condition:.1e}. Break it "
                "with a sample of delay or a controller without direct feedthrough."
            )
    return np.asarray(np.linalg.inv(np.eye(loop.shape[0]) - loop))


def _stacked(matrices: Sequence[FloatArray]) -> FloatArray:
    """Block diagonal that keeps the widths of empty matrices (scipy's drops them)."""
    out = np.zeros((sum(m.shape[0] for m in matrices), sum(m.shape[1] for m in matrices)))
    row = col = 0
    for matrix in matrices:
        out[row : row + matrix.shape[0], col : col + matrix.shape[1]] = matrix
        row, col = row + matrix.shape[0], col + matrix.shape[1]
    return out


def _joined_blocks(parts: Sequence[StateSpace]) -> list[int]:
    sizes: list[int] = []
    for part in parts:
        sizes.extend(
            part.blocks if part.blocks is not None else ((part.n_states,) if part.n_states else ())
        )
    return sizes


def _state_names(parts: Sequence[StateSpace]) -> list[str]:
    """Join state names; where they clash, add the system's place in the list."""
    plain = [name for part in parts for name in part.states]
    if len(set(plain)) == len(plain):
        return plain
    return [f"{i}:{name}" for i, part in enumerate(parts, 1) for name in part.states]


def _short(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
