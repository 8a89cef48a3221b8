"""Eight kinds of driven machines, drawn at random: other topologies and data than `fx.testbeds`.

Each function takes a random generator and returns a sampled plant. Masses, stiffnesses, gears,
sensors, labels, rates (2 to 20 kHz) and delays (0 to 2 samples) vary within what is built.
"""

import numpy as np

import flexplant as fx

ROTATIONS = ("rx", "ry", "rz")
SIX = ("x", "y", "z", *ROTATIONS)


def hertz(freq):
    return (2.0 * np.pi * freq) ** 2


def between(moving, fixed, weight=1.0):
    return {moving: weight, fixed: -weight}


class Assembly:
    """Masses on DOFs and springs along combinations of DOFs, by quadratic forms."""

    def __init__(self):
        self.labels, self.M, self.springs, self.xyz = [], {}, [], {}

    def body(self, *labels, mass):
        at = len(self.labels)
        self.labels += labels
        own = np.asarray(mass, dtype=float)
        self.M[at] = own if own.ndim == 2 else np.diag(np.broadcast_to(own, len(labels)))
        return labels

    def spring(self, stretch, stiffness):
        self.springs.append((dict(stretch), stiffness))

    def matrices(self):
        n = len(self.labels)
        M, K = np.zeros((n, n)), np.zeros((n, n))
        for at, own in self.M.items():
            M[at : at + len(own), at : at + len(own)] = own
        for stretch, k in self.springs:
            row = np.zeros(n)
            for label, weight in stretch.items():
                row[self.labels.index(label)] = weight
            K += k * np.outer(row, row)
        return M, K

    def model(self, slides=None):
        """The finite-element model; `slides` are the motions that no spring resists."""
        M, K = self.matrices()
        nodes, directions = zip(*(one.split(":") for one in self.labels), strict=True)
        nodes = [int(one) for one in nodes]
        xyz = [self.xyz.get(node, (0.0, 0.0, 0.0)) for node in nodes]
        given = (
            None
            if slides is None
            else np.array([[motion.get(label, 0.0) for motion in slides] for label in self.labels])
        )
        return fx.FEModel(M, K, dofs=fx.DofSet(nodes, directions, xyz), joint_motions=given)


def sampled(rng, model, ports, rates, delays=(0.0, 2.0)):
    zeta = float(np.exp(rng.uniform(np.log(0.003), np.log(0.02))))
    modes = fx.solve_modes(model, count=model.n_dof, damping=fx.ModalDamping(zeta))
    rate, delay = round(rng.uniform(*rates), -2), round(rng.uniform(*delays), 2)
    return fx.assemble_plant(modes, ports).discretized(rate, delay=delay)


def gantry(rng):
    """A bridge with yaw in two guides of a soft-footed frame, a carriage and a tool column."""
    a = Assembly()
    frame_m, span = rng.uniform(500, 2500), rng.uniform(0.5, 1.8)
    bridge_m, carriage_m, tool_m = rng.uniform(20, 120), rng.uniform(8, 40), rng.uniform(2, 10)
    frame_i, bridge_i = frame_m * span**2 / 6, bridge_m * span**2 / 12
    frame = a.body("10:x", "10:y", "10:rz", mass=[frame_m, frame_m, frame_i])
    bridge = a.body("20:y", "20:rz", mass=[bridge_m, bridge_i])
    a.body("20:x", mass=bridge_m)
    a.body("30:x", "30:y", mass=carriage_m)
    a.body("40:x", "40:y", mass=tool_m)
    for label, mass in zip(frame, (frame_m, frame_m, frame_i), strict=True):
        a.spring({label: 1.0}, mass * hertz(rng.uniform(6, 20)))
    half, off = span / 2, rng.uniform(-0.3, 0.3) * span
    # along the bridge, x = off: the carriage rides on it in y; guides hold the bridge in x
    a.spring(between("20:x", "10:x"), bridge_m * hertz(rng.uniform(150, 400)))
    a.spring({"30:y": 1.0, "20:y": -1.0, "20:rz": -off}, carriage_m * hertz(rng.uniform(120, 350)))
    for axis in "xy":
        a.spring(between(f"40:{axis}", f"30:{axis}"), tool_m * hertz(rng.uniform(45, 140)))
    soft = rng.random() < 0.5  # flexures at the guides resist yaw
    if soft:
        a.spring(between("20:rz", "10:rz"), bridge_i * hertz(rng.uniform(3, 10)))
    left = {"20:y": 1.0, "20:rz": -half, "10:y": -1.0, "10:rz": half}
    right = {"20:y": 1.0, "20:rz": half, "10:y": -1.0, "10:rz": -half}
    cross = between("30:x", "20:x")
    slides = [
        {"20:y": 1.0, "30:y": 1.0, "40:y": 1.0},
        {"30:x": 1.0, "40:x": 1.0},
        *([] if soft else [{"20:rz": 1.0, "30:y": off, "40:y": off}]),
    ]
    drives = {"Y1": left, "Y2": right, "X": cross}
    tool_y = {"40:y": 1.0, "10:y": -1.0, "10:rz": -off}
    pois = [
        fx.Poi("tip_x", at=between("40:x", "10:x"), axes=("x",)),
        fx.Poi("tip_y", at=tool_y, axes=("y",)),
    ]
    names = ["tip_x", "tip_y"]
    if rng.random() < 0.5:
        pois.append(fx.Poi("yaw", at=between("20:rz", "10:rz"), axes=("rz",)))
        names += ["yaw"] if rng.random() < 0.5 else []
    ports = fx.Ports(
        w=[
            fx.Disturbance("ground", at="10:x", asd=rng.uniform(0.05, 0.5)),
            fx.Disturbance("cable", at="30:x", asd=0.02),
            fx.Disturbance("cable_y", at="20:y", asd=0.02),
        ],
        u=[fx.Actuator(n, at=p, asd=rng.uniform(0.005, 0.05)) for n, p in drives.items()],
        z=pois,
        y=[
            fx.Sensor(f"{n}_scale", at=p, asd=10 ** rng.uniform(-10, -8.5))
            for n, p in drives.items()
        ],
        references=[fx.Reference(n) for n in names],
    )
    assert bridge
    return sampled(rng, a.model(slides), ports, (2e3, 6e3))


def dual_stroke(rng):
    """A short stroke on a long stroke; the lens and the metrology frame on isolators."""
    a = Assembly()
    m = {
        "1:y": rng.uniform(1500, 6000),
        "2:y": rng.uniform(200, 900),
        "3:y": rng.uniform(20, 150),
        "4:y": rng.uniform(30, 120),
        "5:y": rng.uniform(5, 25),
        "6:y": rng.uniform(1, 6),
    }
    for label, mass in m.items():
        a.body(label, mass=mass)
    a.spring({"1:y": 1.0}, m["1:y"] * hertz(rng.uniform(2.5, 20)))
    a.spring(between("2:y", "1:y"), m["2:y"] * hertz(rng.uniform(0.6, 2.5)))
    a.spring(between("3:y", "2:y"), m["3:y"] * hertz(rng.uniform(60, 200)))
    a.spring(between("6:y", "5:y"), m["6:y"] * hertz(rng.uniform(350, 1200)))
    tied = rng.random() < 0.3  # hoses between the strokes
    if tied:
        a.spring(between("5:y", "4:y"), m["5:y"] * hertz(rng.uniform(0.5, 2.0)))
    slides = (
        [{"4:y": 1.0, "5:y": 1.0, "6:y": 1.0}] if tied else [{"4:y": 1.0}, {"5:y": 1.0, "6:y": 1.0}]
    )
    coarse = between("4:y", "1:y") if rng.random() < 0.5 else between("5:y", "4:y")
    ports = fx.Ports(
        w=[
            fx.Disturbance("hall", at="1:y", asd=rng.uniform(0.1, 2)),
            fx.Disturbance("air", at="3:y", asd=1e-3),
        ],
        u=[
            fx.Actuator("LS", at=between("4:y", "1:y"), asd=rng.uniform(1e-3, 1e-2)),
            fx.Actuator("SS", at=between("5:y", "4:y"), asd=rng.uniform(1e-5, 5e-4)),
        ],
        z=[
            fx.Poi("wafer", at=between("5:y", "3:y"), axes=("y",)),
            fx.Poi("coarse", at=coarse, axes=("y",)),
        ],
        y=[
            fx.Sensor("laser", at=between("6:y", "3:y"), asd=10 ** rng.uniform(-12, -11)),
            fx.Sensor("linear", at=coarse, asd=10 ** rng.uniform(-9.5, -8)),
        ],
        references=[fx.Reference("wafer"), fx.Reference("coarse")],
    )
    return sampled(rng, a.model(slides), ports, (3e3, 10e3))


def mirror(rng):
    """A tip-tilt mirror on flexures in a housing: four coils, sensors at its rim."""
    a = Assembly()
    size = np.exp(rng.uniform(np.log(5e-6), np.log(5e-4)))
    body, rim = np.array([size, size * rng.uniform(0.8, 1.4)]), size * rng.uniform(0.1, 0.5)
    house = size * rng.uniform(30, 300)
    arm = rng.uniform(0.02, 0.06)
    a.body("1:rx", "1:ry", mass=house)
    a.body("2:rx", "2:ry", mass=body)
    a.body("3:rx", "3:ry", mass=rim)
    for i, axis in enumerate(("rx", "ry")):
        a.spring({f"1:{axis}": 1.0}, house * hertz(rng.uniform(150, 500)))
        a.spring(between(f"2:{axis}", f"1:{axis}"), (body[i] + rim) * hertz(rng.uniform(8, 80)))
        a.spring(between(f"3:{axis}", f"2:{axis}"), rim * hertz(rng.uniform(1200, 4000)))
    coil = {
        "N": between("2:rx", "1:rx", arm),
        "S": between("2:rx", "1:rx", -arm),
        "E": between("2:ry", "1:ry", -arm),
        "W": between("2:ry", "1:ry", arm),
    }
    if rng.random() < 0.4:  # driven in pairs
        coil = {n: coil[n] for n in ("N", "W")}
    seen = {"eddy_rx": between("3:rx", "1:rx"), "eddy_ry": between("3:ry", "1:ry")}
    ports = fx.Ports(
        w=[fx.Disturbance(f"vibration_{r}", at=f"1:{r}", asd=size) for r in ("rx", "ry")],
        u=[fx.Actuator(n, at=p, asd=1e-5) for n, p in coil.items()],
        z=[fx.Poi("beam", at="2:rx", axes=("rx", "ry"))],
        y=[fx.Sensor(n, at=p, asd=10 ** rng.uniform(-10, -8.5)) for n, p in seen.items()],
        references=[fx.Reference("beam", axes=("rx", "ry"))],
    )
    return sampled(rng, a.model(), ports, (8e3, 20e3))


def joint(rng):
    """A motor behind a gear (its angle not scaled), an elastic gear, a link that bends."""
    a = Assembly()
    ratio = rng.uniform(30, 160)
    link, tip = rng.uniform(0.3, 3), rng.uniform(0.5, 5)
    rotor = rng.uniform(0.4, 2.0) * (link + tip) / ratio**2
    base = rng.uniform(3, 15) * (link + tip)
    a.body("1:rz", mass=base)
    a.body("2:rz", mass=rotor)
    a.body("3:rz", mass=link)
    a.body("4:rz", mass=tip)
    a.spring({"1:rz": 1.0}, base * hertz(rng.uniform(12, 40)))
    # the rotor turns against the base; the gear stretches by rotor / ratio - link
    rotor_rel = between("2:rz", "1:rz", 1.0 / ratio)
    gear = {"2:rz": 1.0 / ratio, "1:rz": 1.0 - 1.0 / ratio, "3:rz": -1.0}
    a.spring(gear, (link + tip) * hertz(rng.uniform(8, 25)))
    a.spring(between("4:rz", "3:rz"), tip * hertz(rng.uniform(10, 30)))
    slides = [{"2:rz": ratio, "3:rz": 1.0, "4:rz": 1.0}]
    ports = fx.Ports(
        w=[
            fx.Disturbance("payload", at="4:rz", asd=1e-2),
            fx.Disturbance("shake", at="1:rz", asd=1e-2),
        ],
        u=[fx.Actuator("servo", at=between("2:rz", "1:rz"), asd=1e-2 / ratio)],
        z=[fx.Poi("tool", at=between("4:rz", "1:rz"), axes=("rz",))],
        y=[
            fx.Sensor("resolver", at=between("2:rz", "1:rz"), asd=10 ** rng.uniform(-6.5, -5)),
            fx.Sensor(
                "output_encoder", at=between("3:rz", "1:rz"), asd=10 ** rng.uniform(-8, -6.5)
            ),
        ],
        references=[fx.Reference("tool")],
    )
    assert rotor_rel
    return sampled(rng, a.model(slides), ports, (2e3, 4e3))


def along(node, at, direction, weight=1.0):
    """The motion of a point on a rigid body with six DOFs along a direction."""
    d = np.asarray(direction, dtype=float)
    row = np.concatenate([d, np.cross(np.asarray(at, dtype=float), d)])
    return {f"{node}:{axis}": weight * v for axis, v in zip(SIX, row, strict=True) if abs(v) > 1e-9}


def table(rng):
    """A rigid table with a payload on a column, on a floor that shakes: velocities alone."""
    a = Assembly()
    mass, lx, ly = rng.uniform(80, 800), rng.uniform(0.6, 2.0), rng.uniform(0.5, 1.2)
    Ix, Iy = mass * ly**2 / 12, mass * lx**2 / 12
    a.body("1:z", "1:rx", "1:ry", mass=[mass, Ix, Iy])
    load = rng.uniform(0.05, 0.2) * mass
    a.body("2:z", mass=load)
    px, py = rng.uniform(-0.3, 0.3) * lx, rng.uniform(-0.3, 0.3) * ly

    def at(x, y):
        return {"1:z": 1.0, "1:rx": y, "1:ry": -x}

    a.spring(
        {"2:z": 1.0, **{n: -v for n, v in at(px, py).items()}}, load * hertz(rng.uniform(40, 160))
    )
    corners = [(sx * 0.45 * lx, sy * 0.45 * ly) for sx in (-1, 1) for sy in (-1, 1)]
    each = (mass + load) * hertz(rng.uniform(1.2, 4.0)) / 4
    for x, y in corners:
        a.spring(at(x, y), each * rng.uniform(0.85, 1.2))
    used = corners if rng.random() < 0.5 else corners[:3]
    ports = fx.Ports(
        w=[
            *(
                fx.Disturbance(f"air{i}", at=at(x, y), asd=10 ** rng.uniform(-3, -2))
                for i, (x, y) in enumerate(corners)
            )
        ],
        u=[fx.Actuator(f"voice{i}", at=at(x, y)) for i, (x, y) in enumerate(used)],
        z=[fx.Poi("board", at="1:z", axes=("z", "rx", "ry"))],
        y=[
            fx.Sensor(f"geo{i}", at=at(x, y), quantity="velocity", asd=10 ** rng.uniform(-9.5, -8))
            for i, (x, y) in enumerate(used)
        ],
    )
    return sampled(rng, a.model(), ports, (2e3, 6e3))


def hexapod(rng):
    """Six struts of finite stiffness between a platform and a base on soft mounts."""
    a = Assembly()
    base_m, top_m, load_m = rng.uniform(60, 300), rng.uniform(8, 40), rng.uniform(2, 12)
    rb, rt, h = rng.uniform(0.2, 0.45), rng.uniform(0.12, 0.25), rng.uniform(0.15, 0.35)
    base_i = base_m * rb**2 * np.array([0.35, 0.4, 0.7])
    top_i = top_m * rt**2 * np.array([0.35, 0.4, 0.7])
    base = a.body(*(f"1:{x}" for x in SIX), mass=[base_m] * 3 + list(base_i))
    a.body(*(f"2:{x}" for x in SIX), mass=[top_m] * 3 + list(top_i))
    a.body("3:x", "3:y", "3:z", mass=load_m)
    a.xyz = {2: (0, 0, h), 3: (0, 0, h + 0.1)}
    for label, m in zip(base, [base_m] * 3 + list(base_i), strict=True):
        a.spring({label: 1.0}, m * hertz(rng.uniform(10, 40)))
    strut = top_m * hertz(rng.uniform(60, 250)) / 3.0
    legs = {}
    splay = rng.uniform(8, 25), rng.uniform(30, 50)
    for i in range(6):
        third, sign = divmod(i, 2)[0], 2 * (i % 2) - 1
        up, down = (np.deg2rad(120 * third + s * sign) for s in (splay[1], splay[0]))
        top = np.array([rt * np.cos(up), rt * np.sin(up), 0.0])
        foot = np.array([rb * np.cos(down), rb * np.sin(down), 0.0])
        d = top - foot + np.array([0, 0, h])
        d /= np.linalg.norm(d)
        legs[f"S{i}"] = along(2, top, d) | along(1, foot, d, -1.0)
        a.spring(legs[f"S{i}"], strut)
    height = rng.uniform(0.05, 0.12)
    for axis, e in zip("xyz", np.eye(3), strict=True):
        a.spring(
            {f"3:{axis}": 1.0, **along(2, (0, 0, height), e, -1.0)},
            load_m * hertz(rng.uniform(90, 300)),
        )
    pois = []
    for axis in SIX:
        carried = (
            {f"1:{axis}": -1.0}
            if axis in ROTATIONS
            else along(1, (0, 0, h), np.eye(3)["xyz".index(axis)], -1.0)
        )
        pois.append(fx.Poi(f"top_{axis}", at={f"2:{axis}": 1.0, **carried}, axes=(axis,)))
    led = pois if rng.random() < 0.6 else pois[:3]
    ports = fx.Ports(
        w=[fx.Disturbance(f"floor_{x}", at=f"1:{x}", asd=0.05) for x in SIX],
        u=[fx.Actuator(n, at=p, asd=10 ** rng.uniform(-3, -1.5)) for n, p in legs.items()],
        z=pois,
        y=[fx.Sensor(f"{n}_lvdt", at=p, asd=10 ** rng.uniform(-11, -9)) for n, p in legs.items()],
        references=[fx.Reference(one.name) for one in led],
    )
    return sampled(rng, a.model(), ports, (2e3, 8e3))


def screw(rng):
    """A motor, a coupling, a screw and a table with a workpiece on a machine bed."""
    a = Assembly()
    lead = rng.choice([5e-3, 10e-3, 20e-3]) / (2 * np.pi)
    bed, table_m, part = rng.uniform(500, 4000), rng.uniform(40, 400), rng.uniform(5, 120)
    motor, spindle = (rng.uniform(0.3, 2.0) * table_m * lead**2 for _ in range(2))
    a.body("1:x", mass=bed)
    a.body("2:rx", mass=motor)
    a.body("3:rx", mass=spindle)
    a.body("4:x", mass=table_m)
    a.body("5:x", mass=part)
    a.spring({"1:x": 1.0}, bed * hertz(rng.uniform(8, 30)))
    a.spring(between("3:rx", "2:rx"), motor * hertz(rng.uniform(200, 600)))
    a.spring({"4:x": 1.0, "1:x": -1.0, "3:rx": -lead}, table_m * hertz(rng.uniform(60, 200)))
    a.spring(between("5:x", "4:x"), part * hertz(rng.uniform(30, 120)))
    slides = [{"2:rx": 1.0, "3:rx": 1.0, "4:x": lead, "5:x": lead}]
    ports = fx.Ports(
        w=[fx.Disturbance("chip", at="5:x", asd=0.1), fx.Disturbance("ground", at="1:x", asd=0.1)],
        u=[fx.Actuator("torque", at="2:rx", asd=10 ** rng.uniform(-4, -2))],
        z=[fx.Poi("work", at=between("5:x", "1:x"), axes=("x",))],
        y=[
            fx.Sensor("rotary", at="2:rx", asd=10 ** rng.uniform(-7, -5.5)),
            fx.Sensor("scale", at=between("4:x", "1:x"), asd=10 ** rng.uniform(-9.5, -8)),
        ],
        references=[fx.Reference("work")],
    )
    return sampled(rng, a.model(slides), ports, (2e3, 8e3))


def maglev(rng):
    """A free block of six axes with flexible parts on it, pushed by six to eight actuators."""
    size = rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.6), rng.uniform(0.03, 0.09)
    block = fx.solid_block(
        size=size,
        elements=(3, 3, 1),
        density=rng.uniform(2300, 2900),
        youngs_modulus=rng.uniform(60e9, 100e9),
        poisson_ratio=0.25,
    )
    x, y, h = size
    over = rng.random() < 0.5
    up = [(0.15 * x, 0.15 * y), (0.85 * x, 0.15 * y), (0.15 * x, 0.85 * y), (0.85 * x, 0.85 * y)]
    up = up if over else up[:3]
    pushes = {f"lift{i}": ((*p, 0.0), "z") for i, p in enumerate(up)}
    pushes |= {
        "left": ((0.0, y / 3, h), "x"),
        "front": ((x / 3, 0.0, h), "y"),
        "back": ((2 * x / 3, y, h), "y"),
    }
    seen = {
        "c1": ((0.0, 0.0, h), "z"),
        "c2": ((x, 0.0, h), "z"),
        "c3": ((0.0, y, h), "z"),
        "ix": ((0.0, y / 3, h), "x"),
        "iy1": ((x / 3, 0.0, h), "y"),
        "iy2": ((2 * x / 3, 0.0, h), "y"),
    }
    place = (rng.uniform(0.35, 0.65) * x, rng.uniform(0.35, 0.65) * y, h)
    led = ("x", "y", "rz") if rng.random() < 0.5 else SIX
    ports = fx.Ports(
        u=[
            fx.Actuator(n, at=p, direction=d, asd=10 ** rng.uniform(-4, -3))
            for n, (p, d) in pushes.items()
        ],
        z=[fx.Poi("chuck", at=place, axes=SIX)],
        y=[
            fx.Sensor(n, at=p, direction=d, asd=10 ** rng.uniform(-12, -10))
            for n, (p, d) in seen.items()
        ],
        references=[fx.Reference("chuck", axes=led)],
    )
    modes = fx.solve_modes(
        block, count=int(rng.integers(12, 20)), damping=fx.ModalDamping(rng.uniform(0.003, 0.01))
    )
    rate, delay = round(rng.uniform(5e3, 20e3), -2), round(rng.uniform(0.0, 2.0), 2)
    return fx.assemble_plant(modes, ports).discretized(rate, delay=delay)


KINDS = {
    "gantry": gantry,
    "dual stroke": dual_stroke,
    "mirror": mirror,
    "joint": joint,
    "table": table,
    "hexapod": hexapod,
    "screw": screw,
    "maglev": maglev,
}
