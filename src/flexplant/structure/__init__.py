r"""Structure of a machine: finite-element matrices with labelled degrees of freedom, and damping.

An `FEModel` holds M, D and K with the DOFs of their rows. The label ``"41:z"`` is the motion of
node 41 in z. `fx.read_model` reads a model from files. The functions here make and change models:

- `plate` (with shear and rotary inertia), `kirchhoff_plate` (thin), `beam`, `solid_block` and
  `chain` make meshes. Thickness and modulus may vary over a plate.
- `FEModel.with_parts` adds `PointMass`, `Spring` and `Damper` to any model. `FEModel.fixed` holds
  DOFs.
- `ModalDamping` (one ratio, one for each mode, or measured ones) and `Rayleigh` give damping. The
  imaginary part of a complex K becomes modal damping.
- `check`: reports on symmetry, definiteness, rigid-body motions, mechanisms and mass of a model.
- `interpolated`: adds an interpolation between nodes to a model without known elements. A point of
  interest (POI) may then be anywhere between the nodes.

A mass and a spring are added to a plate:

>>> import flexplant as fx
>>> plate = fx.plate(
...     size=(0.6, 0.4), thickness=0.02, elements=(6, 4),
...     density=2700, youngs_modulus=70e9, poisson_ratio=0.33,
... )
>>> corner = plate.dofs.nearest((0.6, 0.4, 0.0), "z")
>>> heavier = plate.with_parts([fx.PointMass(corner, 0.5), fx.Spring("1:z", 1e5)])
>>> print(heavier)
<FEModel 'plate': 105 DOFs, sparse, 2 rigid-body motions, D not given>
>>> round(heavier.mass - plate.mass, 6)
0.5

Names elsewhere: Ansys MASS21, COMBIN14; Nastran CONM2, CELAS2, CDAMP2; Abaqus \*MASS, \*SPRING.
Structures are linear and time-invariant, and M, D and K are symmetric. Gyroscopic terms and contact
are not modelled.
"""

from ..rooms import public_names as _public_names
from .additions import Damper as Damper
from .additions import Damping as Damping
from .additions import ModalDamping as ModalDamping
from .additions import PointMass as PointMass
from .additions import Rayleigh as Rayleigh
from .additions import Spring as Spring
from .inspection import ModelCheck as ModelCheck
from .inspection import check as check
from .interpolation import ScatteredShape as ScatteredShape
from .interpolation import interpolated as interpolated
from .matrices import FEMatrices as FEMatrices
from .model import FEModel as FEModel
from .model import HeldShape as HeldShape
from .plates import PlateShape as PlateShape
from .plates import ThickPlateShape as ThickPlateShape
from .plates import kirchhoff_plate as kirchhoff_plate
from .plates import plate as plate
from .simple_models import BeamShape as BeamShape
from .simple_models import BlockShape as BlockShape
from .simple_models import beam as beam
from .simple_models import chain as chain
from .simple_models import solid_block as solid_block
from .sliding_motions import slides as slides
from .sliding_motions import sliding as sliding

__dir__ = _public_names(__name__)
