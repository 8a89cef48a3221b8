"""Parameters of whole matrices: elements, modal damping, dimensions by polynomials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from math import comb
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import (
    FloatArray,
    Matrix,
    element_mask,
    function,
    mapping,
    positive,
    real_array,
    whole,
)
from ..errors import LabelError, ModelError, ShapeError, short
from ..modes import solve_modes
from ..reduction import ReducedModel
from ..sparse.factor import DENSE_LIMIT, LARGEST_FULL
from ..sparse.symmetric import dense, projected
from ..structure import FEModel, ModalDamping
from ..structure.definite import elastic_modes
from ..tolerances import SAME, TYPED
from .parameters import MAKES, Derivatives, Parameter, checked_bounds, checked_text

#: the matrices that parameters name
PARTS = ("dM", "dD", "dK")


@dataclass(frozen=True, eq=False, repr=False)
class _GivenParameter(Parameter):
    """A parameter with given matrices of its powers, of the model or of its full structure."""

    name: str
    dM: Any = field(default=None, kw_only=True)
    dD: Any = field(default=None, kw_only=True)
    dK: Any = field(default=None, kw_only=True)
    unit: str = field(default="", kw_only=True)
    bounds: tuple[float, float] | None = field(default=None, kw_only=True)
    prior: tuple[float, float] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise LabelError(
                f"a {type(self).__name__} needs a name, got {short(self.name)}. Pass a text."
            )
        for label in PARTS:
            part = self._checked(getattr(self, label), f"{label} of {self.name}")
            self._set(**{label: part})
        if not any(self._powers(label) for label in PARTS):
            raise ModelError(f"{self.name} changes nothing: give dM=, dD= or dK=, not all zero.")
        self._set(unit=checked_text(self.unit, "unit"))
        self._check_known()

    def _checked(self, part: Any, name: str) -> Any:
        return _checked_matrix(part, name)

    def _powers(self, label: str) -> Sequence[Matrix | None]:
        """Return the matrices of the first, second, ... power."""
        part = getattr(self, label)
        return part if isinstance(part, tuple) else () if part is None else (part,)

    def terms(self, model: FEModel | ReducedModel) -> list[Derivatives]:
        """Return (dM, dD, dK) of each power of p, converted to the DOFs of the model.

        A `MatrixParameter` has only the first power. None stands for a zero matrix.
        """
        project = partial(_projected_matrix, model=model, name=self.name)
        powers = zip_longest(*(self._powers(label) for label in PARTS))
        return [(project(M), project(D), project(K)) for M, D, K in powers]

    def matrices(self, model: FEModel | ReducedModel) -> Derivatives:
        """Return the derivatives (dM, dD, dK) with respect to p at p = 0, None where zero."""
        return self.terms(model)[0]


@dataclass(frozen=True, eq=False, repr=False)
class MatrixParameter(_GivenParameter):
    """A parameter p that changes the matrices to M + p dM, D + p dD and K + p dK.

    For example, p is the relative change of the stiffness of a group of elements. Then dK is the
    sum of their element stiffness matrices. For a reduced model with the reduction matrix T,
    matrices of the full structure are projected once by ``T^T dK T``.

    Parameters
    ----------
    name : str
        Name of the parameter.
    dM, dD, dK : (k, k) or (n, n) array or sparse matrix, optional
        Symmetric matrices in the DOFs of the model or of the full structure.
    unit : str
        Unit of p. Empty: p is a relative change.
    bounds, prior : optional
        Bounds and prior of p, as for `AddedMass`.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When no matrix is given, or one is not square, finite and symmetric, or the name is empty.

    Examples
    --------
    The stiffness of a joint between two DOFs:

    >>> MatrixParameter("joint", dK=[[2.0, -2.0], [-2.0, 2.0]])
    <MatrixParameter: joint of K>
    """

    def __repr__(self) -> str:
        parts = ", ".join(label[1] for label in PARTS if self._powers(label))
        unit = f" [{self.unit}]" if self.unit else ""
        return f"<MatrixParameter: {self.name}{unit} of {parts}>"

    @classmethod
    def from_difference(
        cls,
        name: str,
        build: Callable[[float], Any],
        *,
        value: float,
        step: float | None = None,
        unit: str = "",
        bounds: tuple[float, float] | None = None,
        prior: tuple[float, float] | None = None,
    ) -> MatrixParameter:
        """Return the parameter ``p = v - value`` of a full model ``build(v)``, by differences.

        The derivatives of the matrices are central differences. They are exact if the matrices are
        linear functions of the quantity v, such as a density or Young's modulus. Otherwise they
        hold for small changes only. An example is a thickness, since the bending stiffness is
        proportional to its third power. `PolynomialParameter.from_build` is exact there.

        Parameters
        ----------
        name, unit, bounds, prior
            As for the class. Bounds and prior are those of the change p.
        build : callable
            Function of v that returns an FEModel, with the same DOFs for every v.
        value : float
            Value of v in the model that is updated.
        step : float, optional
            Step of the difference. None: 1e-3 times the value.

        Raises
        ------
        ModelError, ShapeError
            When the step is not positive, the matrices do not change, or the DOFs change.
        """
        function(build, "build", MAKES)
        middle = float(real_array(value, "value", ()))
        h = positive(1e-3 * abs(middle) if step is None else step, "step")
        low, high = build(middle - h), build(middle + h)
        _check_comparable([low, high], name)
        parts: dict[str, Any] = {}
        for label in "MDK":
            before, after = getattr(low, label), getattr(high, label)
            if before is not None and after is not None:
                parts["d" + label] = (after - before) / (2 * h)
        return cls(name, **parts, unit=unit, bounds=bounds, prior=prior)

    @classmethod
    def regions(
        cls,
        build: Callable[[FloatArray], Any],
        regions: Mapping[str, Any],
        *,
        value: float | FloatArray,
        bounds: tuple[float, float] | None = None,
        prior: tuple[float, float] | None = None,
    ) -> list[MatrixParameter]:
        """Return a parameter for each region of elements: the relative change of one quantity.

        In a region with the parameter p, the quantity is ``value (1 + p)``. The derivatives of the
        matrices are central differences of the full model. They are projected by the reduction
        matrix once, when an update begins. They are exact for Young's modulus and density. For a
        thickness use `PolynomialParameter.from_build` for each region.

        Parameters
        ----------
        build : callable
            Function of an array with the quantity of every element. It returns an FEModel.
        regions : mapping {name: bool array}
            Boolean masks that select the elements of each region. They have the shape of the
            argument of `build` and may overlap.
        value : float or array
            Value of the quantity in the model that is updated. An array has the shape of the
            regions.
        bounds, prior : optional
            Bounds and prior of each relative change, as for `AddedMass`.

        Raises
        ------
        ShapeError, ModelError, LabelError
            When a region has no elements, shapes differ, or the value is zero somewhere in it.

        Examples
        --------
        Young's modulus of one half of a plate:

        >>> from flexplant import kirchhoff_plate
        >>> def build(E):
        ...     return kirchhoff_plate(size=(0.6, 0.6), thickness=0.02, elements=(2, 2),
        ...                            density=2702, youngs_modulus=E, poisson_ratio=0.35)
        >>> left = [[True, True], [False, False]]
        >>> MatrixParameter.regions(build, {"E left": left}, value=70e9)
        [<MatrixParameter: E left of K>]
        """
        mapping(regions, "regions", "Give {'left': mask}.", error=LabelError, least=1)
        function(build, "build", MAKES)
        for name in regions:
            if not isinstance(name, str) or not name:
                raise LabelError(f"a region needs a name, got {short(name)}. Use a text.")
        masks = {name: element_mask(mask, f"region {name!r}") for name, mask in regions.items()}
        shape = next(iter(masks.values())).shape
        given = real_array(value, "value")
        if given.ndim and given.shape != shape:
            raise ShapeError(
                f"value has shape {given.shape}, the regions {shape}: make them equal."
            )
        field_ = np.broadcast_to(given, shape)
        found = []
        for name, mask in masks.items():
            if mask.shape != shape:
                raise ShapeError(f"region {name!r} has shape {mask.shape}, the first one {shape}.")
            if np.any(field_[mask] == 0):
                raise ModelError(f"value is zero in region {name!r}: it has no relative change.")

            def changed(p: float, mask: Any = mask) -> Any:
                return build(np.where(mask, field_ * (1 + p), field_))

            one = cls.from_difference(
                name, changed, value=0.0, step=1e-3, bounds=bounds, prior=prior
            )
            found.append(one)
        return found


@dataclass(frozen=True, eq=False, repr=False)
class ModeDamping(Parameter):
    """A change of the damping ratio of one mode: ``D + p 2 omega (M phi)(M phi)^T``.

    The parameter p is the change of the ratio. The mode has the frequency omega and the
    mass-normalised shape phi.

    Parameters
    ----------
    mode : int
        Number of the mode in the undamped model that is updated. It counts from 1 and includes
        rigid-body modes.
    name : str, optional
        Name of the parameter.
    bounds, prior : optional
        Bounds and prior of the change, as for `AddedMass`.

    Examples
    --------
    The damping ratio of mode 6:

    >>> ModeDamping(6)
    <ModeDamping: damping ratio of mode 6>
    """

    mode: int
    name: str = field(default="", kw_only=True)
    bounds: tuple[float, float] | None = field(default=None, kw_only=True)
    prior: tuple[float, float] | None = field(default=None, kw_only=True)

    unit = ""

    def __post_init__(self) -> None:
        number = whole(self.mode, "mode")
        name = checked_text(self.name, "name") or f"damping ratio of mode {number}"
        self._set(mode=number, name=name)
        self._check_known()

    def __repr__(self) -> str:
        return f"<ModeDamping: {self.name}>"

    def matrices(self, model: FEModel | ReducedModel) -> Derivatives:
        """Return the derivatives (dM, dD, dK) with respect to p, of which only dD is not None.

        A LabelError is raised if the model does not have the mode.
        """
        rigid = np.asarray(model.rigid_body, dtype=np.float64)
        k, r = rigid.shape
        if not r < self.mode <= k:
            raise LabelError(
                f"no elastic mode {self.mode}: the model has {r} rigid-body modes, which are "
                f"undamped, and elastic ones to {k}."
            )
        if k > LARGEST_FULL:
            raise ModelError(
                f"{self.name} would fill the damping matrix of {k} DOFs (limit "
                f"{LARGEST_FULL}). Apply it to a reduced model."
            )
        if sp.issparse(model.K) and k > DENSE_LIMIT:
            modes = solve_modes(model, count=self.mode, damping=ModalDamping(0.0))
            omega, phi = modes.omega[r:], modes.phi[:, r:]
        else:
            omega, phi = elastic_modes(dense(model.M), dense(model.K), rigid, self.mode - r)
        force = np.asarray(model.M @ phi[:, -1].real)
        return None, 2 * float(omega[-1]) * np.outer(force, force), None


def _projected_matrix(part: Matrix | None, model: Any, name: str) -> Matrix | None:
    """Return a matrix in the DOFs of a model, ``T^T A T`` from the full structure."""
    if part is None:
        return None
    k, n = model.M.shape[0], len(getattr(model, "full_dofs", model.dofs))
    if part.shape[0] == k:
        return part
    if part.shape[0] != n:
        raise ShapeError(
            f"{name} has matrices of {part.shape[0]} DOFs; the model has {k}, its full "
            f"structure {n}."
        )
    return projected(part, model.T)


def _check_comparable(models: Sequence[Any], name: str) -> None:
    """Refuse models whose matrices cannot be compared."""
    first = models[0]
    if any(tuple(one.dofs) != tuple(first.dofs) for one in models):
        raise ShapeError(f"build of {name} changes the DOFs: the matrices cannot be compared.")
    if not getattr(first, "is_physical", True):
        raise ShapeError(
            f"build of {name} gives generalised coordinates, which change with the parameter: "
            "matrices in them cannot be compared. Build FEModels; they are projected."
        )


def _checked_matrix(value: Any, name: str) -> Matrix | None:
    """Return a square, finite, symmetric matrix, None when it is None or zero."""
    if value is None:
        return None
    given: Any = value
    matrix: Any = sp.csc_array(given) if sp.issparse(value) else real_array(value, name)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ShapeError(f"{name} must be a square matrix, got shape {matrix.shape}. Pass (k, k).")
    if sp.issparse(value):
        real_array(matrix.data, f"stored entries of {name}")
    largest = float(abs(matrix).max()) if matrix.shape[0] else 0.0
    if largest == 0:
        return None
    if float(abs(matrix - matrix.T).max()) > SAME * largest:
        raise ModelError(
            f"{name} is not symmetric: reciprocity would not hold. Symmetrise it, "
            "0.5 * (A + A.T), when the difference is only rounding."
        )
    half: Any = (matrix + matrix.T) / 2
    checked: Matrix = sp.csc_array(half) if sp.issparse(value) else half
    return checked


#: degrees that are tried where none is given
DEGREES = (3, 6, 12)
#: points at which polynomials are compared with the matrices, relative to the width
CHECKS = (-0.97, -0.77, 0.31)


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialParameter(_GivenParameter):
    """A parameter p with its powers: ``M(p) = M + p M_1 + p^2 M_2 + ...``, also for D and K.

    Derivatives are exact at every p. For example, the stiffness of a plate depends on the first
    three powers of its thickness (K_1, K_2, K_3), and its mass on the first one (M_1).

    Parameters
    ----------
    dM, dD, dK : sequences of (k, k) or (n, n) arrays or sparse matrices
        Matrices M_1, M_2, ... in `dM`, D_1, ... in `dD` and K_1, ... in `dK`, each as in
        `MatrixParameter`. None stands for a zero matrix.
    name, unit, bounds, prior
        As for `MatrixParameter`. The same errors are raised.
    missed : float
        Largest error of the polynomials, relative to the largest change of a matrix.

    Examples
    --------
    The thickness of a plate:

    >>> from flexplant import kirchhoff_plate
    >>> def build(h):
    ...     return kirchhoff_plate(size=(0.6, 0.6), thickness=h, elements=(2, 2),
    ...                            density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> PolynomialParameter.from_build("thickness", build, value=0.02, unit="m")
    <PolynomialParameter: thickness [m], M of degree 1, K of degree 3>
    """

    dM: Sequence[Matrix | None] = field(default=(), kw_only=True)
    dD: Sequence[Matrix | None] = field(default=(), kw_only=True)
    dK: Sequence[Matrix | None] = field(default=(), kw_only=True)
    missed: float = field(default=0.0, kw_only=True)

    def _checked(self, part: Any, name: str) -> tuple[Matrix | None, ...]:
        if not isinstance(part, list | tuple):
            raise ShapeError(f"{name} must be a list of matrices, one a power.")
        label, _, rest = name.partition(" ")
        checked = [_checked_matrix(one, f"{label}[{i}] {rest}") for i, one in enumerate(part)]
        while checked and checked[-1] is None:
            checked.pop()
        return tuple(checked)

    def __repr__(self) -> str:
        degrees = {label[1]: len(self._powers(label)) for label in PARTS}
        parts = ", ".join(f"{part} of degree {count}" for part, count in degrees.items() if count)
        unit = f" [{self.unit}]" if self.unit else ""
        about = f", good to {self.missed:.1g}" if self.missed > SAME else ""
        return f"<PolynomialParameter: {self.name}{unit}, {parts}{about}>"

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
        """Return the parameter ``p = v - value`` of a full model ``build(v)``, by interpolation.

        Polynomials in p interpolate the matrices at degree + 1 Chebyshev points. They are checked
        at three more points. They are exact if the matrices are polynomials of this degree (3 for a
        plate's thickness). If the matrices are other smooth functions (of a length or an angle),
        the polynomials have the error `missed`. Bounds then limit the parameter to the range in
        which the polynomials were checked.

        Parameters
        ----------
        name, build, value, unit, bounds, prior
            As for `MatrixParameter.from_difference`.
        degree : int, optional
            Highest power. None: the first of 3, 6 and 12 that is accurate enough.
        width : float, optional
            Width of the interpolated range on either side of the value. None: a fifth of the value.

        Raises
        ------
        ModelError, ShapeError
            When the error of the polynomials exceeds 1e-6 of the change of the matrices, when the
            matrices do not change, or when the DOFs change.
        """
        function(build, "build", MAKES)
        middle = float(real_array(value, "value", ()))
        half = positive(0.2 * abs(middle) if width is None else width, "width")
        points = {float(x): build(middle + half * x) for x in (0.0, *CHECKS)}
        for powers in DEGREES if degree is None else (whole(degree, "degree"),):
            found, missed = _interpolated(build, points, middle, half, powers, name)
            worst = max(missed, key=lambda label: missed[label][0])
            if missed[worst][0] <= TYPED:
                break
        else:
            part, at = missed[worst]
            raise ModelError(
                f"{worst} of {name} is not a polynomial of degree {powers}: the error is "
                f"{part:.2g} of the change at {middle + half * at:.6g}. Raise degree=, or make "
                "width= smaller."
            )
        if missed[worst][0] > SAME:
            low, high = checked_bounds(bounds, name) or (-np.inf, np.inf)
            bounds = max(low, -half), min(high, half)
        return cls(name, **found, unit=unit, bounds=bounds, prior=prior, missed=missed[worst][0])

    def curve(self, value: float) -> tuple[FloatArray, FloatArray]:
        """Return the powers p, p^2, ... at a value of p, and their derivatives 1, 2 p, ..."""
        k = np.arange(1, max(len(self._powers(label)) for label in PARTS) + 1, dtype=np.float64)
        return np.asarray(value**k), np.asarray(k * value ** (k - 1))

    def about(self, value: float) -> PolynomialParameter:
        """Return the parameter of the change from a value that the model already has.

        The value zero of the new parameter stands for the matrices of the model.
        """
        moved: dict[str, Any] = {}
        for label in PARTS:
            parts = self._powers(label)
            count = len(parts) + 1
            moved[label] = [
                _weighted_sum(
                    [comb(k, j) * value ** (k - j) for k in range(j, count)], parts[j - 1 :]
                )
                for j in range(1, count)
            ]
        return self.replace(**moved)


def _interpolated(
    build: Callable[[float], Any],
    points: dict[float, Any],
    middle: float,
    half: float,
    powers: int,
    name: str,
) -> tuple[dict[str, list[Matrix | None]], dict[str, tuple[float, float]]]:
    """Return the matrices of all powers, and their largest errors for M, D and K with places."""
    # `points` holds the models made so far, by place; those at the nodes join them
    nodes = np.cos(np.pi * (np.arange(powers + 1) + 0.5) / (powers + 1)).tolist()
    for x in nodes:
        if x not in points:
            points[x] = build(middle + half * x)
    start = points[0.0]
    _check_comparable(list(points.values()), name)
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
            part if float(abs(part).max()) * half ** (k + 1) > SAME * size else None
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
