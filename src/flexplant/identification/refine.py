"""Maximum likelihood refinement in pole-residue form, by variable projection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..values import ComplexArray, FloatArray
from .basis import axis, pole_terms, residual_terms

#: largest entry of a participation vector beside the one held at 1
RUNAWAY = 5.0
#: least damping ratio of a pole
LEAST = 1e-7


@dataclass(frozen=True, eq=False)
class Lines:
    """What is fitted: responses, their weights, and what residual terms may explain."""

    freq: FloatArray
    data: ComplexArray  # (n_out, n_in, n_freq)
    weight: FloatArray  # the same shape: sqrt(2)/standard deviation
    lower: int
    upper: int
    hold: float | None
    known: bool = True  # whether the weights are those of a known variance
    #: variance of a mean over many lines, relative to independent ones
    inflation: float = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """Poles (m,), participation (n_in, m), shapes (n_out, m), terms (n_out, n_in, n_terms)."""

    poles: ComplexArray
    participation: ComplexArray
    shapes: ComplexArray
    terms: FloatArray
    cost: float
    N: FloatArray  # normal matrix of the nonlinear parameters
    jacobian: list[ComplexArray]  # per output (n_in, n_freq, n_parameters)
    model: ComplexArray  # the fitted responses
    settled: bool = True
    shape_maps: tuple[tuple[FloatArray, ComplexArray], ...] = ()  # see _Projected.shape_maps


def refined(
    lines: Lines,
    poles: ComplexArray,
    participation: ComplexArray,
    *,
    steps: int,
    strict: bool = True,
) -> Fit:
    r"""Return the weighted least-squares fit of

    .. math:: H_{oi}(s) = \sum_k \frac{\psi_{ok} l_{ik}}{s - \lambda_k}
        + \frac{\bar\psi_{ok} \bar l_{ik}}{s - \bar\lambda_k} + \sum_p E_{oip} g_p(s),

    the maximum likelihood one when the weights are those of circular Gaussian errors. Shapes psi
    and residual terms E are linear and eliminated at each step (Golub and Pereyra, Inverse
    Problems 19 (2003) R1; Kaufman's Jacobian); poles and participation l, one entry of each
    column held at 1, are found by Levenberg-Marquardt.
    """  # noqa: D400 - the sentence is the equation
    pivots = np.argmax(np.abs(participation), axis=0)
    columns = np.arange(poles.size)
    participation = participation / participation[pivots, columns]
    now = _projected(lines, poles, participation, pivots)
    damping, settled, idle = 1e-6, True, 0
    power = float(np.sum(np.abs(lines.data * lines.weight) ** 2))
    for _ in range(steps):
        N, g, _ = now.normal
        size = np.sqrt(np.maximum(np.diag(N), 1e-300))
        scaled, slope = N / np.outer(size, size), g / size
        # a pole outside the band may come to the axis: it stays there, the others go on
        held = np.flatnonzero((poles.real >= -1.01 * LEAST * poles.imag) & (g[: poles.size] > 0))
        scaled[held], scaled[:, held], slope[held] = 0.0, 0.0, 0.0
        scaled[held, held] = 1.0
        # what a full step would gain: a damped one is short, and says nothing of being there
        predicted = float(slope @ _step(scaled, slope, 1e-8))
        better, gained = None, 0.0
        for _ in range(12):
            step = _step(scaled, slope, damping) / size
            trial = _moved(poles, participation, pivots, step)
            if np.abs(trial[1]).max() < 1e6 and np.all(trial[0].imag > 0):
                better = _projected(lines, *trial, pivots)
                gained = now.cost - better.cost
                if gained >= 0:
                    break
            better = None
            damping = max(10.0 * damping, 1e-8)
        if better is None:
            break
        poles, participation = trial
        now, damping = better, damping / 10.0
        if np.abs(participation).max() > RUNAWAY:
            # the entry held at 1 is next to none: another is held
            pivots = np.argmax(np.abs(participation), axis=0)
            participation = participation / participation[pivots, columns]
            now = _projected(lines, poles, participation, pivots)
        # a step of 3e-3 standard deviations of what is left is none
        if predicted <= 1e-5 * now.cost / (2 * lines.data.size):
            break
        idle = idle + 1 if gained <= 1e-12 * now.cost else 0
        if idle >= 3 or (idle and damping <= 1e-3) or now.cost <= 1e-24 * power:
            break
    else:
        settled = False
        if strict:
            raise unsettled(poles.size, steps)
    N, _, jacobian = now.normal
    return Fit(
        poles,
        participation,
        now.shapes,
        now.terms,
        now.cost,
        N,
        jacobian,
        now.model,
        settled,
        tuple(now.shape_maps),
    )


def unsettled(count: int, steps: int) -> SolverError:
    """Return the error of a fit that does not converge."""
    return SolverError(
        f"the refinement of {count} poles did not settle within {steps} steps: leave out "
        "poles that do not stand out of the noise, or narrow the band."
    )


class _Projected:
    """The fit at given poles and participation, and its derivatives when required."""

    def __init__(
        self,
        lines: Lines,
        poles: ComplexArray,
        participation: ComplexArray,
        pivots: Any,
    ) -> None:
        s = axis(lines.freq)
        n_out, n_in, _ = lines.data.shape
        m = poles.size
        self.lines, self.pivots, self.m = lines, pivots, m
        self.participation = participation
        self.plus, self.slope = pole_terms(poles, s, lines.hold)
        self.minus, self.slope_minus = pole_terms(poles.conj(), s, lines.hold)
        top = 2 * np.pi * float(lines.freq[-1])
        smooth = residual_terms(s, lower=lines.lower, upper=lines.upper, hold=lines.hold, top=top)
        self.shapes = np.zeros((n_out, m), dtype=np.complex128)
        self.terms = np.zeros((n_out, n_in, smooth.shape[0]))
        self.model = np.zeros_like(lines.data)
        #: per output, d[Re psi; Im psi]/d(poles, participation) and, with these held, its rows
        #: by the weighted data, (n_in, n_freq, 2 m)
        self.shape_maps: list[tuple[FloatArray, ComplexArray]] = []
        self.triangles: list[tuple[FloatArray, FloatArray]] = []
        self.bases: list[tuple[list[FloatArray], FloatArray, FloatArray, FloatArray]] = []
        self.linear: list[tuple[FloatArray, FloatArray, float]] = []
        self.cost = 0.0
        for o in range(n_out):
            smooth_bases, smooth_R, rows, goal = [], [], [], []
            for i in range(n_in):
                w = lines.weight[o, i]
                Q, R = _qr(_real(smooth * w).T)
                smooth_bases.append(Q)
                smooth_R.append(R)
                rows.append(_off(Q, self._columns(i, w)))
                goal.append(_off(Q, _real(lines.data[o, i] * w)))
            stacked = np.concatenate(rows)
            size = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
            Q, R = _qr(stacked / size)
            right = np.concatenate(goal)
            self.linear.append((stacked.T @ stacked, stacked.T @ right, float(right @ right)))
            x = la.lstsq(R, Q.T @ right, cond=1e-13)[0] / size
            self.shapes[o] = x[:m] + 1j * x[m:]
            self.triangles.append((R, size))
            error = right - Q @ (Q.T @ right)
            self.cost += float(error @ error)
            self.bases.append((smooth_bases, Q, error, x))
            for i in range(n_in):
                w = lines.weight[o, i]
                modal = self._modal(i, self.shapes[o])
                left = _real((lines.data[o, i] - modal) * w)
                self.terms[o, i] = la.lstsq(smooth_R[i], smooth_bases[i].T @ left)[0]
                self.model[o, i] = modal + self.terms[o, i] @ smooth

    def _columns(self, i: int, w: FloatArray) -> FloatArray:
        l = self.participation[i][:, None]  # noqa: E741 - the field's letter
        first, second = l * self.plus, l.conj() * self.minus
        return _real(np.concatenate([first + second, 1j * (first - second)]) * w).T

    def _modal(self, i: int, shape: ComplexArray) -> ComplexArray:
        residue = shape * self.participation[i]
        return np.asarray(residue @ self.plus + residue.conj() @ self.minus)

    @property
    def normal(self) -> tuple[FloatArray, FloatArray, list[ComplexArray]]:
        """Return J^T J, J^T e and J of the nonlinear parameters, all outputs together."""
        n_in, n_freq = self.lines.data.shape[1:]
        count = 2 * self.m * n_in
        self.shape_maps = []
        N, g, kept = np.zeros((count, count)), np.zeros(count), []
        for o, (smooth_bases, Q, error, _) in enumerate(self.bases):
            shape = self.shapes[o][:, None]
            blocks = []
            for i in range(n_in):
                w = self.lines.weight[o, i]
                l = self.participation[i][:, None]  # noqa: E741
                a, b = shape * l * self.slope, (shape * l).conj() * self.slope_minus
                parts = np.zeros((2 * n_in, self.m, n_freq), dtype=np.complex128)
                parts[0], parts[1] = a + b, 1j * (a - b)
                # the entries of l that are free, in order, the pivot of each column left out
                c, d = shape * self.plus, shape.conj() * self.minus
                for k in range(self.m):
                    if i != self.pivots[k]:
                        place = 2 + 2 * (i - (i > self.pivots[k]))
                        parts[place, k] = c[k] + d[k]
                        parts[place + 1, k] = 1j * (c[k] - d[k])
                columns = _real(parts.reshape(count, n_freq) * w).T
                blocks.append(_off(smooth_bases[i], columns))
            J = np.concatenate(blocks)
            R, size = self.triangles[o]
            inverse = la.pinv(R, rtol=1e-13) / size[:, None]
            common = Q.T @ J
            rows = (Q @ inverse.T).reshape(n_in, 2, n_freq, 2 * self.m)
            self.shape_maps.append((-inverse @ common, rows[:, 0] + 1j * rows[:, 1]))
            J -= Q @ common
            N += J.T @ J
            g += J.T @ error
            split = J.reshape(n_in, 2, n_freq, count)
            kept.append(split[:, 0] + 1j * split[:, 1])
        return N, g, kept


def _projected(lines: Lines, poles: ComplexArray, part: ComplexArray, pivots: Any) -> _Projected:
    return _Projected(lines, poles, part, pivots)


def _moved(
    poles: ComplexArray, participation: ComplexArray, pivots: Any, step: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    m, n_in = poles.size, participation.shape[0]
    parts = step.reshape(2 * n_in, m)
    moved = participation.copy()
    for k in range(m):
        free = [i for i in range(n_in) if i != pivots[k]]
        for j, i in enumerate(free):
            moved[i, k] += parts[2 + 2 * j, k] + 1j * parts[3 + 2 * j, k]
    real, imag = poles.real + parts[0], poles.imag + parts[1]
    return np.minimum(real, -LEAST * np.abs(imag)) + 1j * imag, moved


def _step(N: FloatArray, g: FloatArray, damping: float) -> FloatArray:
    return np.asarray(la.solve(N + damping * np.eye(g.size), g, assume_a="pos"))


def _real(values: Any) -> FloatArray:
    return np.concatenate([values.real, values.imag], axis=-1)


def _qr(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    if not matrix.shape[1]:
        return np.zeros((matrix.shape[0], 0)), np.zeros((0, 0))
    Q, R = la.qr(matrix, mode="economic")
    return np.asarray(Q), np.asarray(R)


def _off(Q: FloatArray, rows: FloatArray) -> FloatArray:
    return np.asarray(rows - Q @ (Q.T @ rows))


def projected_normal(
    lines: Lines, poles: ComplexArray, participation: ComplexArray
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return per output the normal equations of shapes, free of residual terms, and the power."""
    return _Projected(lines, poles, participation, np.zeros(poles.size, dtype=int)).linear


def projected_cost(lines: Lines, poles: ComplexArray, participation: ComplexArray) -> float:
    """Return the cost with the best shapes and residual terms."""
    return _Projected(lines, poles, participation, np.zeros(poles.size, dtype=int)).cost
