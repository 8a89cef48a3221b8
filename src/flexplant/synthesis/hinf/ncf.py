"""design_ncf: loop shaping, then robust against errors of the normalised coprime factors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, below_half_rate, inner_names, positive
from ...certificates import Certificate, Verified, stability_check
from ...errors import AssumptionError, CertificateError, ModelError, SolverError
from ...loop import modulus_margin
from ...lti.balancing import hankel_norm
from ...lti.conversions import bilinear, tustin
from ...lti.equations import OnAxisError, balanced_matrix, mean_speed
from ...lti.frequency import frequency_response
from ...lti.interconnection import lft, series
from ...lti.norms import peak_gain
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread
from ...plant import AnyPlant
from ...tolerances import FOUR_DIGITS, TINY
from ..controller import Controller, required_stability
from ..pipeline import Design, Solution, designed
from ..preparation import Prepared, prepared
from .lower_bound import both_sides

#: corner of the integral action of the recipe, relative to the bandwidth
_INTEGRAL = 0.1
#: why a loop that solves its Riccati equations is not stable in rounding
_HIDDEN = (
    "A mode that is undamped, integrating or unstable is nearly hidden by the shaping (a zero of "
    "`before` or `after` next to its pole), or hardly reached or seen. Move that zero, or add an "
    "actuator or a sensor."
)


@one_thread()
def design_ncf(
    plant: AnyPlant | System,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    bandwidth: float | None = None,
    back_off: float = 0.1,
) -> Controller:
    """Return the loop-shaping controller of Glover and McFarlane, ``u = K y``.

    The plant G is first shaped by filters: ``G_s = after G before``. The shaped plant is written as
    ``G_s = M^-1 N`` with normalised left coprime factors M and N, which are stable. The controller
    K_s stabilises G_s. It also stabilises every plant ``(M + dM)^-1 (N + dN)`` whose errors dM and
    dN are stable and satisfy ``|[dN, dM]| < 1 / gamma``. The bound gamma is::

        gamma_min = (1 + lambda_max(X Z))^(1/2),   gamma = (1 + back_off) gamma_min

    Here X and Z are the solutions of the two Riccati equations of G_s. They give the smallest value
    gamma_min directly, so that no search is needed. The result is ``K = before K_s after``. A
    sampled plant is mapped to continuous time by the bilinear transformation, and the controller is
    mapped back. This keeps the H-infinity norms and the normalisation of the factors. Rigid-body
    modes and integrators are allowed in the plant and in `before` and `after`.

    Parameters
    ----------
    plant : StandardPlant or StateSpace
        Plant G. For a StandardPlant, the channels from u to y are used.
    before, after : StateSpace or array, optional
        Shaping filters at u and at y, with the sampling time of the plant. They give the loop gain
        its slope. They may also transform to decoupled axes. For this, `decouple` returns the
        matrices `accelerations` (for `before`) and `to_motions` (for `after`).
    bandwidth : float [Hz], optional
        Bandwidth of every channel. ``after G before`` must be square. Each of its channels is
        multiplied by ``k (1 + w / (10 s))`` with w = 2 pi bandwidth. The factor k makes the gain of
        the channel 1 at the bandwidth.
    back_off : float
        Relative distance of gamma from gamma_min. It must be positive, because the formula of K_s
        has a singular matrix at gamma_min.

    Returns
    -------
    Controller
        The controller. `gamma` is the value of gamma above, verified as an H-infinity norm of the
        closed loop, and `lower` is gamma_min. The certificate holds the margin 1 / gamma of the
        shaped plant, gamma_min from the Hankel norm of the factors, and the modulus margin of the
        loop at u. As a rule of thumb, a design with a gamma below 4 is robust.

    Raises
    ------
    AssumptionError
        When u does not excite an undamped or unstable mode, y does not measure it, or the shaping
        filters cancel it.
    CertificateError
        When the closed loop exceeds the claimed norm.
    ModelError, ShapeError
        When the sizes or sampling times of plant and shaping filters differ, or the bandwidth is
        out of range.

    References
    ----------
    [McFarlaneGlover1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.lti.tf([1.0], [1.0, 0.0, 0.0])  # a free mass
    >>> controller = fx.design_ncf(plant)
    >>> round(fx.synthesis.ncf_margin(plant, controller), 2)
    0.35
    """
    G = plant.Gyu if isinstance(plant, AnyPlant) else as_statespace(plant)
    back_off = positive(back_off, "back_off")
    first = as_statespace(np.eye(len(G.inputs)) if before is None else before)
    last = as_statespace(np.eye(len(G.outputs)) if after is None else after)
    first, last = (s if s.n_states else s.replace(dt=G.dt) for s in (first, last))
    if (len(first.outputs), len(last.inputs)) != (len(G.inputs), len(G.outputs)):
        raise ModelError(
            f"before has {len(first.outputs)} outputs for {len(G.inputs)} u, after "
            f"{len(last.inputs)} inputs for {len(G.outputs)} y: pass systems or matrices that fit."
        )
    shaped = series(series(first, G), last)
    if bandwidth is not None:
        weight = integral_action(shaped, positive(bandwidth, "bandwidth"))
        first, shaped = series(weight, first), series(weight, shaped)
    judged = plant if isinstance(plant, AnyPlant) else None
    return designed(_LoopShaping(back_off), _Shaped(G, first, last, shaped), judged)


class _Shaped(NamedTuple):
    """A plant with its shaping at u and at y, and all three in series."""

    given: StateSpace
    before: StateSpace
    after: StateSpace
    system: StateSpace


@dataclass(frozen=True)
class _LoopShaping(Design):
    """The central controller of the normalised coprime factors, at a distance from the least."""

    back_off: float
    name = "ncf"
    hidden = "a zero of `before` or `after` lies on its pole"

    def prepare(self, plant: _Shaped) -> Prepared:
        g = plant.system
        # the speed is that of the loop of least |y|^2 + |u|^2, feedthrough apart
        image = bilinear(g, 1.0 / g.dt) if g.dt else g
        A, B, C = image.A, image.B, image.C
        hamiltonian = np.block([[A, -B @ B.T], [-C.T @ C, -A.T]])
        poles = np.linalg.eigvals(balanced_matrix(hamiltonian)).astype(complex)
        return prepared(_four_blocks(g), g.inputs, g.outputs, speed=mean_speed(poles))

    def solve(self, problem: Prepared) -> tuple[StateSpace, float, float, float]:
        # the controller of the shaped plant, its gamma, and the smallest gamma by two routes
        p = problem
        control, estimate = both_sides(p)
        try:
            (X, F), (Z, Ht) = control.least_squares(), estimate.least_squares()
        except (OnAxisError, SolverError, la.LinAlgError) as error:
            raise AssumptionError(
                f"no normalised coprime factors of the shaped plant were found: {error}"
            ) from error
        # X and Z do not depend on the units of u and y, F and H do
        B, C = p.B2 @ np.linalg.inv(p.u_scale), np.linalg.solve(p.y_scale, p.C2)
        D = np.linalg.solve(p.y_scale, np.linalg.solve(p.u_scale.T, p.D22.T).T)
        F, H = p.u_scale @ F, Ht.T @ p.y_scale
        least = float(np.sqrt(1.0 + np.max(np.linalg.eigvals(X @ Z).real, initial=0.0)))
        gamma = (1.0 + self.back_off) * least
        L = (1.0 - gamma**2) * np.eye(len(X)) + X @ Z
        gain: FloatArray = np.asarray(gamma**2 * np.linalg.solve(L.T, Z @ C.T), dtype=float)
        plain = p.replace(u_scale=np.eye(len(p.u)), y_scale=np.eye(len(p.y)), D22=0 * p.D22)
        K = plain.restored(p.A + B @ F + gain @ (C + D @ F), gain, B.T @ X, -D.T)
        # of the normalised left coprime factors [N, M]; their feedthrough does not matter
        root = la.cholesky(np.eye(len(D)) + D @ D.T, lower=True)
        drive, sight = np.hstack([B + H @ D, H]), la.solve_triangular(root, C, lower=True)
        factors = StateSpace(p.A + H @ C, drive, sight, np.zeros((len(sight), drive.shape[1])))
        other = float(1.0 / np.sqrt(max(1.0 - hankel_norm(factors) ** 2, TINY)))
        return K, gamma, least, other

    def restore(self, plant: _Shaped, problem: Prepared, found: Any) -> StateSpace:
        K, G = series(series(plant.after, found[0]), plant.before), plant.given
        return K.replace(inputs=G.outputs, outputs=G.inputs, name=self.name, units=G.units)

    def certify(self, solution: Solution) -> Controller:
        plant, _, whole, (K, gamma, least, other) = solution
        loop = lft(_four_blocks(plant.system), K)
        stable, margin = required_stability(loop, _HIDDEN), 1.0 / peak_gain(loop)[0]
        required_stability(lft(_four_blocks(plant.given), whole), _HIDDEN)
        if not abs(other - least) <= FOUR_DIGITS * least or not margin * gamma >= 1.0 - FOUR_DIGITS:
            raise CertificateError(
                f"the loop of the shaped plant has the margin {margin:.6g} where {1.0 / gamma:.6g} "
                f"was claimed, the smallest gamma is {least:.6g} by the Riccati equations and "
                f"{other:.6g} by the Hankel norm of the factors: the shaped plant is too badly "
                "conditioned to trust. Lower the bandwidth where a delay or resonances allow none "
                "so high, bring the gains at u and y to size 1, or leave out states hardly "
                "reached or seen."
            )
        limit = (1.0 - FOUR_DIGITS) / gamma
        found = (
            Verified("margin", margin, "gain of four blocks", limit, at_least=True),
            Verified(
                "smallest gamma", other, "Hankel norm of the factors", least * (1 + FOUR_DIGITS)
            ),
            stability_check(stable, plant.system.dt),
            Verified("modulus margin", modulus_margin((plant.given, whole))),
        )
        return Controller(
            whole,
            "loop shaping by normalised coprime factors",
            gamma=1.0 / margin,
            lower=least,
            certificate=Certificate(found),
        )


def ncf_margin(plant: AnyPlant | System, controller: Controller | System) -> float:
    """Return the margin of a loop u = K y against errors of normalised coprime factors.

    The margin is ``b = 1 / | [K; I] (I - G K)^-1 [I, G] |`` with the H-infinity norm. It is 0 for
    an unstable loop. The largest value that any controller reaches is ``(1 + lambda_max(X
    Z))^(-1/2)``, where X and Z are the solutions of the two Riccati equations of the plant. The
    margin depends on the units of u and y. Scale u and y so that typical signals have size 1, or
    give the shaped plant and its controller.

    Parameters
    ----------
    plant : StandardPlant or StateSpace
        Plant G. For a StandardPlant, the channels from u to y are used.
    controller : Controller or StateSpace
        Controller from y to u. Its channels have the order of the plant's channels.

    Returns
    -------
    float
        Margin. A loop with a margin above 0.2 to 0.3 is called robust.

    Raises
    ------
    ModelError, ShapeError
        When the channels or sampling times of plant and controller do not match.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant, controller = fx.lti.tf([1.0], [1.0, 0.0]), fx.lti.tf([-1.0], [1.0])
    >>> round(fx.synthesis.ncf_margin(plant, controller), 4)  # 1 / sqrt(2)
    0.7071
    """
    G = plant.Gyu if isinstance(plant, AnyPlant) else as_statespace(plant)
    K = as_statespace(controller)
    p, m = len(G.outputs), len(G.inputs)
    if (len(K.inputs), len(K.outputs)) != (p, m):
        raise ModelError(
            f"the controller has {len(K.inputs)} inputs and {len(K.outputs)} outputs, the plant "
            f"{p} y and {m} u: pass the K of u = K y for this plant."
        )
    loop = lft(_four_blocks(G), K.replace(inputs=G.outputs, outputs=G.inputs, units={}))
    return 1.0 / peak_gain(loop)[0] if loop.is_stable else 0.0


def _four_blocks(g: StateSpace) -> StateSpace:
    """Return ``[n; f; u] -> [y; u; y]`` of a plant, y with n and u with f."""
    p, m = g.D.shape
    seen = np.hstack([np.eye(p), g.D, g.D])
    moved = np.hstack([np.zeros((m, p + m)), np.eye(m)])
    w, z = (inner_names((f"{k}{i}" for i in range(p + m)), (*g.inputs, *g.outputs)) for k in "wz")
    return StateSpace(
        g.A,
        np.hstack([np.zeros((g.n_states, p)), g.B, g.B]),
        np.vstack([g.C, np.zeros((m, g.n_states)), g.C]),
        np.vstack([seen, moved, seen]),
        g.dt,
        inputs=[*w, *g.inputs],
        outputs=[*z, *g.outputs],
    )


def integral_action(shaped: StateSpace, bandwidth: float) -> StateSpace:
    """Return ``k_i (1 + w / (10 s))`` for each channel, of gain 1 with the plant's at bandwidth."""
    count = len(shaped.inputs)
    if len(shaped.outputs) != count:
        raise ModelError(
            f"bandwidth needs as many y as u, got {len(shaped.outputs)} and {count}: pass before= "
            "and after= that decouple."
        )
    below_half_rate(bandwidth, "bandwidth", 1.0 / shaped.dt if shaped.dt else 0.0)
    gains = np.abs(frequency_response(shaped, np.array([bandwidth])).data[:, :, 0].diagonal())
    if not np.all(gains > 0):
        raise ModelError(
            f"channel {int(np.argmin(gains)) + 1} of the shaped plant has no gain at "
            f"{bandwidth:g} Hz, so that no gain gives it that bandwidth. Pair u and y that act on "
            "each other by before= and after=."
        )
    omega = 2.0 * np.pi * bandwidth
    k = np.diag(1.0 / gains / np.hypot(1.0, _INTEGRAL))
    action = StateSpace(np.zeros((count, count)), np.eye(count), _INTEGRAL * omega * k, k)
    return tustin(action, 1.0 / shaped.dt) if shaped.dt else action
