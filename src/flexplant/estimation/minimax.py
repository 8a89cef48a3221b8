"""The filter whose worst error over several machines is smallest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..arguments import members
from ..errors import AssumptionError, CertificateError, ModelError, SolverError
from ..lti.lyapunov import scale_of
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant, UncertainPlant
from ..progress import Progress, tick
from ..values import FloatArray, whole
from .error import error_variances
from .estimator_channels import same_pois
from .filter_system import filter_system, own_variances
from .kalman import design_kalman
from .machine_error import FilterPart, Gains, MachineError, filter_part, machine_error
from .robust_filter import MinimaxCertificate, RobustFilter

#: width of the smooth maximum relative to the largest value, from coarse to fine
_WIDTHS = (0.1, 0.01, 0.001)
#: the search's values and those of the errors in closed form agree to this
_AGREEMENT = 1e-6
#: step of a state's variance per innovation's, where the POIs do not say how large it may be
_PART = 0.03
#: what a bar calls the variances that are computed
STEPS = "steps of the search"


@one_thread()
def design_minimax_filter(
    plant: StandardPlant | System,
    machines: Sequence[StandardPlant],
    *,
    iterations: int = 200,
    progress: bool | None = None,
) -> RobustFilter:
    """Return the filter on one plant's matrices whose worst error over machines is smallest.

    A Kalman filter is best on its own plant; on a machine whose modes lie half a percent beside
    them its error may be twice as large. The filter keeps the matrices A, B2, C1, C2 of the plant
    and chooses both gains::

        minimise over K, L_z   max_i  mean_j  E(z_j - hat_j)^2 on machine i / sizes_j^2

    The variances follow from a Stein equation of machine and filter, ``X = F X F' + N N'``, their
    gradients from its dual, ``dJ/dF = 2 Y F X``, and a smooth maximum
    ``t log sum exp(J_i / t)`` is minimised by BFGS for three widths t, the last a thousandth of
    the worst value. The problem is not convex: the search starts at the Kalman filter and is never
    worse.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, not weighted: the nominal plant.
    machines : sequence of StandardPlant
        Sampled alike, with the same ports: `plant.uncertain(fit).sample(rng, 20)`.
    iterations : int
        At most so many for each width.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    RobustFilter
        Its certificate holds the worst value over the machines by `error_variances`, beside that
        of the Kalman filter and that of the worst machine's own Kalman filter, which no filter
        betters.

    Raises
    ------
    AssumptionError
        As `design_kalman`; or when the error of the nominal Kalman filter on a machine has no
        variance: a rigid-body motion enters it.
    ModelError, LabelError
        When there is no machine, or one has another sampling time or other channels.
    SolverError
        When no Kalman filter exists.
    CertificateError
        When the search's variances are not those of `error_variances`.

    References
    ----------
    [Geromel1999]_ (the finite set of machines); [LevineAthans1970]_ (the dual Stein equation
    for the gradient).

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.estimation.design_minimax_filter(plant, [plant], iterations=20)
    >>> bool(abs(found.rms("die") / fx.design_kalman(plant).rms("die") - 1) < 1e-3)
    True
    """
    steps = whole(iterations, "iterations")
    kalman = design_kalman(plant, larger=plant)  # type: ignore[arg-type]
    plant, model = kalman.plant, kalman.model
    sizes = np.sqrt(kalman.variances)
    others = _checked(plant, machines)
    start = Gains(kalman.predictor_gain, model.C1 @ kalman.gain)
    P = kalman.predicted_covariance
    scale, unit = scale_of(P.diagonal()), np.sqrt(sizes.size) * sizes[:, None]

    def part(gains: Gains) -> FilterPart:
        return filter_part(model, gains, scale, unit)

    errors = [machine_error(plant, model, other, start, scale, unit) for other in others]
    spread = kalman.covariance.diagonal() / scale**2
    units = _Units.of(part(start).sight, model.innovation(P), spread, (scale, unit))
    with Progress(None, STEPS, progress=progress):
        found, slope = _searched(errors, part, units, start, steps)
    values = np.array([error.value(part(found)) for error in errors])
    system = filter_system(plant, model, found.K, found.L_z, "minimax_filter")
    truth = _means(others, system, sizes)
    difference = float(np.max(np.abs(values - truth) / truth))
    if not difference <= _AGREEMENT:
        raise CertificateError(
            f"the variances of the search and those of the filter in closed form differ by "
            f"{difference:.1e} (allowed {_AGREEMENT:.0e}). The filter cannot be trusted."
        )
    certificate = MinimaxCertificate(
        float(truth.max()),
        float(_means(others, kalman.system, sizes).max()),
        max(_best(other, sizes) for other in others),
        difference,
        slope,
    )
    return RobustFilter(
        system,
        plant,
        found.K,
        found.L_z,
        sizes,
        own_variances(model, found.K, found.L_z),
        certificate,
    )


def _checked(plant: StandardPlant, machines: Sequence[StandardPlant]) -> list[StandardPlant]:
    """Return the machines as plants with the sensors and POIs of the nominal one."""
    if isinstance(machines, UncertainPlant):
        raise ModelError(
            "machines are sampled plants, got an UncertainPlant: draw them from it, "
            "uncertain.sample(rng, 20), so that it is known which ones the worst case is of."
        )
    listed = members(
        machines, StandardPlant, "machines", "Pass plant.uncertain(fit).sample(rng, 20)."
    )
    return [same_pois(plant, other) for other in listed]


def _means(machines: Sequence[StandardPlant], system: StateSpace, sizes: FloatArray) -> FloatArray:
    """Return the mean relative variance of a filter on each machine."""
    found = [error_variances(machine, system).values for machine in machines]
    return np.asarray(np.mean(np.array(found) / sizes**2, axis=1))


def _best(machine: StandardPlant, sizes: FloatArray) -> float:
    """Return the mean relative variance of a machine's own Kalman filter."""
    return float(np.mean(design_kalman(machine, larger=machine).variances / sizes**2))


class _Units(NamedTuple):
    """Changes of K and L_z are ``left x right``: at the Kalman filter J has the Hessian 2 I.

    There ``J(K) = J + tr(Y dK S dK')``, S the covariance of the innovation and Y the Gramian of
    the error from states to POIs; in other units the search takes a thousand steps.
    """

    states: FloatArray
    right: FloatArray

    scale: FloatArray
    unit: FloatArray

    @classmethod
    def of(
        cls, Y: FloatArray, innovation: FloatArray, spread: FloatArray, into: tuple[FloatArray, ...]
    ) -> _Units:
        """Return the units from Y and variances of states; `into` scales states and POIs."""
        # what the POIs hardly see moves by a part of its deviation for an innovation of one
        values, vectors = np.linalg.eigh(Y + np.diag(1.0 / (_PART * np.maximum(spread, 1e-12))))
        states = vectors / np.sqrt(values)
        size = np.sqrt(innovation.diagonal())
        values, vectors = np.linalg.eigh(innovation / size / size[:, None])
        return cls(states, (vectors / np.sqrt(values)).T / size, *into)

    def change(self, x: FloatArray) -> Gains:
        """Return the change of the gains for a vector (n ny + nz ny,)."""
        n, ny = len(self.states), len(self.right)
        K, L = x[: n * ny].reshape(n, ny), x[n * ny :].reshape(-1, ny)
        return Gains(
            self.scale[:, None] * (self.states @ K @ self.right), self.unit * (L @ self.right)
        )

    def slope(self, rate: Gains) -> FloatArray:
        """Return the derivatives to that vector from those to gains in scaled states."""
        both = self.states.T @ rate.K @ self.right.T, rate.L_z @ self.right.T
        return np.concatenate([one.reshape(-1) for one in both])


def _searched(
    errors: Sequence[MachineError],
    part: Callable[[Gains], FilterPart],
    units: _Units,
    start: Gains,
    steps: int,
) -> tuple[Gains, float]:
    """Return the best gains that were found, and the relative slope there."""
    from scipy.optimize import minimize

    best: list[tuple[float, Gains]] = []

    def smooth(x: FloatArray, width: float) -> tuple[float, FloatArray]:
        tick(STEPS)
        change = units.change(x)
        at = Gains(start.K + change.K, start.L_z + change.L_z)
        try:
            shared = part(at)
            found = [error.value_and_slopes(shared) for error in errors]
        except SolverError:  # the filter is not stable
            return np.inf, np.zeros(x.size)
        values = np.array([value for value, _ in found])
        weight = np.exp((values - values.max()) / width)
        if not best or values.max() < best[0][0]:
            best[:] = [(float(values.max()), at)]
        shares = zip(weight / weight.sum(), found, strict=True)
        slope = np.sum([share * units.slope(rate) for share, (_, rate) in shares], axis=0)
        return float(values.max() + width * np.log(weight.sum())), slope

    def relative(x: FloatArray, width: float, scale: float) -> tuple[float, FloatArray]:
        value, slope = smooth(x, width * scale)
        return value / scale, slope / scale

    x = np.zeros(start.K.size + start.L_z.size)
    if not np.isfinite(smooth(x, 1.0)[0]):
        raise AssumptionError(
            "the Kalman filter of the nominal plant is not stable to working precision, so the "
            "search has no start."
        )
    steepness = 0.0
    for width in _WIDTHS:
        scale = best[0][0]

        with np.errstate(all="ignore"):
            result = minimize(
                relative,
                x,
                args=(width, scale),
                jac=True,
                method="BFGS",
                options={"maxiter": steps, "gtol": 1e-5},
            )
        x = result.x
        steepness = float(np.linalg.norm(result.jac))
    return best[0][1], steepness
