"""Measured responses coupled and uncoupled: models joined, and dense algebra, say the same."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
import oracles_joining as oracles
from flexplant.errors import FlexplantWarning, LabelError, ModelError

PLATE = {"thickness": 0.02, "density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
FREQ = np.array([60.0, 133.0, 290.0, 500.0])
SIZES = {"stage": ((0.4, 0.3), (3, 2)), "frame": ((0.6, 0.5), (4, 3))}
JOINTS = (
    fx.joining.Joint("stage/1:z", "frame/1:z"),
    fx.joining.Joint("stage/4:z", "frame/7:z", stiffness=2e5, rate=40.0),
    fx.joining.Joint("frame/20:z", stiffness=1e5, rate=10.0),
)
#: measured on each: at its joints and at one more place
CHANNELS = {"stage": ["1:z", "4:z", "9:z"], "frame": ["1:z", "7:z", "20:z", "12:z"]}


def models():
    law = fx.structure.Rayleigh(0.0, 1e-6)
    found = {}
    for name, (size, elements) in SIZES.items():
        found[name] = fx.kirchhoff_plate(size=size, elements=elements, **PLATE).with_damping(law)
    return found


def measured(name, quantity="displacement"):
    """The responses of a component alone, by dense algebra."""
    model, channels = models()[name], CHANNELS[name]
    out = np.array([model.row(label) for label in channels])
    none = np.zeros((0, model.n_dof))
    parts = [A.toarray() for A in (model.M, model.D, model.K)]
    data = [oracles.receptance(*parts, none, FREQ, out, load) for load in out]
    frf = fx.Frf(FREQ, np.transpose(data, (2, 0, 1)), channels, channels, "displacement")
    return exact(frf.converted(quantity))


def exact(frf):
    """Responses that are known to have no errors."""
    return frf.replace(variance=np.zeros(frf.data.shape))


def machine():
    """The responses of the joined machine in dense algebra, B and the springs by hand."""
    names = [f"{name}/{label}" for name, model in models().items() for label in model.dofs.labels]
    M, D, K = (
        la.block_diag(*(getattr(model, name).toarray() for model in models().values()))
        for name in "MDK"
    )
    rows = np.eye(len(names))
    row = {name: rows[i] for i, name in enumerate(names)}
    between, ground = row["stage/4:z"] - row["frame/7:z"], row["frame/20:z"]
    K += 2e5 * np.outer(between, between) + 1e5 * np.outer(ground, ground)
    D += 40.0 * np.outer(between, between) + 10.0 * np.outer(ground, ground)
    B = (row["stage/1:z"] - row["frame/1:z"])[None]
    channels = [f"{name}/{label}" for name, listed in CHANNELS.items() for label in listed]
    out = np.array([row[name] for name in channels])
    data = [oracles.receptance(M, D, K, B, FREQ, out, load) for load in out]
    return exact(fx.Frf(FREQ, np.transpose(data, (2, 0, 1)), channels, channels, "displacement"))


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_coupled_responses_are_those_of_the_machine(quantity):
    """With rigid joints, given twice too, springs and dampers between and to the ground."""
    frfs = {name: measured(name, quantity) for name in CHANNELS}
    found = fx.joined(frfs, [JOINTS[0], *JOINTS])
    reference = machine().converted(quantity)
    assert found.outputs == reference.outputs
    assert found.inputs == reference.inputs
    np.testing.assert_allclose(found.data, reference.data, rtol=1e-6)
    assert found.quantity == quantity


@pytest.mark.slow
def test_a_component_is_taken_out_again():
    whole, frame, stage = machine(), measured("frame"), measured("stage")
    rest = fx.joining.uncoupled(whole, {"frame": frame}, JOINTS[:2])
    assert rest.outputs == tuple(f"stage/{label}" for label in CHANNELS["stage"])
    # the frame's spring to the ground was not taken out with it
    held = fx.joined({"frame": frame}, JOINTS[2])
    held = held.replace(inputs=frame.inputs, outputs=frame.outputs)
    rest = fx.joining.uncoupled(whole, {"frame": held}, JOINTS[:2])
    np.testing.assert_allclose(rest.data, stage.data, rtol=1e-5)
    # a rigid joint may be measured on its other side
    kept = [name for name in whole.outputs if name != "frame/1:z"]
    rest = fx.joining.uncoupled(whole.select(kept, kept), {"frame": held}, JOINTS[:2])
    np.testing.assert_allclose(rest.data, stage.data, rtol=1e-5)


def perturbed(frf, factor):
    """The responses with one independent error after the other, each of unit variance."""
    for k in range(frf.data.shape[1]):
        for column in factor.T:
            error = np.zeros(frf.data.shape)
            error[:, k] = 1e-6 * np.abs(frf.data[:, k]) * column[:, None]
            yield frf.replace(data=frf.data + error)


def stated(frf, factor):
    """The responses with the variance, 1e-6 of their size, and correlation of these errors."""
    between = np.repeat((factor @ factor.T)[:, :, None], frf.freq.size, axis=2)
    return frf.replace(variance=(1e-6 * frf.mag) ** 2, correlation=between)


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.0, 0.8])
def test_variances_of_responses_give_that_of_the_machine(part):
    """Errors of outputs under one force are independent, or share a part."""
    parts = {name: measured(name) for name in CHANNELS}
    factor = {
        name: la.cholesky((1.0 - part) * np.eye(n) + part * np.ones((n, n)), lower=True)
        for name, n in (("stage", 3), ("frame", 4), ("", 7))
    }
    whole = fx.joined(parts, JOINTS)
    found = fx.joined({name: stated(frf, factor[name]) for name, frf in parts.items()}, JOINTS)
    wanted = sum(
        np.abs(fx.joined({**parts, name: frf}, JOINTS).data - whole.data) ** 2
        for name in parts
        for frf in perturbed(parts[name], factor[name])
    )
    np.testing.assert_allclose(found.variance, wanted, rtol=1e-4)
    held = fx.joined({"frame": parts["frame"]}, JOINTS[2])
    known = {"frame": held.replace(inputs=parts["frame"].inputs, outputs=parts["frame"].outputs)}
    found = fx.joining.uncoupled(stated(whole, factor[""]), known, JOINTS[:2])
    left = fx.joining.uncoupled(whole, known, JOINTS[:2])
    wanted = sum(
        np.abs(fx.joining.uncoupled(frf, known, JOINTS[:2]).data - left.data) ** 2
        for frf in perturbed(whole, factor[""])
    )
    np.testing.assert_allclose(found.variance, wanted, rtol=1e-3)


@pytest.mark.slow
def test_an_extended_interface_uses_all_channels_of_what_is_known():
    """Inner channels of the frame say what goes through its joints, also without pairs."""
    parts = {name: measured(name) for name in CHANNELS}
    whole = fx.joined(parts, JOINTS[:2])
    rest = fx.joining.uncoupled(whole, {"frame": parts["frame"]}, JOINTS[:2], extended=True)
    plain = fx.joining.uncoupled(whole, {"frame": parts["frame"]}, JOINTS[:2])
    np.testing.assert_allclose(rest.data, parts["stage"].data, rtol=1e-5)
    np.testing.assert_allclose(plain.data, parts["stage"].data, rtol=1e-5)
    uneven = whole.select(outputs=[name for name in whole.outputs if name != "frame/12:z"])
    rest = fx.joining.uncoupled(uneven, {"frame": parts["frame"]}, JOINTS[:2], extended=True)
    np.testing.assert_allclose(rest.data, parts["stage"].data, rtol=1e-5)
    # the variance is that of the errors, to first order, of least squares too
    factor = np.eye(len(whole.outputs))
    known = {"frame": parts["frame"]}
    found = fx.joining.uncoupled(stated(whole, factor), known, JOINTS[:2], extended=True)
    left = fx.joining.uncoupled(whole, known, JOINTS[:2], extended=True)
    wanted = sum(
        np.abs(fx.joining.uncoupled(frf, known, JOINTS[:2], extended=True).data - left.data) ** 2
        for frf in perturbed(whole, factor)
    )
    np.testing.assert_allclose(found.variance, wanted, rtol=1e-2)


def test_a_difference_below_its_errors_is_warned_of():
    """A stage of 1 kg on a frame of 1000: its response is lost in 1 % of the others'."""
    free = lambda m: -1 / (m * (2 * np.pi * FREQ) ** 2)[None, None]  # noqa: E731
    machine = fx.Frf(FREQ, free(1001.0), ["stage/1:x"], ["stage/1:x"])
    frame, joint = (
        fx.Frf(FREQ, free(1000.0), ["1:x"], ["1:x"]),
        fx.joining.Joint("stage/1:x", "frame/1:x"),
    )
    with pytest.warns(
        FlexplantWarning, match="of 1 % in each response exceed the result at 4 of 4"
    ):
        found = fx.joining.uncoupled(machine, {"frame": frame}, joint)
    assert found.variance is None
    for part in (0.01, 1e-6):
        known = frame.replace(variance=(part * frame.mag) ** 2)
        if part == 0.01:
            with pytest.warns(FlexplantWarning, match="by their variances exceed the result"):
                found = fx.joining.uncoupled(machine, {"frame": known}, joint)
        else:
            found = fx.joining.uncoupled(machine, {"frame": known}, joint)
        # 1 / G = 1 / G_machine - 1 / G_frame
        wanted = np.abs(found.data / frame.data) ** 4 * known.variance
        np.testing.assert_allclose(found.variance, wanted, rtol=1e-6)


def placed_parts():
    """A stage above a frame, their DOFs where they stand."""
    found = models()
    stage = found["stage"].dofs
    raised = stage.replace(xyz=stage.xyz + np.array([0.05, 0.08, 0.1]), interpolation=None)
    return found, {"stage": raised, "frame": found["frame"].dofs}


def response_of(model, outputs, inputs):
    """Receptances between named DOFs, by dense algebra; inputs are named as test software does."""
    parts, none = [A.toarray() for A in (model.M, model.D, model.K)], np.zeros((0, model.n_dof))
    out, into = (np.array([model.row(x) for x in names]) for names in (outputs, inputs))
    data = np.array([oracles.receptance(*parts, none, FREQ, out, load) for load in into])
    names = [f"u {name}" for name in inputs]
    return exact(fx.Frf(FREQ, np.transpose(data, (2, 0, 1)), names, outputs, "displacement"))


def mean_rows(nodes, dofs, point):
    """z, rx and ry at a point that fit the z of some nodes best."""
    x, y, _ = (dofs.xyz[[dofs.index(f"{n}:z") for n in nodes]] - point).T
    return np.linalg.pinv(np.column_stack([np.ones(x.size), y, -x]))


@pytest.mark.filterwarnings("ignore:.* bends")
@pytest.mark.parametrize("pushed", [(6, 7, 10, 11), (5, 7, 11, 9)])
def test_patches_and_lever_arms_of_responses(pushed):
    """Mean motions of sensors, forces at other places, and a node with an arm, by hand."""
    parts, dofs = placed_parts()
    sensed = {"stage": (1, 2, 4, 5), "frame": (6, 7, 10, 11)}
    forced = {"stage": (1, 2, 4, 5), "frame": pushed}
    more = {"stage": ["12:z", "12:rx", "12:ry"], "frame": ["20:z", "20:rx", "20:ry"]}
    frfs = {
        name: response_of(
            model,
            [*(f"{n}:z" for n in sensed[name]), *more[name]],
            [*(f"{n}:z" for n in forced[name]), *more[name]],
        )
        for name, model in parts.items()
    }
    points = np.array([0.2, 0.2, 0.05]), np.array([0.4, 0.3, 0.05])
    nodes = {name: sorted({*sensed[name], *forced[name]}) for name in parts}
    joints = [
        fx.joining.Joint(*(fx.joining.Patch(name, nodes[name]) for name in parts), point=points[0]),
        fx.joining.Joint(
            "stage/12", "frame/20", axes=["z"], stiffness=3e5, rate=8.0, point=points[1]
        ),
    ]
    with pytest.warns(FlexplantWarning, match=r"<Patch of frame, \d nodes> bends: \d\d %"):
        found = fx.joined(frfs, joints, dofs=dofs)
    if pushed == sensed["frame"]:  # models joined say the same
        machine = fx.joined(parts, joints, placed={"stage": fx.joining.Pose((0.05, 0.08, 0.1))})
        direct = response_of(machine, found.outputs, ["stage/1:z", "frame/20:rx"])
        some = found.select(inputs=["stage/u 1:z", "frame/u 20:rx"])
        np.testing.assert_allclose(some.data, direct.data, rtol=1e-6)
    B_out, B_in = (np.zeros((4, 14)) for _ in range(2))
    for i, (name, sign) in enumerate((("stage", 1.0), ("frame", -1.0))):
        for B, some in ((B_out, sensed), (B_in, forced)):
            B[:3, 7 * i : 7 * i + 4] = sign * mean_rows(some[name], dofs[name], points[0])
            at = more[name][0]
            arm = points[1] - dofs[name].xyz[dofs[name].index(at)]
            B[3, 7 * i + 4 : 7 * i + 7] = sign * np.array([1.0, arm[1], -arm[0]])
    for k, f in enumerate(FREQ):
        Y = la.block_diag(*(frf.data[:, :, k] for frf in frfs.values()))
        Z = np.diag([0, 0, 0, 1 / (3e5 + 2j * np.pi * f * 8.0)])
        wanted = Y - Y @ B_in.T @ la.solve(B_out @ Y @ B_in.T + Z, B_out @ Y)
        np.testing.assert_allclose(
            found.data[:, :, k], wanted, rtol=1e-6, atol=1e-12 * abs(Y).max()
        )
    # the stage comes back when the frame is taken out, its channels named as in the machine
    rest = fx.joining.uncoupled(found, {"frame": frfs["frame"]}, joints[:1], dofs=dofs)
    alone = fx.joining.uncoupled(
        fx.joined(frfs, joints[:1], dofs=dofs), {"frame": frfs["frame"]}, joints[:1], dofs=dofs
    )
    assert rest.inputs == tuple(f"stage/{name}" for name in frfs["stage"].inputs)
    np.testing.assert_allclose(alone.data, frfs["stage"].data, rtol=1e-5)


@pytest.mark.slow
def test_what_responses_cannot_say_is_refused():
    frfs = {name: measured(name) for name in CHANNELS}
    with pytest.raises(LabelError, match="named alike"):
        fx.joined(frfs, fx.joining.Joint("stage/2:z", "frame/1:z"))
    with pytest.raises(LabelError, match="no component 'base'"):
        fx.joined(frfs, fx.joining.Joint("base/2:z", "frame/1:z"))
    with pytest.raises(ModelError, match="between points, but no channel measures"):
        fx.joined(frfs, fx.joining.Joint(("stage", (0, 0, 0)), "frame/1:z"))
    patch = fx.joining.Joint(fx.joining.Patch("stage", [1, 4, 9]), "frame/1:z", axes=["z"])
    with pytest.raises(LabelError, match=r"has nodes \[2\] that are not measured"):
        fx.joined(
            frfs,
            fx.joining.Joint(fx.joining.Patch("stage", [1, 2, 9]), "frame/1:z", axes=["z"]),
            dofs={"stage": models()["stage"].dofs},
        )
    with pytest.raises(ModelError, match=r"needs the places of the channels of 'stage'.*dofs="):
        fx.joined(frfs, patch)
    with pytest.raises(LabelError, match="no coordinates for nodes"):
        fx.joined(frfs, patch, dofs={"stage": fx.chain(masses=[1, 1], stiffnesses=[1]).dofs})
    with pytest.raises(LabelError, match="dofs has places of 'base'"):
        fx.joined(frfs, patch, dofs={"base": models()["frame"].dofs})
    with pytest.raises(ModelError, match="models have their DOFs"):
        fx.joined(models(), JOINTS, dofs={"stage": models()["stage"].dofs})
    with pytest.raises(ModelError, match="are the same channel"):
        fx.joined(frfs, fx.joining.Joint("stage/1:z", "stage/1:z"))
    with pytest.raises(LabelError, match="has no axis 'x': it moves along z"):
        fx.joined(frfs, fx.joining.Joint("stage/1:z", "frame/1:z", axes=["x"]))
    with pytest.raises(ModelError, match="do not apply to measured"):
        fx.joined(frfs, JOINTS, name="machine")
    with pytest.raises(ModelError, match="responses by component"):
        fx.joining.uncoupled(machine(), frfs["frame"], JOINTS)
    with pytest.raises(ModelError, match="frequencies of 'frame' are not those"):
        fx.joined(frfs | {"frame": frfs["frame"].replace(freq=FREQ + 1)}, JOINTS)
    with pytest.raises(ModelError, match="Convert them"):
        fx.joined(frfs | {"frame": frfs["frame"].converted("velocity")}, JOINTS)
    with pytest.raises(ModelError, match="state it"):
        fx.joined({name: frf.replace(quantity=None) for name, frf in frfs.items()}, JOINTS)
    with pytest.raises(ModelError, match="an Frf each"):
        fx.joined(frfs | {"frame": models()["frame"]}, JOINTS)
    with pytest.raises(LabelError, match="no joint connects"):
        fx.joining.uncoupled(machine(), {"frame": frfs["frame"]}, ())
    double = frfs["stage"].replace(data=np.ones_like(frfs["stage"].data))
    both = [fx.joining.Joint(f"stage/{n}:z", f"frame/{n}:z") for n in (1, 4)]
    with pytest.raises(ModelError, match="the interface has the condition"):
        fx.joined({"stage": double, "frame": double}, both)
    nearly = double.replace(data=double.data + 1e-10 * np.eye(3)[:, :, None])
    with pytest.warns(FlexplantWarning, match="the interface has the condition"):
        fx.joined({"stage": nearly, "frame": double}, both)
