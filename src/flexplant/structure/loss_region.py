"""A region of a structure, or attachments of it, with a loss factor of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arguments import between, element_mask
from ..errors import ModelError, ShapeError, counted
from ..labels import DofSet
from ..values import FloatArray, Matrix, Value, instance, real_array
from .attachments import Spring, added_matrices


@dataclass(frozen=True, eq=False, repr=False)
class LossRegion(Value):
    """What a region adds to the stiffness K of a structure, and its loss factor.

    Parameters
    ----------
    loss_factor : float [-]
        eta, in [0, 2).
    stiffness : (n, n) array or sparse matrix [N/m, ...], Spring or sequence of Spring
        K_i, part of the structure's K and over the same DOFs; or springs that K has already. Of
        joints, what they add: the machine's K less that of one joined with ``stiffness=0`` there.

    Raises
    ------
    ModelError, ShapeError
        When the loss factor is not in [0, 2), or the stiffness is none.

    Examples
    --------
    >>> import flexplant as fx
    >>> LossRegion(0.3, fx.Spring("1:x", 5e4))
    <LossRegion: loss factor 0.3, 1 spring>
    """

    loss_factor: float
    stiffness: Matrix | Spring | Iterable[Spring]

    def __post_init__(self) -> None:
        given: Any = self.stiffness
        if isinstance(given, Spring):
            given = (given,)
        elif sp.issparse(self.stiffness):
            real_array(given.data, "stored entries of a region's stiffness")
        elif isinstance(given, np.ndarray):
            given = real_array(given, "stiffness of a region", (given.shape[0], given.shape[0]))
        else:
            hint = "Give a part of K, or Spring(...) in [...]."
            given = tuple(instance(given, Iterable, "stiffness of a region", hint))
            for spring in given:
                instance(spring, Spring, "the stiffness of a region", hint)
            if not given:
                raise ModelError(f"a region holds no spring: it would do nothing. {hint}")
        self._set(loss_factor=checked_loss_factor(self.loss_factor), stiffness=given)

    def __repr__(self) -> str:
        given: Any = self.stiffness
        if isinstance(given, tuple):
            what = f"{len(given)} spring{'s' * (len(given) != 1)}"
        else:
            what = f"a matrix of {counted(given.shape[0], 'DOF')}"
        return f"<LossRegion: loss factor {self.loss_factor:g}, {what}>"

    @classmethod
    def of_elements(
        cls,
        loss_factor: float,
        build: Callable[[FloatArray], Any],
        elements: Any,
        *,
        youngs_modulus: float | FloatArray,
    ) -> LossRegion:
        """Return a region of the elements of a mesh: K is proportional to their Young's moduli.

        Parameters
        ----------
        loss_factor : float [-]
            Of these elements.
        build : callable
            From Young's moduli of all elements, an array, to an FEModel.
        elements : bool array
            Which elements, in the shape that `build` takes.
        youngs_modulus : float or array [Pa]
            Of the structure.

        Raises
        ------
        ModelError, ShapeError
            When no elements are given, or shapes differ.

        Examples
        --------
        >>> import flexplant as fx
        >>> def build(E):
        ...     return fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.02, elements=(2, 2),
        ...                               density=2702, youngs_modulus=E, poisson_ratio=0.35)
        >>> LossRegion.of_elements(0.1, build, [[True, False], [False, False]],
        ...                        youngs_modulus=70e9)
        <LossRegion: loss factor 0.1, a matrix of 27 DOFs>
        """
        mask = element_mask(elements, "elements")
        modulus = np.broadcast_to(real_array(youngs_modulus, "youngs_modulus"), mask.shape)
        more: Any = build(modulus * (1.0 + mask)).K - build(np.array(modulus)).K
        return cls(loss_factor, sp.csc_array(more))

    def matrix(self, dofs: DofSet) -> Any:
        """Return K_i (n, n), sparse.

        Raises
        ------
        ShapeError
            When it is of other DOFs.
        LabelError
            When a spring is at none of them.
        """
        given: Any = self.stiffness
        if isinstance(given, tuple):
            return added_matrices(dofs, given).get("K", sp.csc_array((len(dofs),) * 2))
        if given.shape != (len(dofs), len(dofs)):
            raise ShapeError(
                f"the stiffness of a region has shape {given.shape}, the structure has "
                f"{len(dofs)} DOFs: give a part of its K, over the same DOFs."
            )
        return sp.csc_array(given)


def checked_loss_factor(value: Any) -> float:
    """Return a loss factor in [0, 2)."""
    why = (
        "The equivalent damping ratio is half of it, and from 1 on there is no oscillation left: "
        "give 0.02 for 2 %."
    )
    return between(value, "loss_factor", 0.0, 2.0, why, ends="[")
