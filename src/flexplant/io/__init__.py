"""Readers and writers of foreign formats; for our own values use `.save` and `flexplant.load`."""

from .frf_csv import read_frf_csv as read_frf_csv
from .frf_csv import write_frf_csv as write_frf_csv
from .mat import read_mat as read_mat
from .mat import write_mat as write_mat
