"""shape_loop: bandwidth reached, margins, reference models followed; oracles by dense matrices."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la
from test_ncf import BODY, brute
from test_spill_over import many, small

import flexplant as fx
from flexplant.errors import CertificateError, FlexplantWarning, LabelError, ModelError, SolverError
from flexplant.lti import StateSpace, discretized, frequency_response
from flexplant.plant import assemble_plant
from flexplant.synthesis import ncf_margin, shape_loop
from stages import RATE, ports, reduced, sampled


def mechanism(rate=0.0):
    """2 kg with a mode at 900 Hz of 0.1 %: 1e-9 m/N at the mode."""
    w = 2 * np.pi * 900.0
    A = la.block_diag([[0, 1], [0, 0]], [[0, 1], [-(w**2), -2e-3 * w]])
    G = StateSpace(A, [[0], [0.5], [0], [0.5]], [[1, 0, 0.2, 0]], [[0]], inputs=["f"])
    return discretized(G, rate, delay=1) if rate else G


def crossover(G, K, low=1.0, high=800.0):
    """The first frequency where |K G| falls below 1, by a sweep of dense solves."""
    freq = np.geomspace(low, high, 4000)
    s = np.exp(2j * np.pi * freq * G.dt) if G.dt else 2j * np.pi * freq
    gain = [abs((K.evaluated(p) @ G.evaluated(p))[0, 0]) for p in s]
    return freq[int(np.argmax(np.array(gain) < 1.0))]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, 2e4], ids=["continuous", "sampled and late"])
@pytest.mark.parametrize("rolloff", [None, 400.0])
def test_from_bandwidth_to_margins(rate, rolloff):
    G = mechanism(rate)
    found = shape_loop(G, bandwidth=50.0, rolloff=rolloff)
    K = found.controller
    assert crossover(G, K.system) == pytest.approx(50.0, rel=0.025)
    assert found.report["y1"].crossovers[0] == pytest.approx(50.0, rel=0.02)
    assert found.report.is_stable and found.report.modulus_margin > 0.5
    assert K.lower < K.gamma < 4.0
    # the claim is of the shaped plant with the robust part: take the shaping out again
    shaping = frequency_response(found.shaped, [7.0]).data / frequency_response(G, [7.0]).data
    part = frequency_response(K, [7.0]).data / shaping
    s = np.exp(14j * np.pi * G.dt) if G.dt else 14j * np.pi
    g = found.shaped.evaluated(s)[0, 0]
    distance = (1 + abs(part[0, 0, 0]) ** 2) * (1 + abs(g) ** 2) / abs(1 - part[0, 0, 0] * g) ** 2
    assert np.sqrt(distance) <= K.gamma * (1 + 1e-6)
    if rolloff:
        fast = frequency_response(K, [300.0, 3000.0]).data[0, 0]
        plain = frequency_response(shape_loop(G, bandwidth=50.0), [300.0, 3000.0]).data[0, 0]
        assert abs(fast[1] / fast[0]) < 0.1 * abs(plain[1] / plain[0])


@pytest.mark.parametrize("rate", [0.0, 1e4], ids=["continuous", "sampled"])
def test_a_free_mass_has_one_margin_at_any_bandwidth_and_mass(rate):
    """Time and gain scale out of 1 / s^2: no state is lost to the units."""
    margins = []
    for bandwidth, gain in [(0.1, 1.0), (1.0, 1e-3), (10.0, 1e-3), (1000.0, 1.0)]:
        if rate and bandwidth > 1.0:  # where the hold lags, the loop is another one
            continue
        mass = fx.lti.tf([gain], [1.0, 0.0, 0.0])
        found = shape_loop(discretized(mass, rate) if rate else mass, bandwidth=bandwidth)
        margins.append(found.controller.certificate["margin"])
    np.testing.assert_allclose(margins, margins[0], rtol=1e-3 if rate else 1e-6)


@cache
def two(weight):
    return shape_loop(mechanism(), bandwidth=50.0, model=40.0, weight=weight)


def closed(found, freq):
    """r -> y of the continuous mechanism, by dense solves."""
    K, G = found.system, mechanism()
    out = []
    for s in 2j * np.pi * freq:
        k, g = K.evaluated(s), G.evaluated(s)
        out.append((g @ k[:, 1:] / (1 - g @ k[:, :1]))[0, 0])
    return np.array(out)


@pytest.mark.slow
def test_two_degrees_of_freedom_follow_a_model():
    """T_ref = 1 / (p^2 + sqrt(2) p + 1): exact at zero, closer with more weight, less robust."""
    freq = np.geomspace(0.05, 2000.0, 400)
    p = 1j * freq / 40.0
    wanted = 1 / (p**2 + np.sqrt(2) * p + 1)
    errors, margins = [], []
    for weight in (1.0, 3.0):
        found = two(weight)
        assert found.system.inputs == ("y1", "y1:ref")
        y = closed(found, freq)
        assert y[0] == pytest.approx(wanted[0], abs=1e-3)
        errors.append(np.abs(y - wanted).max())
        # the mode at 900 Hz, 2 Hz wide, is in it
        at = 900.0 + np.linspace(-5.0, 5.0, 501)
        beside = 1 / ((1j * at / 40.0) ** 2 + np.sqrt(2) * 1j * at / 40.0 + 1)
        whole = max(errors[-1], np.abs(closed(found, at) - beside).max())
        claimed = found.controller.certificate["error of following"]
        assert claimed == pytest.approx(whole, rel=2e-3)
        margins.append(found.controller.certificate["margin"])
        assert margins[-1] >= (1 - 1e-3) / found.controller.gamma
        assert crossover(mechanism(), found.system.select(inputs=["y1"])) == pytest.approx(
            50.0, rel=0.025
        )
    assert errors[1] < 0.5 * errors[0]
    assert margins[1] < margins[0]


@pytest.mark.slow
def test_without_weight_the_two_are_the_one():
    """rho -> 0 leaves the problem of the coprime factors: gamma is its smallest."""
    found = shape_loop(BODY, bandwidth=1.0, model=1.0, weight=1e-3)
    assert found.controller.lower * (1 - 1e-4) <= found.controller.gamma
    assert found.controller.gamma <= 1.06 * found.controller.lower
    one = shape_loop(BODY, bandwidth=1.0)
    K = one.system
    assert ncf_margin(BODY, K) == pytest.approx(1.0 / brute(BODY, K), rel=1e-3)


def dense_radius(plant, K):
    """The spectral radius of plant and controller, by one dense matrix."""
    g = plant.system
    rows, columns = [g.outputs.index(n) for n in K.inputs], [g.inputs.index(n) for n in K.outputs]
    B, C, D = g.B[:, columns], g.C[rows], g.D[np.ix_(rows, columns)]
    inner = np.linalg.inv(np.eye(len(rows)) - D @ K.D)
    A = np.block(
        [
            [g.A + B @ K.D @ inner @ C, B @ (K.C + K.D @ inner @ D @ K.C)],
            [K.B @ inner @ C, K.A + K.B @ inner @ D @ K.C],
        ]
    )
    return np.abs(la.eigvals(A)).max()


@pytest.mark.slow
def test_the_stage_with_the_modes_left_out():
    """24 of 60 modes in the design: held at 25 Hz with all of them; eigenvalues of the whole."""
    P = sampled(small(), ports())
    found = shape_loop(P.replace(evaluation=many()), bandwidth=25.0, rolloff=400.0)
    assert [one.crossovers[0] for one in found.report.loops] == pytest.approx([25.0] * 3, rel=0.03)
    assert found.controller.left_out.is_fine
    whole = assemble_plant(many(), ports()).discretized(RATE, delay=1)
    for plant in (P, whole):
        assert dense_radius(plant, found.system) < 1.0
    assert found.controller.gamma < 4.0


@pytest.mark.slow
def test_the_stage_follows_its_reference():
    """Two degrees of freedom on the sampled, late stage: a step ends on the reference."""
    P = sampled(reduced(), ports())
    found = shape_loop(P, bandwidth=50.0, model=50.0, references={"die:z": "die:ref"})
    assert found.system.inputs == ("y1", "y2", "y3", "y4", "die:ref")
    loop = fx.close_loop(P, found)
    assert loop.is_stable and loop.modulus_margin > 0.5
    gain = loop.frequency_response([0.05]).data
    row, column = P.z.index("die:z"), P.w.index("die:ref")
    assert gain[row, column, 0] == pytest.approx(1.0, abs=5e-3)
    with pytest.warns(FlexplantWarning, match="with the modes that the plant left out"):
        shape_loop(
            sampled(small(12), ports()).replace(evaluation=many()), bandwidth=120.0, model=100.0
        )


@pytest.mark.slow
def test_what_does_not_go_together_is_refused():
    G = mechanism(2e4)
    with pytest.raises(ModelError, match="needs a model"):
        shape_loop(frequency_response(G, [1.0, 2.0]), bandwidth=50.0)
    with pytest.raises(ModelError, match="continuous and stable, with 1 inputs"):
        shape_loop(G, bandwidth=50.0, model=StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(LabelError, match="no axis 'y2'"):
        shape_loop(G, bandwidth=50.0, references={"y2": "r"})
    with pytest.raises((SolverError, CertificateError), match=r"delay or .*resonances"):
        shape_loop(discretized(mechanism(), 2e4, delay=40), bandwidth=900.0)
    for name in ("bandwidth", "rolloff"):
        with pytest.raises(ModelError, match=f"{name} is at 12000 Hz, not below half the rate"):
            shape_loop(G, **({"bandwidth": 50.0} | {name: 12e3}))


@pytest.mark.slow
def test_what_is_rarely_meant_is_said():
    """A model above half the rate is refused; a low roll-off, a heavy weight are warned of."""
    sampled = discretized(BODY, 200.0)
    with pytest.raises(ModelError, match="model is at 150 Hz, not below half the rate, 100 Hz"):
        shape_loop(sampled, bandwidth=1.0, model=150.0)
    with pytest.warns(FlexplantWarning, match="not above twice the bandwidth"):
        shape_loop(BODY, bandwidth=1.0, rolloff=1.9)
    with pytest.warns(FlexplantWarning, match="1 to 3 is usual"):
        shape_loop(BODY, bandwidth=1.0, model=1.0, weight=30.0)
    frf = fx.frequency_response(BODY, np.array([1.0, 2.0]))
    with pytest.raises(ModelError, match="tune laws on the Frf by tune_loops"):
        fx.design_ncf(frf)
