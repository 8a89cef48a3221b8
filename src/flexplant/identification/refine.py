"""Maximum likelihood refinement in pole-residue form, by variable projection."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray
from ..errors import SolverError, attempted, counted
from ..tolerances import RANK, TINY
from .lines import FAR_APART, Lines, orthonormal, real_and_imag, take_off

#: largest entry of a participation vector relative to the one held at 1
RUNAWAY = 5.0
#: squares of the standard deviations by which a full step may still change a converged fit
FINE, COARSE, ROUGH = 1e-5, 1e-2, 0.3
#: number of steps after which a fit may be given up, and multiple of the gain of a full step for
#: this
TRIAL_STEPS, GAINS_AHEAD = 4, 20.0
#: number of steps of a fit of one output, whose start poles are close
OWN = 20
#: least independent fraction of the square of a column for which products are accurate: 1e-10 with
#: rounding, which a damping of 1e-8 hides
OWN_SQUARE = 1e-6
#: least damping ratio of a pole, and its largest distance from zero relative to the highest line:
#: there the pole is a constant within 1 %, and with a hold its exponential does not overflow
LEAST, FARTHEST = 1e-7, 100.0


def refined(
    lines: Lines,
    poles: ComplexArray,
    participation: ComplexArray,
    *,
    steps: int,
    strict: bool = True,
    fine: bool = False,
    below: float = np.inf,
    poles_only: bool = False,
    first: PoleFit | None = None,
) -> PoleFit:
    r"""Return the weighted least-squares fit of poles and residual terms.

    .. math:: H_{oi}(s) = \sum_k \frac{\psi_{ok} l_{ik}}{s - \lambda_k}
        + \frac{\bar\psi_{ok} \bar l_{ik}}{s - \bar\lambda_k} + \sum_p E_{oip} g_p(s),

    the maximum likelihood one when the weights are those of circular Gaussian errors. Shapes psi
    and residual terms E are linear and eliminated at each step ([GolubPereyra2003]_; the Jacobian
    of [Kaufman1975]_); poles and participation l, one entry of each column held at 1, are found by
    Levenberg-Marquardt: to a tenth of a standard deviation, or to 3e-3 of one where the fit is to
    be `fine`. A fit that cannot fall `below` a cost is given up as soon as twenty times the gain of
    a full step is not enough. `poles_only`: the participation is held fixed, and poles are found to
    half a standard deviation. `first`: the `pivoted` fit at these poles, if it exists already.
    """
    now = pivoted(lines, poles, participation) if first is None else first
    participation, pivots = now.participation, now.pivots
    # nearly Gauss-Newton from the start, whose poles are good
    damping, idle = 1e-6, 0
    power = float(np.linalg.norm(lines.data * lines.weight)) ** 2
    enough = ROUGH if poles_only else FINE if fine else COARSE
    farthest = FARTHEST * 2 * np.pi * float(lines.freq[-1])
    for number in range(steps):
        N, g = now.gradient()
        size = np.sqrt(np.maximum(np.diag(N), TINY))
        scaled, slope = N / np.outer(size, size), g / size
        # a pole outside the band may reach the axis: it stays there, the others continue
        held = np.flatnonzero((poles.real >= -1.01 * LEAST * poles.imag) & (g[: poles.size] > 0))
        if poles_only:
            held = np.concatenate([held, np.arange(2 * poles.size, g.size)])
        scaled[held], scaled[:, held], slope[held] = 0.0, 0.0, 0.0
        scaled[held, held] = 1.0
        # the gain of a full step: a damped step is short and does not show convergence
        predicted = float(slope @ _damped_step(scaled, slope, 1e-8))
        if predicted <= FINE * enough * now.cost / (2 * lines.data.size):
            # rounding would decide whether so small a step lowers the cost
            break
        better, gained = None, 0.0
        for _ in range(12):
            step = _damped_step(scaled, slope, damping) / size
            trial = _apply_step(poles, participation, pivots, step)
            near = np.abs(trial[0]).max() < farthest and np.abs(trial[1]).max() < 1e6
            if near and np.all(trial[0].imag > 0):
                better = PoleFit(lines, *trial, pivots)
                gained = now.cost - better.cost
                if gained >= 0:
                    break
            better = None
            # by factors of ten until a step improves the fit, from the smallest effective damping
            damping = max(10.0 * damping, 1e-8)
        if better is None:
            break
        poles, participation = trial
        now, damping = better, damping / 10.0
        if np.abs(participation).max() > RUNAWAY:
            # the entry held at 1 is relatively small: another one is held
            now = pivoted(lines, poles, participation)
            participation, pivots = now.participation, now.pivots
        # a step of this fraction of a standard deviation counts as converged
        if predicted <= enough * now.cost / (2 * lines.data.size):
            break
        if number >= TRIAL_STEPS and now.cost - GAINS_AHEAD * predicted > below:
            raise unsettled(poles.size, number)
        # three gains of rounding size; or everything is explained to 1e-12 of an amplitude
        idle = idle + 1 if gained <= 1e-12 * now.cost else 0
        if idle >= 3 or (idle and damping <= 1e-3) or now.cost <= 1e-24 * power:
            break
    else:
        if strict:
            raise unsettled(poles.size, steps)
    return now


def scaled_inverse(N: FloatArray) -> FloatArray:
    """Return the inverse of a normal matrix, zero in undetermined directions."""
    size = np.sqrt(np.maximum(np.diag(N), TINY))
    return np.asarray(la.pinvh(N / np.outer(size, size), rtol=RANK) / np.outer(size, size))


def pivoted(lines: Lines, poles: ComplexArray, participation: ComplexArray) -> PoleFit:
    """Return the fit whose largest entry of each column of the participation is 1, and held."""
    pivots = np.argmax(np.abs(participation), axis=0)
    return PoleFit(
        lines, poles, participation / participation[pivots, np.arange(poles.size)], pivots
    )


def unsettled(count: int, steps: int) -> SolverError:
    """Return the error of a fit that does not converge."""
    return SolverError(
        f"the refinement of {counted(count, 'pole')} did not converge within {steps} steps: "
        "leave out poles that do not exceed the noise, or narrow the band."
    )


class PoleFit:
    """The best shapes and residual terms at given poles (m,) and participation (n_in, m).

    `pivots` are the entries of its columns that are held at 1 where they are parameters.
    """

    def __init__(
        self, lines: Lines, poles: ComplexArray, participation: ComplexArray, pivots: Any = None
    ) -> None:
        data, m = lines.data, poles.size
        n_out = len(data)
        lines.work.add(lines.data.size * (2 * m) ** 2)
        self.lines, self.poles, self.participation, self.m = lines, poles, participation, m
        self.pivots: IntArray = np.zeros(m, dtype=int) if pivots is None else pivots
        self.plus, self.slope = lines.pole_terms(poles)
        self.minus, self.slope_minus = lines.pole_terms(poles.conj())
        self.shapes = np.zeros((n_out, m), dtype=np.complex128)
        #: per output R and its inverse, of columns of length 1, and their lengths
        self.triangles: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        #: per output the rows C of the shapes' columns, free of residual terms, and T: the rows of
        #: T C are orthonormal
        self.columns: list[tuple[FloatArray, FloatArray]] = []
        #: weighted errors of the outputs
        self.errors: list[FloatArray] = []
        #: fits of single outputs made so far, by position in `lines.parts`
        self.alone: dict[int, PoleFit] = {}
        self.cost = 0.0
        columns = self._stacked(self.plus, self.minus, participation)
        for o, (right, stacked) in enumerate(zip(lines.goals, columns, strict=True)):
            rows = stacked.reshape(2 * m, right.size)
            R, inverse, size, turn = orthonormal(rows)
            if np.min(np.abs(R.diagonal()), initial=1.0) < FAR_APART:
                # the difference of two poles that nearly coincide holds their rounding, enlarged
                take_off(lines.smooth_bases[o][0], stacked.swapaxes(0, 1))
            due = turn @ (rows @ right)
            x = inverse @ due / size
            self.shapes[o] = x[:m] + 1j * x[m:]
            self.triangles.append((R, inverse, size))
            error = right - (due @ turn) @ rows
            self.cost += float(error @ error)
            self.errors.append(error)
            self.columns.append((rows, turn))

    def _stacked(
        self, plus: ComplexArray, minus: ComplexArray, participation: ComplexArray
    ) -> Iterator[FloatArray]:
        """Yield per output the rows (2 m, n_in, 2 n_freq) of shapes, free of residual terms."""
        single = halves(plus, minus)
        both = np.array([with_residues(single, own) for own in participation]).swapaxes(0, 1)
        # one array for all outputs: memory that is new for each takes longer than its products
        whole = np.empty((len(self.lines.data), *both.shape))
        parts = zip(whole, self.lines.smooth_bases, self.lines.twice, strict=True)
        for rows, (Q, _), w in parts:
            np.multiply(both, w, out=rows)
            take_off(Q, rows.swapaxes(0, 1))
            yield rows

    @cached_property
    def bases(self) -> list[FloatArray]:
        """Per output the orthonormal basis Q (N, 2 m) of the columns, which it replaces."""
        for rows, turn in self.columns:
            rows[:] = turn @ rows
            turn[:] = np.eye(len(turn))
        return [rows.T for rows, _ in self.columns]

    @property
    def misfit(self) -> float:
        """The cost relative to that of noise with the stated variance."""
        return self.cost / self.lines.freedom(self.m)

    def rest(self, place: int) -> tuple[ComplexArray, ComplexArray]:
        """Return poles and participation without those at a place."""
        return np.delete(self.poles, place), np.delete(self.participation, place, axis=1)

    def rises(self, kept: list[int]) -> FloatArray:
        """Return the increase of the cost when each of some poles is left out."""
        # with the least-squares coefficients x and the inverse V of the normal matrix, leaving out
        # the two of a pole costs `x^T V^-1 x` of their entries
        both, total = np.array([*kept, *(k + self.m for k in kept)]), np.zeros(len(kept))
        parts = zip(self.lines.goals, self.bases, self.triangles, strict=True)
        for right, Q, (R, half, _) in parts:
            x = half @ (Q.T @ right)
            if len(kept) < self.m:
                half = np.asarray(la.pinv(la.qr(R[:, both], mode="economic")[1], rtol=0.0))
                x = half @ (half.T @ (R[:, both].T @ (Q.T @ right)))
            rows = half.reshape(2, len(kept), -1).transpose(1, 0, 2)
            own = np.linalg.pinv(rows @ rows.transpose(0, 2, 1), rcond=0.0, hermitian=True)
            pairs = x.reshape(2, -1)
            total += np.einsum("ik,kij,jk->k", pairs, own, pairs)
        return total

    def cost_with(
        self, poles: ComplexArray, participation: ComplexArray, instead: int | None = None
    ) -> float:
        """Return the cost with further poles, also instead of one of the present poles."""
        # the bases Q stay: further columns A add `A - Q Q^T A`, and a pole that goes leaves the two
        # directions Z of `Q^T A` that the others do not span
        lines = self.lines
        plus, minus = (lines.pole_terms(some)[0] for some in (poles, poles.conj()))
        cost, columns = self.cost, self._stacked(plus, minus, participation)
        gone = [] if instead is None else [instead, instead + self.m]
        for right, rows, Q, error, (R, _, _) in zip(
            lines.goals, columns, self.bases, self.errors, self.triangles, strict=True
        ):
            lines.work.add(rows.size * 4 * self.m)
            A = rows.reshape(len(rows), -1).T
            A = A / np.maximum(np.linalg.norm(A, axis=0), TINY)
            known = Q.T @ A
            turned = la.qr(np.delete(R, gone, axis=1))[0] if gone else np.eye(2 * self.m)
            Z = turned[:, 2 * self.m - len(gone) :]
            freed = Z.T @ (Q.T @ right)
            basis = la.orth(np.vstack([A - Q @ known, Z.T @ known]), rcond=RANK)
            gain = basis.T @ np.concatenate([error, freed])
            cost += float(freed @ freed - gain @ gain)
        return cost

    @property
    def own(self) -> list[PoleFit]:
        """The fits of each output, or set-up, alone."""
        return [self.own_of(place) for place in range(len(self.lines.parts))]

    def own_below(self, place: int, below: float) -> PoleFit | None:
        """Return the fit of one output, or set-up, alone: a known one, or one below a cost."""
        with attempted(f"a fit of {self.lines.side} {place + 1} alone", SolverError):
            return self.own_of(place, below)
        return None

    def own_of(self, place: int, below: float = np.inf) -> PoleFit:
        """Return the fit of one output, or set-up, alone, with the common participation."""
        if place not in self.alone:
            first = self.at_rows(self.lines.parts[place])
            self.alone[place] = refined(
                *(first.lines, self.poles, self.participation),
                steps=OWN,
                strict=False,
                below=below,
                poles_only=True,
                first=first,
            )
        return self.alone[place]

    def at_rows(self, rows: IntArray) -> PoleFit:
        """Return the part of this fit at some outputs."""
        part: PoleFit = object.__new__(PoleFit)
        part.lines, part.alone, part.m = self.lines.of_rows(rows), {}, self.m
        part.poles, part.participation, part.pivots = self.poles, self.participation, self.pivots
        part.plus, part.slope = self.plus, self.slope
        part.minus, part.slope_minus = self.minus, self.slope_minus
        part.shapes = self.shapes[rows]
        part.triangles, part.columns, part.errors = (
            [each[o] for o in rows] for each in (self.triangles, self.columns, self.errors)
        )
        part.cost = sum(float(error @ error) for error in part.errors)
        return part

    @property
    def terms(self) -> FloatArray:
        """The coefficients (n_out, n_in, n_terms) of the residual terms."""
        residues = self.shapes[:, None, :] * self.participation
        modal = residues @ self.plus + residues.conj() @ self.minus
        left = real_and_imag((self.lines.data - modal) * self.lines.weight)
        return np.array(
            [
                np.linalg.pinv(R) @ (Q.swapaxes(1, 2) @ rows[..., None])
                for (Q, R), rows in zip(self.lines.smooth_bases, left, strict=True)
            ]
        )[..., 0]

    @cached_property
    def model(self) -> ComplexArray:
        """The fitted responses (n_out, n_in, n_freq)."""
        error = np.array(self.errors).reshape(self.lines.twice.shape)
        real, imag = np.split(error, 2, axis=-1)
        return np.asarray(self.lines.data - (real + 1j * imag) / self.lines.weight)

    @cached_property
    def _rows(self) -> FloatArray:
        """The rows (4 m, 2 n_freq) whose combinations are all derivatives; 2 m for one input."""
        # of the poles, then of the participation, which is held at 1 for a single input
        of_poles = halves(self.slope, self.slope_minus)
        if len(self.participation) == 1:
            return of_poles
        return np.concatenate([of_poles, halves(self.plus, self.minus)])

    def _combined(self, rows: FloatArray, shapes: ComplexArray) -> FloatArray:
        """Return derivatives (..., n_in, 4 m, n) from `_rows`, or from products of it."""
        # by Re and Im of the poles, then by those of the participation of the row's own input
        m = self.m
        parts = [with_residues(rows[..., : 2 * m, :], shapes * self.participation)]
        if rows.shape[-2] > 2 * m:
            parts.append(with_residues(rows[..., 2 * m :, :], shapes))
        return np.concatenate(parts, axis=-2)

    @cached_property
    def _places(self) -> list[tuple[Any, Any]]:
        """Per input, which of the 4 m columns of its rows are parameters, and their numbers."""
        # Re and Im of the poles, then the participation, input by input, without the pivots
        m, k = self.m, np.arange(self.m)
        found = []
        for i in range(self.participation.shape[0]):
            free = k[self.pivots != i]
            place = 2 + 2 * (i - (i > self.pivots[free]))
            mine = np.concatenate([np.arange(2 * m), 2 * m + free, 3 * m + free])
            found.append(
                (mine, np.concatenate([np.arange(2 * m), place * m + free, (place + 1) * m + free]))
            )
        return found

    def _jacobian(self, o: int) -> FloatArray:
        """Return J (n_in 2 n_freq, n_parameters) of an output."""
        # `J = D - Q Q^T D` with the derivatives D of the rows of each input and the basis Q of the
        # shapes
        n_in, Q = self.participation.shape[0], self.bases[o]
        J = np.zeros((n_in, Q.shape[0] // n_in, 2 * self.m * n_in))
        moving = self._combined(self._rows * self.lines.twice[o][:, None, :], self.shapes[o])
        take_off(self.lines.smooth_bases[o][0], moving)
        for own, D, (mine, at) in zip(J, moving, self._places, strict=True):
            own[:, at] = D[mine].T
        J = J.reshape(Q.shape[0], -1)
        return np.asarray(J - Q @ (Q.T @ J))

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return J^T J and J^T e of the nonlinear parameters, all outputs together."""
        N, g, _ = self._equations
        return N, g

    @cached_property
    def _equations(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """J^T J and J^T e, and per output the projection Q^T D on the shapes."""
        # `J^T J = D^T D - (Q^T D)^T Q^T D` and `J^T e = D^T e`, summed over the inputs, whose rows
        # depend only on their participation; products of the common rows are combined. Q is the
        # basis of the residual terms and of the shapes, which are orthogonal to them, as e is. J
        # itself is formed where the difference would lose more digits than the least damping of a
        # step allows
        n_in, lines, m = self.participation.shape[0], self.lines, self.m
        count, (size, width) = 2 * self.participation.size, self._rows.shape
        lines.work.add(lines.data.size * count**2)
        rows, terms = np.empty((size, width)), lines.lower + lines.upper
        # the same memory for all outputs: new memory takes longer than its products
        known = np.empty((n_in, terms + 1, width))
        squares, right = np.empty((n_in, size, size)), np.empty((n_in, size, terms + 1 + 2 * m))
        taken = np.zeros((len(self.errors), 2 * m, count))
        N, g = np.zeros((count, count)), np.zeros(count)
        parts = zip(self.errors, self.columns, lines.twice, self.shapes, taken, strict=True)
        for o, (error, (columns, turn), weights, shapes, mean) in enumerate(parts):
            smooth = lines.smooth_bases[o][0]
            np.multiply(smooth.swapaxes(1, 2), weights[:, None], out=known[:, :-1])
            np.multiply(error.reshape(weights.shape), weights, out=known[:, -1])
            products = self._rows @ known.reshape(-1, width).T
            right[:, :, : terms + 1] = products.reshape(size, n_in, -1).swapaxes(0, 1)
            each = columns.reshape(2 * m, n_in, width).transpose(1, 2, 0)
            for i, (w, own) in enumerate(zip(weights, each, strict=True)):
                np.multiply(self._rows, w, out=rows)
                np.matmul(rows, rows.T, out=squares[i])
                np.matmul(rows, own, out=right[i, :, terms + 1 :])
            half = self._combined(squares, shapes).swapaxes(1, 2)
            whole, seen = self._combined(half, shapes), self._combined(right, shapes)
            off = seen[..., :terms]
            free = whole - off @ off.swapaxes(1, 2)
            length, left = np.zeros((2, count))
            for i, (mine, at) in enumerate(self._places):
                length[at] += whole[i, mine, mine]
                left[at] += free[i, mine, mine]
                mean[:, at] += seen[i, mine, terms + 1 :].T
                g[at] += seen[i, mine, terms]
            mean[:] = turn @ mean
            if np.any(left - np.sum(mean**2, axis=0) < OWN_SQUARE * length):
                J = self._jacobian(o)
                N += J.T @ J
                continue
            for i, (mine, at) in enumerate(self._places):
                N[at[:, None], at] += free[i][mine[:, None], mine]
            N -= mean.T @ mean
        return N, g, taken

    def jacobians(self) -> Iterator[ComplexArray]:
        """Yield J (n_in, n_freq, n_parameters) per output."""
        n_in, n_freq = self.lines.data.shape[1:]
        for o in range(len(self.errors)):
            split = self._jacobian(o).reshape(n_in, 2, n_freq, -1)
            yield split[:, 0] + 1j * split[:, 1]

    def maps(self) -> list[tuple[FloatArray, FloatArray]]:
        """Return per output the derivatives of its shapes, and their map from the bases."""
        # d[Re psi; Im psi] / d(poles, participation) and, these held, by `Q^T` times the data
        each = (inverse / size[:, None] for _, inverse, size in self.triangles)
        return [(-own @ mean, own) for own, mean in zip(each, self._equations[2], strict=True)]

    def shape_rows(self, o: int, own: FloatArray) -> ComplexArray:
        """Return the derivatives (n_in, n_freq, 2 m) of an output's shapes by its weighted data."""
        n_in, n_freq = self.lines.data.shape[1:]
        rows = (self.bases[o] @ own.T).reshape(n_in, 2, n_freq, 2 * self.m)
        return np.asarray(rows[:, 0] + 1j * rows[:, 1])


def halves(plus: ComplexArray, minus: ComplexArray) -> FloatArray:
    """Return the rows (2 m, 2 n_freq) of terms and their conjugates for residues 1, and for j."""
    return real_and_imag(np.concatenate([plus + minus, 1j * (plus - minus)]))


def with_residues(rows: FloatArray, residues: ComplexArray) -> FloatArray:
    """Return the rows (..., 2 m, n) of `halves` for residues (..., m), and for j times these."""
    m = residues.shape[-1]
    first, second = rows[..., :m, :], rows[..., m:, :]
    real, imag = residues.real[..., None], residues.imag[..., None]
    found = np.empty(np.broadcast_shapes(rows.shape, (*residues.shape[:-1], 1, 1)))
    np.multiply(real, first, out=found[..., :m, :])
    np.multiply(real, second, out=found[..., m:, :])
    found[..., :m, :] += imag * second
    found[..., m:, :] -= imag * first
    return found


def free_inputs(pivots: Any, n_in: int) -> IntArray:
    """Return the inputs (n_in - 1, m) with free participation, ascending for each mode."""
    others = np.arange(n_in - 1)[:, None]
    return np.asarray(others + (others >= pivots))


def _apply_step(
    poles: ComplexArray, participation: ComplexArray, pivots: Any, step: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    n_in, m = participation.shape
    parts, moved = step.reshape(2 * n_in, m), participation.copy()
    moved[free_inputs(pivots, n_in), np.arange(m)] += parts[2::2] + 1j * parts[3::2]
    real, imag = poles.real + parts[0], poles.imag + parts[1]
    return np.minimum(real, -LEAST * np.abs(imag)) + 1j * imag, moved


def _damped_step(N: FloatArray, g: FloatArray, damping: float) -> FloatArray:
    step, info = la.lapack.dposv(N + damping * np.eye(g.size), g)[1:]
    if info:
        raise la.LinAlgError("the equations of a step are not positive.")
    return np.asarray(step)
