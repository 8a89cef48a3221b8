"""The result of an update: parameters, their covariance, and the updated model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import MOST_DRAWS, ComplexArray, FloatArray, Rng, between, generator, positive, whole
from ..errors import ModelError, attempted, counted, require_known, short, warn, with_deviation
from ..identification import MeasuredModes
from ..modes import MeshError, Modes, solve_modes
from ..modes.matching import ALIKE, CLUSTER, in_span
from ..sparse.factor import DENSE_LIMIT
from ..store import Value
from ..tolerances import INTERVAL
from .discrepancy import USUAL_DOF, Discrepancy, ModalUncertainty, modal_uncertainty
from .family import changed_model
from .machines import COUNT, Machines, Trend, trend_of
from .parameters import AddedMass, Parameter
from .residuals.residual import Eigenvalues, Residual
from .search.objective import chance, is_bad


@dataclass(frozen=True, eq=False, repr=False)
class History(Value):
    """The iterations of an update, the start first.

    Parameters
    ----------
    parameters : (i + 1, q) array [kg, N s/m, N/m]
        Values of the parameters.
    eigenvalues : (i + 1, m) complex array [rad/s]
        The model's eigenvalues, paired with the measured ones.
    error : (i + 1,) array
        Error ``e_i`` of equation (12) in the paper, if only eigenvalues are fitted. With other
        residuals it is the sum of squares of the whitened residuals (divided by the standard
        deviation of their noise), without priors.
    fraction : (i + 1,) array
        Fraction of the Gauss-Newton step that was taken. It is 1 unless the step was halved, and 0
        for the start.

    Examples
    --------
    One full step lowers the error from 4 to 0.1:

    >>> import numpy as np
    >>> steps, poles = np.array([[0.0], [0.2]]), np.array([[600j], [580j]])
    >>> History(steps, poles, error=np.array([4.0, 0.1]), fraction=np.array([0.0, 1.0]))
    <History: 1 step (0 shortened), error 4 -> 0.1>
    """

    parameters: FloatArray
    eigenvalues: ComplexArray
    error: FloatArray
    fraction: FloatArray

    def __len__(self) -> int:
        return int(self.error.size) - 1

    def __repr__(self) -> str:
        halved = int(np.sum(self.fraction[1:] < 1))
        return (
            f"<History: {counted(len(self), 'step')} ({halved} shortened), "
            f"error {self.error[0]:.3g} -> {self.error[-1]:.3g}>"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Starts(Value):
    """Results of an update from several starting points.

    Parameters
    ----------
    begin, end : (s, q) array
        Parameters at the start and at the end, NaN where a search failed.
    cost : (s,) array
        Half the sum of squares at the end, infinite where a search failed.
    reason : sequence of s str
        Reason why each search ended or failed. It names all methods that were tried.
    minima : (r, q) array
        Parameters at the minima other than the best one, in the order of increasing cost.
    above : (r,) array
        Increase of ``-2 ln(likelihood)`` at each of these minima relative to the best one. It is
        the difference of chi-square if noise explains the residual, otherwise
        ``n ln(cost / least cost)`` for n residuals. It is negative if a minimum has a lower cost
        than the best one but the FEModel refuses it, for example because of a negative damper.

    Examples
    --------
    One of two searches failed:

    >>> import numpy as np
    >>> Starts(np.zeros((2, 1)), np.array([[0.1], [np.nan]]), cost=np.array([1.0, np.inf]))
    <Starts: 1 of 2 at the least cost 1, 1 failed>
    """

    begin: FloatArray
    end: FloatArray
    cost: FloatArray
    reason: tuple[str, ...] = ()
    minima: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    above: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def rivals(self) -> list[tuple[FloatArray, float]]:
        """Other minima that the data hardly distinguish from the best, with their `above`.

        A minimum is included if noise alone could cause its value of `above` with a probability of
        at least 1e-3, by the chi-square distribution with one degree of freedom.
        """
        return [
            (p, float(more))
            for p, more in zip(self.minima, self.above, strict=True)
            if not is_bad(chance(more, 1))
        ]

    def __len__(self) -> int:
        return int(self.cost.size)

    def __repr__(self) -> str:
        best = float(np.min(self.cost))
        # minima that only differ by the end of the search
        same = int(np.sum(self.cost <= best + 1e-6 * max(abs(best), 1e-12)))
        failed = int(np.sum(~np.isfinite(self.cost)))
        return f"<Starts: {same} of {self.cost.size} at the least cost {best:.3g}, {failed} failed>"


@dataclass(frozen=True, eq=False, repr=False)
class UpdateResult(Value):
    """Result of `update`: parameters, their covariance and the updated model.

    Parameters
    ----------
    parameters : sequence of q str
        Names of the parameters.
    units : sequence of q str
        Units of the parameters.
    values : (q,) array
        Values of the parameters.
    covariance : (q, q) array or None
        Covariance of the estimate. For m poles it is computed from their derivatives S with respect
        to the parameters, written as real numbers ``J = [Re S; Im S]``, and from their weights W.
        If the covariance C of the measurement is known, the result is ``G C G^T``. The matrix
        ``G = (J^T W J)^-1 J^T W`` converts errors of the poles into errors of the parameters. If C
        is not known, the result is ``s^2 (J^T W J)^-1``. The residual variance
        ``s^2 = e / (2 m - q)``, with the weighted sum of squares e, then includes the model error.
        If C is known for some residuals only, s^2 is the variance of the others. If the residual
        exceeds noise (`p_value` below 1e-3), C includes the model error (see `discrepancy`). If
        responses are fitted, C is multiplied by ``chi2 / dof`` instead. None: the data do not
        determine all parameters, the result depends on the start values, or ``2 m = q``, so that
        s^2 is not known.
    correlation : (q, q) array
        Correlation matrix of the estimate. It follows from `covariance` if the noise of all
        residuals is known. Otherwise it is computed for errors with the covariance W^-1.
    model : ReducedModel or FEModel
        Updated model of the same type, with changed M, D and K.
    history : History
        Parameters, eigenvalues and error in each iteration.
    converged : bool
        Whether a tolerance was met and the data determine all parameters.
    reason : str
        Reason why the iteration ended.
    at_bound : sequence of str
        Names of the parameters that ended at one of their bounds, because the data suggest a value
        beyond it. The covariance does not take these bounds into account.
    starts : Starts or None
        Results of all starts, including other minima.
    unknowns : sequence of Parameter
        Estimated parameters, as given to `update`.
    chi2 : float or None
        Smallest sum of squares of the residuals (and priors), each divided by the standard
        deviation of its noise. It is about `dof` if the model explains the measurement. Only
        residuals with known noise count. Where responses have correlated errors, or a variance
        that was estimated from few runs, the sum and `dof` are multiplied by the same factor. Mean
        and variance are then those of chi-square with `dof` degrees of freedom. None: all noise is
        unknown.
    dof : int
        Degrees of freedom: number of residuals and priors that count in `chi2`, minus the number of
        parameters that they determine. Parameters at a bound are not subtracted.
    rounds : (r, q) array or None
        Estimate with the reduced model alone, and estimate after each round of defect correction.
        Defect correction removes the error of the reduction; see `update`.
    residuals : sequence of Residual
        Fitted residuals.
    discrepancy : sequence of Discrepancy
        Model error in each kind of residual, in addition to noise. Empty: noise explains the
        residual.
    determined : sequence of str or None
        None if the data determine all parameters. Otherwise a text for each combination of
        parameters that the data determine to first order. Other combinations have no meaning.
    prior_std : (q,) array or None
        Standard deviations of the used priors, infinite for a parameter without a prior. None: no
        prior was used.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray | None
    correlation: FloatArray
    model: Any
    history: History
    converged: bool
    reason: str
    at_bound: tuple[str, ...] = ()
    starts: Starts | None = None
    unknowns: tuple[Parameter, ...] = ()
    chi2: float | None = None
    dof: int = 0
    rounds: FloatArray | None = None
    residuals: tuple[Residual, ...] = ()
    discrepancy: tuple[Discrepancy, ...] = ()
    determined: tuple[str, ...] | None = None
    prior_std: FloatArray | None = None

    def __getitem__(self, name: str) -> float:
        require_known("parameter", [name], self.parameters)
        return float(self.values[self.parameters.index(name)])

    @property
    def std(self) -> FloatArray | None:
        """Standard deviations (q,) of the estimate, None when the covariance is not known."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    @property
    def p_value(self) -> float | None:
        """Probability that noise alone causes a larger `chi2`, None if it is not known.

        If it is below 1e-3, the model has another error, or the stated noise is too small. Of
        responses whose variances come from fewer than ten runs it is too small: with four runs of a
        true model it is below 1e-3 in four of a thousand fits.
        """
        return chance(self.chi2, self.dof)

    @property
    def fitted_poles(self) -> MeasuredModes | None:
        """The measured poles that were fitted. None if no set or several sets were fitted."""
        found = [r.measured for r in self.residuals if isinstance(r, Eigenvalues)]
        return found[0] if len(found) == 1 else None

    @property
    def discrepancy_text(self) -> str:
        """Text that describes the model error in each kind of residual (see `discrepancy`)."""
        return ", ".join(f"{d.deviation:.2g} of {d.kind}" for d in self.discrepancy)

    @property
    def negative_masses(self) -> tuple[str, ...]:
        """Names of added masses that are negative by more than two standard deviations.

        If no mass was removed from the machine, either the model is too heavy at this place, or the
        change is at another place.
        """
        margin = np.zeros(self.values.size) if self.std is None else 2 * self.std
        return tuple(
            q.name
            for q, value, deviation in zip(self.unknowns, self.values, margin, strict=False)
            if isinstance(q, AddedMass) and value < -deviation
        )

    def __repr__(self) -> str:
        def said(values: Sequence[str]) -> list[str]:
            named = zip(self.parameters[:5], values, self.units, strict=False)
            return [f"{name} = {value} {unit}".rstrip() for name, value, unit in named]

        deviations = self._printed_deviations()
        values = list(map(with_deviation, self.values.tolist(), deviations))
        lines = [f"  {line}" for line in said(values)]
        if len(self.parameters) > 5:
            lines.append(f"  ... and {len(self.parameters) - 5} more")
        if self.at_bound:
            lines.append(f"  at a bound: {', '.join(self.at_bound[:5])}")
        unused = [q.name for q in self.unknowns if q.prior is not None]
        if unused and self.prior_std is None:
            lines.append(f"  unused priors: {', '.join(unused[:5])}")
        if self.determined is not None:
            lines.append(f"  determined only: {'; '.join(self.determined) or 'nothing':.200}")
        lines += self._trend_lines
        if self.negative_masses:
            lines.append(f"  negative: {', '.join(self.negative_masses[:5])}")
        rivals = [] if self.starts is None else self.starts.rivals
        for p, more in rivals[:2]:
            other = ", ".join(said([f"{v:.4g}" for v in p]))
            # a better minimum is the result, unless it takes the poles for those of other modes
            kind, sign = ("OTHER MODE NUMBERS", "-") if more < 0 else ("ANOTHER MINIMUM", "+")
            lines.append(f"  {kind}, chi2 {sign} {abs(more):.3g}: {other}")
        if self.discrepancy:
            off = f"{self.discrepancy_text} (relative)"
            lines.append(f"  model error in addition to noise: {off}; the +- include it")
        elif is_bad(self.p_value):
            lines.append("  no +-: the residual is coherent and not noise")
        ended = "converged" if self.converged else "NOT CONVERGED"
        head = f"<UpdateResult: {ended} in {counted(len(self.history), 'step')} ({self.reason})"
        if self.p_value is not None:
            head += f", chi2 {self.chi2:.4g} for {self.dof} dof"
        return "\n".join([head, *lines]) + ">"

    @cached_property
    def _trend_lines(self) -> list[str]:
        """Text on the trend of the fitted frequencies, and pairs that may be swapped."""
        model = self.model
        if self.fitted_poles is None or not (hasattr(model, "T") or model.n_dof <= DENSE_LIMIT):
            return []
        found = None
        with attempted("the trend of the residual", ModelError):
            found = self.trend()
        lines = [] if found is None or found.dof < 1 or not found.missing else [found.missing]
        lines += self.unlike_shapes()[:3]
        return [f"  {line}" for line in lines]

    def unlike_shapes(self, measured: MeasuredModes | None = None) -> list[str]:
        """Return a sentence for each measured shape that differs from the updated model's."""
        return [
            f"mode {mode} has another shape than measured (MAC {mac:.2f}): what is promised of it "
            "does not hold"
            for mode, mac in self.likeness(measured).items()
            if mac < ALIKE
        ]

    def likeness(self, measured: MeasuredModes | None = None) -> dict[int, float]:
        """Return the MAC of each measured shape with that of the updated model.

        Modes whose frequencies differ by at most 2 % mix differently in each machine. If several
        such modes were measured, a measured shape is compared with all combinations of their shapes
        in the model. The result is then the fraction of the measured shape that these explain.

        Parameters
        ----------
        measured : MeasuredModes, optional
            Measured modes with shapes, as returned by ``numbered(..., at=...)``. None: the fitted
            poles.

        Returns
        -------
        dict {mode: float}
            MAC by mode number. It is empty if no shapes were measured at known points.
        """
        given = self.fitted_poles if measured is None else measured
        if given is None or given.shapes is None or given.xyz is None:
            return {}
        modes, numbers = self.modes(), given.modes or ()
        own = np.isin(np.arange(modes.n_modes) + 1, numbers)
        points = zip(given.xyz.tolist(), given.directions or (), strict=True)
        rows = np.array([modes.at(tuple(at), direction) for at, direction in points])
        found = {}
        for k, mode in enumerate(numbers):
            near = np.abs(modes.omega / modes.omega[mode - 1] - 1.0) <= CLUSTER
            found[mode] = float(in_span(rows[:, near & own], given.shapes[:, [k]])[0])
        return found

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence (credible) intervals (q, 2) of the parameters for a level in 0 .. 1.

        The intervals follow the normal distribution. If the discrepancy was estimated, they follow
        Student's distribution. The data of each kind of residual give a number of degrees of
        freedom, and the smallest number is used, minus one. One is subtracted because the data
        cannot show an error that is common to all modes. A ModelError is raised if the covariance
        is not known.
        """
        from scipy.special import ndtri

        share = between(level, "level", 0.0, 1.0, "Choose 0.95, say.")
        half = float(ndtri((1 + share) / 2)) * self._wider_std(share)
        return np.column_stack([self.values - half, self.values + half])

    def widened(self, factor: float) -> FloatArray:
        """Return the covariance (q, q) if the covariance of the data is multiplied by a factor.

        The covariance of the priors is not multiplied, so that the result for a parameter is never
        larger than its prior. A ModelError is raised if the covariance is not known.
        """
        std, factor = self._known_std(), positive(factor, "factor")
        wide: FloatArray = np.asarray(self.covariance) * factor
        if self.prior_std is not None:
            # information adds up: that of the priors is not divided by the factor
            size = np.outer(std, std)
            held = np.diag((std / self.prior_std) ** 2)
            told = np.linalg.inv(np.asarray(self.covariance) / size) - held
            wide = np.linalg.inv(held + told / factor) * size
        return wide

    def _wider_std(self, share: float) -> FloatArray:
        """Return deviations that give a probability of each distribution by normal quantiles."""
        from scipy.special import ndtri

        ratio = self._quantile(share) / float(ndtri((1 + share) / 2))
        return np.sqrt(np.diag(self.widened(ratio**2)))

    def _quantile(self, share: float) -> float:
        """Return the number of standard deviations for a probability of a parameter."""
        from scipy.special import ndtri, stdtrit

        if not self.discrepancy:
            return float(ndtri((1 + share) / 2))
        least = max(min(d.dof for d in self.discrepancy) - USUAL_DOF - 1, 1.0)
        return float(stdtrit(least, (1 + share) / 2))

    def _printed_deviations(self) -> list[float | None]:
        """Return deviations of which two contain 95 % of machines, None if not known."""
        # for responses that a model does not explain, the misfit is coherent over lines
        std, rejected = self.std, is_bad(self.p_value)
        if std is None or (rejected and not self.discrepancy):
            return [None] * len(self.parameters)
        return list((self._wider_std(INTERVAL) if rejected else std).tolist())

    def sample(self, count: int, *, rng: Rng = 0) -> FloatArray:
        """Return random draws (count, q) of the parameters, from a generator or seed `rng`.

        They are normally distributed with the mean `values` and the `covariance` (Laplace's
        approximation of the posterior). A ModelError is raised if the covariance is not known.
        """
        std = self._known_std()
        white = generator(rng).standard_normal(
            (whole(count, "count", maximum=MOST_DRAWS), std.size)
        )
        values, vectors = np.linalg.eigh(np.asarray(self.covariance) / np.outer(std, std))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(self.values + (white @ root.T) * std, dtype=np.float64)

    def _known_std(self) -> FloatArray:
        std = self.std
        if std is None:
            raise ModelError(
                "the covariance of this update is not known: give the measurement's noise "
                "(covariance=, std=, variance=) or more data than parameters."
            )
        return std

    def applied_to(self, model: Any) -> Any:
        """Return another model of the same structure, such as the full FEModel, with the update.

        The given model must not be updated yet. The estimated values of the parameters change its
        M, D and K. Damping that is not part of the model, as in ``solve_modes(model, damping=)``,
        is not included. Add it first, by
        ``fit.applied_to(model.with_damping(ModalDamping(0.01)))``.

        Parameters
        ----------
        model : FEModel or ReducedModel
            Model whose DOFs contain the places of the parameters. The result has the same type, and
            a sparse model remains sparse.

        Raises
        ------
        ModelError, LabelError, ShapeError
            When the argument is not a model, its matrices become indefinite, it does not have the
            place of a parameter, or the matrices of a parameter have another number of DOFs.
        """
        if not hasattr(model, "rigid_body") or not hasattr(model, "dofs"):
            raise ModelError(
                f"applied_to needs an FEModel or a ReducedModel, got {short(model)}. Pass the "
                "model the reduced one was made from."
            )
        if not self.unknowns:
            raise ModelError("this result does not hold its parameters: run update() once more.")
        changed = zip(self.unknowns, self.values, strict=True)
        if getattr(model, "D", None) is None and any(
            q.matrices(model)[1] is not None and value for q, value in changed
        ):
            warn(
                "the model has no D: the D of the updated model would contain only the parameters "
                "of the update, and solve_modes(..., damping=) would replace it. Apply the update "
                "to a model with damping, for example model.with_damping(ModalDamping(0.01))."
            )
        return changed_model(model, self.unknowns, self.values)

    def calibrated(self, measured: Any) -> Any:
        """Return the updated reduced model with the measured poles of some modes.

        The measured poles replace those of the updated model. Shapes, motions of points of interest
        and unmeasured modes stay those of the updated model. If the model is an FEModel, a
        ModelError is raised. Use ``fit.modes().calibrated(measured)`` instead.

        Parameters
        ----------
        measured : MeasuredModes
            Measured poles with mode numbers.
        """
        if not hasattr(self.model, "calibrated"):
            raise ModelError(
                "calibrated needs a reduced model, as intervals of results do: update "
                "fx.reduce(modes, fx.DesiredDofs(labels)), with the damping in its modes. Without "
                "intervals: fit.modes(count=...).calibrated(measured)."
            )
        found = self.model.calibrated(measured)
        return found.replace(machines=self.machines(measured)) if self.unknowns else found

    def machines(self, measured: MeasuredModes, *, count: int = COUNT, seed: int = 0) -> Machines:
        """Return the uncertainty of the machine as draws of whole machines; see `Machines`.

        Parameters
        ----------
        measured : MeasuredModes
            All measured modes, with the mode numbers of the updated model, and with their shapes if
            they were measured.
        count : int
            Number of machines that are drawn for an interval.
        seed : int
            Seed of the draws.
        """
        return Machines(self, measured, count, seed)

    def trend(self, measured: MeasuredModes | None = None) -> Trend:
        """Return a test for neglected effects that grow with frequency; see `Trend`.

        Parameters
        ----------
        measured : MeasuredModes, optional
            Measured modes with numbers. None: the fitted poles.
        """
        poles = self.fitted_poles if measured is None else measured
        if poles is None:
            raise ModelError(
                "the fit was not made from one set of measured poles. Pass them: "
                "fit.trend(measured)."
            )
        return trend_of(self, poles)

    def uncertainty(
        self, measured: Any = None, *, mesh: MeshError | None = None
    ) -> ModalUncertainty:
        """Return the uncertainty of frequencies and damping of modes, and their covariance.

        The relative error of a mode is ``S dp + s (e + c)``. Here dp is the error of the parameters
        with the sensitivities S, e is an error of each mode, and c is an error common to all modes.
        The standard deviation s is estimated from the residual of the measured modes by restricted
        maximum likelihood, separately for frequencies and damping ratios. If few modes were
        measured, it is near 0.25 % for frequencies and 15 % for damping ratios. The covariance of
        the modes takes into account that the measured poles are known.

        Parameters
        ----------
        measured : MeasuredModes, optional
            Modes with which the model is calibrated. The result then holds for
            ``fit.calibrated(measured)``. The uncertainty of a measured mode is two standard
            deviations of its pole, but at least 0.1 % (at least 2 % for the damping ratio). None:
            the result holds for `model` and uses the fitted poles. The error of a measured mode is
            then the residual of the update.
        mesh : MeshError, optional
            Result of ``modes.mesh_error(finer)``. The uncertainty of modes that were not measured
            includes 1.5 times this error.

        Raises
        ------
        ModelError, LabelError
            When `measured` has no mode numbers, or a number is not that of an elastic mode of the
            model. Also when `measured` is not given and no poles were fitted.

        References
        ----------
        [PattersonThompson1971]_, [KennedyOHagan2001]_.
        """
        return modal_uncertainty(self, measured, mesh)

    def modes(self, *, count: int | None = None) -> Modes:
        """Return the modes of the updated model on all DOFs of the structure.

        Mode shapes phi_k of a reduced model are expanded to all DOFs by ``phi_n = T phi_k``, with
        the reduction matrix T (equations (7) and (4) of the paper).

        Parameters
        ----------
        count : int, optional
            Number of modes, rigid-body modes included. None: all modes. An FEModel of more than
            1500 DOFs needs a count.

        Raises
        ------
        ModelError
            When dampers to the ground damp the rigid-body modes, or the count is not valid.
        """
        if not hasattr(self.model, "T"):
            return solve_modes(self.model, count=count)
        reduced: Modes = self.model.modes()
        if count is not None:
            reduced = reduced.select(range(whole(count, "count", maximum=reduced.n_modes)))
        if not self.model.is_physical:
            return reduced  # generalised coordinates: the shapes are already expanded
        return reduced.replace(phi=self.model.T @ reduced.phi, dofs=self.model.full_dofs)
