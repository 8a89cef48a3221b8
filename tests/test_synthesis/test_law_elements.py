"""Elements and laws against their transfer functions, and SciPy's bilinear map."""

import numpy as np
import pytest
import scipy.signal

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.synthesis import Law, Lead, LowPass, Notch, Pid

FREQ = np.geomspace(0.3, 4900.0, 60)
S = 2j * np.pi * FREQ


def w(freq):
    return 2 * np.pi * freq


#: element, its transfer function written out, order
ELEMENTS = [
    (Pid(2.0), lambda s: 2.0 + 0 * s, 0),
    (Pid(2.0, 3.0), lambda s: 2.0 + 3.0 / s, 1),
    (Pid(2.0, d=0.1, pole=50.0), lambda s: 2.0 + 0.1 * s / (1 + s / w(50)), 1),
    (Pid(2.0, 3.0, 0.1, 50.0), lambda s: 2.0 + 3.0 / s + 0.1 * s / (1 + s / w(50)), 2),
    (
        Pid.corners(1e5, integrator=4.0, zero=12.0, pole=200.0),
        lambda s: 1e5 * (1 + w(4) / s) * (1 + s / w(12)) / (1 + s / w(200)),
        2,
    ),
    (Lead(60.0, 9.0), lambda s: (1 + s / w(20)) / (1 + s / w(180)) / 3, 1),
    (Lead(60.0, 0.25), lambda s: 2 * (1 + s / w(120)) / (1 + s / w(30)), 1),
    (
        Notch(830.0, 0.1, 0.2),
        lambda s: (
            (s**2 + 0.04 * w(830) * s + w(830) ** 2) / (s**2 + 0.4 * w(830) * s + w(830) ** 2)
        ),
        2,
    ),
    (LowPass(400.0), lambda s: 1 / ((s / w(400)) ** 2 + np.sqrt(2) * s / w(400) + 1), 2),
    (LowPass(400.0, 1), lambda s: 1 / (s / w(400) + 1), 1),
]


@pytest.mark.parametrize(("element", "transfer", "order"), ELEMENTS, ids=lambda x: repr(x)[:12])
def test_an_element_in_closed_form(element, transfer, order):
    np.testing.assert_allclose(element.law.response(FREQ), transfer(S), rtol=1e-12)
    np.testing.assert_allclose(
        fx.frequency_response(element, FREQ).data[0, 0], transfer(S), rtol=1e-10
    )
    assert element.system.n_states <= order
    late = element.sampled(1e4)
    np.testing.assert_allclose(
        fx.frequency_response(late, FREQ).data[0, 0], late.response(FREQ), rtol=1e-9
    )


def test_products_multiply():
    law = 2.0 * Pid(3.0, 1.0) * Notch(80.0) * (LowPass(400.0, 1) * 0.5)
    wanted = (3.0 + 1.0 / S) * Notch(80.0).law.response(FREQ) / (S / w(400) + 1)
    np.testing.assert_allclose(law.response(FREQ), wanted, rtol=1e-12)
    assert (law.gain, len(law.factors), law.system.n_states) == (1.0, 3, 4)
    assert repr(law) == (
        "Pid(p=3, i=1 /s, d=0 s) * Notch(freq=80 Hz, depth=0.05, width=0.3, skew=1) * "
        "LowPass(freq=400 Hz, order=1, damping=0.707107)"
    )


def test_sampled_by_tustin_what_has_a_frequency_stays_there():
    """A notch at 0.4 of the rate is at 0.4 of the rate; plain Tustin puts it at 0.29."""
    rate = 1e3
    for element in (Notch(400.0, 0.01), LowPass(400.0), Lead(400.0)):
        at = np.array([400.0])
        exact = element.law.response(at)
        np.testing.assert_allclose(element.sampled(rate).response(at), exact, rtol=1e-12)
    plain = Law((Notch(400.0, 0.01),), rate=rate, prewarped=False)
    assert abs(plain.response([400.0])[0]) > 0.5
    # a law without such frequencies: SciPy's bilinear map
    law = Pid(2.0, 3.0, 0.1, 50.0)
    num = np.polyadd(np.polymul([2.0, 3.0], [1 / w(50), 1.0]), [0.1, 0.0, 0.0])
    b, a = scipy.signal.bilinear(num, [1 / w(50), 1.0, 0.0], fs=rate)
    z = np.exp(2j * np.pi * np.array([1.0, 30.0, 300.0]) / rate)
    wanted = np.polyval(b, z) / np.polyval(a, z)
    np.testing.assert_allclose(law.sampled(rate).response([1.0, 30.0, 300.0]), wanted, rtol=1e-9)


def test_what_makes_no_law_is_refused():
    with pytest.raises(ModelError, match="derivative without a pole"):
        Pid(1.0, d=1.0)
    with pytest.raises(ModelError, match="a zero and a pole"):
        Pid.corners(1.0, zero=3.0)
    with pytest.raises(ModelError, match="not below half the rate"):
        Notch(600.0).sampled(1e3)
    with pytest.raises(ModelError, match="a factor of a law must be"):
        Law((1.0,))
    with pytest.raises(ModelError, match="run at 1000 and 2000 Hz"):
        _ = Pid(1.0).sampled(1e3) * Pid(1.0).sampled(2e3)


def test_laws_are_scaled_and_not_added():
    law = Pid(3.0, i=1.0) * Notch(80.0)
    freq = np.array([10.0, 70.0])
    np.testing.assert_allclose((-law / 4).response(freq), -0.25 * law.response(freq), rtol=1e-12)
    np.testing.assert_allclose((-Pid(2.0)).law.response(freq), -2.0, rtol=1e-12)
    with pytest.raises(ModelError, match="not zero, got 0"):
        law / 0
    with pytest.raises(ModelError, match="a law is a product"):
        Pid(2.0) + Lead(30.0)
    with pytest.raises(ModelError, match="a law is a product"):
        1.0 - law
