"""Figures of several loops side by side, against dense algebra on a grid of its own."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_loop as oracle
from flexplant import load
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.loop import close_loop, compare_loops
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from machines import RATE, observer, servo, stage


@pytest.fixture(scope="module")
def loops():
    held, weak = observer(), servo()
    return {
        "servo": close_loop(stage(), held, weak),
        "half": close_loop(stage(), held, weak.replace(C=0.5 * weak.C, D=0.5 * weak.D)),
    }


@pytest.fixture(scope="module")
def found(loops):
    return compare_loops(loops)


def dense(loop, freq):
    """Return |S| from reference to error by the closed loop's own matrices."""
    g = loop.monitored.select(["die:error"], ["die:ref"])
    z = np.exp(2j * np.pi * np.asarray(freq) / RATE)
    return np.array([abs(oracle.gain(g.A, g.B, g.C, g.D, point)[0, 0]) for point in z])


@pytest.mark.slow
def test_figures_are_those_of_a_dense_sweep(loops, found):
    for name, loop in loops.items():
        row = found[name]
        freq = np.geomspace(0.05, 0.4999 * RATE, 20_000)
        size = dense(loop, freq)
        first = freq[np.argmax(size >= 1.0)]
        assert row.stable
        assert row.decay == loop.spectral_radius
        assert row.bandwidth == pytest.approx(first, rel=2e-3)
        assert row.peak == pytest.approx(size.max(), rel=1e-4)
        assert row.peak >= size.max() * (1 - 1e-9)
        assert dense(loop, [row.peak_freq])[0] == pytest.approx(row.peak, rel=1e-8)
        assert dense(loop, [row.low_freq])[0] == pytest.approx(row.low, rel=1e-8)
        assert row.margin == loop.modulus_margin
    assert found["servo"].bandwidth > 1.2 * found["half"].bandwidth
    assert found["half"].low_freq == found["servo"].low_freq
    assert found["half"].low > 1.5 * found["servo"].low


def test_eigenvalues_and_eigenvectors_are_computed_once(monkeypatch):
    """For stability, margin, repr, response and comparison together: of the loop, of each block."""
    sizes = {"eigvals": [], "eig": []}
    for owner, (name, seen) in zip((la, np.linalg), sizes.items(), strict=True):
        plain = getattr(owner, name)

        def counted(A, *rest, plain=plain, seen=seen, **options):
            seen.append(len(A))
            return plain(A, *rest, **options)

        monkeypatch.setattr(owner, name, counted)
    one = observer()  # with a second state, for a matrix of one needs no eigenvectors
    grown = {"A": [[0.3, 0.1], [0.0, 0.2]], "B": np.vstack([one.B, one.B]), "C": [[1.0, 0.0]]}
    loop = close_loop(stage(), one.replace(**grown, states=()), servo())
    assert loop.is_stable
    assert loop.system.is_stable
    assert loop.spectral_radius < 1 < 1 / loop.modulus_margin
    assert "stable" in repr(loop)
    loop.frequency_response([1.0, 10.0])
    compare_loops({"servo": loop})
    assert sizes == {"eigvals": [loop.monitored.n_states], "eig": [2]}


def test_it_reads_as_a_table_and_survives_a_file(found, tmp_path):
    lines = repr(found).splitlines()
    assert lines[0].split("  ")[-1].strip() == "max |S| at u"
    assert lines[1].startswith("servo")
    assert lines[1].count(" Hz") == 2
    assert "die:ref to die:error" in lines[-2]
    assert lines[-1] == "not judged on a larger model"
    found.save(tmp_path / "figures.npz")
    assert repr(load(tmp_path / "figures.npz")) == repr(found)


def test_an_unstable_loop_has_no_figures(loops):
    law = servo()
    with pytest.warns(FlexplantWarning, match="unstable"):
        wrong = close_loop(stage(), observer(), law.replace(C=-law.C, D=-law.D))
    found = compare_loops({"right": loops["servo"], "wrong sign": wrong})
    row = found["wrong sign"]
    assert not row.stable
    assert row.decay > 1
    assert np.isnan([row.bandwidth, row.peak, row.low]).all()
    assert row.margin == 0.0
    assert "NO (1." in repr(found) and "stable (spectral radius)" in repr(found)


def test_loops_without_a_reference_show_the_margin_at_u():
    mass = StateSpace(
        [[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0], [1, 0], [0, 1]], np.zeros((3, 2)),
        inputs=["f", "u"], outputs=["z", "y", "v"],
    )  # fmt: skip
    plant = StandardPlant.from_statespace(mass, u=["u"], y=["y", "v"])
    law = StateSpace([], [], [], [[-100.0, -20.0]], inputs=["y", "v"], outputs=["u"])
    found = compare_loops({"pd": close_loop(plant, law)})
    assert found["pd"].decay == pytest.approx(-10.0)
    assert "stable (largest real part [rad/s])" in repr(found)
    sampled = plant.discretized(100.0)
    with pytest.raises(ModelError, match="some continuous"):
        compare_loops({"pd": close_loop(plant, law), "held": close_loop(sampled, law)})
    # |S_u| = |s^2 / (s + 10)^2| rises to 1, its value at infinite frequency
    assert found["pd"].margin == pytest.approx(1.0, rel=1e-3)
    assert np.isnan(found["pd"].bandwidth)
    assert "Hz" not in repr(found)


def test_other_channels_may_be_named(loops, found):
    same = compare_loops(loops, reference="die:ref", error="die:error")
    assert repr(same) == repr(found)


def test_wrong_use_is_refused(loops, found):
    with pytest.raises(ModelError, match="loops must be a mapping"):
        compare_loops(loops["servo"])
    with pytest.raises(ModelError, match="loops must be a mapping"):
        compare_loops({})
    with pytest.raises(ModelError, match="must be of type ClosedLoop"):
        compare_loops({"servo": servo()})
    with pytest.raises(LabelError, match="'servo' has no 'die:ref' in w or no 'die:rx'"):
        compare_loops(loops, reference="die:ref", error="die:rx")
    with pytest.raises(LabelError, match="no loop 'servos'"):
        found["servos"]


def test_loops_are_judged_on_their_evaluation_models(loops):
    """The rows are those of the loops around the evaluation plants; what lacks one is named."""
    plant = stage().replace(evaluation=stage(stiffer=1.02))
    judged = close_loop(plant, *loops["servo"].blocks)
    found = compare_loops({"judged": judged, "alone": loops["servo"]})
    row, other = found.rows["judged"], loops["servo"].around(stage(stiffer=1.02))
    assert row.margin == pytest.approx(other.modulus_margin, rel=1e-9, abs=0)
    assert row.margin != pytest.approx(found.rows["alone"].margin, rel=1e-3, abs=0)
    assert row.decay == pytest.approx(other.spectral_radius, rel=1e-9, abs=0)
    assert repr(found).splitlines()[-1] == "not judged on a larger model: alone"
