"""design_h2: controllers of least H2 norm (LQG), verified by the Gramians of the closed loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from ..certificates import Certificate, Verified, stability_check
from ..errors import AssumptionError, CertificateError, ModelError, SolverError
from ..lti.interconnection import lft
from ..lti.norms import SAME_NORM, h2_norm
from ..lti.riccati import control_care, control_dare, filter_care, filter_dare
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import AnyPlant
from .controller import Controller, SolvedController, required_stability
from .hinf.singular import lacking, made_regular
from .pipeline import Design, Solution, designed, posed
from .preparation import Prepared, prepared, require_reach
from .structured.judges import require_finite_h2


@one_thread()
def design_h2(
    plant: AnyPlant | System, *, u: Sequence[str] | None = None, y: Sequence[str] | None = None
) -> Controller:
    """Return the controller ``u = K y`` with the smallest H2 norm from w to z.

    For white noise w of unit intensity, this norm is the rms of z.

    The plant is ``dx/dt = A x + B1 w + B2 u``, ``z = C1 x + D11 w + D12 u``, ``y = C2 x + D21 w +
    D22 u``. X and F are the solution and the gain of the Riccati equation of control. Y is the
    solution of the Riccati equation of estimation. The matrix R is ``D12' D12`` for a continuous
    plant, and ``D12' D12 + B2' X B2`` for a sampled one. The square of the smallest norm is::

        |Tzw|^2 = trace(B1' X B1 + D11' D11) + trace(R (F Y F' - L0 S L0')),
                  S = D21 D21' + C2 Y C2',  L0 = (F Y C2' + F0 D21') S^-1

    L0 and S are needed only for a sampled plant, with ``F0 = -R^-1 (B2' X B1 + D12' D11)``. For a
    continuous plant L0 is zero. A sampled plant is solved by the discrete-time equations. The
    command u at a sample depends on y of the same sample. The norm is computed a second time from
    the Gramians of the closed loop, and both results must agree.

    Parameters
    ----------
    plant : StandardPlant
        Continuous or sampled plant. A StateSpace with named channels (also of python-control) is
        accepted.
    u, y
        As for `design_hinf`. Truncated modes give the same warning as there.

    Returns
    -------
    Controller
        Controller whose `gamma` is the H2 norm of the closed loop. `lower` is the smallest norm by
        the formula above; it is None if noise or effort had to be added (see Notes). `certificate`
        holds the checks. `left_out` holds the check with the truncated modes, which the design
        model leaves out.

    Raises
    ------
    AssumptionError
        When w acts directly on z in a continuous plant, so that the norm is infinite. Also when u
        does not excite, or y does not measure, a mode that is not stable.
    InfeasibleError, SolverError
        When no stabilising controller was found. Also when the norm can be made arbitrarily small
        by ever larger gains, so that no best controller exists.
    CertificateError
        When the closed loop is not stable or its norm is not that of the formula.
    ModelError
        When the plant is of another type.

    Notes
    -----
    LQG is a special case of this design. Its cost is ``x' Q x + u' R u``. Its white noises have the
    intensities W (process) and V (sensors); for a sampled plant W and V are covariances. The
    channels of LQG are ``z = [Q^(1/2) x; R^(1/2) u]`` and ``w = [process; sensor]``, with ``B1 =
    [W^(1/2), 0]`` and ``D21 = [0, V^(1/2)]``. For a plant of `assemble_plant`, its method
    `weighted` gives w and z these weights. The weight of each channel of w is the size of its
    noise, where asd is its amplitude spectral density: asd / sqrt(2) for a continuous plant and asd
    / sqrt(2 dt) for a sampled one. The weight of each channel of z is one over the allowed rms of
    the motion or effort.

    If D12 or D21 does not have full rank, a small noise of each sensor is added to w, and a small
    effort of each actuator to z, as for `design_hinf`. Both are reduced until the norm hardly
    changes. If w does not excite an undamped mode, a small disturbance at u is added to w. If z
    does not observe an undamped mode, a small multiple of y is added to z.

    References
    ----------
    [ZhouDoyleGlover1996]_, theorems 14.7 and 21.14.

    Examples
    --------
    >>> import flexplant as fx
    >>> controller = fx.design_h2(fx.testbeds.three_masses())
    >>> controller.certificate["H2 norm"] == controller.gamma
    True
    """
    plant = posed(plant, u, y, "H2 synthesis")
    require_finite_h2(plant, plant.w, plant.z)
    return designed(_LeastH2(), plant, plant)


class _LeastH2(Design):
    """The least H2 norm, by two Riccati equations."""

    name = "h2"

    def prepare(self, plant: AnyPlant) -> Prepared:
        if plant.dt:
            require_reach(prepared(plant.system, plant.u, plant.y))
        return prepared(plant.system, plant.u, plant.y, direct=True)

    def solve(self, problem: Prepared) -> SolvedController:
        # noise and effort are added where the problem is singular
        lack = lacking(problem)
        if lack.is_full and not lack.modes:
            return _solve_regular(problem)
        return made_regular(problem, _solve_regular, lack, h2_norm)

    def certify(self, solution: Solution) -> Controller:
        plant, problem, K, found = solution
        # a norm of the scaled problem, in the user's unit of time
        certificate = _certified(plant.system, K, float(np.sqrt(problem.speed)) * found.gamma)
        return Controller(
            K,
            "H2 by two Riccati equations",
            gamma=certificate["H2 norm"],
            lower=None if found.notes else min(certificate["claim"], certificate["H2 norm"]),
            certificate=Certificate((*certificate.checks, *found.checks)),
            notes=found.notes,
        )


def _solve_regular(p: Prepared) -> SolvedController:
    """Return the optimal controller of a regular prepared problem."""
    solve_control, solve_filter = (
        (control_dare, filter_dare) if p.direct else (control_care, filter_care)
    )
    try:
        control = solve_control(p.A, p.B2, Q=p.C1.T @ p.C1, R=p.D12.T @ p.D12, S=p.C1.T @ p.D12)
    except (SolverError, ModelError) as error:
        raise AssumptionError(f"no optimal feedback from the states to u: {error}") from error
    try:
        estimate = solve_filter(p.A, p.C2, Q=p.B1 @ p.B1.T, R=p.D21 @ p.D21.T, S=p.B1 @ p.D21.T)
    except (SolverError, ModelError) as error:
        raise AssumptionError(f"no optimal estimate of the states from y: {error}") from error
    residual = max(control.residual, estimate.residual)
    X, F, Y, L = control.P, -control.gain, estimate.P, -estimate.gain
    R, S = p.D12.T @ p.D12, p.D21 @ p.D21.T
    L0: FloatArray = np.zeros((len(F), L.shape[1]))
    if p.direct:
        R, S = R + p.B2.T @ X @ p.B2, S + p.C2 @ Y @ p.C2.T
        F0 = -np.linalg.solve(R, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
        L0 = np.asarray(np.linalg.solve(S, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T, dtype=float)
    square = np.sum(p.B1 * (X @ p.B1)) + np.sum(p.D11**2)
    square += np.sum(R * (F @ Y @ F.T - L0 @ S @ L0.T))
    cost = float(np.sqrt(max(square, 0.0)))
    A = p.A + p.B2 @ F + L @ p.C2 - p.B2 @ L0 @ p.C2
    checks = (Verified("residual of the Riccati equations", residual),)
    return SolvedController(A, p.B2 @ L0 - L, F - L0 @ p.C2, L0, cost, cost, checks)


#: why a loop that solves its Riccati equations is not stable in rounding
_UNDAMPED = (
    "The plant is too badly conditioned, or a mode that neither z nor w contains stays undamped: "
    "weight its motion and disturb it."
)


def _certified(P: StateSpace, K: StateSpace, claim: float) -> Certificate:
    """Return what was verified of lft(P, K): its H2 norm by both Gramians, and its stability."""
    loop = lft(P, K)
    least, norm = required_stability(loop, _UNDAMPED), h2_norm(loop)
    if not np.isfinite(norm):
        raise CertificateError(
            f"the H2 norm of the closed loop is infinite: the controller is refused. {_UNDAMPED}"
        )
    if not abs(norm - claim) <= SAME_NORM * norm:
        raise CertificateError(
            f"the H2 norm of the closed loop is {norm:.9g} by its Gramians, {claim:.9g} by the "
            "synthesis: the problem is too badly conditioned to trust. Bring the "
            "sizes of the weights closer together."
        )
    limit = claim * (1.0 + SAME_NORM)
    checks = (Verified("H2 norm", norm, "Gramians of the loop", limit), Verified("claim", claim))
    return Certificate((*checks, stability_check(least, loop.dt)))
