"""Readers and writers of foreign formats; for our own values use `.save` and `flexplant.load`.

`read_model`, `read_matrices` and `read_modes` find the format themselves; the reader of one format
says more.

====================  ====================  =======================================================
format                reader                what is read
====================  ====================  =======================================================
Matrix Market         read_matrix_market    .mtx, .mtx.gz: one matrix a file, triangle or full
Harwell-Boeing        read_harwell_boeing   .rsa, .rua, .rb, .hb: one assembled matrix a file
MATLAB                read_matlab           .mat v5; v7.3 with `flexplant[hdf5]`: K, M, D by name
NumPy, SciPy          read_npz              .npz (dense, or save_npz), .npy
ANSYS                 read_ansys            .full: K, M; with `flexplant[ansys]`; .rst, .cdb: nodes
Nastran OUTPUT4       read_op4              .op4: text, binary, dense, sparse, both byte orders
Nastran punch         read_dmig             .pch: DMIG in all fields; GRID, CORD2x of the bulk data
Abaqus                read_abaqus           .mtx: *MATRIX OUTPUT as text; *NODE of the input file
Sierra                read_sierra           .m: K, M as text; nodes of an Exodus file
modes                 read_modes            .op2, .pch, .rst, .exo, .uff: of a solved model
Exodus                read_exodus_modes     .exo, .e: modes (classic netCDF; HDF5 with an extra)
universal file        read_modes_uff, ...   .uff, .unv: 55, 58, 2414, nodes; with `flexplant[uff]`
tables                read_dofs             .csv, text: node, direction, x, y, z
responses             read_frf_csv, ...     .csv, .mat, .npz: frequency responses
values for MATLAB     read_mat, write_mat   .mat: systems, plants, reduced models, responses
functional mock-up    write_fmu             .fmu: sampled plants and controllers, FMI 2.0 and 3.0
====================  ====================  =======================================================
"""

from ..rooms import public_names as _public_names
from .abaqus import read_abaqus as read_abaqus
from .ansys import read_ansys as read_ansys
from .dmig import read_dmig as read_dmig
from .exodus import read_exodus_modes as read_exodus_modes
from .fmu import write_fmu as write_fmu
from .frf_arrays import read_frf_mat as read_frf_mat
from .frf_arrays import read_frf_npz as read_frf_npz
from .frf_csv import read_frf_csv as read_frf_csv
from .frf_csv import write_frf_csv as write_frf_csv
from .harwell_boeing import read_harwell_boeing as read_harwell_boeing
from .mat_matrices import read_matlab as read_matlab
from .mat_matrices import read_npz as read_npz
from .mat_values import read_mat as read_mat
from .mat_values import read_mat_values as read_mat_values
from .mat_values import write_mat as write_mat
from .matrix_market import read_matrix_market as read_matrix_market
from .models import read_matrices as read_matrices
from .models import read_model as read_model
from .op4 import read_op4 as read_op4
from .op4 import read_op4_matrices as read_op4_matrices
from .result_modes import read_modes as read_modes
from .sierra import read_sierra as read_sierra
from .tables import read_dofs as read_dofs
from .uff import read_frf_uff as read_frf_uff
from .uff import read_modes_uff as read_modes_uff
from .uff import read_nodes_uff as read_nodes_uff

__dir__ = _public_names(__name__)
