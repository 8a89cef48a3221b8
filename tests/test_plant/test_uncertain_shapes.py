"""Deltas on measured shapes: exact in the plant, as wide as many noisy measurements spread."""

import numpy as np
import pytest
from test_uncertainty import closed

from flexplant import DofSet
from flexplant.errors import CertificateError, ModelError, ShapeError
from flexplant.identification import (
    MeasuredModes,
    PoleSelection,
    identify_modes,
    numbered,
    shape_deviations,
    structural_modes,
)
from flexplant.lti import Frf, frequency_response
from flexplant.modes import Modes, solve_modes
from flexplant.plant import (
    Actuator,
    Delay,
    Disturbance,
    Fit,
    Gains,
    Poi,
    Ports,
    Sensor,
    Shapes,
    assemble_plant,
)
from flexplant.plant.uncertainty.sampled_channels import delta_channels
from flexplant.structure import ModalDamping, chain

DOFS = DofSet([1, 2, 3], ["z"] * 3, [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
PORTS = Ports(
    w=[Disturbance("floor", at="3:z", asd=1e-3)],
    u=[Actuator("u1", at="1:z"), Actuator("u2", at="2:z")],
    z=[Poi("die", at="3:z", axes=("z",))],
    y=[
        Sensor("y1", at="1:z"),
        Sensor("y2", at="2:z", quantity="velocity"),
        Sensor("y3", at="3:z", quantity="acceleration"),
    ],
)
FREQ = np.linspace(5.0, 120.0, 40)


def three_modes(phi):
    omega = 2 * np.pi * np.array([0.0, 20.0, 60.0])
    return Modes(omega, np.array([0.0, 0.01, 0.02]), phi, DOFS, n_rigid=1)


@pytest.mark.slow
def test_a_value_of_delta_is_the_plant_with_that_shape():
    """Displacement, velocity, acceleration and POI; frequency and two shapes at once."""
    rng = np.random.default_rng(0)
    phi = rng.normal(size=(3, 3))
    plant = assemble_plant(three_modes(phi), PORTS)
    poles = np.array([complex(*_upper(plant, k)) for k in (2, 3)])
    measured = MeasuredModes(poles, modes=(2, 3), covariance=np.full(2, 0.25))
    shapes = 0.05 * rng.normal(size=(2, 3, 2))
    uncertain = plant.uncertain(
        Fit(measured, deviations=3.0), Shapes(shapes, measured.modes, deviations=3.0)
    )
    names = [delta.name for delta in uncertain.deltas]
    assert names[4:] == ["mode2:shape1", "mode2:shape2", "mode3:shape1", "mode3:shape2"]
    values = {
        "mode2:shape1": 0.7, "mode2:shape2": -0.4, "mode3:shape2": 1.0, "mode2:freq": 0.5
    }  # fmt: skip
    moved = phi.copy()
    moved[:, 1] += 3.0 * (0.7 * shapes[0, :, 0] - 0.4 * shapes[0, :, 1])
    moved[:, 2] += 3.0 * shapes[1, :, 1]
    modes = three_modes(moved)
    change = 1 + 0.5 * next(d.scale for d in uncertain.deltas if d.name == "mode2:freq")
    omega, zeta = modes.omega.copy(), modes.zeta.copy()
    omega[1] *= np.sqrt(change)
    zeta[1] /= np.sqrt(change)
    exact = frequency_response(assemble_plant(modes.replace(omega=omega, zeta=zeta), PORTS).system,
                               FREQ)  # fmt: skip
    for made in (closed(uncertain, values), uncertain.lft(values).system):
        found = frequency_response(made, FREQ)
        size = np.abs(exact.data).max(axis=2, keepdims=True)
        size[size == 0] = 1.0
        assert np.abs((found.data - exact.data) / size).max() < 1e-9
    # drawn machines have independent directions of the stated deviations
    alone = plant.uncertain(Shapes(shapes, measured.modes, deviations=3.0))
    machines = alone.machines.drawn(400, rng=1)
    drawn = [m.assembled.realisation.inputs[:, 3] - phi[:, 1] for m in machines]
    wanted = shapes[0] @ shapes[0].T
    np.testing.assert_allclose(np.cov(np.array(drawn).T), wanted, atol=0.2 * np.trace(wanted))
    # sampled: of positions as good as affine, with the channels of each Delta side by side
    seen = plant.with_ports(PORTS.replace(y=[Sensor("y1", at="1:z")])).discretized(2e3)
    sampled = seen.uncertain(
        Fit(measured, deviations=1.0), Shapes(shapes, measured.modes, deviations=1.0)
    )
    found = delta_channels(sampled)
    assert found.distance < 1e-4
    # an acceleration holds the product of both shapes: no rate makes it affine
    seen = plant.with_ports(PORTS.replace(y=[Sensor("y3", at="3:z", quantity="acceleration")]))
    wide = Shapes(3.0 * shapes, measured.modes, deviations=1.0)
    fast = seen.discretized(2e5).uncertain(Fit(measured, deviations=1.0), wide)
    with pytest.raises(CertificateError, match=r"what y3 measure .* measure displacements there"):
        delta_channels(fast)
    assert dict(found.deltas)["mode3:shape1"] == 2
    with pytest.raises(ShapeError, match="shapes"):
        plant.uncertain(measured, Shapes(shapes[:, :2], measured.modes))
    silent = np.zeros((2, 3, 1))
    assert len(plant.uncertain(measured, Shapes(silent, measured.modes)).deltas) == 4


def test_gains_and_a_delay_go_beside_shapes():
    """Together they are the plant assembled anew, channels in the order gains, modes, shapes."""
    rng = np.random.default_rng(3)
    phi = rng.normal(size=(3, 3))
    plant = assemble_plant(three_modes(phi), PORTS)
    poles = np.array([complex(*_upper(plant, k)) for k in (2, 3)])
    measured = MeasuredModes(poles, modes=(2, 3), covariance=np.full(2, 0.25))
    shapes = 0.05 * rng.normal(size=(2, 3, 1))
    gain = dict.fromkeys((plant.u[0], "y1", "y3"), 0.1)
    uncertain = plant.uncertain(measured, Shapes(shapes, measured.modes), Gains(gain))
    values = {delta.name: rng.uniform(-1, 1) for delta in uncertain.deltas}
    by_channels = closed(uncertain, values)
    exact = frequency_response(uncertain.lft(values).system, FREQ).data
    found = frequency_response(by_channels, FREQ).data
    size = np.maximum(np.abs(exact).max(axis=2, keepdims=True), 1e-300)
    assert np.abs((found - exact) / size).max() < 1e-9
    owners = list(dict.fromkeys(uncertain.channels.values()))
    assert [name for name in owners if name.endswith("gain")] == owners[:3]
    late = plant.discretized(2e3, delay=1).uncertain(
        measured, Shapes(shapes, measured.modes), Delay(0.5)
    )
    assert [delta.kind for delta in late.deltas].count("delay") == 1


def _upper(plant, number):
    pole = max(np.linalg.eigvals(plant.modal_blocks[number - 1]), key=lambda value: value.imag)
    return pole.real, pole.imag


@pytest.mark.long
@pytest.mark.parametrize("driven", [("1:x",), ("1:x", "3:x")])
def test_shapes_spread_as_stated(driven):
    """60 noisy measurements of a held chain: mass-normalised shapes at all places, chi-square."""
    model = chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e5, 3e5], ground=[1e5, 0.0, 2e5])
    modes = solve_modes(model, count=3, damping=ModalDamping(0.01))
    places = model.dofs.labels
    ports = Ports(
        u=[Actuator(f"u{label}", at=label) for label in driven],
        y=[Sensor(f"y{label}", at=label) for label in places],
    )
    freq = np.arange(20.0, 150.0, 0.5)
    exact = frequency_response(assemble_plant(modes, ports).Gyu, freq)
    sigma = 2e-3 * np.abs(exact.data).max()
    where = {f"{side}{label}": label for side in "uy" for label in places}
    where = {k: v for k, v in where.items() if k in (*exact.inputs, *exact.outputs)}
    poles = modes.omega * (-0.01 + 1j * np.sqrt(1 - 1e-4))
    rows = [places.index(label) for label in driven]
    start = PoleSelection(poles, np.asarray(modes.phi[rows], dtype=complex))
    rng, scores = np.random.default_rng(3), []
    for _ in range(60):
        noise = rng.normal(size=exact.data.shape) + 1j * rng.normal(size=exact.data.shape)
        frf = Frf(freq, exact.data + noise * sigma / np.sqrt(2), inputs=exact.inputs,
                  outputs=exact.outputs, variance=np.full(noise.shape, sigma**2))  # fmt: skip
        found = identify_modes(frf, dofs=where, start=start, lower=0, upper=0)
        made = structural_modes(found, model.dofs, rigid=False)
        spread = shape_deviations(found, model.dofs, count=3)
        for k in range(3):
            truth = modes.phi[:, k] * np.sign(modes.phi[:, k] @ made.phi[:, k])
            error = made.phi[:, k] - truth
            scores.append(np.linalg.solve(spread[k], error))
    # three independent directions of each of three modes
    scores = np.array(scores).reshape(60, 3, 3)
    mean = np.mean(scores**2, axis=(0, 2))
    assert np.all(np.abs(mean - 1) < 3.5 * np.sqrt(2 / 180))
    # and the plant takes them
    known = numbered(found, made)
    plant = assemble_plant(made, ports)
    uncertain = plant.uncertain(
        known, Shapes(shape_deviations(found, model.dofs, count=1), known.modes)
    )
    assert sum(delta.kind == "shape" for delta in uncertain.deltas) == 3
    # one direction has the variance of all
    assert np.linalg.norm(shape_deviations(found, model.dofs, count=1)[0]) == pytest.approx(
        np.linalg.norm(spread[0]), rel=1e-9
    )
    with pytest.raises(ModelError, match="covariance of these shapes is not known"):
        shape_deviations(found.replace(channel_covariance=None), model.dofs)
