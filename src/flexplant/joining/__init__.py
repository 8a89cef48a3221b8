"""Components joined: placed, coupled by joints and patches, certified; measured FRFs too."""

from ..rooms import public_names as _public_names
from .coincident import coincident_joints as coincident_joints
from .frf_coupling import uncoupled as uncoupled
from .join import joined as joined
from .joined_shapes import JoinedShape as JoinedShape
from .joined_shapes import PlacedShape as PlacedShape
from .joining_certificate import JoiningCertificate as JoiningCertificate
from .joint import Joint as Joint
from .patch import Patch as Patch
from .pose import Pose as Pose

__dir__ = _public_names(__name__)
