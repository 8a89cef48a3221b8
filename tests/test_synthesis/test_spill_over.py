"""Designs on truncated plants, checked with the truncated modes: oracle by dense matrices."""

import re
import warnings
from functools import cache

import numpy as np
import pytest

from flexplant import DofSet, load
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.estimation import design_static
from flexplant.loop import SpillOver, close_loop
from flexplant.loop.other_machines import growing_modes, modes_in_words
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    Sensor,
    assemble_plant,
    reference_errors,
    stage_weights,
)
from flexplant.reduction import DesiredDofs, reduce
from flexplant.structure import FEModel, ModalDamping
from flexplant.synthesis import Lmi, Riccati, design_hinf, design_servo
from flexplant.synthesis.controller import checked_loop
from oracles_ports import chain
from oracles_synthesis import closed_loop, split, stability
from plates import make_plate
from stages import L, ports, sampled

#: weights that ask for S alone
OLD = (("disturbance", 0.3), ("effort", 0.3), ("noise", 0.005))


@cache
def many(count=60):
    """The plate without a secret: 60 modes at 0.1 % damping."""
    return solve_modes(make_plate(), count=count, damping=ModalDamping(0.001))


@cache
def small(count=24):
    """24 of these modes in physical DOFs."""
    spots = [(x, y, 0.0) for y in np.linspace(0, L, 5) for x in np.linspace(0, L, 5)]
    labels = [many().dofs.nearest(p, "z") for p in spots if p[:2] != (L / 2, L / 2)]
    return reduce(many(count), DesiredDofs(labels[:count]))


def weighted(plant, bandwidth, **knobs):
    errors, weights = reference_errors(plant), stage_weights(plant, bandwidth, **knobs)
    return errors, plant.through(errors).weighted(z=weights.z, w=weights.w)


@cache
def design(bandwidth=110.0, knobs=OLD, whole=True):
    errors, problem = weighted(sampled(small()), bandwidth, **dict(knobs))
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = design_hinf(problem.replace(evaluation=many()) if whole else problem)
    return errors, problem, found, [str(w.message) for w in seen]


def dense(plant, errors, K, kept=None):
    """The plant's loop by dense matrices; modes of `kept` only are reached by u."""
    g = plant.system
    B, C, D = g.B.copy(), g.C, g.D
    if kept is not None:
        for i, name in enumerate(g.states):
            number = name.partition(":")[0]
            if number.startswith("mode") and int(number[4:]) not in kept:
                B[i] = 0.0
        # the delayed u act on the modes through A: silence those rows too
        A = g.A.copy()
        delays = [i for i, name in enumerate(g.states) if "delay" in name]
        silent = [i for i in range(g.n_states) if i not in delays and not np.any(B[i])
                  and int(g.states[i].partition(":")[0][4:]) not in kept]  # fmt: skip
        A[np.ix_(silent, delays)] = 0.0
    else:
        A = g.A
    rows = [*range(len(plant.z)), *(len(plant.z) + plant.y.index(n) for n in errors.inputs)]
    nz = len(plant.z)
    mix = np.zeros((nz + len(errors.outputs), len(rows)))
    mix[:nz, :nz], mix[nz:, nz:] = np.eye(nz), errors.D
    P = split(A, B, mix @ C[rows], mix @ D[rows], len(errors.outputs), len(plant.u))
    return closed_loop(P, K.A, K.B, K.C, K.D)


@pytest.mark.slow
def test_a_design_on_24_modes_that_the_others_make_unstable_is_warned_of():
    errors, _, found, messages = design()
    assert found.certificate["spectral radius"] < 1
    radius = found.certificate["spectral radius with truncated modes"]
    assert radius > 1.0015
    assert found.certificate["modulus margin with truncated modes"] == 0.0
    whole = sampled(many())
    # oracle: stability() is the radius' logarithm or the like: only its sign counts
    loop = dense(whole, errors, found.system)
    assert np.abs(np.linalg.eigvals(loop[0])).max() == pytest.approx(radius, abs=1e-9)
    # one mode of a repeated pair or both, as the eigenvalue solver turns them
    assert len(messages) == 1 and re.search(rf"modes? {found.left_out.modes[0]}\b", messages[0])
    assert "unstable" in repr(found) and "truncated modes" in repr(found)


@pytest.mark.slow
def test_the_named_modes_are_the_cause():
    """Without them, and with all others, the loop is stable."""
    errors, _, found, _ = design()
    whole, named = sampled(many()), found.left_out.modes
    assert named and min(named) > 24
    rest = set(range(1, 61)) - set(named)
    assert stability(dense(whole, errors, found.system, rest)[0], whole.dt) < 0
    only = set(range(1, 25)) | set(named)
    assert stability(dense(whole, errors, found.system, only)[0], whole.dt) > 0
    for number, freq in zip(named, found.left_out.freq, strict=True):
        assert freq == pytest.approx(many().freq[number - 1], rel=0.02)


def test_a_pole_that_modes_share_is_given_once():
    said = modes_in_words((1, 2, 5, 7), (63.456, 63.456, 63.456, 80.0))
    assert said == "modes 1, 2, 5 (at 63.46 Hz), mode 7 (at 80 Hz)"
    assert modes_in_words((), ()) == "no mode named"


@pytest.mark.slow
def test_the_default_weights_are_stable_with_the_modes_left_out():
    errors, _, found, messages = design(80.0, ())
    assert not messages and found.left_out.is_stable and not found.left_out.modes
    whole = sampled(many())
    loop = dense(whole, errors, found.system)
    radius = np.abs(np.linalg.eigvals(loop[0])).max()
    assert found.certificate["spectral radius with truncated modes"] == pytest.approx(radius)
    margin = found.certificate["modulus margin with truncated modes"]
    assert 0.4 < margin < found.left_out.states
    g, K = whole.system, found.system
    peaks = []
    for freq in np.unique(np.append(np.geomspace(5, 4900, 800), many().freq[3:24])):
        z = np.exp(2j * np.pi * freq * whole.dt)
        P = g.C[-5:-1] @ np.linalg.solve(z * np.eye(g.n_states) - g.A, g.B[:, -4:])
        back = K.C @ np.linalg.solve(z * np.eye(K.n_states) - K.A, K.B) + K.D
        peaks.append(np.linalg.norm(np.linalg.inv(np.eye(4) + back @ P), 2))
    assert 1 / max(peaks) == pytest.approx(margin, rel=0.02)


@pytest.mark.slow
def test_one_flipped_sign_fails_the_check():
    _, problem, found, _ = design(80.0, ())
    K = found.system
    for side in ("u", "y"):
        signs = np.array([1.0, 1, -1, 1])
        wrong = (
            K.replace(C=signs[:, None] * K.C, D=signs[:, None] * K.D)
            if side == "u"
            else K.replace(B=K.B * signs, D=K.D * signs)
        )
        with pytest.warns(FlexplantWarning, match=r"unstable .*spectral radius 1\.\d+: modes? \d"):
            checked = checked_loop(problem.replace(evaluation=many()), [wrong]).left_out
        assert not checked.is_stable and checked.modulus_margin == 0.0


@pytest.mark.slow
def test_the_reduced_model_knows_its_modes_by_itself():
    """`solve_modes` found 60 modes, the reduction kept 21: nothing need be given."""
    spots = [(x, y, 0.0) for y in np.linspace(0, L, 5) for x in np.linspace(0, L, 5)]
    labels = [many().dofs.nearest(p, "z") for p in spots if p[:2] != (L / 2, L / 2)]
    model = reduce(many(), DesiredDofs(labels))
    assert model.truncated is not None
    errors, problem = weighted(sampled(model), 80.0)
    found = design_hinf(problem)
    assert found.left_out is not None
    assert found.left_out.states == sampled(model).evaluation_plant.system.n_states
    other = design_hinf(problem.replace(evaluation=many()))
    assert other.left_out.modulus_margin == pytest.approx(found.left_out.modulus_margin, rel=1e-6)
    loop = close_loop(sampled(model), errors, found)
    assert loop.left_out.modulus_margin == pytest.approx(found.left_out.modulus_margin, rel=1e-9)
    assert "with the truncated modes: stable" in repr(loop)


@pytest.mark.slow
def test_where_none_are_known_the_answer_says_so():
    errors, problem, _, _ = design()
    found = design_hinf(problem)
    assert found.left_out is None
    assert "not judged on a larger model" in repr(found)
    assert not [key for key in found.certificate if "left out" in key]
    loop = close_loop(sampled(small()), errors, found)
    assert loop.left_out is None


@pytest.mark.slow
def test_a_closed_loop_carries_the_check(tmp_path):
    errors, _, found, _ = design()
    plant = sampled(small())
    with pytest.warns(FlexplantWarning, match=r"stable on its plant, .* unstable .*modes? \d+"):
        loop = close_loop(plant.replace(evaluation=many()), errors, found)
    assert loop.is_stable and not loop.left_out.is_stable
    assert loop.left_out.modes == found.left_out.modes
    assert isinstance(loop.left_out, SpillOver) and "unstable" in repr(loop)
    found.save(tmp_path / "k.npz")
    back = load(tmp_path / "k.npz")
    assert back.left_out.modes == found.left_out.modes and back.notes == found.notes


@cache
def row_of_masses():
    """Five masses in a row, pushed at one end and seen at the other; sampled as a rigid body."""
    M, D, K = chain()
    row = DofSet(range(1, 6), ["x"] * 5, [(0.1 * i, 0.0, 0.0) for i in range(5)])
    body = FEModel(M, K, D, dofs=row)
    channels = Ports(
        w=[Disturbance("push", at="1:x")],
        u=[Actuator("u1", at="1:x")],
        z=[Poi("die", at="5:x", axes=("x",))],
        y=[Sensor("y1", at="5:x", asd=1e-9)],
    )
    stiff = assemble_plant(solve_modes(body, count=1), channels).discretized(5e3, delay=1)
    return body, stiff, assemble_plant(body, channels).discretized(5e3, delay=1)


def by_lmi(method, bandwidth):
    body, stiff, _ = row_of_masses()
    push = body.M.sum() * (2 * np.pi * bandwidth) ** 2
    problem = stiff.weighted(z={"die:x": push}, w={"y1:noise": 0.1 / push, "push": 1.0})
    return design_hinf(problem.replace(evaluation=body), method)


def by_servo(bandwidth):
    body, stiff, _ = row_of_masses()
    observer = design_static(stiff.replace(evaluation=body))
    return observer, design_servo(
        stiff.replace(evaluation=body), bandwidth=bandwidth, observer=observer, notches=()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "peak"),
    [
        (lambda: [by_lmi(Lmi(), 5.0)], "low"),
        (lambda: [by_lmi(Lmi(), 11.0)], "high"),
        (lambda: [by_lmi(Lmi(), 100.0)], "unstable"),
        (lambda: [by_lmi(Riccati(), 11.0)], "high"),
        (lambda: by_servo(10.0), "low"),
        (lambda: by_servo(32.0), "high"),
        (lambda: by_servo(50.0), "unstable"),
    ],
)
def test_every_design_is_warned_of_modes_left_out_that_bring_the_peak_above_8_db(make, peak):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        *before, found = make()
    _, _, whole = row_of_masses()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        loop = close_loop(whole, *before, found)
    radius = np.abs(np.linalg.eigvals(loop.system.A)).max()
    assert found.left_out.spectral_radius == pytest.approx(radius, abs=1e-9)
    assert (radius < 1) == (peak != "unstable") and found.left_out.is_high == (peak == "high")
    assert bool(seen) == (peak != "low") == bool({2, 3} & set(found.left_out.modes))
    if peak == "unstable":
        return
    g, K = whole.system.select(["y1"], ["u1"]), loop.controller.select(["u1"], ["y1"])
    fine = [np.linspace(120.0, 180.0, 2000), np.linspace(318.0, 328.0, 2000)]
    freq = np.unique(np.concatenate([np.geomspace(1.0, 2400.0, 1000), *fine]))
    gain = [
        ((one.C @ np.linalg.solve(z * np.eye(one.n_states) - one.A, one.B)) + one.D)[0, 0]
        for z in np.exp(2j * np.pi * freq * whole.dt)
        for one in (g, K)
    ]
    size = np.abs(1.0 / (1.0 - np.multiply(*np.reshape(gain, (-1, 2)).T)))
    assert 1.0 / found.left_out.modulus_margin == pytest.approx(size.max(), rel=0.01)
    assert (size.max() > 2.5) == (peak == "high")
    if peak == "high":
        assert found.left_out.peak_freq == pytest.approx(freq[np.argmax(size)], rel=1e-3)
        said, own = str(seen[0].message), solve_modes(row_of_masses()[0]).freq
        number = 1 + int(np.argmin(np.abs(own - found.left_out.peak_freq)))
        assert f"dB without them: mode {number} (" in said


@pytest.mark.slow
def test_a_continuous_design_is_checked_in_continuous_time():
    plant = assemble_plant(small(), ports())
    _, problem = weighted(plant, 50.0)
    found = design_hinf(problem.replace(evaluation=many()))
    assert found.left_out.stability < 0
    assert "largest real part with truncated modes" in found.certificate
    with pytest.raises(ModelError, match="sampled loops"):
        _ = found.left_out.spectral_radius


@pytest.mark.slow
def test_what_does_not_go_with_the_plant_is_refused():
    _, problem, found, _ = design()
    with pytest.raises(LabelError, match="other channels"):
        design_hinf(problem.replace(evaluation=sampled(many(), ports(references=[]))))
    # a loop around weights is judged with the same weights around the evaluation plant
    with pytest.warns(FlexplantWarning, match="with the truncated modes it is unstable"):
        loop = close_loop(problem.replace(evaluation=many()), found)
    assert loop.left_out.stability == pytest.approx(found.left_out.stability, rel=1e-9, abs=0)


@pytest.mark.slow
def test_modes_are_told_from_the_controllers_states():
    """Participation does not depend on units; states of other names take no part."""
    errors, _, found, _ = design()
    with pytest.warns(FlexplantWarning, match="unstable"):
        loop = close_loop(sampled(many()), errors, found)
    system, names = loop.monitored, loop.plant.system.states
    first = growing_modes(system, names)
    scale = 10.0 ** np.random.default_rng(3).integers(-6, 6, system.n_states)
    turned = system.replace(A=system.A * scale / scale[:, None], B=system.B / scale[:, None],
                            C=system.C * scale, blocks=None)  # fmt: skip
    assert growing_modes(turned, names)[0] == first[0]
    assert growing_modes(system, ["x"] * len(names)) == ((), ())


def test_four_modes_are_named_and_the_others_counted():
    found = SpillOver(1.01, True, 0.0, 0.5, np.nan, 120, tuple(range(31, 48)), (2000.0,) * 17)
    assert "modes 31, 32, 33, 34 (at 2000 Hz) and 13 more" in repr(found)
    assert "35" not in repr(found)
