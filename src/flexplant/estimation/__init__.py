"""Estimation: the motion at a point of interest from sensors elsewhere.

- `design_kalman(plant)`: the stationary filter of the POIs; modes of the evaluation model that are
  truncated in the plant count as noise.
- `KalmanEstimator.rms(channel)`: the predicted error; ``rms(channel, on=other_plant)``: the error
  on another plant.
- `KalmanEstimator.estimate(records)`: recorded data (`FixedLag`, `Smoother`, gaps, outliers, a
  moving POI); ``step(y, u)`` runs sample by sample.
- `consistency`, `estimate_noise`: a test of the filter with a record, and noise levels from it.
- `design_static`: the estimate from the sensors of one instant.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> print(observer)
<KalmanEstimator: 7 states, 2 sensors, spectral radius 0.960145
  rms error die:x 1.88 nm (not judged on a larger model: truncation is not in these numbers)>
>>> static = fx.design_static(plant)
>>> round(static.rms("die:x") / observer.rms("die:x"), 1)
25.9

**How accurate is a predicted error?** As accurate as the evaluation model, including errors of its
mesh: ``modes.extrapolated(coarser)`` corrects these, and ``observer.interval`` gives the interval
of the error on machines that agree with a measurement. For a plate of 0.6 m x 0.6 m, a mesh of 8 x
8 elements predicts the error of finer meshes within 6 % in z and within 23 % in rotations. For a
plate of 0.5 m x 0.3 m the same mesh predicts an error in z that is 65 % too large: above 10 kHz,
modes of nearly equal frequency have other shapes on a finer mesh. There 12 x 12 elements agree with
24 x 24 within 5 % in z.

Names elsewhere: ``kalman``, ``lqe`` (MATLAB, python-control), filterpy
(`KalmanEstimator.to_filterpy`).
"""

from ..rooms import public_names as _public_names
from .consistency_tests import ConsistencyReport as ConsistencyReport
from .consistency_tests import consistency as consistency
from .estimate import Estimate as Estimate
from .estimator import KalmanEstimator as KalmanEstimator
from .filter_models import FilterModel as FilterModel
from .kalman import design_kalman as design_kalman
from .lag_report import Filter as Filter
from .lag_report import FixedLag as FixedLag
from .lag_report import LagReport as LagReport
from .lag_report import Predictor as Predictor
from .lag_report import Smoother as Smoother
from .lag_report import StaticEstimator as StaticEstimator
from .lag_report import design_static as design_static
from .left_out_modes import LeftOut as LeftOut
from .mode_changes import MovedModes as MovedModes
from .noise_from_records import NoiseLevels as NoiseLevels
from .noise_from_records import estimate_noise as estimate_noise

__dir__ = _public_names(__name__)
