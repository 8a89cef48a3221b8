"""Controllers: the servo on the estimated point of interest, H2 and H-infinity."""

from .controller import Controller as Controller
from .elements import Lead as Lead
from .elements import LowPass as LowPass
from .elements import Notch as Notch
from .elements import Pid as Pid
from .h2 import design_h2 as design_h2
from .hinf import design_hinf as design_hinf
from .law import Law as Law
from .lmi import Lmi as Lmi
from .loop_design import LoopDesign as LoopDesign
from .loop_design import design_loops as design_loops
from .ncf import design_ncf as design_ncf
from .ncf import ncf_margin as ncf_margin
from .riccati import Riccati as Riccati
from .robustness.blocks import FullBlock as FullBlock
from .robustness.blocks import RepeatedScalar as RepeatedScalar
from .robustness.gain import WorstCaseGain as WorstCaseGain
from .robustness.gain import worst_case_gain as worst_case_gain
from .robustness.mu import MuBounds as MuBounds
from .robustness.mu import mu as mu
from .robustness.stability import RobustStability as RobustStability
from .robustness.stability import robust_stability as robust_stability
from .servo import design_servo as design_servo
from .servo import servo_bandwidth as servo_bandwidth
from .structured_lmi import StructuredLmi as StructuredLmi
from .tune import tune_loops as tune_loops
