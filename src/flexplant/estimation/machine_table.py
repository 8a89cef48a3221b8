"""Estimators on machines that are not their model: a table of their errors."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Value, in_unit, instance, members, short
from ..errors import AssumptionError, FlexplantWarning, ModelError, counted, require_known
from ..loop import close_loop
from ..plant import StandardPlant
from .error import loop_variances
from .estimator_channels import poi_channels, row_of


@dataclass(frozen=True, eq=False, repr=False)
class MachineTable(Value):
    """The rms error of estimators of one POI motion on several machines; prints as a table.

    Parameters
    ----------
    channel : str
        The motion.
    names : sequence of str
        The estimators.
    nominal : (k,) array [m or rad]
        Each on its own model, as the machines run: in a closed loop where they are in one.
    values : (k, n) array
        On each machine; infinite where the closed loop is unstable.
    unit : str
        Of the motion.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> estimators = {"filter": fx.design_kalman(plant)}
    >>> table = fx.estimation.errors_on_machines(estimators, [plant], "die")
    >>> bool(abs(table.values[0, 0] / estimators["filter"].rms("die") - 1) < 1e-9)
    True
    """

    channel: str
    names: Sequence[str]
    nominal: FloatArray
    values: FloatArray
    unit: str = ""

    def __getitem__(self, name: str) -> FloatArray:
        """Return the rms errors (n,) of one estimator."""
        require_known("estimator", [name], self.names)
        return np.asarray(self.values[list(self.names).index(name)])

    def __repr__(self) -> str:
        finite = self.nominal[np.isfinite(self.nominal)]
        factor, unit = in_unit(float(np.max(finite, initial=0.0)), self.unit)
        width = max(10, *(len(name) for name in self.names)) + 2
        heads = ("own model", "median", "95 %", "worst", "worst / own")
        title = f"rms error of {self.channel} [{unit or '?'}]"
        lines = [
            f"{title} on {counted(self.values.shape[1], 'machine')}",
            " " * width + "".join(f"{head:>13s}" for head in heads),
        ]
        for name, own, row in zip(self.names, self.nominal, self.values, strict=True):
            ordered = np.sort(row)
            cells = [own, np.median(row), ordered[int(np.ceil(0.95 * row.size)) - 1], ordered[-1]]
            text = "".join(f"{value / factor:13.4g}" for value in cells)
            lines.append(f"{name:{width}s}{text}{ordered[-1] / own:13.3g}")
            if unstable := int(np.count_nonzero(np.isinf(row))):
                lines.append(f"{'':{width}s}the loop is unstable on {unstable} of them")
        return "\n".join(lines)


def errors_on_machines(
    estimators: Mapping[str, Any] | Any,
    machines: Sequence[StandardPlant],
    channel: str,
    *,
    blocks: Sequence[Any] = (),
) -> MachineTable:
    """Return the rms errors of estimators on machines that differ from their model.

    In closed form. A filter that trusts its model doubles its error when frequencies of light modes
    are half a percent off; how much is lost on the machines that a fit allows is what this says.

    Parameters
    ----------
    estimators : KalmanEstimator, StaticEstimator or RobustFilter, or mapping {name: estimator}
        All of the same POIs.
    machines : sequence of StandardPlant
        Sampled alike: `plant.uncertain(fit).sample(rng, 20)`.
    channel : str
        A POI's motion.
    blocks : sequence of Controller or StateSpace
        Controllers that close the loop on the estimates (or on y): each estimator runs in
        `close_loop(machine, estimator, *blocks)`. None: u is at rest.

    Raises
    ------
    ModelError
        When there are no estimators or machines, or they are no such values.
    LabelError
        When the motion is none of a POI, or a machine lacks a channel.
    AssumptionError
        When the error contains a rigid-body motion of a machine, or the nominal loop is not stable.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> estimators = {"filter": fx.design_kalman(plant)}
    >>> fx.estimation.errors_on_machines(estimators, [plant], "die").names
    ('filter',)
    """
    instance(blocks, Iterable, "blocks", "Pass controllers in [...].")
    given = estimators if isinstance(estimators, Mapping) else {"estimator": estimators}
    listed = members(
        machines, StandardPlant, "machines", "Pass plant.uncertain(fit).sample(rng, 20)."
    )
    if not given or not all(hasattr(one, "rms") for one in given.values()):
        raise ModelError(
            f"estimators must be estimators by name, got {short(estimators)}. Pass "
            "{'Kalman': design_kalman(plant)}."
        )
    first = next(iter(given.values())).plant
    name = poi_channels(first)[row_of(poi_channels(first), channel)]
    nominal = [_rms(one, one.plant, name, blocks) for one in given.values()]
    values = []
    for one in given.values():
        row = []
        for machine in listed:
            try:
                row.append(_rms(one, machine, name, blocks))
            except AssumptionError:
                if not blocks:
                    raise
                row.append(np.inf)
        values.append(row)
    return MachineTable(
        name, tuple(given), np.array(nominal), np.array(values), first.units.get(name, "")
    )


def _rms(estimator: Any, machine: StandardPlant, channel: str, blocks: Sequence[Any]) -> float:
    if not blocks:
        return float(estimator.rms(channel, on=machine))
    with warnings.catch_warnings():  # the table itself says which loops are unstable
        warnings.simplefilter("ignore", FlexplantWarning)
        loop = close_loop(machine, estimator, *blocks)
    row = row_of(poi_channels(estimator.plant), channel)
    return float(np.sqrt(loop_variances(estimator.plant, estimator.system, loop)[row]))
