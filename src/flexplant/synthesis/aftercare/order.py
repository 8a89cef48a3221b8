"""Controllers of fewer states, or sampled: what they replace is closed again, and kept."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, instance, positive, whole
from ...certificates import Certificate, Verified, stability, stability_check, stability_name
from ...errors import CertificateError, FlexplantError, FlexplantWarning, ModelError
from ...loop import close_loop
from ...lti.balancing import balanced
from ...lti.conversions import tustin
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import connect, feedback, lft, series
from ...lti.modal import split_stable
from ...lti.norms import peak_gain
from ...lti.riccati import control_care, control_dare
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread
from ...plant import AnyPlant, GeneralizedPlant, StandardPlant, plant_of
from ..controller import Controller, with_left_out


class _FactoredController(NamedTuple):
    """A controller, what is kept of it as it is, and the factors of the rest with their weight."""

    K: StateSpace
    #: poles on the edge of stability and beyond: integrators
    kept: StateSpace
    factors: StateSpace
    weight: StateSpace
    size: float

    @classmethod
    def of(cls, plant: AnyPlant, K: StateSpace) -> _FactoredController:
        size = _controller_gain(plant, K)
        split = split_stable(K)
        scaled = split.stable.replace(C=split.stable.C / size, D=split.stable.D / size, blocks=None)
        factors, F = _coprime_factors(scaled)
        rows = [name for name in K.outputs if name in plant.u]
        P = plant.system.select(K.inputs, rows)
        if split.rest.n_states:  # the plant with what is kept around it
            P = feedback(P, split.rest.select(rows), sign=1)
        return cls(K, split.rest, factors, _factor_weight(P, scaled, rows, F, size), size)

    def truncated(self, order: int) -> tuple[StateSpace, float]:
        """Return the controller of truncated factors, and the weighted error."""
        K, size, p = self.K, self.size, len(self.K.outputs)
        wanted = order - self.kept.n_states
        found = balanced(self.factors, order=wanted, output_weight=self.weight).system
        # K_r = N_r M_r^-1
        Cn, Cm, Dn = found.C[:p], found.C[p:], found.D[:p]
        inverse = np.linalg.inv(found.D[p:])
        reduced = K.replace(
            A=found.A - found.B @ inverse @ Cm,
            B=found.B @ inverse,
            C=size * (Cn - Dn @ inverse @ Cm),
            D=size * Dn @ inverse,
            states=None,
            blocks=None,
        )
        same = found.replace(inputs=self.factors.inputs, outputs=self.factors.outputs)
        error = peak_gain(series(self.factors - same, self.weight))[0]
        if self.kept.n_states:
            kept = self.kept.replace(units=K.units, name=K.name)
            reduced = reduced + kept.replace(D=np.zeros_like(kept.D))
        return reduced.replace(states=None, name=K.name), error


@one_thread()
def reduce_controller(
    plant: AnyPlant | System, controller: Any, *, order: int | None = None, loss: float = 0.1
) -> Controller:
    """Return a controller of fewer states whose closed loop is nearly the same.

    The controller K is written as ``K = N M^-1``, a normalised right coprime factorisation: N and M
    are stable even if K is not. The states of ``[N; M]`` are reduced by weighted balanced
    truncation. This changes the factors by the errors dN and dM. The loop of K with the plant P
    stays stable if the weighted error has an H-infinity norm below one. With the weight W it is::

        W [dN; dM],   W = (M - P N)^-1 [P, -I]

    This condition (the small-gain theorem) is sufficient, but not necessary. The loop with the
    reduced controller is therefore computed in any case. An error is raised if this loop is
    unstable, or if it loses more of its modulus margin than `loss` allows. If the plant is
    weighted, gamma (the H-infinity norm from w to z) is compared instead of the margin, and may
    grow by at most `loss`.

    Parameters
    ----------
    plant : StandardPlant
        Plant of the design, weighted or not. It is continuous or sampled, like the controller.
    controller : StateSpace or Controller
        Controller from y to u. Its integrators and unstable poles are kept.
    order : int, optional
        Largest number of states of the result, which may have fewer. By default it is the smallest
        number with which the loop stays stable and the loss is allowed.
    loss : float
        Allowed relative loss of the modulus margin, or allowed relative growth of gamma. The
        modulus margin is one over the largest singular value of the sensitivity S.

    Returns
    -------
    Controller
        Reduced controller. The certificate holds the margin, gamma and the stability of the loop
        before and after the reduction. It also holds the weighted error of the factors.

    Raises
    ------
    CertificateError
        When the loop with the given controller is not stable, or the loop with the reduced one is
        unstable or loses too much margin.
    ModelError
        When an order is not below that of the controller.
    SolverError
        When the factors cannot be computed.

    Warns
    -----
    FlexplantWarning
        When the truncated modes make the loop unstable, or bring |S| at u above 8 dB.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 19.2; [AndersonLiu1989]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> controller = fx.design_h2(plant)
    >>> smaller = fx.synthesis.reduce_controller(plant, controller, order=6)
    >>> smaller.system.n_states, fx.close_loop(plant, smaller).is_stable
    (4, True)
    """
    given = plant_of(plant)
    K = as_statespace(controller)
    allowed = positive(loss, "loss", zero=True)
    before = stable_before(given, K)
    if K.n_states < 1:
        raise ModelError("the controller is a static gain: it has no states to leave out.")
    problem = _FactoredController.of(given, K)
    if order is not None:
        least = problem.kept.n_states
        chosen = whole(order, "order", minimum=least, maximum=max(K.n_states - 1, least))
        found, error = problem.truncated(chosen)
        after = loop_facts(given, found)
        required(before, after, allowed, "Choose a higher order, leave order out, or raise loss.")
    else:
        found, error, after = _fewest_states(given, problem, before, allowed)
    was = before.named("before")
    answer = Controller(
        found,
        f"reduced from {K.n_states} states, coprime factors weighted by the loop",
        gamma=None if np.isnan(after.gamma) else after.gamma,
        certificate=Certificate(
            (*after.certificate.checks, *was, Verified("weighted error", error))
        ),
    )
    return with_left_out(answer, given)


def _fewest_states(
    plant: AnyPlant, problem: _FactoredController, before: LoopFacts, loss: float
) -> tuple[StateSpace, float, LoopFacts]:
    """Return the reduced controller of the fewest states that keeps the loop, from halvings."""
    best: tuple[StateSpace, float, LoopFacts] | None = None
    lost = ""

    def tried(order: int) -> bool:
        nonlocal best, lost
        try:
            found, error = problem.truncated(order)
        except FlexplantError as failure:  # this order has no factors: another may
            lost = str(failure)
            return False
        after = loop_facts(plant, found)
        lost = loss_text(before, after, loss)
        if not lost and (best is None or found.n_states < best[0].n_states):
            best = found, error, after
        return not lost

    full = problem.K.n_states
    low, high = problem.kept.n_states - 1, full
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if tried(middle) else (middle, high)
    if best is None:  # an odd order may keep what the halves lose
        next(filter(tried, range(full - 1, full // 2, -1)), None)
    if best is None:
        raise CertificateError(
            f"no controller of fewer states than {full} keeps the loop: with "
            f"{full - 1}, {lost or 'none is left out'}. Raise loss, or keep the controller."
        )
    return best


def _controller_gain(plant: AnyPlant, K: StateSpace) -> float:
    """Return the gain of the controller where the loop works, the unit of u in those of y."""
    loop = plant.system.select(plant.y, plant.u)
    grid = resonance_grid(np.concatenate([loop.poles(), K.poles()]), K.dt, points=60)
    grid = grid[grid < 0.49 / K.dt] if K.dt else grid
    rows = [name for name in K.outputs if name in plant.u]
    gain, through = (
        np.abs(frequency_response(one, grid).data).max(axis=(0, 1))
        for one in (K.select(rows), plant.system.select(K.inputs, rows))
    )
    acts = gain * through > 0.1
    return float(np.median(gain[acts])) if acts.any() else float(gain.max())


def _coprime_factors(K: StateSpace) -> tuple[StateSpace, FloatArray]:
    """Return [N; M] of the normalised right coprime factorisation, and its feedback F."""
    m = len(K.inputs)
    R = np.eye(m) + K.D.T @ K.D
    solve = control_dare if K.dt else control_care
    found = solve(K.A, K.B, Q=K.C.T @ K.C, R=R, S=K.C.T @ K.D)
    F = -found.gain
    C, D = np.vstack([K.C + K.D @ F, F]), np.vstack([K.D, np.eye(m)])
    return StateSpace(K.A + K.B @ F, K.B, C, D, K.dt), F


def _factor_weight(
    P: StateSpace, K: StateSpace, rows: list[str], F: FloatArray, size: float
) -> StateSpace:
    """Return W: from errors of u = N v and of y = M v to v, the loop of P and K closed."""
    own, m = K.select(rows), len(K.inputs)
    errors = [f"a:{name}" for name in K.outputs]  # monitored outputs do not act on the loop
    pushed, v = [f"{name}|u" for name in rows], [f"v{i}" for i in range(m)]
    y, read, missed = ([f"{kind}{i}" for i in range(m)] for kind in ("y", "in", "b"))
    plant = P.replace(B=size * P.B, D=size * P.D, inputs=pushed, outputs=y, units={})
    C, D = np.vstack([own.C, -F]), np.vstack([own.D, np.eye(m)])
    law = own.replace(C=C, D=D, inputs=read, outputs=[*rows, *v], units={})
    gains = la.block_diag(np.tile(np.eye(len(rows)), 2), np.hstack([np.eye(m), -np.eye(m)]))
    entering = [*rows, *(f"a:{name}" for name in rows), *y, *missed]
    sums = StateSpace([], [], [], gains, K.dt, inputs=entering, outputs=[*pushed, *read])
    return connect([plant, law, sums], [*errors, *missed], v)


class LoopFacts(NamedTuple):
    """Stability, at which frequency [Hz], modulus margin at u, and gamma of a weighted plant."""

    sampled: bool
    stability: float
    freq: float
    is_stable: bool
    margin: float
    gamma: float

    @property
    def why(self) -> str:
        """The least stable pole, in words."""
        return f"{stability_name(self.sampled)} {self.stability:.6g}, at {self.freq:.4g} Hz"

    def named(self, when: str) -> tuple[Verified, ...]:
        """Return the figures under names of when they hold, without limits."""
        checks = self.certificate.checks
        return tuple(Verified(f"{one.what} {when}", one.figure, one.route) for one in checks)

    @property
    def certificate(self) -> Certificate:
        """What the controller keeps."""
        margin = Verified("modulus margin", self.margin, "a sweep of |1 + L| at u")
        found = Certificate((stability_check(self.stability, self.sampled), margin))
        return found if np.isnan(self.gamma) else found.extended(Verified("gamma", self.gamma))


def loop_facts(plant: AnyPlant, controller: StateSpace) -> LoopFacts:
    """Return what a controller keeps on a plant."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        loop = close_loop(plant.replace(evaluation=None), controller)
    poles, dt, stable = loop.poles(), loop.plant.dt, loop.obstacle is None
    least = poles[np.argmax(np.abs(poles) if dt else poles.real)] if poles.size else np.nan
    freq = float(np.abs(np.angle(least) / dt if dt else np.imag(least)) / (2.0 * np.pi))
    weighted = isinstance(plant, GeneralizedPlant) and stable
    gamma = peak_gain(lft(plant.system, controller))[0] if weighted else float("nan")
    margin = loop.modulus_margin if stable else 0.0
    return LoopFacts(bool(dt), stability(poles, dt), freq, stable, margin, gamma)


def loss_text(before: LoopFacts, after: LoopFacts, loss: float) -> str:
    """Return what was lost in words; empty when nothing was."""
    beyond = f"by more than {100 * loss:.3g} %"
    if not after.is_stable:
        return f"the loop becomes unstable ({after.why})"
    if after.margin < (1.0 - loss) * before.margin:
        margins = f"from {before.margin:.3g} to {after.margin:.3g}"
        return f"the modulus margin falls {margins}, {beyond}"
    if after.gamma > (1.0 + loss) * before.gamma:
        return f"gamma grows from {before.gamma:.4g} to {after.gamma:.4g}, {beyond}"
    return ""


def required(before: LoopFacts, after: LoopFacts, loss: float, cure: str) -> None:
    """Raise CertificateError when a loop lost more than is allowed."""
    lost = loss_text(before, after, loss)
    if lost:
        raise CertificateError(f"{lost}: the controller is refused. {cure}")


def stable_before(plant: AnyPlant, controller: StateSpace) -> Any:
    """Return the facts of the loop as it was designed."""
    facts = loop_facts(plant, controller)
    if not facts.is_stable:
        raise CertificateError(
            f"the controller as given does not stabilise the plant ({facts.why}), so its loop "
            "cannot be preserved. Is it the plant that it was made for?"
        )
    return facts


def discretise_controller(
    plant: AnyPlant, controller: Any, *, prewarp: float | None = None, loss: float = 0.5
) -> Controller:
    """Return a continuous controller sampled at the rate of a plant. Its loop is verified.

    The method is bilinear (Tustin). If `prewarp` is given, the response at this frequency is kept.
    The modulus margin of the loop with the sampled and delayed plant is compared with that of the
    continuous loop. The loss of margin therefore includes the effect of the delay. A controller
    that is designed for the sampled plant loses less margin.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant without weights, ``plant.discretized(rate, delay=)``.
    controller : StateSpace or Controller
        Continuous controller, from y to u.
    prewarp : float [Hz], optional
        Frequency at which the response is kept, such as that of a notch or of the crossover.
    loss : float
        Allowed relative loss of the modulus margin. The modulus margin is one over the largest
        singular value of the sensitivity S.

    Returns
    -------
    Controller
        Sampled controller. The certificate holds the spectral radius and the modulus margin of the
        sampled loop, and the stability and margin of the continuous loop.

    Raises
    ------
    CertificateError
        When the sampled loop is unstable or loses more than the allowed margin, or the continuous
        loop is unstable.
    ModelError
        When the plant is continuous, the plant has weights, or the controller is already sampled.

    Warns
    -----
    FlexplantWarning
        When the truncated modes make the loop unstable, or bring |S| at u above 8 dB.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> law = fx.lti.tf([-1e4, -2e6], [1.0, 1e3]).replace(inputs=["y1"], outputs=["u1"])
    >>> fx.synthesis.discretise_controller(plant, law).system.dt
    0.0005
    """
    given = instance(plant, StandardPlant, "plant", "Make it by assemble_plant(...).discretized().")
    K = as_statespace(controller)
    if not given.dt or given.continuous.dt:
        raise ModelError(
            "a controller is discretised for a sampled plant without weights whose continuous one "
            "is known: pass plant.unweighted.discretized(rate, delay=1)."
        )
    if K.dt:
        raise ModelError(
            f"the controller is sampled already (dt {K.dt:g} s). Pass a continuous one."
        )
    before = stable_before(given.continuous, K)
    found = tustin(K, 1.0 / given.dt, prewarp=prewarp)
    after = loop_facts(given, found)
    required(
        before, after, positive(loss, "loss", zero=True),
        "Raise the rate, shorten the delay, lower the bandwidth, or design on the sampled plant.",
    )  # fmt: skip
    answer = Controller(
        found,
        f"discretised at {1.0 / given.dt:g} Hz by the bilinear map"
        + ("" if prewarp is None else f", exact at {prewarp:g} Hz"),
        certificate=Certificate((*after.certificate.checks, *before.named("continuous"))),
    )
    return with_left_out(answer, given)
