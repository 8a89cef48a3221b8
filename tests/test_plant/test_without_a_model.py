"""A plant from measured modes alone: no finite-element model, POIs between the sensors."""

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.identification import identify_modes, numbered, structural_modes
from flexplant.lti import Frf, frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Fit, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import ModalDamping, interpolated, kirchhoff_plate

FREQ = np.arange(60.0, 701.0, 4.0)
ZETA = 0.01
POI = (0.33, 0.22, 0.0)


class Machine:
    """A free plate (its full model is only the truth), 12 sensors and 3 amplifiers at corners."""

    def __init__(self):
        self.full = kirchhoff_plate(
            size=(0.6, 0.5),
            thickness=0.02,
            elements=(6, 5),
            density=2702,
            youngs_modulus=70e9,
            poisson_ratio=0.35,
        )
        nearest = self.full.dofs.nearest
        self.sensors = [
            nearest((x, y, 0.0), "z") for x in (0, 0.2, 0.4, 0.6) for y in (0, 0.2, 0.5)
        ]
        self.amplifiers = [self.sensors[i] for i in (0, 2, 9)]
        self.modes = solve_modes(self.full, damping=ModalDamping(ZETA))
        data = self.exact(self.sensors)
        self.sigma = 1e-4 * np.sqrt(np.mean(np.abs(data) ** 2, axis=2, keepdims=True))
        rng = np.random.default_rng(0)
        noise = rng.normal(size=data.shape) + 1j * rng.normal(size=data.shape)
        self.frf = Frf(
            FREQ,
            data + noise * self.sigma / np.sqrt(2),
            inputs=["u1", "u2", "u3"],
            outputs=[f"y{i}" for i in range(12)],
            quantity="displacement",
            variance=np.broadcast_to(self.sigma**2, data.shape),
        )
        self.where = dict(zip(self.frf.outputs, self.sensors, strict=True))
        self.where |= dict(zip(self.frf.inputs, self.amplifiers, strict=True))
        self.found = identify_modes(self.frf, dofs=self.where, orders=range(2, 21))
        self.between = interpolated(self.full.dofs.select(self.sensors))

    def exact(self, places):
        """The sum over all 126 modes, by hand."""
        s, w = 2j * np.pi * FREQ, self.modes.omega[:, None]
        terms = 1 / (s**2 + 2 * ZETA * w * s + w**2)
        rows = [np.array([self.full.dofs.row(p) for p in ends]) @ self.modes.phi
                for ends in (places, self.amplifiers)]  # fmt: skip
        return np.einsum("ok,ik,kf->oif", *rows, terms)

    def plant(self, modes):
        ports = Ports(
            w=[Disturbance("floor", at=self.amplifiers[1], asd=1e-3)],
            u=[Actuator(f"u{i}", at=p) for i, p in enumerate(self.amplifiers, 1)],
            z=[Poi("die", at=POI, axes=("z",))],
            y=[Sensor(f"y{i}", at=p, asd=1e-10) for i, p in enumerate(self.sensors)],
        )
        return assemble_plant(modes, ports)

    def errors(self, plant):
        """Rms of the error of the worst sensor's and of the POI's response, relative to theirs."""
        G = frequency_response(plant.system, FREQ)
        rows = [f"y{i}" for i in range(12)], ["die:z"]
        truth = self.exact(self.sensors), self.exact([POI])
        found = []
        for names, exact in zip(rows, truth, strict=True):
            made = np.array([[G[name, u] for u in ("u1", "u2", "u3")] for name in names])
            gap, size = (np.mean(np.abs(part) ** 2, axis=2) for part in (made - exact, exact))
            found.append(float(np.sqrt(gap / size).max()))
        return found


@pytest.fixture(scope="module")
def machine():
    return Machine()


@pytest.mark.slow
def test_a_plant_from_measured_modes(machine):
    """12 places: sensors within 3 %, a POI between them by splines or by a model's shapes."""
    modes = structural_modes(machine.found, machine.between)
    assert modes.n_rigid == 3
    true = machine.modes
    rows = [true.dofs.index(label) for label in modes.dofs.labels]
    # the mass is that of the plate
    body, exact = modes.phi[:, :3], true.phi[rows, :3]
    np.testing.assert_allclose(body @ body.T, exact @ exact.T, atol=0.02 * np.max(exact @ exact.T))
    plant = machine.plant(modes)
    sensors, poi = machine.errors(plant)
    assert sensors < 0.03
    assert poi < 0.1
    # expanded over a wrong model's modes: 3 % thinner
    model = kirchhoff_plate(
        size=(0.6, 0.5),
        thickness=0.0194,
        elements=(6, 5),
        density=2702,
        youngs_modulus=70e9,
        poisson_ratio=0.35,
    )
    over = structural_modes(machine.found, machine.between, over=solve_modes(model, count=10))
    assert over.certificate["expansion"] < 0.02
    sensors, better = machine.errors(machine.plant(over))
    assert sensors < 0.08
    assert better < 0.04
    # the covariance of the poles is the plant's uncertainty
    known = numbered(machine.found, modes)
    assert known.modes == tuple(range(4, 4 + len(known)))
    uncertain = plant.uncertain(Fit(known, modes=[4, 5], deviations=3.0))
    assert [d.name for d in uncertain.deltas] == [
        "mode4:freq", "mode4:damping", "mode5:freq", "mode5:damping"
    ]  # fmt: skip
    truth = -ZETA * true.omega[3:5] + 1j * true.omega[3:5] * np.sqrt(1 - ZETA**2)
    error = known.poles[:2] - truth
    std = known.std[:2]
    assert np.abs(error.real / std.real).max() < 4
    assert np.abs(error.imag / std.imag).max() < 4
    # scale is relative, of omega^2: three standard deviations
    wanted = 3.0 * 2 * std.imag / np.abs(truth)
    got = [d.scale for d in uncertain.deltas if d.kind == "freq"]
    np.testing.assert_allclose(got, wanted, rtol=0.05)
    assert len(uncertain.machines.drawn(2, rng=1)) == 2


@pytest.mark.slow
def test_a_mode_just_outside_the_band_keeps_its_frequency(machine):
    """606 Hz, the band ends at 600: 10 % off as a residual vector at 618 Hz of all that is left."""
    where = {"dofs": machine.where, "orders": range(2, 21)}
    found = identify_modes(machine.frf, band=(60.0, 600.0), **where)
    assert found.freq.max() < 600
    modes = structural_modes(found, machine.between)
    assert "mode outside the band at 606.2" in modes.vector_dofs[0]
    assert modes.vector_omega[0] == pytest.approx(machine.modes.omega[7], rel=1e-3)
    assert modes.vector_zeta[0] == pytest.approx(ZETA, rel=0.05)
    assert modes.vector_omega[1] > 1.03 * 2 * np.pi * 606
    sensors, _ = machine.errors(machine.plant(modes))
    assert sensors < 0.03
    # one that is no mode of a structure stays with what is left
    poles, shapes, part = found.unreported
    turned = found.replace(unreported=(poles, shapes * np.exp(0.8j), part))
    assert "residual 1" in structural_modes(turned, machine.between).vector_dofs[0]


@pytest.mark.slow
def test_what_a_measurement_does_not_say_is_refused(machine):
    with pytest.raises(ModelError, match="no input and output are at one DOF"):
        structural_modes(machine.found.replace(mass_normalised=False), machine.between)
    few = DofSet([1, 2], ["z", "z"], [[0.0, 0, 0], [1.0, 0, 0]])
    with pytest.raises(LabelError, match="are channels without a DOF"):
        structural_modes(machine.found, few)
    with pytest.raises(ModelError, match="12 measured places cannot determine 14 modes"):
        structural_modes(machine.found, few, over=solve_modes(machine.full, count=14))
    with pytest.warns(FlexplantWarning, match="not in the span of the model's modes"):
        structural_modes(machine.found, few, over=solve_modes(machine.full, count=5))
    # no motion in 1/s^2 of positive mass
    upside = machine.found.replace(terms=-machine.found.terms, poles=machine.found.poles)
    with pytest.raises(ModelError, match="not a rigid-body motion with positive mass"):
        structural_modes(upside, machine.between)
    held = structural_modes(machine.found, machine.between, rigid=False)
    assert held.n_rigid == 0
