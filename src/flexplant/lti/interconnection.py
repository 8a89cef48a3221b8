"""Systems from systems: series, parallel, feedback, append, lft, and connection by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import scipy.linalg as la
from scipy.sparse import csgraph

from ..arrays import ComplexArray, FloatArray, IntArray, inner_names, instance, name_list
from ..errors import LabelError, ModelError, ShapeError, require_known, short
from ..tolerances import ROUNDING
from .blocks_of_states import (
    Matrices,
    block_matrix,
    common_dt,
    common_fields,
    joined_units,
    state_names,
)
from .equations import balanced_matrix
from .statespace import StateSpace, System, as_statespace


def append(*systems: System) -> StateSpace:
    """Return the block-diagonal system: inputs and outputs of all, in order.

    Parameters
    ----------
    *systems : StateSpace
        Systems, in any number.

    Raises
    ------
    LabelError
        When two share a channel name: rename one.

    Examples
    --------
    >>> import flexplant as fx
    >>> first = fx.lti.tf([1.0], [1.0, 1.0]).replace(inputs=["u1"], outputs=["y1"])
    >>> second = fx.lti.tf([2.0], [1.0, 2.0]).replace(inputs=["u2"], outputs=["y2"])
    >>> both = fx.lti.append(first, second)
    >>> both.inputs, both.outputs
    (('u1', 'u2'), ('y1', 'y2'))
    """
    parts = [as_statespace(sys) for sys in systems]
    return StateSpace(
        block_matrix([p.A for p in parts]),
        block_matrix([p.B for p in parts]),
        block_matrix([p.C for p in parts]),
        block_matrix([p.D for p in parts]),
        inputs=[name for p in parts for name in p.inputs],
        outputs=[name for p in parts for name in p.outputs],
        **common_fields(parts),
    )


def side_by_side(systems: Iterable[System], names: Iterable[str], mark: str = "|") -> StateSpace:
    """Return single-channel systems as one system with the given channel names."""
    return append(
        *(
            g.replace(inputs=[n], outputs=[n], states=[f"{n}{mark}{state}" for state in g.states])
            for g, n in zip(map(as_statespace, systems), names, strict=True)
        )
    )


def among(
    g: StateSpace,
    inputs: Sequence[str],
    outputs: Sequence[str],
    through: Mapping[tuple[str, str], float] | None = None,
) -> StateSpace:
    """Return a system with more channels and with added gains {(output, input): k}."""
    column, row = ({name: i for i, name in enumerate(names)} for names in (inputs, outputs))
    driven, seen = [column[name] for name in g.inputs], [row[name] for name in g.outputs]
    B, C = np.zeros((g.n_states, len(column))), np.zeros((len(row), g.n_states))
    D = np.zeros((len(row), len(column)))
    B[:, driven], C[seen], D[np.ix_(seen, driven)] = g.B, g.C, g.D
    for (to, fro), gain in (through or {}).items():
        D[row[to], column[fro]] += gain
    return g.replace(B=B, C=C, D=D, inputs=inputs, outputs=outputs)


def series(first: System, second: System) -> StateSpace:
    """Return second * first: the outputs of `first` drive the inputs of `second`, in order.

    Parameters
    ----------
    first, second : StateSpace
        Systems; the first has as many outputs as the second has inputs, with any names.

    Raises
    ------
    ShapeError
        When the numbers of channels differ.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([2.0], [1.0, 1.0])
    >>> fx.lti.series(lag, lag).dcgain()
    4.0
    """
    return as_statespace(second) * as_statespace(first)


def parallel(first: System, second: System) -> StateSpace:
    """Return first + second: same inputs, outputs added, channel by channel.

    Parameters
    ----------
    first, second : StateSpace
        Systems with the same channel names.

    Raises
    ------
    LabelError
        When the channel names differ.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([1.0], [1.0, 1.0])
    >>> fx.lti.parallel(lag, lag).dcgain()
    2.0
    """
    return as_statespace(first) + as_statespace(second)


def lft(P: System, K: System) -> StateSpace:
    """Return the lower linear fractional transformation of P with ``u = K y``.

    ``F_l(P, K) = P11 + P12 K (I - P22 K)^-1 P21``, connected by name. Each input of K has the name
    of an output of P, and each output of K the name of an input of P. The other inputs and outputs
    of P are those of the result, in the same order.

    Parameters
    ----------
    P : StateSpace
        ``[w; u] -> [z; y]``.
    K : StateSpace
        ``y -> u``; the sign of the feedback is in K.

    Returns
    -------
    StateSpace
        System w -> z with the states of P, then those of K.

    Raises
    ------
    LabelError
        When a channel of K is not one of P.
    ModelError
        When the loop is ill-posed (I - D22 DK singular) or sampling times differ.

    References
    ----------
    [ZhouDoyleGlover1996]_, chapter 10.

    Examples
    --------
    >>> import flexplant as fx
    >>> A, B, C = [[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]]
    >>> plant = fx.StateSpace(A, B, C, [[0, 0], [0, 0]], inputs=["w", "u"], outputs=["z", "y"])
    >>> gain = fx.StateSpace([], [], [], [[-9.0]], inputs=["y"], outputs=["u"])
    >>> fx.lft(plant, gain).poles().real
    array([-10.])
    """
    plant, controller = as_statespace(P), as_statespace(K)
    y, u = plant.output_index(controller.inputs), plant.input_index(controller.outputs)
    z, w = _others(len(plant.outputs), y), _others(len(plant.inputs), u)
    D22, DK = plant.D[np.ix_(y, u)], controller.D
    B1, B2, C1, C2 = plant.B[:, w], plant.B[:, u], plant.C[z], plant.C[y]
    D11, D12, D21 = plant.D[np.ix_(z, w)], plant.D[np.ix_(z, u)], plant.D[np.ix_(y, w)]
    # u = u_x x + u_k xk + R DK D21 w with R = (I - DK D22)^-1; y = S (C2 x + D22 CK xk + D21 w)
    R, S = _well_posed(DK @ D22), _well_posed(D22 @ DK)
    A, u_x, u_k = _looped(
        (plant.A, B2, C2, D22), (controller.A, controller.B, controller.C, DK), R, S
    )
    u_w, y_w = R @ DK @ D21, S @ D21
    return StateSpace(
        A,
        np.vstack([B1 + B2 @ u_w, controller.B @ y_w]),
        np.hstack([C1 + D12 @ u_x, D12 @ u_k]),
        D11 + D12 @ u_w,
        common_dt([plant, controller]),
        inputs=[plant.inputs[i] for i in w],
        outputs=[plant.outputs[i] for i in z],
        states=state_names([plant, controller]),
        name=plant.name,
        units=plant.units,
    )


def _others(count: int, chosen: IntArray) -> IntArray:
    """Return the numbers below a count that are not chosen."""
    left = np.ones(count, dtype=bool)
    left[chosen] = False
    return np.flatnonzero(left)


def loop_poles(g: StateSpace, K: StateSpace | Matrices) -> ComplexArray:
    """Return the poles of the loop of g and ``u = K y``, channels of both in one order."""
    P, back = (g.A, g.B, g.C, g.D), K if isinstance(K, tuple) else (K.A, K.B, K.C, K.D)
    A, *_ = _looped(P, back, _well_posed(back[3] @ g.D), _well_posed(g.D @ back[3]))
    return np.asarray(la.eigvals(A), dtype=np.complex128)


def _looped(
    P: Matrices, K: Matrices, R: FloatArray, S: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A of the loop and ``u = u_x x + u_k xk``; R, S: (I - DK D)^-1, (I - D DK)^-1."""
    (A, B, C, D), (AK, BK, CK, DK) = P, K
    u_x, u_k, y_x, y_k = R @ DK @ C, R @ CK, S @ C, S @ D @ CK
    return np.block([[A + B @ u_x, B @ u_k], [BK @ y_x, AK + BK @ y_k]]), u_x, u_k


def feedback(forward: System, back: System | None = None, *, sign: int = -1) -> StateSpace:
    """Return ``(I - sign G H)^-1 G``: G in the forward path, H (or one) in the return path.

    Parameters
    ----------
    forward, back : StateSpace
        G and H, connected in order of their channels.
    sign : {-1, +1}
        Sign of the feedback; negative by default.

    Raises
    ------
    ModelError
        When the loop is ill-posed.

    References
    ----------
    [Skogestad2005]_, section 3.2.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.feedback(fx.lti.tf([3.0], [1.0, 0.0])).poles().real
    array([-3.])
    """
    g = as_statespace(forward)
    h = as_statespace(np.eye(len(g.outputs)) if back is None else back)
    if len(h.inputs) != len(g.outputs) or len(h.outputs) != len(g.inputs):
        raise ShapeError(
            f"feedback needs H with {len(g.outputs)} inputs and {len(g.inputs)} outputs, got "
            f"{len(h.inputs)} and {len(h.outputs)}."
        )
    if not isinstance(sign, int | float) or sign not in (-1, 1):
        raise ModelError(f"sign must be -1 or +1, got {short(sign)}. -1 is negative feedback.")
    # G with its inputs and outputs twice: once open, once for the loop
    inner_in = inner_names((f"{name}|loop" for name in g.inputs), g.inputs)
    inner_out = inner_names((f"{name}|loop" for name in g.outputs), g.outputs)
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
        units=g.units,
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

    Each input of a system is driven by the output of another system, or by the outer input, that
    has the same name. The systems are also called blocks below.

    Parameters
    ----------
    systems : sequence of StateSpace
        Systems to connect.
    inputs : sequence of str
        Outer inputs; each drives every block input of its name.
    outputs : sequence of str
        Outer outputs, each the output of a block or an outer input.
    adding : iterable of str
        Names that several blocks may drive; their outputs add.

    Returns
    -------
    StateSpace
        System with exactly these inputs and outputs, and with the states of the blocks in order.

    Raises
    ------
    LabelError
        When a block input is driven by nothing, or a name is driven twice.
    ModelError
        When the loop is ill-posed or sampling times differ.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.lti.tf([1.0], [1.0, 0.0]).replace(inputs=["u"], outputs=["y"])
    >>> law = fx.StateSpace([], [], [], [[-3.0, 3.0]], inputs=["y", "r"], outputs=["u"])
    >>> loop = fx.lti.connect([plant, law], inputs=["r"], outputs=["y"])
    >>> loop.poles().real
    array([-3.])
    """
    hint = "Pass systems in [...]."
    parts = [as_statespace(sys) for sys in instance(systems, Iterable, "systems", hint)]
    produced = [name for part in parts for name in part.outputs]
    needed = [name for part in parts for name in part.inputs]
    outer, outputs = name_list(inputs, "inputs"), name_list(outputs, "outputs")
    known = [*produced, *outer]
    may_add = set(name_list(adding, "adding"))
    for name in sorted({n for n in known if known.count(n) > 1} - may_add):
        raise LabelError(
            f"{name!r} is driven {known.count(name)} times: two blocks (or a block and an outer "
            "input) produce it. Rename one, or add them in a separate block."
        )
    require_known("signal to connect", [*needed, *outputs], known)
    route, enter, leave, through = (
        np.array([[float(a == b) for b in fro] for a in to]).reshape(len(to), len(fro))
        for to, fro in ((needed, produced), (needed, outer), (outputs, produced), (outputs, outer))
    )
    A, B, C, D = (block_matrix([getattr(p, part) for p in parts]) for part in "ABCD")
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
        states=state_names(parts),
        units=joined_units(parts),
    )


def _well_posed(loop: FloatArray) -> FloatArray:
    """Return (I - loop)^-1, refusing an algebraic loop that has no solution."""
    # only channels that depend on themselves can be ill-posed, whatever their units
    if not loop.any():
        return np.eye(loop.shape[0])
    count, part = csgraph.connected_components(loop != 0, connection="strong")
    for i in range(count):
        inside = np.flatnonzero(part == i)
        balanced = balanced_matrix(loop[np.ix_(inside, inside)])
        condition = float(np.linalg.cond(np.eye(inside.size) - balanced))
        if condition > 1.0 / ROUNDING:
            raise ModelError(
                f"the algebraic loop is ill-posed: I - D D has condition {condition:.1e}. Break it "
                "with a sample of delay or a controller without direct feedthrough."
            )
    return np.asarray(np.linalg.inv(np.eye(loop.shape[0]) - loop))
