"""MA and MSD over exposures, settling and maps, against sums by hand."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.simulation import Response, error_map, exposure_errors, settling_time
from stages import sampled, some_modes


def made(data, names=("die:z", "die:rx", "die:error", "chuck:z"), dt=1e-3):
    data = np.asarray(data)
    units = {name: "rad" if name.endswith("rx") else "m" for name in names}
    return Response(np.arange(data.shape[-1]) * dt, data, names, units)


def by_hand(signal, begin, end, count):
    """All windows within [begin, end): the mean, and the deviation after it was removed."""
    parts = [signal[k : k + count] for k in range(begin, end - count + 1)]
    return np.abs([p.mean() for p in parts]), np.array([np.std(p - p.mean()) for p in parts])


def test_windows_lie_within_the_exposures_and_lose_their_mean_first():
    rng = np.random.default_rng(4)
    data = 1e-9 * rng.standard_normal((3, 4, 500)) + np.array([0.2, 1e-3, 5e-6, -0.1])[:, None]
    data[:, :, 250:] *= 1e3  # outside the exposures
    run = made(data)
    windows = np.array([[0.02, 0.11], [0.13, 0.2001]])
    found = exposure_errors(run, window=0.015, exposures=windows)
    # the first axis of die has a reference, chuck has none
    assert found.channels == ("chuck:z", "die:rx", "die:error")
    for name in found.channels:
        pairs = [by_hand(one, *edges, 15) for one in run[name] for edges in ((20, 110), (130, 200))]
        ma, msd = (np.concatenate([pair[j] for pair in pairs]) for j in (0, 1))
        wanted = (ma.max(), np.quantile(ma, 0.997), msd.max(), np.quantile(msd, 0.997))
        np.testing.assert_allclose(found[name], wanted, rtol=1e-8, atol=0.0)
    whole = exposure_errors(run, ["die:rx"], window=None, exposures=windows[:1])
    assert whole["die:rx"].ma == pytest.approx(np.abs(run["die:rx"][:, 20:110].mean(1)).max())
    assert whole["die:rx"].msd == pytest.approx(run["die:rx"][:, 20:110].std(1).max(), rel=1e-9)
    late = exposure_errors(run, ["die:error"], window=0.01, start=0.3)
    assert late["die:error"].ma == pytest.approx(
        max(by_hand(one, 300, 500, 10)[0].max() for one in run["die:error"]), rel=1e-9
    )
    text = repr(found)
    assert "MSD 99.7%" in text and f"{1e9 * found['die:rx'].ma:.4g}" in text and "nrad" in text


def test_settling_is_the_last_time_outside():
    t = np.arange(1000) * 1e-3
    run = made([1e-6 * np.exp(-t / 0.05)], ["die:error"])
    count, limit = 10, 1e-8
    took = settling_time(run, "die:error", ma=limit, window=0.01, after=0.1)
    means = np.array([run["die:error"][k : k + count].mean() for k in range(100, 991)])
    assert took == pytest.approx((means > limit).sum() * 1e-3, rel=1e-12)
    assert settling_time(run, "die:error", ma=1e-6, after=0.1) == 0.0
    assert settling_time(run, "die:error", ma=1e-16) == np.inf
    assert settling_time(run, "die:error", ma=1e-6, msd=1e-9, after=0.1) > 0.0
    two = made(np.array([[run["die:error"]], [2 * run["die:error"]]]), ["die:error"])
    first, second = settling_time(two, "die:error", ma=limit, window=0.01, after=0.1)
    assert first == took
    assert second == pytest.approx(first + 0.05 * np.log(2), abs=1e-3)


@pytest.mark.slow
def test_a_map_is_the_run_of_a_poi_at_each_point():
    plant = sampled(some_modes(count=8, attached=False))
    blocks = fx.design_static(plant), fx.design_servo(plant, bandwidth=25.0)
    loop = fx.close_loop(plant, *blocks)
    move = fx.setpoint(1e-5, velocity=5e-3, acceleration=0.5, jerk=100.0, exposure=0.02)
    points = [(x, y, 0.0) for x in (0.1, 0.3, 0.5) for y in (0.1, 0.3, 0.5)]
    options = {"reference": move, "duration": 0.06, "noise": False}
    found = error_map(loop, points, exposures=move.exposures, **options)
    for i in (0, 4, 7):
        moved = fx.simulate(fx.close_loop(plant.at(points[i]), *loop.blocks), **options)
        own = exposure_errors(moved, ["die:error"], exposures=move.exposures)["die:error"]
        assert found.ma[i] == pytest.approx(own.ma, rel=1e-9, abs=0)
        assert found.msd[i] == pytest.approx(own.msd, rel=1e-7, abs=0)
    assert found.msd[0] > 1.001 * found.msd[4]  # it bends: the corners follow last
    assert "9 points along z, windows of 5 ms" in repr(found)
    ax = fx.plot.error_map(found, what="msd")
    assert "MSD of the error along z" in ax.figure.axes[1].get_ylabel()
    with pytest.raises(ModelError, match="'ma', 'msd'"):
        fx.plot.error_map(found, what="rms")


def test_what_is_no_exposure():
    run = made(np.zeros((1, 100)), ["die:error"])
    with pytest.raises(ModelError, match=r"not within the run of 0\.1 s"):
        exposure_errors(run, exposures=[[0.05, 0.2]])
    with pytest.raises(ShapeError, match=r"shape \(k, 2\)"):
        exposure_errors(run, exposures=[0.0, 0.1])
    with pytest.raises(ModelError, match="the shortest exposure has 20"):
        exposure_errors(run, window=0.05, exposures=[[0.0, 0.02]])
    with pytest.raises(ModelError, match="has no error of a POI"):
        exposure_errors(made(np.zeros((1, 100)), ["y1"]))
    with pytest.raises(LabelError, match="no channel"):
        exposure_errors(run, ["die:errror"])
    with pytest.raises(ModelError, match=r"^after=1 s is too late"):
        settling_time(run, "die:error", ma=1.0, after=1.0)
    with pytest.raises(ModelError, match=r"^after has a NaN"):
        settling_time(run, "die:error", ma=1.0, after=np.nan)
