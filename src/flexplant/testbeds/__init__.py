"""Virtual machines: full-order truths with hidden differences, which answer like hardware."""

from .wafer_stage import WaferStage as WaferStage
from .wafer_stage import wafer_stage as wafer_stage
