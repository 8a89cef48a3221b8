"""How often the stated intervals hold on machines that share no code with the drawing.

``python -m pytest tests/benchmarks/test_interval_benchmarks.py -n 0 -m benchmark -s`` prints the
table, 15 to 25 s a machine. Each machine is a Mindlin plate in polynomials with masses that no
drawing shows, stiffness that varies by 2 % over it, and dampings that scatter by a quarter; the
third kind has uneven actuators and a weak strip that makes two modes of almost one frequency, the
fourth is a solid on springs in polynomials. It is drawn with `fx.plate` or `fx.solid_block`,
updated with its measured poles (with the strip or the springs as a third parameter), and its filter
and servo are designed as the README does. No constant of the drawing of machines was chosen on
these. The solid's springs were made softer along x and y after one trial with equal ones: there the
pairs of suspension modes had a sentence in the interval's place.

Drawings and machines without any scatter tell whether both have converged. A solid of 16 x 11 x 2
elements, used before, predicts an error of z that is 13 % too large, because its modes above 4 kHz
are 5 % and more too high before Richardson's rule. The one of 30 x 20 x 2, eight elements per
bending wave at the sampling rate, is 4 % off. Errors of ry of a soft pair are 4 % too small with
polynomials of order 19, which were used before; of order 27 they are 1 % off those of order 31.
The error of a free plate was a small difference of large numbers and up to 10 % of it was rounding;
see `unlike_machines.SWING`.

Measured on the seeds below, 72000 to 72019, which were not used before, in the order z, rx, ry,
margin, bandwidth, MA: 20 of 20 plates with masses are stated and hold 20, 19, 20, 20, 20, 20 of 20;
20 of 20 soft pairs are stated and hold 17, 19, 19, 18, 20, 20 of 20; 18 of 20 solids on springs are
stated and hold 16, 15, 18, 16, 16, 16 of 18. That is 329 of 348 (95 %): 91, 91, 98, 93, 97 and 97 %
of 58. Seeds 71000 to 71013 had 229 of 240 (95 %). Where nothing is stated, the
model is said to lack something.
"""

import warnings

import numpy as np
import pytest
import unlike_machines

import flexplant as fx

pytestmark = pytest.mark.benchmark

RATE, DELAY = 10e3, 1.3
FORCE, NOISE = 1e-3, 1.4e-12
FIGURES = ("die:z", "die:rx", "die:ry", "modulus margin", "bandwidth", "MA")
COUNT = 20

KINDS = {
    "plate with masses": {
        "size": (0.6, 0.6), "thickness": 0.0272, "zeta": 0.01, "cells": (40, 40),
        "known": (0.3, 0.15), "inset": (0.25, 0.75), "bandwidth": 50.0, "poles": 13,
    },
    "uneven plate": {
        "size": (0.45, 0.3), "thickness": 0.02, "zeta": 0.003, "cells": (42, 28),
        "known": (0.1, 0.2), "inset": (0.2, 0.7), "bandwidth": 40.0, "poles": 11,
    },
    "soft pair": {
        "size": (0.45, 0.3), "thickness": 0.02, "zeta": 0.003, "cells": (42, 28),
        "known": (0.1, 0.2), "bandwidth": 40.0, "poles": 11, "soft": 0.53, "order": 27,
        "push": [(0.09, 0.06), (0.36, 0.075), (0.1, 0.24), (0.33, 0.22)],
    },
    "solid on springs": {
        "size": (0.6, 0.4, 0.03), "zeta": 0.01, "cells": (30, 20, 2), "known": (0.2, 0.3),
        "inset": (0.2, 0.75), "bandwidth": 50.0, "poles": 11, "springs": 43e3,
    },
}  # fmt: skip
#: half-width [m] of the weak strip across the plate, which makes a soft pair at 412 and 419 Hz
STRIP = 0.07
#: stiffness of the solid's springs along x, y and z over that along z, as of rubber feet
SOFTER = (0.5, 0.5, 1.0)
ALUMINIUM = {"density": 2702.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}


def layout(kind):
    a, b = kind["size"][:2]
    low, high = kind.get("inset", (0.0, 1.0))
    forces = kind.get("push") or [(x * a, y * b) for y in (low, high) for x in (low, high)]
    corners = [(x, y) for y in (0.0, b) for x in (0.0, a)]
    return forces, corners, (0.5 * a, 0.5 * b)


def height(kind):
    """Height [m] of the plane of forces, sensors and POI."""
    return (*kind["size"], 0.0)[2]


def corners(kind):
    """Places of the sensors."""
    return [(*place, height(kind)) for place in layout(kind)[1]]


def ports(kind):
    forces, _, poi = layout(kind)
    c = height(kind)
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=(*p, c), asd=FORCE) for i, p in enumerate(forces, 1)],
        u=[fx.Actuator(f"u{i}", at=(*p, c)) for i, p in enumerate(forces, 1)],
        z=[fx.Poi("die", at=(*poi, c), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=NOISE) for i, p in enumerate(corners(kind), 1)],
        references=[fx.Reference("die")],
    )


def modulus(kind, soft, size=70e9):
    """Young's modulus over the plate: a weak strip across its middle where it has one."""
    middle = 0.5 * kind["size"][0]
    return lambda x, y: size * (1.0 - soft * np.exp(-(((x - middle) / STRIP) ** 2))) + 0.0 * y


def solid(kind, cells, mass=0.0, stiffer=0.0, firmer=0.0):
    """A block on springs at its lower corners, pushed and seen on its upper side."""
    a, b, c = kind["size"]
    material = ALUMINIUM | {"youngs_modulus": 70e9 * (1.0 + stiffer)}
    model = fx.solid_block(size=(a, b, c), elements=cells, **material)
    firm = kind["springs"] * (1.0 + firmer)
    springs = [
        fx.Spring(model.dofs.nearest((x, y, 0.0), along), firm * part)
        for x in (0.0, a) for y in (0.0, b) for along, part in zip("xyz", SOFTER, strict=True)
    ]  # fmt: skip
    model = model.with_parts(springs)
    at = model.dofs.nearest((*kind["known"], c), "z")
    return (model.with_parts(fx.PointMass(at, mass)) if mass > 0 else model), at


def drawn(kind, cells, make=fx.plate, mass=0.0, stiffer=0.0, softer=0.0):
    if "springs" in kind:
        return solid(kind, cells, mass, stiffer, softer)
    stiff = modulus(kind, kind.get("soft", 0.0) + softer, 70e9 * (1.0 + stiffer))
    material = ALUMINIUM | {"youngs_modulus": stiff}
    model = make(size=kind["size"], thickness=kind["thickness"], elements=cells, **material)
    at = model.dofs.nearest((*kind["known"], 0.0), "z")
    return (model.with_parts(fx.PointMass(at, mass)) if mass > 0 else model), at


def solved(kind, cells, make, *changes, **options):
    """Modes of the drawing with the mesh error corrected by Richardson's rule."""
    damping = fx.ModalDamping(kind["zeta"])
    coarser = tuple(round(0.7 * n) for n in cells)
    fine = fx.solve_modes(drawn(kind, cells, make, *changes)[0], damping=damping, **options)
    options.pop("compliance_at", None)
    coarse = drawn(kind, coarser, make, *changes)[0]
    return fine.extrapolated(fx.solve_modes(coarse, damping=damping, **options))


def machine_of(kind, seed):
    if "springs" in kind:
        return solid_machine_of(kind, seed)
    rng = np.random.default_rng([seed, 60])
    forces, sensors, poi = layout(kind)
    a, b = kind["size"]
    plate = a * b * kind["thickness"] * 2702.0
    masses = [
        (kind["known"], plate * rng.uniform(0.005, 0.02)),
        ((a * rng.random(), b * rng.random()), plate * 0.003 * rng.random()),
    ]
    young = modulus(kind, kind["soft"] * rng.normal(1.0, 0.03)) if "soft" in kind else 70e9
    return unlike_machines.plate_machine(
        rng, kind["size"], kind["thickness"], 2702.0, young, 0.33, forces=forces, sensors=sensors,
        poi=poi, zeta=kind["zeta"], masses=masses,
        order=kind.get("order", unlike_machines.ORDER),
    )  # fmt: skip


def solid_machine_of(kind, seed):
    rng = np.random.default_rng([seed, 60])
    a, b, c = kind["size"]
    upper = [[(*p, c) for p in places] for places in layout(kind)[:2]]
    block = a * b * c * 2702.0
    masses = [
        ((*kind["known"], c), block * rng.uniform(0.005, 0.02)),
        ((a * rng.random(), b * rng.random(), c), block * 0.003 * rng.random()),
    ]
    firm = kind["springs"] * rng.normal(1.0, 0.05)
    return unlike_machines.solid_machine(
        rng, (a, b, c), 2702.0, 70e9, 0.33, forces=upper[0], sensors=upper[1],
        poi=(0.5 * a, 0.5 * b, c), zeta=kind["zeta"], masses=masses,
        springs=[((x, y, 0.0), firm * np.array(SOFTER)) for x in (0.0, a) for y in (0.0, b)],
    )  # fmt: skip


def measured_of(machine, model, count, seed):
    """Poles with the noise of a measurement and shapes at the corners, as the model's modes."""
    rng = np.random.default_rng([seed, 61])
    poles, shapes = machine.measured(count)
    std = 1e-5 * np.abs(poles)
    poles = poles + std * (rng.normal(size=count) + 1j * rng.normal(size=count)) / np.sqrt(2)
    names = [f"y{i}" for i in range(1, 5)]
    found = fx.MeasuredModes(poles, covariance=std**2, shapes=shapes, dofs=names)
    return lambda kind: fx.numbered(
        found, model, at=dict(zip(names, corners(kind), strict=True)),
        partial=True, least_mac=0.7, tolerance=0.05,
    )  # fmt: skip


def third(kind, rom, make):
    """What a weaker strip or firmer springs add to the stiffness of the reduced model."""
    K = [drawn(kind, kind["cells"], make, 0.0, 0.0, more)[0].K for more in (0.0, 0.1)]
    return rom.T.T @ ((K[1] - K[0]) @ rom.T) / 0.1


def designed_for(kind, seed, machine, make=fx.plate):
    """The sampled plant of a drawing that was updated with the poles of a machine."""
    at = drawn(kind, kind["cells"], make)[1]
    modes = solved(kind, kind["cells"], make, count=24, compliance_at=[at])
    kept = [at, *(modes.dofs.nearest(place, "z") for place in corners(kind) if "springs" in kind)]
    rom = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 25, required=kept).labels))
    measured = measured_of(machine, rom, kind["poles"], seed)(kind)
    other = third(kind, rom, make) if kind.keys() & {"soft", "springs"} else None
    own = rom.K - other if "springs" in kind else rom.K
    unknown = [fx.AddedMass(at), fx.MatrixParameter("stiffness", dK=own)]
    if other is not None:
        unknown.append(fx.MatrixParameter("strip or springs", dK=other))
    fit = fx.update(rom, unknown, [fx.Eigenvalues(measured)])
    whole = solved(kind, kind["cells"], make, *fit.values, count=120)
    whole = whole.calibrated(measured_of(machine, whole, kind["poles"], seed)(kind))
    plant = fx.assemble_plant(fit.calibrated(measured), ports(kind), evaluation=whole)
    return plant.discretized(RATE, delay=DELAY)


def errors_of(observer, machine):
    """True rms errors of a filter on a machine."""
    g = observer.system.select(inputs=[f"y{i}" for i in range(1, 5)])
    return unlike_machines.true_errors(machine, (g.A, g.B, g.C, g.D), FORCE, NOISE, RATE, 4)


def judged(kind, seed, make=fx.plate):
    """Intervals and true figures of one machine."""
    machine = machine_of(kind, seed)
    plant = designed_for(kind, seed, machine, make)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=kind["bandwidth"], observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    stated = [observer.interval(name) for name in FIGURES[:3]]
    stated += [loop.interval(name) for name in FIGURES[3:5]]
    stated.append(loop.interval(ma, unit="m"))
    true = [*errors_of(observer, machine), *loop_figures(machine, (observer, servo))]
    return stated, true


#: a move of 1 mm along z in 60 ms, after which the error settles for 20 ms
MOVE = {"distance": 1e-3, "velocity": 0.05, "acceleration": 2.0, "jerk": 200.0}
SETTLING = 0.02


def ma(loop):
    """Largest |MA| [m] of the error after the move, without noise."""
    move = fx.setpoint(**MOVE)
    late = move.duration + SETTLING
    run = fx.simulate(
        loop, reference={"die:ref": move}, duration=late + 0.03, noise=False, progress=False
    )
    return run.exposure("die:error", start=late)[0]


def loop_figures(machine, blocks):
    """Margin, bandwidth and MA after a move of the loop on the machine."""
    A, B, C = machine.continuous()
    four = range(1, 5)
    w = [*(f"amp{i}" for i in four), *(f"y{i}:noise" for i in four), "die:ref"]
    u, sensors = [f"u{i}" for i in four], [f"y{i}" for i in four]
    z = ["die:z", "die:rx", "die:ry", "die:error", *(f"{name}:effort" for name in u)]
    forces = np.hstack([B, np.zeros((len(A), 5)), B])
    rows = np.vstack([C[4:], -C[4:5], np.zeros((4, len(A))), C[:4], np.zeros((1, len(A)))])
    D = np.zeros((len(rows), forces.shape[1]))
    D[3, 8] = D[12, 8] = 1.0
    D[4:8, 9:], D[8:12, 4:8] = np.eye(4), np.eye(4)
    system = fx.StateSpace(A, forces, rows, D, inputs=[*w, *u], outputs=[*z, *sensors, "die:ref"])
    plant = fx.StandardPlant.from_statespace(system, w=w, u=u, z=z, y=[*sensors, "die:ref"])
    loop = fx.close_loop(plant.discretized(RATE, delay=DELAY), *blocks)
    bandwidth = fx.compare_loops({"servo": loop}).rows["servo"].bandwidth
    return loop.modulus_margin, bandwidth, ma(loop)


def table(name, kind, make=fx.plate, count=COUNT, first=72000):
    """Print how often intervals are stated and hold; return both shares."""
    with warnings.catch_warnings(action="ignore"):
        runs = [judged(kind, seed, make) for seed in range(first, first + count)]
    print(f"\n{name}, {count} machines: stated, of these held, median width")
    stated = np.array([[one.low is not None for one in each] for each, _ in runs])
    held = np.array([
        [a.low is not None and a.low <= x <= a.high for a, x in zip(each, true, strict=True)]
        for each, true in runs
    ])  # fmt: skip
    for j, figure in enumerate(FIGURES):
        known = [each[j] for each, _ in runs if each[j].low is not None]
        width = np.median([one.high / one.low - 1.0 for one in known]) if known else np.nan
        print(f"  {figure:16s}{stated[:, j].sum():4d}{held[:, j].sum():4d}{width:8.1%}")
    for sentence in sorted({one.sentence for each, _ in runs for one in each if one.low is None}):
        print(f"  {sentence:.150}")
    return stated.mean(), held.sum() / max(stated.sum(), 1)


@pytest.mark.parametrize("name", KINDS)
def test_stated_intervals_hold(name):
    stated, held = table(name, KINDS[name])
    assert stated >= 0.5
    assert held >= 0.85


def test_a_thin_drawing_states_no_narrow_number():
    """With the thin plate intervals are wide (60 % of z) and hold, or a sentence stands there."""
    kind = KINDS["plate with masses"]
    stated, held = table("thin drawing", kind, fx.kirchhoff_plate, 5)
    assert stated < 0.5 or held >= 0.85


@pytest.mark.parametrize("name", ["plate with masses", "soft pair", "solid on springs"])
def test_a_filter_that_weighs_modes_by_their_uncertainty(name, seeds=range(41000, 41003)):
    """Print by how much it lowers the upper ends of the intervals, and the true errors.

    Measured on seeds 61000 and 61001 for z, rx, ry: upper ends of plates with masses change by
    -0.6, -0.4, -0.7 % and -2.9, -2.3, -3.3 %, those of soft pairs by -0.2, -3.8, +1.1 % and -0.8,
    -0.6, +0.7 %; the true errors by -1.8 to -0.1 % and -0.5 to +3.7 %. On a solid (seed 41000) the
    plain filter is kept. So the gain is small: 1 to 2 % of an upper end.
    """
    ratios = []
    for seed in seeds:
        machine = machine_of(KINDS[name], seed)
        with warnings.catch_warnings(action="ignore"):
            plant = designed_for(KINDS[name], seed, machine)
        both = [fx.design_kalman(plant, machines=own) for own in (None, plant.machines)]
        ends = [[one.interval(figure).high for figure in FIGURES[:3]] for one in both]
        true = [errors_of(one, machine) for one in both]
        ratios.append([np.divide(*pair[::-1]) - 1.0 for pair in (ends, true)])
    upper, errors = np.mean(ratios, axis=0)
    print(f"\n{name}, z rx ry: upper ends", *(f"{x:+.1%}" for x in upper), end="")
    print(", true errors", *(f"{x:+.1%}" for x in errors))
    assert upper.mean() <= 0.0
