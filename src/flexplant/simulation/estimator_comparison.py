"""Several estimators of one POI side by side: what each predicts, and what a machine has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..checks import FloatArray, Value, instance, short
from ..errors import LabelError, ModelError, require_known, unknown_label
from ..estimation import KalmanEstimator, StaticEstimator
from ..estimation.estimator_channels import estimates, poi_channels, row_of
from ..lti.statespace import StateSpace
from .response import Response

Estimator = KalmanEstimator | StaticEstimator


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorComparison(Value):
    """Predicted and measured rms errors of several estimators; prints as a table.

    Parameters
    ----------
    channel : str
        The motion that is estimated.
    names : sequence of str
        Of the estimators.
    errors : (n, 4) array [m or rad]
        Predicted, measured, and the ends of the confidence interval of what was measured.
    level : float
        Of the interval.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> designs = {"static": fx.design_static(plant)}
    >>> servo = fx.design_servo(plant, bandwidth=10.0, observer=designs["static"])
    >>> loop = fx.close_loop(plant, designs["static"], servo, *fx.reading_along(designs))
    >>> run = fx.simulate(loop, duration=0.5, rng=1, runs=5)
    >>> fx.compare_estimators(designs, run, "die:x", start=0.2).names
    ('static',)
    """

    channel: str
    names: tuple[str, ...]
    errors: FloatArray
    level: float

    def __getitem__(self, name: str) -> FloatArray:
        require_known("estimator", [name], self.names)
        found: FloatArray = self.errors[self.names.index(name)]
        return found

    def __repr__(self) -> str:
        turning = self.channel.rpartition(":")[2].startswith("r")
        unit = "nrad" if turning else "nm"
        width = max(map(len, self.names)) + 2
        lines = [f"rms error of the estimate of {self.channel} [{unit}]"]
        lines.append(f"{'':{width}s}{'predicted':>10s}{'measured':>10s}  {self.level:.0%} interval")
        for name, (predicted, measured, low, high) in zip(
            self.names, 1e9 * self.errors, strict=True
        ):
            lines.append(
                f"{name:{width}s}{predicted:10.3f}{measured:10.3f}  {low:.3f} to {high:.3f}"
            )
        return "\n".join(lines)


def reading_along(designs: Mapping[str, Estimator]) -> tuple[StateSpace, ...]:
    """Return estimators as blocks of a loop that receive its signals and drive nothing.

    Parameters
    ----------
    designs : mapping {name: KalmanEstimator or StaticEstimator}
        Each estimate gets the name of its design in front: `updated|die:hat`.

    Returns
    -------
    tuple of StateSpace
        For `close_loop` or `simulate`, beside the blocks that control.

    Raises
    ------
    ModelError
        When there is no mapping of estimators.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> designs = {"static": fx.design_static(plant), "filter": fx.design_kalman(plant)}
    >>> [output for block in fx.reading_along(designs) for output in block.outputs]
    ['static|die:hat', 'filter|die:hat']
    """
    _check_estimators(designs)
    return tuple(
        design.system.renamed(outputs={hat: f"{name}|{hat}" for hat in design.system.outputs})
        for name, design in designs.items()
    )


def compare_estimators(
    designs: Mapping[str, Estimator],
    run: Response,
    channel: str,
    *,
    start: float = 0.0,
    level: float = 0.95,
) -> EstimatorComparison:
    """Return the errors that estimators predict beside those measured in runs of a machine.

    Parameters
    ----------
    designs : mapping {name: KalmanEstimator or StaticEstimator}
        As given to `reading_along`.
    run : Response
        Several runs of a loop in which they read along, with the POI's motion.
    channel : str
        The motion at the POI, `die:z`.
    start : float [s]
        Samples before this time are left out: transients.
    level : float
        Of the confidence intervals (`Response.rms_interval`).

    Raises
    ------
    ModelError
        When there is no mapping of estimators, or there is only one run.
    LabelError
        When the run lacks the motion or an estimate of it.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> designs = {"static": fx.design_static(plant), "filter": fx.design_kalman(plant)}
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=designs["filter"])
    >>> loop = fx.close_loop(plant, designs["filter"], servo, *fx.reading_along(designs))
    >>> run = fx.simulate(loop, duration=0.5, rng=1, runs=5)
    >>> found = fx.compare_estimators(designs, run, "die:x", start=0.2)
    >>> bool(found["filter"][1] < found["static"][1])  # measured
    True
    """
    _check_estimators(designs)
    instance(run, Response, "run", "Pass what simulate returned.")
    rows = []
    for name, design in designs.items():
        channels = poi_channels(design.plant)
        hat = f"{name}|{estimates(channels)[row_of(channels, channel)]}"
        for wanted in (channel, hat):
            if wanted not in run:
                raise LabelError(
                    f"{unknown_label('channel', wanted, list(run))} Estimators read along in a "
                    "loop as blocks: close_loop(plant, *blocks, *reading_along(designs))."
                )
        error = run[channel] - run[hat]
        seen = run.replace(data=error[..., None, :], names=["error"], units={})
        rows.append((design.rms(channel), *seen.rms_interval("error", start=start, level=level)))
    return EstimatorComparison(channel, tuple(designs), np.array(rows), level)


def _check_estimators(designs: Mapping[str, Estimator]) -> None:
    if not isinstance(designs, Mapping) or not designs:
        raise ModelError(
            f"need a mapping of names to estimators, got {short(designs)}. Type "
            "{'updated': design_kalman(plant)}."
        )
    wrong = [found for found in designs.values() if not isinstance(found, Estimator)]
    if wrong:
        raise ModelError(
            f"need estimators, got {short(wrong[0])}. Use design_kalman or design_static."
        )
