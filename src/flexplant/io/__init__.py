"""Readers and writers of foreign formats; for our own values use `.save` and `flexplant.load`."""

from .abaqus import read_abaqus as read_abaqus
from .ansys import read_ansys as read_ansys
from .dmig import read_dmig as read_dmig
from .exodus import read_exodus_modes as read_exodus_modes
from .frf_arrays import read_frf_mat as read_frf_mat
from .frf_arrays import read_frf_npz as read_frf_npz
from .frf_csv import read_frf_csv as read_frf_csv
from .frf_csv import write_frf_csv as write_frf_csv
from .mat import read_mat as read_mat
from .mat import write_mat as write_mat
from .matlab import read_matlab as read_matlab
from .matlab import read_npz as read_npz
from .matrix_market import read_harwell_boeing as read_harwell_boeing
from .matrix_market import read_matrix_market as read_matrix_market
from .models import read_matrices as read_matrices
from .models import read_model as read_model
from .op4 import read_op4 as read_op4
from .op4 import read_op4_matrices as read_op4_matrices
from .sierra import read_sierra as read_sierra
from .tables import read_dofs as read_dofs
from .uff import read_frf_uff as read_frf_uff
from .uff import read_modes_uff as read_modes_uff
from .uff import read_nodes_uff as read_nodes_uff
