"""Readers and writers of foreign formats; for our own values use `.save` and `flexplant.load`."""

from .ansys import read_ansys as read_ansys
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
from .tables import read_dofs as read_dofs
