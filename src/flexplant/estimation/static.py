"""The static geometric relation: the POI from the sensors as if the structure were rigid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Value
from ..errors import AssumptionError, ModelError
from ..lti.statespace import StateSpace, System
from ..plant import StandardPlant, larger_plant
from ..plant.realisation import Structure
from ..plant.rigid_motion import rigid_rows
from .error import error_variances
from .estimator_channels import checked_plant, estimates, poi_channels, row_of, same_pois, sensors

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
    larger : StandardPlant, optional
        The plant with the modes left out, where these are known.
    """

    system: StateSpace
    plant: StandardPlant
    larger: StandardPlant | None = None

    def __repr__(self) -> str:
        g = self.system
        return f"<StaticEstimator: {', '.join(g.inputs)} -> {', '.join(g.outputs)}>"

    @property
    def gain(self) -> FloatArray:
        """The gains (n_poi, n_sensors)."""
        return self.system.D

    def rms(self, channel: str, *, on: StandardPlant | System | None = None) -> float:
        """Return the predicted rms of the error at sample instants, with u at rest.

        What the disturbances bend, the modes left out among it where they are known, and the
        sensor noise; the rigid-body motion, free or on weak springs, has no error.

        Parameters
        ----------
        channel : str
            A POI's motion: `die`, `die:z`, `die:hat` or `die:error`.
        on : StandardPlant, optional
            Another plant that it runs on, sampled; None: its own, with the modes left out.

        Raises
        ------
        LabelError
            When it is no motion of a POI, or the other plant lacks a channel.
        AssumptionError
            When the plant is continuous (a sample of white sensor noise has no variance then), its
            noise is not known, or the error grows with the rigid-body motion.
        ModelError
            When the other plant is not sampled alike, or its noise is not known.
        SolverError
            When an elastic mode is not damped.
        """
        row = row_of(poi_channels(self.plant), channel)
        if not self.plant.dt:
            raise AssumptionError(
                "the rms needs a sampled plant: design_static(plant.discretized(rate))."
            )
        plant = self.larger or self.plant
        if on is not None:
            plant = same_pois(self.plant, on)
        held = plant.rigid_motions if plant.is_assembled else None
        found = error_variances(plant, self.system, None if held is None else held.modes)
        return float(np.sqrt(found.values[row]))


def design_static(
    plant: StandardPlant, larger: StandardPlant | Structure | None = None
) -> StaticEstimator:
    """Return the static geometric relation between the displacement sensors and the POIs.

    ``hat = R_z R_y^+ y`` with R_y and R_z the rigid-body modes at the sensors and the POIs: the
    least-squares rigid-body motion that the sensors show, at the POI. Usual practice, and the
    baseline for anything with a flexible model.

    Parameters
    ----------
    plant : StandardPlant
        Assembled from a structure that is free or on weak springs, continuous or sampled.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        The structure with more modes, for the predicted error. None: the modes of the plant's
        reduced model beyond those it kept.

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
        When the plant is weighted, or the larger one is not sampled alike.

    References
    ----------
    [paper]_, section 5: "the static geometric relation".

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.design_static(fx.testbeds.three_masses()).gain.round(6)  # the mean of both ends
    array([[0.5, 0.5]])
    """
    plant = checked_plant(plant)
    if plant.is_weighted:
        raise ModelError(
            f"the plant is {plant.alteration}: what a sensor sees of the rigid body is known of "
            "sensors only. Use plant.unweighted."
        )
    ports = plant.assembled.ports
    motions = plant.rigid_motions
    orders = {s.name: s.order for s in ports.y}
    used = [name for name in sensors(plant) if orders.get(name) == 0]
    channels = poi_channels(plant)
    R_y, R_z = rigid_rows(plant, motions, used), rigid_rows(plant, motions, channels)
    gain = R_z @ np.linalg.pinv(R_y, rcond=_MISSED)
    missed = np.linalg.norm(R_z - gain @ R_y, axis=1)
    # displacements of a static solution have nine digits
    bad = missed > 1e-6 * np.linalg.norm(R_z, axis=1)
    if np.any(bad):
        raise AssumptionError(
            f"the displacement sensors ({', '.join(used) or 'none'}) do not determine the "
            f"rigid-body motion at {channels[int(np.argmax(bad))]!r}. Add or move sensors: three "
            "that are not on one line see z, rx and ry."
        )
    names: Any = {"inputs": used, "outputs": estimates(channels), "units": plant.units}
    system = StateSpace([], [], [], gain, plant.dt, name="static", **names)
    return StaticEstimator(system, plant, None if larger is plant else larger_plant(plant, larger))
