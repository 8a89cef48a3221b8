"""Result of an identification: scaled shapes and the covariance of poles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray
from ..errors import ModelError, SolverError, warn
from ..lti.frequency import Frf, checked_freq
from ..tolerances import TINY
from .diagram import StabilisationDiagram
from .lines import NARROW, PreparedLines, Rejected, axis, pole_terms, residual_terms
from .measured import MeasuredModes
from .model_error import Disagreement
from .refine import PoleFit, free_inputs, scaled_inverse


def answer(
    frf: Frf,
    delay: float,
    ready: PreparedLines,
    fit: PoleFit,
    reported: IntArray,
    labels: Mapping[str, str],
    diagram: StabilisationDiagram | None,
    rejected: tuple[Rejected, ...],
    reason: str,
    apart: Disagreement | None,
    uneven: float,
) -> IdentifiedModes:
    """Return the reported modes of a fit, sorted; `uneven` enlarges the variance of its poles."""
    lines, misfit = fit.lines, fit.misfit
    formal, spread = _covariances(fit, ready)
    covariance, spread = formal * max(uneven, misfit), spread * max(1.0, misfit)
    if apart is not None:
        covariance = apart.covariance(formal)
    shapes, part, terms = fit.shapes, fit.participation, fit.terms
    if ready.swapped:
        shapes, part, terms = part, shapes, terms.transpose(1, 0, 2)
    outputs = tuple(labels.get(name, name) for name in frf.outputs)
    inputs = tuple(labels.get(name, name) for name in frf.inputs)
    shared = [(outputs.index(dof), i) for i, dof in enumerate(inputs) if dof in outputs]
    normalised = bool(labels and shared)
    shapes, part, T = _scaled_shapes(fit.poles, shapes, part, shared if normalised else [])
    if ready.swapped:
        turned = np.roll(np.arange(spread.shape[1]), -len(fit.shapes))
        spread = spread[:, turned][:, :, turned]
    spread = T @ spread @ T.conj().transpose(0, 2, 1)
    order = np.argsort(np.abs(fit.poles), kind="stable")
    seen = np.isin(order, reported)
    inside, outside = order[seen], order[~seen]
    both = np.concatenate([inside, inside + fit.poles.size])
    return IdentifiedModes(
        fit.poles[inside],
        covariance=covariance[np.ix_(both, both)],
        shapes=shapes[:, inside],
        dofs=outputs,
        participation=part[:, inside],
        inputs=tuple(frf.inputs),
        input_dofs=inputs,
        outputs=tuple(frf.outputs),
        terms=terms,
        lower=lines.lower,
        top=float(lines.freq[-1]),
        hold=lines.hold,
        delay=delay,
        segment=lines.segment,
        unreported=(fit.poles[outside], shapes[:, outside], part[:, outside]),
        mass_normalised=normalised,
        misfit=misfit,
        diagram=diagram,
        channel_covariance=spread[inside],
        rejected=rejected,
        first_answer=reason,
        inconsistency=None if apart is None else apart.size,
        inconsistent="" if apart is None else lines.side,
    )


def _covariances(fit: PoleFit, ready: PreparedLines) -> tuple[FloatArray, ComplexArray]:
    """Return the covariance of [Re lambda; Im lambda] and that of shapes and participation."""
    # the latter is E[n n^H] of the errors n (n_out + n_in,) of each mode. With poles and
    # participation theta, the error of the shape at output a is `S_a d theta + D_a^T e_a`, `d theta
    # = N^{-1} sum_b J_b^T e_b`; D_a and J_a are orthogonal, so that the two are independent unless
    # outputs share errors. Noise forces on the machine are shared: near a resonance they move all
    # outputs along the shape, which is an error of scale
    N, maps = fit.gradient()[0], fit.maps()
    m, n_out, n_in = fit.poles.size, len(maps), fit.participation.shape[0]
    # participation of repeated poles is only known up to a rotation and gets no variance
    inverse = scaled_inverse(N)
    slopes = np.array([slope for slope, _ in maps]).reshape(n_out, 2, m, -1)
    common = inverse
    mixed: FloatArray = np.zeros((n_out, len(inverse), 2 * m))
    held = np.zeros((n_out, n_out, m, 2, 2))
    if ready.independent:
        for a, (_, turn) in enumerate(maps):
            pairs = turn.reshape(2, m, -1)
            held[a, a] = np.einsum("akq,bkq->kab", pairs, pairs)
    else:
        direct = [fit.shape_rows(a, turn) for a, (_, turn) in enumerate(maps)]
        J, common = list(fit.jacobians()), np.zeros_like(inverse)
        for b, (own, slope) in enumerate(zip(direct, J, strict=True)):
            others, total = ready.spread(own), np.zeros_like(slope)
            for a in range(n_out):
                C = ready.correlated(a, b)
                if C is not None:
                    held[a, b] = _of_modes(direct[a], C * others)
                    total += np.conj(C) * J[a]
            common += _inner_product(total, ready.spread(slope))
            mixed[b] = inverse @ _inner_product(total, others)
        common = inverse @ common @ inverse
    # derivatives of Re and Im of the participation, whose free entries are parameters themselves
    entries = np.zeros((n_in, 2, m, 2 * m * n_in))
    place = 2 * m * (1 + np.arange(n_in - 1)[:, None]) + np.arange(m)
    free = free_inputs(fit.pivots, n_in)
    entries[free, 0, np.arange(m), place] = entries[free, 1, np.arange(m), place + m] = 1.0
    slopes = np.concatenate([slopes, entries])
    mixed = mixed.reshape(n_out, -1, 2, m)
    found = np.zeros((m, n_out + n_in, n_out + n_in), dtype=np.complex128)
    for k in range(m):
        slope = slopes[:, :, k]
        S = np.einsum("oap,pq,ebq->oaeb", slope, common, slope, optimize=True)
        if not ready.independent:
            cross = np.einsum("oap,epb->oaeb", slope, mixed[..., k])
            S[:, :, :n_out] += cross
            S[:n_out] += cross.transpose(2, 3, 0, 1)
        S[:n_out, :, :n_out] += held[:, :, k].transpose(0, 2, 1, 3)
        found[k] = S[:, 0, :, 0] + S[:, 1, :, 1] + 1j * (S[:, 1, :, 0] - S[:, 0, :, 1])
    chosen = common[: 2 * m, : 2 * m]
    both: ComplexArray = found + found.conj().transpose(0, 2, 1)
    return (chosen + chosen.T) / 2, both / 2


def _scaled_shapes(
    poles: ComplexArray, psi: ComplexArray, part: ComplexArray, shared: list[tuple[int, int]]
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    r"""Return shapes mass-normalised by shared DOFs, or with a largest entry of 1; participation.

    Also returns T (m, n_out + n_in, n_out + n_in) from errors of the raw channels to scaled ones.
    With ``phi = f psi``, ``p = l / f``: ``d phi = f d psi + phi df/f`` and
    ``d p = d l / f - p df/f``. For `shared` channels s, ``f^2 ~ psi_s^H l_s / |psi_s|^2`` and l_s
    is a multiple r of psi_s except for noise, so that
    ``2 df/f = psi_s^H (d l_s / r - d psi_s) / |psi_s|^2``; else ``f = 1 / psi_max``.
    """
    n_out, m = psi.shape
    large, columns = np.argmax(np.abs(psi), axis=0), np.arange(m)
    g = np.zeros((m, n_out + part.shape[0]), dtype=np.complex128)
    if shared:
        rows, places = (list(side) for side in zip(*shared, strict=True))
        driven = psi[rows].conj() / np.sum(np.abs(psi[rows]) ** 2, axis=0)
        ratio = np.sum(driven * part[places], axis=0)
        factor = np.sqrt(2j * poles.imag * ratio)
        factor = factor * np.where((factor * psi[large, columns]).real < 0, -1.0, 1.0)
        for row, place, weight in zip(rows, places, driven, strict=True):
            g[:, row] -= 0.5 * weight
            g[:, n_out + place] += 0.5 * weight / ratio
    else:
        factor = 1.0 / psi[large, columns]
        g[columns, large] = -factor
    phi, driving = psi * factor, part / factor
    T = np.concatenate([phi, -driving]).T[:, :, None] * g[:, None, :]
    diagonal = np.arange(g.shape[1])
    T[:, diagonal, diagonal] += np.where(diagonal < n_out, factor[:, None], 1 / factor[:, None])
    return phi, driving, np.asarray(T)


def _inner_product(left: ComplexArray, right: ComplexArray) -> Any:
    """Return Re(left^H right), summed over inputs and lines."""
    return (left.reshape(-1, left.shape[2]).conj().T @ right.reshape(-1, right.shape[2])).real


def _of_modes(left: ComplexArray, right: ComplexArray) -> Any:
    """Return the blocks (m, 2, 2) of the inner product that belong to one mode each."""
    pairs = (side.reshape(-1, 2, side.shape[2] // 2) for side in (left.conj(), right))
    return np.einsum("fak,fbk->kab", *pairs).real


#: width 2 zeta f of a resonance in lines below which leakage may make poles unstable
FEWEST = 4.0
#: relative increase of the damping by leakage at a width of n lines, as factor and power of n:
#: without a window, and with Hamming and Kaiser windows (6 to 2.5 %, 1.1 and 0.4 % at 2 to 16
#: lines)
BOXCAR, TAPERED = (1.0 / np.pi, -1.0), (0.15, -1.25)


def hann_segment(frf: Frf) -> float | None:
    """Return the length [s] of the Hann-windowed segments of a measurement, else None."""
    known = frf.window == "hann" and frf.resolution is not None
    return 1.0 / float(frf.resolution or 1.0) if known else None


def leakage_warned(frf: Frf, found: IdentifiedModes) -> None:
    """Warn of resonances that windowed segments broaden by more than their deviation."""
    # segments of length T without a taper shift a pole by about -1/T, a fraction `1/(pi n)` of its
    # width of n lines; tapered ones by about `0.15 n^-1.25` ([BendatPiersol2010]_, section 11.6;
    # random excitation). Leakage is not coherent and at most `1 - gamma^2` at the resonance. Where
    # the fit includes the window, an error remains only below half a line
    if frf.window is None or frf.resolution is None:
        return
    poles = found.poles
    width = -2.0 * poles.real / (2 * np.pi)
    lines = width / frf.resolution
    if found.segment is not None:
        # of a narrower resonance only the main lobe of the window is visible
        added = np.where(lines < NARROW, 1.0, 0.0)
    else:
        factor, power = BOXCAR if frf.window == "boxcar" else TAPERED
        added = factor * lines**power
        if frf.coherence is not None:
            at = np.argmin(np.abs(frf.freq[:, None] - np.abs(poles) / (2 * np.pi)), axis=0)
            added = np.minimum(added, 1.0 - np.max(frf.coherence[:, :, at], axis=(0, 1)))
    std = found.std
    known = np.zeros(poles.size) if std is None else std.real / -poles.real
    narrow = np.flatnonzero(added > known)
    if not narrow.size:
        return
    worst = int(narrow[np.argmax(added[narrow])])
    freq = np.abs(poles) / (2 * np.pi)
    listed = ", ".join(f"{freq[k]:.4g} Hz (2 zeta f = {width[k]:.2g} Hz)" for k in narrow[:4])
    more = f" and {narrow.size - 4} more" if narrow.size > 4 else ""
    size = (
        f"by up to {added[worst]:.1%} where its deviation is {known[worst]:.1%}"
        if found.segment is None
        else "and splits it into several poles where it is narrower than half a line"
    )
    longer = (
        NARROW / width[worst]
        if found.segment
        else added[worst] / (max(known[worst], TINY) * frf.resolution)
    )
    other = ", a Hann window" if frf.window == "boxcar" else ""
    warn(
        f"segments of {1 / frf.resolution:.3g} s are too short for the damping near "
        f"{listed}{more}: leakage widens a resonance {size}. Take segment= of at least "
        f"{longer:.2g} s{other}, or excite with whole periods, identification.Periodic(...)."
    )


def of_segments(frf: Frf, error: SolverError) -> SolverError:
    """Return the error of an identification that failed, with leakage as a possible cause."""
    if frf.window is None or frf.resolution is None:
        return error
    return SolverError(
        f"{error} The responses come from windowed segments of {1 / frf.resolution:.3g} s: where "
        f"resonances are narrower than about four lines ({FEWEST * frf.resolution:.2g} Hz), "
        "leakage makes poles unstable. Take longer segments, segment=, or excite with whole "
        "periods, Periodic(...)."
    )


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedModes(MeasuredModes):
    r"""Result of `identify_modes`: measured modes with all results of the fit.

    .. math:: H(s) = \sum_k \frac{\psi_k l_k^T}{s - \lambda_k}
        + \frac{\bar\psi_k \bar l_k^T}{s - \bar\lambda_k} + E(s)

    The fit has the poles lambda_k, the shapes psi_k and the participation vectors l_k, which state
    how strongly each input excites the mode. E(s) contains the residual terms, which represent the
    modes outside the band. M and D in the
    descriptions below are the mass and damping matrices of the structure.

    Parameters
    ----------
    poles, modes, covariance, shapes, dofs, xyz, directions
        As in `MeasuredModes`. The shapes psi_k are those at the outputs.
    participation : (n_in, m) complex array
        Participation vectors l_k of the inputs.
    inputs, outputs : sequences of str
        Names of the channels.
    input_dofs : sequence of n_in str
        Labels of the inputs' DOFs, or names of the inputs where no DOF is known.
    terms : (n_out, n_in, number of terms) array
        Coefficients of the residual terms E(s). The first `lower` ones belong to 1/s, 1/s^2 and so
        on, and the others to 1, s, s^2 and so on. In these powers, s is divided by ``2 pi top``.
    lower : int
        Number of the terms with negative powers of s.
    top : float [Hz]
        Largest frequency of the measured lines, which scales s in E(s).
    hold : float [Hz], optional
        Rate of the zero-order hold in the measurement.
    delay : float [samples]
        Delay of the measurement, in samples of the hold.
    segment : float [s], optional
        Length of the Hann-windowed segments of the measurement, whose effect the fit includes.
    unreported : three complex arrays (p,), (n_out, p), (n_in, p)
        Poles of modes just outside the band that are part of the fit, their shapes, and their
        participation vectors.
    mass_normalised : bool
        Whether the shapes are scaled as those of a model, with ``phi^T (2 lambda M + D) phi = 2i
        Im(lambda)``. This needs an input and an output at the same DOF. Otherwise the largest entry
        of each shape is 1.
    misfit : float
        Weighted squared error of the fit, relative to its expected value if the error is only noise
        with the stated variance. A value of 1 is therefore good.
    diagram : StabilisationDiagram, optional
        Diagram from which the poles were chosen.
    channel_covariance : (m, n_out + n_in, n_out + n_in) complex array, optional
        Covariance E[n n^H] of the error n of the vector [shape; participation] of each mode,
        including the error of its scale. It follows from the variance of the FRF and from the
        correlation between the errors of outputs. If this correlation is not known, the errors of
        outputs are assumed independent.
    rejected : sequence of (frequency [Hz], damping ratio, reason)
        Poles that are not reported, and frequencies of mains hum that the fit leaves out.
    first_answer : str
        Reason why the poles were not refined by maximum likelihood. Empty: they were refined.
    inconsistency : float, optional
        Relative difference between the frequencies that are found from separate outputs, inputs or
        runs. The poles are then means over these, and their covariance follows from the
        differences. None: the frequencies agree.
    inconsistent : str
        Kind of the data that disagree: "outputs", "inputs" or "runs". Empty: they agree.
    undamped : float [rad/s]
        Damping of an exponential window, already subtracted from the poles.
    """

    participation: ComplexArray = field(kw_only=True)
    inputs: tuple[str, ...] = field(kw_only=True)
    outputs: tuple[str, ...] = field(kw_only=True)
    input_dofs: tuple[str, ...] = field(default=(), kw_only=True)
    terms: FloatArray = field(kw_only=True)
    lower: int = field(kw_only=True)
    top: float = field(kw_only=True)
    hold: float | None = field(default=None, kw_only=True)
    delay: float = field(default=0.0, kw_only=True)
    segment: float | None = field(default=None, kw_only=True)
    unreported: tuple[ComplexArray, ComplexArray, ComplexArray] = field(kw_only=True)
    mass_normalised: bool = field(default=False, kw_only=True)
    misfit: float = field(kw_only=True)
    diagram: StabilisationDiagram | None = field(default=None, kw_only=True)
    channel_covariance: ComplexArray | None = field(default=None, kw_only=True)
    rejected: tuple[tuple[float, float, str], ...] = field(default=(), kw_only=True)
    first_answer: str = field(default="", kw_only=True)
    inconsistency: float | None = field(default=None, kw_only=True)
    inconsistent: str = field(default="", kw_only=True)
    undamped: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shapes is None:
            raise ModelError("identified modes have shapes at their outputs.")
        self._set(
            input_dofs=tuple(self.input_dofs) or tuple(self.inputs),
            participation=self.participation,
            terms=self.terms,
            channel_covariance=self.channel_covariance,
        )

    @property
    def refined(self) -> bool:
        """Whether the poles are the result of the complete maximum likelihood fit."""
        return not self.first_answer

    def __repr__(self) -> str:
        notes = ["refined" if self.refined else f"the first result ({self.first_answer})"]
        if self.inconsistency is not None:
            notes.append(
                f"{self.inconsistent} disagree by {self.inconsistency:.1e}, "
                "poles are means of separate fits"
            )
        elif self.misfit > 1.0:
            notes.append(f"deviations enlarged by the misfit {self.misfit:.3g}")
        notes += [f"rejected {freq:.5g} Hz: {why}" for freq, _, why in self.rejected[:4]]
        return "; ".join([super().__repr__()[:-1].replace("Measured", "Identified"), *notes]) + ">"

    @property
    def shape_covariance(self) -> ComplexArray | None:
        """Covariance E[n n^H] (m, n_out, n_out) of the error n of each shape; None: not known."""
        count, spread = len(self.outputs), self.channel_covariance
        return None if spread is None else spread[:, :count, :count]

    def frf(self, freq: FloatArray, *, as_measured: bool = False) -> Frf:
        """Return the FRF of the identified modes and residual terms (displacement per input).

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Positive frequencies. Outside the identified band the residual terms are not valid.
        as_measured : bool
            Whether to include the effect of windowed segments, if the fit included it. Resonances
            are then lower and wider than those of the machine.
        """
        freq = checked_freq(freq)
        if freq.size and freq.min() <= 0:
            raise ModelError("freq must be positive: a free machine has no response at zero.")
        s = axis(freq)
        poles, shapes, participation = self.unreported
        assert self.shapes is not None  # noqa: S101 - checked when made
        poles = np.concatenate([self.poles, poles])
        shapes = np.concatenate([self.shapes, shapes], axis=1)
        participation = np.concatenate([self.participation, participation], axis=1)
        segment = self.segment if as_measured else None
        late = self.delay % 1.0
        plus, _ = pole_terms(poles, s, self.hold, segment, late=late)
        minus, _ = pole_terms(poles.conj(), s, self.hold, segment, late=late)
        data = np.einsum("ok,ik,kf->oif", shapes, participation, plus)
        data += np.einsum("ok,ik,kf->oif", shapes.conj(), participation.conj(), minus)
        upper = self.terms.shape[2] - self.lower
        smooth = residual_terms(
            s, lower=self.lower, upper=upper, hold=self.hold, top=2 * np.pi * self.top, late=late
        )
        data += self.terms @ smooth
        if self.hold is not None:
            data *= np.exp(-s * self.delay / self.hold)
        return Frf(freq, data, inputs=self.inputs, outputs=self.outputs, quantity="displacement")

    def _picked(self, places: list[int]) -> dict[str, Any]:
        spread = self.channel_covariance
        return super()._picked(places) | {
            "participation": self.participation[:, places],
            "channel_covariance": None if spread is None else spread[places],
        }
