"""Files of finite-element programs that hold neither matrices nor modes to read, and what to do."""

from __future__ import annotations

from .formats import Elsewhere

OTHERS: tuple[Elsewhere, ...] = (
    Elsewhere(
        (".op2",),
        "results, of which flexplant.io.read_modes reads the modes. Matrices: EXTSEOUT(ASMBULK, "
        "EXTID=1, DMIGOP4) in the case control writes them as .op4, read_op4",
    ),
    Elsewhere(
        (".f06", ".f04", ".out"),
        "what a run printed, with too few digits. Matrices: EXTSEOUT(ASMBULK, EXTID=1, DMIGOP4) in "
        "the case control writes them as .op4, read_op4",
    ),
    Elsewhere(
        (".odb", ".fil", ".sim"),
        "results in a form of Abaqus' own. Matrices: *MATRIX GENERATE, STIFFNESS, MASS and *MATRIX "
        "OUTPUT, STIFFNESS, MASS write them as .mtx, read_abaqus",
    ),
    Elsewhere(
        (".mph",),
        "a model of COMSOL. Matrices: LiveLink's mphmatrix(model, 'sol1', 'out', {'Kc', 'Ec'}), "
        "of which Ec is M, saved as .mat: read_matlab",
    ),
)
