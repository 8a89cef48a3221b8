"""Disk margins beside python-control, and beside loops whose gains are changed."""

import control
import numpy as np
import pytest

import flexplant as fx
from flexplant.synthesis import margins


def stable_loop(rng, dt=0.0):
    """Return num, den of a random loop gain that unity feedback stabilises."""
    while True:
        n = int(rng.integers(2, 5))
        den = np.real(np.poly(-rng.uniform(0.05, 8.0, n)))
        num = rng.uniform(0.5, 30.0) * np.real(np.poly(-rng.uniform(0.5, 10.0, n - 2)))
        if np.all(np.real(np.roots(np.polyadd(den, num))) < -0.02):
            return num, den


@pytest.mark.parametrize("seed", range(10))
def test_one_loop_has_the_margins_of_python_control(seed):
    num, den = stable_loop(np.random.default_rng(seed))
    found = margins(fx.lti.tf(num, den))
    theirs, coarse = control.tf(num, den), np.logspace(-3, 3, 1500)
    for disk, skew in zip(found.disks[0], (0.0, 1.0, -1.0), strict=True):
        each = control.disk_margins(theirs, coarse, skew=skew, returnall=True)[0]
        least = coarse[np.argmin(each)]
        finer = least * np.linspace(0.98, 1.02, 500)
        alpha, gain, phase = control.disk_margins(theirs, np.append(coarse, finer), skew=skew)
        assert disk.alpha == pytest.approx(alpha, rel=1e-4)
        assert disk.reached == pytest.approx(alpha, rel=1e-4)
        assert disk.phase == pytest.approx(min(phase, 180.0), rel=1e-3)
        low, high = disk.gains
        if np.isfinite(gain):  # theirs is infinite where either side is
            assert min(1 / low if low else np.inf, high) == pytest.approx(
                10 ** (gain / 20), rel=1e-3
            )
    loop = found.loops[0]
    for freq, phase in zip(loop.crossovers, loop.phases, strict=True):
        L = np.polyval(num, 2j * np.pi * freq) / np.polyval(den, 2j * np.pi * freq)
        assert -L * np.exp(-1j * np.radians(phase)) == pytest.approx(1.0, abs=1e-6)
    for freq, factor in loop.gains:
        L = np.polyval(num, 2j * np.pi * freq) / np.polyval(den, 2j * np.pi * freq)
        assert -factor * L == pytest.approx(1.0, abs=1e-4)
    delays = [
        np.radians(p % 360) / (2 * np.pi * f)
        for p, f in zip(loop.phases, loop.crossovers, strict=True)
    ]
    assert loop.delay_margin == pytest.approx(min(delays, default=np.inf))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["S-T", "S", "T"])
def test_loops_that_change_at_once_stay_stable_within_the_disk(seed, kind):
    """Factors of all loops from the disk, drawn on its edge, keep |det(I - f L)| away from 0."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    A, B, C = rng.normal(size=(4, 4)), rng.normal(size=(4, n)), rng.normal(size=(n, 4))
    worst = max(*np.linalg.eigvals(A).real, *np.linalg.eigvals(A - B @ C).real)
    A -= (worst + 0.3) * np.eye(4)  # stable, open and closed
    loop = fx.StateSpace(A, B, C, 0)
    (disk,) = (one for one in margins(loop).together if one.kind == kind)
    assert disk.alpha <= disk.reached * (1 + 1e-6)
    assert disk.reached <= 1.1 * disk.alpha
    sigma = {"S-T": 0.0, "S": 1.0, "T": -1.0}[kind]
    for _ in range(300):
        d = 0.999 * disk.alpha * np.exp(2j * np.pi * rng.uniform(size=n))
        f = (2 + (1 - sigma) * d) / (2 - (1 + sigma) * d)
        assert max(np.linalg.eigvals(A - (B * f) @ C).real) < 0


def test_a_table_is_read_by_name_and_printed_with_units():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0, observer=observer))
    found = margins(loop)
    assert found.disks[0][1].alpha == pytest.approx(loop.modulus_margin, rel=1e-3)
    for words in ("crosses 1 at [Hz]", "delay [ms]", "S-T", "phase [deg]", "gain [dB]"):
        assert words in repr(found)


def test_an_unstable_loop_has_no_margins():
    with pytest.raises(fx.FlexplantError, match="not stable"):
        margins(fx.lti.tf([1.0], [1.0, -2.0]))


def test_a_loop_that_never_crosses_says_so():
    assert "never" in repr(margins(fx.lti.tf([0.1], [1.0, 1.0])))
