"""Blows on a plate in polynomials, whose modes are its own and no mesh's; its poles are known."""

import warnings
from functools import cache

import numpy as np
import pytest
import scipy.signal as ss

from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.identification import identify_modes, impact_frf
from flexplant.testbeds.virtual_machine import DRAWING, plate_modes, ritz_plate
from oracles_identification import pole

RATE = 4000.0
PLACES = [(0.0, 0.0), (0.6, 0.0), (0.31, 0.6), (0.13, 0.26), (0.42, 0.33)]
STRUCK = {"1:z": 0, "4:z": 3}
ZETA = np.array([0.003, 0.002, 0.004, 0.0025, 0.003])


@cache
def plate():
    bare = ritz_plate(**DRAWING)
    omega, phi = plate_modes(bare)
    rows = np.array([bare.dofs.row(np.array([x, y, 0.0]), "z") for x, y in PLACES])
    return pole(omega[:5] / 2 / np.pi, ZETA), (rows @ phi)[:, :5]


def ringing(force, struck, noise, rng):
    """Displacements (5, n_time), the force held; modes beyond the fifth are not excited."""
    poles, phi = plate()
    y = np.zeros((5, force.size))
    for k, p in enumerate(poles):
        mode = ss.cont2discrete(([1.0], [1.0, -2 * p.real, abs(p) ** 2]), 1 / RATE)
        y += np.outer(phi[:, k] * phi[struck, k], ss.lfilter(mode[0][0], mode[1], force))
    return y + noise * np.std(y) * rng.normal(size=y.shape)


def blows(times, n, *, peaks=None, width=4):
    """Half sines of `width` samples."""
    force = np.zeros(n)
    pulse = np.sin(np.pi * (np.arange(width) + 0.5) / width)
    for time, peak in zip(times, peaks or np.full(len(times), 200.0), strict=True):
        at = round(time * RATE)
        force[at : at + width] += peak * pulse
    return force


def hammered(times, *, seed, noise=0.02, **options):
    """Force and responses of both points, struck one after the other in two experiments."""
    rng = np.random.default_rng(seed)
    n = round((max(times) + 1.3) * RATE)
    forces = np.zeros((2, 2, n))
    y = np.zeros((2, 5, n))
    for e, struck in enumerate(STRUCK.values()):
        forces[e, e] = blows(times, n, **options)
        y[e] = ringing(forces[e, e], struck, noise, rng)
    forces += 0.2 * rng.normal(size=forces.shape)
    return dict(zip(STRUCK, forces.transpose(1, 0, 2), strict=True)), {
        f"{i}:z": y[:, i - 1] for i in range(1, 6)
    }


def off(found):
    """Errors of real and imaginary parts in deviations; repeated pairs by the nearer one."""
    poles = plate()[0]
    assert len(found) == len(poles)
    rest = list(poles)
    near = [rest.pop(int(np.argmin(np.abs(np.array(rest) - p)))) for p in found.poles]
    error = found.poles - near
    return np.concatenate([error.real / found.std.real, error.imag / found.std.imag])


@pytest.mark.slow
def test_poles_are_the_machines_without_the_windows_damping():
    """A pair 3e-5 apart struck at two points; ringing 0.4 to 5 % into the next blow."""
    force, y = hammered([0.2, 1.4, 2.5, 3.9, 5.2], seed=1)
    test = impact_frf(force, y, RATE, segment=1.0)
    assert (len(test.used), len(test.refused), test.decay) == (10, 0, 0.25)
    seen = identify_modes(test.frf, band=(150.0, 700.0), hold=RATE)
    found = test.corrected(seen)
    np.testing.assert_allclose(found.poles - seen.poles, 4.0, rtol=1e-9)
    assert np.abs(off(found)).max() < 3.5
    assert np.sort(found.zeta) == pytest.approx(np.sort(ZETA), rel=0.02)
    phi = plate()[1]
    for k in range(3):
        shape = found.shapes[:, k] / np.sqrt(np.vdot(found.shapes[:, k], found.shapes[:, k]).real)
        assert abs(np.vdot(shape, phi[:, k])) ** 2 / np.sum(phi[:, k] ** 2) > 0.9999


@pytest.mark.long
def test_deviations_of_few_blows_are_those_of_the_errors():
    """Three blows that ring to 1 % and less, and noise: two modes, 12 records, 48 scores."""
    rng = np.random.default_rng(6)
    force = blows([0.2, 2.4, 4.5], 28_000)
    clean = ringing(force, 3, 0.0, rng)[[1, 3, 4]]
    scores = []
    for _ in range(12):
        y = clean + 0.3 * np.std(clean) * rng.normal(size=clean.shape)
        test = impact_frf(force, y, RATE, segment=2.0, decay=0.5)
        found = test.corrected(identify_modes(test.frf, band=(215.0, 390.0), hold=RATE))
        error = found.poles[:2] - plate()[0][:2]
        scores.append([error.real / found.std.real[:2], error.imag / found.std.imag[:2]])
    # the rms of 48 independent scores is known to 10 %
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.3)


def test_doubles_overloads_and_cut_blows_are_left_out_with_their_reasons():
    rng = np.random.default_rng(3)
    times = [0.1, 1.4, 1.43, 2.7, 4.0, 5.3, 6.6]
    force = blows(times, 28_000, peaks=[200.0, 150.0, 80.0, 200.0, 900.0, 180.0, 190.0])
    y = ringing(force, 0, 0.01, rng)
    force += 0.1 * rng.normal(size=force.size)
    y = np.clip(y, -0.4 * np.abs(y).max(), 0.4 * np.abs(y).max())  # the fifth blow overloads
    test = impact_frf({"1:z": force}, y, RATE, segment=1.0)
    assert [round(blow.time, 1) for blow in test.used] == [0.1, 2.7, 5.3]
    reasons = {round(blow.time, 2): blow.reason for blow in test.refused}
    assert reasons[1.4] == "another blow follows after 0.0302 s"
    assert reasons[1.43] == "a blow came 0.0302 s before"
    assert "limit of its range" in reasons[4.0]
    assert reasons[6.6] == "the record ends 0.4 s after it"
    assert "refused Blow(input='1:z', time=6.6" in repr(test)
    with pytest.raises(ModelError, match=r"1:z has no blow.*range"):
        impact_frf({"1:z": force}, y, RATE, segment=1.0, limits={"1:z": 100.0})


def test_coherence_is_the_share_of_what_the_blows_have_in_common():
    rng = np.random.default_rng(4)
    force = blows(np.arange(40) * 0.3 + 0.1, 50_000)
    clean = ss.lfilter([0.0, 1.0], [1.0], force)
    options = {"segment": 0.25, "decay": np.inf}
    part = impact_frf(force, clean + 1e-3 * rng.normal(size=force.size), RATE, **options)
    assert part.frf.coherence[0, 0, :100].min() > 0.999
    noisy = impact_frf(force, clean + 15.0 * rng.normal(size=force.size), RATE, **options)
    error = np.abs(noisy.frf.data - part.frf.data)[0, 0, :100] ** 2
    assert np.mean(error / noisy.frf.variance[0, 0, :100]) == pytest.approx(1.0, abs=0.3)
    assert 0.3 < np.mean(noisy.frf.coherence[0, 0, :100]) < 0.95


@pytest.mark.parametrize("noise", [1e-2, 1e-3])
def test_five_blows_that_ring_at_the_records_end_give_three_poles(noise):
    """Ringing 2.8 % at the end of each record, the first mode: not one pole more."""
    rng = np.random.default_rng(2)
    rate, count = 1000.0, 2000
    freq, zeta = np.array([41.3, 102.6, 163.9]), np.array([0.00689, 0.008, 0.006])
    phi = rng.normal(size=(3, 3))
    force = np.zeros(5 * count + 50)
    for k in range(5):
        force[50 + k * count : 53 + k * count] = 100.0 * np.array([0.5, 1.0, 0.5])
    y = np.zeros((3, force.size))
    for k, p in enumerate(pole(freq, zeta)):
        mode = ss.cont2discrete(([abs(p) ** 2], [1.0, -2 * p.real, abs(p) ** 2]), 1 / rate)
        y += np.outer(phi[:, k] * phi[0, k], ss.lfilter(mode[0][0], mode[1], force))
    y += noise * np.std(y) * rng.normal(size=y.shape)
    test = impact_frf(force, y, rate, segment=1.9)
    found = test.corrected(identify_modes(test.frf, band=(20.0, 250.0), hold=rate))
    assert found.freq == pytest.approx(freq, rel=1e-3)
    assert found.zeta == pytest.approx(zeta, rel=0.03)
    assert np.abs((found.poles - pole(freq, zeta)).real / found.std.real).max() < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_mains_in_the_record_is_no_pole(seed):
    """Nothing damps it once the window is taken out; by noise half of all draws did a little."""
    force, motion = hammered([0.1, 1.5, 2.9], seed=seed)
    time = np.arange(motion["1:z"].shape[1]) / RATE
    hum = 0.2 * np.sin(2 * np.pi * 350.0 * time + seed)
    motion = {name: y + hum * np.std(y) for name, y in motion.items()}
    test = impact_frf(force, motion, RATE, segment=1.2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = test.corrected(identify_modes(test.frf, band=(200.0, 700.0)))
    freq = np.abs(plate()[0]) / (2 * np.pi)
    assert found.freq == pytest.approx(freq[(freq > 200.0) & (freq < 700.0)], rel=1e-3)
    with pytest.raises(ModelError, match="already"):
        test.corrected(found)


def half_sines(rng, n, rate, *, front=400):
    """Blows of one random width, each with a random phase, and the response of one mode."""
    width = rng.uniform(3.0, 30.0)
    force = np.zeros(n)
    for at in range(front, n - 1500, 2000):
        time = np.arange(n) - at - rng.uniform(0.0, 1.0)
        inside = (time >= 0) & (time <= width)
        force[inside] += rng.uniform(100.0, 200.0) * np.sin(np.pi * time[inside] / width)
    p = pole(rng.uniform(0.01, 0.05) * rate, 0.02)
    mode = ss.cont2discrete(([abs(p) ** 2], [1.0, -2 * p.real, abs(p) ** 2]), 1 / rate)
    return force, ss.lfilter(mode[0][0], mode[1], force)


@pytest.mark.parametrize("seed", range(30))
def test_a_level_of_rest_is_no_limit(seed):
    """Without noise, with an offset, of either sign, rectified noise, few bits: all are used."""
    rng = np.random.default_rng(seed)
    rate = 10 ** rng.uniform(3, 5)
    force, y = half_sines(rng, 10_000, rate)
    count = np.count_nonzero(np.diff(np.concatenate([[0.0], (force > 0).astype(float)])) > 0)
    sign, offset = rng.choice([-1.0, 1.0]), rng.choice([0.0, 7.3, -120.0])
    kind = seed % 3
    if kind == 1:  # a converter that knows no negative force
        force = np.maximum(force + rng.normal(size=force.size), 0.0)
    if kind == 2:
        quantum = 200.0 / 2 ** rng.integers(8, 16)
        force = quantum * np.round(force / quantum)
    y = y + 1e-4 * np.abs(y).max() * rng.normal(size=y.size)
    test = impact_frf(sign * force + offset, y, rate, segment=1500 / rate)
    assert (len(test.used), test.refused) == (count, ())


@pytest.mark.parametrize("seed", range(12))
def test_clipped_blows_are_found_whatever_the_offset(seed):
    """The converter stops at a part of the largest blow; channels with a stated range keep it."""
    rng = np.random.default_rng(100 + seed)
    rate = 4000.0
    force = np.zeros(9000)
    width = int(rng.integers(8, 24))
    pulse = np.sin(np.pi * (np.arange(width) + rng.uniform()) / (width + 1))
    for at, peak in ((500, 100.0), (3500, 400.0), (6500, 90.0)):
        force[at : at + width] = peak * pulse
    y = np.convolve(force, np.exp(-np.arange(900) / 90.0) * np.sin(np.arange(900)))[:9000]
    force = np.minimum(force + (seed % 2) * 0.3 * rng.normal(size=9000), 160.0)
    sign, offset = rng.choice([-1.0, 1.0]), rng.choice([0.0, 33.0])
    y += 1e-4 * rng.normal(size=y.size)
    given = {"force": sign * force + offset, "response": {"y": y}, "rate": rate, "segment": 0.5}
    test = impact_frf(**given)
    assert [round(blow.time * rate, -2) for blow in test.refused] == [3500]
    assert "u1 is at the limit" in test.refused[0].reason
    assert len(impact_frf(**given, limits=1e9).used) == 3
    assert len(impact_frf(**given, limits={"u1": 1e9}).used) == 3
    assert len(impact_frf(**given, limits={"y": 1e9}).used) == 2
    assert len(impact_frf(**given, limits=float(np.abs(given["force"]).max())).used) == 2


@pytest.mark.parametrize("seed", range(30))
def test_blows_that_are_clipped_a_little_are_found(seed):
    """Exactly the blows with three samples at the limit, without noise, with some, in few bits."""
    rng = np.random.default_rng(200 + seed)
    rate = 10 ** rng.uniform(3, 5)
    force, y = half_sines(rng, 10_000, rate)
    kind = seed % 3
    if kind == 1:
        force = force + 0.1 * rng.normal(size=force.size)
    # bits for which a smooth peak has no three samples in one quantum
    quantum = 200.0 / 2**14 if kind == 2 else 0.0
    limit = rng.uniform(0.5, 0.99) * force.max()
    limit = quantum * np.floor(limit / quantum) if quantum else limit
    clipped = np.minimum(quantum * np.round(force / quantum) if quantum else force, limit)
    begins = np.flatnonzero(np.diff((force > 20.0).astype(int)) == 1)
    held = [np.count_nonzero(clipped[at : at + 60] == limit) >= 3 for at in begins]
    sign, offset = rng.choice([-1.0, 1.0]), rng.choice([0.0, 7.3, -120.0])
    y = y + 1e-4 * np.abs(y).max() * rng.normal(size=y.size)
    given = {"response": y, "rate": rate, "segment": 1500 / rate}
    scale = 10.0 ** rng.integers(-9, 9)
    if all(held):
        with pytest.raises(ModelError, match="u1 is at the limit of its range"):
            impact_frf(scale * (sign * clipped + offset), **given)
        return
    test = impact_frf(scale * (sign * clipped + offset), **given)
    assert len(test.used) == len(held) - sum(held)
    assert all("u1 is at the limit" in blow.reason for blow in test.refused)
    assert len(test.refused) == sum(held)


@pytest.mark.parametrize("seed", range(8))
def test_a_record_may_begin_with_its_blow(seed):
    """The same FRF as with zeros in front, whatever is missing of them."""
    rng = np.random.default_rng(seed)
    rate, lead = 4000.0, 300
    force, y = half_sines(rng, 4000, rate, front=lead)
    y = np.diff(y, 2, prepend=[0.0, 0.0])  # an acceleration, whose mean is zero
    first = int(np.flatnonzero(force)[0])
    whole = impact_frf(force, y, rate, segment=0.4, decay=np.inf)
    for keep in (0, 1, 2, 5):
        cut = slice(first - keep, None)
        if keep == 0 and force[first] > force[first + 1]:
            continue
        test = impact_frf(force[cut], y[cut], rate, segment=0.4, decay=np.inf)
        assert len(test.used) == len(whole.used)
        assert abs(test.used[0].time * rate - keep) <= 2.0  # a pulse begins above 5 % of its peak
        pulse = np.abs(np.fft.rfft(force[first : first + 1600]))[1:800]
        seen = pulse > 0.2 * pulse.max()
        ours, theirs = test.frf.data[0, 0, seen], whole.frf.data[0, 0, seen]
        np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max())
    top = first + int(np.argmax(force[first : first + 40]))
    if force[top + 1] > 0.05 * force.max():
        with pytest.raises(ModelError, match="the record begins within its pulse"):
            impact_frf(force[top:2000], y[top:2000], rate, segment=0.4)


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"segment": 9.0}, ModelError, "segment"),
        ({"segment": -1.0}, ModelError, "segment"),
        ({"decay": 0.0}, ModelError, "decay"),
        ({"level": 1.5}, ModelError, "level"),
        ({"quantity": "position"}, LabelError, "quantity"),
        ({"limits": "5"}, ShapeError, "limits"),
        ({"limits": -5.0}, ModelError, "limits"),
        ({"limits": {"x": 5.0}}, LabelError, "channel"),
        ({"force": np.zeros((2, 4000))}, ModelError, "no blow"),
        ({"response": np.zeros(300)}, ShapeError, "same experiments"),
    ],
)
def test_bad_impact_tests_are_refused(changes, error, text):
    force = blows([0.1, 0.5], 4000)
    noise = np.random.default_rng(0).normal(size=force.size)
    arguments = {"force": force, "response": force + noise, "rate": RATE, "segment": 0.2} | changes
    with pytest.raises(error, match=text):
        impact_frf(**arguments)
