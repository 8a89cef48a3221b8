"""The static geometric relation: the POI from the sensors as if the structure were rigid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import AssumptionError
from ..lti.lyapunov import controllability_gramian
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..plant.carried import carried, carried_of, seen, structure_of
from ..values import FloatArray, Value
from .channels import checked_plant, estimates, poi_channels, row_of, sensors

#: a POI motion that the sensors miss by this relative part is not determined by them
_MISSED = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class StaticEstimator(Value):
    """The rigid-body least-squares estimate of the motions at the POIs, a matrix of gains.

    Parameters
    ----------
    system : StateSpace
        From the displacement sensors to `die:hat`, ...; no states.
    plant : StandardPlant
        Whose geometry it uses.
    """

    system: StateSpace
    plant: StandardPlant

    def __repr__(self) -> str:
        g = self.system
        return f"<StaticEstimator: {', '.join(g.inputs)} -> {', '.join(g.outputs)}>"

    @property
    def gain(self) -> FloatArray:
        """The gains (n_poi, n_sensors)."""
        return self.system.D

    def rms(self, channel: str) -> float:
        """Return the predicted rms of the error at sample instants, with u at rest.

        What the disturbances bend, by the Gramian of the elastic modes, and the sensor noise; the
        rigid-body motion has no error.

        Parameters
        ----------
        channel : str
            A POI's motion: `die`, `die:z`, `die:hat` or `die:error`.

        Raises
        ------
        LabelError
            When it is no motion of a POI.
        AssumptionError
            When the plant is continuous (a sample of white sensor noise has no variance then), or
            its ports have dynamics of their own.
        SolverError
            When an elastic mode is not damped.
        """
        plant = self.plant
        row = row_of(poi_channels(plant), channel)
        if not plant.dt:
            raise AssumptionError(
                "the rms needs a sampled plant: design_static(plant.discretized(rate))."
            )
        if plant.ports is not None and plant.ports.has_dynamics:
            raise AssumptionError(
                "the static relation's rms is known for sensors and actuators without dynamics or "
                "delay of their own. Simulate instead, or leave the dynamics out of the ports."
            )
        g = plant.system
        weights = self.gain[row]
        rows = [plant.y.index(name) for name in self.system.inputs]
        noise = weights @ plant.sensor_noise[np.ix_(rows, rows)] @ weights
        elastic = _elastic(plant)
        missed = (
            g.C[g.output_index(poi_channels(plant))[row]]
            - weights @ (g.C[g.output_index(self.system.inputs)])
        )
        missed = missed[elastic]
        if plant.noise_factor is None:
            raise AssumptionError(
                "the rms needs the process noise of a plant that was assembled and sampled: "
                "assemble_plant(model, ports).discretized(rate)."
            )
        factor = plant.noise_factor[elastic]
        bending = StateSpace(
            g.A[np.ix_(elastic, elastic)],
            factor,
            missed[None],
            np.zeros((1, factor.shape[1])),
            plant.dt,
            blocks=[2] * (len(elastic) // 2),
        )
        return float(np.sqrt(noise + missed @ controllability_gramian(bending) @ missed))


def design_static(plant: StandardPlant) -> StaticEstimator:
    """Return the static geometric relation between the displacement sensors and the POIs.

    ``hat = R_z R_y^+ y`` with R_y and R_z the rigid-body modes at the sensors and the POIs: the
    least-squares rigid-body motion that the sensors show, at the POI. Usual practice, and the
    baseline for anything that knows that the structure bends.

    Parameters
    ----------
    plant : StandardPlant
        Assembled from a structure that is free or on weak springs, continuous or sampled.

    Returns
    -------
    StaticEstimator
        Exact for rigid-body motion.

    Raises
    ------
    AssumptionError
        When the structure has no rigid-body or suspension mode, or the displacement sensors do
        not determine the POI's rigid-body motion.
    ModelError
        When the plant is weighted.

    References
    ----------
    The paper, section 5: "the static geometric relation".
    """
    plant = checked_plant(plant)
    ports = structure_of(plant)[1]
    motions = carried_of(plant)
    kinds = {s.name: s.quantity for s in ports.y}
    used = [name for name in sensors(plant) if kinds.get(name) == "displacement"]
    channels = poi_channels(plant)
    R_y, R_z = seen(plant, motions, used), seen(plant, motions, channels)
    gain = R_z @ np.linalg.pinv(R_y, rcond=_MISSED)
    missed = np.linalg.norm(R_z - gain @ R_y, axis=1)
    bad = missed > 1e-6 * np.linalg.norm(R_z, axis=1)
    if np.any(bad):
        raise AssumptionError(
            f"the displacement sensors ({', '.join(used) or 'none'}) do not determine the "
            f"rigid-body motion at {channels[int(np.argmax(bad))]!r}. Add or move sensors: three "
            "that are not on one line see z, rx and ry."
        )
    n = np.zeros((0, 0))
    return StaticEstimator(
        StateSpace(
            n,
            np.zeros((0, len(used))),
            np.zeros((len(channels), 0)),
            gain,
            plant.dt,
            inputs=used,
            outputs=estimates(channels),
            name="static",
        ),
        plant,
    )


def _elastic(plant: StandardPlant) -> list[int]:
    """Return the states of elastic modes; delay lines of u come after all modes."""
    modes = (plant.continuous or plant).system.n_states
    rigid = carried(structure_of(plant)[0]).modes
    return [i for i in range(modes) if i // 2 not in rigid]
