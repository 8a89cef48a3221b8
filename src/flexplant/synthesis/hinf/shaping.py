"""shape_loop: from a bandwidth to the shaped plant, its robust controller and the margins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, below_half_rate, positive
from ...certificates import Certificate, Verified, stability_check
from ...errors import CertificateError, ModelError, SolverError, warn
from ...loop import LoopReport, report_loops
from ...lti.discretisation import tustin
from ...lti.filters import low_pass_filter
from ...lti.frequency_sweep import SOUGHT, highest, resonance_grid
from ...lti.interconnection import connect, loop_poles, series, side_by_side
from ...lti.minimal_realisations import minimal
from ...lti.response_solvers import responses
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread
from ...plant import AnyPlant
from ...store import Value
from ..controller import Controller, with_left_out
from ..laws.law import Axes, connected
from ..laws.loop_design import axes_of
from .hinf_design import design_hinf
from .ncf import (
    continuous,
    integral_action,
    loop_margin,
    ncf_solutions,
    numbered,
    power,
    require_model,
    verified_controller,
)

#: how near the crossover comes to the bandwidth, and the steps that it may take
_NEAR, _STEPS = 0.02, 8
#: divisions of a grid at the largest error of following a model
_ROUNDS = 3
#: weight of following a model above which a warning is given
_HEAVY = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class ShapedLoop(Value):
    """A loop shaped to a bandwidth: every step of the recipe.

    Parameters
    ----------
    shaped : StateSpace
        The plant in its axes with the shaping before it.
    controller : Controller
        From y (and references) to u; what was verified is in it.
    report : LoopReport
        Crossovers and margins of each axis, the others closed.
    """

    shaped: StateSpace
    controller: Controller
    report: LoopReport

    @property
    def system(self) -> StateSpace:
        """The controller, for `close_loop`."""
        return self.controller.system

    def __repr__(self) -> str:
        first, *rest = repr(self.report).splitlines()
        return "\n".join([first.replace("LoopReport", "ShapedLoop"), *rest, repr(self.controller)])


@one_thread()
def shape_loop(
    plant: AnyPlant | System,
    *,
    bandwidth: float,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rolloff: float | None = None,
    model: float | System | None = None,
    weight: float = 1.0,
    references: Mapping[str, str] | None = None,
    back_off: float = 0.1,
) -> ShapedLoop:
    """Return the loop shaped to a bandwidth by the recipe of Glover and McFarlane.

    In the decoupled axes the plant gets integral action, a roll-off and a gain (`design_ncf`); the
    robust controller of the shaped plant moves the crossover, so the gain is set again until the
    slowest axis crosses 1 at the bandwidth. With a reference model the controller has two degrees
    of freedom: it reads references too, and the closed loop follows the model.

    Parameters
    ----------
    plant : StandardPlant or StateSpace
        Continuous or sampled, with rigid-body modes and integrators as they are. Of an assembled
        StandardPlant the rigid-body axes are taken (`decouple`), unless `before` and `after` are
        given.
    bandwidth : float [Hz]
        Where the slowest axis shall cross 1.
    before, after : StateSpace or array, optional
        Static transformations, commands of the axes to u and y to motions.
    rolloff : float [Hz], optional
        Corner of a second-order low-pass before the plant.
    model : float [Hz] or StateSpace, optional
        Reference model: second-order low-passes of this corner, one for each axis, or a
        continuous stable system from references to motions of the axes.
    weight : float
        rho: how much following the model counts beside robustness, 1 to 3.
    references : mapping {axis: channel of y}, optional
        Axes that follow a reference, and its name, such as ``{"cog:z": "die:ref"}``; with a model
        all axes, ``cog:z:ref`` and so on, unless given.
    back_off : float
        Relative distance from the smallest gamma, with one degree of freedom.

    Returns
    -------
    ShapedLoop
        Of its controller `gamma` is the verified norm (one degree of freedom: 1 over the margin
        against errors of the coprime factors; below 4 is robust), `lower` the smallest gamma of the
        shaped plant. The certificate holds the margin, and of two degrees of freedom the largest
        error of following the model.

    Raises
    ------
    AssumptionError, CertificateError, ModelError, ShapeError, LabelError
        As for `design_ncf`; names too.
    SolverError
        When no gain brings the crossover to the bandwidth.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.
        When the roll-off is below twice the bandwidth, or the weight above 10.

    References
    ----------
    [McFarlaneGlover1992]_; [Hoyle1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> shaped = fx.synthesis.shape_loop(fx.lti.tf([1.0], [1.0, 1.0, 0.0]), bandwidth=10.0)
    >>> shaped.controller.system.n_states
    4
    """
    target, back_off = positive(bandwidth, "bandwidth"), positive(back_off, "back_off")
    rho = positive(weight, "weight")
    require_model(plant)
    axes = axes_of(plant, before, after, None, 0.0, True)
    rate = 1.0 / axes.plant.dt if axes.plant.dt else 0.0
    below_half_rate(target, "bandwidth", rate)
    if rolloff is not None:
        below_half_rate(rolloff, "rolloff", rate)
    if isinstance(model, int | float | np.number):
        below_half_rate(model, "model", rate)
    _unusual(target, rolloff, None if model is None else rho)
    T_ref = None if model is None else _model(model, axes)
    freq = target
    for _ in range(_STEPS):
        shaping = _shaping(axes, freq, rolloff)
        shaped = series(shaping, axes.plant)
        K, gamma, least, certificate = _shaped_controller(shaped, T_ref, rho, back_off)
        K = series(K, shaping)
        inner = K.select(inputs=K.inputs[-len(axes.names) :])
        inner = inner.replace(inputs=axes.names, outputs=axes.before.inputs)
        report = report_loops((axes.plant, inner), at="y")
        reached = [one.crossovers[0] for one in report.loops if one.crossovers]
        if reached and abs(min(reached) / target - 1.0) <= _NEAR:
            break
        freq *= target / min(reached) if reached else 2.0
        if rate and freq >= 0.5 * rate:
            break
    if not reached or abs(min(reached) / target - 1.0) > _NEAR:
        raise SolverError(
            f"the slowest axis crosses 1 at {min(reached, default=np.nan):.4g} Hz, not at "
            f"{target:g} Hz, whatever the gain: the plant's delay or resonances leave no loop of "
            "that bandwidth. Lower it, or the roll-off."
        )
    if references is None:
        references = {} if T_ref is None else {axis: f"{axis}:ref" for axis in axes.names}
    system = connected(axes, K, references).replace(name="shaped loop")
    if not report.is_stable:
        raise CertificateError(
            "the loop of the plant as given is not stable: a mode was hidden by the shaping. "
            "Move the zeros of `before` and `after`."
        )
    feedback = system.select(inputs=axes.after.inputs)  # references take no part in the loop
    controller = Controller(
        system,
        f"loop shaping to {target:g} Hz{'' if T_ref is None else ', two degrees of freedom'}",
        gamma=gamma,
        lower=least,
        certificate=certificate,
    )
    if axes.given is not None:
        controller = with_left_out(controller, axes.given, feedback)
    return ShapedLoop(shaped, controller, report)


def _unusual(bandwidth: float, rolloff: float | None, rho: float | None) -> None:
    """Warn of numbers that are allowed and rarely meant."""
    if rolloff is not None and positive(rolloff, "rolloff") < 2.0 * bandwidth:
        warn(
            f"rolloff {rolloff:g} Hz is not above twice the bandwidth, {bandwidth:g} Hz: its phase "
            "lag takes the margin. Three to ten times the bandwidth is usual."
        )
    if rho is not None and rho > _HEAVY:
        warn(
            f"weight {rho:g} counts following the model so much more than robustness that little "
            "margin is left: 1 to 3 is usual."
        )


def _shaped_controller(
    shaped: StateSpace, model: StateSpace | None, rho: float, back_off: float
) -> tuple[StateSpace, float, float, Certificate]:
    """Return the controller of a shaped plant, y or [references; y] to u, gamma, least, and more.

    With one degree of freedom, or with two where there is a model; the last is what was verified.
    """
    K, least, certificate = verified_controller(shaped, back_off)
    if model is None:
        return K, 1.0 / certificate["margin"], least, certificate
    K, gamma = following(shaped, model, rho)
    margin, stability = loop_margin(shaped, K.select(inputs=K.inputs[len(shaped.outputs) :]))
    if not margin >= (1.0 - 1e-3) / gamma:  # as of every norm that is verified
        raise CertificateError(
            f"the loop of the shaped plant has the margin {margin:.6g} where {1.0 / gamma:.6g} was "
            "claimed: the shaped plant is too badly conditioned to trust. Bring its gains at u "
            "and y to size 1."
        )
    kept = Verified(
        "margin", margin, "norm of the four blocks", (1.0 - 1e-3) / gamma, at_least=True
    )
    error = Verified("error of following", _following_error(shaped, model, K), "peak of T - model")
    checks = kept, stability_check(stability, shaped.dt), error
    return K, gamma, least, certificate | Certificate(checks)


def _following_error(shaped: StateSpace, model: StateSpace, K: StateSpace) -> float:
    """Return the largest singular value of closed loop minus model over a sweep."""
    poles = loop_poles(shaped, K.select(inputs=K.inputs[len(shaped.outputs) :]))
    grid = resonance_grid(poles, shaped.dt, around=SOUGHT)

    def error(freq: FloatArray) -> FloatArray:
        closed, T = _followed(shaped, model, K, freq)
        return np.asarray(np.linalg.norm(closed - T, 2, axis=(1, 2)))

    return highest(error, grid[grid < 0.499 / shaped.dt] if shaped.dt else grid, _ROUNDS)[0]


def _followed(
    shaped: StateSpace, model: StateSpace, K: StateSpace, freq: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return ``(I - G K2)^-1 G K1`` and the model's response (n_freq, p, p)."""
    G, gains, T = (np.moveaxis(responses(s, freq), 2, 0) for s in (shaped, K, model))
    p = T.shape[1]
    closed = np.linalg.solve(np.eye(p) - G @ gains[:, :, p:], G @ gains[:, :, :p])
    return np.asarray(closed, dtype=np.complex128), T


def _model(given: float | System, axes: Axes) -> StateSpace:
    """Return the reference model: as it is given, or low-passes."""
    if not isinstance(given, int | float | np.number):
        return as_statespace(given)
    one = low_pass_filter(positive(given, "model"), order=2)
    names = [f"{name}:ref" for name in axes.names]
    return side_by_side([one] * len(names), axes.names).replace(inputs=names)


def _shaping(axes: Axes, freq: float, rolloff: float | None) -> StateSpace:
    """Return integral action and roll-off of each axis, of gain 1 with the plant at a frequency."""
    if rolloff is None:
        return integral_action(axes.plant, freq)
    names = axes.before.inputs
    filters = side_by_side([low_pass_filter(rolloff, order=2)] * len(names), names)
    filters = tustin(filters, axes.rate) if axes.rate else filters
    return series(integral_action(series(filters, axes.plant), freq), filters)


#: frequency, beside the slowest pole of the model, that stands for zero
_SLOW = 1e-4


def following(shaped: StateSpace, model: StateSpace, weight: float) -> tuple[StateSpace, float]:
    """Return ``[K1 W, K2]``, from references and y to u, of a shaped plant, and its gamma."""
    # `u = K1 r + K2 y` minimises the norm from [r; phi] to [u; y; e], where `y = M^-1 (N u + phi)`
    # with the normalised left coprime factors N, M of the plant, `r` counts rho times and
    # `e = rho (y - rho T_ref r)`: the larger rho (`weight`), the closer the loop follows the model
    # T_ref, the less robust it is. W brings the gain at zero frequency to that of the model.
    # [Hoyle1991]_; [Limebeer1993]_
    p, m = len(shaped.outputs), len(shaped.inputs)
    if model.dt or model.D.shape != (p, p) or not model.is_stable:
        raise ModelError(
            f"the reference model must be continuous and stable, with {p} inputs and outputs, got "
            f"{model!r}. Pass low-passes of the loop's bandwidth, one for each axis."
        )
    part = minimal(shaped)
    _, Z = ncf_solutions(part)
    g = continuous(part)
    P = _two_degrees(g, model, Z, weight)
    found = design_hinf(P, u=P.inputs[-m:], y=P.outputs[-2 * p :])
    K = tustin(found.system, 1.0 / shaped.dt) if shaped.dt else found.system
    W = la.block_diag(_scaling(shaped, model, K), np.eye(p))
    return K.replace(B=K.B @ W, D=K.D @ W), float(found.gamma or np.nan)


def _two_degrees(g: StateSpace, model: StateSpace, Z: FloatArray, rho: float) -> StateSpace:
    """Return [r; phi; u] -> [u; y; e; rho r; y]."""
    p, m = g.D.shape
    R = np.eye(p) + g.D @ g.D.T
    shake = (g.B @ g.D.T + Z @ g.C.T) @ power(R, -0.5)
    u, zu = (numbered(kind, m) for kind in ("u", "zu"))
    r, phi, y, zy, t, e, read = (
        numbered(kind, p) for kind in ("r", "phi", "y", "zy", "t", "e", "read")
    )
    B, D = np.hstack([shake, g.B]), np.hstack([power(R, 0.5), g.D])
    plant = StateSpace(g.A, B, g.C, D, inputs=[*phi, *u], outputs=y)
    follow = np.kron([[1.0, 0.0, 0.0], [rho, -(rho**2), 0.0], [0.0, 0.0, rho]], np.eye(p))
    gains, entering = la.block_diag(np.eye(m), follow), [*u, *y, *t, *r]
    sums = StateSpace([], [], [], gains, inputs=entering, outputs=[*zu, *zy, *e, *read])
    known = model.replace(inputs=r, outputs=t, units={})
    return connect([plant, known, sums], [*r, *phi, *u], [*zu, *zy, *e, *read, *y])


def _scaling(shaped: StateSpace, model: StateSpace, K: StateSpace) -> FloatArray:
    """Return W with ``(I - G K2)^-1 G K1 W = T_ref`` at a frequency that stands for zero."""
    slowest = float(np.abs(model.poles()).min(initial=np.inf)) / (2.0 * np.pi)
    freq = np.array([_SLOW * (slowest if np.isfinite(slowest) else 1.0)])
    closed, T = _followed(shaped, model, K, freq)
    return np.asarray(np.linalg.solve(closed[0], T[0]).real)
