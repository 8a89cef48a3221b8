"""Model updating: errors of a model are found from measurements, with their uncertainty.

- `update(model, parameters, residuals)`: finds the parameters that fit the measurements. Parameters
  are `AddedMass`, `AddedDamping`, `AddedStiffness`, `MatrixParameter` and others. Residuals are
  `Eigenvalues`, `ModeShapes`, `FrfResidual`, `Antiresonances` and `StaticCompliance`. Chi-square
  shows whether the updated model explains the measurements.
- `localise(model, candidates, residuals)`: finds the place of an error among candidates.
- `identifiability`: shows which parameters the data determine.
- `validate`: tests the updated model with data that were not fitted.
- `UpdateResult.calibrated(measured)`: puts the measured poles into the updated model.
- `UpdateResult.applied_to(full)`: updates the full model.
- `UpdateResult.uncertainty()`: remaining uncertainty of each mode, for robust controllers.

A mass of 0.05 kg is missing in the model and is found from two poles:

>>> import flexplant as fx
>>> nominal = fx.chain(masses=[1.0, 0.3, 0.2], stiffnesses=[2e4, 3e4])
>>> true = nominal.with_parts(fx.PointMass("3:x", 0.05))
>>> poles = 1j * fx.solve_modes(true).omega[1:]
>>> measured = fx.MeasuredModes(poles, modes=[2, 3])
>>> fit = fx.update(nominal, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
>>> round(float(fit.values[0]), 6)
0.05
>>> fit.converged
True

Names elsewhere: FEMtools, Nastran SOL 200, Simcenter Correlation. ``examples/measured_frf.py``
updates a model with noisy responses. ``examples/paper_plate.py`` computes the numbers of the paper.
"""

from ..rooms import public_names as _public_names
from .discrepancy import Discrepancy as Discrepancy
from .discrepancy import ModalUncertainty as ModalUncertainty
from .judgement.candidate_search import Localisation as Localisation
from .judgement.candidate_search import localise as localise
from .judgement.identifiability_tests import IdentifiabilityReport as IdentifiabilityReport
from .judgement.identifiability_tests import identifiability as identifiability
from .judgement.validation import Correlation as Correlation
from .judgement.validation import Validation as Validation
from .judgement.validation import correlate as correlate
from .judgement.validation import fdac as fdac
from .judgement.validation import frac as frac
from .judgement.validation import mac as mac
from .judgement.validation import split as split
from .judgement.validation import validate as validate
from .machines import Machines as Machines
from .machines import Trend as Trend
from .matrix_parameters import MatrixParameter as MatrixParameter
from .matrix_parameters import ModeDamping as ModeDamping
from .matrix_parameters import PolynomialParameter as PolynomialParameter
from .parameters import AddedDamping as AddedDamping
from .parameters import AddedMass as AddedMass
from .parameters import AddedStiffness as AddedStiffness
from .parameters import Parameter as Parameter
from .residuals.frf_residual import FrfResidual as FrfResidual
from .residuals.point_residuals import Antiresonances as Antiresonances
from .residuals.point_residuals import StaticCompliance as StaticCompliance
from .residuals.residual import Bound as Bound
from .residuals.residual import Eigenvalues as Eigenvalues
from .residuals.residual import Residual as Residual
from .residuals.residual import Sensitivities as Sensitivities
from .residuals.residual import eigenvalue_sensitivities as eigenvalue_sensitivities
from .residuals.shape_residuals import ModeShapes as ModeShapes
from .residuals.shape_residuals import ShapeCorrelation as ShapeCorrelation
from .search import GaussNewton as GaussNewton
from .search import TrustRegion as TrustRegion
from .search import UpdateMethod as UpdateMethod
from .update_result import History as History
from .update_result import Starts as Starts
from .update_result import UpdateResult as UpdateResult
from .updates import update as update

__dir__ = _public_names(__name__)
