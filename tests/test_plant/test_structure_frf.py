"""Responses of structures between ports: beside dense solutions, plants, and their certificate."""

import numpy as np
import pytest

import flexplant as fx
import oracles_reduction as oracle
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.modes import dynamic_basis
from flexplant.modes import solve as solving
from flexplant.plant import RigidForce
from flexplant.sparse.factor import dynamic_lu
from plates import make_plate

FREQ = np.geomspace(30.0, 1500.0, 60)
FORCED, SEEN = ["1:z", "22:z"], ["22:z", "15:z"]
PLAIN = fx.Ports(
    u=[fx.Actuator(f"u{i}", at) for i, at in enumerate(FORCED)],
    y=[fx.Sensor(f"y{i}", at) for i, at in enumerate(SEEN)],
)


@pytest.fixture(scope="module")
def plate():
    return make_plate(elements=(6, 6))


def apart(found, wanted):
    """The largest difference, of the peak of each channel."""
    return (np.abs(found - wanted).max(axis=2) / np.abs(wanted).max(axis=2)).max()


def dense_response(plate, damping_at):
    """C (K - omega^2 M + damping)^-1 B, frequency by frequency."""
    M, K = plate.M.toarray(), plate.K.toarray()
    at = plate.dofs.indices
    B, C = np.eye(plate.n_dof)[:, at(FORCED)], np.eye(plate.n_dof)[at(SEEN)]
    none = np.zeros((1, 1))
    size = 1 / np.sqrt(np.diag(K))
    scale = np.outer(size, size)
    return np.moveaxis(
        [
            oracle.response(
                M * scale, none, (K + damping_at(2 * np.pi * f)) * scale,
                size[:, None] * B, C * size, 2j * np.pi * f,
            )
            for f in FREQ
        ],
        0, 2,
    )  # fmt: skip


@pytest.mark.slow
def test_every_damping_beside_dense_solutions(plate):
    M, K = plate.M.toarray(), plate.K.toarray()
    R = plate.rigid_body
    damped = plate.with_parts([fx.Damper("8:z", 300.0), fx.Damper("30:z", 40.0, to="18:z")])
    free = M - M @ R @ R.T @ M
    for model, law, damping_at in (
        (
            plate,
            fx.structure.Rayleigh(3.0, 1e-7),
            lambda omega: 1j * omega * (3.0 * free + 1e-7 * K),
        ),
        (damped, None, lambda omega: 1j * omega * damped.D.toarray()),
    ):
        found = fx.frequency_response(model, PLAIN, FREQ, damping=law)
        assert apart(found.data, dense_response(plate, damping_at)) < 1e-4
        assert found.error.max() < 1e-4
        assert found.error.size >= 3
        assert found.quantity == "displacement"  # joined with springs or converted as it is
    # modal damping over all modes: what is beyond the basis moves statically
    law = fx.ModalDamping(2e-3)
    every = plate.with_damping(law).D
    found = fx.frequency_response(plate, PLAIN, FREQ, damping=law)
    assert apart(found.data, dense_response(plate, lambda omega: 1j * omega * every)) < 1e-4


def test_without_damping_there_is_no_response_at_a_resonance(plate):
    found = fx.frequency_response(plate, PLAIN, FREQ)
    wanted = dense_response(plate, lambda omega: 0.0)
    np.testing.assert_allclose(found.data.real, wanted.real, rtol=0, atol=1e-5 * abs(wanted).max())
    modes = fx.solve_modes(plate, count=20)
    with pytest.raises(ModelError, match="infinite"):
        fx.frequency_response(plate, PLAIN, [100.0, modes.freq[3], 1400.0])


@pytest.mark.slow
def test_all_kinds_of_ports_as_in_a_plant(plate):
    lowpass = fx.lti.low_pass_filter(500.0, order=2)
    ports = fx.Ports(
        w=[
            fx.Disturbance("d", (0.11, 0.22, 0)),
            fx.BaseAcceleration("floor"),
            fx.plant.OutputDisturbance("o", "a"),
            RigidForce("turn", "rx"),
        ],
        u=[fx.Actuator("u1", "1:z", dynamics=lowpass), fx.Actuator("u2", (0.3, 0.3, 0), "rx")],
        z=[fx.Poi("die", (0.3, 0.2, 0), axes=("z", "rx")), fx.Poi("still", "9:z", absolute=False)],
        y=[
            fx.Sensor("v", "8:z", quantity="velocity"),
            fx.Sensor("a", "8:z", quantity="acceleration", dynamics=lowpass),
            fx.Sensor("sum", {"1:z": 1.0, "3:z": -1.0}),
        ],
    )
    damped = plate.with_damping(fx.structure.Rayleigh(1.0, 1e-7))
    modes = fx.solve_modes(plate, count=20, damping=fx.ModalDamping(0.01), compliance_at=["1:z"])
    kept = ["1:z", "7:z", "43:z", "49:z", "15:z"]
    for model in (
        damped,
        modes,
        fx.reduce(plate, fx.reduction.Guyan(kept, damping=fx.ModalDamping(0.01))),
    ):
        found = fx.frequency_response(model, ports, FREQ)
        plant = fx.assemble_plant(model, ports)
        wanted = fx.frequency_response(plant.system.select(found.outputs, found.inputs), FREQ)
        size = np.abs(wanted.data).max(axis=2)
        floor = 1e-5 * np.sqrt(np.outer(size.max(axis=1), size.max(axis=0)))
        gap = np.abs(found.data - wanted.data).max(axis=2) / np.maximum(size, floor)
        assert gap.max() < (1e-4 if model is damped else 1e-8)
        assert found.quantity is None
        assert found.unit("v", "u1") == wanted.unit("v", "u1") == "m/s/N"
    late = ports.replace(u=[ports.u[0].replace(latency=1e-3)])
    prompt, delayed = (fx.frequency_response(modes, given, FREQ) for given in (ports, late))
    turn = np.exp(-2e-3j * np.pi * FREQ)
    np.testing.assert_allclose(delayed["v", "u1"], turn * prompt["v", "u1"])


def test_the_check_sees_a_wrong_basis_and_mends_a_poor_one(plate, monkeypatch):
    law = fx.ModalDamping(1e-3)
    right = dynamic_basis.DynamicBasis.response

    def stiffer(basis, freq, rows, loads):
        basis.squares = np.where(basis.squares > 0, 2.5e6, 0.0)
        return right(basis, freq, rows, loads)

    monkeypatch.setattr(dynamic_basis.DynamicBasis, "response", stiffer)
    with pytest.warns(FlexplantWarning, match="not good to 0.0001"):
        wrong = fx.frequency_response(plate, PLAIN, FREQ, damping=law)
    assert wrong.error.max() > 0.1
    monkeypatch.undo()
    # a damper as stiff as the plate, far from all loads: their static shapes do not hold its motion
    damped = plate.with_parts([fx.Damper("49:z", 2e5, to="33:z"), fx.Damper("49:z", 1.0)])
    few = fx.solve_modes(damped, count=8, damping=fx.ModalDamping(0.0))
    grid = np.linspace(30.0, 0.9 * few.freq[-1], 9)
    good = fx.frequency_response(damped, PLAIN, grid)
    assert int(good.route.split()[3]) == 8  # of three places, and of the dampers at once
    monkeypatch.setattr(dynamic_basis, "damper_forces", lambda model: np.zeros((model.n_dof, 0)))
    fine = fx.frequency_response(damped, PLAIN, grid)
    assert apart(good.data, fine.data) < 1e-4
    assert fine.error.max() < 1e-4
    assert int(fine.route.split()[3]) > 6  # more than the static responses at three places
    poor = fx.frequency_response(damped, PLAIN, fine.freq, checks=0)
    assert apart(poor.data, fine.data) > 1e-4
    assert not poor.error.size
    assert "direct" not in repr(poor)


def test_modes_in_use_are_not_solved_again(plate, monkeypatch):
    model = plate.with_damping(fx.structure.Rayleigh(0.0, 1e-7))
    modes = fx.solve_modes(model, count=30)
    monkeypatch.setattr(solving, "solve_modes", None)
    found = fx.frequency_response(model, PLAIN, FREQ)
    assert found.route.startswith(f"{modes.n_modes} modes and")
    monkeypatch.undo()
    del modes
    assert "30 modes" not in fx.frequency_response(model, PLAIN, FREQ).route


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [fx.ModalDamping(0.01), fx.structure.Rayleigh(2.0, 1e-6), None],
    ids=["modal", "rayleigh", "dampers"],
)
@pytest.mark.parametrize("lost", [0, 2])
def test_a_large_model_is_checked_without_another_factor(law, lost, monkeypatch):
    """The error found is that of direct solutions, also where modes are missing in the band."""
    model = make_plate(elements=(23, 23))
    if law is None:
        model = model.with_parts([fx.Damper("1:z", 30.0), fx.Damper("30:z", 5.0, to="9:z")])
    modes = fx.solve_modes(model, below=2000.0, damping=fx.ModalDamping(0.0))
    kept = np.delete(np.arange(modes.n_modes), [6, 8][:lost])
    modes = modes.replace(
        omega=modes.omega[kept], zeta=modes.zeta[kept], phi=modes.phi[:, kept],
        residual=modes.residual[kept], rounding=modes.rounding[kept],
    )  # fmt: skip
    loads = np.array([model.row(at) for at in FORCED]).T
    rows = np.array([model.row(at) for at in SEEN])
    factor = dynamic_basis.held_factor(model)
    basis = dynamic_basis.DynamicBasis(model, modes, np.hstack([loads, rows.T]), law)
    at, wanted = np.array([40.0, 320.0, 700.0, 1100.0]), []
    made = dynamic_basis.ComplexSymmetricFactor
    monkeypatch.setattr(dynamic_basis, "ComplexSymmetricFactor", lambda *a: wanted.append(made(*a)))
    corrected = basis.corrected(at, loads, factor)
    assert not wanted
    monkeypatch.undo()
    direct = np.array([rows @ basis.solved(f, loads) for f in at])
    gap = np.abs(basis.response(at, rows, loads) - direct)
    assert corrected is not None
    left = np.abs(corrected.response(at, rows, loads) - direct)
    assert left.max() < 0.1 * gap.max()
    assert (gap.max() > 1e-3 * np.abs(direct).max()) == bool(lost)


@pytest.mark.slow
def test_a_large_model_by_fronts():
    pad = fx.Spring("30:z", 1e5, to="300:z")
    plate = make_plate(elements=(24, 24)).with_parts(pad)
    at = plate.dofs.indices
    for law in (fx.structure.Rayleigh(0.0, 1e-6), fx.ModalDamping(1e-3)):
        found = fx.frequency_response(plate, PLAIN, FREQ, damping=law)
        assert found.error.max() < 1e-4
        for f, data in list(zip(FREQ, np.moveaxis(found.data, 2, 0), strict=True))[5::20]:
            viscous = isinstance(law, fx.structure.Rayleigh)
            loss = (2 * np.pi * f * 1e-6 if viscous else 2e-3) * plate.K
            lu = dynamic_lu(plate.K + 1j * loss - (2 * np.pi * f) ** 2 * plate.M)
            wanted = lu.solve(np.eye(plate.n_dof, dtype=complex)[:, at(FORCED)])[at(SEEN)]
            # away from resonance a loss factor and its viscous equivalent differ by their size
            limit = 1e-4 if viscous else 5e-3
            assert np.abs(data - wanted).max() < limit * np.abs(wanted).max()


def test_refusals(plate):
    modes = fx.solve_modes(plate, count=12, damping=fx.ModalDamping(0.01))
    with pytest.raises(ModelError, match="no response at 0 Hz"):
        fx.frequency_response(plate, PLAIN, [0.0, 10.0])
    with pytest.raises(ModelError, match="damped already"):
        fx.frequency_response(modes, PLAIN, FREQ, damping=fx.ModalDamping(0.01))
    with pytest.raises(ModelError, match="freq is missing"):
        fx.frequency_response(plate, PLAIN)
    with pytest.raises(ModelError, match="channels of its own"):
        fx.frequency_response(fx.assemble_plant(modes, PLAIN).system, PLAIN, FREQ)
    with pytest.raises(ModelError, match="frequency_response\\(model, ports, freq\\)"):
        fx.frequency_response(plate, FREQ)
    with pytest.raises(ModelError, match="Add ports"):
        fx.frequency_response(plate, fx.Ports(u=PLAIN.u), FREQ)
