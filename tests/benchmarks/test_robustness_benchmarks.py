"""Loops promised and measured, on machines of another formulation than the design model's.

Run with ``-n 0 -m benchmark -s``: some fifteen minutes. The drawing is a mesh with 24 modes;
machines are plates in polynomials with rotary inertia, scattered stiffness and damping (0.1 % on
average), 0.2 to 0.9 kg that no drawing shows and a second mass. Their first ten poles are measured
to 1e-5; four of them give mass and stiffness, all calibrate the model, the fit says what is not
known.
"""

import time
import warnings

import numpy as np
import pytest

import flexplant as fx

pytestmark = pytest.mark.benchmark

RATE, ZETA = 10e3, 0.001
#: numbers of the machines and the mass [kg] that no drawing shows
MACHINES = {301: 0.3, 302: 0.6, 303: 0.9}
LONG = {811: 0.2, 812: 0.5, 813: 0.8}
MATERIAL = {"density": 2702, "poisson_ratio": 0.35}
MODULUS = 70e9
#: size [m], thickness [m], elements, actuators as parts of the size
CASES = {
    "the paper's plate": ((0.6, 0.6), 0.0272, (8, 8), ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75),
                                                       (0.75, 0.75))),
    "actuators uneven": ((0.6, 0.6), 0.0272, (8, 8), ((0.2, 0.25), (0.83, 0.17), (0.25, 0.7),
                                                      (0.67, 0.8))),
    "small and thick": ((0.5, 0.35), 0.03, (8, 6), ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75),
                                                    (0.75, 0.75))),
    "long": ((0.7, 0.4), 0.025, (10, 6), ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))),
}  # fmt: skip


def ports(size, forces):
    places = [(x * size[0], y * size[1], 0.0) for x, y in forces]
    corners = [(x, y, 0.0) for y in (0.0, size[1]) for x in (0.0, size[0])]
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(places, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(places, 1)],
        z=[fx.Poi("die", at=(size[0] / 2, size[1] / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=1.4e-12) for i, p in enumerate(corners, 1)],
        references=[fx.Reference("die")],
    )


def meshed(size, thickness, elements, stiffer=0.0):
    modulus = MODULUS * (1.0 + stiffer)
    return fx.kirchhoff_plate(
        size=size, thickness=thickness, elements=elements, youngs_modulus=modulus, **MATERIAL
    )


def models(machine, size, thickness, elements, seed, zeta=ZETA):
    """The calibrated model, the one with the truncated modes, and what is not known."""
    drawing = meshed(size, thickness, elements)
    place = (size[0] / 2, size[1] / 4, 0.0)
    at, low = drawing.dofs.nearest(place, "z"), fx.ModalDamping(zeta)
    modes = fx.solve_modes(drawing, count=24, damping=low, compliance_at=[at])
    rom = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 25, required=[at]).labels))
    poles = machine.poles(range(4, 14), deviation=1e-5, rng=seed)
    first = fx.MeasuredModes(poles.poles[:4], modes=poles.modes[:4])
    unknown = [fx.AddedMass(at), fx.MatrixParameter("E", dK=rom.K)]
    fit = fx.update(rom, unknown, [fx.Eigenvalues(first)])
    fine = meshed(size, thickness, [4 * n for n in elements], fit.values[1])
    loaded = fine.with_parts(fx.PointMass(fine.dofs.nearest(place, "z"), fit.values[0]))
    whole = fx.solve_modes(loaded, count=120, damping=low).calibrated(poles)
    return fit.calibrated(poles), whole, fit.uncertainty(poles).frequency


@pytest.mark.parametrize("name", list(CASES))
def test_promised_and_measured(name):
    size, thickness, elements, forces = CASES[name]
    own = ports(size, forces)
    print(f"\n{name}: margin promised, with the truncated modes, on the machine; |S| < 1 up to")
    for seed, mass in (LONG if name == "long" else MACHINES).items():
        machine = fx.testbeds.wafer_stage(
            size=size,
            thickness=thickness,
            damping=ZETA,
            individual=seed,
            added_mass=mass,
            rate=RATE,
        )
        model, whole, off = models(machine, size, thickness, elements, seed)
        plant = fx.assemble_plant(model, own, evaluation=whole)
        plant = plant.discretized(RATE, delay=machine.delay)
        begin = time.process_time()
        with warnings.catch_warnings(action="ignore"):
            controller = fx.design_stage(plant.uncertain(frequency=off))
            spent = time.process_time() - begin
            promised = fx.close_loop(plant, controller)
        loop = machine.loop(own, controller)
        assert loop.is_stable
        reach = fx.compare_loops({"machine": loop}).rows["machine"].bandwidth
        margins = [promised, promised.completed, loop]
        said = "  ".join(f"{one.modulus_margin:.3f}" for one in margins)
        print(f"  machine {seed}: {said}  {reach:5.1f} Hz  ({spent:.0f} s of CPU)")
        # design_stage draws machines with truncated modes, shapes and damping off: without shapes
        # machine 302 of the small plate was 0.33 for 0.43; without less damping of modes that were
        # not measured the long plate 811 was 0.22 for 0.41 (a mode left out, 2 % lower and of a
        # third less damping, half of which the controller takes away)
        assert loop.modulus_margin > 0.8 * promised.completed.modulus_margin
        assert np.isfinite(reach)
