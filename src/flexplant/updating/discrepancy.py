"""Errors that a model cannot explain, and the resulting uncertainty of its modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, divisor, instance
from ..errors import ModelError, counted, some_names
from ..modes.matching import assigned
from ..modes.modes import MeshError, measured_poles
from ..sparse.factor import DENSE_LIMIT
from ..store import Value
from ..tolerances import CLOSE, DEVIATIONS, INTERVAL, MOST_STEPS, NEGLIGIBLE, SAME, TYPED
from .family import Point
from .residuals.residual import USUAL, Bound, Eigenvalues, Kind, eigenvalue_sensitivities, growth
from .search import Objective, SearchEnd
from .search.least_squares import SearchPlan

#: degrees of freedom of the usual discrepancy of a kind: two measured modes outweigh it, and it
#: holds without measured modes
USUAL_DOF = 2.0


@dataclass(frozen=True, eq=False)
class Discrepancy(Value):
    """Model error in one kind of measured values, in addition to noise.

    Parameters
    ----------
    kind : str
        Kind of the measured values, such as ``"frequency"``, ``"damping"`` or ``"mode shape"``.
    deviation : float
        Standard deviation relative to the measured value.
    dof : float
        Degrees of freedom of the estimated deviation. The model error of a further measured value,
        divided by the deviation, follows Student's distribution with these degrees of freedom.

    Examples
    --------
    The frequencies of a model have errors of 0.4 % in addition to noise:

    >>> Discrepancy("frequency", 0.004, 5.2).deviation
    0.004
    """

    kind: str
    deviation: float
    dof: float


def restricted(
    r: FloatArray, J: FloatArray, noise: FloatArray, kinds: Sequence[Kind]
) -> tuple[list[Discrepancy], FloatArray]:
    """Return the discrepancy of each kind, and the covariance V (m, m) of the residuals with them.

    ``V = N + sum_k s_k^2 F_k F_k^T`` maximises the likelihood of the residual,
    ``-(ln|V| + ln|J^T V^-1 J| + r^T P r)/2`` with ``P = V^-1 - V^-1 J (J^T V^-1 J)^-1 J^T V^-1``,
    times a scaled inverse chi-square density of each s_k^2 about the usual value.
    [PattersonThompson1971]_; [KennedyOHagan2001]_ (the discrepancy).
    """
    from scipy.optimize import minimize

    names = list(dict.fromkeys(kind.name for kind in kinds))
    usual = np.array([next(k.usual for k in kinds if k.name == name) for name in names])
    parts = [sum(k.F @ k.F.T for k in kinds if k.name == name) for name in names]
    length = np.linalg.norm(J, axis=0)
    Q = la.qr(J[:, length > 0] / length[length > 0], mode="economic")[0]

    def covariance(log: FloatArray) -> FloatArray:
        size = (usual * np.exp(log)) ** 2
        total: FloatArray = noise + sum(s * part for s, part in zip(size, parts, strict=True))
        return total

    def projected(V: FloatArray) -> tuple[FloatArray, float]:
        factor = la.cho_factor(V, lower=True)
        inverse = la.cho_solve(factor, np.eye(len(V)))
        weighed = inverse @ Q
        inner = la.cho_factor(Q.T @ weighed, lower=True)
        both = 2 * sum(np.log(np.diag(f[0])).sum() for f in (factor, inner))
        return inverse - weighed @ la.cho_solve(inner, weighed.T), float(both)

    def cost(log: FloatArray) -> tuple[float, FloatArray]:
        P, both = projected(covariance(log))
        known = USUAL_DOF * (log + 0.5 * np.exp(-2 * log))
        moved = P @ r
        slope = USUAL_DOF * (1 - np.exp(-2 * log))
        for k, (size, part) in enumerate(zip((usual * np.exp(log)) ** 2, parts, strict=True)):
            slope[k] += size * (np.sum(P * part) - moved @ part @ moved)
        return 0.5 * (both + r @ moved) + known.sum(), slope

    limits = [(np.log(NEGLIGIBLE), -np.log(NEGLIGIBLE))] * len(names)
    log = minimize(cost, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=limits).x
    V = covariance(log)
    P = projected(V)[0]
    size = usual * np.exp(log)
    dof = [s**2 * float(np.sum(P * part)) for s, part in zip(size, parts, strict=True)]
    found = [
        Discrepancy(name, float(s), USUAL_DOF + d)
        for name, s, d in zip(names, size, dof, strict=True)
    ]
    return found, V


class _Weighed(Bound):
    """Residuals that are whitened by noise and discrepancy together."""

    noisy = True

    def __init__(self, bound: Bound, V: FloatArray) -> None:
        self.own, self.numbers, self.name = bound, bound.numbers, bound.name
        self.lost = bound.lost
        self.factor = la.cholesky(V, lower=True)
        self.size = np.abs(self.white(np.eye(len(V)))) @ np.broadcast_to(bound.size, len(V))

    def white(self, rows: FloatArray) -> FloatArray:
        """Return ``L^-1 rows`` with ``V = L L^T``."""
        return np.asarray(la.solve_triangular(self.factor, rows, lower=True))

    def values(self, point: Point) -> FloatArray:
        """Return the whitened residuals."""
        return self.white(self.own.values(point))

    def slopes(self, point: Point) -> FloatArray:
        """Return their derivatives."""
        return self.white(self.own.slopes(point))

    def row_name(self, row: int) -> str:
        """Return what is measured in a row."""
        return self.own.row_name(row)

    def assigned(self, point: Point) -> Point:
        """Return the point with the mode numbers of the residual."""
        return self.own.assigned(point)


def weigh_discrepancy(
    objective: Objective, search: SearchPlan, end: SearchEnd
) -> tuple[SearchEnd, tuple[Discrepancy, ...]]:
    """Return the end of a search with the discrepancy as noise, and the discrepancy."""
    # alternate: the variances at the estimate, and the estimate with these. None with responses,
    # where a model error is correlated over lines
    rows = objective.rows(objective.at(end.p))
    kinds = [bound.kinds() for bound, _ in rows]
    count = rows[-1][1].stop
    if not objective.noise_known or not all(kinds) or count > DENSE_LIMIT:
        return end, ()
    own, defect = list(objective.bounds), objective.defect
    noise, spread = np.eye(count), []
    for (bound, at), each in zip(rows, kinds, strict=True):
        if bound.noise is not None:
            dense: Any = bound.noise
            noise[at, at] = dense.toarray() if hasattr(dense, "toarray") else dense
        for kind in each:
            F = np.zeros((count, kind.F.shape[1]))
            F[at] = kind.F
            spread.append(kind._replace(F=F))
    before: FloatArray = np.zeros(0)
    places = [at for _, at in rows]
    found: list[Discrepancy] = []
    for _ in range(MOST_STEPS):
        objective.bounds, objective.defect = own, defect
        point = objective.at(end.p)
        r, J = objective.values(point), objective.slopes(point)
        # priors count as measured values without a discrepancy
        extra = r.size - count
        widened = [k._replace(F=np.pad(k.F, ((0, extra), (0, 0)))) for k in spread]
        found, V = restricted(r, J, la.block_diag(noise, np.eye(extra)), widened)
        new = [_Weighed(bound, V[at, at]) for bound, at in zip(own, places, strict=True)]
        objective.bounds = list(new)
        objective.noisy = True
        if defect is not None:
            parts = list(zip(new, places, strict=True))
            objective.defect = defect._replace(
                values=np.concatenate([b.white(defect.values[at]) for b, at in parts]),
                slopes=np.vstack([b.white(defect.slopes[at]) for b, at in parts]),
            )
        end = search.resumed(objective, end)
        size = np.array([one.deviation for one in found])
        if before.size and np.all(np.abs(size - before) <= CLOSE * size):
            break
        before = size
    return end, tuple(found)


#: least relative errors of measured frequencies and damping: the drift of a machine exceeds the
#: noise, and its damping depends on amplitude and temperature
_DRIFT = (1e-3, 0.02)
#: factor on the error between two meshes: without it 55 to 100 % of modes were covered
_MESH = 1.5
#: standard deviation of the logarithm of a damping ratio without information
_SILENT = 1e2


@dataclass(frozen=True, eq=False, repr=False)
class ModalUncertainty(Value):
    """Relative uncertainty of frequencies and damping ratios of the elastic modes of a model.

    It is the result of ``fit.uncertainty(...)`` and an argument of ``plant.uncertain(...)``.

    Parameters
    ----------
    modes : sequence of m int
        Numbers of elastic modes, counted from 1 with rigid-body modes.
    share : (2 m,) array
        Relative half-widths of the 95 % intervals of the frequencies, then of the damping ratios.
    covariance : (2 m, 2 m) array
        Covariance of the logarithms of m frequencies and m damping ratios, in this order. It
        includes the noise of the measured poles, the uncertainty of the parameters and the model
        error. The half-widths `share` also include bias, drift and the mesh error, and they are
        quantiles of Student's distribution.
    poles : (m,) complex array [rad/s]
        Poles of the model.

    Examples
    --------
    Only mode 2 was measured. The result also contains the uncertainty of mode 3:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> fit.uncertainty(measured).modes
    (2, 3)
    """

    modes: tuple[int, ...]
    share: FloatArray
    covariance: FloatArray
    poles: ComplexArray

    @property
    def frequency(self) -> dict[int, float]:
        """Relative uncertainty of the frequency of each mode."""
        return dict(zip(self.modes, self.share.tolist(), strict=False))

    @property
    def damping(self) -> dict[int, float]:
        """Relative uncertainty of the damping ratio of each mode."""
        return dict(zip(self.modes, self.share[len(self.modes) :].tolist(), strict=True))

    @property
    def undetermined(self) -> tuple[int, ...]:
        """Modes with a frequency that is not determined (uncertainty of 100 % or more)."""
        return tuple(mode for mode, share in self.frequency.items() if share >= 1.0)

    def __repr__(self) -> str:
        m = len(self.modes)
        known = self.share[:m] < 1.0
        parts = [
            f"{name} {100 * part[known].min():.2g} to {100 * part[known].max():.2g} %"
            for name, part in (("frequency", self.share[:m]), ("damping", self.share[m:]))
            if np.any(known)
        ]
        if open_ones := self.undetermined:
            names = some_names([str(mode) for mode in open_ones])
            parts.append(f"not determined by the measurement: modes {names}")
        return f"<ModalUncertainty: {counted(m, 'mode')}, {', '.join(parts)}>"


def modal_uncertainty(fit: Any, measured: Any, mesh: MeshError | None) -> ModalUncertainty:
    """Return the relative uncertainty of modes; see `UpdateResult.uncertainty`."""
    instance(mesh, MeshError | None, "mesh", "Make it by modes.mesh_error(finer).")
    calibrated = measured is not None
    if measured is None:
        measured = fit.fitted_poles
        if measured is None:
            raise ModelError(
                "the model error is judged by measured poles, but the fit does not contain one "
                "set of poles. Pass them: fit.uncertainty(measured)."
            )
    about = [q.about(v) for q, v in zip(fit.unknowns, fit.values.tolist(), strict=True)]
    found = eigenvalue_sensitivities(fit.model, about)
    # attachment vectors represent truncated modes: no machine has their frequencies
    m = len(found.modes) - getattr(fit.model, "n_vectors", 0)
    found = found.replace(modes=found.modes[:m], poles=found.poles[:m], S=found.S[:m])
    elastic = range(found.modes[0], found.modes[-1] + 1)
    places, poles = measured_poles(measured, elastic)
    places = places + 1 - found.modes[0]
    own = found.poles[places]
    both = np.r_[places, m + places]
    S = _relative_changes(found.poles, found.S)
    # zero damping of a model or a measurement has no information
    damped = np.minimum(_damping(poles), _damping(own)) > TYPED
    said = np.r_[np.full(damped.size, True), damped]
    ratio = _damping(poles) / divisor(_damping(own))
    gap = np.r_[np.log(np.abs(poles / own)), np.log(np.where(damped, ratio, 1.0))]
    known = np.eye(said.size) * SAME**2
    if measured.covariance is not None:
        G = _relative_changes(poles, np.hstack([np.eye(poles.size), 1j * np.eye(poles.size)]))
        known += G @ measured.covariance @ G.T
    noise = np.where(np.outer(said, said), known, np.eye(said.size) * _SILENT**2)
    least = np.where(said, 0.5 * np.diag(known), 0.0)
    grown = growth(np.abs(found.poles), np.abs(poles))
    mean, covariance, dof = _conditioned(S, both, gap, noise, np.r_[grown, np.ones(m)], fit)
    # rounding of well-known values must not make a variance negative
    covariance[both, both] = np.maximum(covariance[both, both], least)
    model = found.poles
    if calibrated:
        mean[both], model = 0.0, _calibrated_poles(fit, measured, model, places)
        # a damping ratio is measured even if the model has no damping
        silent = both[~said]
        covariance[silent], covariance[:, silent] = 0.0, 0.0
        covariance[silent, silent] = np.diag(known)[~said]
    from scipy.special import stdtrit

    width = np.repeat(stdtrit(dof, 0.5 * (1 + INTERVAL)), m)
    width[both] = DEVIATIONS
    # in logarithms, so that the upper side is wider
    share = np.expm1(np.abs(mean) + width * np.sqrt(np.diag(covariance)))
    if mesh is not None:
        for mode, error in zip(mesh.modes.tolist(), mesh.error.tolist(), strict=True):
            place = mode - elastic[0]
            if mode in elastic and place not in places:
                share[place] = max(share[place], _MESH * abs(error))
    share[both] = np.maximum(share[both], np.repeat(_DRIFT, places.size))
    return ModalUncertainty(found.modes, share, covariance, model)


def _calibrated_poles(
    fit: Any, measured: Any, poles: ComplexArray, places: IntArray
) -> ComplexArray:
    """Return the poles (m,) of the calibrated model, in the order of the modes before."""
    changed = poles.copy()
    changed[places] = measured.poles
    if not hasattr(fit.model, "calibrated"):
        return changed
    # where damping couples the modes, the poles of the others move a little
    every = fit.calibrated(measured).modes().poles
    every = every[every.imag > 0]
    gap = np.abs(changed[:, None] - every)
    return np.asarray(every[assigned(gap / np.abs(changed)[:, None])])


def _conditioned(
    S: FloatArray, both: FloatArray, gap: FloatArray, noise: FloatArray, grown: FloatArray, fit: Any
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean and covariance of relative errors of all modes, given the measured ones."""
    # `d = S dp + s g (e + 1 c)` with independent e of each mode and common c, s from restricted
    # likelihood, and g the growth of errors with frequency; normal, conditioned on `gap = d +
    # noise`. The last result is the degrees of freedom of s
    m, measured = len(S) // 2, both.size // 2
    shared = np.kron(np.eye(2), np.ones((m, 1))) * grown[:, None]
    each = np.diag(grown[both])
    kinds = [
        Kind(name, np.hstack([each[:, part], shared[both][:, [i]]]), usual)
        for i, (name, usual) in enumerate(zip(("frequency", "damping"), USUAL, strict=True))
        for part in (slice(i * measured, (i + 1) * measured),)
    ]
    sizes, _ = restricted(gap, S[both], noise, kinds)
    s = np.repeat([one.deviation for one in sizes], m)
    alone = all(isinstance(one, Eigenvalues) for one in fit.residuals)
    if alone or fit.covariance is None:
        # a parameter is known to the whole of the pole that it changes most, of all modes: measured
        # ones may not depend on a parameter that others depend on
        wide = S / divisor(np.abs(S).max(axis=0))
        parameters = wide @ wide.T
    else:
        parameters = S @ fit.covariance @ S.T
    before = parameters + np.outer(s, s) * (np.diag(grown**2) + shared @ shared.T)
    factor = la.cho_factor(before[np.ix_(both, both)] + noise, lower=True)
    gain = la.cho_solve(factor, before[both]).T
    after = before - gain @ before[both]
    return gain @ gap, 0.5 * (after + after.T), np.array([one.dof for one in sizes])


def _damping(poles: ComplexArray) -> FloatArray:
    return np.asarray(-poles.real / np.abs(poles))


def _relative_changes(poles: ComplexArray, changes: ComplexArray) -> FloatArray:
    """Return relative changes (2m, q) of frequencies and of damping ratios by those of poles."""
    part = np.real(changes / poles[:, None])
    # an undamped pole has no relative damping, so that it is left out
    damped = np.where(_damping(poles) > TYPED, poles.real, np.inf)
    return np.vstack([part, changes.real / damped[:, None] - part])
