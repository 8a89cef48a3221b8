"""Components joined: placed, coupled by joints and patches, certified; measured FRFs too."""

from .certificate import JoiningCertificate as JoiningCertificate
from .coincident import coincident_joints as coincident_joints
from .frf_coupling import uncoupled as uncoupled
from .join import joined as joined
from .joint import Joint as Joint
from .patch import Patch as Patch
from .pose import Pose as Pose
from .shapes import JoinedShape as JoinedShape
from .shapes import PlacedShape as PlacedShape
