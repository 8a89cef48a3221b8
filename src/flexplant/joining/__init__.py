"""Joining of components, which are models or measured FRFs, by joints and patches.

- `joined(components, joints)`: makes one machine of components and checks it. Its labels begin with
  the name of the component, such as ``"stage/41:z"``.
- `Joint`: connects places of two components, rigidly or by springs and dampers.
- `Patch`: joins surfaces whose meshes do not match.
- `coincident_joints`: joins surfaces whose meshes match, node by node.
- `Pose`: position and orientation of a component.
- `uncoupled`: removes a component from the measured responses of a machine.

A stage and a frame, each a chain of two masses, are joined by a spring:

>>> import flexplant as fx
>>> stage = fx.chain(masses=[2.0, 1.0], stiffnesses=[1e5])
>>> frame = fx.chain(masses=[10.0, 5.0], stiffnesses=[1e6])
>>> joint = fx.joining.Joint("frame/2:x", "stage/1:x", stiffness=1e4)
>>> machine = fx.joined({"stage": stage, "frame": frame}, [joint])
>>> fx.solve_modes(machine).freq.round(1)
array([ 0. , 10. , 62. , 87.4])
>>> machine.dofs.labels
('stage/1:x', 'stage/2:x', 'frame/1:x', 'frame/2:x')

Names elsewhere: component-mode synthesis, substructuring, LM-FBS (pyFBS), CONTACT and CEINTF
(Ansys), RBE2 and CBUSH (Nastran). ``examples/joined_machine.py`` joins, reduces and separates a
machine.
"""

from ..rooms import public_names as _public_names
from .component import JoinedShape as JoinedShape
from .component import PlacedShape as PlacedShape
from .component import Pose as Pose
from .frf_coupling import uncoupled as uncoupled
from .join import JoiningReport as JoiningReport
from .join import joined as joined
from .joint import Joint as Joint
from .joint import Patch as Patch
from .links import coincident_joints as coincident_joints

__dir__ = _public_names(__name__)
