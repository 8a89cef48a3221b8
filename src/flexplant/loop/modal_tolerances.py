"""Tolerances of a loop to errors of single modes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray, positive, real_array
from ..certificates import Certificate, Verified
from ..errors import SHOWN, AssumptionError, ModelError, aligned, counted, warn
from ..plant import AnyPlant, standard_plant
from ..plant.realisation import natural
from ..plant.uncertainty.uncertain_plants import UncertainPlant
from ..store import Value
from ..tolerances import CLOSE, DEVIATIONS, TINY
from .broken import BrokenLoop
from .mode_crossings import LIMIT, ModeLoops, axis_crossings, size_reached

#: number of grid points per half-width around a mode, and largest number on either side
_TO_A_WIDTH, _ASIDE = 2, 400
#: searched range of relative changes of damping: without damping, a mode that the loop does not
#: affect is marginal
_DAMPINGS = (-0.999, 2.0)
#: modulus margin for which tolerances are stated: |S| at u of 2.9, 9 dB
MARGIN = 0.35
#: ratio of the search range, or that of a grid, to the requested change, so that a crossing and the
#: flanks of a resonance lie inside
BEYOND = 1.25


@dataclass(frozen=True, eq=False, repr=False)
class ModeTolerances(Value):
    """The smallest change of each mode, with the others unchanged, at which a loop fails.

    Each array with two columns holds the change downwards (negative) and the change upwards. A
    change is infinite if the loop does not fail up to `limit`. In the printed table, ">5" means
    that it does not fail up to 5 %. A frequency is changed through the stiffness of the mode, so
    that its damping force stays the same.

    Parameters
    ----------
    modes : (m,) array
        Numbers of the modes. Counting starts at 1 and includes rigid-body modes.
    freq : (m,) array [Hz]
        Frequencies of the modes in the plant.
    stable : (m, 2) array
        Relative changes of frequency at which the loop becomes unstable.
    within : (m, 2) array
        Relative changes of frequency at which the modulus margin of the loop falls to `margin`.
    damping : (m, 2) array
        Relative changes of damping at which the loop becomes unstable. Changes from -1 to 2 are
        examined.
    margin : float
        Modulus margin that defines `within`, with the loop opened at u.
    limit : (m,) array
        Largest relative change of frequency examined.
    known : (m,) array, optional
        Relative uncertainty of each frequency.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).mode_tolerances()
    <ModeTolerances of 2 modes: stays stable if one modal frequency (not its shape) shifts by 5 %
      mode      Hz  |S| at u of 2.86   unstable
      2     100.66         ->5 +>5 %  ->5 +>5 %
      3     174.35         ->5 +>5 %  ->5 +>5 %>
    """

    modes: IntArray
    freq: FloatArray
    stable: FloatArray
    within: FloatArray
    damping: FloatArray
    margin: float
    limit: FloatArray
    known: FloatArray | None = None

    @property
    def least(self) -> FloatArray:
        """Smallest change (m,) of each frequency at which the loop fails or reaches `margin`.

        If the loop does not have this margin without a change, only failure counts.
        """
        ends = [self.stable] if self._is_below else [self.within, self.stable]
        return np.asarray(np.abs(np.hstack(ends)).min(axis=1))

    @property
    def _is_below(self) -> bool:
        """Whether the loop is below `margin` without a change."""
        return not np.any(self.within)

    @property
    def critical(self) -> tuple[int, ...]:
        """Modes with a tolerance below twice their uncertainty; empty if that is not known."""
        if self.known is None:
            return ()
        return tuple(self.modes[self.least < DEVIATIONS * self.known].tolist())

    @property
    def summary(self) -> str:
        """Text of the mode with the smallest tolerance."""
        if not self.modes.size:
            return "no elastic mode"
        worst = int(np.argmin(self.least))
        below = f"the modulus margin is below {self.margin:.3g}, " if self._is_below else ""
        if not np.isfinite(self.least[worst]):
            off = f"{100 * self.limit.min():.2g} %"
            return f"{below}stays stable if one modal frequency (not its shape) shifts by {off}"
        to = f"a modulus margin of {self.margin:.3g}"
        side = int(np.argmin(np.abs(self.within[worst])))
        change = self.within[worst, side]
        if self._is_below or not np.isfinite(change):
            change = self.stable[worst, int(np.argmin(np.abs(self.stable[worst])))]
            to = "instability"
        return (
            f"{below}mode {self.modes[worst]} ({self.freq[worst]:.4g} Hz) shifted by "
            f"{100 * change:+.2g} % "
            f"leads to {to}"
            + ("" if self.known is None else f" (known to {100 * self.known[worst]:.2g} %)")
        )

    @property
    def certificate(self) -> Certificate:
        """Checks of the mode whose tolerance is smallest relative to its uncertainty."""
        checks: list[Verified] = []
        if self.modes.size:
            known = np.ones_like(self.least) if self.known is None else self.known
            with np.errstate(divide="ignore"):
                worst = int(np.argmin(self.least / known))
            name = f"mode {self.modes[worst]}"
            if np.isfinite(self.least[worst]):  # else no change of a single mode matters
                route = "the loop closed around changed machines"
                checks.append(Verified(f"{name} holds to", float(self.least[worst]), route))
                if self.known is not None:
                    route = "what is known of the machine"
                    checks.append(Verified(f"{name} known to", float(self.known[worst]), route))
        return Certificate(tuple(checks))

    def warn_of_critical(self) -> None:
        """Warn of modes with a tolerance below twice their uncertainty."""
        if self.known is None or not self.critical:
            return
        said = [
            f"mode {mode} ({freq:.4g} Hz) tolerates {100 * least:.2g} %, is known to "
            f"{100 * known:.2g} %"
            for mode, freq, least, known in zip(
                self.modes, self.freq, self.least, self.known, strict=True
            )
            if mode in self.critical
        ]
        more = f" and {len(said) - SHOWN} more" if len(said) > SHOWN else ""
        warn(
            "the loop depends on frequencies that are not known accurately enough: "
            f"{'; '.join(said[:SHOWN])}{more}. Measure these modes, or design for their "
            "uncertainty: design_stage(plant.uncertain(...))."
        )

    def __repr__(self) -> str:
        lines = [f"<ModeTolerances of {counted(self.modes.size, 'mode')}: {self.summary}"]
        head = ("mode", "Hz", f"|S| at u of {1 / self.margin:.3g}", "unstable", "known to", "")
        rows = []
        for i in np.argsort(self.least, kind="stable")[:SHOWN]:
            row = [_percent(ends, self.limit[i]) for ends in (self.within[i], self.stable[i])]
            own = "" if self.known is None else f"{100 * self.known[i]:.2g} %"
            mark = "!" if self.modes[i] in self.critical else ""
            rows.append((str(self.modes[i]), f"{self.freq[i]:.5g}", *row, own, mark))
        lines += [f"  {line}" for line in aligned(head, rows)]
        if self.modes.size > SHOWN:
            lines.append(f"  ... and {self.modes.size - SHOWN} more")
        return "\n".join(lines) + ">"


def _percent(ends: FloatArray, limit: float) -> str:
    """Return two ends of a range in percent."""
    low, high = (
        f"{100 * end:+.2g}" if np.isfinite(end) else f"{sign}>{100 * limit:.2g}"
        for end, sign in zip(ends, "-+", strict=True)
    )
    return f"{low} {high} %"


def mode_tolerances(
    plant: AnyPlant,
    broken: BrokenLoop,
    *,
    margin: float,
    known: Any = None,
    limit: float | Mapping[int, float] = LIMIT,
) -> ModeTolerances:
    """Return the smallest changes of each mode that make a stable loop fail, up to `limit`."""
    # a mapping names the examined modes, each with its own limit. At each point of the stability
    # boundary, a complex change of one mode can place a pole there (`mode_crossings`). Where the
    # imaginary part of this change has a zero along the boundary, a real change makes a pole cross
    # it. The sampled plant's matrices are exact
    _ = standard_plant(plant).assembled.realisation.uncoupled
    margin = positive(margin, "margin")
    if margin >= 1.0:
        raise ModelError(f"margin must be below 1, the largest that a loop can keep, got {margin}.")
    modes, freq, zeta = _swinging_modes(plant)
    if broken.is_unstable:
        raise AssumptionError(
            "the loop is unstable, so that modes have no tolerance. Stabilise it first."
        )
    if isinstance(limit, Mapping):
        some = np.isin(modes, list(limit))
        modes, freq, zeta = modes[some], freq[some], zeta[some]
        most = np.minimum([limit[int(mode)] for mode in modes], LIMIT)
    else:
        most = np.full(modes.size, limit)
    limits = np.minimum(most, _ASIDE / _TO_A_WIDTH * zeta)
    own = _uncertainties(known, modes)
    if not modes.size:
        none = np.zeros((0, 2))
        return ModeTolerances(modes, freq, none, none, none, margin, limits, own)
    loops = ModeLoops.of(plant, broken, modes)
    grids = [
        _around(f, z, end, broken.grid, plant.dt)
        for f, z, end in zip(freq, zeta, limits, strict=True)
    ]
    every, at = np.unique(np.concatenate([*grids, np.zeros(0)]), return_inverse=True)
    mode = np.repeat(np.arange(modes.size), [grid.size for grid in grids])
    swept = loops.swept(every)
    each = swept.swept_modes(at, mode)
    ends = np.outer(limits, [-1.0, 1.0])
    stable = axis_crossings(swept, each, every[at], "freq", ends)
    damping = axis_crossings(swept, each, every[at], "damping", np.tile(_DAMPINGS, (modes.size, 1)))
    passed = np.abs(every[at] / freq[mode] - 1.0) <= BEYOND * limits[mode]
    within = size_reached(swept, each, every[at], passed, stable, limits, 1.0 / margin)
    return ModeTolerances(modes, freq, stable, within, damping, margin, limits, own)


def reported_tolerances(loop: Any) -> ModeTolerances | None:
    """Return the tolerances of the modes of a closed loop, with the uncertainty of its plant."""
    # with the truncated modes, if these are known and frequencies are uncertain; without them for a
    # certain plant, since evaluation models are large and change the result little
    uncertain = loop.plant.uncertainty
    if uncertain is None:
        sure = loop.plant.has_own_modes and loop.is_stable and _swinging_modes(loop.plant)[0].size
        return _tolerances(loop, {}) if sure else None
    whole_loop = loop.completed or loop
    if not uncertain.frequencies or not whole_loop.is_stable:
        return None
    return _tolerances(whole_loop, uncertain.frequencies)


def _tolerances(loop: Any, known: Mapping[int, float]) -> ModeTolerances | None:
    """Return the tolerances of a stable loop to the changes that a report follows."""
    limit = min(max(CLOSE, BEYOND * DEVIATIONS * max(known.values(), default=0.0)), LIMIT)
    try:
        return mode_tolerances(
            loop.plant, loop.broken, margin=MARGIN, known=known or None, limit=limit
        )
    except ModelError as error:
        if known:
            warn(f"the tolerances of modes are not computed: {error}")
        return None


def _swinging_modes(plant: AnyPlant) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return numbers, frequencies [Hz] and damping ratios of oscillating modes below Nyquist."""
    realisation = plant.assembled.realisation
    omega, zeta = natural(realisation.pairs)
    top = np.pi / plant.dt if plant.dt else np.inf
    swings = (np.arange(omega.size) >= realisation.n_rigid) & (zeta < 1.0) & (omega < top)
    keep = np.flatnonzero(swings & (omega > 0))
    return keep + 1, omega[keep] / (2.0 * np.pi), zeta[keep]


def _around(freq: float, zeta: float, limit: float, grid: FloatArray, dt: float) -> FloatArray:
    """Return frequencies [Hz] over the possible range of a mode, and around it."""
    count = int(np.ceil(limit * _TO_A_WIDTH / max(zeta, TINY)))
    count = min(max(count, 2 * _TO_A_WIDTH), _ASIDE)
    fine = freq * (1.0 + BEYOND * limit * np.linspace(-1.0, 1.0, 2 * count + 1))
    near = np.union1d(fine, grid[(grid > 0.5 * freq) & (grid < 2.0 * freq)])
    return np.asarray(near[near < 0.5 / dt] if dt else near)


def _uncertainties(given: Any, modes: IntArray) -> FloatArray | None:
    """Return the relative uncertainty of each frequency, zero where it is not stated."""
    if given is None:
        return None
    if isinstance(given, UncertainPlant):
        given = given.frequencies
    if isinstance(given, Mapping):
        given = [given.get(int(mode), 0.0) for mode in modes]
    values = real_array(given, "known")
    if values.ndim and values.shape != modes.shape:
        raise ModelError(
            f"known has the shape {values.shape}, the plant {counted(modes.size, 'elastic mode')}: "
            "pass a number, one for each, {mode: number} or an UncertainPlant."
        )
    return np.broadcast_to(values, modes.shape).copy()
