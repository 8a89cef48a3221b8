"""tune_loops: for each decoupled axis the law of highest bandwidth that keeps a modulus margin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..arguments import between
from ..errors import SolverError
from ..loop import report_loops
from ..lti.frequency import Frf, frequency_response
from ..lti.grid import resonance_grid
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..progress import Progress
from ..values import FloatArray, whole
from .axis_law import AxisLaw
from .law import Law
from .law_search import FoundLaw, LawSearch
from .loop_design import Axes, LoopDesign, axes_controller, axes_of, made
from .measured_axis import MeasuredAxis
from .servo_loop import TARGET

#: steps down, and their factor, while the axes disturb each other a little; margin, beside that
#: needed, below which that is no cure; rounds in which each adapts to the others, to a peak so
#: much lower
_STEPS, _SLOWER, _FAR, _ROUNDS, _STRICTER = 4, 0.99, 0.95, 4, 0.97
#: distance of a pole from zero frequency, beside the farthest, that counts as none
_ZERO = 1e-6


@one_thread()
def tune_loops(
    plant: StandardPlant | System | Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
    peak: float = TARGET,
    rigid: int | None = None,
    notches: int = 3,
    larger: Any = None,
    progress: bool | None = None,
) -> LoopDesign:
    """Return the laws of highest bandwidth that keep |S| of each axis below a peak.

    Each axis gets ``k (1 + w_i / s) (1 + a s / w_b) / (1 + s / (b w_b)) F(s)`` with a low-pass and
    notches in F. w_b, where the loop of the rigid body alone crosses 1, is made as large as
    ``|1 + L| >= 1 / peak`` allows, beyond resonances too; a, b, the corner of the low-pass and
    frequency, depth and width of the notches are found on the way, from many starts: the best of
    them, without proof that no other law does better. w_i is w_b / 10, no zero lies below it, no
    corner above 0.45 of the rate or the last line.

    No model is needed: the plant may be an Frf. A line is taken to lie anywhere within two standard
    deviations, by its variance, else its coherence (averages by `freedom`; unless given as if of
    two), else by how lines scatter. Where a resonance turns between two lines, the circle through
    its neighbours is followed; where lines do not resolve it, the loop gain has to be small there.
    Peaks that fall between two lines unseen are not known: the lines have to be closer than a
    mode is wide. Above the last line the plant is unknown, and the loop gain there at most 0.1.

    Parameters
    ----------
    plant, before, after, rate, delay, hold
        As for `design_loops`.
    peak : float
        Bound on |S|; 2 is a modulus margin of 6 dB.
    rigid : int, optional
        Rigid-body modes that the axes show; unless given as many as axes, of a model those that it
        has. 0 on springs whose modes lie within the lines.
    notches : int
        At most so many for each axis; one has to raise the bandwidth by 2 %.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes left out, for the check of a StandardPlant as for `larger_plant`.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    LoopDesign
        Verified in all axes together, each broken with the others closed.

    Raises
    ------
    SolverError
        When no bandwidth within the lines holds the peak, with the axis; or when the axes disturb
        each other too much.
    ModelError, ShapeError, LabelError, AssumptionError
        As for `design_loops`; ModelError when peak is not above 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=2)
    >>> design = fx.tune_loops(plant)
    >>> design.report.is_stable
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    axes = axes_of(plant, before, after, rate, delay, hold)
    measured = isinstance(axes.plant, Frf)
    if rigid is None:
        rigid = len(axes.names) if measured else _free_modes(axes.plant)
    rigid = whole(rigid, "rigid", minimum=0)
    most = whole(notches, "notches", minimum=0)
    frf = axes.plant if measured else _response(axes.plant)
    tuner = _Tuner(axes, frf, float(peak), rigid, most)
    with Progress(len(axes.names), "axes", progress=progress) as bar:
        reached = tuner.together(tuner.each_alone(bar)) or tuner.settled(tuner.one_by_one())
    if reached is None:
        raise SolverError(
            f"each axis alone holds |S| below {peak:g}, all together do not: they disturb each "
            "other. Decouple the axes better (before=, after=), or close them one after the other "
            "with design_loops."
        )
    design = made(axes, reached.laws, rigid, 0, None, larger)
    return design.replace(notes=(*design.notes, *reached.notes))


class _Reached(NamedTuple):
    """Laws that hold the peak in all axes together, and what to say of them."""

    laws: dict[str, Law]
    notes: list[str]


@dataclass(frozen=True)
class _Tuner:
    """The axes of a plant, each with its response."""

    axes: Axes
    frf: Frf
    peak: float
    rigid: int
    notches: int

    def each_alone(self, bar: Progress) -> list[tuple[AxisLaw, FoundLaw]]:
        """Return the best law of each axis, the others open."""
        found = []
        for i in range(len(self.axes.names)):
            found.append(self._tuned(i, {}))
            bar.advance()
        return found

    def one_by_one(self) -> list[tuple[AxisLaw, FoundLaw]]:
        """Return the best law of each axis, those before it closed."""
        found: list[tuple[AxisLaw, FoundLaw]] = []
        for i in range(len(self.axes.names)):
            found.append(self._tuned(i, {k: one.law for k, (_, one) in enumerate(found)}))
        return found

    def settled(self, found: list[tuple[AxisLaw, FoundLaw]]) -> _Reached | None:
        """Return laws that hold the peak together, each adapted in turn to all the others."""
        for _ in range(_ROUNDS):
            reached = self.together(found)
            if reached is not None:
                return reached
            for i in range(len(found)):
                others = {k: one.law for k, (_, one) in enumerate(found) if k != i}
                law = AxisLaw(self._axis(i, others), _STRICTER * self.peak)
                again = LawSearch(law, self.notches).raised(found[i][1].numbers)
                found[i] = (law, again) if again else found[i]
        return self.together(found)

    def _tuned(self, i: int, closed: dict[int, Law]) -> tuple[AxisLaw, FoundLaw]:
        law = AxisLaw(self._axis(i, closed), self.peak)
        return law, LawSearch(law, self.notches).best()

    def _axis(self, i: int, closed: dict[int, Law]) -> MeasuredAxis:
        """Return one axis with others closed.

        ``G_i - G_iJ C_J (I + G_JJ C_J)^-1 G_Ji`` is what its law acts on, J the others.
        """
        P, J = np.moveaxis(self.frf.data, -1, 0), list(closed)
        G = P[:, i, i]
        if J:
            C = np.stack([law.response(self.frf.freq) for law in closed.values()], axis=-1)
            inner = np.eye(len(J)) + P[:, J][:, :, J] * C[:, None, :]
            reached = np.linalg.solve(inner, P[:, J, i, None])[..., 0]
            G = G - np.sum(P[:, i, J] * C * reached, axis=-1)
        variance = None if self.frf.variance is None else self.frf.variance[i, i]
        name, free = self.axes.names[i], self.rigid > 0
        return MeasuredAxis(name, self.frf.freq, G, self.axes.rate, free, variance)

    def together(self, found: list[tuple[AxisLaw, FoundLaw]]) -> _Reached | None:
        """Return the laws if they hold the peak in all axes together, or do so a little slower."""
        for step in range(_STEPS):
            each = [law.slower(one.numbers, _SLOWER**step) for law, one in found]
            laws = dict(zip(self.axes.names, each, strict=True))
            inner = axes_controller(self.axes, laws)
            report = report_loops((self.axes.plant, inner), at="y", rigid=self.rigid)
            margins = [one.modulus_margin for one in report.loops]
            if report.is_stable and min(margins) >= 1.0 / self.peak:
                return _Reached(
                    laws, [note for law, one in found for note in law.notes(one.numbers)]
                )
            if not report.is_stable or min(margins) < _FAR / self.peak:
                return None
        return None


def _free_modes(plant: StateSpace) -> int:
    """Return the number of rigid-body modes: half the poles at zero frequency."""
    distance = np.abs(plant.poles() - (1.0 if plant.dt else 0.0))
    return int(np.count_nonzero(distance <= _ZERO * np.max(distance, initial=0.0))) // 2


def _response(plant: StateSpace) -> Frf:
    """Return the response over a grid through the resonances of a model."""
    grid = resonance_grid(plant.poles(), plant.dt, points=1000)
    frf = frequency_response(plant, grid[grid < 0.4999 / plant.dt] if plant.dt else grid)
    return frf.replace(variance=np.zeros(frf.data.shape))
