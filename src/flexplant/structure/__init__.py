"""What the machine is: finite-element matrices with labelled degrees of freedom, and damping."""

from ..rooms import public_names as _public_names
from .attachments import Damper as Damper
from .attachments import HeldShape as HeldShape
from .attachments import PointMass as PointMass
from .attachments import Spring as Spring
from .damping import Damping as Damping
from .damping import ModalDamping as ModalDamping
from .damping import Rayleigh as Rayleigh
from .hysteretic import Hysteretic as Hysteretic
from .hysteretic import LossRegion as LossRegion
from .inspection import ModelCheck as ModelCheck
from .inspection import check as check
from .interpolation import ScatteredShape as ScatteredShape
from .interpolation import interpolated as interpolated
from .matrices import FEMatrices as FEMatrices
from .mesh.grid_fields import Disc as Disc
from .mesh.grid_fields import Rectangle as Rectangle
from .mesh.ribs import Rib as Rib
from .mesh.shapes import BeamShape as BeamShape
from .mesh.shapes import BlockShape as BlockShape
from .mesh.shapes import PlateShape as PlateShape
from .mesh.simple_models import beam as beam
from .mesh.simple_models import chain as chain
from .mesh.simple_models import kirchhoff_plate as kirchhoff_plate
from .mesh.simple_models import solid_block as solid_block
from .model import FEModel as FEModel

__dir__ = _public_names(__name__)
