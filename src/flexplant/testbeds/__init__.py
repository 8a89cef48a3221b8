"""Virtual machines: full-order models with hidden differences, used like hardware.

No machine here has the mesh or the plate theory of the models that are used for design. The claims
of a design are therefore tested independently.

- `wafer_stage`: a free plate, described by polynomials and with rotary inertia. It has masses that
  no drawing shows, scattered stiffness and damping, sensors with finite resolution, and a delay.
- `magnet_stage`: a stage on magnets of negative stiffness, in six axes.
- `three_masses`: a sampled standard plant of three masses, for small examples.
- `gantry`, `dual_stage`, `steering_mirror`, `flexible_joint`, `isolation_table`, `hexapod`,
  `ball_screw`, `maglev_block`: sampled plants of driven machines with relative drives and sensors.
- `WaferStage.measure_frf` and ``poles`` measure a machine; ``run`` and ``loop`` test a design on
  it.

>>> import flexplant as fx
>>> machine = fx.testbeds.wafer_stage(damping=0.01)
>>> measured = machine.poles([4, 5, 6])
>>> measured.freq.round(1)
array([244.7, 355.3, 455.1])
>>> fx.testbeds.three_masses().u
('u1',)

A machine that you write has the same two methods, ``loop(ports, *blocks)`` and ``poles(modes)`` or
``measure_frf(ports)``, and can be used in `fx.study` like these.
"""

from ..rooms import public_names as _public_names
from .driven_machines import ball_screw as ball_screw
from .driven_machines import dual_stage as dual_stage
from .driven_machines import flexible_joint as flexible_joint
from .driven_machines import gantry as gantry
from .driven_machines import hexapod as hexapod
from .driven_machines import isolation_table as isolation_table
from .driven_machines import maglev_block as maglev_block
from .driven_machines import steering_mirror as steering_mirror
from .lumped_machines import three_masses as three_masses
from .virtual_blocks import magnet_stage as magnet_stage
from .virtual_machine import WaferStage as WaferStage
from .virtual_machine import wafer_stage as wafer_stage

__dir__ = _public_names(__name__)
