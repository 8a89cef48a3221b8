"""Importance of modes for channels, and bounds of the error without the other modes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from ..arrays import FloatArray, IntArray, name_list, positive, real_array, whole
from ..errors import ModelError, aligned, counted
from ..labels import Place
from ..lti.balancing import hankel_values
from ..lti.blocks_of_states import block_diagonal
from ..lti.statespace import StateSpace
from ..modes.modes import Modes
from ..modes.solve import labels_of, places
from ..store import Value, checked
from ..structure.definite import refuse_unstable


def peak_gains(omega: FloatArray, zeta: FloatArray) -> FloatArray:
    """Return the peaks of ``1 / |omega^2 - w^2 + 2 i zeta omega w|``; infinite without damping."""
    low = zeta < np.sqrt(0.5)
    damped = np.where(low, 2 * zeta * np.sqrt(np.maximum(1 - zeta**2, 0.0)), 1.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (damped * omega**2))


@dataclass(frozen=True, eq=False, repr=False)
class ModeRanking(Value):
    """Importance of each elastic mode for each channel, computed by `rank_modes`.

    A channel is a pair of an input and an output. The vector b holds the displacements of a mode at
    the inputs, and c those at the outputs.

    Parameters
    ----------
    modes : (m,) array of int
        Mode numbers, from 1.
    freq : (m,) array [Hz]
        Frequencies of the modes.
    values : (m, p, q) array [m/N]
        Modal Hankel values ``|c b| / (4 zeta omega^2)`` of m modes from q inputs to p outputs. They
        are approximate Hankel singular values of a single mode.
    total : (m,) array [m/N]
        Modal Hankel values of all channels together, ``||c|| ||b|| / (4 zeta omega^2)``.
    peak : (m,) array [m/N]
        Largest singular value of the response of each mode over all frequencies.
    exact : (2 m,) array [m/N]
        Hankel singular values of the model of all elastic modes together, from Lyapunov equations,
        the largest first. There are two for each mode. They are close to its `total` if damping is
        low and the modes are well separated.
    inputs, outputs : sequence of str
        Names of the inputs and outputs.

    Examples
    --------
    In mode 2, the middle mass is at rest, so that mode 3 is more important:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> modes = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.01))
    >>> ranking = fx.reduction.rank_modes(modes, inputs=["1:x"], outputs=["2:x"])
    >>> ranking.order  # mode 2 is still at "2:x"
    array([3, 2])
    """

    modes: IntArray
    freq: FloatArray
    values: FloatArray
    total: FloatArray
    peak: FloatArray
    exact: FloatArray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def order(self) -> IntArray:
        """The mode numbers, the most important first."""
        return np.asarray(self.modes[np.argsort(-self.total, kind="stable")])

    def __repr__(self) -> str:
        first = ", ".join(str(i) for i in self.order[:6])
        more = ", ..." if self.modes.size > 6 else ""
        channels = f"{counted(len(self.inputs), 'input')} to {counted(len(self.outputs), 'output')}"
        found = counted(self.modes.size, "elastic mode")
        return f"<ModeRanking: {found}, {channels}; by Hankel value: {first}{more}>"

    def table(self, most: int = 12) -> str:
        """Return a table of the `most` most important modes, each with its main channel."""
        rows = []
        top = float(self.total.max(initial=0.0)) or 1.0
        for i in np.argsort(-self.total, kind="stable")[: whole(most, "most")]:
            out, into = np.unravel_index(int(np.argmax(self.values[i])), self.values[i].shape)
            sizes = f"{self.total[i]:.3g}", f"{self.peak[i]:.3g}", f"{self.total[i] / top:.2%}"
            channel = f"{self.inputs[into]} -> {self.outputs[out]}"
            rows.append((str(self.modes[i]), f"{self.freq[i]:.2f}", *sizes, channel))
        head = ("mode", "f [Hz]", "Hankel", "peak", "of the largest", "channel")
        return "\n".join(aligned(head, rows))


def rank_modes(
    modes: Modes, *, inputs: Place | Iterable[Place], outputs: Place | Iterable[Place] = ()
) -> ModeRanking:
    """Return the importance of each elastic mode for each channel, by Hankel singular values.

    The two Hankel singular values of a single lightly damped mode are about
    ``||c|| ||b|| / (4 zeta omega^2)``. Here b holds the modal forces of unit forces at the inputs,
    and c holds the displacements of the mode at the outputs. In a model of many modes the values
    are nearly the same if the frequencies differ by much more than the widths of the resonances.

    Parameters
    ----------
    modes : Modes
        Real and damped modes. Attachment vectors are ignored.
    inputs, outputs : place or sequence of places
        Places of forces and displacements. A place is a DOF label, a point (x, y, z), at which the
        direction is z, or a mapping {label: weight}. Without `outputs`, the displacements are taken
        at the inputs.

    Raises
    ------
    ModelError
        When the modes are complex, or an elastic mode is undamped.

    References
    ----------
    [Gregory1984]_; [Gawronski2004]_, chapter 4.

    Examples
    --------
    From one end of a chain to the other, mode 2 is more important than mode 3:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> modes = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.01))
    >>> fx.reduction.rank_modes(modes, inputs=["1:x"], outputs=["3:x"]).order
    array([2, 3])
    """
    refuse_unstable(modes, "a ranking of modes")
    into, out, B, C = modal_channels(modes, inputs, outputs)
    r = modes.n_rigid
    omega, zeta = modes.omega[r:], modes.zeta[r:]
    b, c = B[r:], C[:, r:]
    if np.any(zeta <= 0):
        i = int(np.argmin(zeta))
        raise ModelError(
            f"mode {r + 1 + i} is undamped: its Hankel values are infinite. Solve the modes with "
            "damping=ModalDamping(...)."
        )
    half = 1.0 / (4 * zeta * omega**2)
    force, seen = np.linalg.norm(b, axis=1), np.linalg.norm(c, axis=0)
    return ModeRanking(
        np.arange(r + 1, modes.n_modes + 1),
        omega / (2 * np.pi),
        np.abs(np.einsum("pm,mq,m->mpq", c, b, half)),
        force * seen * half,
        force * seen * peak_gains(omega, zeta),
        _exact(omega, zeta, b, c),
        into,
        out,
    )


def modal_channels(
    modes: Modes, inputs: Place | Iterable[Place], outputs: Place | Iterable[Place]
) -> tuple[tuple[str, ...], tuple[str, ...], FloatArray, FloatArray]:
    """Return names of inputs and outputs, and modal forces (k, q) and motions (p, k) there."""
    if not isinstance(modes, Modes) or np.iscomplexobj(modes.phi):
        kind = "complex modes" if isinstance(modes, Modes) else type(modes).__name__
        raise ModelError(
            f"channels are ranked by real Modes, got {kind}: pass solve_modes(model, count=..., "
            "damping=ModalDamping(...))."
        )
    pushed = places(inputs)
    watched = places(outputs) or pushed
    if not pushed:
        raise ModelError("inputs is empty: name at least one place, such as '41:z'.")
    into, out = labels_of(pushed, modes.dofs), labels_of(watched, modes.dofs)
    phi = np.real(modes.phi)
    B = np.column_stack([modes.dofs.row(place) @ phi for place in pushed])
    return into, out, B, np.array([modes.dofs.row(place) @ phi for place in watched])


def _exact(omega: FloatArray, zeta: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    m = omega.size
    if not m:
        return np.zeros(0)
    pairs = np.zeros((m, 2, 2))
    pairs[:, 0, 1], pairs[:, 1, 0], pairs[:, 1, 1] = omega, -omega, -2 * zeta * omega
    B, C = np.zeros((2 * m, b.shape[1])), np.zeros((c.shape[0], 2 * m))
    B[1::2], C[:, ::2] = b, c / omega
    D = np.zeros((c.shape[0], b.shape[1]))
    return hankel_values(StateSpace(block_diagonal(pairs), B, C, D, blocks=[2] * m))


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBound(Value):
    """An upper bound of the error of a reduction, known before any response is computed.

    Parameters
    ----------
    value : float [m/N]
        Upper bound of the error over all frequencies. The error is the largest singular value of
        the difference of the full and the reduced response (displacement per force) between the
        channels.
    inputs, outputs : sequence of str
        Channels for which the bound holds.
    rule : str
        Description of the rule that gives the bound, as it is printed.
    terms : (k, 3) array, optional
        Gain ``||c|| ||b||`` [1/kg], frequency [rad/s] and damping ratio of every neglected mode.
        Here b holds the displacements of the mode at the inputs, and c those at the outputs.
        `ErrorBound.below` uses these terms.
    static : float [m/N], optional
        Exact error at 0 Hz.
    covers : int, optional
        Number of modes of the structure that the bound covers, if only some were solved. The bound
        does not include the contribution of the other modes. None: it covers all modes.

    Examples
    --------
    Bound of the error when the third mode of a chain is truncated:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> light = fx.ModalDamping(0.01)
    >>> method = fx.reduction.ModalTruncation(2, inputs=["1:x"], outputs=["3:x"], damping=light)
    >>> round(fx.reduce(model, method).bound.value, 9)
    6.945e-06
    """

    value: float = field(metadata=checked(positive, zero=True, unit="m/N"))
    inputs: tuple[str, ...] = field(metadata=checked(name_list))
    outputs: tuple[str, ...] = field(metadata=checked(name_list))
    rule: str
    terms: FloatArray | None = field(
        default=None, kw_only=True, metadata=checked(real_array, shape=(None, 3))
    )
    static: float | None = field(default=None, kw_only=True, metadata=checked(positive, zero=True))
    covers: int | None = field(default=None, kw_only=True, metadata=checked(whole))

    def __repr__(self) -> str:
        some = f", of the {counted(self.covers, 'mode')} solved alone" if self.covers else ""
        return (
            f"<ErrorBound {self.value:.4g} m/N, {counted(len(self.inputs), 'input')} to "
            f"{len(self.outputs)} outputs: {self.rule}{some}>"
        )

    def below(self, freq: float) -> float:
        """Return the bound [m/N] for all frequencies up to `freq` [Hz].

        A neglected mode i has the response ``g_i h_i(w)``. Here g_i is the gain in `terms`, and h_i
        is ``1 / (omega_i^2 - w^2 + 2j zeta_i omega_i w)`` at the angular frequency w. If the mode
        lies above `freq`, its response up to `freq` is far below its peak. The bound is the
        smallest of three values. The first is `value`. The second is the sum over the modes of the
        largest ``g_i |h_i(w)|`` up to `freq`, and it needs `terms`. The third is the static error
        plus the sum of the largest ``g_i |h_i(w) - h_i(0)|``, and it needs `terms` and `static`.
        """
        top = 2 * np.pi * positive(freq, "freq")
        if self.terms is None:
            return self.value
        gain, omega, zeta = np.asarray(self.terms).T
        found = min(self.value, float(gain @ _largest_modal_gain(omega, zeta, top)))
        if self.static is not None:
            found = min(found, self.static + float(gain @ _largest_change(omega, zeta, top)))
        return found


def _largest_modal_gain(omega: FloatArray, zeta: FloatArray, top: float) -> FloatArray:
    """Return the largest ``1 / |omega^2 - w^2 + 2 i zeta omega w|`` for w up to `top`."""
    r = top / omega
    peak = peak_gains(omega, zeta)
    with np.errstate(divide="ignore"):
        at_top = 1 / (omega**2 * np.hypot(1 - r**2, 2 * zeta * r))
    # it rises up to the peak, if there is one; otherwise it falls from the start
    rising = r**2 < 1 - 2 * zeta**2
    return np.asarray(np.where(rising, at_top, peak), dtype=np.float64)


def _largest_change(omega: FloatArray, zeta: FloatArray, top: float) -> FloatArray:
    """Return the largest deviation of the same response from its value at 0, for w up to `top`."""
    # with `x = w^2 / omega^2` and `a = 4 zeta^2` the square of this deviation times omega^4 is
    # `(x^2 + a x) / ((1 - x)^2 + a x)`, rising up to `x = (1 + sqrt(1 + 2 a)) / 2`
    a = 4 * zeta**2
    x = np.minimum((top / omega) ** 2, 0.5 * (1 + np.sqrt(1 + 2 * a)))
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt((x**2 + a * x) / ((1 - x) ** 2 + a * x)) / omega**2)
