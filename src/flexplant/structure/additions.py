"""What is added to a structure: damping laws, point masses, springs and dampers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import (
    FloatArray,
    Matrix,
    between,
    complex_array,
    divisor,
    flag,
    floats_of,
    instance,
    number,
    positive,
    real_array,
    several,
    whole,
)
from ..errors import LabelError, ModelError, ShapeError, short
from ..labels import DofSet, Place, checked_direction
from ..sparse.factor import LARGEST_FULL
from ..sparse.symmetric import dense
from ..store import Value, checked
from ..tolerances import ROUNDING
from .definite import elastic_modes


class Damping(Value):
    """The base class of damping laws, which give a damping ratio for each frequency.

    Examples
    --------
    The library's damping laws are instances of this class:

    >>> import flexplant as fx
    >>> isinstance(fx.ModalDamping(0.01), fx.structure.Damping)
    True
    """

    @abstractmethod
    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios of modes. Those of rigid-body modes (omega = 0) are 0.

        Parameters
        ----------
        omega : (k,) array [rad/s]
            Undamped frequencies.
        """


#: field: one damping ratio per mode
_OTHERS = checked(between, low=0.0, high=1.0, hint="1 % is 0.01. Check per cent.", ends="[")


@dataclass(frozen=True, eq=False, repr=False)
class ModalDamping(Damping):
    """Modal damping: one damping ratio for all modes, or one for each mode.

    Rigid-body modes are undamped by default, since a free structure does not dissipate energy in
    them.

    Parameters
    ----------
    ratio : float or (k,) array [-]
        Damping ratio in [0, 1). An array has one entry for each mode, also for rigid-body modes.
        The entries of rigid-body modes are not used.
    others : float [-], optional
        Damping ratio of all modes after those of the array. Without it, the array needs one entry
        for each mode.
    rigid : float [1/s]
        Decay rate c of rigid-body motions, whose velocity decays as ``exp(-c t)``. Only
        ``FEModel.with_damping`` uses it. `assemble_plant` accepts the resulting model, with dense
        matrices. `solve_modes` refuses it, since it computes undamped rigid-body modes only.

    Examples
    --------
    The same ratio for all elastic modes, and given ratios for the first two modes:

    >>> ModalDamping(0.01).zeta([0.0, 1500.0])
    array([0.  , 0.01])
    >>> ModalDamping([0.0, 0.02], others=0.01).zeta([0.0, 1500.0, 2000.0])
    array([0.  , 0.02, 0.01])
    """

    ratio: float | Sequence[float] | FloatArray
    others: float | None = field(default=None, kw_only=True, metadata=_OTHERS)
    rigid: float = field(default=0.0, kw_only=True, metadata=checked(positive, zero=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        ratio = real_array(self.ratio, "ratio")
        if ratio.ndim > 1:
            raise ShapeError(
                f"ratio must be a number or one per mode, got shape {ratio.shape}. Flatten it."
            )
        if self.others is not None and ratio.ndim == 0:
            raise ModelError(
                "others needs an array of ratios for the first modes, but a single ratio holds "
                "for all modes. Leave others out, or pass an array."
            )
        ratio = _ratios(ratio, "damping ratios")
        self._set(ratio=ratio if ratio.ndim else float(ratio))

    @classmethod
    def from_measured(
        cls, poles: Any, *, modes: Sequence[int] | None = None, others: float
    ) -> ModalDamping:
        """Return the damping of measured poles p, whose damping ratios are ``-Re(p) / |p|``.

        Parameters
        ----------
        poles : (k,) complex array [rad/s], or MeasuredModes
            Measured poles, with either sign of the imaginary part.
        modes : (k,) sequence of int
            Mode number of each pole in the model, counted from 1 with rigid-body modes.
            MeasuredModes contain the numbers.
        others : float [-]
            Damping ratio of every mode that was not measured.

        Raises
        ------
        ModelError
            When a pole is unstable or real, or mode numbers are missing or given twice.

        Examples
        --------
        >>> ModalDamping.from_measured([-3 + 300j], modes=[2], others=0.02).zeta([0, 300, 800])
        array([0.       , 0.0099995, 0.02     ])
        """
        numbers = getattr(poles, "modes", None) if modes is None else modes
        values = np.atleast_1d(complex_array(getattr(poles, "poles", poles), "poles"))
        if values.dtype.kind not in "iufc" or values.ndim != 1 or not np.all(np.isfinite(values)):
            raise ModelError(
                f"poles must be a list of complex numbers [rad/s], got {short(poles)}. "
                "MeasuredModes or identify_modes(frf) hold them."
            )
        if numbers is None:
            raise ModelError(
                "the numbers of the measured modes are not known: a pole alone does not say which "
                "mode of the model it damps. Pass modes=[...], counted from 1 with the rigid-body "
                "modes."
            )
        numbers = numbers if several(numbers) else [numbers]
        listed = [whole(number, "a mode number", maximum=10**6) for number in numbers]
        if len(listed) != values.size or len(set(listed)) != len(listed):
            raise ModelError(
                f"{values.size} poles need as many different mode numbers, got {short(listed)}. "
                "Give one number for each pole."
            )
        wrong = (values.real > 0) | (values.imag == 0)
        if wrong.any():
            raise ModelError(
                f"the pole {values[wrong][0]:.6g} rad/s does not oscillate and decay: it has no "
                "damping ratio. Leave it out, or look for a sign or for Hz in place of rad/s."
            )
        ratio = np.full(max(listed, default=0), float(_ratios(others, "others")))
        ratio[np.array(listed, dtype=np.int64) - 1] = -values.real / np.abs(values)
        return cls(ratio, others=others)

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]; 0 for rigid-body modes."""
        omega = real_array(omega, "omega", (None,))
        ratio: Any = self.ratio
        if self.others is not None:
            listed = np.full(omega.size, self.others)
            listed[: np.size(ratio)] = ratio[: omega.size]
            ratio = listed
        elif not isinstance(ratio, float) and ratio.shape != omega.shape:
            raise ShapeError(
                f"{ratio.size} damping ratios for {omega.size} modes (rigid-body modes and "
                "vectors counted): give one ratio for all, exactly one for each, or others=, the "
                "ratio of all modes beyond these."
            )
        return np.where(omega > 0, ratio, 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Rayleigh(Damping):
    """Damping ``D = alpha M + beta K``, with ratios ``alpha / (2 omega) + beta omega / 2``.

    Rigid-body modes are undamped by default, since a free structure does not dissipate energy in
    them.

    Parameters
    ----------
    alpha : float [1/s]
        Factor of the mass-proportional damping.
    beta : float [s]
        Factor of the stiffness-proportional damping.
    rigid : bool
        Whether alpha also damps rigid-body motions. D is then exactly ``alpha M + beta K``. Only
        ``FEModel.with_damping`` uses it. `assemble_plant` accepts the resulting model, with dense
        matrices. `solve_modes` refuses it, since it computes undamped rigid-body modes only.

    References
    ----------
    [CraigKurdila2006]_, section 10.4.

    Examples
    --------
    Damping ratios of a rigid-body mode and of a mode at 100 rad/s:

    >>> Rayleigh(alpha=2.0, beta=0.0).zeta([0.0, 100.0])
    array([0.  , 0.01])
    """

    alpha: float = field(metadata=checked(positive, zero=True, unit="1/s"))
    beta: float = field(metadata=checked(positive, zero=True, unit="s"))
    rigid: bool = field(default=False, kw_only=True, metadata=checked(flag))

    @classmethod
    def fitted(cls, freq: Iterable[float], zeta: Iterable[float]) -> Rayleigh:
        """Return the Rayleigh damping with given damping ratios at given frequencies.

        Two ratios are matched exactly. More than two are fitted by least squares, in which alpha
        and beta do not become negative.

        Parameters
        ----------
        freq : (k,) array [Hz]
            Frequencies, at least two different ones.
        zeta : (k,) array [-]
            Damping ratio at each frequency.

        Raises
        ------
        ModelError
            When a frequency is not positive, or all are equal. Also when no Rayleigh damping with
            alpha and beta of at least 0 gives the two ratios.

        Examples
        --------
        >>> law = Rayleigh.fitted([100.0, 1000.0], [0.01, 0.02])
        >>> law, law.zeta([200 * np.pi, 2000 * np.pi])
        (Rayleigh(alpha=10.1546 1/s, beta=6.10898e-06 s), array([0.01, 0.02]))
        """
        from scipy.optimize import nnls

        hertz = real_array(freq, "freq", (None,))
        ratio = _ratios(real_array(zeta, "zeta", hertz.shape), "zeta")
        if np.any(hertz <= 0) or np.unique(hertz).size < 2:
            raise ModelError(
                f"freq must hold at least two different positive frequencies, got {short(freq)}: "
                "one ratio leaves alpha and beta open. Use ModalDamping for a constant ratio."
            )
        omega = 2 * np.pi * hertz
        terms = 0.5 * np.column_stack([1 / omega, omega])
        scale = np.linalg.norm(terms, axis=0)
        if hertz.size == 2:
            found = np.linalg.solve(terms / scale, ratio) / scale
            found[np.abs(found * scale) < ROUNDING * np.abs(ratio).max()] = 0.0
            if found.min() < 0:
                bound = float(hertz.max() / hertz.min())
                raise ModelError(
                    f"no Rayleigh damping goes through {ratio.tolist()} at {hertz.tolist()} Hz: "
                    f"{'alpha' if found[0] < 0 else 'beta'} would be negative and feed energy in. "
                    f"The two ratios may differ by a factor of {bound:.3g} at most; use "
                    "ModalDamping, with a ratio for each mode."
                )
        else:
            found = nnls(terms / scale, ratio)[0] / scale
        return cls(float(found[0]), float(found[1]))

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]; 0 for rigid-body modes."""
        omega = real_array(omega, "omega", (None,))
        safe = divisor(omega)
        ratio = 0.5 * (self.alpha / safe + self.beta * safe)
        return np.asarray(np.where(omega > 0, ratio, 0.0), dtype=np.float64)


def _ratios(value: Any, name: str) -> FloatArray:
    ratio = real_array(value, name)
    if np.any(ratio < 0) or np.any(ratio >= 1):
        worst = ratio.min() if np.any(ratio < 0) else ratio.max()
        raise ModelError(
            f"{name} must be in [0, 1), got {worst:g}: 1 % is 0.01. Negative ones feed energy in, "
            "and a mode with 1 or more does not oscillate. Check the sign, and whether the value "
            "is in per cent."
        )
    return ratio


def damping_matrix(
    stiffness: Matrix,
    mass: Matrix,
    rigid: FloatArray,
    damping: Damping,
    motions: Callable[[], FloatArray],
) -> FloatArray:
    """Return the full D of a damping law, ``M Phi 2 Z Omega Phi^T M`` over all modes."""
    n = rigid.shape[0]
    if n > LARGEST_FULL:
        raise ModelError(
            f"this damping gives a full D, too large for {n} DOFs (limit "
            f"{LARGEST_FULL}). Pass it to solve_modes(model, damping=...) instead."
        )
    M, K = dense(mass), dense(stiffness)
    loaded = M @ rigid
    if isinstance(damping, Rayleigh):
        D = damping.alpha * (M - loaded @ loaded.T) + damping.beta * K
        return np.asarray(0.5 * (D + D.T), dtype=np.float64)
    elastic, phi = elastic_modes(M, K, rigid, motions=motions)
    r = rigid.shape[1]
    zeta = damping.zeta(np.concatenate([np.zeros(r), elastic]))[r:]
    forces = M @ phi
    D = (forces * (2 * zeta * np.abs(elastic))) @ forces.T
    if isinstance(damping, ModalDamping) and damping.rigid:
        D = D + damping.rigid * (loaded @ loaded.T)
    return np.asarray(0.5 * (D + D.T), dtype=np.float64)


def plain_place(at: Any, name: str) -> Any:
    """Return a label, a point as a tuple or a mapping as they are."""
    if isinstance(at, str | Mapping):
        return at
    try:
        return floats_of(at, "at", 3)
    except ValueError:
        raise LabelError(
            f"{name} must be at a DOF label like '41:z', a point (x, y, z) in metres or a mapping "
            f"{{label: weight}}, got {at!r:.80}. Use dofs.nearest((x, y, z)), which finds a label."
        ) from None


@dataclass(frozen=True, eq=False)
class PointMass(Value):
    """A rigid mass at a place of the structure.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        Place of the mass: a DOF label, a point, or a mapping of DOF labels to weights. At a point
        the mass acts on every translation that the model has there. At a DOF label or a mapping it
        acts on this motion only.
    mass : float [kg]
        Mass. When the place is the label of a rotation, it is a moment of inertia [kg m^2].
    inertia : float or (3,) array [kg m^2]
        Moments of inertia about axes along x, y and z through the centre of the mass. They act on
        the rotations of the model at the point. A model without rotational DOFs computes these
        rotations from its displacements.

    Examples
    --------
    A mass of 3 kg is added to the second mass of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.PointMass("2:x", 3.0)).M.toarray()
    array([[1., 0.],
           [0., 4.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a point mass"))
    mass: float = field(metadata=checked(positive, name="mass of a point mass", zero=True))
    inertia: float | Sequence[float] = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        inertia = real_array(self.inertia, "inertia")
        about = np.broadcast_to(inertia, (3,)) if inertia.size == 1 else inertia
        if about.shape != (3,) or np.any(about < 0):
            raise ModelError(
                f"inertia must be one number or three (about x, y, z), none negative, got "
                f"{inertia.tolist()!r:.80}. Leave products of inertia out: turn the axes."
            )
        if about.any() and isinstance(self.at, str | Mapping):
            raise ModelError(
                f"a point mass with inertia needs a point (x, y, z), got {self.at!r:.80}: a label "
                "names one motion only. Use dofs.xyz of the node as the point."
            )
        self._set(inertia=tuple(about.tolist()))

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the additions to the matrix M, as a list of tuples ("M", row, weight).

        The row (n,) gives a motion of the place from the n DOFs, and the weight is the mass or the
        moment of inertia. The addition is ``weight row^T row``.
        """
        if isinstance(self.at, str | Mapping):
            return [("M", dofs.row(self.at), self.mass)]
        moved = [d for d in ("x", "y", "z") if d in dofs.directions]
        if not moved:
            raise ModelError(
                "the model has no translation for a point mass to ride on. Name a DOF by its label."
            )
        turned = zip(("rx", "ry", "rz"), np.asarray(self.inertia).tolist(), strict=True)
        found = [("M", dofs.row(self.at, d), self.mass) for d in moved]
        return found + [("M", dofs.row(self.at, d), j) for d, j in turned if j]


@dataclass(frozen=True, eq=False)
class Spring(Value):
    """A linear spring between a place and the ground, or between two places.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        One end: a DOF label, a point, or a mapping of DOF labels to weights.
    stiffness : float [N/m or N m/rad]
        Stiffness of the spring. It may be negative, as for attracting magnets in reluctance
        actuators, whose force increases the displacement. A negative stiffness may make rigid-body
        motions unstable. `solve_modes` and `assemble_plant` accept such a model. They refuse a
        model in which a deformation of the structure is unstable.
    direction : str
        Direction of the motion at a point: x, y, z, rx, ry, rz. A DOF label has its own direction.
    to : place, optional
        Place of the other end. None: the ground.

    Examples
    --------
    A spring to the ground is added to the first mass of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.Spring("1:x", 50.0)).K.toarray()
    array([[ 150., -100.],
           [-100.,  100.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a spring"))
    stiffness: float = field(metadata=checked(number, name="stiffness of a spring"))
    direction: str = field(default="z", kw_only=True, metadata=checked(checked_direction))
    to: Place | None = field(
        default=None, kw_only=True, metadata=checked(plain_place, name="a spring")
    )

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the addition to the matrix K, as a list of one tuple ("K", row, weight).

        The row (n,) gives the motion of one end relative to the other from the n DOFs, and the
        weight is the stiffness. The addition is ``weight row^T row``.
        """
        return [("K", _stretch(self, dofs), self.stiffness)]


@dataclass(frozen=True, eq=False)
class Damper(Value):
    """A viscous damper between a place and the ground, or between two places.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        One end: a DOF label, a point, or a mapping of DOF labels to weights.
    rate : float [N s/m or N m s/rad]
        Damping, which is the force per velocity. It must not be negative.
    direction : str
        Direction of the motion at a point: x, y, z, rx, ry, rz. A DOF label has its own direction.
    to : place, optional
        Place of the other end. None: the ground. A damper to the ground also damps rigid-body
        motions, which `solve_modes` refuses unless springs to the ground hold these motions too.
        `assemble_plant` accepts such a model, with dense matrices.

    Examples
    --------
    A damper connects the two masses of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.Damper("1:x", 2.0, to="2:x")).D.toarray()
    array([[ 2., -2.],
           [-2.,  2.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a damper"))
    rate: float = field(metadata=checked(positive, name="rate of a damper", zero=True))
    direction: str = field(default="z", kw_only=True, metadata=checked(checked_direction))
    to: Place | None = field(
        default=None, kw_only=True, metadata=checked(plain_place, name="a damper")
    )

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the addition to the matrix D, as a list of one tuple ("D", row, weight).

        The row (n,) gives the motion of one end relative to the other from the n DOFs, and the
        weight is the damping. The addition is ``weight row^T row``.
        """
        return [("D", _stretch(self, dofs), self.rate)]


Part = PointMass | Spring | Damper


def added_matrices(dofs: DofSet, parts: Iterable[Part] | Part) -> dict[str, sp.csc_array]:
    """Return the terms that parts add to M, K and D, only for the matrices that change."""
    listed = (
        [parts]
        if isinstance(parts, Part)
        else list(instance(parts, Iterable, "parts", "Pass PointMass(...) in [...]."))
    )
    rows: dict[str, list[sp.csc_array]] = {}
    signs: dict[str, list[float]] = {}
    for part in listed:
        instance(part, Part, "a part", "Add your own matrices by model.replace(K=...).")
        for name, row, weight in part.added(dofs):
            if weight:
                scaled = np.sqrt(abs(weight)) * row
                rows.setdefault(name, []).append(sp.csc_array(scaled[:, None]))
                signs.setdefault(name, []).append(float(np.sign(weight)))
    found = {}
    for name, columns in rows.items():
        spread = sp.hstack(columns, format="csc")
        found[name] = sp.csc_array(spread @ sp.diags_array(signs[name]) @ spread.T)
    return found


def _stretch(part: Spring | Damper, dofs: DofSet) -> FloatArray:
    row = dofs.row(part.at, part.direction)
    if part.to is None:
        return row
    row = row - dofs.row(part.to, part.direction)
    if not row.any():
        raise ModelError(
            f"both ends of a {type(part).__name__.lower()} are at {part.at!r:.60}: it would do "
            "nothing. Leave `to` out to fix its other end to the ground."
        )
    return row
