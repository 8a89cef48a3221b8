"""Which degrees of freedom distinguish the modes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as la

from ..errors import LabelError, ModelError, ShapeError, counted
from ..modes.modes import Modes
from ..values import FloatArray, Value, instance, name_list, positive, whole
from .criteria import PivotedQr, SelectionCriterion


@dataclass(frozen=True, eq=False, repr=False)
class DofSelection(Value):
    """Selected DOFs, to be given to `DesiredDofs`, `Guyan` or as a boundary.

    Parameters
    ----------
    labels : tuple of str
        The DOFs, required ones first.
    condition : float
        Condition number of the rows of modes and vectors at these DOFs (phi_kk).
    values : (count,) array, optional
        What the criterion says of each DOF, in the order of the labels.
    criterion : SelectionCriterion
        How they were chosen.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> fx.select_dofs(modes, 2).labels
    ('1:x', '3:x')
    """

    labels: tuple[str, ...]
    condition: float
    values: FloatArray = field(default_factory=lambda: np.zeros(0))
    criterion: SelectionCriterion = field(default_factory=PivotedQr)

    def __repr__(self) -> str:
        more = f", ... {self.labels[-1]}" if len(self.labels) > 3 else ""
        return (
            f"<DofSelection: {counted(len(self.labels), 'DOF')} "
            f"({', '.join(self.labels[:3])}{more}), "
            f"condition {self.condition:.3g}>"
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self.labels)

    def __len__(self) -> int:
        return len(self.labels)


def select_dofs(
    modes: Modes,
    count: int,
    *,
    candidates: Iterable[str] | None = None,
    required: Iterable[str] = (),
    criterion: SelectionCriterion | None = None,
    limit: float = 1e12,
) -> DofSelection:
    """Return DOFs at which modes and attachment vectors are well distinguished.

    Parameters
    ----------
    modes : Modes
        Modes, real or complex, with their attachment vectors.
    count : int
        Number of DOFs, at most modes plus vectors; `reduce` needs exactly as many.
    candidates : iterable of str, optional
        Labels to choose from; None: all displacements (no rotations).
    required : iterable of str
        DOFs that are kept in any case.
    criterion : PivotedQr, EffectiveIndependence or Greedy, optional
        How to choose; None: `PivotedQr`.
    limit : float
        Largest condition of phi_kk that is let pass.

    Raises
    ------
    LabelError
        When a label is unknown or twice in `required`.
    ShapeError
        When `count` does not fit.
    ModelError
        When `count` is no whole number, or no candidates distinguish them.

    Examples
    --------
    >>> from flexplant.structure import kirchhoff_plate
    >>> from flexplant.modes import solve_modes
    >>> plate = kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(4, 4), density=2702,
    ...                         youngs_modulus=70e9, poisson_ratio=0.35)
    >>> near = ["7:z", "12:z", "23:z"]
    >>> select_dofs(solve_modes(plate, count=3), 3, required=["1:z", "5:z"], candidates=near)
    <DofSelection: 3 DOFs (1:z, 5:z, 23:z), condition 1.93>
    """
    instance(modes, Modes, "modes", "Pass solve_modes(model, count=24).")
    rule = PivotedQr() if criterion is None else criterion
    instance(rule, SelectionCriterion, "criterion", "Pass PivotedQr() or Greedy().")
    basis = modes.basis
    kept = list(name_list(required, "required DOFs"))
    if len(set(kept)) != len(kept):
        raise LabelError(f"required DOFs appear twice: {kept}.")
    if candidates is None:
        pool = [label for label in modes.dofs.labels if ":r" not in label]
    else:
        pool = list(dict.fromkeys(name_list(candidates, "candidates")))
    pool = [label for label in pool if label not in set(kept)]
    rows, open_rows = modes.dofs.indices(kept), modes.dofs.indices(pool)
    k = basis.shape[1]
    number = whole(count, "count", minimum=-(10**9))
    if not max(1, len(kept)) <= number <= k:
        raise ShapeError(
            f"count must be from {max(1, len(kept))} (the required DOFs) to {k} ({modes.n_modes} "
            f"modes plus {counted(modes.n_vectors, 'attachment vector')}), got {count!r}."
        )
    missing = number - len(kept)
    if missing > len(pool):
        raise ShapeError(
            f"{missing} DOFs are to be chosen from {len(pool)} candidates: name more of them."
        )
    taken = rule.chosen(basis[rows], basis[open_rows], missing) if missing else []
    chosen = kept + [pool[i] for i in taken]
    picked = basis[modes.dofs.indices(chosen)]
    singular = la.svdvals(picked)
    top = positive(limit, "limit")
    if not singular[-1] * top > singular[0]:
        raise ModelError(
            f"no {number} of these DOFs distinguish the modes (condition above {top:.3g}): the "
            "required ones depend on each other, or all candidates lie on node lines. Name other "
            "candidates."
        )
    condition = float(singular[0] / singular[-1])
    return DofSelection(tuple(chosen), condition, rule.values(picked), rule)
