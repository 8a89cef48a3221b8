"""Parameters on which matrices depend as polynomials, or nearly: thicknesses, lengths, angles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from math import comb
from typing import Any

import numpy as np

from ...checks import FloatArray, Matrix, function, positive, real_array, whole
from ...errors import LabelError, ModelError, ShapeError
from ...reduction import ReducedModel
from ...structure import FEModel
from .added import MAKES, Derivatives, Parameter, checked_bounds, checked_text
from .matrix_parameters import checked_matrix, projected_matrix

#: relative to the change of a matrix: what its polynomial may miss between the points of it, and
#: what rounding makes it miss where the matrix is one
CLOSE, EXACT = 1e-6, 1e-9
#: degrees that are tried where none is given
DEGREES = (3, 6, 12)
#: where polynomials are compared with the matrices, in parts of the width
CHECKS = (-0.97, -0.77, 0.31)


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialParameter(Parameter):
    """A parameter with powers: ``M(p) = M + p M_1 + p^2 M_2 + ...``, and so D and K.

    Derivatives are exact at every p. A plate's thickness has K_1 to K_3 and M_1 (with rotary
    inertia M_3).

    Parameters
    ----------
    name : str
        For results.
    dM, dD, dK : sequences of (k, k) or (n, n) arrays or sparse matrices
        M_1, M_2, ...; D_1, ...; K_1, ...: symmetric, of the model's own DOFs or of the full
        structure's. None stands for zero.
    unit : str
        Of p.
    bounds, prior : optional
        As for `AddedMass`.
    missed : float
        Part of the largest change of a matrix that the polynomials were seen to miss.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When no matrix is given, or one is not square, finite and symmetric, or the name is empty.

    Examples
    --------
    >>> from flexplant import kirchhoff_plate
    >>> def build(h):
    ...     return kirchhoff_plate(size=(0.6, 0.6), thickness=h, elements=(2, 2),
    ...                            density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> PolynomialParameter.from_build("thickness", build, value=0.02, unit="m")
    <PolynomialParameter: thickness [m], M of degree 1, K of degree 3>
    """

    name: str
    dM: Sequence[Matrix | None] = field(default=(), kw_only=True)
    dD: Sequence[Matrix | None] = field(default=(), kw_only=True)
    dK: Sequence[Matrix | None] = field(default=(), kw_only=True)
    unit: str = field(default="", kw_only=True)
    bounds: tuple[float, float] | None = field(default=None, kw_only=True)
    prior: tuple[float, float] | None = field(default=None, kw_only=True)
    missed: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        if not checked_text(self.name, "name"):
            raise LabelError("a PolynomialParameter needs a name, got ''. Pass a text.")
        parts: dict[str, Any] = {}
        for label in ("dM", "dD", "dK"):
            given = getattr(self, label)
            if not isinstance(given, list | tuple):
                raise ShapeError(f"{label} of {self.name} must be a list of matrices, one a power.")
            checked = [
                checked_matrix(part, f"{label}[{i}] of {self.name}") for i, part in enumerate(given)
            ]
            while checked and checked[-1] is None:
                checked.pop()
            parts[label] = tuple(checked)
        if not any(parts.values()):
            raise ModelError(f"{self.name} changes nothing: give dM=, dD= or dK=, not all zero.")
        self._set(**parts, unit=checked_text(self.unit, "unit"))
        self._check_known()

    def __repr__(self) -> str:
        parts = [
            f"{label[1]} of degree {len(getattr(self, label))}"
            for label in ("dM", "dD", "dK")
            if getattr(self, label)
        ]
        unit = f" [{self.unit}]" if self.unit else ""
        about = f", good to {self.missed:.1g}" if self.missed > EXACT else ""
        return f"<PolynomialParameter: {self.name}{unit}, {', '.join(parts)}{about}>"

    @classmethod
    def from_build(
        cls,
        name: str,
        build: Callable[[float], Any],
        *,
        value: float,
        degree: int | None = None,
        width: float | None = None,
        unit: str = "",
        bounds: tuple[float, float] | None = None,
        prior: tuple[float, float] | None = None,
    ) -> PolynomialParameter:
        """Return the parameter p = v - value of a full model `build(v)`, by interpolation.

        The matrices at degree + 1 Chebyshev points make the polynomials, three points more check
        them. Exact where the matrices are polynomials of this degree (3 for a plate's thickness).
        Where they are smooth functions of another kind (a length, an angle), `missed` says how good
        the polynomials are, and bounds keep the parameter where they were compared.

        Parameters
        ----------
        name : str
            For results.
        build : callable
            From the value to an FEModel; the same DOFs at every value.
        value : float
            Of the model that is updated.
        degree : int, optional
            Highest power. None: the first of 3, 6 and 12 that is good enough.
        width : float, optional
            Of the interval on either side of the value; a fifth of it when not given.
        unit, bounds, prior
            As of the class; bounds and prior of p, the change.

        Raises
        ------
        ModelError
            When the polynomials miss the matrices by more than 1e-6 of their change between the
            points, or nothing changes.
        ShapeError
            When the DOFs change.
        """
        function(build, "build", MAKES)
        middle = float(real_array(value, "value", ()))
        half = positive(0.2 * abs(middle) if width is None else width, "width")
        points = {float(x): build(middle + half * x) for x in (0.0, *CHECKS)}
        for powers in DEGREES if degree is None else (whole(degree, "degree"),):
            found, missed = _interpolated(build, points, middle, half, powers, name)
            worst = max(missed, key=lambda label: missed[label][0])
            if missed[worst][0] <= CLOSE:
                break
        else:
            part, at = missed[worst]
            raise ModelError(
                f"{worst} of {name} is no polynomial of degree {powers}: it misses by {part:.2g} "
                f"of the change at {middle + half * at:.6g}. Raise degree=, or make width= smaller."
            )
        if missed[worst][0] > EXACT:
            low, high = checked_bounds(bounds, name) or (-np.inf, np.inf)
            bounds = max(low, -half), min(high, half)
        return cls(name, **found, unit=unit, bounds=bounds, prior=prior, missed=missed[worst][0])

    def terms(self, model: FEModel | ReducedModel) -> list[Derivatives]:
        """Return the matrices of all powers in the model's DOFs."""
        powers = zip_longest(self.dM, self.dD, self.dK)
        return [
            (projected_matrix(M, model, self.name), projected_matrix(D, model, self.name),
             projected_matrix(K, model, self.name))
            for M, D, K in powers
        ]  # fmt: skip

    def matrices(self, model: FEModel | ReducedModel) -> Derivatives:
        """Return the derivatives (dM, dD, dK) at p = 0."""
        return self.terms(model)[0]

    def curve(self, value: float) -> tuple[FloatArray, FloatArray]:
        """Return the powers of a value, and their derivatives."""
        k = np.arange(1, self._degree + 1, dtype=np.float64)
        powers, slopes = np.power(value, k), k * np.power(value, k - 1)
        return np.asarray(powers, dtype=np.float64), np.asarray(slopes, dtype=np.float64)

    def about(self, value: float) -> PolynomialParameter:
        """Return the parameter counted from a value: ``(p + v)^k`` by the binomial theorem."""
        moved: dict[str, Any] = {}
        for label in ("dM", "dD", "dK"):
            parts = getattr(self, label)
            moved[label] = [
                _weighted_sum([comb(k, j) * value ** (k - j) for k in range(j, len(parts) + 1)],
                     list(parts[j - 1 :]))
                for j in range(1, len(parts) + 1)
            ]  # fmt: skip
        return self.replace(**moved)

    @property
    def _degree(self) -> int:
        return max(len(self.dM), len(self.dD), len(self.dK))


def _interpolated(
    build: Callable[[float], Any],
    points: dict[float, Any],
    middle: float,
    half: float,
    powers: int,
    name: str,
) -> tuple[dict[str, list[Matrix | None]], dict[str, tuple[float, float]]]:
    """Return the matrices of all powers, and what they miss at most and where, of M, D and K.

    `points` holds the models at the middle and where the polynomials are checked; those at the
    nodes join them.
    """
    nodes = np.cos(np.pi * (np.arange(powers + 1) + 0.5) / (powers + 1)).tolist()
    for x in nodes:
        if x not in points:
            points[x] = build(middle + half * x)
    start = points[0.0]
    if any(tuple(one.dofs) != tuple(start.dofs) for one in points.values()):
        raise ShapeError(f"build of {name} changes the DOFs: the matrices cannot be compared.")
    # without a constant: p = 0 is the model itself
    table = np.array(nodes)[:, None] ** np.arange(1, powers + 1)
    weights = np.linalg.lstsq(table, np.eye(powers + 1))[0]
    found: dict[str, list[Matrix | None]] = {}
    missed: dict[str, tuple[float, float]] = {}
    for label in "MDK":
        base = getattr(start, label)
        if base is None:
            continue
        changes = [getattr(points[x], label) - base for x in nodes]
        terms = [_weighted_sum(row, changes) for row in weights]
        size = max(float(abs(part).max()) for part in changes)
        missed[label] = (0.0, 0.0)
        for x in CHECKS:
            made = _weighted_sum([x ** (k + 1) for k in range(powers)], terms)
            off = float(abs(made - (getattr(points[x], label) - base)).max())
            missed[label] = max(missed[label], (off / size if size else 0.0, x))
        kept = [part / half ** (k + 1) for k, part in enumerate(terms)]
        found["d" + label] = [
            part if float(abs(part).max()) * half ** (k + 1) > EXACT * size else None
            for k, part in enumerate(kept)
        ]
    return found, missed


def _weighted_sum(weights: Any, parts: Sequence[Any]) -> Any:
    """Return the weighted sum of matrices of which any may be None."""
    total: Any = None
    for weight, part in zip(weights, parts, strict=True):
        if part is not None:
            term = float(weight) * part
            total = term if total is None else total + term
    return total
