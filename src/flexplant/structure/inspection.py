"""The report on a model: what is wrong with it, what is odd, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, Value, one_of
from ..errors import ModelError, counted, some_names
from ..parallel import Progress
from .check_facts import Facts, facts
from .check_lines import Line, masses, matrices, rigid, scales, widest_dofs, zero_rows
from .matrices import FEMatrices
from .model import FEModel
from .precision import held_motions, verdict
from .zero_energy import nearly_free


@dataclass(frozen=True, eq=False, repr=False)
class ModelCheck(Value):
    """What `check` found, line by line; printed it is a table.

    Parameters
    ----------
    lines : tuple of (verdict, subject, finding, next step)
        Verdicts are "ok", "note" (worth a look) and "fail" (no model, or a wrong one).
    mass : (3,) array [kg]
        Against translation in x, y, z; NaN where no DOF moves so.
    center : (3,) array [m]
        Centre of gravity; NaN where the DOFs do not determine it.
    inertia : (3, 3) array [kg m^2]
        About the centre of gravity.
    rigid : tuple of str
        Directions x to rz (rotations about the middle) in which the structure moves freely.
    grounded : tuple of str
        Those that are held.
    n_rigid : int
        Independent free rigid-body motions, combinations included.
    n_zero : int
        Motions without energy found in K alone.
    mechanisms : tuple of tuple of str
        For each zero-energy motion that is no rigid-body motion, the DOFs that move most.
    massless, stiffless : tuple of str
        DOFs without mass, without stiffness.
    n_pieces : int
        Parts of the structure that are not joined.
    first_freq : float [Hz]
        Of the first elastic mode; NaN when it is not known.
    source : str or None
        What was checked.

    Examples
    --------
    >>> import flexplant as fx
    >>> report = fx.check(fx.chain(masses=[1.0, 2.0], stiffnesses=[100.0]))
    >>> report.ok, report.n_rigid, float(report.mass[0])
    (True, 1, 3.0)
    """

    lines: tuple[tuple[str, str, str, str], ...]
    mass: FloatArray
    center: FloatArray
    inertia: FloatArray
    rigid: tuple[str, ...]
    grounded: tuple[str, ...]
    n_rigid: int
    n_zero: int
    mechanisms: tuple[tuple[str, ...], ...]
    massless: tuple[str, ...]
    stiffless: tuple[str, ...]
    n_pieces: int
    first_freq: float
    source: str | None = None

    @property
    def ok(self) -> bool:
        """Whether nothing failed; notes may be there."""
        return not self.of("fail")

    def of(self, verdict: str) -> tuple[str, ...]:
        """Return the subjects with a verdict: "ok", "note" or "fail".

        Parameters
        ----------
        verdict : str
            Which.
        """
        one_of(verdict, "verdict", ("ok", "note", "fail"))
        return tuple(subject for found, subject, _, _ in self.lines if found == verdict)

    def __repr__(self) -> str:
        failed, noted = len(self.of("fail")), len(self.of("note"))
        named = f" {self.source!r}" if self.source else ""
        result = "ok" if self.ok else f"{failed} FAILED"
        head = f"<ModelCheck{named}: {result}, {counted(noted, 'warning')}>"
        text = [head]
        for found, subject, finding, following in self.lines:
            mark = {"ok": "ok  ", "note": "note", "fail": "FAIL"}[found]
            text.append(f"  {mark} {subject:<18} {finding}")
            if following:
                text.append(f"       {'':<18} -> {following}")
        return "\n".join(text)


def check(model: FEModel | FEMatrices) -> ModelCheck:
    """Return the report on a model: what is wrong, what is odd, and the next step for each.

    Symmetry and definiteness (by factorisation), rigid-body motions found in K against those of the
    geometry, mechanisms and which DOFs move in them, total mass, centre of gravity and inertia,
    DOFs without mass or stiffness, parts that are not joined, penalties, odd units, damping to
    ground, and digits lost in a text or in single precision. Nothing is changed or repaired.

    Parameters
    ----------
    model : FEModel or FEMatrices
        What is checked; matrices as a file holds them may be wrong in any way.

    Raises
    ------
    ModelError
        When it is neither.

    Examples
    --------
    >>> from flexplant import DofSet
    >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    >>> report = check(FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]], dofs=dofs))
    >>> report.ok, report.rigid, report.n_zero
    (True, ('x',), 1)
    """
    given: Any = model
    if isinstance(model, FEModel):
        matrices_ = FEMatrices(given.K, given.M, given.D, dofs=given.dofs, source=given.name)
    elif isinstance(model, FEMatrices):
        matrices_ = model
    else:
        raise ModelError(
            f"check needs an FEModel or FEMatrices, got {type(model).__name__}. "
            "Pass FEMatrices(K, M, dofs=...), which takes matrices of any quality."
        )
    with Progress(0, "check"):
        found = facts(matrices_, model if isinstance(model, FEModel) else None)
    parts = (matrices, zero_rows, rigid, _connectivity, masses, scales, _digits)
    # of swapped matrices all else would be nonsense
    lines = [line for part in parts[: 1 if found.swapped else None] for line in part(found)]
    lines += [("note", "reader", note, "") for note in matrices_.notes]
    if matrices_.constrained:
        lines.append(("note", "constrained", f"{some_names(matrices_.constrained)} dropped", ""))
    return ModelCheck(
        lines=tuple(lines),
        mass=found.body.mass,
        center=found.body.center,
        inertia=found.body.inertia,
        rigid=found.motions.free if found.motions else (),
        grounded=found.motions.grounded if found.motions else (),
        n_rigid=found.motions.n_rigid if found.motions else 0,
        n_zero=found.n_zero,
        mechanisms=tuple(widest_dofs(found, column) for column in found.mechanisms.T),
        massless=found.names(found.massless),
        stiffless=found.names(found.stiffless),
        n_pieces=int(found.piece.max(initial=-1)) + 1,
        first_freq=found.first_freq,
        source=matrices_.source,
    )


def _connectivity(found: Facts) -> list[Line]:
    count = int(found.piece.max(initial=-1)) + 1
    if count <= 1:
        return [("ok", "connectivity", "one piece", "")]
    if found.given.dofs is None:
        return [("note", "connectivity", f"K joins the rows to {count} separate blocks", "")]
    shown = []
    for piece in range(1, min(count, 4)):
        rows = np.flatnonzero(found.piece == piece)
        shown.append(f"{counted(rows.size, 'DOF')} with {some_names(found.names(rows), most=2)}")
    more = f" and {count - 4} more" if count > 4 else ""
    return [
        (
            "note",
            "connectivity",
            f"{count} pieces that nothing joins; beside the largest: {'; '.join(shown)}{more}",
            "coincident nodes not merged, or a missing contact? Join them, or model them apart",
        )
    ]


def _digits(found: Facts) -> list[Line]:
    digits = found.digits
    if digits is None:
        return []
    said: Any = verdict(found.loss, digits)
    if found.given.digits is None:
        return [
            (
                "note",
                "digits",
                f"K carries about {digits} digits: rigid translations leave forces in every row",
                (
                    "export in double precision; or free what rounding holds: "
                    "FEMatrices(K, M, dofs=dofs).model(free=True)"
                ),
            )
        ]
    notes: list[Line] = []
    for one in (said, _rounding_warning(found, digits)):
        if one:
            text, _, following = one.partition(" Export")
            notes.append(("note", "digits", text, f"export{following}"))
    return notes or [("ok", "digits", f"{digits} digits are enough", "")]


def _rounding_warning(found: Facts, digits: int) -> str | None:
    """Return what `FEMatrices.model` warns of, where rounding alone holds rigid-body motions."""
    given = found.given
    if given.dofs is None or not given.located or found.motions is None:
        return None
    nearly, exactly = (
        nearly_free(given.K, given.M, given.dofs, of).shape[1] for of in (digits, None)
    )
    return held_motions(nearly - exactly, digits)
