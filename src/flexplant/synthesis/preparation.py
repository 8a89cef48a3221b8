"""Plants made ready for synthesis: scaled, and whether any controller stabilises them.

Equations of machines in SI units (1e-9 m/N together with rates of 1e4 Hz) cannot be solved
directly. A sampled plant is mapped to continuous time (bilinear, norms are kept), time is scaled to
the plant's own speed, states are balanced, and the channels are turned and scaled so that D12 = [0;
I] and D21 = [0, I] where they have full rank. None of it changes a norm from w to z. The controller
has a way back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, inner_names
from ..errors import AssumptionError, ModelError
from ..lti.blocks_of_states import Matrices
from ..lti.conversions import bilinear, image_freq, tustin
from ..lti.equations import mean_speed
from ..lti.modal import modal_form
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import RESIDUAL, ROUNDING, SPLIT, TINY
from .scaling import POINT, answers, balanced, departure_from_normal, loop_speed, normalised

#: departure from normal above which modal coordinates are taken; the condition of their
#: eigenvectors may be as many times larger, and from there on a failure is attributed to it
_MIXED, _CONDITION = 5.0, 1e3


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Value):
    """A scaled problem ``[w; u] -> [z; y]`` with D22 = 0, continuous unless `direct`."""

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray
    D12: FloatArray
    D21: FloatArray
    D22: FloatArray
    u_scale: FloatArray
    y_scale: FloatArray
    speed: float
    dt: float
    u: Sequence[str]
    y: Sequence[str]
    departure: float = 1.0
    direct: bool = False
    #: point at the loop's speed: e^(j pi/4), or its image in z for a problem that stays sampled
    point: complex = POINT

    @cached_property
    def system(self) -> StateSpace:
        """The scaled problem as one system, inputs w1.., u and outputs z1.., y."""
        w = inner_names((f"w{i}" for i in range(1, self.B1.shape[1] + 1)), self.u)
        z = inner_names((f"z{i}" for i in range(1, self.C1.shape[0] + 1)), self.y)
        return StateSpace(
            self.A,
            np.hstack([self.B1, self.B2]),
            np.vstack([self.C1, self.C2]),
            np.block([[self.D11, self.D12], [self.D21, np.zeros_like(self.D22)]]),
            inputs=[*w, *self.u],
            outputs=[*z, *self.y],
            dt=self.dt if self.direct else 0.0,
        )

    @property
    def own_sizes(self) -> tuple[FloatArray, FloatArray]:
        """What the plant does on each channel at the loop's speed: u in z (nu,), w in y (ny,)."""
        u = answers(self.A, self.B2, self.C1, self.D12, self.point)
        return u, answers(self.A.T, self.C2.T, self.B1.T, self.D21.T, self.point)

    @property
    def own_gain(self) -> float:
        """Size of w in z at the loop's speed, 1 where w does nothing there."""
        gains = answers(self.A, self.B1, self.C1, self.D11, self.point)
        return float(np.max(gains, initial=0.0)) or 1.0

    def measured_in(self, unit: float) -> Prepared:
        """Return the problem with z in multiples of `unit`; u too, so that D12 is kept."""
        # its controller's C and D times `unit` are those of this problem
        return self.replace(
            B2=unit * self.B2,
            C1=self.C1 / unit,
            D11=self.D11 / unit,
            D22=unit * self.D22,
            u_scale=unit * self.u_scale,
        )

    def with_unit_channels(
        self, size_u: FloatArray | float = 0.0, size_y: FloatArray | float = 0.0
    ) -> Prepared:
        """Return the problem with ``D12 = [0; I]`` and ``D21 = [0, I]`` where they have full rank.

        What is small next to a size of its channel counts as zero.
        """
        (z, u), (w, y) = normalised(self.D12, size_u), normalised(self.D21.T, size_y)
        z, y = z.T, y.T
        return self.replace(
            B1=self.B1 @ w,
            B2=self.B2 @ u,
            C1=z @ self.C1,
            C2=y @ self.C2,
            D11=z @ self.D11 @ w,
            D12=z @ self.D12 @ u,
            D21=y @ self.D21 @ w,
            D22=y @ self.D22 @ u,
            u_scale=self.u_scale @ u,
            y_scale=y @ self.y_scale,
        )

    def frequency(self, omega: float) -> float:
        """Return the frequency [Hz] of the original plant that a scaled one [1] stands for."""
        return float(image_freq(self.speed * omega, 0.0 if self.direct else self.dt))

    def restored(self, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> StateSpace:
        """Return the controller of the original plant from that of the scaled problem."""
        A, B, C, D = less_feedthrough((A, B, C, D), self.D22)
        controller = StateSpace(
            self.speed * A,
            np.sqrt(self.speed) * B @ self.y_scale,
            np.sqrt(self.speed) * self.u_scale @ C,
            self.u_scale @ D @ self.y_scale,
            inputs=self.y,
            outputs=self.u,
            dt=self.dt if self.direct else 0.0,
        )
        return tustin(controller, 1.0 / self.dt) if self.dt and not self.direct else controller


def less_feedthrough(K: Matrices, D22: FloatArray) -> Matrices:
    """Return A, B, C, D of the controller ``u = K (y - D22 u)``: of a plant with feedthrough."""
    A, B, C, D = K
    inner = np.eye(D.shape[0]) + D @ D22
    if la.svdvals(inner)[-1] < ROUNDING * (1.0 + float(np.linalg.norm(D @ D22))):
        raise ModelError(
            "the controller and the feedthrough from u to y (D22, as of accelerometers) make "
            "an algebraic loop that has no solution. Give u a sample of delay or a low-pass."
        )
    loop = np.linalg.inv(inner)
    return A - B @ D22 @ loop @ C, B @ (np.eye(B.shape[1]) - D22 @ loop @ D), loop @ C, loop @ D


def prepared(
    P: StateSpace,
    u: Sequence[str],
    y: Sequence[str],
    *,
    direct: bool = False,
    speed: float | None = None,
) -> Prepared:
    """Return a standard plant ``[w; u] -> [z; y]``, made ready for synthesis.

    `speed` [rad/s] is that of the loop, where it is known.
    """
    dt, direct = P.dt, direct and bool(P.dt)
    m1, p1 = len(P.inputs) - len(u), len(P.outputs) - len(y)
    # balanced first: whether I + A can be inverted must not depend on the units of the states
    s = np.exp(1j) * (1.5 if P.dt else mean_speed(P.poles()))
    P, image = _with_image(P, *balanced(P.A, P.B, P.C, s))
    speed = speed or loop_speed(image, m1, p1, dt)
    departure = departure_from_normal(P.A, speed * (dt or 1.0))
    if departure > _MIXED:
        form = modal_form(P, largest_condition=_CONDITION * departure)
        if not form.reason:
            P, image = _with_image(P, form.system.A, form.system.B, form.system.C)
    if direct:
        half, speed = 0.5 * speed * dt * POINT, 1.0
        point = complex((1.0 + half) / (1.0 - half))
        A, B, C = balanced(P.A, P.B, P.C, point)
    else:
        P, point, root = image, POINT, np.sqrt(speed)
        A, B, C = balanced(P.A / speed, P.B / root, P.C / root, POINT)
    B1, B2, C1, C2 = B[:, :m1], B[:, m1:], C[:p1], C[p1:]
    D11, D12, D21, D22 = P.D[:p1, :m1], P.D[:p1, m1:], P.D[p1:, :m1], P.D[p1:, m1:]
    scales, names = (np.eye(len(u)), np.eye(len(y))), (tuple(u), tuple(y))
    plain = Prepared(
        A, B1, B2, C1, C2, D11, D12, D21, D22, *scales, speed, dt, *names, departure, direct, point
    )
    found = plain.with_unit_channels(*plain.own_sizes)
    # balanced with z and u in the unit of what w does to z, so that its unit does not matter
    unit = plain.own_gain
    sized = found.measured_in(unit)
    B, C = np.hstack([sized.B1, sized.B2]), np.vstack([sized.C1, sized.C2])
    A, B, C = balanced(A, B, C, point)
    return found.replace(A=A, B1=B[:, :m1], B2=B[:, m1:] / unit, C1=C[:p1] * unit, C2=C[p1:])


def badly_scaled(problem: Prepared) -> str:
    """Return that the plant was given in bad coordinates, in words; empty where it was not."""
    if problem.departure < _CONDITION:
        return ""
    return (
        f"the coordinates of the plant's states are badly conditioned: A is "
        f"{problem.departure:.1e} times as large as its poles, and rounding of that size hides "
        "what the plant is. Give it in modal, balanced or physical coordinates."
    )


def _with_image(
    P: StateSpace, A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[StateSpace, StateSpace]:
    """Return a plant in other coordinates, and its continuous image when it is sampled."""
    P = P.replace(A=A, B=B, C=C, blocks=None)
    return P, bilinear(P, 1.0 / P.dt) if P.dt else P


#: |z| of poles that are delays; e-folds of a mode during them that leave nothing to be gained
_NILPOTENT, _TOO_LONG = 0.5, 15.0


def require_reach(problem: Prepared, hidden: str = "") -> None:
    """Raise AssumptionError when u does not reach, or y does not see, a pole that is not stable.

    `hidden`: what else may hide it.
    """
    # weights included; Hautus' rank test in the prepared coordinates, whatever the user's units
    A = problem.A
    poles = np.linalg.eigvals(A)
    size = max(float(np.linalg.norm(A, 2)) if A.size else 0.0, TINY)
    # the poles of a chain of integrators come out of rounding as a ring around zero
    poles = np.where(np.abs(poles) < SPLIT * size, 0.0, poles)
    edge = poles[(poles.real > -RESIDUAL * size) & (poles.imag >= 0.0)]
    for pole in dict.fromkeys(edge.tolist()):  # a conjugate has the same singular values
        for matrix, gain, text in (
            (A, problem.B2, f"u ({', '.join(problem.u)}) does not reach"),
            (A.T, problem.C2.T, f"y ({', '.join(problem.y)}) does not see"),
        ):
            reach = size * gain / max(float(np.linalg.norm(gain, 2)), TINY)
            pencil = np.hstack([matrix - pole * np.eye(A.shape[0]), reach])
            if np.linalg.svd(pencil, compute_uv=False)[-1] < ROUNDING * size:
                raise AssumptionError(
                    _delay_effect(problem, complex(pole).real)
                    or f"{text} a mode of the plant or of a weight that is not stable "
                    f"({_pole_in_words(problem, complex(pole))}){hidden and ', or ' + hidden}: no "
                    "controller can stabilise it. "
                    "Add or move an actuator or a sensor, or give the weight finite gain."
                )


def beyond_rounding(problem: Prepared) -> str:
    """Return why no controller stabilises a problem in rounding, and what to do, in words."""
    poles = np.linalg.eigvals(problem.A)
    unstable = poles[poles.real > SPLIT * float(np.linalg.norm(problem.A, 2))]
    if not unstable.size:
        return (
            "the plant is too badly conditioned. Weight z and w so that their sizes are similar "
            "(metres and newtons are not; see stage_weights), or remove states that u hardly "
            "moves or y hardly shows."
        )
    growth = float(np.max(unstable.real))
    return _delay_effect(problem, growth) or (
        f"the plant has {unstable.size} unstable pole(s), growing e-fold in "
        f"{1.0 / (problem.speed * growth):.3g} s, which u ({', '.join(problem.u)}) and y "
        f"({', '.join(problem.y)}) can hold only with gains that 16 digits do not resolve. Add "
        "actuators and sensors that act on these modes one by one, move zeros away from them, or "
        "correct the model where the machine is stable (signs of stiffness and damping)."
    )


def _delay_effect(problem: Prepared, growth: float) -> str:
    """Return what a delay does to a mode of that growth, in words; empty where it does little."""
    if not problem.dt or problem.direct or growth <= SPLIT:
        return ""
    half = 0.5 * problem.dt * problem.speed
    # delays are poles at z = 0; a chain of n of them comes out of rounding on a circle eps^(1/n)
    s = half * np.linalg.eigvals(problem.A)
    delay = problem.dt * int(np.count_nonzero(np.abs(1.0 + s) < _NILPOTENT * np.abs(1.0 - s)))
    rate = 2.0 * np.arctanh(min(half * growth, 0.999)) / problem.dt
    if rate * delay < _TOO_LONG:
        return ""
    return (
        f"the delay of {delay:.3g} s between u ({', '.join(problem.u)}) and y "
        f"({', '.join(problem.y)}) is too long: an unstable mode grows e-fold in "
        f"{1.0 / rate:.3g} s, {np.exp(min(rate * delay, 700.0)):.1e} times meanwhile, and gamma by "
        "as much. Shorten the delay, or make the mode slower."
    )


def _pole_in_words(problem: Prepared, pole: complex) -> str:
    if abs(pole.imag) > SPLIT and abs(pole.imag) > pole.real:
        return f"at {problem.frequency(abs(pole.imag)):.3g} Hz"
    if pole.real > SPLIT:
        return f"it grows e-fold in {1.0 / (problem.speed * pole.real):.3g} s"
    return "at 0 Hz: rigid-body or integrating"
