"""certified_norm: no wrong loop passes; the sweep finds what a dense grid finds."""

import pickle
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import flexplant as fx
from flexplant.certificates import Certificate, Verified, deferred
from flexplant.errors import CertificateError
from flexplant.lti import StateSpace, lft
from flexplant.synthesis import controller as certificate
from flexplant.synthesis.controller import certified_norm, swept_norm
from oracles_synthesis import brute_norm


def loop_parts(dt=0.0):
    """An unstable scalar plant and a gain that stabilises it."""
    a = 1.2 if dt else 0.5
    P = StateSpace(
        [[a]],
        [[1.0, 1.0]],
        [[1.0], [1.0]],
        np.zeros((2, 2)),
        dt,
        inputs=["w", "u"],
        outputs=["z", "y"],
    )
    K = StateSpace([], [], [], [[-1.0]], dt, inputs=["y"], outputs=["u"])
    return P, K


@pytest.mark.parametrize(("dt", "norm", "edge"), [(0.0, 2.0, -0.5), (0.1, 1.25, 0.2)])
def test_scalar_loops_are_certified_with_their_exact_norm(dt, norm, edge):
    """1 / (s + 1/2) peaks at 2; 1 / (z - 0.2) at 1 / 0.8."""
    found = certified_norm(lft(*loop_parts(dt)), norm)
    assert found["norm"] == pytest.approx(norm, rel=1e-8)
    assert found["swept norm"] == pytest.approx(norm, rel=1e-6)
    assert found["spectral radius" if dt else "largest real part"] == pytest.approx(edge)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_the_other_sign_is_refused(dt):
    P, K = loop_parts(dt)
    with pytest.raises(CertificateError, match=r"not stable.*sign"):
        certified_norm(lft(P, K.replace(D=-K.D)), 10.0)


def test_a_claim_below_the_norm_is_refused_and_one_within_a_thousandth_is_not():
    P, K = loop_parts()
    with pytest.raises(CertificateError, match=r"norm 2, but 1\.99 was claimed"):
        certified_norm(lft(P, K), 1.99)
    assert certified_norm(lft(P, K), 1.9985)["claim"] == 1.9985


@pytest.mark.parametrize("wrong", [0.99, 1.01, float("nan")])
def test_two_norms_that_disagree_are_refused(monkeypatch, wrong):
    monkeypatch.setattr(certificate, "swept_norm", lambda *_: 2.0 * wrong)
    with pytest.raises(CertificateError, match="two routes"):
        certified_norm(lft(*loop_parts()), 2.0)


def test_a_marginally_stable_loop_is_refused():
    P, K = loop_parts()
    with pytest.raises(CertificateError, match="not stable"):
        certified_norm(lft(P, K.replace(D=[[-0.5]])), 10.0)


def test_static_loops_have_the_norm_of_their_gain():
    P = StateSpace([], [], [], [[3.0, 1.0], [1.0, 0.0]], inputs=["w", "u"], outputs=["z", "y"])
    K = StateSpace([], [], [], [[-1.0]], inputs=["y"], outputs=["u"])
    assert certified_norm(lft(P, K), 2.0)["norm"] == pytest.approx(2.0)
    sampled = certified_norm(lft(P.replace(dt=0.1), K.replace(dt=0.1)), 2.0)
    assert sampled["swept norm"] == pytest.approx(2.0)


@pytest.mark.slow
@given(
    seed=st.integers(0, 10**6),
    zeta=st.floats(1e-5, 0.5),
    dt=st.sampled_from([0.0, 1e-3]),
    delays=st.integers(0, 2),
)
def test_the_sweep_agrees_with_a_dense_grid(seed, zeta, dt, delays):
    """Three resonances at random frequencies; sampled ones with delays (poles at z = 0)."""
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * 10 ** rng.uniform(0, 2, 3)
    poles = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    poles = np.exp(poles * dt) if dt else poles
    A = np.zeros((6 + delays, 6 + delays))
    for i, p in enumerate(poles):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[p.real, p.imag], [-p.imag, p.real]]
    B, C = rng.normal(size=(6 + delays, 2)), rng.normal(size=(2, 6 + delays))
    if delays and dt:
        A[:6, 6] = rng.normal(size=6)
        A[6 : 5 + delays, 7:] = np.eye(delays - 1)
    elif delays:
        A[range(6, 6 + delays), range(6, 6 + delays)] = -1e3
    g = StateSpace(A, B, C, np.zeros((2, 2)), dt)
    assert swept_norm(g) == pytest.approx(brute_norm(A, B, C, g.D, dt), rel=5e-4)


def test_a_deferred_certificate_is_computed_once_where_it_is_read(tmp_path):
    """Not by what makes a value of it; by what shows, copies or saves one."""
    count = []

    def checks():
        count.append(1)
        yield from (Verified("norm", 1.0), Verified("norm", 2.0))

    whole = {"norm": 2.0, "radius": 0.5, "rank": 3.0}
    first = deferred(checks)
    both = (first | Certificate((Verified("radius", 0.5),))).extended(Verified("rank", 3.0))
    K = fx.synthesis.Controller(loop_parts()[1], "by hand", certificate=both).replace(gamma=2.0)
    assert not count
    assert "norm 2, radius 0.5000, rank 3" in repr(K)
    assert (dict(K.certificate), dict(first), count) == (whole, {"norm": 2.0}, [1])
    K.replace(certificate=deferred(checks)).save(tmp_path / "K.npz")
    assert dict(fx.load(tmp_path / "K.npz").certificate) == {"norm": 2.0}
    assert dict(pickle.loads(pickle.dumps(deferred(checks)))) == {"norm": 2.0}
    assert len(count) == 3


def test_a_deferred_certificate_that_fails_fails_each_time():
    def checks():
        raise CertificateError("two routes disagree")

    later = deferred(checks)
    assert "checks" in dir(later)  # which shows names, and computes nothing
    for read in (dict, repr, len, pickle.dumps):
        with pytest.raises(CertificateError, match="two routes"):
            read(later)
    with pytest.raises(AttributeError, match="check"):
        _ = Certificate().check


def test_a_field_put_off_whose_computation_lacks_an_attribute_is_not_a_missing_field():
    def checks():
        return np.zeros(1).no_such_thing

    later = deferred(checks)
    for read in (lambda v: hasattr(v, "checks"), lambda v: getattr(v, "checks", ()), dict):
        with pytest.raises(RuntimeError, match=r"^checks cannot.*no_such_thing") as found:
            read(later)
        assert isinstance(found.value.__cause__, AttributeError)


def test_a_deferred_certificate_is_read_in_two_threads_at_once():
    def checks():
        if not seen:  # another thread reads it before the first is done
            seen.append({})
            other = threading.Thread(target=lambda: seen.append(dict(later)))
            other.start()
            other.join()
        return [Verified("norm", 1.0)]

    seen, later = [], deferred(checks)
    assert dict(later) == seen[1] == {"norm": 1.0}
