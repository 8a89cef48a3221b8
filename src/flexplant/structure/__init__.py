"""What the machine is: finite-element matrices with labelled degrees of freedom, and damping."""

from .beam import beam as beam
from .block import solid_block as solid_block
from .chain import chain as chain
from .check import ModelCheck as ModelCheck
from .check import check as check
from .damping import Damping as Damping
from .damping import Hysteretic as Hysteretic
from .damping import ModalDamping as ModalDamping
from .damping import Rayleigh as Rayleigh
from .fields import Disc as Disc
from .fields import Rectangle as Rectangle
from .matrices import FEMatrices as FEMatrices
from .model import FEModel as FEModel
from .pardiso import Pardiso as Pardiso
from .parts import Damper as Damper
from .parts import HeldShape as HeldShape
from .parts import PointMass as PointMass
from .parts import Spring as Spring
from .plate import kirchhoff_plate as kirchhoff_plate
from .scattered import ScatteredShape as ScatteredShape
from .scattered import interpolated as interpolated
from .shapes import BeamShape as BeamShape
from .shapes import BlockShape as BlockShape
from .shapes import PlateShape as PlateShape
from .stiffeners import Rib as Rib
