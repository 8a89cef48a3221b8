"""design_hinf: H-infinity controllers verified by the norm of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...arrays import instance, positive
from ...certificates import Certificate, Verified, deferred
from ...errors import CertificateError, ModelError, SolverError, counted, short
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.statespace import StateSpace, System
from ...parallel import one_thread
from ...plant import AnyPlant, StandardPlant, stage_weights
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...tolerances import NEGLIGIBLE
from ..controller import Controller, ReachedNorms, SolvedController, SynthesisMethod, certified_norm
from ..pipeline import Design, Solution, designed, posed, solved, verified
from ..preparation import Prepared, badly_scaled
from .hinf_riccati import Riccati
from .lower_bound import raised_bound
from .moved_design import PlantRange, PositionDesign
from .tolerated_modes import ModeChannel, mode_channels, rebalanced, tolerated, with_mode_channels

#: in the certificate: the upper bound of real mu of all uncertain frequencies together
TOLERATED = "all frequencies at once"
#: number of draws of one rounding of the plant; the loop is examined where its norm by two routes
#: differs by more
_DRAWS, _FELT = 3, 1e-5


@one_thread()
def design_hinf(
    plant: AnyPlant | UncertainPlant[Any] | System | Mapping[float, StandardPlant],
    method: SynthesisMethod | None = None,
    *,
    bandwidth: float | None = None,
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
    uncertain: UncertainPlant[Any] | None = None,
    damped_below: float = 0.0,
    progress: bool | None = None,
) -> Controller:
    """Return a controller ``u = K y`` that keeps the H-infinity norm from w to z small.

    The H-infinity norm is the largest gain over all frequencies. Weights on w and z define how
    large it may be in each channel. For a stage, `stage_weights` computes the weights from a
    bandwidth: ``weights = fx.stage_weights(plant, 60.0)``. The design is then ``K =
    fx.design_hinf(plant.weighted(z=weights.z, w=weights.w))``. The attribute `K.gamma` is the norm
    that the controller reaches. If it is below 1, all requirements of the weights are satisfied.
    `mixed_sensitivity` builds a plant from weights of S, KS and T. The closed loop of the given
    plant is checked: it must be stable, and its norm is computed by two methods.
    ``fx.close_loop(plant, K)`` returns the closed loop. The page `algorithms` describes the method.

    Parameters
    ----------
    plant : StandardPlant, UncertainPlant or mapping {position: StandardPlant}
        Continuous or sampled plant, usually weighted. For a moving machine, give a mapping by
        position, ``{x: plant.at(x=x) for x in places}``. One controller for all positions is then
        designed on the mean plant. Additional channels of w and z represent the change with
        position. `gamma` is the largest norm of all positions. The certificate contains the norms
        at each position and half way between them. A StateSpace (also of python-control) is
        accepted if its channels are named as in a StandardPlant, or if u and y are given.
    method : Riccati or Lmi, optional
        Method of the synthesis, by default `Riccati()`. It needs full rank of D12, the feedthrough
        from u to z, and of D21, the feedthrough from w to y. If D12 does not have full rank, it
        adds a small weight of u; if D21 does not, it adds a small sensor noise. If w does not
        excite an undamped mode, it adds a small disturbance at the actuators. If z does not observe
        an undamped mode, it adds a small multiple of the sensors to z. `Lmi()` finds gamma by a
        semidefinite program and is suitable for up to 20 states.
    bandwidth : float [Hz], optional
        Bandwidth of a stage whose plant has no weights. The weights are then the `stage_weights` of
        this bandwidth. `design_stage` finds the largest possible bandwidth.
    u, y : sequences of str, optional
        For a StateSpace: inputs that the controller drives, and outputs that it reads.
    uncertain : UncertainPlant, optional
        Uncertainty of the plant before it was weighted, such as
        ``plant.uncertain(frequency=0.005)``. It is not needed if `plant` is an UncertainPlant. The
        design then aims at a loop that remains stable for all modal frequencies within their
        uncertainties. For this purpose each uncertain mode gets one additional input and output,
        through which a change of its frequency acts. Changes of frequencies are real numbers.
        Therefore these channels are scaled with the matrices D and G that `mu` uses for real
        uncertainties. A
        first design determines the scale of each channel. `gamma` is then the norm with these
        channels. It may therefore be above 1 although the requirements of the weights are
        satisfied. The entry ``all frequencies at once`` of `certificate` is an upper bound of the
        structured singular value mu over a frequency grid. If it is below 1, no plant of the
        uncertainty has a closed-loop pole on the imaginary axis (unit circle) at a frequency of the
        grid.
        ``ClosedLoop.mode_tolerances`` gives the allowed error of each frequency.
    damped_below : float [Hz]
        Frequency below which the controller actively damps the uncertain modes that the actuators
        excite. Other modes are only tolerated, as described for `uncertain`. The additional channel
        of a mode to be damped represents a frequency error of at least 1 %. It also represents
        errors of its mode shape and damping. `design_stage` uses 3.5 times the bandwidth.
    progress : bool, optional
        Whether to show a progress bar of the method's steps. By default (None) it is shown on a
        terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    Controller
        The controller. `gamma` is the verified norm, and `lower` is a lower bound on the norm for
        all controllers. `certificate` holds the checks. `reached` holds the largest gain from each
        group of w (disturbances, references, noises) to each group of z (motions, efforts).
        `left_out` holds the check with the truncated modes, which the design model leaves out.

    Raises
    ------
    AssumptionError
        When an assumption of the method fails. The message names it in physical terms.
    InfeasibleError, SolverError
        When no stabilising controller was found, or gamma can be made arbitrarily small.
    CertificateError
        When the closed loop exceeds the claimed norm, or its norm is not finite.
    ModelError
        When the plant or the method is of another type, or a sampled plant has a pole at z = -1.

    Warns
    -----
    FlexplantWarning
        When truncated modes make the loop unstable, or raise the sensitivity |S| at u above 8 dB.
        The warning names these modes.

    References
    ----------
    [GloverDoyle1988]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, 20.0)
    >>> controller = fx.design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    >>> controller.gamma < 1  # all that the weights require is reached
    True
    >>> fx.close_loop(plant, errors, controller).is_stable
    True
    """
    method = Riccati() if method is None else method
    if isinstance(method, type) or not hasattr(method, "solve"):
        raise ModelError(
            f"method must be Riccati(...) or Lmi(...), got {short(method)}. Pass one, or none."
        )
    if progress is not None and isinstance(method, Riccati):
        method = method.replace(progress=progress)
    positive(damped_below, "damped_below", zero=True)
    design, what = HinfDesign(method), "H-infinity synthesis"
    if isinstance(plant, Mapping):
        if uncertain is not None:
            raise ModelError(
                "plants by position are designed for as they are: leave out uncertain=, and check "
                "the loop at each position."
            )
        plants = {x: posed(one, u, y, what) for x, one in plant.items()}
        if bandwidth is not None and plants:
            weights = stage_weights(list(plants.values())[len(plants) // 2], bandwidth)
            plants = {x: one.weighted(weights) for x, one in plants.items()}
        return designed(PositionDesign(design, progress), PlantRange.of(plants), None)
    plant = posed(plant, u, y, what)
    if bandwidth is not None:
        plant = plant.weighted(stage_weights(plant, bandwidth, uncertainty=uncertain))
    known = plant.uncertainty if uncertain is None else uncertain
    if uncertain is not None or (known is not None and known.frequencies):
        instance(known, UncertainPlant, "uncertain", "Make it by plant.uncertain(frequency=0.005).")
        return designed(TolerantDesign(design, known, damped_below), plant, plant)
    return designed(design, plant, plant)


@dataclass(frozen=True)
class HinfDesign(Design):
    """The least H-infinity norm, by `Riccati`, `Lmi` or a method of the same kind."""

    method: SynthesisMethod
    #: whether the norms between groups of channels are wanted
    grouped: bool = True
    name = "hinf"

    def solve(self, problem: Prepared) -> SolvedController:
        """Return what the method finds."""
        return self.method.solve(problem)

    def certify(self, solution: Solution) -> Controller:
        """Return the controller with the norm of its loop, by two routes, and a lower bound."""
        plant, problem, K, found = solution
        loop = lft(plant.system, K)
        respond = ReachedNorms(plant, loop) if self.grouped else None
        try:
            certificate = certified_norm(loop, found.gamma, respond)
        except CertificateError:
            _require_resolved(plant.system, K)  # the cause, if it is rounding
            raise
        gamma = certificate["norm"]
        # the loops of the method and of the plant are equal: they differ by the effect of rounding
        if badly_scaled(problem) or abs(gamma - found.gamma) > _FELT * gamma:
            _require_resolved(plant.system, K)
        lower = raised_bound(problem, gamma, found.lower)
        name = type(self.method).__name__
        return Controller(
            K,
            f"H-infinity by {name}",
            gamma=gamma,
            lower=lower,
            certificate=Certificate((*certificate.checks, *found.checks)),
            reached=Certificate() if respond is None else respond.norms,
            notes=found.notes,
            tried=Certificate((Verified(f"{name}()", gamma),)),
        )


class _WithDeltas(NamedTuple):
    """A plant with channels for its modes, and gamma before they were scaled in closed loop."""

    plant: AnyPlant
    channels: tuple[ModeChannel, ...]
    first: float


@dataclass(frozen=True)
class TolerantDesign(Design):
    """The same on a plant with a channel for each mode whose frequency is uncertain."""

    design: HinfDesign
    uncertain: UncertainPlant[Any]
    damped_below: float = 0.0
    #: what the scales are evened out by, if it is not the design itself
    first: HinfDesign | None = None

    def prepare(self, plant: AnyPlant) -> _WithDeltas:
        """Return the plant with channels, their scales evened out in closed loop."""
        channels = mode_channels(plant, self.uncertain, self.damped_below)
        opened = with_mode_channels(plant, channels)
        # by a whole search: scales of a quick one jump with the weights, and designs with them
        first = solved(self.first or self.design, opened)
        channels = rebalanced(channels, opened, first.K)
        return _WithDeltas(with_mode_channels(plant, channels), channels, first.found.gamma)

    def solve(self, problem: _WithDeltas) -> Solution:
        """Return the solution on the plant with channels."""
        return solved(self.design, problem.plant)

    def restore(self, plant: AnyPlant, problem: _WithDeltas, found: Solution) -> StateSpace:
        """Return its controller."""
        return found.K

    def certify(self, solution: Solution) -> Controller:
        """Return the controller with the norm of all channels, and real mu of the frequencies."""
        _, (_, channels, first), _, found = solution
        # the norms that the weights limit are those without the channels of modes
        answer = verified(replace(self.design, grouped=False), found)
        return answer.replace(
            certificate=deferred(lambda: (*answer.certificate.checks, self._tolerated(solution))),
            tried=Certificate(
                (
                    Verified("before the scales were evened out", first),
                    Verified("after", answer.gamma or np.inf),
                )
            ),
            notes=(
                *answer.notes,
                f"gamma is with a channel for each of {counted(len(channels), 'mode')}",
            ),
        )

    def _tolerated(self, solution: Solution) -> Verified:
        """Return real mu of all uncertain frequencies, whether or not their modes are damped."""
        plant, (_, channels, _), K, _ = solution
        scales = {one.mode: one.D for one in channels}
        stated = [one.replace(D=scales[one.mode]) for one in mode_channels(plant, self.uncertain)]
        share = tolerated(stated, with_mode_channels(plant, stated), K)
        return Verified(TOLERATED, share, "real mu over a grid")


def _require_resolved(P: StateSpace, K: StateSpace) -> None:
    """Raise SolverError when one rounding of each entry of the plant moves the loop's norm."""
    gamma, rng, change = hinf_norm(lft(P, K)), np.random.default_rng(0), 0.0
    for _ in range(_DRAWS):
        moved = {
            name: part * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], size=part.shape))
            for name, part in (("A", P.A), ("B", P.B), ("C", P.C))
        }
        norm = hinf_norm(lft(P.replace(**moved, blocks=None), K))
        change = max(change, abs(norm / gamma - 1.0) if gamma else 0.0)
    if change > NEGLIGIBLE:
        raise SolverError(
            f"a controller with gamma {gamma:.4g} was found, but one rounding of each entry of A, "
            f"B and C changes it by {100 * change:.2g} %. Loosen the weights, or leave out modes "
            "that u does not move or y does not see: assemble_plant(modes.select([...]), ports)."
        )
