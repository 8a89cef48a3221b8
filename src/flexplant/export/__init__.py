"""Export: C code of controllers, and functional mock-up units.

- `write_c`: writes a controller as one C file with its header. It is given as a `fx.ClosedLoop`
  (observer and servo together) or a `fx.Controller`. 60 states take 0.04 us per sample.
- `write_fmu`: writes a sampled `fx.StandardPlant` or controller as a functional mock-up unit (FMU)
  for FMI 2.0 and 3.0, which Simulink and other simulation programs import.

In MATLAB, MATLAB Coder and Simulink Coder serve the same purpose.

>>> import tempfile, pathlib
>>> import flexplant as fx
>>> folder = pathlib.Path(tempfile.mkdtemp())
>>> law = fx.lti.discretized(fx.lti.tf([1.0], [0.01, 1.0]), 1e3)
>>> [file.name for file in fx.export.write_c(law, folder / "law.c")]
['law.c', 'law.h']
"""

from ..rooms import public_names as _public_names
from .c_code import write_c as write_c
from .fmu import write_fmu as write_fmu

__dir__ = _public_names(__name__)
