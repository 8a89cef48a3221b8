"""Parameters on which matrices depend as polynomials: thicknesses, lengths, widths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import comb
from typing import Any

import numpy as np

from ...arguments import function
from ...errors import LabelError, ModelError, ShapeError
from ...values import FloatArray, Matrix, positive, real_array, whole
from .added import MAKES, Derivatives, Parameter, checked_bounds, checked_prior, checked_text
from .matrix_parameters import checked_matrix, projected

#: relative to the change of a matrix: what its polynomial may miss between the points of it
EXACT = 1e-6


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
    bounds : (lowest, highest), optional
        The parameter is kept between them.
    prior : (mean, standard deviation), optional
        What is known beforehand, a normal distribution.

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
        bounds, prior = checked_bounds(self.bounds, self.name), checked_prior(self.prior, self.name)
        self._set(**parts, bounds=bounds, prior=prior, unit=checked_text(self.unit, "unit"))

    def __repr__(self) -> str:
        parts = [
            f"{label[1]} of degree {len(getattr(self, label))}"
            for label in ("dM", "dD", "dK")
            if getattr(self, label)
        ]
        unit = f" [{self.unit}]" if self.unit else ""
        return f"<PolynomialParameter: {self.name}{unit}, {', '.join(parts)}>"

    @classmethod
    def from_build(
        cls,
        name: str,
        build: Callable[[float], Any],
        *,
        value: float,
        degree: int = 3,
        width: float | None = None,
        unit: str = "",
        bounds: tuple[float, float] | None = None,
        prior: tuple[float, float] | None = None,
    ) -> PolynomialParameter:
        """Return the parameter p = v - value of a full model `build(v)`, by interpolation.

        The matrices at degree + 1 Chebyshev points make the polynomials, two points more check
        them. Exact where the matrices are polynomials of this degree (3 for a plate's thickness),
        and as good as the check says where they are not.

        Parameters
        ----------
        name : str
            For results.
        build : callable
            From the value to an FEModel; the same DOFs at every value.
        value : float
            Of the model that is updated.
        degree : int
            Highest power.
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
        powers = whole(degree, "degree")
        nodes = np.cos(np.pi * (np.arange(powers + 1) + 0.5) / (powers + 1))
        between = np.array([-0.77, 0.31])
        start, models = build(middle), [build(middle + half * x) for x in nodes]
        checks = [build(middle + half * x) for x in between]
        if any(tuple(one.dofs) != tuple(start.dofs) for one in [*models, *checks]):
            raise ShapeError(f"build of {name} changes the DOFs: the matrices cannot be compared.")
        # without a constant: p = 0 is the model itself
        weights = np.linalg.lstsq(nodes[:, None] ** np.arange(1, powers + 1), np.eye(powers + 1))[0]
        found: dict[str, list[Matrix | None]] = {}
        for label in "MDK":
            base = getattr(start, label)
            if base is None:
                continue
            changes = [getattr(one, label) - base for one in models]
            terms = [_sum(row, changes) for row in weights]
            size = max(float(abs(part).max()) for part in changes)
            for x, one in zip(between.tolist(), checks, strict=True):
                made = _sum([x ** (k + 1) for k in range(powers)], terms)
                missed = float(abs(made - (getattr(one, label) - base)).max())
                if missed > EXACT * size:
                    raise ModelError(
                        f"{label} of {name} is no polynomial of degree {powers}: it misses by "
                        f"{missed / size:.2g} of the change at {middle + half * x:.6g}. Raise "
                        "degree=, or make width= smaller."
                    )
            kept = [part / half ** (k + 1) for k, part in enumerate(terms)]
            least = 1e-9 * size
            found["d" + label] = [
                part if float(abs(part).max()) * half ** (k + 1) > least else None
                for k, part in enumerate(kept)
            ]
        return cls(name, **found, unit=unit, bounds=bounds, prior=prior)

    def terms(self, model: Any) -> list[Derivatives]:
        """Return the matrices of all powers in the model's DOFs."""
        return [
            (
                projected(_at(self.dM, k), model, self.name),
                projected(_at(self.dD, k), model, self.name),
                projected(_at(self.dK, k), model, self.name),
            )
            for k in range(self._degree)
        ]

    def matrices(self, model: Any) -> Derivatives:
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
                _sum([comb(k, j) * value ** (k - j) for k in range(j, len(parts) + 1)],
                     list(parts[j - 1 :]))
                for j in range(1, len(parts) + 1)
            ]  # fmt: skip
        return self.replace(**moved)

    @property
    def _degree(self) -> int:
        return max(len(self.dM), len(self.dD), len(self.dK))


def _at(parts: Sequence[Matrix | None], k: int) -> Matrix | None:
    return parts[k] if k < len(parts) else None


def _sum(weights: Any, parts: Sequence[Any]) -> Any:
    """Return the weighted sum of matrices of which any may be None."""
    total: Any = None
    for weight, part in zip(weights, parts, strict=True):
        if part is not None:
            term = float(weight) * part
            total = term if total is None else total + term
    return total
