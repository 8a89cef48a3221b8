"""Identifiability: parameters, or combinations of them, that the residuals determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import FloatArray
from ...errors import SHOWN, counted
from ...store import Value
from ...tolerances import CLOSE, NEGLIGIBLE, TINY, TYPED
from ..family import repeated_groups
from ..parameters import Parameter, checked_parameters, checked_values
from ..search import Objective, checked_residuals
from ..search.objective import resolution


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiabilityReport(Value):
    """Parameters that the residuals determine, to first order.

    Parameters
    ----------
    parameters : sequence of q str
        Names of the parameters.
    singular_values : (q,) array
        Singular values of the sensitivities, with each column scaled to length one. They are
        between zero and sqrt(q).
    combinations : (q, q) array
        Right singular vectors in columns. Each is the combination of (scaled) parameters that
        belongs to a singular value.
    std : (q,) array
        Expected standard deviations of the parameters. They are infinite for parameters that cannot
        be determined. If the noise is not known, the weighted residuals are assumed to have unit
        noise.
    correlation : (q, q) array
        Correlation of the expected errors. It is zero for parameters that cannot be determined.
    unseen : sequence of str
        Names of the parameters on which no residual depends.
    mixed : sequence of (str, ...)
        Groups of parameters. A combination of the parameters of a group cannot be determined.
    missing : mapping {str: (int, ...)}
        Advice for each parameter that is unseen or mixed: unmeasured modes whose eigenvalues would
        determine it. Modes whose eigenvalues change most come first. Empty: no eigenvalue helps, as
        for mirror images on a symmetric structure.
    """

    parameters: tuple[str, ...]
    singular_values: FloatArray
    combinations: FloatArray
    std: FloatArray
    correlation: FloatArray
    unseen: tuple[str, ...]
    mixed: tuple[tuple[str, ...], ...]
    missing: dict[str, tuple[int, ...]]

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that can be determined."""
        return int(np.sum(self.singular_values > TYPED * self.singular_values[0]))

    def __repr__(self) -> str:
        lines = [
            (
                f"<IdentifiabilityReport: {self.rank} of "
                f"{counted(len(self.parameters), 'combination')}, "
                f"singular values {self.singular_values[0]:.3g} to {self.singular_values[-1]:.3g}"
            )
        ]
        if self.unseen:
            lines.append(f"  unseen: {', '.join(self.unseen[:4])}")
        lines += [f"  not distinguished: {', '.join(group[:4])}" for group in self.mixed[:2]]
        q = len(self.parameters)
        close = [
            f"{self.parameters[i]} and {self.parameters[j]} {self.correlation[i, j]:+.3f}"
            for i in range(q)
            for j in range(i)
            if abs(self.correlation[i, j]) > 1.0 - CLOSE
        ]
        lines += [f"  correlated: {text}" for text in close[:2]]
        for name, modes in list(self.missing.items())[:2]:
            if modes:
                lines.append(f"  measure modes {', '.join(map(str, modes))} for {name}")
            else:
                lines.append(f"  no eigenvalue separates {name}: measure shapes or responses")
        return "\n".join(lines) + ">"


def identifiability(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Any],
    *,
    start: Sequence[float] | FloatArray | None = None,
) -> IdentifiabilityReport:
    """Return which parameters the residuals determine, to first order at the start values.

    The report contains the singular values of the weighted sensitivities S. It also contains the
    correlation of the estimate, from ``(S^T S)^-1``, and the numbers of modes that should be
    measured in addition. Priors are not used.

    Parameters
    ----------
    model, parameters, start
        Model, parameters and start values, as for `update`.
    residuals : sequence of Residual
        Data. Only their noise and their dependence on parameters are used. Their values do not
        matter.

    Returns
    -------
    IdentifiabilityReport
        Parameters and combinations of parameters that can be determined.

    Raises
    ------
    ModelError, LabelError, ShapeError
        In the same cases as for `update`.

    Examples
    --------
    One pole cannot distinguish added masses at the two ends of a symmetric chain:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[630.0j], modes=[2]))
    >>> ends = [fx.AddedMass("1:x"), fx.AddedMass("3:x")]
    >>> found = fx.updating.identifiability(drawing, ends, [poles])
    >>> found.rank  # of two: one pole is the same for both ends
    1
    """
    listed = checked_parameters(parameters)
    objective = Objective(model, listed, checked_residuals(residuals), prior=False)
    p = objective.default_start if start is None else checked_values(start, listed, "start")
    point = objective.begin(p)
    names = tuple(q.name for q in listed)
    found = resolution(objective, point)
    s, Vt, clear, seen, length = found.values, found.axes, found.clear, found.seen, found.length
    half = Vt[clear].T / s[clear]
    unit = half @ half.T
    # squared: a fraction of 1e-3 of a lost combination
    lost = np.sum(Vt[~clear] ** 2, axis=0) > 1e-6
    std = np.where(lost | ~seen, np.inf, np.sqrt(np.diag(unit)) / length)
    size = np.where(lost, 1.0, np.sqrt(np.maximum(np.diag(unit), TINY)))
    correlation = np.where(np.outer(~lost, ~lost), unit / np.outer(size, size), np.eye(lost.size))
    parts = np.array(names, dtype=object)
    groups = [tuple(parts[seen & (np.abs(vector) > 0.1)].tolist()) for vector in Vt[~clear]]
    mixed = [group for group in groups if len(group) > 1]
    unseen = tuple(n for n, ok in zip(names, seen, strict=True) if not ok)
    poor = list(dict.fromkeys([*unseen, *(n for group in mixed for n in group)]))
    # combinations of the parameters themselves that change no residual
    lost = Vt[~clear] / length
    return IdentifiabilityReport(
        parameters=names,
        singular_values=s,
        combinations=Vt.T,
        std=std,
        correlation=correlation,
        unseen=unseen,
        mixed=tuple(mixed),
        missing=_missing_modes(objective, point, names, poor, lost),
    )


def _missing_modes(
    objective: Objective, point: Any, names: tuple[str, ...], poor: list[str], lost: FloatArray
) -> dict[str, tuple[int, ...]]:
    """Return the unmeasured modes that determine a lost combination, for poorly known parameters.

    The change of an eigenvalue along the combination counts, against that by its parts.
    """
    numbers = [int(n) for n in point.labels if n and n not in objective.numbers]
    if not poor:
        return {}
    columns = point.columns(numbers)
    size = np.abs(point.eigen.poles[columns])[:, None]
    S = objective.family.sensitivity(point.eigen, columns) / size
    # the split of repeated modes has no sign: only their mean has a direction
    for group in repeated_groups(point.eigen.poles):
        mean = np.trace(objective.family.group_derivative(point.eigen, group), axis1=1, axis2=2)
        for i in [i for i, column in enumerate(columns) if column in group]:
            S[i] = mean / len(group) / size[i]
    along = np.abs(S @ lost.T)
    parts = np.abs(S) @ np.abs(lost.T)
    # terms that cancel except for rounding, or truncation of the model, determine nothing
    felt = parts > 1e-6 * np.max(parts, axis=0, initial=0.0)
    clear = np.where(felt & (along > NEGLIGIBLE * parts), along, 0.0)
    found = {}
    for name in poor:
        # contributes
        own = np.abs(lost[:, names.index(name)]) > 1e-3 * np.abs(lost).max(axis=1, initial=0.0)
        share = np.max(clear[:, own], axis=1, initial=0.0)
        order = np.argsort(-share, kind="stable")[:SHOWN]
        largest = share.max(initial=0.0)
        # modes that contribute only rounding
        found[name] = tuple(numbers[i] for i in order if share[i] > 1e-6 * largest > 0)
    return found
