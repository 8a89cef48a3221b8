"""Readers and writers of other formats; for values of flexplant use `.save` and `flexplant.load`.

- `read_model(K, mass=, dofs=, units=)`: the model of a finite-element program, with its DOFs.
- `read_matrices`: matrices, also without DOFs; their `frequencies(10)` can still be computed.
- `read_modes`: modes of a model that another program has solved.
- `read_frf_uff`, `read_frf_csv`: measured responses; `read_records`: time records for
  `estimate_frf`.
- `read_mat`, `write_mat`: systems to and from MATLAB.

The first three detect the format; readers of a single format have more options. If a file cannot be
read, the error says what to export instead.

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

**Your own model**, in any units, is read, checked, solved and reduced in these steps:

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

- Ansys, matrices: a modal analysis with ``LUMPM,OFF`` and ``WRFULL,1`` writes ``file.full``.
  ``CDWRITE,DB,model,cdb`` writes the nodes, which are also in ``file.rst``. Read both by
  ``fx.read_model("file.full", nodes="model.cdb")`` (needs the extra ``ansys``).
- Ansys, modes: ``ANTYPE,MODAL``, ``MODOPT,LANB,100``, ``RESVEC,ON`` with loads at actuators and
  POIs, and ``MXPAND`` write ``file.rst``. A free structure also needs ``D,,,SUPPORT`` at six DOFs.
  Read the file by ``fx.io.read_modes("file.rst", zeta=0.002)``.
- Nastran, matrices: list all DOFs that you want in ``ASET1``. ``ASSIGN OUTPUT4='run.op4',UNIT=31``
  with the case control ``EXTSEOUT(ASMBULK,EXTID=1,MATOP4=31)`` writes ``run.op4``, which is read
  with ``dofs=``. ``EXTSEOUT(ASMBULK,EXTID=1,DMIGPCH)`` writes ``run.pch`` with ten digits. Read it
  by ``fx.read_model("run.pch", nodes="run.bdf")``.
- Nastran, modes: SOL 103 with ``EIGRL`` (normalisation ``MASS``), ``DISPLACEMENT=ALL``,
  ``RESVEC=YES``, ``USET,U6`` at actuators and POIs, and ``PARAM,POST,-1`` writes ``run.op2``. Read
  it by ``fx.io.read_modes("run.op2", zeta=0.002)``. With ``DISPLACEMENT(PUNCH)=ALL`` it writes
  ``run.pch``, which is read with ``nodes="run.bdf"``.
- Abaqus, matrices: ``*MATRIX GENERATE, STIFFNESS, MASS`` and ``*MATRIX OUTPUT, STIFFNESS, MASS``
  write ``_STIF1.mtx`` and ``_MASS1.mtx`` (1 is the number of the step). The input file must be flat
  (without parts and assemblies). Read the files by
  ``fx.read_model("job_STIF1.mtx", mass="job_MASS1.mtx", nodes="job.inp")``.
- COMSOL, matrices: the LiveLink commands ``s = mphmatrix(model, 'sol1', 'out', {'Kc', 'Ec'})``,
  ``K = s.Kc``, ``M = s.Ec`` and ``save('m.mat', 'K', 'M', '-v7')`` write ``m.mat``. Read it by
  ``fx.read_model("m.mat", dofs="dofs.csv")``.
- Any other program: write K and M as Matrix Market, ``.npz`` or ``.mat``, and the DOFs as a table
  ``node, direction, x, y, z``. Write modes as a universal file (dataset 55 or 2414, nodes in
  dataset 15 or 2411) or as Exodus.

Give ``units=("mm", "t", "s")`` if the model is not in SI units. Give ``rigid_below=`` if the
frequencies of rigid-body modes in the file are not exactly 0. Read modes instead of matrices if the
model is so large that only a cluster can solve it. You must then give the damping. The static
motion of the truncated modes is missing, as a note of the result states; residual vectors
(``RESVEC``) provide most of it.
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
