"""Estimation: the motion at a point of interest from sensors elsewhere.

- `design_kalman(plant)`: the stationary Kalman filter of the motions at the points of interest
  (POIs). Modes of the evaluation model that are truncated in the plant count as noise.
- `KalmanEstimator.rms(channel)`: the predicted error. ``rms(channel, on=other_plant)`` gives the
  error on another plant.
- `KalmanEstimator.estimate(records)`: estimates from recorded data, with `FixedLag`, `Smoother`,
  gaps, outliers or a moving POI. ``step(y, u)`` runs the filter sample by sample.
- `consistency` tests the filter with a record; `estimate_noise` finds noise levels from a record.
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

**How accurate is a predicted error?** It is as accurate as the evaluation model, including the
errors of its mesh, which ``modes.extrapolated(coarser)`` corrects. ``observer.interval`` gives the
interval of the error over ``plant.machines``, random draws of the machine within the known
uncertainty of the plant. For a plate of 0.6 m x 0.6 m, a mesh of 8 x 8 elements predicts the error
of finer meshes within 6 % in z and within 23 % in rotations. For a plate of 0.5 m x 0.3 m the same
mesh predicts an error in z that is 65 % too large, because above 10 kHz modes of nearly equal
frequency have other shapes on a finer mesh. For this plate 12 x 12 elements agree with 24 x 24
elements within 5 % in z.

`design_kalman` does what ``kalman`` and ``lqe`` do in MATLAB and python-control.
`KalmanEstimator.to_filterpy` makes a filter for filterpy.
"""

from ..rooms import public_names as _public_names
from .consistency_tests import ConsistencyReport as ConsistencyReport
from .consistency_tests import consistency as consistency
from .estimate import Estimate as Estimate
from .estimator import KalmanEstimator as KalmanEstimator
from .filter_models import FilterModel as FilterModel
from .filter_models import LeftOut as LeftOut
from .kalman import design_kalman as design_kalman
from .lag_report import LagReport as LagReport
from .lag_report import StaticEstimator as StaticEstimator
from .lag_report import design_static as design_static
from .mode_changes import MovedModes as MovedModes
from .noise_from_records import NoiseLevels as NoiseLevels
from .noise_from_records import estimate_noise as estimate_noise
from .steady_filter import Filter as Filter
from .steady_filter import FixedLag as FixedLag
from .steady_filter import Predictor as Predictor
from .steady_filter import Smoother as Smoother

__dir__ = _public_names(__name__)
