"""Components joined: the machine in one piece, dense algebra and physics are the references."""

import re
import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
import oracles_joining as oracles
from flexplant.errors import CertificateError, FlexplantWarning, LabelError, ModelError
from flexplant.joining import join as join_module
from flexplant.joining.component import components_of

PLATE = {"density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
SOLID = {"density": 2700, "youngs_modulus": 70e9, "poisson_ratio": 0.3}
KINDS = ("z", "rx", "ry")
RIGHT = {"right": fx.joining.Pose(shift=(0.3, 0, 0))}


def plate(nx, lx=0.6, ny=4):
    return fx.kirchhoff_plate(size=(lx, 0.6), thickness=0.0272, elements=(nx, ny), **PLATE)


def edge(model, x):
    found = model.dofs.where(box=[(x, -9, -9), (x, 9, 9)]).nodes
    return list(dict.fromkeys(found.tolist()))


def seam(half, names=("left", "right")):
    pairs = zip(edge(half, 0.3), edge(half, 0.0), strict=True)
    return [fx.joining.Joint(f"{names[0]}/{i}", f"{names[1]}/{j}") for i, j in pairs]


def halves():
    half = plate(2, 0.3)
    return fx.joined({"left": half, "right": half}, seam(half), placed=RIGHT)


def elastic(model, count):
    modes = fx.solve_modes(model, count=count)
    return modes.freq[modes.n_rigid :]


def stage_on_frame():
    stage = fx.solid_block(size=(0.3, 0.2, 0.05), elements=(3, 2, 1), **SOLID)
    frame = fx.solid_block(size=(0.6, 0.4, 0.1), elements=(4, 2, 1), **SOLID)
    models = {"stage": stage, "frame": frame}
    return models, {"stage": fx.joining.Pose(shift=(0.1, 0.1, 0.1))}


#: three feet below the stage
FEET = [(0.2, 0.2, 0.1), (0.4, 0.2, 0.1), (0.3, 0.3, 0.1)]


def at_feet(axes, **kind):
    return [fx.joining.Joint(("stage", p), ("frame", p), axes=axes, **kind) for p in FEET]


def test_two_halves_are_one_plate():
    """To 1e-10, with places, labels of what was eliminated, plants and files as one model has."""
    whole, machine = plate(4), halves()
    assert machine.n_dof == whole.n_dof
    assert sp.issparse(machine.K)
    np.testing.assert_allclose(elastic(machine, 15), elastic(whole, 15), rtol=1e-10)
    assert machine.mass == pytest.approx(whole.mass, rel=1e-12)
    found = machine.joining
    assert (found.n_rigid, found.rank, found.constraints) == (3, 15, 15)
    assert dict(found.rigid) == {"left": 3, "right": 3}
    assert dict(found.pieces) == {"left, right": 3}
    assert max(found.gap, found.balance, found.inertia_error, found.rigid_force) < 1e-13
    # the second end follows the first, and stays known as a place
    assert "left/3:z" in machine.dofs
    assert "right/1:z" not in machine.dofs
    np.testing.assert_array_equal(machine.row("right/1:z"), machine.row("left/3:z"))
    np.testing.assert_array_equal(machine.dofs.location("right/1:z"), [0.3, 0, 0])
    with pytest.raises(LabelError, match=r"no DOF at nodes \[1\]"):
        machine.dofs.where(nodes=1, component="right")
    with pytest.raises(LabelError, match="follows other DOFs"):
        machine.dofs.index("right/1:z")
    assert machine.dofs.nearest((0.6, 0.6, 0), "z") == "right/15:z"
    assert machine.dofs.nearest((0.6, 0.6, 0), "z", component="left") == "left/15:z"
    assert set(machine.dofs.where(component="right").components) == {"left", "right"}
    assert fx.check(machine).ok
    ports = fx.Ports(
        u=[fx.Actuator("u", at=(0.3, 0.25, 0.0))],
        y=[fx.Sensor("a", at=(0.45, 0.2, 0.0)), fx.Sensor("b", at=(0.1, 0.6, 0.0))],
    )
    freq = np.array([120.0, 245.0, 600.0])
    both = [
        fx.frequency_response(fx.assemble_plant(fx.solve_modes(m, count=20), ports).Gyu, freq).data
        for m in (machine, whole)
    ]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-8)


def test_a_machine_goes_through_a_file_and_is_held(tmp_path):
    machine, whole = halves(), plate(4)
    machine.save(tmp_path / "machine.npz")
    loaded = fx.load(tmp_path / "machine.npz")
    assert loaded.dofs.labels == machine.dofs.labels
    assert repr(loaded.joining) == repr(machine.joining)
    np.testing.assert_array_equal(loaded.row((0.5, 0.1, 0.0)), machine.row((0.5, 0.1, 0.0)))
    held = loaded.fixed(loaded.dofs.where(box=[(0, -1, -1), (0, 1, 1)]).labels)
    same = whole.fixed(whole.dofs.where(box=[(0, -1, -1), (0, 1, 1)]).labels)
    np.testing.assert_allclose(elastic(held, 8), elastic(same, 8), rtol=1e-10)
    np.testing.assert_array_equal(held.row("right/1:z"), held.row("left/3:z"))
    assert machine.joining.n_rigid == 3
    for changed in (held, machine.with_parts(fx.PointMass("left/1:z", 1.0))):
        assert changed.joining is None  # held, it has no rigid-body motion; heavier, another mass
    assert machine.with_damping(fx.structure.Rayleigh(0.0, 1e-6)).joining is machine.joining
    # held before they are joined: the same, with the inertia of the held DOFs
    left = plate(2, 0.3).fixed([f"{i}:{a}" for i in edge(plate(2, 0.3), 0.0) for a in KINDS])
    models = {"left": left, "right": plate(2, 0.3)}
    first = fx.joined(models, seam(models["right"]), placed=RIGHT)
    np.testing.assert_allclose(elastic(first, 8), elastic(same, 8), rtol=1e-10)
    np.testing.assert_allclose(first.held_inertia, held.held_inertia, atol=1e-15)
    boundary = [f"{i}:{axis}" for i in edge(models["right"], 0.3) for axis in KINDS]
    rom = fx.reduce(left, fx.reduction.CraigBampton(boundary, 8))
    mixed = fx.joined({"left": rom, "right": models["right"]}, seam(models["right"]), placed=RIGHT)
    assert mixed.joining.n_rigid == 0
    np.testing.assert_allclose(mixed.modes().freq[:4], elastic(same, 4), rtol=1e-3)
    with pytest.raises(LabelError, match=r"no DOF 'frame/1:z'.*Close matches"):
        machine.row("frame/1:z")


def test_a_turned_component():
    """A quarter turn about z exchanges rx and ry, about y it makes a plate stand upright."""
    whole, half = plate(4), plate(2, 0.3)
    lying = fx.kirchhoff_plate(size=(0.6, 0.3), thickness=0.0272, elements=(4, 2), **PLATE)
    pose = fx.joining.Pose(shift=(0.6, 0.0, 0.0), rotation=(0, 0, np.pi / 2))
    other = components_of({"b": lying}, {"b": pose})[0].dofs
    joints = []
    for node in edge(half, 0.3):
        place = half.dofs.xyz[half.dofs.index(f"{node}:z")]
        joints.append(fx.joining.Joint(f"a/{node}", "b/" + other.nearest(place).partition(":")[0]))
    machine = fx.joined({"a": half, "b": lying}, joints, placed={"b": pose})
    np.testing.assert_allclose(elastic(machine, 15), elastic(whole, 15), rtol=1e-10)
    turn = machine.row((0.5, 0.2, 0.0), "rx") @ machine.rigid_motions()
    np.testing.assert_allclose(turn, np.eye(6)[3], atol=1e-14)
    upright = fx.joined(
        {"wall": half}, placed={"wall": fx.joining.Pose(rotation=(0, np.pi / 2, 0))}
    )
    assert set(upright.dofs.directions) == {"x", "ry", "rz"}
    assert upright.rigid_body.shape[1] == 3
    with pytest.raises(ModelError, match="oblique"):
        fx.joined({"wall": half}, placed={"wall": fx.joining.Pose(rotation=(0.5, 0, 0))})
    with pytest.raises(ModelError, match="mirror"):
        fx.joining.Pose(rotation=np.diag([1.0, 1.0, -1.0]))


def test_solids_at_any_angle():
    """A block cut in two and the machine turned by odd angles: the block's frequencies."""
    turn = (0.4, -0.7, 1.1)
    R = fx.joining.Pose(rotation=turn).rotation
    whole = fx.solid_block(size=(0.4, 0.2, 0.1), elements=(4, 2, 1), **SOLID)
    half = fx.solid_block(size=(0.2, 0.2, 0.1), elements=(2, 2, 1), **SOLID)
    placed = {
        "left": fx.joining.Pose((0.1, 0, 0), turn),
        "right": fx.joining.Pose([0.1, 0, 0] + 0.2 * R[:, 0], R),
    }
    pairs = zip(edge(half, 0.2), edge(half, 0.0), strict=True)
    joints = [fx.joining.Joint(f"left/{i}", f"right/{j}") for i, j in pairs]
    machine = fx.joined({"left": half, "right": half}, joints, placed=placed)
    assert machine.n_dof == whole.n_dof
    assert machine.rigid_body.shape[1] == 6
    np.testing.assert_allclose(elastic(machine, 16), elastic(whole, 16), rtol=1e-10)
    point = np.array([0.1, 0, 0]) + R @ [0.3, 0.1, 0.05]
    turned_row = machine.row(point, "x") @ machine.rigid_motions()
    np.testing.assert_allclose(turned_row[:3], [1, 0, 0], atol=1e-12)
    outer = fx.joined({"m": machine}, placed={"m": fx.joining.Pose((0, 1, 0), (-0.2, 0.5, 0.9))})
    for axis in "xyz":  # the labels of nodes that follow, whose directions turn with them
        left, right = f"m/left/3:{axis}", f"m/right/1:{axis}"
        assert right not in outer.dofs.labels
        np.testing.assert_allclose(outer.row(right), outer.row(left), atol=1e-14)
        np.testing.assert_allclose(outer.dofs.location(right), outer.dofs.location(left))


def test_matching_meshes_with_few_digits():
    """Nodes of one place found; gaps of 1e-7 of the machine leave its rigid-body motions free."""
    whole = fx.solid_block(size=(0.4, 0.2, 0.1), elements=(4, 2, 1), **SOLID)
    half = fx.solid_block(size=(0.2, 0.2, 0.1), elements=(2, 2, 1), **SOLID)
    models = {"left": half, "right": half}
    placed = {"right": fx.joining.Pose((0.2 + 4e-8, -3e-8, 2e-8))}
    joints = fx.joining.coincident_joints(models, placed=placed)
    assert [repr(joint) for joint in joints[:2]] == [
        "<Joint left/3 - right/1 along x, y, z, rigid>",
        "<Joint left/6 - right/4 along x, y, z, rigid>",
    ]
    machine = fx.joined(models, joints, placed=placed)
    assert machine.n_dof == whole.n_dof
    assert machine.rigid_body.shape[1] == 6
    np.testing.assert_allclose(elastic(machine, 16), elastic(whole, 16), rtol=1e-5)
    assert len(fx.joining.coincident_joints(models, placed=placed, box=[(0, 0, 0), (1, 1, 0)])) == 3
    with pytest.raises(ModelError, match="no nodes of left, right are within"):
        fx.joining.coincident_joints(models, placed={"right": fx.joining.Pose((1.0, 0, 0))})
    with pytest.raises(ModelError, match="near several"):
        fx.joining.coincident_joints(models, placed=placed, tolerance=0.15)


def test_joints_with_lever_arms_and_springs_are_those_of_dense_algebra():
    """A stage on three ball joints above the frame, springs beside: B and k written out by hand."""
    upper, lower = plate(3, 0.6, 3), plate(4)
    placed = {"upper": fx.joining.Pose(shift=(0.0, 0.0, 0.2))}
    # at (0.2, 0.2) of the frame, 0.05 m beside its node 13 at (0.15, 0.15), by lever arms
    joints = [
        fx.joining.Joint("upper/6", "lower/7", axes=("z", "rx", "ry")),
        fx.joining.Joint("upper/1:z", "lower/1:z", stiffness=2e5, rate=30.0),
        fx.joining.Joint("upper/16:z", stiffness=1e5),
    ]
    machine = fx.joined({"upper": upper, "lower": lower}, joints, placed=placed)
    names = [*(f"upper/{n}" for n in upper.dofs.labels), *(f"lower/{n}" for n in lower.dofs.labels)]
    n = len(names)
    arm = upper.dofs.xyz[upper.dofs.index("6:z")] - lower.dofs.xyz[lower.dofs.index("7:z")]
    assert np.linalg.norm(arm) > 0.05
    B = np.zeros((3, n))
    for i, axis in enumerate(("z", "rx", "ry")):
        B[i, names.index(f"upper/6:{axis}")], B[i, names.index(f"lower/7:{axis}")] = 1.0, -1.0
    B[0, names.index("lower/7:rx")], B[0, names.index("lower/7:ry")] = -arm[1], arm[0]
    M, K = (
        la.block_diag(a.toarray(), b.toarray()) for a, b in ((upper.M, lower.M), (upper.K, lower.K))
    )
    D = np.zeros_like(M)
    between, ground = np.zeros(n), np.zeros(n)
    between[[names.index("upper/1:z"), names.index("lower/1:z")]] = 1.0, -1.0
    ground[names.index("upper/16:z")] = 1.0
    K += 2e5 * np.outer(between, between) + 1e5 * np.outer(ground, ground)
    D += 30.0 * np.outer(between, between)
    reference = oracles.frequencies(M, K, B)
    found = fx.solve_modes(machine, damping=fx.ModalDamping(0.0))
    r = machine.rigid_body.shape[1]
    assert r == 2  # one spring to ground leaves two rotations of the whole
    np.testing.assert_allclose(found.freq[r:], reference[r:], rtol=1e-7)
    Z = la.null_space(B, rcond=1e-10)
    stretch = machine.row("upper/1:z") - machine.row("lower/1:z")
    np.testing.assert_allclose(machine.D.toarray(), 30 * np.outer(stretch, stretch), rtol=1e-14)
    poles = oracles.poles(*(Z.T @ A @ Z for A in (M, D, K)))
    poles = poles[np.abs(poles) > 1.0]
    complex_modes = fx.solve_modes(machine)
    assert np.iscomplexobj(complex_modes.phi)
    np.testing.assert_allclose(complex_modes.poles[r : r + 12], poles[:12], rtol=1e-6)


def test_reduced_components_to_their_truncation():
    """Craig-Bampton on one side: errors fall with the modes; without vectors, a warning."""
    whole, half = elastic(plate(4), 9), plate(2, 0.3)
    boundary = [f"{i}:{axis}" for i in edge(half, 0.0) for axis in KINDS]
    errors = []
    for method in (fx.reduction.CraigBampton(boundary, 2), fx.reduction.CraigBampton(boundary, 30)):
        rom = fx.reduce(half, method)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            machine = fx.joined({"left": half, "right": rom}, seam(half), placed=RIGHT)
        assert isinstance(machine, fx.ReducedModel)
        seam_row = machine.row((0.3, 0.25, 0.0))  # a point of both is one motion
        assert seam_row == pytest.approx(machine.row({(0.2999999999, 0.25, 0.0): 1.0}), abs=1e-6)
        found = machine.modes()
        assert found.n_rigid == machine.joining.n_rigid == 3
        assert np.all(found.freq[:3] == 0)
        errors.append(found.freq[3:9] / whole - 1)
        assert np.all(errors[-1] > -1e-10)  # Rayleigh-Ritz
    assert errors[0].max() > 1e-4
    assert errors[1].max() < 1e-9  # all modes of the interior
    truncated = fx.reduce(fx.solve_modes(half, count=20), fx.reduction.ModalTruncation(count=20))
    with pytest.warns(FlexplantWarning, match="no static shape for the load"):
        fx.joined({"left": half, "right": truncated}, seam(half), placed=RIGHT)
    label = half.dofs.nearest((0, 0.3, 0))
    vectors = fx.solve_modes(half, count=20, compliance_at=[label])
    rom = fx.reduce(vectors, fx.reduction.ModalTruncation(count=20, static_at=[label]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        node = half.dofs.nearest((0.3, 0.3, 0))
        machine = fx.joined(
            {"left": half, "right": rom},
            fx.joining.Joint(f"left/{node}", f"right/{label}"),
            placed=RIGHT,
        )
    assert machine.row(f"right/{label}") == pytest.approx(machine.row(f"left/{node}"))


@pytest.mark.slow
def test_complex_modes_of_plates_on_dampers():
    """Sparse: light damping is ``phi^T D phi / (2 omega)``, phi by another eigensolver."""
    half = fx.kirchhoff_plate(size=(0.3, 0.6), thickness=0.02, elements=(16, 32), **PLATE)
    places = fx.joining.coincident_joints({"left": half, "right": half}, placed=RIGHT)
    soft = {"stiffness": [1e7, 1e5, 1e5], "rate": [3.0, 0.03, 0.03]}
    joints = [
        fx.joining.Joint(joint.first, joint.second, axes=joint.axes, **soft) for joint in places
    ]
    machine = fx.joined({"left": half, "right": half}, joints, placed=RIGHT)
    assert sp.issparse(machine.D)
    modes = fx.solve_modes(machine, count=10)
    squares, phi = sp.linalg.eigsh(machine.K, 10, machine.M, sigma=-1e4)
    omega = np.sqrt(squares[3:])
    np.testing.assert_allclose(modes.omega[3:], omega, rtol=1e-6)
    share = np.einsum("ij,ij->j", phi[:, 3:], machine.D @ phi[:, 3:])
    np.testing.assert_allclose(modes.zeta[3:], share / (2 * omega), rtol=1e-3)


@pytest.mark.filterwarnings("ignore:component 'stage' .* holds no static shape")
def test_modes_on_a_spring():
    """Motions that the spring does not feel leave rounding alone, which is no force."""
    model = fx.solid_block(size=(0.3, 0.2, 0.05), elements=(3, 2, 1), **SOLID)
    rom = fx.reduce(fx.solve_modes(model, count=20), fx.reduction.ModalTruncation(14))
    machine = fx.joined({"stage": rom}, fx.joining.Joint("stage/1:z", stiffness=1e5))
    row = rom.row("1:z")
    K = np.diag(np.diag(rom.K)) + 1e5 * np.outer(row, row)
    assert machine.joining.n_rigid == 5
    assert machine.joining.rigid_force < 1e-12
    truth = oracles.frequencies(rom.M, K)[5:]
    np.testing.assert_allclose(machine.modes().freq[5:], truth, rtol=1e-9)


@pytest.mark.slow
def test_a_reduced_machine_is_a_model_like_any():
    """Labels, plants, an update of a joint's stiffness, a machine in a machine."""
    half = plate(2, 0.3)
    boundary = [f"{i}:{axis}" for i in edge(half, 0.0) for axis in KINDS]
    rom = fx.reduce(half, fx.reduction.CraigBampton(boundary, 6, damping=fx.ModalDamping(0.01)))
    corner = half.dofs.nearest((0, 0, 0))
    springs = [
        fx.joining.Joint(
            f"left/{half.dofs.nearest((0, y, 0))}",
            f"right/{half.dofs.nearest((0, y, 0))}",
            stiffness=1e6,
        )
        for y in (0.0, 0.3, 0.6)
    ]  # fmt: skip
    machine = fx.joined({"left": rom, "right": rom}, springs)
    assert machine.rigid_body.shape[1] == 4  # the halves turn about the line of the springs
    assert machine.row(f"right/{corner}").any()
    truth = machine.replace(
        K=machine.K + 4e5 * np.outer(*[machine.row("left/1:z") - machine.row("right/1:z")] * 2)
    )
    numbers = [5, 6, 7]
    measured = fx.MeasuredModes(poles=truth.modes().poles[4:7], modes=numbers)
    unknown = fx.AddedStiffness("left/1:z", to="right/1:z")
    fit = fx.update(machine, [unknown], [fx.Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(4e5, rel=1e-6)
    assert fit.model.joining is None  # its checks are of the machine before
    wafer = fx.chain(masses=[1.0, 0.5], stiffnesses=[1e7]).with_damping(
        fx.structure.Rayleigh(0.0, 1e-6)
    )
    outer = fx.joined(
        {"machine": machine, "wafer": wafer},
        placed={"wafer": fx.joining.Pose(rotation=(0, np.pi / 2, 0))},
    )
    assert dict(outer.joining.pieces) == {"machine": 4, "wafer": 1}
    assert "machine/left/1:z" in outer.full_dofs
    assert outer.full_dofs.components == ("machine/left", "machine/right", "wafer")
    assert outer.modes().n_rigid == 5


def test_a_node_of_a_machine_in_a_machine():
    """By the name of its component, also where it follows another node; a number is not enough."""
    part = fx.chain(masses=[1.0, 2.0], stiffnesses=[1e6])
    inner = fx.joined({"a": part, "b": part}, fx.joining.Joint("a/2", "b/1"))
    for node in ("a/1", "b/1"):
        first, second = (
            fx.joined({"m": inner, "c": part}, fx.joining.Joint(f"m/{node}{axis}", f"c/1{axis}"))
            for axis in ("", ":x")
        )
        assert first.dofs.labels == second.dofs.labels
        np.testing.assert_array_equal(first.K.toarray(), second.K.toarray())
    patch = fx.joined(
        {"m": inner, "c": part}, fx.joining.Joint(fx.joining.Patch("m/b", [2]), "c/1", axes=["x"])
    )
    first = fx.joined({"m": inner, "c": part}, fx.joining.Joint("m/b/2", "c/1"))
    np.testing.assert_allclose(patch.K.toarray(), first.K.toarray(), rtol=1e-12)
    assert list(patch.joining.patches) == ["joint 1, <Patch of m/b, 1 nodes>"]
    with pytest.raises(LabelError, match=r"which a, b may share.*Patch\('m/a', nodes\)"):
        fx.joined(
            {"m": inner, "c": part}, fx.joining.Joint(fx.joining.Patch("m", [2]), "c/1", axes=["x"])
        )
    with pytest.raises(LabelError, match="no node '2' for the joint at 'm/2'"):
        fx.joined({"m": inner, "c": part}, fx.joining.Joint("m/2", "c/1"))


@pytest.mark.slow
def test_slides_and_hinges_are_rigid_body_motions_at_zero():
    models, placed = stage_on_frame()
    machine = fx.joined(models, at_feet(("y", "z")), placed=placed)
    assert machine.rigid_body.shape[1] == machine.joining.n_rigid == 7
    modes = fx.solve_modes(machine, count=12)
    assert np.all(modes.freq[:7] == 0)
    report = fx.check(machine)
    assert report.ok
    assert report.n_rigid == 7
    # springs along the slide, of the weakest kind that counts, give one soft mode and no more
    joints = [*at_feet(("y", "z")), *at_feet(("x",), stiffness=100.0)]
    soft = fx.solve_modes(fx.joined(models, joints, placed=placed), count=8)
    assert soft.n_rigid == 6
    m, frame = models["stage"].mass, models["frame"].mass
    pure = np.sqrt(300.0 * (1 / m + 1 / frame)) / (2 * np.pi)
    assert pure < soft.freq[6] < 1.5 * pure
    # springs of no stiffness hold nothing together
    loose = fx.joined(models, at_feet("x", stiffness=0.0), placed=placed)
    assert dict(loose.joining.pieces) == {"stage": 6, "frame": 6}
    # magnets along it: unstable, as a rigid body
    joints = [*at_feet(("y", "z")), *at_feet(("x",), stiffness=-100.0)]
    magnets = fx.joined(models, joints, placed=placed)
    assert magnets.n_unstable == 1
    assert fx.solve_modes(magnets, count=8).freq[6] == pytest.approx(-soft.freq[6], rel=1e-6)


def test_joints_that_repeat_others_do_no_harm():
    models, placed = stage_on_frame()
    once = fx.joined(models, at_feet(("x", "y", "z")), placed=placed)
    twice = fx.joined(models, [*at_feet(("x", "y", "z"))] * 2, placed=placed)
    assert (twice.joining.constraints, twice.joining.rank) == (18, 9)
    assert twice.n_dof == once.n_dof
    np.testing.assert_allclose(elastic(twice, 12), elastic(once, 12), rtol=1e-9)


def test_a_joint_within_a_component_stretches_no_rigid_motion():
    """A bar between two of its nodes, rigid or a spring: three motions at zero stay."""
    model = plate(3)
    for stiffness in (None, [1e6, 1e3]):
        bar = fx.joining.Joint("a/1", "a/8", axes=["z", "rx"], stiffness=stiffness)
        machine = fx.joined({"a": model}, bar)
        assert machine.joining.n_rigid == machine.rigid_body.shape[1] == 3
        zeros = np.linalg.eigvalsh(machine.K.toarray())[:4]
        assert np.abs(zeros[:3]).max() < 1e-9 * zeros[3]
        assert fx.solve_modes(machine, count=4).freq[3] > fx.solve_modes(model, count=4).freq[3]


def test_very_unlike_components():
    """A rubber pad below steel: 1e6 between their stiffnesses, exact zeros and inertia kept."""
    steel = fx.solid_block(size=(0.3, 0.2, 0.1), elements=(3, 2, 1), density=7850,
                           youngs_modulus=210e9, poisson_ratio=0.3)  # fmt: skip
    rubber = fx.solid_block(size=(0.3, 0.2, 0.02), elements=(3, 2, 1), density=1100,
                            youngs_modulus=2e5, poisson_ratio=0.45)  # fmt: skip
    pairs = zip(edge_z(rubber, 0.02), edge_z(steel, 0.0), strict=True)
    joints = [fx.joining.Joint(f"pad/{i}", f"steel/{j}") for i, j in pairs]
    machine = fx.joined(
        {"pad": rubber, "steel": steel},
        joints,
        placed={"steel": fx.joining.Pose(shift=(0, 0, 0.02))},
    )
    modes = fx.solve_modes(machine, count=10)
    assert modes.n_rigid == 6
    n = rubber.n_dof + steel.n_dof
    B = np.zeros((3 * len(joints), n))
    names = [*(f"pad/{x}" for x in rubber.dofs.labels), *(f"steel/{x}" for x in steel.dofs.labels)]
    for i, (joint, axis) in enumerate((j, a) for j in joints for a in "xyz"):
        B[i, names.index(f"{joint.first}:{axis}")] = 1.0
        B[i, names.index(f"{joint.second}:{axis}")] = -1.0
    M = la.block_diag(rubber.M.toarray(), steel.M.toarray())
    K = la.block_diag(rubber.K.toarray(), steel.K.toarray())
    np.testing.assert_allclose(modes.freq[6:], oracles.frequencies(M, K, B)[6:10], rtol=1e-6)


def edge_z(model, z):
    found = model.dofs.where(box=[(-9, -9, z), (9, 9, z)]).nodes
    return list(dict.fromkeys(found.tolist()))


def test_what_is_refused(monkeypatch):
    models, placed = stage_on_frame()

    def join(*joints, **more):
        return fx.joined(more.pop("models", models), joints, placed=placed, **more)

    with pytest.raises(ModelError, match="would hold the machine's motion rx, ry against"):
        join(fx.joining.Joint("stage/1:z", "frame/1:z"))
    with pytest.warns(FlexplantWarning, match="would hold the machine's motion") as said:
        join(fx.joining.Joint("stage/1:z", "frame/1:z", stiffness=1e4))
    assert {one.filename for one in said} == {__file__}  # at the caller's line
    with pytest.raises(LabelError, match=r"component 'frame': no DOF '1:rz'"):
        join(fx.joining.Joint("stage/1:z", "frame/1:rz"))
    with pytest.raises(LabelError, match="needs its rotation r"):
        join(fx.joining.Joint("stage/1", "frame/1"))
    with pytest.raises(LabelError, match="has no axis 'rx'"):
        join(fx.joining.Joint("stage/1", "frame/1", axes=["rx"]))
    with pytest.raises(LabelError, match=r"no component 'stag'.*Close matches: 'stage'"):
        join(fx.joining.Joint("stag/1:z", "frame/1:z"))
    with pytest.raises(LabelError, match="the place of the joint"):
        join(fx.joining.Joint(("stage", (5.0, 5.0, 5.0)), "frame/1"))
    with pytest.raises(LabelError, match="not clear what is joined"):
        fx.joined({"a": plate(2), "b": models["frame"]}, fx.joining.Joint("a/1", "b/1"))
    with pytest.raises(ModelError, match="needs a second end"):
        fx.joining.Joint("stage/1:z")
    with pytest.raises(ModelError, match="units differ"):
        fx.joined({"a": plate(2)}, fx.joining.Joint("a/1", stiffness=1e3))
    with pytest.raises(ModelError, match="of type FEModel or ReducedModel, got Modes"):
        join(models={"stage": fx.solve_modes(models["stage"], count=8)})
    with pytest.raises(LabelError, match="cannot name a component"):
        join(models={"st:age": models["stage"]})
    rom = fx.reduce(
        models["stage"], fx.reduction.CraigBampton(["1:x", "1:y", "1:z", "4:y", "4:z", "9:z"])
    )
    monkeypatch.setattr(join_module, "LARGEST_FULL", 20)
    with pytest.raises(ModelError, match=r"are too many .* Reduce the large components first"):
        join(models=models | {"stage": rom})
    with pytest.raises(ModelError, match=r"times as stiff as its components .* for a rigid joint"):
        join(*at_feet(("x", "y", "z"), stiffness=1e21))
    with pytest.raises(LabelError, match="the end of a joint must be a DOF"):
        fx.joining.Joint("stage/", "frame/1")
    with pytest.raises(ModelError, match="angles are in radians"):
        fx.joining.Pose(rotation=(0, 0, 90))
    with pytest.raises(LabelError, match="node numbers must be whole"):
        fx.joining.Patch("stage", ["a", "b"])
    with pytest.raises(LabelError, match="must be different"):
        fx.joining.Patch("stage", [1, 2, 1], weights=[1.0, 2.0, 3.0])
    damped = {"stage": models["stage"].with_damping(fx.structure.Rayleigh(0.0, 1e-6))}
    with pytest.warns(FlexplantWarning, match=re.escape("components ['frame'] have no D")):
        join(models=models | damped)


def test_the_certificate_can_fail(monkeypatch):
    """A gap, and a count that is wrong, are found."""
    half = plate(2, 0.3)
    good = join_module.eliminated

    def wrong(rows, size, order):
        rows = rows.copy()
        rows.data[:1] *= 1.001
        return good(rows, size, order)

    monkeypatch.setattr(join_module, "eliminated", wrong)
    with pytest.raises(CertificateError, match="fails its check"):
        fx.joined({"left": half, "right": half}, seam(half), placed=RIGHT)
    monkeypatch.undo()
    monkeypatch.setattr(join_module, "_force", lambda K, motions: 1.0)
    with pytest.raises(CertificateError, match="fails its check"):
        fx.joined({"left": half, "right": half}, seam(half), placed=RIGHT)


@pytest.mark.parametrize("stiffness", [None, (1e8, 1e8, 2e8, 1e5, 1e5, 1e5)])
def test_one_joint_of_patches_listed_twice(stiffness):
    """It was numpy's "Singular matrix": its axes were counted twice."""
    below = fx.solid_block(
        size=(0.2, 0.1, 0.05), elements=(4, 2, 1), density=2700, youngs_modulus=70e9,
        poisson_ratio=0.33,
    )  # fmt: skip
    above = fx.solid_block(
        size=(0.1, 0.1, 0.1), elements=(2, 2, 2), density=7800, youngs_modulus=210e9,
        poisson_ratio=0.3,
    )  # fmt: skip
    ends = (
        fx.joining.Patch("a", box=[(0.05, 0, 0.05), (0.15, 0.1, 0.05)], at=(0.1, 0.05, 0.05)),
        fx.joining.Patch("b", box=[(0.06, 0, 0.05), (0.16, 0.1, 0.05)], at=(0.1, 0.05, 0.05)),
    )
    joint = fx.joining.Joint(*ends, stiffness=stiffness)
    placed = {"b": fx.joining.Pose(shift=(0.06, 0, 0.05))}
    once, twice = (fx.joined({"a": below, "b": above}, [joint] * n, placed=placed) for n in (1, 2))
    assert set(twice.joining.patches) == set(once.joining.patches)
    if stiffness is None:
        np.testing.assert_allclose(elastic(twice, 6), elastic(once, 6), rtol=1e-9)
    else:  # springs beside each other add
        assert np.all(elastic(twice, 6) >= elastic(once, 6) * (1 - 1e-9))
