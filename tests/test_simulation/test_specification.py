"""Specifications: what is reached, what fails, and that a failed test shows the table."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.loop import bandwidth
from flexplant.simulation import exposure_errors, settling_time
from machines import observer, servo, stage


@pytest.fixture(scope="module")
def loop():
    return fx.close_loop(stage(), observer(), servo())


@pytest.fixture(scope="module")
def run(loop):
    move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    return fx.simulate(loop, reference=move, duration=0.6, rng=1, runs=2)


@pytest.mark.slow
def test_each_row_is_what_is_reached(loop, run):
    limits = {"ma": 5e-5, "msd": 5e-5, "rms": 1e-4, "peak": 1e-4, "settling": 0.4, "effort": 5.0,
              "noise": 1e-4, "bandwidth": 1.0, "modulus_margin": 0.1}  # fmt: skip
    spec = fx.Specification(**limits, start=0.05)
    found = spec.check(loop, run)
    assert found["bandwidth"] == bandwidth(loop)
    assert found["modulus margin"] == loop.modulus_margin
    assert found["noise"] == loop.rms("die:error")
    own = exposure_errors(run, ["die:error"], start=0.45)["die:error"]
    assert (found["MA"], found["MSD"]) == (own.ma, own.msd)
    assert found["rms"] == np.max(run.rms("die:error", start=0.05))
    assert found["peak"] == np.max(run.peak("die:error", start=0.05))
    assert found["effort u2"] == np.abs(run["u2"]).max()
    assert found["settling"] == settling_time(run, "die:error", ma=5e-5, msd=5e-5, after=0.05).max()
    assert len(found.names) == len(limits) + 2 and found["stable"] == 1.0
    # each limit alone, a little on either side of what is reached
    for name, row in (("ma", "MA"), ("bandwidth", "bandwidth"), ("noise", "noise")):
        least = name == "bandwidth"
        for factor, passes in ((0.9, least), (1.1, not least)):
            one = spec.replace(**{name: factor * found[row]})
            assert (row not in one.check(loop, run).failed) == passes
    tight = spec.replace(effort={"u1": 1e-9}).check(loop, run)
    assert not tight and tight.failed[-1] == "effort u1"
    lines = repr(tight).splitlines()
    assert lines[0].startswith("specification: FAILED (") and lines[-1].endswith("FAILED")
    assert "effort u1" in lines[-1] and "<= 1e-09" in lines[-1]


def test_an_unstable_loop_meets_nothing(run):
    with pytest.warns(fx.FlexplantWarning, match="unstable"):
        wrong = fx.close_loop(stage(), observer(), servo(sign=-1.0))
    found = fx.Specification(bandwidth=1.0, modulus_margin=0.1, noise=1.0).check(wrong)
    assert found.failed == ("stable", "bandwidth", "modulus margin", "noise")
    assert not found.passed


def test_what_is_no_specification(loop, run):
    with pytest.raises(ModelError, match="at least one limit"):
        fx.Specification()
    with pytest.raises(ModelError, match="give ma as well"):
        fx.Specification(settling=0.1)
    with pytest.raises(ModelError, match="msd must be positive"):
        fx.Specification(msd=-1.0)
    with pytest.raises(ModelError, match="limits on ma, effort need a run"):
        fx.Specification(ma=1.0, effort=1.0).check(loop)
    with pytest.raises(LabelError, match="driven actuator"):
        fx.Specification(effort={"u9": 1.0}).check(loop, run)
    with pytest.raises(ModelError, match="loop must be of type ClosedLoop"):
        fx.Specification(ma=1.0).check(run)


@pytest.mark.slow
def test_the_message_of_a_failed_test_is_the_table(tmp_path):
    """In a pytest of its own, as a user runs it."""
    test = tmp_path / "test_mine.py"
    test.write_text(
        textwrap.dedent(
            """
            import numpy as np
            from flexplant.simulation import Verdict

            def test_it():
                verdict = Verdict(["MA", "bandwidth"], ["m", "Hz"], np.array([2e-9, 80.0]),
                                  np.array([1e-9, 60.0]), [False, True])
                assert verdict.passed, str(verdict)
            """
        )
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(test)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 1
    assert "specification: FAILED (MA)" in done.stdout
    assert "MA 2 <= 1 nm FAILED" in " ".join(done.stdout.split())


@pytest.mark.slow
def test_the_only_error_is_meant_or_one_is_named():
    """Whatever the POI is called; without an error the channel must be named."""
    ports = fx.testbeds.three_masses().assembled.ports
    called = {"z": [fx.Poi("tip", at="2:x", axes=("x",))], "y": ports.y, "u": ports.u, "w": ports.w}
    for references in ([fx.Reference("tip")], []):
        own = fx.Ports(**called, references=references)
        plant = fx.testbeds.three_masses().with_ports(own)
        servo = {"noise": 1.0}
        loop = fx.close_loop(plant, fx.design_h2(plant.weighted(z={"u1:effort": 1e-6})))
        if references:
            found = fx.Specification(**servo).check(loop)
            assert found["noise"] == loop.rms("tip:error")
        else:
            with pytest.raises(LabelError, match=r"no error channel\. .* channel="):
                fx.Specification(**servo).check(loop)
            assert fx.Specification(**servo, channel="tip:x").check(loop)["noise"] > 0
