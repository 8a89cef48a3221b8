"""Residuals of measured shapes, without their unknown scale and phase."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import (
    ComplexArray,
    FloatArray,
    flag,
    instance,
    real_array,
    real_or_complex,
    spread_array,
)
from ...errors import ModelError, ShapeError, counted, require_known
from ...identification import MeasuredModes
from ...labels import DIRECTIONS, Place
from ...modes.matching import CLUSTER, assigned, clusters, mac_matrix
from ...tolerances import SAME, TYPED
from ..family import Family, Point
from ..parameters import named_place
from .residual import Bound, ModalResidual, channel_places, place_rows, split_parts


@dataclass(frozen=True, eq=False, repr=False)
class ModeShapes(ModalResidual):
    """Residuals of measured mode shapes psi at some places, without their scale and phase.

    The residual is ``r = (I - P) psi``, where P is the projector on the model's shape at these
    places. It is the part of the measured shape that no complex multiple of the model's shape
    explains. Its size is ``|r|^2 = (1 - MAC) |psi|^2`` with the modal assurance criterion MAC. The
    unknown complex factor is thereby estimated by maximum likelihood.

    Modes whose measured poles are closer than 2 % form a cluster. They are compared with the
    subspace of the model's shapes of the cluster, which does not change when the modes mix. In each
    step of the fit, the measured modes i are paired with the model's modes j. The pairs minimise
    the sum of ``1 - MAC + |ln(f_j / f_i)|`` with the frequencies f. If shapes look alike at the few
    measured places, the frequencies decide.

    Parameters
    ----------
    measured : MeasuredModes
        Poles with their mode numbers.
    shapes : (m, modes) real or complex array, optional
        Shapes in the order of the poles, with any scale. None: those of `measured`.
    at : sequence of m places, optional
        Places of the rows of the shapes: DOF labels, points or mappings. None: the labels of the
        rows in `measured`. If these labels are names of channels, pass a mapping {label: place}.
    direction : str
        Direction of the motion at points.
    std : float or (m, modes) array, optional
        Standard deviation of the noise n of the entries, in the scale of each shape. For a complex
        entry ``E|n|^2 = std^2``. None: it is not known, and assumed equal for all entries.
    covariance : (modes, m, m) array, optional
        Covariance ``E[n n^H]`` of the noise of each shape, in place of `std`. It is real or
        Hermitian and may be singular. Noise that only changes the scale of a shape has no effect.
        None: the `shape_covariance` of `measured`, if its shapes are used.
    assign : bool
        Whether modes are paired with the measured ones as described above. False: the modes with
        the measured numbers are followed from one step of the search to the next.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When sizes do not match, a shape is zero, or mode numbers are missing.

    Examples
    --------
    Two measured shapes at two DOFs:

    >>> measured = MeasuredModes([-1 + 20j, -2 + 60j], modes=[1, 2])
    >>> ModeShapes(measured, [[1.0, 1.0], [1.4, -0.7]], ["1:z", "2:z"])
    <ModeShapes: modes 1, 2 at 2 places, noise not known>
    """

    measured: MeasuredModes
    shapes: FloatArray | ComplexArray | None = None
    at: Sequence[Place] | Mapping[str, Place] | None = field(default=None)
    direction: str = field(default="z", kw_only=True)
    std: FloatArray | None = field(default=None, kw_only=True)
    covariance: ComplexArray | FloatArray | None = field(default=None, kw_only=True)
    assign: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        numbers = self._checked_numbers()
        require_known("direction", [self.direction], DIRECTIONS)
        at, given = _measured_shapes(self)
        shape = (len(at), len(self.measured))
        shapes: Any = real_or_complex(given, "shapes", shape)
        if len(at) < 2:
            raise ShapeError("shapes need at least two places, since their scale is not known.")
        empty = np.flatnonzero(np.all(shapes == 0, axis=0))
        if empty.size:
            raise ModelError(f"the shape of mode {numbers[empty[0]]} is zero.")
        std = self.std
        if std is not None:
            std = spread_array(std, "std", shape)
        covariance = self.covariance
        if covariance is None and self.shapes is None and std is None:
            covariance = getattr(self.measured, "shape_covariance", None)
        if covariance is not None:
            if std is not None:
                raise ModelError("std and covariance are alternatives: give one of them.")
            covariance = _hermitian_stack(covariance, (shape[1], shape[0]))
        self._set(shapes=shapes, at=tuple(at), std=std, covariance=covariance)
        self._set(assign=flag(self.assign, "assign"))

    def __repr__(self) -> str:
        numbers = ", ".join(str(n) for n in self.measured.modes or ())
        known = "not known" if self.std is None and self.covariance is None else "known"
        places = len(self.at or ())
        return (
            f"<{type(self).__name__}: modes {numbers} at {counted(places, 'place')}, noise {known}>"
        )

    def select(self, modes: Sequence[int]) -> ModeShapes:
        """Return the residual of some of the measured modes, given by their numbers."""
        chosen, columns = self._chosen(modes)
        std = None if self.std is None else self.std[:, columns]
        covariance = None if self.covariance is None else self.covariance[columns]
        shapes = np.asarray(self.shapes)[:, columns]
        return self.replace(measured=chosen, shapes=shapes, std=std, covariance=covariance)

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it; see `Residual.bound`."""
        return BoundShapes(self, family)


class _Batch(NamedTuple):
    """Measured shapes that are compared together, each with a span of equally many modes."""

    sets: list[list[int]]  # their numbers
    white: Any  # (b, m, m)
    psi: Any  # (b, m, 1)


class BoundShapes(Bound):
    """Shapes at unit variance, each compared with the nearest multiple of the model's."""

    kind, usual = "mode shape", 0.02

    def __init__(self, residual: ModeShapes, family: Family) -> None:
        measured = residual.measured
        own = measured.modes or ()
        near = [group.tolist() for group in clusters(measured.poles, CLUSTER)]
        alone = [i for i in range(len(own)) if not any(i in group for group in near)]
        self.numbers = own
        self.noisy = residual.std is not None or residual.covariance is not None
        self.rows = place_rows(family, list(residual.at or ()), residual.direction)
        self.poles = measured.poles
        self.psi = np.asarray(residual.shapes)
        white = np.array(_whitening(self.psi, residual))
        self.batches = []
        for chosen, sets in [(alone, [[i] for i in alone]), *((g, [g] * len(g)) for g in near)]:
            if chosen:
                psi = white[chosen] @ self.psi.T[chosen][:, :, None]
                modes = [[own[i] for i in one] for one in sets]
                self.batches.append(_Batch(modes, white[chosen], psi))
        self.assign = residual.assign
        parts = 2 if np.iscomplexobj(self.psi) else 1
        self._order = [i for group in (alone, *near) for i in group]
        self._rows_each = self.psi.shape[0] * parts
        # what lies in the span of the model's shapes
        spans = [len(modes) for batch in self.batches for modes in batch.sets]
        self.lost = sum(min(parts * span, self._rows_each) for span in spans)
        lengths = [float(np.linalg.norm(one)) for batch in self.batches for one in batch.psi]
        self.size = np.repeat(lengths, self._rows_each)
        self.name = f"shapes of modes {', '.join(map(str, own))}"

    def row_name(self, row: int) -> str:
        """Return the mode of a row."""
        return f"the shape of mode {self.numbers[self._order[row // self._rows_each]]}"

    def assigned(self, point: Point) -> Point:
        """Return the point with its modes paired with the measured ones by their shapes."""
        if not self.assign:
            return point
        eigen = point.eigen
        # one to one, the sum of `1 - MAC + |ln(f_j / f_i)|` over the pairs being least
        far = np.abs(np.log(np.abs(eigen.poles) / np.abs(self.poles)[:, None]))
        columns = assigned(far - mac_matrix(self.psi.astype(complex), self.rows @ eigen.X))
        labels = point.labels.copy()
        for i, column in enumerate(columns.tolist()):
            here = np.flatnonzero(labels == self.numbers[i])
            if here.size and here[0] != column:
                labels[here[0]], labels[column] = labels[column], labels[here[0]]
            labels[column] = self.numbers[i]
        changed = Point(point.family, point.p, point.eigen, labels)
        changed.turned = point.turned
        return changed

    def _parts(self, point: Point, batch: _Batch) -> tuple[Any, Any, Any]:
        """Return the model's shapes (b, m, s), their basis Q, and the remainder of psi."""
        X = point.eigen.X[:, [point.columns(numbers) for numbers in batch.sets]]
        Phi = batch.white @ np.moveaxis(np.tensordot(self.rows, X, axes=1), 0, 1)
        if not np.any(Phi.imag):
            Phi = Phi.real
        Q = np.linalg.qr(Phi)[0]
        return Phi, Q, batch.psi - Q @ (_conjugated(Q) @ batch.psi)

    def _moved(self, point: Point, batch: _Batch, Phi: Any) -> tuple[Any, Any, Any]:
        """Return dPhi (b, m, q, s), ``dPhi Phi^+ psi`` (b, m, q) and Phi^+ (b, s, m)."""
        dY = np.array([self.rows @ dX for dX, _ in point.subspaces(batch.sets)])
        b, q, m, s = dY.shape
        dY = (dY if np.iscomplexobj(Phi) else dY.real).transpose(0, 2, 1, 3)
        dPhi = (batch.white @ dY.reshape(b, m, q * s)).reshape(b, m, q, s)
        plus = np.linalg.pinv(Phi)
        return dPhi, (dPhi @ (plus @ batch.psi)[:, None])[..., 0], plus

    def values(self, point: Point) -> FloatArray:
        """Return the part of the measured shapes that the model does not explain."""
        left = [one[:, 0] for batch in self.batches for one in self._parts(point, batch)[2]]
        return np.concatenate([self._stacked(one) for one in left])

    def slopes(self, point: Point) -> FloatArray:
        """Return their derivatives."""
        found = []
        for batch in self.batches:
            Phi, Q, left = self._parts(point, batch)
            dPhi, inner, plus = self._moved(point, batch, Phi)
            inner = inner - Q @ (_conjugated(Q) @ inner)
            outer = _conjugated(plus) @ np.einsum("bmqs,bm->bsq", dPhi.conj(), left[:, :, 0])
            found += [self._stacked(one) for one in -(inner + outer)]
        return np.concatenate(found)

    def _stacked(self, part: Any) -> FloatArray:
        complex_data = np.iscomplexobj(self.psi)
        return split_parts(np.asarray(part, dtype=complex)) if complex_data else np.real(part)


def _conjugated(X: Any) -> Any:
    """Return X^H of stacks of matrices."""
    return X.conj().transpose(0, 2, 1)


def _measured_shapes(residual: ModeShapes) -> tuple[list[Place], Any]:
    """Return the places and the shapes there, from the measured modes where none are given."""
    measured, at, name = residual.measured, residual.at, type(residual).__name__
    shapes = measured.shapes if residual.shapes is None else residual.shapes
    if shapes is None:
        raise ShapeError(
            f"{measured!r} holds no shapes: give them, {name}(measured, shapes, at), or identify "
            "them."
        )
    if at is not None and not isinstance(at, Mapping):
        listed = [at] if isinstance(at, str) else at
        hint = "Give a place for each row."
        instance(listed, Sequence | np.ndarray, "at", hint, ShapeError)
        return [named_place(place, residual.direction)[0] for place in listed], shapes
    if residual.shapes is not None:
        raise ShapeError(f"{name} needs at= with shapes=. Pass the place of each row.")
    return list(channel_places(measured.dofs or (), at)), shapes


def _hermitian_stack(value: Any, size: tuple[int, int]) -> Any:
    shape = (size[0], size[1], size[1])
    real = real_array(np.real(value), "covariance", shape)
    imag = real_array(np.imag(value), "the imaginary part of covariance", shape)
    whole = real + 1j * imag if np.any(imag) else real
    mirrored = np.swapaxes(whole, 1, 2).conj()
    if not np.allclose(whole, mirrored, rtol=TYPED, atol=SAME * np.abs(whole).max(initial=0.0)):
        raise ModelError("covariance of shapes must be Hermitian: E[n n^H] of each.")
    if np.linalg.eigvalsh(whole).min() < -SAME * np.abs(whole).max(initial=0.0):
        raise ModelError("covariance of shapes must be positive semi-definite, E[n n^H] of each.")
    return (whole + mirrored) / 2


def _whitening(psi: Any, residual: ModeShapes) -> list[Any]:
    """Return a matrix for each shape that gives its real residuals unit variance."""
    # Re and Im of complex noise have half the variance each
    part = 2.0 if np.iscomplexobj(psi) else 1.0
    found: list[Any] = []
    for i, shape in enumerate(psi.T):
        if residual.covariance is not None:
            known = residual.covariance[i]
            size = float(np.trace(known).real) / shape.size
            # noise along the shape is an error of scale, which is free and has no effect
            along = np.outer(shape, shape.conj()) / float(np.vdot(shape, shape).real)
            known = known + size * (along + 1e-10 * np.eye(shape.size))  # singular without
            try:
                factor = la.cholesky(known / part, lower=True)
            except la.LinAlgError:
                raise ModelError(
                    f"the covariance of shape {i + 1} is zero: a shape without noise would count "
                    "infinitely. Leave covariance= out."
                ) from None
            found.append(la.solve_triangular(factor, np.eye(shape.size), lower=True))
        elif residual.std is not None:
            found.append(np.diag(np.sqrt(part) / residual.std[:, i]))
        else:
            found.append(np.eye(shape.size) / np.linalg.norm(shape))
    return found


@dataclass(frozen=True, eq=False, repr=False)
class ShapeCorrelation(ModeShapes):
    """Residuals ``(1 - sqrt(MAC)) / sqrt(MAC)`` of measured mode shapes, one for each mode.

    They have no derivative near a perfect fit, and `ModeShapes` uses the same data better. They
    serve for comparison with published studies.

    Parameters
    ----------
    measured, shapes, at, direction, assign
        Measured shapes, their places and their pairing, as in `ModeShapes`.
    std, covariance : optional
        Noise of the shapes, as in `ModeShapes`. It gives only the weights of the entries in the
        MAC. The noise of the residuals is treated as unknown.

    Examples
    --------
    A measured shape at three DOFs:

    >>> import flexplant as fx
    >>> shape = {"shapes": [[1.0], [0.0], [-1.0]], "dofs": ["1:x", "2:x", "3:x"]}
    >>> measured = fx.MeasuredModes(poles=[630.0j], modes=[2], **shape)
    >>> fx.updating.ShapeCorrelation(measured)
    <ShapeCorrelation: modes 2 at 3 places, noise not known>
    """

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it; see `Residual.bound`."""
        return _BoundMac(self, family)


class _BoundMac(BoundShapes):
    """sqrt(MAC) = |Q^H psi| / |psi|; r = 1/sqrt(MAC) - 1."""

    def __init__(self, residual: ModeShapes, family: Family) -> None:
        super().__init__(residual, family)
        self.noisy, self.size, self._rows_each, self.lost = False, 1.0, 1, 0

    def _inside(self, batch: _Batch, Q: Any) -> tuple[FloatArray, FloatArray]:
        """Return |psi| and |Q^H psi| (b,)."""
        both = (batch.psi, _conjugated(Q) @ batch.psi)
        whole, inside = (np.linalg.norm(part, axis=(1, 2)) for part in both)
        return whole, inside

    def values(self, point: Point) -> FloatArray:
        found = []
        for batch in self.batches:
            whole, inside = self._inside(batch, self._parts(point, batch)[1])
            found.append(whole / inside - 1)
        return np.concatenate(found)

    def slopes(self, point: Point) -> FloatArray:
        found = []
        for batch in self.batches:
            Phi, Q, left = self._parts(point, batch)
            whole, inside = self._inside(batch, Q)
            # d |P psi|^2 = 2 Re (left^H dPhi Phi^+ psi)
            change = np.real(_conjugated(left) @ self._moved(point, batch, Phi)[1])[:, 0]
            found.append(-change * (whole / inside**3)[:, None])
        return np.concatenate(found)
