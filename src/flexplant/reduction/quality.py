"""How well a reduced model stands for the full one: the numbers of a comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import counted
from ..values import FloatArray, IntArray, Value
from .bounds import ErrorBound


@dataclass(frozen=True, eq=False, repr=False)
class ReductionQuality(Value):
    """The error of a reduced model beside the full one.

    Parameters
    ----------
    modes : (m,) array of int
        Numbers of the full model's modes that are compared.
    full_freq, freq : (m,) arrays [Hz]
        Their frequencies, and those of the reduced modes paired with them, one to one, by shape and
        frequency; NaN where none has a MAC of 0.5.
    freq_error : (m,) array
        Relative; 0 for rigid-body modes, NaN without a partner.
    mac : (m,) array
        Of each full mode with the reduced one: mass-weighted for an FEModel. Of repeated modes,
        whose shapes are any basis of a subspace, the squared cosines of the angles between the two
        subspaces.
    group : (m,) array of int
        Number of the first mode whose shape cannot be distinguished from that of each: of
        repeated modes that lack a partner it is not known which one is missing.
    check_freq : (f,) array [Hz]
        Where responses were compared.
    frf_error : (p, q) array
        Largest error over the band, of the largest response, output by input.
    resonance_error : (p, q) array
        Largest error at a resonance of either model, of the largest response of any pair and
        either model there; NaN without a resonance in the band.
    antiresonance_error : (p, q) array
        Largest error at an antiresonance of either model, of the larger response of both there: 1
        where one has an antiresonance that the other does not have. NaN without one.
    static_error : (p, q) array
        Of the elastic static compliance, relative to its size sqrt(G_ii G_jj).
    true_error : float [m/N]
        Largest singular value of the error at the check frequencies.
    orthogonality : float
        Departure of the expanded reduced modes from M-orthonormality; NaN against Modes.
    condition : float
        Of what the method inverted.
    inputs, outputs : sequence of str
        The channels.
    route : str
        How the full responses were found.
    full_error : float
        Difference between these and direct solutions with all of the matrices, of the peak; NaN
        against Modes.
    bound : ErrorBound, optional
        The a-priori bound of the method, when it is of these channels.
    bounded : bool
        Whether the bound covers all modes that were compared with: that of a reduction of some
        modes says nothing of the others of a model.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> small = fx.reduce(model, fx.ModalTruncation(3))
    >>> quality = small.quality(model, band=(10.0, 200.0), inputs=["1:x"], outputs=["1:x"])
    >>> quality.freq_error.round(9), quality.mac.round(6)
    (array([ 0.,  0.,  0., nan]), array([1., 1., 1., 0.]))
    """

    modes: IntArray
    full_freq: FloatArray
    freq: FloatArray
    freq_error: FloatArray
    mac: FloatArray
    group: IntArray
    check_freq: FloatArray
    frf_error: FloatArray
    resonance_error: FloatArray
    antiresonance_error: FloatArray
    static_error: FloatArray
    true_error: float
    orthogonality: float
    condition: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    route: str
    full_error: float = np.nan
    bound: ErrorBound | None = None
    bounded: bool = True

    @property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the elastic modes whose shapes cannot be distinguished, group by group."""
        elastic = self.full_freq > 0
        firsts = np.unique(self.group[elastic])
        groups = [self.modes[elastic & (self.group == first)].tolist() for first in firsts]
        return tuple(tuple(members) for members in groups if len(members) > 1)

    @property
    def band_bound(self) -> float | None:
        """The a-priori bound [m/N] for frequencies up to the last one checked, if there is one."""
        if self.bound is None or not self.check_freq[-1]:
            return None if self.bound is None else self.bound.value
        return self.bound.below(float(self.check_freq[-1]))

    @property
    def holds(self) -> bool:
        """Whether the true error at the check frequencies is within the bound, if there is one.

        A bound that does not cover all modes that were compared with is none (`bounded`).
        """
        limit = self.band_bound if self.bounded else None
        return limit is None or self.true_error <= limit * (1 + 1e-9)

    def __repr__(self) -> str:
        lost = int(np.count_nonzero(np.isnan(self.freq)))
        errors = self.freq_error[~np.isnan(self.freq_error)]
        lines = [
            f"<ReductionQuality: {counted(self.modes.size, 'mode')}, worst frequency "
            f"{100 * np.abs(errors).max(initial=0.0):.3g} %, lowest MAC "
            f"{self.mac[~np.isnan(self.freq)].min(initial=1.0):.4f}"
            + (f", {lost} without a partner" if lost else "")
        ]
        if self.alike:
            listed = "; ".join(", ".join(map(str, members)) for members in self.alike[:4])
            more = ", ..." if len(self.alike) > 4 else ""
            lines.append(f"shapes that cannot be distinguished: modes {listed}{more}")
        if self.frf_error.size:
            i, j = np.unravel_index(int(np.argmax(self.frf_error)), self.frf_error.shape)
            lines.append(
                f"FRF over {self.check_freq[0]:.4g} to {self.check_freq[-1]:.4g} Hz: worst "
                f"{100 * self.frf_error[i, j]:.3g} % of the peak ({self.inputs[j]} -> "
                f"{self.outputs[i]}), static {100 * self.static_error.max():.3g} %"
            )
            if not np.all(np.isnan(self.resonance_error)):
                lines[-1] += f", at resonance {100 * np.nanmax(self.resonance_error):.3g} %"
            if not np.all(np.isnan(self.antiresonance_error)):
                worst = 100 * np.nanmax(self.antiresonance_error)
                lines[-1] += f", at antiresonance {worst:.3g} %"
            if self.bound is not None:
                lines.append(
                    f"error {self.true_error:.3g} m/N, bound {self.band_bound:.3g} m/N up to "
                    f"{self.check_freq[-1]:.4g} Hz ({self.bound.value:.3g} at all)"
                    + ("" if self.holds else ": BROKEN")
                )
                if not self.bounded:
                    lines[-1] += (
                        f", of the {self.bound.covers} modes solved: others add to the error"
                    )
            lines.append(f"by {self.route}")
        return "\n  ".join(lines) + ">"

    def table(self) -> str:
        """Return mode by mode: both frequencies, error, MAC and of which shape it may also be."""
        other = {
            n: f"  alike: {', '.join(str(k) for k in members if k != n)}"
            for members in self.alike
            for n in members
        }
        lines = [f"mode{'full [Hz]':>12s}{'reduced [Hz]':>14s}{'error [%]':>12s}{'MAC':>9s}"]
        lines += [
            f"{n:4d}{f:12.4f}{g:14.4f}{100 * e:12.3g}{m:9.5f}{other.get(n, '')}"
            for n, f, g, e, m in zip(
                self.modes, self.full_freq, self.freq, self.freq_error, self.mac, strict=True
            )
        ]
        return "\n".join(lines)
