"""A force on a rigid-body axis of the whole machine: a bias, a cable's drag, gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import unknown_label
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .port import ForcePort, force_unit
from .realisation import ModalRealisation
from .rigid.rigid_body import inertia_load, rigid_body_of


@dataclass(frozen=True, eq=False)
class RigidForce(ForcePort):
    """A force (or moment) spread over the mass so that a free machine moves and does not bend.

    The load ``M r / (r' M r)``, r the rigid-body motion of its axis, rotations about the centre of
    mass: it does the work of a unit force along r, and none on elastic modes of a free structure.

    Parameters
    ----------
    name : str
        The channel's name.
    direction : str
        x, y, z [N] or rx, ry, rz [N m].
    asd : float [N/sqrt(Hz), N m/sqrt(Hz)]
        One-sided amplitude spectral density of white noise; 0 for none.
    shape : StateSpace, optional
        A stable filter between the channel and the machine.

    Raises
    ------
    LabelError, ModelError
        For a bad name, direction, shape or a negative asd.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.RigidForce("cable", "x", asd=1e-3).unit
    'N'
    """

    name: str
    direction: str = "z"
    asd: float = 0.0
    shape: StateSpace | None = None

    @property
    def unit(self) -> str | None:
        """N or N m."""
        return force_unit({}, self.direction)

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the load (n,) over the model's DOFs of a unit force."""
        body = rigid_body_of(realisation)
        if self.direction not in body.axes:
            raise unknown_label("rigid-body axis of the machine", self.direction, body.axes)
        row = body.axes.index(self.direction)
        load = inertia_load(realisation, self.direction, body.centre)
        return np.asarray(-load / body.mass[row, row])
