"""Components joined: placed, coupled by joints and patches, certified; measured FRFs too."""

from ..rooms import public_names as _public_names
from .component import JoinedShape as JoinedShape
from .component import PlacedShape as PlacedShape
from .component import Pose as Pose
from .frf_coupling import uncoupled as uncoupled
from .join import joined as joined
from .joining_certificate import JoiningCertificate as JoiningCertificate
from .joint import Joint as Joint
from .joint import Patch as Patch
from .links import coincident_joints as coincident_joints

__dir__ = _public_names(__name__)
