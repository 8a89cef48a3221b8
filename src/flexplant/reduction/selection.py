"""Which degrees of freedom tell the modes apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import LabelError, ModelError, ShapeError
from ..values import FloatArray, Value
from .modes import Modes


@dataclass(frozen=True, eq=False, repr=False)
class DofSelection(Value):
    """Selected DOFs, to be given to `DesiredDofs`.

    Parameters
    ----------
    labels : tuple of str
        The DOFs, required ones first.
    condition : float
        Condition number of the rows of modes and vectors at these DOFs.
    """

    labels: tuple[str, ...]
    condition: float

    def __repr__(self) -> str:
        more = f", ... {self.labels[-1]}" if len(self.labels) > 3 else ""
        return (
            f"<DofSelection: {len(self.labels)} DOFs ({', '.join(self.labels[:3])}{more}), "
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
) -> DofSelection:
    """Return DOFs at which modes and attachment vectors are well told apart.

    By QR with column pivoting over the candidates: each next DOF is the one whose motion is least
    explained by those chosen before.

    Parameters
    ----------
    modes : Modes
        Real modes, with their attachment vectors.
    count : int
        Number of DOFs, at most modes plus vectors; `reduce` needs exactly as many.
    candidates : iterable of str, optional
        Labels to choose from; None: all displacements (no rotations).
    required : iterable of str
        DOFs that are kept in any case.

    Raises
    ------
    LabelError
        When a label is unknown or twice in `required`.
    ShapeError
        When `count` does not fit.
    ModelError
        When the modes are complex, or no candidates tell them apart.
    """
    if np.iscomplexobj(modes.phi):
        raise ModelError("select_dofs needs real modes: solve with damping=ModalDamping(...).")
    basis = np.asarray(modes.basis, dtype=np.float64)
    kept = [required] if isinstance(required, str) else list(required)
    if len(set(kept)) != len(kept):
        raise LabelError(f"required DOFs appear twice: {kept}.")
    if candidates is None:
        pool = [label for label in modes.dofs.labels if ":r" not in label]
    else:
        pool = [candidates] if isinstance(candidates, str) else list(dict.fromkeys(candidates))
    pool = [label for label in pool if label not in set(kept)]
    rows, open_rows = modes.dofs.indices(kept), modes.dofs.indices(pool)
    k = basis.shape[1]
    if isinstance(count, bool) or int(count) != count or not max(1, len(kept)) <= count <= k:
        raise ShapeError(
            f"count must be from {max(1, len(kept))} (the required DOFs) to {k} ({modes.n_modes} "
            f"modes plus {modes.n_vectors} attachment vectors), got {count!r}."
        )
    missing = int(count) - len(kept)
    if missing > len(pool):
        raise ShapeError(
            f"{missing} DOFs are to be chosen from {len(pool)} candidates: name more of them."
        )
    chosen = kept + [pool[i] for i in _pivots(basis[rows], basis[open_rows], missing)]
    singular = la.svdvals(basis[modes.dofs.indices(chosen)])
    if not singular[-1] > 1e-12 * singular[0]:
        raise ModelError(
            f"no {count} of these DOFs tell the modes apart (condition above 1e12): the required "
            "ones depend on each other, or all candidates lie on node lines. Name other candidates."
        )
    return DofSelection(tuple(chosen), float(singular[0] / singular[-1]))


def _pivots(required: FloatArray, pool: FloatArray, count: int) -> list[int]:
    if not count:
        return []
    if required.shape[0]:
        span = la.qr(required.T, mode="economic")[0]
        for _ in range(2):
            pool = pool - (pool @ span) @ span.T
    pivots = la.qr(pool.T, mode="r", pivoting=True)[1]
    return [int(i) for i in pivots[:count]]
