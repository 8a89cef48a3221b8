"""FRFs of the convention exp(-i omega t): random machines, each in both conventions."""

import warnings

import numpy as np
import pytest
from test_real_measurements import ruler, vibration_toolbox

from flexplant.errors import FlexplantWarning
from flexplant.identification import identify_modes, stabilisation_diagram
from flexplant.identification.identify import forward_in_time
from flexplant.lti import Frf
from oracles_identification import pole

QUANTITIES = ("displacement", "velocity", "acceleration")


def machine(rng, noise):
    """Separated modes, of which those in the middle lie in the band; all units and quantities."""
    top = 10 ** rng.uniform(1, 4)
    n = int(rng.integers(3, 8))
    freq = top * (np.arange(1, n + 1) + rng.uniform(-0.25, 0.25, n)) / (n - 0.5)
    zeta = 10 ** rng.uniform(-3, -1.7, n)
    lines = np.linspace(0.0, top, int(rng.integers(400, 1200)))[1:]
    out, into = rng.normal(size=(int(rng.integers(2, 6)), n)), rng.normal(size=(n, 2))
    s, omega = 2j * np.pi * lines, 2 * np.pi * freq[:, None]
    terms = 1.0 / (s**2 + 2 * zeta[:, None] * omega * s + omega**2)
    order = int(rng.integers(3))
    data = np.einsum("ok,ki,kf->oif", out, into, terms) * s**order
    data += noise * np.abs(data).mean() * (rng.normal(size=(2, *data.shape)).T @ [1, 1j]).T
    inside = freq < 0.95 * top
    return Frf(lines, data, quantity=QUANTITIES[order]), pole(freq, zeta)[inside]


def identified(frf):
    """The modes and the texts of all warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = identify_modes(frf, refine=False)
    return found, [str(one.message) for one in caught]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("noise", [1e-6, 1e-2])
def test_both_conventions_give_the_same_modes(seed, noise):
    frf, truth = machine(np.random.default_rng([seed, int(1e6 * noise)]), noise)
    given, said = identified(frf)
    assert not any("conjugate" in text for text in said)
    other, said = identified(frf.replace(data=frf.data.conj()))
    assert sum("exp(-i omega t)" in text and "conjugate is used" in text for text in said) == 1
    np.testing.assert_array_equal(other.poles, given.poles)
    np.testing.assert_array_equal(other.shapes, given.shapes)
    for one in truth:
        near = np.abs(given.poles - one).min()
        assert near < 0.05 * -one.real + 10 * noise * abs(one) * 0.02
    with pytest.warns(FlexplantWarning, match="conjugate is used"):
        diagram = stabilisation_diagram(frf.replace(data=frf.data.conj()))
    np.testing.assert_array_equal(diagram.poles, stabilisation_diagram(frf).poles)


def test_variance_and_correlation_go_with_the_data():
    rng = np.random.default_rng(5)
    frf, _ = machine(rng, 1e-4)
    n = len(frf.outputs)
    mixed = rng.normal(size=(n, n, 2)) @ [1, 0.5j]
    mixed = np.eye(n) + 0.1 * (mixed + mixed.conj().T) * (1 - np.eye(n))
    correlation = np.repeat(mixed[:, :, None], frf.freq.size, axis=2)
    full = frf.replace(variance=np.abs(frf.data) ** 2 + 1.0, correlation=correlation)
    other = full.replace(data=frf.data.conj(), correlation=correlation.conj())
    with pytest.warns(FlexplantWarning, match="conjugate is used"):
        found = forward_in_time(other, None)[0]
    for name in ("data", "variance", "correlation"):
        np.testing.assert_array_equal(getattr(found, name), getattr(full, name))


@pytest.mark.parametrize("seed", range(40))
def test_the_usual_convention_is_never_turned(seed):
    """Few lines, noise above the responses, modes narrower than a line, delays, free bodies."""
    rng = np.random.default_rng(seed)
    top = 10 ** rng.uniform(0, 4)
    n, count = int(rng.integers(1, 12)), int(10 ** rng.uniform(1.5, 3))
    lines = np.linspace(rng.choice([0.0, 0.3]) * top, top, count + 1)[1:]
    freq, zeta = top * rng.uniform(0.05, 1.2, n), 10 ** rng.uniform(-4, -1.3, n)
    s, omega = 2j * np.pi * lines, 2 * np.pi * freq[:, None]
    terms = 1.0 / (s**2 + 2 * zeta[:, None] * omega * s + omega**2)
    data = np.einsum("ok,ki,kf->oif", rng.normal(size=(3, n)), rng.normal(size=(n, 2)), terms)
    data = data + rng.choice([0.0, 1.0]) * rng.normal(size=(3, 2, 1)) / s**2
    data = data * s ** int(rng.integers(3)) * np.exp(-s * rng.choice([0.0, 0.3]) / top)
    size = rng.choice([0.0, 0.01, 0.3, 1.0, 10.0]) * np.abs(data).mean()
    data += size * (rng.normal(size=(2, *data.shape)).T @ [1, 1j]).T
    frf = Frf(lines, data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert forward_in_time(frf, None)[0] is frf


@pytest.mark.parametrize(
    ("read", "argument", "band"),
    [
        (ruler, (20.0, 400.0), None),
        (ruler, (400.0, 1500.0), None),
        (vibration_toolbox, ("vt_case1.mat",), (150.0, 280.0)),
    ],
)
def test_real_measurements_in_both_conventions(read, argument, band):
    frf = read(*argument)
    assert forward_in_time(frf, band)[0] is frf
    with pytest.warns(FlexplantWarning, match="conjugate is used"):
        found = forward_in_time(frf.replace(data=frf.data.conj()), band)[0]
    np.testing.assert_array_equal(found.data, frf.data)
