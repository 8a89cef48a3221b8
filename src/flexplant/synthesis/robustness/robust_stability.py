"""robust_stability: how large the uncertainty of a plant may be before a loop becomes unstable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...certificates import stability
from ...checks import MOST, FloatArray, Value, generator, whole
from ...errors import CertificateError, FlexplantError, counted
from ...loop import ClosedLoop, SpillOver, close_loop
from ...parallel import Progress, one_thread
from ...plant import StandardPlant, larger_plant
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ..hinf.mode_channels import mode_channels, tolerated, with_mode_channels
from .lower import (
    Destabilising,
    destabilising,
    power_iteration,
    smallest_with_block,
)
from .mu import sought
from .sweep import INTERVALS, covered
from .uncertain_loop import UncertainLoop, machine_at, neglected_delta, uncertain_loop, values_of
from .uncertainty_blocks import FullBlock, block_places

#: mu below this is not resolved
_RESOLVED = 0.05
#: starts at each frequency
_STARTS = 3
#: the worst machine is shown this much beyond its edge of stability
_BEYOND = 1e-3
#: largest multiple of an uncertainty that the quick bound tries
_REACH = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class RobustStability(Value):
    """Bounds on the uncertainty under which a loop is stable, and the smallest that is not.

    Parameters
    ----------
    upper : float
        mu: every machine with Deltas smaller than ``1 / upper`` is stable; below 1, all machines
        of the uncertainty are. Values below 0.05 are not resolved.
    lower : float
        A machine with Deltas of ``1 / lower`` is not stable; 0 when none was found.
    freq : float [Hz]
        Where mu is largest; NaN where it is not resolved.
    values : mapping {str: float}
        The Deltas of that machine.
    machine : StandardPlant, optional
        That machine, a little beyond its edge of stability; it can be simulated. None when it is
        none that could exist (without stiffness or damping) or none was found.
    frequencies, bounds : (k,) arrays [Hz, 1]
        Upper bounds at single frequencies; where they are not near the largest they need not be
        the smallest.
    certificate : mapping {str: float}
        Machines that were drawn and closed exactly, and how stable the least stable was; the
        distance of sampled channels from sampled machines; how many intervals between frequencies
        were proven by Hamiltonian matrices (0 above 260 states: sampled); the check with modes
        left out.
    left_out : SpillOver, optional
        How the nominal loop stands on the plant with the modes left out, where these are known.
    """

    upper: float
    lower: float
    freq: float
    values: Mapping[str, float]
    machine: StandardPlant | None
    frequencies: FloatArray
    bounds: FloatArray
    certificate: Mapping[str, float]
    left_out: SpillOver | None = None

    @property
    def is_robust(self) -> bool:
        """Whether every machine of the uncertainty is proven stable."""
        return self.upper < 1.0

    def __repr__(self) -> str:
        verdict = "every machine is stable" if self.is_robust else "not proven for every machine"
        if self.lower >= 1.0:
            verdict = "a machine of the uncertainty is unstable"
        bounds = f"{self.lower:.4g} <= mu <= {self.upper:.4g}"
        where = f", largest at {self.freq:.5g} Hz" if np.isfinite(self.freq) else ""
        lines = [f"<RobustStability: {verdict}, {bounds}{where}"]
        if self.lower:
            most = sorted(self.values.items(), key=lambda one: -abs(one[1]))[:4]
            shown = ", ".join(f"{name} {value:+.3g}" for name, value in most)
            lines.append(f"  unstable at {1 / self.lower:.4g} times the uncertainty: {shown}")
        shown = ", ".join(f"{k} {v:.4g}" for k, v in self.certificate.items())
        lines.append(f"  verified: {shown}")
        if self.left_out is not None:
            lines.append(f"  with the modes left out: {self.left_out.summary}")
        return "\n".join(lines) + ">"


@one_thread()
def robust_stability(
    uncertain: UncertainPlant[Any],
    *blocks: Any,
    quick: bool = False,
    larger: Any = None,
    machines: int = 20,
    rng: Any = 0,
    progress: bool | None = None,
) -> RobustStability:
    """Return bounds on the uncertainty under which a loop is stable: mu of all its Deltas.

    Real Deltas (frequencies, damping, parameters) stay real, neglected modes are one full complex
    block. The bound holds between grid points; a sampled loop is examined as it is sampled and
    delayed. What it says is tried on machines drawn from the uncertainty, each closed exactly.

    Parameters
    ----------
    uncertain : UncertainPlant
        From `plant.uncertain(fit, neglected=larger)`.
    *blocks : StateSpace, or values with a `system`
        The controller, as for `close_loop`.
    quick : bool
        Where all Deltas are frequencies, first a bound with one channel a mode, the change of a
        sampled mode to first order, on a grid through the resonances: a fraction of a second for
        ten modes. Where it is below 1 it is the answer, without a lower bound; else the whole
        search follows.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`: the nominal loop is
        checked there too.
    machines : int
        How many are drawn, each Delta at an end of its interval.
    rng : int, SeedSequence, Generator or None
        Of the machines and of the search for the worst.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    RobustStability

    Raises
    ------
    AssumptionError
        When the nominal loop is not stable.
    CertificateError
        When a machine is unstable for which stability was proven, or sampled machines are too far
        from affine in their Deltas.
    ModelError
        When `uncertain` is no uncertain plant.
    SolverError
        When intervals do not cover the frequency axis.

    References
    ----------
    [ZhouDoyleGlover1996]_, chapter 11.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5])
    >>> modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.02))
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x"]))
    >>> spread = [[1.0, 0.0], [0.0, 4.0]]
    >>> measured = fx.MeasuredModes(poles=[-17 + 890j], modes=[2], covariance=spread)
    >>> fit = fx.update(drawing, [fx.AddedMass("2:x")], [fx.Eigenvalues(measured)])
    >>> ports = fx.Ports(
    ...     w=[fx.Disturbance("d", "1:x", "x", asd=1e-3)],
    ...     u=[fx.Actuator("u1", "1:x", "x")],
    ...     z=[fx.Poi("tip", "2:x", ("x",))],
    ...     y=[fx.Sensor("y1", "1:x", "x", asd=1e-9)],
    ... )
    >>> plant = fx.assemble_plant(fit.model, ports)
    >>> lead = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    >>> fx.synthesis.robust_stability(plant.uncertain(fit), lead, machines=3).is_robust
    True
    """
    count = whole(machines, "machines", minimum=0, maximum=MOST)
    chance = generator(rng)
    if quick:
        first = _quick(uncertain, blocks, larger, count, chance)
        if first is not None:
            return first
    loop = uncertain_loop(uncertain, blocks)
    with Progress(None, INTERVALS, progress=progress):
        found = covered(loop.system, loop.blocks, heights=loop.heights, least=_RESOLVED**2)
    upper = float(np.sqrt(found.level))
    worst = _worst(loop, found, upper, chance)
    names = [block.name for block in loop.blocks if not isinstance(block, FullBlock)]
    certificate = _corner_machines(uncertain, loop.loop, names, upper, count, chance)
    # systems of many states are covered by sampling between the frequencies instead
    certificate["intervals by Hamiltonians"] = float(found.intervals * found.by_hamiltonian)
    if loop.dt:
        certificate["distance of channels"] = loop.channels.distance
    values, shown, lower = _worst_machine(loop, worst)
    left_out = _spill_over(loop.loop, larger)
    if left_out is not None:
        certificate |= left_out.certificate
    return RobustStability(
        upper,
        min(lower, upper),
        loop.freq(found.omega) if upper > _RESOLVED else float("nan"),
        values,
        shown,
        np.array([loop.freq(one) for one in found.frequencies]),
        np.sqrt(np.maximum(found.bounds, 0.0)),
        certificate,
        left_out,
    )


def _spill_over(loop: ClosedLoop, larger: Any) -> SpillOver | None:
    """Return the check of the nominal loop with the modes left out."""
    if larger is None:
        return loop.left_out
    return loop.replace(larger=larger_plant(loop.plant, larger)).left_out


def _worst(
    loop: UncertainLoop, found: Any, upper: float, rng: np.random.Generator
) -> Destabilising | None:
    """Return the smallest perturbation that destabilises, as far as it was found."""
    omegas = sought(loop.system, found)
    if not loop.neglected_w:
        return destabilising(loop.system, loop.blocks, omegas, upper, rng)
    where, best = block_places(loop.blocks), None
    for omega in omegas:
        gain = loop.system.evaluated(1j * omega) * loop.heights(omega, omega)
        for _ in range(_STARTS):
            start = power_iteration(gain, where, rng, omega)
            one = smallest_with_block(gain, where, start, 0.99 / upper)
            if one is not None and (best is None or one[0] < best.size):
                best = Destabilising(one[0], one[1], omega)
    return best


def _worst_machine(
    loop: UncertainLoop, worst: Destabilising | None
) -> tuple[dict[str, float], StandardPlant | None, float]:
    """Return the Deltas of the worst machine, that machine and one over its size.

    Only what is not stable when closed exactly counts.
    """
    if worst is None:
        return {}, None, 0.0
    values: dict[str, float] = {}
    for beyond in (0.0, _BEYOND, 10 * _BEYOND, 50 * _BEYOND):
        size = worst.size * (1.0 + beyond)
        values = values_of(loop, worst.found, size)
        try:
            made = machine_at(loop, values, neglected_delta(loop, worst.found, size))
        except FlexplantError:  # no stiffness left, say: it can only be computed
            return values, None, 1.0 / worst.size
        if not loop.around(made).is_stable:
            return values, made, 1.0 / size
    return values, None, 0.0


def _quick(
    uncertain: UncertainPlant[Any],
    blocks: tuple[Any, ...],
    larger: Any,
    count: int,
    rng: np.random.Generator,
) -> RobustStability | None:
    """Return the answer of one channel a mode where it shows stability, None where it does not."""
    names = [delta.name for delta in uncertain.deltas]
    if uncertain.neglected is not None or any(d.kind != "freq" for d in uncertain.deltas):
        return None
    loop = close_loop(uncertain.plant, *blocks)
    if loop.obstacle is not None:
        return None  # the whole search says what is wrong
    channels = mode_channels(uncertain.plant, uncertain)
    opened = with_mode_channels(uncertain.plant, channels)
    controller = loop.controller.select(outputs=loop.driven)
    upper = tolerated(channels, opened, controller)
    if not upper < 1.0:
        return None
    # the grid goes through the places of the modes at Deltas of a size, not beyond
    size = 1.0 / max(upper, 1.0 / _REACH)
    upper = max(1.0 / size, tolerated(channels, opened, controller, size) / size)
    certificate = _corner_machines(uncertain, loop, names, upper, count, rng)
    certificate["modes, each by one channel"] = float(len(channels))
    left_out = _spill_over(loop, larger)
    if left_out is not None:
        certificate |= left_out.certificate
    none = np.zeros(0)
    return RobustStability(
        upper, 0.0, float("nan"), {}, None, none, none, certificate, left_out
    )  # fmt: skip


def _corner_machines(
    uncertain: UncertainPlant[Any],
    nominal: ClosedLoop,
    names: list[str],
    upper: float,
    count: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return how stable machines at corners are, each closed exactly."""
    size = min(1.0, 0.999 / upper)
    worst = -np.inf
    for _ in range(count):
        corner = dict(
            zip(names, (size * rng.choice([-1.0, 1.0], len(names))).tolist(), strict=True)
        )
        loop = nominal.around(uncertain.lft(corner))
        worst = max(worst, stability(loop.poles(), loop.plant.dt))
    if not worst < (1.0 if nominal.plant.dt else 0.0):
        raise CertificateError(
            f"a machine with Deltas of {size:.3g} is unstable ({worst:.9g}), but mu <= "
            f"{upper:.4g} was found: the loop is too badly conditioned. Report it."
        )
    if not count:
        return {}
    kind = "largest spectral radius" if nominal.plant.dt else "largest real part"
    return {f"{kind} of {counted(count, 'machine')}": worst}
