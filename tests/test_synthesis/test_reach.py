"""What no controller can do is refused first, by every design: modes missed, bounds too low."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, InfeasibleError
from flexplant.lti import StateSpace
from flexplant.synthesis import H2, FixedOrder, Hinf, PeakGain, PoleRegion
from flexplant.synthesis.lmi.objective_design import require_reachable
from oracles_lmi import output_feedback_gamma

DESIGNS = {
    "h2": fx.design_h2,
    "hinf": fx.design_hinf,
    "structured": lambda plant: fx.synthesis.design_structured(plant, FixedOrder(1)),
    "lmi": lambda plant: fx.synthesis.design_lmi(plant, minimize=Hinf()),
}


def standard(A, B, C, D):
    return fx.StandardPlant.from_statespace(
        StateSpace(A, B, C, D, inputs=["d", "n", "f"], outputs=["x", "e", "s"]), u=["f"], y=["s"]
    )


def oscillators(reach, seen):
    """Undamped, at 3 and 10 rad/s; the slower is reached by u, and seen by y, so much."""
    A = np.kron(np.diag([3.0, 10.0]), [[0.0, 1.0], [-1.0, 0.0]])
    B = np.zeros((4, 3))
    B[[1, 3], 0], B[[1, 3], 2] = 1.0, [reach, 1.0]
    C = np.zeros((3, 4))
    C[0, [0, 2]], C[2, [0, 2]] = 1.0, [seen, 1.0]
    return standard(A, B, C, [[0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])


def integrator():
    """``x' = d + f``, z = [x; f], y = x + n."""
    return standard([[0.0]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]],
                    [[0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])  # fmt: skip


@pytest.mark.parametrize("design", DESIGNS.values(), ids=DESIGNS)
@pytest.mark.parametrize(
    ("reach", "seen", "message"),
    [
        (0.0, 1.0, r"u \(f\) does not reach a mode .*at 0\.477 Hz.*Add or move an actuator"),
        (1.0, 0.0, r"y \(s\) does not see a mode .*at 0\.477 Hz.*an actuator or a sensor"),
    ],
)
def test_a_mode_that_is_missed_is_named(design, reach, seen, message):
    with pytest.raises(AssumptionError, match=message):
        design(oscillators(reach, seen))


@pytest.mark.parametrize(
    ("norm", "least"), [(H2, np.sqrt(2.0)), (Hinf, output_feedback_gamma(0.0))]
)
def test_a_bound_below_the_optimum_is_refused(norm, least):
    """LQG of an integrator by hand; H-infinity by its scalar Riccati equations."""
    require_reachable(integrator(), [norm(below=1.01 * least), PoleRegion(), PeakGain(below=0.1)])
    text = r"d, n to x, e none reaches less than 1\.4\d*, even without .*peaks at .* Raise below"
    with pytest.raises(InfeasibleError, match=text) as found:
        require_reachable(integrator(), [PoleRegion(), norm(below=0.97 * least)])
    named = float(str(found.value).split("less than ")[1].split(",")[0])
    assert named == pytest.approx(least, rel=5e-3)


@pytest.mark.slow
def test_an_integrator_follows_its_noise():
    """At zero frequency x = -n in any stable loop."""
    require_reachable(integrator(), [Hinf(w=["n"], z=["x"], below=1.01)])
    with pytest.raises(InfeasibleError, match="from n to x none reaches less than 1,"):
        require_reachable(integrator(), [Hinf(w=["n"], z=["x"], below=0.98)])


def test_a_bound_without_costs_is_refused_well_below_its_infimum():
    """Without effort in z the H2 norm has the infimum 1, the variance of the estimate."""
    least = [H2(z=["x"], below=bound) for bound in (0.6, 0.4)]
    require_reachable(integrator(), least[:1])
    with pytest.raises(InfeasibleError, match=r"to x none reaches less than about 1(\.\d+)?,"):
        require_reachable(integrator(), least)
