"""Virtual machines: full-order truths with hidden differences, which answer like hardware."""

from ..rooms import public_names as _public_names
from .magnet_stage import magnet_stage as magnet_stage
from .three_masses import three_masses as three_masses
from .wafer_stage import WaferStage as WaferStage
from .wafer_stage import wafer_stage as wafer_stage

__dir__ = _public_names(__name__)
