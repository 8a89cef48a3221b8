"""design_static: the static geometric relation, which every better estimator has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import AssumptionError
from ..lti.lyapunov import solve_stein
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray, Value


@dataclass(frozen=True, eq=False, repr=False)
class StaticEstimator(Value):
    """The POI as if the structure were rigid: ``hat = C_poi,r C_y,r^+ y``.

    Parameters
    ----------
    system : StateSpace
        A static gain from the displacement sensors to `die:hat`, ...
    plant : StandardPlant
        The sampled plant it was designed on.
    covariance : (n_poi, n_poi) array [m^2, rad^2]
        Of the estimation error that the model predicts: elastic motion and sensor noise.
    """

    system: StateSpace
    plant: StandardPlant
    covariance: FloatArray

    def __post_init__(self) -> None:
        self._set(covariance=self.covariance)

    def __repr__(self) -> str:
        return f"<StaticEstimator: {len(self.system.inputs)} sensors -> {list(self.system.outputs)}>"

    def rms(self, channel: str) -> float:
        """Return the rms error of an estimate at the sampling instants that the model predicts.

        Parameters
        ----------
        channel : str
            `die:z`, `die:rx`, ..., or `die` or `die:hat` for the POI's first axis.

        Raises
        ------
        LabelError
            When there is no such POI channel.
        """
        position = self.plant.z.index(self.plant.channel(channel))
        return float(np.sqrt(self.covariance[position, position]))


def design_static(plant: StandardPlant) -> StaticEstimator:
    """Return the rigid-body least-squares estimate of the POIs from the displacement sensors.

    The assumption of traditional wafer stages (paper, section 1): measured and performance
    variables are related by geometry alone.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, assembled from a free structure.

    Returns
    -------
    StaticEstimator
        With the error that the model predicts for it in open loop.

    Raises
    ------
    AssumptionError
        When the plant is not sampled, has no rigid-body modes or POIs, or its displacement sensors
        do not see all rigid-body modes.
    """
    if not plant.dt or plant.noise_factor is None or plant.ports is None or not plant.ports.z:
        raise AssumptionError(
            "the static relation needs a plant with POIs, assembled from a structure and sampled: "
            "assemble_plant(model, ports).discretized(rate)."
        )
    r = plant.n_rigid
    if not r:
        raise AssumptionError("the structure is held: it has no rigid-body motion to follow.")
    plant.check().require(("detectable",), "a static estimate")
    system = plant.system
    sensors = [s.name for s in plant.ports.y if s.quantity == "displacement"]
    pois = [poi.channel(axis) for poi in plant.ports.z for axis in poi.axes]
    seen, wanted = (system.C[system.output_index(names)] for names in (sensors, pois))
    positions = np.arange(r) * 2
    gain = wanted[:, positions] @ np.linalg.pinv(seen[:, positions])
    static = StateSpace(
        [],
        [],
        [],
        gain,
        plant.dt,
        inputs=sensors,
        outputs=[poi.derived(axis, "hat") for poi in plant.ports.z for axis in poi.axes],
        name="static",
    )
    return StaticEstimator(static, plant, _error(plant, wanted - gain @ seen, gain, sensors))


def _error(
    plant: StandardPlant, left: FloatArray, gain: FloatArray, sensors: list[str]
) -> FloatArray:
    """Return the covariance of the error: the rigid part cancels, elastic modes and noise stay."""
    structural = 2 * plant.realisation.pairs.shape[0] if plant.realisation is not None else 0
    elastic = slice(2 * plant.n_rigid, structural)
    motion = solve_stein(plant.system.A[elastic, elastic], plant.process_noise[elastic, elastic])
    rows = [plant.y.index(name) for name in sensors]
    noise = plant.sensor_noise[np.ix_(rows, rows)]
    return np.asarray(left[:, elastic] @ motion @ left[:, elastic].T + gain @ noise @ gain.T)
