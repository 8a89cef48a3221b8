"""design_hinf: H-infinity controllers that are accepted by the norm of their own closed loop."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from ..errors import AssumptionError, ModelError
from ..lti.preparation import Prepared, prepared
from ..lti.statespace import System
from ..plant import StandardPlant
from ..values import FloatArray
from .certificate import certified_norm
from .controller import Controller
from .riccati import Riccati


class Solved(NamedTuple):
    """A controller of the prepared problem, with what its method claims."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    gamma: float
    lower: float


class Method(Protocol):
    """A way to solve the prepared problem: `Riccati()` or `Lmi()`."""

    def solve(self, problem: Prepared) -> Solved:
        """Return a controller of the prepared problem."""


def design_hinf(
    plant: StandardPlant | System,
    method: Method | None = None,
    *,
    u: tuple[str, ...] | None = None,
    y: tuple[str, ...] | None = None,
) -> Controller:
    """Return a controller ``u = K y`` that keeps the H-infinity norm of w -> z small.

    The plant is prepared (scaled, balanced; a sampled one is mapped to continuous time with its
    norms kept), solved by the method, and the controller is brought back to the user's channels
    and units. It is then judged by its own closed loop: stability, and the norm by two routes.

    Parameters
    ----------
    plant : StandardPlant
        Usually weighted; continuous or sampled. A labelled StateSpace (ours or python-control's)
        serves too, with u and y named.
    method : Riccati or Lmi, optional
        `Riccati()` unless given. `Lmi()` needs no full-rank D12 and D21, but suits small plants.
    u, y : tuples of str, optional
        Channels of the controller, for a StateSpace.

    Returns
    -------
    Controller
        `gamma` is the verified norm, `lower` a bound that no controller beats, `certificate` what
        was checked.

    Raises
    ------
    AssumptionError
        When an assumption of the method fails; the message says which, in physical words.
    InfeasibleError
        When no stabilising controller was found.
    CertificateError
        When the closed loop does not keep the promise.
    ModelError
        When the plant is of another type.

    References
    ----------
    Glover, Doyle, State-space formulae for all stabilizing controllers that satisfy an
    H-infinity-norm bound, Systems & Control Letters 11, 1988.
    """
    if not isinstance(plant, StandardPlant):
        if u is None or y is None:
            raise ModelError(
                f"design_hinf needs a StandardPlant, got {type(plant).__name__}. For a StateSpace "
                "name the controller's channels: design_hinf(sys, u=(...), y=(...))."
            )
        plant = StandardPlant.from_statespace(plant, u=u, y=y)
    method = Riccati() if method is None else method
    if not plant.w or not plant.z or not plant.u or not plant.y:
        raise AssumptionError(f"H-infinity synthesis needs channels w, z, u and y, got {plant!r}.")
    plant.check().require(("stabilisable", "detectable"), "H-infinity synthesis")
    problem = prepared(plant.system, plant.u, plant.y)
    found = method.solve(problem)
    controller = problem.restored(found.A, found.B, found.C, found.D).replace(name="hinf")
    certificate = certified_norm(plant.system, controller, found.gamma)
    return Controller(
        controller,
        f"H-infinity by {type(method).__name__}",
        gamma=certificate["norm"],
        lower=found.lower,
        certificate=certificate,
    )
