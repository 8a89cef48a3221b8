"""From modes to states: the one place where (M, D, K) becomes (A, B, C, D)."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, instance, positive
from ..errors import ModelError, SolverError, warn
from ..labels import Place
from ..lti.blocks_of_states import block_diagonal
from ..modes import Modes, NormalForm
from ..modes.normal_forms import PROPORTIONAL, RealForm, modal, pole_pairs, real_form
from ..reduction import ReducedModel
from ..store import Value, checked
from ..structure import FEModel
from ..structure.rigid import Structure as Structure
from ..tolerances import SAME, TINY

T = TypeVar("T")

#: a dense eigenproblem of more DOFs than this is refused: reduce first
LARGEST_DENSE = 2500
#: condition c of a complex mode above which its block costs too many digits: rounding times c^2
ILL_CONDITIONED = 30.0
#: the form of a realisation whose modes do not see each other
MODAL = "modal blocks"


def none() -> FloatArray:
    """Return nothing (0,)."""
    return np.zeros(0)


def natural(pairs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angular frequencies [rad/s] and damping ratios of blocks (b, 2, 2)."""
    # `omega^2 = det, 2 zeta omega = -trace`; a frequency is 0 where nothing holds the mode back
    omega = np.sqrt(np.maximum(np.linalg.det(pairs), 0.0))
    trace = np.trace(pairs, axis1=1, axis2=2)
    return omega, np.asarray(-0.5 * trace / np.maximum(omega, TINY))


def changed_pairs(
    pairs: FloatArray, stiffness: FloatArray | float, damping: FloatArray | float
) -> FloatArray:
    """Return blocks (b, 2, 2) with omega^2 and 2 zeta omega changed by relative amounts (b,)."""
    # the second row of a block changes, whatever its form
    trace = np.trace(pairs, axis1=1, axis2=2)
    changed = np.array(pairs)
    changed[:, 1, 1] += damping * trace
    held = stiffness * np.linalg.det(pairs) - damping * trace * pairs[:, 0, 0]
    changed[:, 1, 0] -= held / pairs[:, 0, 1]
    return changed


@dataclass(frozen=True, eq=False, repr=False)
class ModalRealisation(Value):
    """A structure's modes as first-order blocks, with maps from and to its DOFs.

    ``dx/dt = A x + N' f, q = S x`` with forces f and displacements q at the model's DOFs; each mode
    is one 2 x 2 block of A. A rigid-body mode has the states (omega_r q, dq/dt), where omega_r is
    the first elastic frequency, so that both have similar size.
    """

    model: Structure
    pairs: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    names: tuple[str, ...]
    n_rigid: int
    static_outputs: FloatArray = field(default_factory=none)
    static_inputs: FloatArray = field(default_factory=none)
    coupling: FloatArray | None = None
    form: str = MODAL

    def __post_init__(self) -> None:
        for name in ("static_outputs", "static_inputs"):
            given, n = getattr(self, name), self.inputs.shape[0]
            self._set(**{name: given.reshape(n, given.size // max(n, 1))})

    @property
    def n_modes(self) -> int:
        """Number of modes, rigid-body ones included, residual vectors not."""
        return sum(name.startswith("mode") for name in self.names) // 2

    @property
    def elastic(self) -> range:
        """The numbers of the elastic modes, from 1, rigid-body ones included."""
        return range(self.n_rigid + 1, self.n_modes + 1)

    @property
    def uncoupled(self) -> ModalRealisation:
        """These modes, each of which has its own frequency and damping."""
        if self.form != MODAL:
            raise ModelError(
                f"the modes of this plant are coupled by damping ({self.form}): frequency and "
                "damping of one mode are not its own, so that no Delta belongs to it. Deltas on "
                "the parameters of a fit do: plant.uncertain(fit)."
            )
        return self

    def once(self, key: Hashable, found: Callable[[], T]) -> T:
        """Return what is known of the structure by a key, found at the first call only."""
        known: dict[Hashable, Any] = self.__dict__.setdefault("_known", {})
        if key not in known:
            known[key] = found()
        value: T = known[key]
        return value

    @property
    def A(self) -> FloatArray:
        """The (2 b, 2 b) matrix: block-diagonal, but for coupled velocities."""
        A = block_diagonal(self.pairs)
        if self.coupling is not None:
            A[1::2, 1::2] -= self.coupling
        return A

    @property
    def blocks(self) -> list[int]:
        """Sizes of the diagonal blocks of A: 2 for each uncoupled mode, one for coupled ones."""
        b = self.pairs.shape[0]
        if self.coupling is None or not np.any(self.coupling):
            return [2] * b
        coupled = np.flatnonzero(np.any(self.coupling, axis=0) | np.any(self.coupling, axis=1))
        first, last = int(coupled[0]), int(coupled[-1])
        return [2] * first + [2 * (last - first + 1)] + [2] * (b - 1 - last)

    def row(self, at: Place, direction: str) -> FloatArray:
        """Return the row over the model's DOFs for a place; its nonzero entries are kept."""
        if not isinstance(at, str | tuple):
            return self.model.row(at, direction)

        def found() -> tuple[IntArray, FloatArray, int]:
            row = self.model.row(at, direction)
            used = np.flatnonzero(row)
            return used, row[used], row.size

        used, weights, size = self.once(("row", at, direction), found)
        row = np.zeros(size)
        row[used] = weights
        return row

    def load(self, forces: FloatArray) -> FloatArray:
        """Return forces on the model's DOFs in the coordinates of `row`."""
        return forces

    def force(self, row: FloatArray) -> FloatArray:
        """Return the column (2 b,) of B for a unit force along a row of DOFs."""
        return self._along(row, "inputs")

    def motion(self, row: FloatArray, derivative: int) -> FloatArray:
        """Return the row (2 b,) of C for a displacement's derivative; rows (p, n) give (p, 2 b)."""
        known = self._along(row, "outputs") if row.ndim == 1 else np.asarray(row @ self.outputs)
        C = known.reshape(-1, self.pairs.shape[0], 1, 2)
        for _ in range(derivative):
            slowed = 0.0 if self.coupling is None else C[:, :, 0, 1] @ self.coupling
            C = C @ self.pairs
            C[:, :, 0, 1] -= slowed
        return C.reshape(*np.shape(row)[:-1], -1)

    def _along(self, row: FloatArray, table: str) -> FloatArray:
        """Return a row over DOFs times a table; that of a place is found once."""
        used = np.flatnonzero(row)

        def found() -> FloatArray:
            product = np.asarray(row @ getattr(self, table))
            product.flags.writeable = False
            return product

        return self.once((table, used.tobytes(), row[used].tobytes()), found)

    def at_once(self, row: FloatArray) -> FloatArray:
        """Return the displacement along a row (n,) that unit forces at the DOFs (n,) cause at once.

        Zero unless modes were replaced by their flexibility.
        """
        return np.asarray(self.static_inputs @ (row @ self.static_outputs))


def realise(model: Structure | ModalRealisation) -> ModalRealisation:
    """Return the modal realisation of a structure; one that is given passes through."""
    if isinstance(model, ModalRealisation):
        return model
    if isinstance(model, Modes):
        if np.iscomplexobj(model.phi):
            return _complex(model, model.omega, model.zeta, np.asarray(model.phi), model.n_rigid)
        omega, zeta, basis = model.basis_omega, model.basis_zeta, np.real(model.basis)
        return modes_as_states(model, omega, zeta, basis, model.n_rigid, model.omega.size)
    if isinstance(model, FEModel | ReducedModel):
        if model.M.shape[0] > LARGEST_DENSE:
            raise ModelError(
                f"a plant of all {model.M.shape[0]} DOFs needs a dense eigenproblem of that size. "
                "Pass solve_modes(model, count=...) or a reduced model instead."
            )
        if isinstance(model, ReducedModel) and model.massless.size:
            return _at_once(model)
        return _of_matrices(
            model,
            real_form(model.M, model.D, model.K, model.rigid_body, lambda: model.body_motions),
        )
    raise ModelError(
        f"a plant is assembled from an FEModel, Modes or ReducedModel, got {type(model).__name__}. "
        "A state-space model made elsewhere comes in through StandardPlant.from_statespace."
    )


def _at_once(model: ReducedModel) -> ModalRealisation:
    """Return the realisation of a model whose massless coordinates (MacNeal) answer at once."""
    heavy, follow, flexibility = model.condensed()
    found = realise(heavy)
    values, vectors = np.linalg.eigh(flexibility)
    # flexibilities relative to the softest: those left out are stiff enough to count as rigid
    kept = values > 1e-15 * values[-1]
    half = vectors[:, kept] * np.sqrt(values[kept])
    return found.replace(
        model=model,
        inputs=follow @ found.inputs,
        outputs=follow @ found.outputs,
        static_outputs=half,
        static_inputs=half,
    )


def _of_matrices(model: FEModel | ReducedModel, real: RealForm) -> ModalRealisation:
    """Modal blocks where they hold the damping to working precision, else the dense form."""
    # a mode that D does not couple to others is a block for any damping, critical and overdamped
    # too
    omega, r = real.omega, real.n_rigid
    if real.drags:
        why = f"dampers to ground drag rigid-body motion at up to {real.drag:.3g} 1/s"
        return _dense(model, real, why)
    if real.is_proportional:
        zeta = np.zeros_like(omega)
        zeta[r:] = 0.5 * np.diag(real.C)[r:] / np.abs(omega[r:])
        return modes_as_states(model, omega, zeta, real.phi, r, omega.size)
    # rigid-body motions are undamped by convention, in both forms alike
    C = real.C.copy()
    C[:r], C[:, :r] = 0.0, 0.0
    real = real._replace(C=C)
    try:
        form: NormalForm = modal(real)
    except ModelError:
        return _dense(model, real, f"an overdamped pair {_worst_mode(real, overdamped=True)}")
    except SolverError:
        return _dense(model, real, f"two poles coalesce {_worst_mode(real)}")
    if real.condition(form) > ILL_CONDITIONED:
        return _dense(model, real, f"two poles nearly coalesce {_worst_mode(real)}")
    return _complex(model, form.omega, form.zeta, np.asarray(form.phi), r)


def _worst_mode(real: RealForm, *, overdamped: bool = False) -> str:
    """Return which undamped mode takes most part in the worst conditioned pole."""
    r = real.n_rigid
    omega, C = real.omega[r:], real.C[r:, r:]
    k = omega.size
    A = np.block([[np.zeros((k, k)), np.diag(np.abs(omega))], [-np.diag(omega), -C]])
    values, left, right = la.eig(A, left=True)
    overlap = np.abs(np.sum(left.conj() * right, axis=0))
    if overdamped:
        overlap = np.where(np.abs(values.imag) <= SAME * np.abs(values), overlap, 2.0)
    worst = right[:, int(np.argmin(overlap))]
    i = int(np.argmax(np.abs(worst[:k]) ** 2 + np.abs(worst[k:]) ** 2))
    return f"near mode {r + i + 1} ({omega[i] / (2 * np.pi):.4g} Hz undamped)"


def _dense(model: Structure, real: RealForm, why: str) -> ModalRealisation:
    """Undamped modes, their velocities coupled by all of D."""
    # rigid-body motions that D does not damp stay separate double integrators
    r, C, phi = real.n_rigid, real.C.copy(), real.phi.copy()
    if r:
        size = PROPORTIONAL * max(float(np.abs(C).max()), TINY)
        rank, turned = _turned(C[:, :r], size)
        phi[:, :r] = phi[:, :r] @ turned
        C[:, :r] = C[:, :r] @ turned
        C[:r] = turned.T @ C[:r]
        C[: r - rank], C[:, : r - rank] = 0.0, 0.0
    b = real.omega.size
    blocks = modes_as_states(model, real.omega, np.zeros(b), phi, r, b)
    pairs = np.array(blocks.pairs)
    pairs[:, 1, 1] = -np.diag(C)
    return blocks.replace(pairs=pairs, coupling=C - np.diag(np.diag(C)), form=f"dense: {why}")


def _turned(drag: FloatArray, size: float) -> tuple[int, FloatArray]:
    """Return how many rigid-body motions are dragged, and a basis with the others first."""
    rank = int(np.linalg.matrix_rank(drag, tol=size))
    if rank in (0, drag.shape[1]):
        return rank, np.eye(drag.shape[1])
    return rank, np.linalg.svd(drag)[2][::-1].T


def modes_as_states(
    model: Structure, omega: FloatArray, zeta: FloatArray, phi: FloatArray, rigid: int, modes: int
) -> ModalRealisation:
    """Equation (5): states (omega q, dq/dt) of each mode; residual vectors are fast modes."""
    # an unstable mode has [[0, |omega|], [|omega|, -2 zeta |omega|]]
    n, b = phi.shape
    size = np.abs(omega)
    scale = np.where(size > 0, size, size[rigid:].min(initial=np.inf) if size[rigid:].size else 1.0)
    pairs = np.zeros((b, 2, 2))
    pairs[:, 0, 1] = scale
    pairs[:, 1, 0] = -omega * size / scale
    pairs[:, 1, 1] = -2.0 * zeta * size
    inputs, outputs = np.zeros((n, b, 2)), np.zeros((n, b, 2))
    inputs[:, :, 1] = phi
    outputs[:, :, 0] = phi / scale
    names = _state_names(b, modes)
    return ModalRealisation(
        model, pairs, inputs.reshape(n, 2 * b), outputs.reshape(n, 2 * b), names, rigid
    )


def _complex(
    model: Structure, omega: FloatArray, zeta: FloatArray, phi: ComplexArray, rigid: int
) -> ModalRealisation:
    """Real 2 x 2 blocks [[s, w], [-w, s]] of complex modes lambda = s + i w."""
    # with `phi' (2 lambda M + D) phi = 2 i w` the displacement per force is the sum of
    # `phi phi' / (2 i w (s - lambda))` and its conjugate; the states are scaled like those of a
    # real mode (omega q, dq/dt). Rigid-body and unstable modes are blocks of real form
    n, start = phi.shape[0], int(np.count_nonzero(omega <= 0))
    elastic = pole_pairs(omega, zeta)[0][start:]
    swing, size = elastic.imag, omega[start:]
    first = float(np.abs(omega[rigid:]).min()) if omega.size > rigid else 1.0
    real = modes_as_states(
        model, np.append(omega[:start], first), np.append(zeta[:start], 0.0),
        np.column_stack([phi[:, :start].real, np.zeros(n)]), rigid, start,
    )  # fmt: skip
    pairs = np.zeros((elastic.size, 2, 2))
    pairs[:, 0, 0] = pairs[:, 1, 1] = elastic.real
    pairs[:, 0, 1], pairs[:, 1, 0] = swing, -swing
    driven = -1j * phi[:, start:] * (size / swing)
    inputs = np.stack([driven.real, -driven.imag], axis=2)
    outputs = np.stack([phi[:, start:].real, phi[:, start:].imag], axis=2) / size[:, None]
    found = real.replace(
        pairs=np.concatenate([real.pairs[:start], pairs]),
        inputs=np.hstack([real.inputs[:, : 2 * start], inputs.reshape(n, -1)]),
        outputs=np.hstack([real.outputs[:, : 2 * start], outputs.reshape(n, -1)]),
        names=_state_names(omega.size, omega.size),
    )
    return _with_two_shapes(found, omega, zeta, phi, slice(rigid, start))


def _with_two_shapes(
    found: ModalRealisation, omega: FloatArray, zeta: FloatArray, phi: ComplexArray, unstable: slice
) -> ModalRealisation:
    """Return a realisation whose unstable blocks have a shape for each of their poles."""
    # `v1 v1' / ((s1 - s2) (s - s1)) - v2 v2' / ((s1 - s2) (s - s2))` is the displacement per force;
    # the states (|omega| q, dq/dt) of a block are `[[|omega|, |omega|], [s1, s2]]` times those of
    # its two poles
    n = phi.shape[0]
    inputs, outputs = found.inputs.reshape(n, -1, 2).copy(), found.outputs.reshape(n, -1, 2).copy()
    grow, decay = (part.real for part in pole_pairs(omega, zeta))
    for i in range(unstable.start, unstable.stop):
        s1, s2 = grow[i], decay[i]
        both = np.column_stack([phi[:, i].real + phi[:, i].imag, phi[:, i].real - phi[:, i].imag])
        mix = np.array([[-omega[i], -omega[i]], [s1, s2]])
        inputs[:, i] = (both * np.array([1.0, -1.0]) / (s1 - s2)) @ mix.T
        outputs[:, i] = both @ np.linalg.inv(mix)
    return found.replace(inputs=inputs.reshape(n, -1), outputs=outputs.reshape(n, -1))


def _state_names(blocks: int, modes: int) -> tuple[str, ...]:
    names = [f"mode{i}" for i in range(1, modes + 1)]
    names += [f"residual{i}" for i in range(1, blocks - modes + 1)]
    return tuple(f"{name}:{part}" for name in names for part in ("q", "v"))


class ResidualForm(Value):
    """How the residual compliance of a reduction appears in a plant: as it is, unless said."""

    def applied(self, realisation: ModalRealisation) -> ModalRealisation:
        """Return the modes of a structure in this form."""
        return realisation


@dataclass(frozen=True, eq=False)
class FastStates(ResidualForm):
    """Residual attachment vectors are kept as additional modes of high frequency (the default).

    An attachment vector is the static deformation that the computed modes lack under a load. With
    these modes, displacements do not respond to forces at once: the plant is strictly proper
    between forces and displacements. It can then be sampled without a delay, simulated, and used in
    a Kalman filter with white forces. Each vector costs two states.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.FastStates()
    FastStates()
    """


@dataclass(frozen=True, eq=False)
class Feedthrough(ResidualForm):
    """Attachment vectors, or all modes above a frequency, become their static flexibility.

    An attachment vector is the static deformation that the computed modes lack under a load.
    Displacements then respond to forces at once: the matrices D12, D22 and D11 contain the static
    flexibility ``phi phi' / omega^2`` of the modes that were replaced. Velocities and accelerations
    of these modes are neglected, because they are small at frequencies far below those of the
    modes. White forces then reach displacements directly, and samples would have infinite variance.
    For Kalman filters and simulation, give the forces a `shape`. A simulation needs a delay of at
    least one sample, which every machine has.

    Parameters
    ----------
    above : float [Hz], optional
        Frequency above which modes are replaced too. By default only the attachment vectors are
        replaced.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses(rate=None).assembled
    >>> fx.plant.Feedthrough(above=1e3)
    Feedthrough(above=1000.0)
    """

    above: float | None = field(default=None, metadata=checked(positive))

    def applied(self, realisation: ModalRealisation) -> ModalRealisation:
        """Return the modes of a structure with the fast ones replaced by their static flexibility.

        ModelError when nothing would be replaced, or everything.
        """
        b = realisation.pairs.shape[0]
        fast = np.array([name.startswith("residual") for name in realisation.names[::2]])
        if self.above is not None:
            omega = np.sqrt(np.abs(np.linalg.det(realisation.pairs)))
            fast |= omega > 2.0 * np.pi * self.above
        if not fast.any() or fast.all():
            which = "attachment vectors" if self.above is None else f"modes above {self.above:g} Hz"
            raise ModelError(
                f"the model has {'nothing but' if fast.any() else 'no'} {which}: "
                "fx.plant.Feedthrough(above=...) says which modes become static, and "
                "solve_modes(..., compliance_at=...) keeps the compliance of those left out."
            )
        n = realisation.outputs.shape[0]
        pairs = realisation.pairs[fast]
        see = realisation.outputs.reshape(n, b, 2)[:, fast].reshape(n, -1)
        push = realisation.inputs.reshape(n, b, 2)[:, fast]
        settled = -np.einsum("bij,nbj->nbi", np.linalg.inv(pairs), push).reshape(n, -1)
        kept = np.repeat(~fast, 2)
        coupling = realisation.coupling
        if coupling is not None:
            # damping between a mode that stays and one that answers at once is left out with it
            coupling = coupling[np.ix_(~fast, ~fast)]
        return realisation.replace(
            pairs=realisation.pairs[~fast],
            inputs=realisation.inputs[:, kept],
            outputs=realisation.outputs[:, kept],
            names=tuple(n for n, keep in zip(realisation.names, kept, strict=True) if keep),
            static_outputs=np.hstack([realisation.static_outputs, see]),
            static_inputs=np.hstack([realisation.static_inputs, settled]),
            coupling=coupling,
        )


def plant_modes(
    model: Structure | ModalRealisation, residual: ResidualForm | None = None
) -> ModalRealisation:
    """Return the modes of a structure as a plant takes them; FastStates where nothing is given."""
    way = FastStates() if residual is None else residual
    instance(way, ResidualForm, "residual", "Pass fx.plant.FastStates() or fx.plant.Feedthrough().")
    realisation = realise(model)
    if realisation.form != MODAL and realisation is not model:
        warn(
            f"this plant is not in modal blocks but {realisation.form}. It is exact all the same; "
            "the damping couples its modes, so that what costs O(n) a frequency or sample costs "
            "O(n^2) or more, and mode by mode uncertainty is not defined. See plant.form."
        )
    return way.applied(realisation)
