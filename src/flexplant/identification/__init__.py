"""Identification from measurements: frequency responses, poles and mode shapes.

- `estimate_frf(inputs, outputs, rate)`: computes an `Frf` with coherence and variance from records.
- `impact_frf`: computes an `Frf` from hammer tests.
- `identify_modes(frf, band=)`: finds poles and shapes with their covariance. A least-squares method
  (pLSCF) finds them, and a maximum likelihood fit refines them.
- `identify_output_only`: finds poles and shapes if the forces are unknown.
- `numbered(found, model, at=)`: pairs identified modes with those of a model, for `fx.Eigenvalues`.
- `MeasuredModes.from_freq`: takes frequencies and damping ratios from another source.
- `structural_modes`: makes modes of a structure from measured modes, if no model exists.

Three modes of a wafer stage are identified from a simulated frequency response:

>>> import flexplant as fx
>>> machine = fx.testbeds.wafer_stage()
>>> ports = fx.Ports(
...     u=[fx.Actuator("u1", at=(0.15, 0.15, 0.0))],
...     y=[fx.Sensor("y1", at=(0.0, 0.0, 0.0), asd=1e-12)],
... )
>>> plant = fx.assemble_plant(machine.truth, ports)
>>> frf = fx.frequency_response(plant.Gyu, [200.0 + 0.5 * i for i in range(600)])
>>> found = fx.identify_modes(frf)
>>> print(found)
<IdentifiedModes: 3 poles at 244.7, 355.3, 455.1 Hz, with covariance; refined>

Names elsewhere: ``tfestimate``, ``modalfrf``, ``modalfit`` (MATLAB), PolyMAX (Simcenter),
sdypy-EMA, vector fitting (scikit-rf). Files: `fx.io.read_frf_uff`, `fx.io.read_frf_csv`.
"""

from ..rooms import public_names as _public_names
from .diagram import PoleSelection as PoleSelection
from .diagram import StabilisationDiagram as StabilisationDiagram
from .frf_estimation import average_frfs as average_frfs
from .frf_estimation import estimate_frf as estimate_frf
from .identify import identify_modes as identify_modes
from .identify import stabilisation_diagram as stabilisation_diagram
from .impact import Blow as Blow
from .impact import ImpactTest as ImpactTest
from .impact import impact_frf as impact_frf
from .measured import MeasuredModes as MeasuredModes
from .measured import numbered as numbered
from .output_only import identify_output_only as identify_output_only
from .periodic import Periodic as Periodic
from .periodic import multisine as multisine
from .result import IdentifiedModes as IdentifiedModes
from .spectra import H1Estimator as H1Estimator
from .spectra import H2Estimator as H2Estimator
from .spectra import HvEstimator as HvEstimator
from .structural import shape_deviations as shape_deviations
from .structural import structural_modes as structural_modes

__dir__ = _public_names(__name__)
