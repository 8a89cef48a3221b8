"""Damping first and motion after: three dampers, H-infinity and an input shaper on one machine.

Run it: ``python examples/active_damping.py``. A mast of four masses stands on a base. A voice coil
and a sensor at its tip damp it, and a drive at its foot moves it. `damp_modes` tunes velocity
feedback, positive position feedback (PPF) and integral resonant control (IRC) for the same
damping ratio of the first mode. They are compared with an H-infinity controller that uses the same
coil and sensor. The plant has two of the four modes, but every loop is judged on all of them.
H-infinity leaves a smaller motion than any damper, because it uses the two modes of the plant. A
warning says that |S| is large at the machine's other modes, so that small errors of these modes
matter.

Then the mast moves. The drive gets the static force of the set-point and an integral law of 1 Hz,
which is stable with the damper and unstable without it. A set-point leaves a vibration.
`residual_vibration` predicts it from the modes of the loop and also simulates it. An input shaper
(zero vibration and derivative, ZVD) for the mode that vibrates most removes the vibration.
"""

# %% The machine: two modes in the plant, four in its evaluation model
import numpy as np

import flexplant as fx
from flexplant.simulation import input_shaper, residual_vibration
from flexplant.synthesis import ActiveDamping, damp_modes

RATE = 2000.0


def machine() -> fx.StandardPlant:
    """Return the sampled plant of the mast: coil and sensor at the tip, drive at the foot."""
    model = fx.chain(masses=[2.0, 1.0, 1.0, 1.0], stiffnesses=[4e4] * 3, ground=[4e4, 0, 0, 0])
    whole = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.005))
    ports = fx.Ports(
        w=[fx.Disturbance("wind", at="4:x", asd=1e-2)],
        u=[fx.Actuator("coil", at="4:x"), fx.Actuator("drive", at="1:x")],
        z=[fx.Poi("tip", at="4:x", axes=("x",))],
        y=[fx.Sensor("gauge", at="4:x", direction="x", asd=1e-9)],
        references=[fx.Reference("tip")],
    )
    plant = fx.assemble_plant(whole.select([0, 1]), ports, evaluation=whole)
    return plant.discretized(RATE, delay=1)


# %% Damping first
def dampers(plant: fx.StandardPlant) -> dict[str, ActiveDamping]:
    """Return a damper of each kind, tuned for the first mode."""
    kinds = ("velocity", "ppf", "irc")
    return {kind: damp_modes(plant, kind, u="coil", y="gauge", damping=0.15) for kind in kinds}


def by_hinf(plant: fx.StandardPlant, effort: float = 0.2) -> fx.Controller:
    """Return the H-infinity controller of coil and gauge: motion by wind against effort."""
    part = plant.select(u=["coil"], y=["gauge"])
    weighted = part.weighted(
        z={"tip:x": 1e4, "tip:error": None, "coil:effort": effort},
        w={"wind": 1.0, "gauge:noise": 1e-5, "tip:ref": None},
    )
    return fx.design_hinf(weighted)


def table(plant: fx.StandardPlant, found: dict[str, ActiveDamping], hinf: fx.Controller) -> str:
    """Return the peak of the tip's motion by wind and of the coil's force, and the margin."""
    rows = ["damper     tip / wind [um/N]   coil / wind [N/N]   modulus margin   all modes stable"]
    blocks = {name: one.system for name, one in found.items()} | {"H-infinity": hinf.system}
    for name, block in blocks.items():
        loop = fx.close_loop(plant, block.select(outputs=["coil"]), idle=["drive"])
        motion, force = (
            fx.hinf_norm(loop.system.select([z], ["wind"])) for z in ("tip:x", "coil:effort")
        )
        rows.append(
            f"{name:10} {1e6 * motion:17.1f} {force:19.2f} {loop.modulus_margin:16.2f}"
            f"{'yes' if loop.left_out.is_stable else 'no':>19}"
        )
    bare = fx.hinf_norm(plant.system.select(["tip:x"], ["wind"]))
    return "\n".join([*rows, f"{'none':10} {1e6 * bare:17.1f}"])


# %% Motion after
def moved(plant: fx.StandardPlant, damper: ActiveDamping) -> tuple[fx.ClosedLoop, float]:
    """Return the loop of damper and drive, and the spectral radius without the damper."""
    soft = plant.system.select(["tip:x"], ["drive"]).dcgain()  # m/N
    drive = fx.Pid(0.0, i=2.0 * np.pi / soft).sampled(RATE).system  # 1 Hz
    static = drive.D + 1.0 / soft  # the force that holds the tip at the set-point
    law = fx.StateSpace(
        drive.A, np.hstack([drive.B, -drive.B]), drive.C, np.hstack([static, -drive.D]), 1 / RATE,
        inputs=["tip:ref", "gauge"], outputs=["drive"],
    )  # fmt: skip
    loop = fx.close_loop(plant, damper, law)
    alone = fx.close_loop(plant, 0.0 * damper.system, law)
    return loop, alone.spectral_radius


def residuals(loop: fx.ClosedLoop) -> dict[str, fx.simulation.ResidualVibration]:
    """Return what a step-like move leaves, without a shaper and with one for the loudest mode."""
    move = fx.setpoint(1e-3, velocity=0.02, acceleration=2.0, jerk=200.0)
    plain = residual_vibration(loop, move)
    shaper = input_shaper(plain.freq[0], damping=plain.damping[0], kind="ZVD")
    return {"plain": plain, "ZVD": residual_vibration(loop, shaper.shaped(move))}


# %% Run it
if __name__ == "__main__":
    mast = machine()
    tuned = dampers(mast)
    print(*tuned.values(), sep="\n")
    print(table(mast, tuned, by_hinf(mast)))
    both, radius = moved(mast, tuned["velocity"])
    print(
        f"drive alone: spectral radius {radius:.5f}; "
        f"with velocity feedback {both.spectral_radius:.5f}"
    )
    for label, left in residuals(both).items():
        print(label, left)
