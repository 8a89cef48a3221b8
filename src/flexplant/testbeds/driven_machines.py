"""Eight driven machines, small: what motion engineers control in addition to a free body."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray
from ..lti.filters import high_pass_filter
from ..modes import solve_modes
from ..plant import (
    Actuator,
    BaseAcceleration,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
    suspend,
)
from ..structure import FEModel, ModalDamping, kirchhoff_plate, solid_block
from .lumped_machines import Stretch, along_leg, lumped, two_points


def gantry(*, rate: float = 4e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of an H-gantry on a frame with soft feet.

    Two linear motors push the ends of a bridge (60 kg, guides 1 m apart) along y against the frame.
    A third motor pushes the carriage (18 kg) along x against the bridge. The frame (900 kg) stands
    on feet on which it sways at 11 and 13 Hz. The tool, 5 kg on a column of the carriage, sways at
    62 and 80 Hz. An encoder at each motor measures the motion that this motor causes. The tool has
    references for x and y relative to the frame, and the skew of the bridge has a reference too.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> gantry().u
    ('left', 'right', 'cross')
    """
    # nodes: frame ends 1 and 2 below the guides, bridge ends 3 and 4, carriage 5, tool 6
    at = 0.62  # m from the left guide to the carriage, of a span of 1 m
    here, there = 1.0 - at, at
    model = lumped(
        {
            ("1:y", "2:y"): two_points(900.0, 150.0, 1.0),
            "1:x": 900.0,
            ("3:y", "4:y"): two_points(60.0, 6.5, 1.0),
            "3:x": 60.0,
            ("5:x", "5:y"): 18.0,
            ("6:x", "6:y"): 5.0,
        },
        [
            ({"1:x": 1.0}, 900.0 * _square(11.0)),
            ({"1:y": 1.0}, 450.0 * _square(13.0)),
            ({"2:y": 1.0}, 450.0 * _square(13.0)),
            ({"3:x": 1.0, "1:x": -1.0}, 1.2e8),
            ({"5:y": 1.0, "3:y": -here, "4:y": -there}, 6e7),
            ({"6:x": 1.0, "5:x": -1.0}, 5.0 * _square(62.0)),
            ({"6:y": 1.0, "5:y": -1.0}, 5.0 * _square(80.0)),
        ],
        {2: (1.0, 0.0, 0.0), 3: (0.0, 0.0, 0.2), 4: (1.0, 0.0, 0.2), 5: (at, 0.0, 0.2),
         6: (at, 0.0, 0.5)},
        "gantry",
    )  # fmt: skip
    drives = {
        "left": _between("3:y", "1:y"),
        "right": _between("4:y", "2:y"),
        "cross": _between("5:x", "3:x"),
    }
    pois = [
        Poi("tool_x", at=_between("6:x", "1:x"), axes=("x",)),
        Poi("tool_y", at={"6:y": 1.0, "1:y": -here, "2:y": -there}, axes=("y",)),
        Poi("skew", at={"4:y": 1.0, "3:y": -1.0, "2:y": -1.0, "1:y": 1.0}, axes=("y",)),
    ]
    floor = [Disturbance("floor_x", at="1:x", asd=0.1), Disturbance("floor_y", at="2:y", asd=0.1)]
    ports = Ports(
        w=floor,
        u=[Actuator(name, at=place, asd=0.02) for name, place in drives.items()],
        z=pois,
        y=[Sensor(f"{name}_encoder", at=place, asd=2e-10) for name, place in drives.items()],
        references=[Reference("tool_x"), Reference("tool_y"), Reference("skew")],
    )
    return _plant(model, ports, rate, delay)


def dual_stage(*, rate: float = 5e3, delay: float = 1.5) -> StandardPlant:
    """Return the plant of a short stroke on a long stroke, below a lens on isolators.

    All bodies move along x. A frequency in brackets is that of the body on its springs. One
    actuator pushes the long stroke (60 kg) against the base (3000 kg, 4 Hz). The other pushes the
    short stroke (15 kg, with a mirror block of 4 kg at 700 Hz) against the long stroke, without
    contact between the two. The lens (70 kg, 95 Hz) hangs in a metrology frame (500 kg, isolated
    from the base at 1.2 Hz). An interferometer measures the mirror block relative to the lens, and
    a second sensor the gap between both strokes. The die relative to the lens has a reference, and
    so has the gap.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> dual_stage().u
    ('long', 'short')
    """
    base, frame, lens, long, short, mirror = (f"{i}:x" for i in range(1, 7))
    model = lumped(
        {base: 3000.0, frame: 500.0, lens: 70.0, long: 60.0, short: 15.0, mirror: 4.0},
        [
            ({base: 1.0}, 3000.0 * _square(4.0)),
            (_between(frame, base), 500.0 * _square(1.2)),
            (_between(lens, frame), 70.0 * _square(95.0)),
            (_between(mirror, short), 4.0 * _square(700.0)),
        ],
        name="dual stage",
    )
    ports = Ports(
        w=[Disturbance("floor", at=base, asd=0.5), Disturbance("flow", at=lens, asd=1e-3)],
        u=[
            Actuator("long", at=_between(long, base), asd=5e-3),
            Actuator("short", at=_between(short, long), asd=2e-4),
        ],
        z=[
            Poi("die", at=_between(short, lens), axes=("x",)),
            Poi("gap", at=_between(short, long), axes=("x",)),
        ],
        y=[
            Sensor("interferometer", at=_between(mirror, lens), asd=1e-12),
            Sensor("gap_sensor", at=_between(short, long), asd=1e-9),
        ],
        references=[Reference("die"), Reference("gap")],
    )
    return _plant(model, ports, rate, delay)


def steering_mirror(*, rate: float = 20e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of a mirror that tilts on flexures.

    A mirror (0.12 kg, diameter 80 mm) is held by flexures in a housing. Its tilting modes about x
    and y have the frequencies 23 and 26 Hz. The housing (2.5 kg) is bolted to the ground and tilts
    on its bolts at 310 and 360 Hz. The rim of the mirror bends at 2.3 and 2.6 kHz. Four coils push
    against the housing; each pair makes one moment. Two differential sensors measure the tilt of
    the rim relative to the housing. The tilt of the mirror's centre has a reference.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> steering_mirror().z[:2]
    ('mirror:rx', 'mirror:ry')
    """
    inertia, rim, housing = 3.6e-5, 1.2e-5, 4e-3  # kg m^2
    axes = {"rx": (23.0, 2300.0, 310.0), "ry": (26.0, 2600.0, 360.0)}
    springs: list[Stretch] = []
    for axis, (tilt, bend, bolts) in axes.items():
        springs += [
            ({f"1:{axis}": 1.0}, housing * _square(bolts)),
            (_between(f"2:{axis}", f"1:{axis}"), (inertia + rim) * _square(tilt)),
            (_between(f"3:{axis}", f"2:{axis}"), rim * _square(bend)),
        ]
    bodies: dict[str | tuple[str, ...], float | FloatArray] = {
        (f"{node}:rx", f"{node}:ry"): size for node, size in ((1, housing), (2, inertia), (3, rim))
    }
    pairs = {axis: _between(f"2:{axis}", f"1:{axis}") for axis in axes}
    sensors = {axis: _between(f"3:{axis}", f"1:{axis}") for axis in axes}
    ports = Ports(
        w=[Disturbance(f"shaking_{axis}", at=f"1:{axis}", asd=1e-5) for axis in axes],
        u=[Actuator(f"coils_{axis}", at=place, asd=1e-7) for axis, place in pairs.items()],
        z=[Poi("mirror", at="2:rx", axes=("rx", "ry"))],
        y=[Sensor(f"tilt_{axis}", at=place, asd=1e-10) for axis, place in sensors.items()],
        references=[Reference("mirror", axes=("rx", "ry"))],
    )
    model = lumped(bodies, springs, name="steering mirror")
    return _plant(model, ports, rate, delay)


def flexible_joint(*, rate: float = 2e3, delay: float = 2.0) -> StandardPlant:
    """Return the plant of a robot's joint: a gear that winds up and a link that bends.

    The motor (1.4 kg m^2, as seen behind the gear) turns the root of the link (1.1 kg m^2) through
    a gear of the stiffness 2.6e4 N m/rad. The tip of the link (2.2 kg m^2) is connected to the root
    by a bending stiffness of 9e3 N m/rad. The motor pushes against a pedestal (9 kg m^2, 24 Hz).
    Encoders measure the motor and the root relative to the pedestal. The tip has a reference
    relative to the pedestal.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> flexible_joint().y
    ('motor_encoder', 'link_encoder', 'tip:ref')
    """
    pedestal, motor, root, tip = (f"{i}:rz" for i in range(1, 5))
    model = lumped(
        {pedestal: 9.0, motor: 1.4, root: 1.1, tip: 2.2},
        [
            ({pedestal: 1.0}, 9.0 * _square(24.0)),
            (_between(root, motor), 2.6e4),
            (_between(tip, root), 9e3),
        ],
        name="flexible joint",
    )
    ports = Ports(
        w=[Disturbance("load", at=tip, asd=1e-2)],
        u=[Actuator("motor", at=_between(motor, pedestal), asd=5e-3)],
        z=[Poi("tip", at=_between(tip, pedestal), axes=("rz",))],
        y=[
            Sensor("motor_encoder", at=_between(motor, pedestal), asd=1e-8),
            Sensor("link_encoder", at=_between(root, pedestal), asd=1e-7),
        ],
        references=[Reference("tip")],
    )
    return _plant(model, ports, rate, delay)


def isolation_table(*, rate: float = 4e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of a vibration isolation table with geophones; it has no references.

    A honeycomb table (1.5 m by 1 m, 300 kg) floats on four air mounts at 2.1 Hz above a shaking
    floor. Its bending modes begin at 175 Hz. Four actuators at the mounts push against the floor.
    Above them four geophones measure the absolute velocity; their response is corrected below their
    corner frequency. The point of interest is the absolute motion of the table's centre.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> isolation_table().z[:3]
    ('table:z', 'table:rx', 'table:ry')
    """
    size = (1.5, 1.0)
    table = kirchhoff_plate(size=size, thickness=0.2, elements=(4, 4), density=1000.0,
                            youngs_modulus=2e9, poisson_ratio=0.3, name="table")  # fmt: skip
    corners = [(x, y, 0.0) for x in (0.2, 1.3) for y in (0.15, 0.85)]
    modes = solve_modes(table, count=8, damping=ModalDamping(0.01))
    mass = size[0] * size[1] * 0.2 * 1000.0
    each = mass * _square(2.1) / 4.0
    held = suspend(modes, [GroundSpring(p, each, 0.1 * each / 13.2) for p in corners])
    ports = Ports(
        w=[
            BaseAcceleration("floor", "z", 2e-4, high_pass_filter(0.3, order=2)),
            *(Disturbance(f"air{i}", at=p, asd=1e-3) for i, p in enumerate(corners, 1)),
        ],
        u=[Actuator(f"coil{i}", at=p) for i, p in enumerate(corners, 1)],
        z=[Poi("table", at=(0.75, 0.5, 0.0), axes=("z", "rx", "ry"), absolute=True)],
        y=[
            Sensor(f"geophone{i}", at=p, quantity="velocity", absolute=True,
                   asd=1e-9)
            for i, p in enumerate(corners, 1)
        ],
    )  # fmt: skip
    return assemble_plant(held, ports).discretized(rate, delay=delay)


def hexapod(*, rate: float = 5e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of a hexapod with stiff legs on a soft base.

    Six legs carry a platform (22 kg). A load (8 kg) on the platform has modes at 140 Hz and above.
    Each leg is a stack of the stiffness 1.5e7 N/m with an actuator that strains it. The legs stand
    on a base (120 kg) that sways on its mounts at 16 to 35 Hz. Sensors in the legs measure their
    lengths. All six motions of the platform relative to the base have references.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> hexapod().u
    ('leg1', 'leg2', 'leg3', 'leg4', 'leg5', 'leg6')
    """
    base, platform = (tuple(f"{node}:{axis}" for axis in _AXES) for node in (1, 2))
    load = ("3:x", "3:y", "3:z")
    inertia = {base: (120.0, 5.0, 5.5, 9.0), platform: (22.0, 0.35, 0.4, 0.7)}
    bodies: dict[str | tuple[str, ...], float | FloatArray] = {
        group: np.diag([mass, mass, mass, *turned]) for group, (mass, *turned) in inertia.items()
    }
    legs = {f"leg{i + 1}": _leg(i) for i in range(6)}
    mounts = zip(base, (16.0, 17.0, 24.0, 30.0, 33.0, 35.0), strict=True)
    sizes = (120.0, 120.0, 120.0, 5.0, 5.5, 9.0)
    # the load stands 0.1 m above the platform's centre
    attached = [along_leg(2, (0.0, 0.0, 0.1), one, -1.0) for one in np.eye(3)]
    springs: list[Stretch] = [
        *(({one: 1.0}, m * _square(f)) for (one, f), m in zip(mounts, sizes, strict=True)),
        *((leg, 1.5e7) for leg in legs.values()),
        *(
            ({own: 1.0, **rest}, 8.0 * _square(freq))
            for own, rest, freq in zip(load, attached, (140.0, 150.0, 260.0), strict=True)
        ),
    ]
    model = lumped({**bodies, load: 8.0}, springs, {2: (0.0, 0.0, 0.25), 3: (0.0, 0.0, 0.35)},
                   "hexapod")  # fmt: skip
    # the base carries the platform along where it sways
    pois = [
        Poi(f"platform_{axis}", at={f"2:{axis}": 1.0, **_carried(axis)}, axes=(axis,))
        for axis in _AXES
    ]
    ports = Ports(
        w=[Disturbance(f"floor_{axis}", at=f"1:{axis}", asd=0.05) for axis in _AXES],
        u=[Actuator(name, at=leg, asd=1e-2) for name, leg in legs.items()],
        z=pois,
        y=[Sensor(f"{name}_length", at=leg, asd=1e-11) for name, leg in legs.items()],
        references=[Reference(poi.name) for poi in pois],
    )
    return _plant(model, ports, rate, delay)


def ball_screw(*, rate: float = 4e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of a screw axis with an encoder on its motor and one at its load.

    A motor and a screw (2.4e-3 kg m^2, lead 10 mm) move a table (140 kg) through an axial stiffness
    of 1.3e8 N/m. A workpiece (35 kg) stands on the table and sways at 48 Hz. The screw is supported
    by a machine bed (1100 kg, which sways at 14 Hz) and pushes against it. Encoders measure the
    angle of the motor and the table relative to the bed. The workpiece has a reference relative to
    the bed.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> ball_screw().units["motor_encoder"], ball_screw().units["load_encoder"]
    ('rad', 'm')
    """
    bed, motor, table, part = "1:x", "2:rx", "3:x", "4:x"
    lead = 10e-3 / (2.0 * np.pi)  # m/rad
    model = lumped(
        {bed: 1100.0, motor: 2.4e-3, table: 140.0, part: 35.0},
        [
            ({bed: 1.0}, 1100.0 * _square(14.0)),
            ({table: 1.0, bed: -1.0, motor: -lead}, 1.3e8),
            (_between(part, table), 35.0 * _square(48.0)),
        ],
        name="ball screw",
    )
    ports = Ports(
        w=[Disturbance("cutting", at=part, asd=0.1), Disturbance("floor", at=bed, asd=0.1)],
        u=[Actuator("motor", at=motor, asd=1e-3)],
        z=[Poi("part", at=_between(part, bed), axes=("x",))],
        y=[
            Sensor("motor_encoder", at=motor, asd=1e-6),
            Sensor("load_encoder", at=_between(table, bed), asd=1e-9),
        ],
        references=[Reference("part")],
    )
    return _plant(model, ports, rate, delay)


def maglev_block(*, rate: float = 10e3, delay: float = 1.0) -> StandardPlant:
    """Return the plant of a block that floats freely, pushed in six axes by eight actuators.

    A glass ceramic block (0.4 m by 0.4 m by 0.06 m, 24 kg) floats; its bending modes begin at
    1430 Hz. Four actuators push up near its corners, and four push along its sides. Six sensors
    measure its motion relative to the ground. The point of interest, which is not at the centre,
    has references in x, y and rz, and is to be held at rest in z, rx and ry.

    Parameters
    ----------
    rate : float [Hz]
        Sampling rate.
    delay : float [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> maglev_block().n_rigid
    6
    """
    side, height = 0.4, 0.06
    block = solid_block(size=(side, side, height), elements=(4, 4, 1), density=2530.0,
                        youngs_modulus=90e9, poisson_ratio=0.24, name="maglev block")  # fmt: skip
    near, far = 0.1, 0.3
    corners = [(x, y, 0.0) for x in (near, far) for y in (near, far)]
    pushes = {f"up{i}": (at, "z") for i, at in enumerate(corners, 1)}
    pushes |= {
        "x1": ((near, 0.0, 0.0), "x"),
        "x2": ((near, side, 0.0), "x"),
        "y1": ((0.0, near, 0.0), "y"),
        "y2": ((side, near, 0.0), "y"),
    }
    seen = {
        "z1": ((0.0, 0.0, height), "z"),
        "z2": ((side, 0.0, height), "z"),
        "z3": ((0.2, side, height), "z"),
        "sx": ((0.0, 0.2, height), "x"),
        "sy1": ((near, 0.0, height), "y"),
        "sy2": ((far, 0.0, height), "y"),
    }
    ports = Ports(
        u=[Actuator(n, at=p, direction=d, asd=2e-4) for n, (p, d) in pushes.items()],
        z=[Poi("die", at=(0.25, 0.15, height), axes=("x", "y", "rz", "z", "rx", "ry"))],
        y=[Sensor(n, at=p, direction=d, asd=1e-12) for n, (p, d) in seen.items()],
        references=[Reference("die", axes=("x", "y", "rz"))],
    )
    modes = solve_modes(block, count=16, damping=ModalDamping(0.005))
    return assemble_plant(modes, ports).discretized(rate, delay=delay)


_AXES = ("x", "y", "z", "rx", "ry", "rz")


def _plant(model: FEModel, ports: Ports, rate: float, delay: float) -> StandardPlant:
    """Return the sampled plant of all modes of a model."""
    modes = solve_modes(model, count=model.n_dof, damping=ModalDamping(0.01))
    return assemble_plant(modes, ports).discretized(rate, delay=delay)


def _between(moving: str, fixed: str) -> dict[str, float]:
    """Return the motion of one DOF relative to another."""
    return {moving: 1.0, fixed: -1.0}


def _square(freq: float) -> float:
    """Return omega^2 of a frequency [Hz]: stiffness per mass."""
    return float((2.0 * np.pi * freq) ** 2)


def _carried(axis: str) -> dict[str, float]:
    """Return minus the motion of the hexapod's base along an axis, 0.25 m above it."""
    if axis.startswith("r"):
        return {f"1:{axis}": -1.0}
    return along_leg(1, (0.0, 0.0, 0.25), np.eye(3)["xyz".index(axis)], -1.0)


def _leg(number: int) -> dict[str, float]:
    """Return the motion that lengthens a leg: platform (0.15 m) relative to base (0.25 m)."""
    third, side = divmod(number, 2)
    sign = 2 * side - 1
    up = np.deg2rad(120.0 * third + 50.0 * sign)
    down = np.deg2rad(120.0 * third + 12.0 * sign)
    top = np.array([0.15 * np.cos(up), 0.15 * np.sin(up), 0.0])
    foot = np.array([0.25 * np.cos(down), 0.25 * np.sin(down), 0.0])
    leg = top - foot + np.array([0.0, 0.0, 0.25])
    leg /= np.linalg.norm(leg)
    return along_leg(2, top, leg) | along_leg(1, foot, leg, -1.0)
