"""What the machine is: finite-element matrices with labelled degrees of freedom, and damping."""

from .damping import Damping as Damping
from .damping import ModalDamping as ModalDamping
from .damping import Rayleigh as Rayleigh
from .matrices import FEMatrices as FEMatrices
from .model import FEModel as FEModel
from .plate import PlateShape as PlateShape
from .plate import kirchhoff_plate as kirchhoff_plate
from .scattered import ScatteredShape as ScatteredShape
from .scattered import interpolated as interpolated
