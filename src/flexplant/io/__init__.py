"""Readers and writers of other formats; for values of flexplant use `.save` and `flexplant.load`.

- `read_model(K, mass=, dofs=, units=)`: matrices, nodes and DOFs of a finite-element program.
- `read_matrices`: matrices without DOFs, which still give `frequencies(10)`; `read_modes`: modes of
  a solved model.
- `read_frf_uff`, `read_frf_csv`: measured responses; `read_records`: time records for
  `estimate_frf`.
- `read_mat`, `write_mat`: systems to and from MATLAB.

The first three detect the format; readers of a single format have more options. An error for a file
that cannot be read says what to export instead.

>>> import tempfile, pathlib
>>> import flexplant as fx
>>> path = pathlib.Path(tempfile.mkdtemp()) / "plant.mat"
>>> fx.io.write_mat(path, fx.testbeds.three_masses().system)
>>> fx.io.read_mat(path).inputs
('amp', 'y1:noise', 'y2:noise', 'die:ref', 'u1')

| format | reader | what is read |
|---|---|---|
| Matrix Market | `read_matrix_market` | .mtx, .mtx.gz: one matrix a file, triangle or full |
| Harwell-Boeing | `read_harwell_boeing` | .rsa, .rua, .rb, .hb: one assembled matrix a file |
| MATLAB | `read_matlab` | .mat v5; v7.3 with `flexplant[hdf5]`: K, M, D by name |
| NumPy, SciPy | `read_npz` | .npz (dense, or save_npz), .npy |
| ANSYS | `read_ansys` | .full: K, M; with `flexplant[ansys]`; .rst, .cdb: nodes |
| Nastran OUTPUT4 | `read_op4` | .op4: text, binary, dense, sparse, both byte orders |
| Nastran punch | `read_dmig` | .pch: DMIG in all fields; GRID, CORD2x of the bulk data |
| Abaqus | `read_abaqus` | .mtx: MATRIX OUTPUT as text; NODE of the input file |
| modes | `read_modes` | .op2, .pch, .rst, .exo, .uff: of a solved model |
| Exodus | `read_exodus_modes` | .exo, .e: modes (classic netCDF; HDF5 with an extra) |
| universal file | `read_modes_uff`, ... | .uff, .unv: 55, 58, 2414, nodes; with `flexplant[uff]` |
| tables | `read_dofs` | .csv, text: node, direction, x, y, z |
| records | `read_records` | .uff, .lvm, .csv of a logger: time records; `read_spectra` |
| responses | `read_frf_csv`, ... | .csv, .mat, .npz: frequency responses |
| values for MATLAB | `read_mat`, `write_mat` | .mat: systems and plants; responses are written |

**Your own model**, in any units, is read, checked, solved and reduced:

```python
model = fx.read_model(
    "stage_K.mtx", mass="stage_M.mtx", dofs="stage_dofs.csv", units=("mm", "t", "s")
)
print(fx.check(model))  # symmetry, definiteness, rigid-body motions, mechanisms, mass, ...

modes = fx.solve_modes(model, count=30, damping=fx.ModalDamping(0.001))
print(modes)  # rigid-body modes at exactly 0 Hz
keep = fx.select_dofs(modes, 30)
small = fx.reduce(modes, fx.DesiredDofs(keep.labels))
print(small.quality(model, band=(100.0, 5000.0), inputs=keep.labels[:2], outputs=keep.labels[-2:]))
```

**What to write in Ansys, Nastran, Abaqus, COMSOL**, and how to read it:

- Ansys, matrices: a modal analysis with ``LUMPM,OFF`` and ``WRFULL,1`` writes ``file.full``; nodes
  by ``CDWRITE,DB,model,cdb``, or of ``file.rst``.
  ``fx.read_model("file.full", nodes="model.cdb")`` (extra ``ansys``).
- Ansys, modes: ``ANTYPE,MODAL``, ``MODOPT,LANB,100``, ``RESVEC,ON`` with loads at actuators and
  POIs (and ``D,,,SUPPORT`` at six DOFs of a free one), ``MXPAND`` write ``file.rst``.
  ``fx.io.read_modes("file.rst", zeta=0.002)``.
- Nastran, matrices: ``ASSIGN OUTPUT4='run.op4',UNIT=31``, case control
  ``EXTSEOUT(ASMBULK,EXTID=1,MATOP4=31)``, all DOFs wanted in ``ASET1``: ``.op4``, read with
  ``dofs=``; or ``EXTSEOUT(ASMBULK,EXTID=1,DMIGPCH)``: ``.pch``, ten digits.
  ``fx.read_model("run.pch", nodes="run.bdf")``.
- Nastran, modes: SOL 103, ``EIGRL`` with ``MASS``, ``DISPLACEMENT=ALL``, ``RESVEC=YES`` with
  ``USET,U6`` at actuators and POIs, ``PARAM,POST,-1``: ``.op2``; or ``DISPLACEMENT(PUNCH)=ALL``:
  ``.pch``, with ``nodes="run.bdf"``. ``fx.io.read_modes("run.op2", zeta=0.002)``.
- Abaqus, matrices: ``*MATRIX GENERATE, STIFFNESS, MASS`` and ``*MATRIX OUTPUT, STIFFNESS, MASS``
  write ``_STIF1.mtx``, ``_MASS1.mtx`` (1: the step); a flat input file.
  ``fx.read_model("job_STIF1.mtx", mass="job_MASS1.mtx", nodes="job.inp")``.
- COMSOL, matrices, by LiveLink: ``s = mphmatrix(model, 'sol1', 'out', {'Kc', 'Ec'}); K = s.Kc;
  M = s.Ec; save('m.mat', 'K', 'M', '-v7')``. ``fx.read_model("m.mat", dofs="dofs.csv")``.
- any: Matrix Market, ``.npz``, ``.mat`` of K, M; a table ``node, direction, x, y, z``; modes as
  universal file (55 or 2414, nodes 15 or 2411) or Exodus.

Give ``units=("mm", "t", "s")`` where the model is not in SI, ``rigid_below=`` where rigid-body
modes came out near 0. Modes serve models that only a cluster can solve. The static motion of the
truncated modes is then missing (residual vectors, ``RESVEC``, provide most of it), which a note
states, and damping must be given.
"""

from ..rooms import public_names as _public_names
from .abaqus import read_abaqus as read_abaqus
from .ansys import read_ansys as read_ansys
from .exodus import read_exodus_modes as read_exodus_modes
from .fe_modes import read_modes as read_modes
from .files import Format as Format
from .files import add_format as add_format
from .frf_files import read_frf_csv as read_frf_csv
from .frf_files import read_frf_mat as read_frf_mat
from .frf_files import read_frf_npz as read_frf_npz
from .frf_files import write_frf_csv as write_frf_csv
from .mat_matrices import read_matlab as read_matlab
from .mat_matrices import read_npz as read_npz
from .mat_values import read_mat as read_mat
from .mat_values import write_mat as write_mat
from .matrix_files import read_harwell_boeing as read_harwell_boeing
from .matrix_files import read_matrix_market as read_matrix_market
from .models import read_matrices as read_matrices
from .models import read_model as read_model
from .op4 import read_op4 as read_op4
from .op4 import read_op4_matrices as read_op4_matrices
from .punch import read_dmig as read_dmig
from .records import read_records as read_records
from .tables import read_dofs as read_dofs
from .uff import read_frf_uff as read_frf_uff
from .uff import read_modes_uff as read_modes_uff
from .uff import read_nodes_uff as read_nodes_uff
from .uff_times import read_spectra as read_spectra

__dir__ = _public_names(__name__)
