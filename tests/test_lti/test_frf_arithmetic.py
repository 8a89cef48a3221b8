"""Frf arithmetic beside that of the systems it came from, and beside drawn errors."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError, ShapeError

FREQ = np.array([0.1, 1.0, 7.0])


def system(poles, n_in, n_out, seed):
    rng = np.random.default_rng(seed)
    n = len(poles)
    B, C = rng.normal(size=(n, n_in)), rng.normal(size=(n_out, n))
    units = {f"y{i + 1}": "m" for i in range(n_out)} | {f"u{i + 1}": "N" for i in range(n_in)}
    return fx.StateSpace(np.diag(poles), B, C, 0, units=units)


def test_responses_calculate_as_their_systems():
    g, h, k = (system(p, 2, 2, i) for i, p in enumerate(([-1.0, -3.0], [-2.0], [-9.0, -5.0])))
    G, H = (fx.frequency_response(one, FREQ) for one in (g, h))
    for found, there in (
        (G * H, g * h),
        (G + H, g + h),
        (G - H, g - h),
        (-G, -g),
        (2.0 * G, 2.0 * g),
        (np.float64(2.0) * G * 3, 6.0 * g),
        (G / 4, g / 4),
        (k * G, k * g),
        (G * k, g * k),
        (k + G, k + g),
        (k - G, k - g),
        (G - k, g - k),
    ):
        expected = fx.frequency_response(there, FREQ)
        np.testing.assert_allclose(found.data, expected.data, rtol=1e-12, atol=1e-15)
        assert (found.inputs, found.outputs) == (expected.inputs, expected.outputs)
        assert dict(found.units) == dict(expected.units)
    np.testing.assert_allclose((G * k.to_control()).data, (G * k).data)
    np.testing.assert_allclose(G.mag * np.exp(1j * G.phase), G.data)
    np.testing.assert_array_equal((1j * G)[0, 1], 1j * G["y1", "u2"])


def test_quotients_of_one_channel():
    """Of two responses, and of a number: as python-control divides, with the variance drawn."""
    rng = np.random.default_rng(2)
    one, two = (rng.normal(size=(1, 1, 3)) + 1j * rng.normal(size=(1, 1, 3)) for _ in range(2))
    G, H = fx.Frf(FREQ, one), fx.Frf(FREQ, two, variance=np.full((1, 1, 3), 1e-6))
    np.testing.assert_allclose((G / H).data, one / two)
    np.testing.assert_allclose((2.0 / H).data, 2.0 / two)
    noise = rng.normal(size=(2, 20_000, 1, 1, 3))
    drawn = one / (two + np.sqrt(0.5e-6) * (noise[0] + 1j * noise[1]))
    np.testing.assert_allclose((G / H).variance, np.var(drawn, axis=0), rtol=0.05)
    with pytest.raises(ModelError, match="other than 0"):
        system([-1.0], 1, 1, 0) / 0
    with pytest.raises(ModelError, match=r"the response is 0 at 0\.1 Hz"):
        G / fx.Frf(FREQ, [[[0.0, 1.0, 1.0]]])
    with pytest.raises(ShapeError, match="one input and one output"):
        G / fx.frequency_response(system([-1.0], 2, 1, 0), FREQ)


def test_errors_propagate_as_drawn_ones():
    rng = np.random.default_rng(1)
    A, B = (rng.normal(size=(2, 2, 3)) + 1j * rng.normal(size=(2, 2, 3)) for _ in range(2))
    va, vb = 1e-6 * rng.uniform(0.5, 2.0, size=(2, 2, 2, 3))
    a, b = (fx.Frf(FREQ, d, variance=v) for d, v in ((A, va), (B, vb)))

    def drawn(values, variance):
        size = (4000, *values.shape)
        noise = rng.normal(size=size) + 1j * rng.normal(size=size)
        return values + np.sqrt(variance / 2) * noise

    many = drawn(A, va), drawn(B, vb)
    product = np.einsum("dijf,djkf->dikf", *many) - np.einsum("ijf,jkf->ikf", A, B)
    np.testing.assert_allclose((a * b).variance, np.mean(np.abs(product) ** 2, axis=0), rtol=0.12)
    np.testing.assert_allclose((a - b).variance, va + vb)
    np.testing.assert_allclose((2j * a).variance, 4 * va)
    np.testing.assert_allclose((a + fx.Frf(FREQ, B)).variance, va)


def test_what_belongs_to_one_measurement_stays_there():
    G = fx.Frf(FREQ, np.ones((1, 1, 3)), quantity="velocity", coherence=np.ones((1, 1, 3)))
    assert (3 * G).coherence is not None and (3 * G).quantity == "velocity"
    assert (G + G).coherence is None and (G + G).quantity == "velocity"
    assert (G * G).quantity is None and (G * G).unit("y1", "u1") == "m/s/N"


def test_what_does_not_combine_is_refused():
    G = fx.Frf(FREQ, np.ones((1, 2, 3)))
    with pytest.raises(ShapeError, match=r"3 lines from 0.1 to 7 Hz and the other 2 lines"):
        G + fx.Frf(FREQ[:2], np.ones((1, 2, 2)))
    with pytest.raises(LabelError, match="same channels, got u1, u2 -> y1 and a, u2 -> y1"):
        G + fx.Frf(FREQ, np.ones((1, 2, 3)), inputs=["a", "u2"])
    with pytest.raises(ShapeError, match=r"got 1 .y1. and 2 .u1, u2."):
        G * G
    for wrong in (0, "2"):
        with pytest.raises(ModelError, match="a number other than 0"):
            G / wrong
    with pytest.raises(ModelError, match="finite number"):
        np.inf * G
    with pytest.raises(LabelError, match=r"2 inputs. Use frf.select"):
        G["y1", ["u1", "u2"]]
    with pytest.raises(LabelError, match="input number 2 does not exist"):
        G[0, 2]
