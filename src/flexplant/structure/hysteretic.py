"""Structural damping by loss factors, and the error of its viscous equivalent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..checks import (
    FloatArray,
    Matrix,
    Value,
    between,
    checked,
    element_mask,
    function,
    instance,
    mapping,
    members,
    real_array,
    short,
)
from ..errors import ModelError, ShapeError
from ..labels import DofSet
from ..tolerances import divisor
from .attachments import Spring, added_matrices
from .damping import Damping
from .definite import square

#: part of the strain energy of a mode that regions may have beyond all of it, by rounding
_BEYOND = 1e-6


_REGIONS = "Pass {'pads': (0.3, K_pads)}."


def checked_loss_factor(value: Any, name: str) -> float:
    """Return a loss factor in [0, 2)."""
    why = (
        "The equivalent damping ratio is half of it, and from 1 on there is no oscillation left: "
        "give 0.02 for 2 %."
    )
    return between(value, name, 0.0, 2.0, why, ends="[")


@dataclass(frozen=True, eq=False, repr=False)
class Hysteretic(Damping):
    """Structural damping ``K (1 + i eta)``, as the viscous damping of equal loss at resonance.

    A loss factor has no equation of motion (its free response is not causal), so that modes and
    plants take ``zeta = eta / 2`` in its place. Of a mode's response
    ``1 / (omega_i^2 (1 + i eta) - omega^2)`` the equivalent one is, relatively, off by

        ``eta |1 - r| / sqrt((1 - r^2)^2 + eta^2 r^2)``,  ``r = omega / omega_i``:

    nothing at resonance, eta / (1 + r) away from it, eta at most (statically, where the hysteretic
    response alone has a loss). `error` gives it, `response_error` bounds a whole response.

    With regions of their own loss factors eta_j the stiffness is ``K + i H``, ``H = eta K +
    sum (eta_j - eta) K_j``, and the loss factor of a mode is the mean by strain energy, ``eta_i =
    phi_i^T H phi_i / phi_i^T K phi_i``. That leaves out that H couples modes, most of all those
    of near frequencies: `coupling_errors` compares with the eigenvalues of ``Phi^T (K + i H) Phi``,
    and `solve_modes` warns where it matters. ``frequency_response(model, ports, freq,
    damping=law)`` takes the law itself.

    Parameters
    ----------
    loss_factor : float [-]
        eta, in [0, 2): the energy lost in a cycle over 2 pi times the largest energy stored. Of
        all that is in no region.
    regions : mapping {str: LossRegion or (eta_j, K_j)}, optional
        Regions of other loss factors, each a part of K: a matrix, or Springs that K has; see
        `LossRegion`. They must not overlap. An exported matrix of structural damping (Nastran's K4)
        is one of loss factor 1, beside a `loss_factor` of 0.

    References
    ----------
    [Ewins2000]_, sections 2.4 and 2.7; [JohnsonKienholz1982]_.

    Examples
    --------
    >>> law = Hysteretic(0.02)
    >>> law.zeta([0.0, 100.0]), law.error([0.0, 50.0, 100.0], [100.0])[:, 0].round(4)
    (array([0.  , 0.01]), array([0.02  , 0.0133, 0.    ]))

    A stage on two rubber feet, which hold nearly all of the energy of its first mode:

    >>> import flexplant as fx
    >>> feet = [fx.Spring("1:x", 2e5), fx.Spring("2:x", 3e5)]
    >>> model = fx.chain(masses=[1.0, 2.0], stiffnesses=[5e6]).with_parts(feet)
    >>> law = Hysteretic(0.002, regions={"feet": (0.3, feet)})
    >>> fx.solve_modes(model, damping=law).zeta.round(4)
    array([0.1499, 0.0046])
    """

    loss_factor: float = field(metadata=checked(checked_loss_factor))
    regions: Mapping[
        str, LossRegion | tuple[float, Matrix] | tuple[float, Spring | Iterable[Spring]]
    ] = field(default_factory=dict, kw_only=True, metadata=checked(mapping, hint=_REGIONS))

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(regions={str(name): _region(name, part) for name, part in self.regions.items()})

    @property
    def _regions(self) -> Mapping[str, LossRegion]:
        return cast(Mapping[str, LossRegion], self.regions)

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]: eta / 2, 0 for rigid ones.

        Raises
        ------
        ModelError
            When there are regions: where a mode bends decides, which its frequency does not say.
        """
        omega = real_array(omega, "omega", (None,))
        if self._regions:
            raise ModelError(
                f"{self!r} damps a mode by where it bends, which its frequency does not say. Solve "
                "with it, solve_modes(model, damping=law), or call ratios(omega, shapes, K, dofs)."
            )
        return np.where(omega > 0, 0.5 * self.loss_factor, 0.0)

    def ratios(self, omega: FloatArray, shapes: FloatArray, K: Matrix, dofs: DofSet) -> FloatArray:
        """Return the damping ratios (k,) of shapes: half their loss factors, 0 for rigid ones.

        Raises
        ------
        ModelError
            When regions have less than none or more than all of a shape's strain energy.
        """
        shapes = real_array(
            shapes, "shapes", (len(instance(dofs, DofSet, "dofs", "Pass model.dofs.")), None)
        )
        if not self._regions:
            return self.zeta(omega)
        stored = np.sum(shapes * np.asarray(K @ shapes), axis=0)
        elastic = (real_array(omega, "omega", (None,)) > 0) & (stored > 0)
        whole = np.where(elastic, stored, 1.0)
        found, all_of = np.full(elastic.size, self.loss_factor), np.zeros(elastic.size)
        for name, region in self._regions.items():
            part = np.sum(shapes * np.asarray(region.matrix(dofs) @ shapes), axis=0)
            share = np.where(elastic, part / whole, 0.0)
            all_of += share
            found += (region.loss_factor - self.loss_factor) * share
            lowest, highest = float(share.min(initial=0.0)), float(all_of.max(initial=0.0))
            if lowest < -_BEYOND or highest > 1 + _BEYOND:
                raise ModelError(
                    f"region {name!r} and those before it hold {100 * highest:.4g} % of the strain "
                    f"energy of a mode (lowest part {100 * lowest:.4g} %): they overlap, or are no "
                    "part of this K. Give each stiffness once, and springs that K has."
                )
        return np.where(elastic, 0.5 * found, 0.0)

    def loss_stiffness(self, dofs: DofSet) -> Any:
        """Return ``H - eta K = sum (eta_j - eta) K_j`` (n, n), None without regions."""
        parts = [
            (region.loss_factor - self.loss_factor) * region.matrix(dofs)
            for region in self._regions.values()
        ]
        return sum(parts[1:], parts[0]) if parts else None

    def coupling_errors(self, omega: FloatArray, shapes: FloatArray, dofs: DofSet) -> FloatArray:
        """Return by how much, relatively, loss factors of modes change as H couples them (k,).

        Parameters
        ----------
        omega : (k,) array [rad/s]
            Undamped frequencies.
        shapes : (n, k) array
            Their mass-normalised shapes.
        dofs : DofSet
            The n rows.
        """
        from scipy.optimize import linear_sum_assignment

        H = self.loss_stiffness(dofs)
        omega = real_array(omega, "omega", (None,))
        squares, found = omega**2, np.zeros(omega.size)
        elastic = np.flatnonzero(omega > 0)
        if H is None or not elastic.size:
            return found
        some, squares = shapes[:, elastic], squares[elastic]
        loss = some.T @ np.asarray(H @ some) + self.loss_factor * np.diag(squares)
        # each mode by itself, and all of them: matched, as near frequencies may change places
        alone = squares + 1j * np.diag(loss)
        coupled = np.asarray(la.eigvals(np.diag(squares) + 1j * loss), dtype=np.complex128)
        gap: FloatArray = np.abs(alone[:, None] - coupled) / squares[:, None]
        first, second = linear_sum_assignment(gap)
        eta, true = alone[first].imag / squares[first], coupled[second].imag / coupled[second].real
        found[elastic[first]] = np.abs(eta - true) / divisor(true)
        return found

    def error(
        self, freq: FloatArray, natural: FloatArray, *, zeta: FloatArray | None = None
    ) -> FloatArray:
        """Return by how much, relatively, the viscous responses of modes differ (n_freq, k).

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Where.
        natural : (k,) array [Hz]
            Natural frequencies; rigid-body modes (0) differ by nothing.
        zeta : (k,) array [-], optional
            Their damping ratios, where regions differ: ``modes.zeta``.

        Raises
        ------
        ModelError
            When a frequency is negative, or regions need the ratios.
        """
        at, own = _checked_hertz(freq, "freq")[:, None], _checked_hertz(natural, "natural")
        r = at / divisor(own)
        eta = 2.0 * (self.zeta(own) if zeta is None else real_array(zeta, "zeta", own.shape))
        size = np.sqrt((1 - r**2) ** 2 + (eta * r) ** 2)
        # without loss both are infinite at resonance, and the same
        found = eta * np.abs(1 - r) / divisor(size)
        return np.asarray(np.where(own > 0, found, 0.0), dtype=np.float64)

    def response_error(
        self,
        freq: FloatArray,
        natural: FloatArray,
        gains: FloatArray,
        *,
        zeta: FloatArray | None = None,
    ) -> FloatArray:
        """Return a bound (n_freq,) of the difference between hysteretic and viscous responses.

        The sum over the modes of ``|gain_i| |h_viscous - h_hysteretic|``: equality for one mode.

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Where; above 0 when there are rigid-body modes.
        natural : (k,) array [Hz]
        gains : (k,) array [1/kg]
            ``phi_out phi_in`` of each mode, of mass-normalised shapes: receptance [m/N].
        zeta : as in `error`, optional
        """
        own = _checked_hertz(natural, "natural")
        weights = np.abs(real_array(gains, "gains", own.shape))
        relative = self.error(freq, own, zeta=zeta)
        eta = 2.0 * (self.zeta(own) if zeta is None else real_array(zeta, "zeta", own.shape))
        at, omega = 2 * np.pi * real_array(freq, "freq")[:, None], 2 * np.pi * own
        stiffness = np.abs(omega**2 * (1 + 1j * eta) - at**2)
        part = relative / divisor(stiffness)
        return np.asarray(part @ weights, dtype=np.float64)


def _checked_hertz(value: Any, name: str) -> FloatArray:
    found = real_array(value, name, (None,))
    if np.any(found < 0):
        raise ModelError(f"{name} must not be negative, got {found.min():g} Hz. Take its size.")
    return found


def _region(name: Any, part: Any) -> LossRegion:
    if isinstance(part, LossRegion):
        return part
    if isinstance(part, tuple | list) and len(part) == 2:
        return LossRegion(*part)
    raise ModelError(
        f"region {name!r} must be (loss factor, stiffness), got {short(part)}. Give "
        "(0.3, K_pads), or (0.3, [Spring(...)])."
    )


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

    Examples
    --------
    >>> import flexplant as fx
    >>> LossRegion(0.3, fx.Spring("1:x", 5e4)).loss_factor
    0.3
    """

    loss_factor: float = field(metadata=checked(checked_loss_factor))
    stiffness: Matrix | Spring | Iterable[Spring]

    def __post_init__(self) -> None:
        super().__post_init__()
        given: Any = self.stiffness
        if isinstance(given, Spring):
            given = (given,)
        elif sp.issparse(given) or isinstance(given, np.ndarray):
            square(given, "stiffness of a region")
        else:
            hint = "Give a part of K, or Spring(...) in [...]."
            given = members(given, Spring, "stiffness of a region", hint)
        self._set(stiffness=given)

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

        Examples
        --------
        >>> import flexplant as fx
        >>> def build(E):
        ...     return fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.02, elements=(2, 2),
        ...                               density=2702, youngs_modulus=E, poisson_ratio=0.35)
        >>> LossRegion.of_elements(0.1, build, [[True, False], [False, False]],
        ...                        youngs_modulus=70e9)
        LossRegion(loss_factor=0.1, stiffness=array (27, 27))
        """
        mask = element_mask(elements, "elements")
        function(build, "build", "It takes the modulus of each element and returns a model.")
        modulus = real_array(youngs_modulus, "youngs_modulus")
        modulus = np.broadcast_to(
            modulus if not modulus.ndim else real_array(modulus, "youngs_modulus", mask.shape),
            mask.shape,
        )
        more: Any = build(modulus * (1.0 + mask)).K - build(np.array(modulus)).K
        return cls(loss_factor, sp.csc_array(more))

    def matrix(self, dofs: DofSet) -> Any:
        """Return K_i (n, n), sparse."""
        given: Any = self.stiffness
        if isinstance(given, tuple):
            return added_matrices(dofs, given).get("K", sp.csc_array((len(dofs),) * 2))
        if given.shape != (len(dofs), len(dofs)):
            raise ShapeError(
                f"the stiffness of a region has shape {given.shape}, the structure has "
                f"{len(dofs)} DOFs: give a part of its K, over the same DOFs."
            )
        return sp.csc_array(given)
