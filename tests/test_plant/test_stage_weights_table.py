"""The table in the docstring of stage_weights, measured again on the machine."""

import re
import warnings
from functools import cache

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning
from flexplant.loop import close_loop
from flexplant.plant import reference_errors, stage_weights
from flexplant.synthesis import design_hinf
from flexplant.testbeds import wafer_stage
from stages import RATE, fitted, ports, reduced, sampled

KNOBS = ("peak", "disturbance", "effort", "noise")


def rows():
    """Return (bandwidth, changed knobs, numbers) of each line of the table."""
    found = []
    for line in (stage_weights.__doc__ or "").splitlines():
        cells = re.split(r"\s{2,}", line.strip())
        if re.fullmatch(r"\d+", cells[0]) and len(cells) in (6, 7):
            words = " ".join(cells[1:-5]).replace(",", "").split()
            knobs = dict(zip(words[::2], map(float, words[1::2]), strict=True))
            found.append((float(cells[0]), knobs, [float(cell) for cell in cells[-5:]]))
    return found


@cache
def machine(damping=0.001):
    return wafer_stage(elements=(8, 8), damping=damping, rate=RATE, delay=1)


@cache
def model(damping=0.001):
    return fitted(reduced(damping), machine(damping).poles([6, 7]).poles).model


def judged(bandwidth, knobs, damping=0.001):
    """Design on the updated model; |S| of the machine over a grid through the loop's resonances."""
    plant = sampled(model(damping))
    errors, weights = reference_errors(plant), stage_weights(plant, bandwidth, **knobs)
    found = design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    loop = machine(damping).loop(ports(), errors, found)
    swing = np.log(loop.monitored.poles())
    swing = swing[(swing.imag > 0) & (np.abs(swing) < 3.1)] * RATE / (2 * np.pi)
    near = swing.imag + swing.real * np.linspace(-3, 3, 13)[:, None]
    freq = np.unique(
        np.append(np.geomspace(0.5, 0.499 * RATE, 1500), near[(near > 0.5) & (near < 0.499 * RATE)])
    )
    S = np.abs(loop.frequency_response(freq)["die:error", "die:ref"])
    assert loop.spectral_radius < 1
    numbers = [
        found.gamma,
        freq[np.argmax(S >= 1)],
        20 * np.log10(S.max()),
        -20 * np.log10(loop.modulus_margin),
        np.interp(5.0, freq, S),
    ]
    return found, numbers


def test_the_table_names_every_knob():
    named = [knobs for _, knobs, _ in rows()]
    assert len(named) == 14
    assert {name for knobs in named for name in knobs} == set(KNOBS)


@pytest.mark.slow
@pytest.mark.parametrize(("bandwidth", "knobs", "numbers"), rows())
def test_a_line_of_the_table(bandwidth, knobs, numbers):
    found, measured = judged(bandwidth, knobs)
    steps = np.array([0.02 * numbers[0], 0.02 * numbers[1], 0.25, 0.25, 0.00006])
    np.testing.assert_array_less(np.abs(np.array(measured) - numbers), steps)
    # gamma is the size of the largest block, beside 1 that is asked
    assert 0.5 * found.gamma < max(found.reached.values()) <= found.gamma * (1 + 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("bandwidth", "damping"), [(30.0, 0.01), (50.0, 0.001), (80.0, 0.001)])
def test_the_defaults_keep_margins_on_the_machine(bandwidth, damping):
    found, (gamma, reached, at_poi, at_u, _) = judged(bandwidth, {}, damping)
    assert reached > bandwidth
    assert max(at_poi, at_u) < 8.0
    assert gamma < 1.15
    assert found.reached["efforts from disturbances"] == pytest.approx(gamma, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bandwidth", "size", "to", "at_u"), [(80.0, 3.0, 88.7, 7.6), (100.0, 2.0, 102.0, 10.4)]
)
def test_nominal_unstable_and_updated_stable_on_the_machine(bandwidth, size, to, at_u):
    """The hidden 0.5 kg at 0.1 % damping; noise as small as 0.005."""
    radii = []
    for source in (reduced(0.001), model()):
        plant = sampled(source)
        errors = reference_errors(plant)
        weights = stage_weights(plant, bandwidth, disturbance=size, effort=size, noise=0.005)
        found = design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
        assert close_loop(plant, errors, found).spectral_radius < 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FlexplantWarning)
            loop = machine().loop(ports(), errors, found)
        radii.append(loop.spectral_radius)
    assert radii[0] > 1.0005
    assert radii[1] < 1.0
    freq = np.geomspace(0.5, 300.0, 1500)
    S = np.abs(loop.frequency_response(freq)["die:error", "die:ref"])
    assert freq[np.argmax(S >= 1)] == pytest.approx(to, rel=0.02)
    assert -20 * np.log10(loop.modulus_margin) == pytest.approx(at_u, abs=0.6)
