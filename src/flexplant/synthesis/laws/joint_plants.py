"""Plants whose loops are tuned together: what their laws see, and the largest |S| with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, IntArray
from ...loop.broken import inverted
from ...lti.frequency import Frf
from ...lti.frequency_sweep import SOUGHT, highest, resonance_grid
from ...lti.interconnection import loop_poles
from ...lti.measured_lines import MeasuredPlant
from ...lti.response_solvers import responder
from ...lti.statespace import StateSpace
from ...tolerances import NEGLIGIBLE
from .axis_law import are_stable
from .law import Law, decoupled

#: logarithmic part of a grid through the resonances, and times that it is refined
_POINTS, _REFINEMENTS = 250, 6


class Worst(NamedTuple):
    """The largest |S|, its frequency [Hz], and where it is."""

    size: float
    freq: float
    place: str


@dataclass(frozen=True)
class JointPlant:
    """A plant in its own channels, and the static maps to them and from them."""

    plant: StateSpace | Frf
    before: FloatArray
    after: FloatArray
    axes: tuple[str, ...]
    rigid: int
    kind: str = ""

    @property
    def places(self) -> tuple[str, ...]:
        """Where |S| counts: at u and at y where these have one unit, and in each axis."""
        # two sensors of one axis differ at modes between them, for any law
        sides = {"u": self.plant.inputs}
        if len(self.plant.outputs) == len(self.axes):
            sides["y"] = self.plant.outputs
        units = self.plant.channel_units if isinstance(self.plant, Frf) else self.plant.units
        alike = [f"at {s}" for s, names in sides.items() if len({units.get(n) for n in names}) < 2]
        return (*alike, *(f"of {name}" for name in self.axes))

    @cached_property
    def grid(self) -> FloatArray:
        """The lines of an Frf, or frequencies through the resonances of a model."""
        if isinstance(self.plant, Frf):
            return self.plant.freq
        return self._through(self.plant.poles())

    @cached_property
    def respond(self) -> Callable[[FloatArray], ComplexArray]:
        """The response (n_freq, ny, nu)."""
        if isinstance(self.plant, Frf):
            lines, data = self.plant.freq, np.moveaxis(self.plant.data, -1, 0)
            return lambda freq: data[np.searchsorted(lines, freq)]
        find = responder(self.plant)
        return lambda freq: np.moveaxis(find(freq), -1, 0)

    def coupling(self, freq: FloatArray) -> Coupling:
        """Return the coupling of the axes at some frequencies [Hz]."""
        G = self.respond(freq)
        seen, felt = G @ self.before, self.after @ G
        su, sy = self.sizes
        return Coupling(freq, seen / sy[:, None], felt * su, self.after @ seen, self)

    @cached_property
    def sizes(self) -> tuple[FloatArray, FloatArray]:
        """The size of each input and output from the axes: |S| is computed in these units."""
        forces = np.linalg.norm(self.before, axis=1)
        shown = np.linalg.norm(np.linalg.pinv(self.after), axis=1)
        return (
            np.maximum(forces, NEGLIGIBLE * forces.max(initial=0.0)),
            np.maximum(shown, NEGLIGIBLE * shown.max(initial=0.0)),
        )

    @property
    def own_before(self) -> FloatArray:
        """Commands of axes to inputs in units of their sizes."""
        return np.asarray(self.before / self.sizes[0][:, None])

    @property
    def own_after(self) -> FloatArray:
        """Outputs in units of their sizes to motions of axes."""
        return np.asarray(self.after * self.sizes[1])

    def is_stable(self, laws: Sequence[Law]) -> bool:
        """Return whether the loop is stable, by its poles or the Nyquist count of an Frf."""
        if not isinstance(self.plant, Frf):
            poles = self._poles(laws)
            edge = np.abs(poles) - 1.0 if self.plant.dt else poles.real
            return bool(edge.max(initial=-1.0) < 0.0)
        return are_stable(laws, self.lines, rigid=self.rigid)

    @cached_property
    def lines(self) -> MeasuredPlant:
        """The axes of an Frf for which laws are judged on its lines."""
        return MeasuredPlant(self.grid, np.moveaxis(self.coupling(self.grid).inner, 0, -1))

    def worst(self, laws: Sequence[Law]) -> Worst:
        """Return the largest |S| of a stable loop, the grid refined at its peaks."""
        rounds = 0 if isinstance(self.plant, Frf) else _REFINEMENTS
        grid = self._closed_grid(laws)
        size, freq = highest(lambda f: 1.0 / self._distances(laws, f).min(axis=0), grid, rounds)
        place = self.places[int(np.argmin(self._distances(laws, np.array([freq]))[:, 0]))]
        return Worst(size, freq, f"{place}{self.kind}")

    def high(self, laws: Sequence[Law], size: float) -> FloatArray:
        """Return frequencies through the resonances of the closed loop where |S| is above a size.

        A mode is as narrow as its damping, and the loop moves it off the grid of the plant.
        """
        grid = self._closed_grid(laws)
        return np.asarray(grid[self._distances(laws, grid).min(axis=0) * size < 1.0])

    def _distances(self, laws: Sequence[Law], freq: FloatArray) -> FloatArray:
        return self.coupling(freq).distances(np.stack([law.at(freq) for law in laws], axis=-1))

    def _closed_grid(self, laws: Sequence[Law]) -> FloatArray:
        return self.grid if isinstance(self.plant, Frf) else self._through(self._poles(laws))

    def _through(self, poles: ComplexArray) -> FloatArray:
        dt = float(self.plant.dt)  # type: ignore[union-attr]
        grid = resonance_grid(poles, dt, points=_POINTS, around=SOUGHT)
        return grid[(grid > 0.0) & (grid < 0.4999 / dt)] if dt else grid[grid > 0.0]

    def _poles(self, laws: Sequence[Law]) -> ComplexArray:
        assert isinstance(self.plant, StateSpace)  # noqa: S101 - an Frf has no poles
        parts = [(one.A, one.B, one.C, one.D) for one in (law.system for law in laws)]
        K = StateSpace(*decoupled(parts, self.before, self.after), self.plant.dt)
        return loop_poles(self.plant, K)


class Coupling(NamedTuple):
    """``seen = G before``, ``felt = after G``, ``inner = after G before``, frequency first."""

    freq: FloatArray
    seen: ComplexArray
    felt: ComplexArray
    inner: ComplexArray
    of: JointPlant

    def turns(self, C: ComplexArray) -> ComplexArray:
        """Return ``det(I + after G before C)`` of laws C (n, k)."""
        return np.asarray(np.linalg.det(np.eye(C.shape[1]) + self.inner * C[:, None, :]))

    def distances(self, C: ComplexArray) -> FloatArray:
        """Return ``1 / |S|`` (places, n): the least singular value, or ``1 / |S_ii|``."""
        S = self._inverse(C)
        sides = [
            1.0 / np.sqrt(np.linalg.eigvalsh(one.conj().swapaxes(1, 2) @ one)[:, -1])
            for one in self._sides(S, C)
        ]
        axes = 1.0 / np.abs(np.einsum("fii->if", S))
        return np.concatenate([np.reshape(sides, (len(sides), len(C))), axes])

    def slopes(self, C: ComplexArray, place: int) -> ComplexArray:
        """Return g (n, k) of one place: the distance changes by ``Re(g . dC)``."""
        # v, w: singular vectors of S, and 1 / S = I + M: d sigma = Re(v' dM w)
        S = self._inverse(C)
        sides, of = self._sides(S, C), self.of
        if place >= len(sides):
            i = place - len(sides)
            m = 1.0 / S[:, i, i]
            turn = m * np.abs(m)  # conj(m) / |m| m^2
            return np.asarray(turn[:, None] * (S @ self.inner)[:, i, :] * S[:, :, i])
        left, _, right = np.linalg.svd(sides[place])
        # S = left sigma right: I + M has the singular vectors the other way round
        v, w = right[:, 0, :], left[:, :, 0]
        if of.places[place] == "at u":
            return np.asarray((v @ of.own_before) * np.einsum("fku,fu->fk", self.felt, w))
        return np.asarray(np.einsum("fy,fyk->fk", v, self.seen) * (w @ of.own_after.T))

    def rows(self, rows: IntArray) -> Coupling:
        """Return the coupling of the axes at some of the frequencies."""
        parts = (self.seen[rows], self.felt[rows], self.inner[rows])
        return Coupling(self.freq[rows], *parts, self.of)

    def _inverse(self, C: ComplexArray) -> ComplexArray:
        return inverted(-self.inner * C[:, None, :])

    def _sides(self, S: ComplexArray, C: ComplexArray) -> list[ComplexArray]:
        """Return S at u and y, ``I - before C S after G`` and ``I - G before C S after``."""
        CS, of = C[:, :, None] * S, self.of
        found = []
        if "at u" in of.places:
            found.append(np.eye(of.own_before.shape[0]) - of.own_before @ CS @ self.felt)
        if "at y" in of.places:
            found.append(np.eye(of.own_after.shape[1]) - self.seen @ CS @ of.own_after)
        return found
