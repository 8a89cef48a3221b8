"""Every design, score, simulation and export on channels whose names inner code might use too."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx

syn, est, pl, sim = fx.synthesis, fx.estimation, fx.placement, fx.simulation
#: names of: disturbance, two actuators, two sensors, POI
NAMES = [
    ("v", "y1", "z1", "u1", "w1", "e"),
    ("u1", "x", "w1", "z1", "z2", "s"),
    ("w1", "s", "q", "z1", "x", "d"),
    ("y1", "e", "z2", "s", "v", "z1"),
    ("d0", "in", "error", "out", "z1", "zu0"),
    ("p1", "w1", "w1|", "z1", "z1|", "x"),
    ("x|loop", "y", "y|applied", "x", "v", "z"),
]
LAW = fx.Pid(1e3) * fx.Lead(20.0) * fx.LowPass(200.0)
MOVE = fx.setpoint(1e-6, velocity=1e-3, acceleration=0.1, jerk=10.0)


@cache
def modes():
    masses = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    return fx.solve_modes(masses, count=3, damping=fx.ModalDamping(0.01))


class Case:
    """Three masses, pushed and seen at both ends, with names of a user's."""

    def __init__(self, names):
        self.amp, self.u1, self.u2, self.y1, self.y2, self.die = names
        self.ports = fx.Ports(
            w=[fx.Disturbance(self.amp, at="1:x", asd=1e-3)],
            u=[fx.Actuator(self.u1, at="1:x"), fx.Actuator(self.u2, at="3:x")],
            z=[fx.Poi(self.die, at="2:x", axes=("x",))],
            y=[fx.Sensor(n, at=p, asd=1e-10) for n, p in ((self.y1, "1:x"), (self.y2, "3:x"))],
            references=[fx.Reference(self.die)],
        )
        self.plant = fx.assemble_plant(modes(), self.ports).discretized(2e3, delay=1)
        self.observer = fx.design_kalman(self.plant.replace(evaluation=modes()))
        self.servo = fx.design_servo(self.plant, bandwidth=20.0, observer=self.observer)
        self.loop = fx.close_loop(self.plant, self.observer, self.servo)
        self.run = fx.simulate(self.loop, duration=0.6, rng=1)
        efforts = {f"{name}:effort": 1.0 for name in self.plant.u}
        noises = {f"{name}:noise": 1e-8 for name in (self.y1, self.y2)}
        given = {self.amp: 1e-3, f"{self.die}:ref": 1e-7}
        self.weighted = self.plant.weighted(
            z={f"{self.die}:x": 1e6, f"{self.die}:error": 1e6, **efforts}, w=given | noises
        )
        self.h2 = fx.design_h2(self.weighted)
        self.g = self.plant.Gyu.select(outputs=[self.y1, self.y2])
        free = [n for n in ("w2", "p2", "x1") if n not in names]
        at = {n: {"at": f"{i}:x", "direction": "x"} for i, n in enumerate(free, 1)}
        self.sensors = [fx.Sensor(n, **place, asd=1e-10) for n, place in at.items()]
        self.actuators = [fx.Actuator(n, **place) for n, place in at.items()]

    def stage(self):
        weights = fx.stage_weights(self.plant, 20.0)
        errors = fx.reference_errors(self.plant)
        return self.plant.through(errors).weighted(z=weights.z, w=weights.w)

    def uncertain(self):
        poles = modes().omega[1:] * (-0.01 + 1j)
        measured = fx.MeasuredModes(poles, modes=[2, 3], covariance=1e-2 * np.eye(4))
        return self.plant.uncertain(measured)

    def level(self):
        def level(plant):
            z = dict.fromkeys(plant.z) | {f"{self.die}:x": 1e6}
            z |= {name: 0.1 for name in z if name.endswith(":effort")}
            w = dict.fromkeys(plant.w) | {self.amp: 1.0}
            w |= {name: 1e-9 for name in w if name.endswith(":noise")}
            read = [name for name in plant.y if w.get(name, 1.0) is not None]
            sums = fx.StateSpace([], [], [], np.eye(len(read)), plant.dt, inputs=read, outputs=read)
            return fx.design_hinf(plant.weighted(z=z, w=w).through(sums)).gamma

        return level


USES = {
    "hinf": lambda c: fx.design_hinf(c.weighted),
    "hinf, unweighted": lambda c: fx.design_hinf(c.plant),
    "hinf of a stage": lambda c: fx.design_hinf(c.stage()),
    "hinf with added noise": lambda c: fx.design_hinf(
        c.plant.weighted(z={f"{c.die}:x": 1e6}, w={c.amp: 1e-3})
    ),
    "hinf of a foreign system": lambda c: fx.design_hinf(
        c.weighted.system.to_control(), u=list(c.plant.u), y=list(c.plant.y)
    ),
    "hinf of mixed sensitivity": lambda c: fx.design_hinf(
        fx.plant.mixed_sensitivity(c.g, S=1.0, KS=1e-6, T=1.0)
    ),
    "h2 of a foreign system": lambda c: fx.design_h2(c.plant.to_control()),
    "structured": lambda c: syn.design_structured(c.weighted, syn.FixedOrder(1), starts=1),
    "tuned laws": lambda c: syn.design_structured(
        c.weighted, syn.TunedLaws(LAW, free=("p",)), starts=1
    ),
    "ncf": lambda c: fx.design_ncf(c.g * 1e6),
    "loops": lambda c: fx.design_loops(c.plant, LAW),
    "robust stability": lambda c: syn.robust_stability(c.uncertain(), c.h2),
    "order": lambda c: syn.reduce_controller(c.weighted, c.h2, order=6),
    "anti-windup": lambda c: syn.anti_windup_form(c.h2, recovery=0.01),
    "sections": lambda c: syn.second_order_sections(c.h2),
    "feedforward": lambda c: fx.design_feedforward(c.plant),
    "compared": lambda c: fx.compare_loops({"z1": c.loop, "x": fx.close_loop(c.plant, c.h2)}).rows,
    "budget": lambda c: c.loop.budget(f"{c.die}:x"),
    "sensitivities": lambda c: [
        f(c.loop)
        for f in (
            fx.loop.sensitivity,
            fx.loop.complementary_sensitivity,
            fx.loop.control_sensitivity,
            fx.loop.loop_gain,
        )
    ],
    "report": lambda c: fx.loop.report_loops((c.plant, c.h2)),
    "moved": lambda c: fx.simulate(c.loop, reference=MOVE, duration=0.1, rng=1),
    "saturated": lambda c: fx.simulate(
        c.loop,
        duration=0.05,
        rng=1,
        elements={c.u1: sim.Saturation(1.0), c.y1: sim.Quantiser(1e-9)},
    ),
    "estimated": lambda c: (c.observer.estimate(c.run), c.observer.report()),
    "consistent": lambda c: est.consistency(c.observer, c.observer.estimate(c.run)),
    "noise levels": lambda c: est.estimate_noise(c.plant, c.run),
    "static": lambda c: fx.design_static(c.plant),
    "sensor scores": lambda c: fx.score_sensors(c.plant, [[c.y1], [c.y2]]),
    "actuator scores": lambda c: fx.placement.score_actuators(c.plant, [[c.u1], [c.u2]]),
    "sensors": lambda c: fx.place_sensors(c.plant, c.sensors, 1),
    "actuators by H2": lambda c: fx.place_actuators(
        c.plant, c.actuators, 1, pl.ClosedLoopH2(c.die)
    ),
    "actuators by LQR": lambda c: fx.place_actuators(c.plant, c.actuators, 1, pl.PoiLqr(c.die)),
    "sensor map": lambda c: fx.placement.sensor_map(
        c.plant, [(0, 0, 0), (2, 0, 0)], asd=1e-10, direction="x"
    ),
    "feedback": lambda c: fx.lti.feedback(c.g, np.eye(2)),
}
EXPORTS = {
    "npz": lambda c, p: [v.save(p / "v.npz") for v in (c.plant, c.observer, c.loop, c.h2)],
    "c": lambda c, p: fx.export.write_c(c.h2, p / "k.c"),
    "html": lambda c, p: fx.plot.report(p / "r.html", c.run, c.plant, c.observer),
}


def test_a_sensor_named_like_a_disturbance_is_refused():
    """It would be taken for a reference."""
    with pytest.raises(fx.errors.LabelError, match=r"ports w and y hold \['z1'\] more"):
        fx.Ports(w=[fx.Disturbance("z1", at="1:x")], y=[fx.Sensor("z1", at="3:x")])


@pytest.mark.parametrize("names", NAMES, ids="-".join)
def test_designs_are_the_same_under_any_names(names):
    """H-infinity, feedback and the loop as it is read, on one mass and a lag."""
    amp, u, _, y, _, z = names
    A, B, C = [[-1.0, 1.0], [0.0, -2.0]], np.eye(2), [[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]
    D = [[0.0, 0.0], [0.0, 1.0], [0.1, 0.0]]
    g = fx.StateSpace(A, B, C, D, inputs=[amp, u], outputs=[z, f"{u}:effort", y])
    plant = fx.StandardPlant.from_statespace(g, u=[u], y=[y])
    found = fx.design_hinf(plant)
    same = g.replace(inputs=["a", "b"], outputs=["c", "d", "e"])
    assert found.gamma == fx.design_hinf(same, u=["b"], y=["e"]).gamma
    loop = fx.close_loop(plant, found)
    assert loop.monitored.outputs[:3] == (z, f"{u}:effort", y)
    assert fx.lti.feedback(g.select([y], [u])).inputs == (u,)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::flexplant.FlexplantWarning")
@pytest.mark.parametrize("names", NAMES[6:], ids="-".join)
def test_names_of_a_user_meet_none_of_ours(names, tmp_path):
    one = Case(names)
    for use in USES.values():
        use(one)
    for export in EXPORTS.values():
        export(one, tmp_path)
    again = fx.load(tmp_path / "v.npz")
    assert again.system.inputs == one.h2.system.inputs
