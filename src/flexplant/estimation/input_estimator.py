"""What an estimator of unknown inputs is: its gains, and what it predicts of its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..certificates import Certificate
from ..errors import counted
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray, Value, sizes_of
from .estimator_channels import poi_channels, row_of
from .invertibility import Invertibility


@dataclass(frozen=True, eq=False, repr=False)
class InputCertificate(Certificate):
    """What was checked about an estimator of unknown inputs after it was computed.

    Parameters
    ----------
    spectral_radius : float
        Of the estimation error, below 1.
    bias : float
        How much of an unknown input enters the errors, relative: the largest entry of
        ``M F - I`` and of ``(G - L F)`` beside G; 0 when inputs are assumed to be random walks.
    difference : float
        Largest relative difference between the variances with the P that the gains were computed
        from and those with the P of the gains' own Stein equation, at most 1e-6.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.estimation.Augmented(drift=1.0)
    >>> found = fx.estimation.design_input_estimator(plant, ["amp"], method)
    >>> found.certificate.spectral_radius < 1
    True
    """

    spectral_radius: float
    bias: float
    difference: float


@dataclass(frozen=True, eq=False, repr=False)
class InputEstimator(Value):
    """A stationary filter of the motions at the POIs and of unknown inputs d.

    Parameters
    ----------
    system : StateSpace
        From the sensors and the applied u to `die:hat`, ... and `amp1:hat`, ...
    plant : StandardPlant
        What it was designed on.
    inputs : tuple of str
        Names of d.
    delay : int [samples]
        The output `amp1:hat` at sample k is the estimate of the input at k - delay.
    variances : (nz,) array [m^2 or rad^2]
        Of the errors at the POIs.
    input_variances : (m,) array [N^2 or (N m)^2]
        Of the errors of the inputs.
    invertibility : Invertibility
        Whether the sensors determine the inputs without any assumption of them.
    certificate : InputCertificate
        What was checked.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.estimation.Augmented(drift=1.0)
    >>> fx.estimation.design_input_estimator(plant, ["amp"], method).system.outputs
    ('die:hat', 'amp:hat')
    """

    system: StateSpace
    plant: StandardPlant
    inputs: tuple[str, ...]
    delay: int
    variances: FloatArray
    input_variances: FloatArray
    invertibility: Invertibility
    certificate: InputCertificate

    def __repr__(self) -> str:
        names = [*poi_channels(self.plant), *self.inputs]
        rms = sizes_of({name: self.rms(name) for name in names}, self.plant.units)
        late = "in their own sample" if not self.delay else f"{self.delay} sample late"
        return (
            f"<InputEstimator: {counted(self.system.n_states, 'state')}, inputs {late}, spectral "
            "radius "
            f"{self.certificate.spectral_radius:.6f}\n  rms error {rms}>"
        )

    def rms(self, channel: str) -> float:
        """Return the rms of the error of a POI's motion or of an unknown input.

        Parameters
        ----------
        channel : str
            `die`, `die:z`, `die:hat`, or `amp1`, `amp1:hat`.

        Returns
        -------
        float
            In the channel's unit.

        Raises
        ------
        LabelError
            When it is neither.
        """
        row = row_of([*poi_channels(self.plant), *self.inputs], channel)
        both = np.concatenate([self.variances, self.input_variances])
        return float(np.sqrt(max(both[row], 0.0)))
