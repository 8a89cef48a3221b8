"""Virtual machines: full-order truths with hidden differences, which answer like hardware."""

from .three_masses import three_masses as three_masses
from .wafer_stage import WaferStage as WaferStage
from .wafer_stage import wafer_stage as wafer_stage
