"""What an update compares: poles, shapes, responses, antiresonances, static compliance."""

from .eigenvalues import Eigenvalues as Eigenvalues
from .frf_residual import FrfResidual as FrfResidual
from .mode_shapes import ModeShapes as ModeShapes
from .mode_shapes import ShapeCorrelation as ShapeCorrelation
from .point_residuals import Antiresonances as Antiresonances
from .point_residuals import StaticCompliance as StaticCompliance
from .residual import Residual as Residual
