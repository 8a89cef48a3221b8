"""A machine of which no body is free: an H-gantry on a frame with soft feet, from plant to move.

Two motors push a bridge against the frame, a third the carriage on it, and all of them shake the
frame that their encoders stand on. What is controlled are the axes that the motors move: the tool's
x and y beside the frame, and the bridge's skew.

It prints what the servo and H-infinity reach, and what feedforward leaves of the error of a move::

                |S| < 1 up to  max |S|  max |S| at u
    servo              4.9 Hz   3.3 dB        6.0 dB
    H-infinity         6.9 Hz   5.2 dB        5.5 dB

    peak error of the tool in the move, feedforward none: 401 um
    peak error of the tool in the move, feedforward at rest: 4.61 um
"""

from __future__ import annotations

from typing import Any

import flexplant as fx

BANDWIDTH = 6.0  # Hz, of the H-infinity design
MOVE = {"velocity": 0.05, "acceleration": 0.5, "jerk": 10.0, "snap": 400.0}  # of 20 mm


# %% The plant and its axes
def axes_of(plant: fx.StandardPlant) -> fx.plant.DrivenAxes:
    """Return the axes and how forces reach them, decoupled on the real axis."""
    return fx.plant.driven_axes(plant, freq=BANDWIDTH)


# %% Loops
def servo_loop(plant: fx.StandardPlant, observer: Any) -> tuple[float, fx.ClosedLoop]:
    """Return the largest bandwidth of a servo, and its loop."""
    reach = fx.servo_bandwidth(plant, observer=observer)
    servo = fx.design_servo(plant, bandwidth=reach, observer=observer)
    return reach, fx.close_loop(plant, observer, servo)


def hinf_loop(plant: fx.StandardPlant) -> fx.ClosedLoop:
    """Return the H-infinity loop, which reads errors at the encoders."""
    errors = fx.reference_errors(plant)
    weights = fx.stage_weights(plant, BANDWIDTH)
    controller = fx.design_hinf(plant.through(errors).weighted(weights))
    return fx.close_loop(plant, errors, controller)


# %% A move along y: forces from its derivatives
def errors_of_a_move(loop: fx.ClosedLoop) -> dict[str, float]:
    """Return the peak errors [m] of the tool along y, without feedforward and with it."""
    plant = loop.plant
    move = fx.setpoint(20e-3, **MOVE, rate=1.0 / plant.dt)
    forward = {
        "none": (),
        "at rest": (fx.design_feedforward(loop, reference="tool_y:ref"),),
        "of the move": (fx.design_feedforward(loop, reference="tool_y:ref", move=move),),
    }
    found = {}
    for name, blocks in forward.items():
        fed = fx.close_loop(plant, *loop.blocks, *blocks)
        run = fx.simulate(fed, reference={"tool_y:ref": move}, duration=1.2, noise=False)
        found[name] = float(run.peak("tool_y:error"))
    return found


# %% The run
def main() -> dict[str, Any]:
    """Return what is printed and pinned by the tests."""
    plant = fx.testbeds.gantry()
    observer = fx.design_kalman(plant)
    reach, servo = servo_loop(plant, observer)
    return {
        "axes": axes_of(plant),
        "reach": reach,
        "servo": servo,
        "hinf": hinf_loop(plant),
        "errors": errors_of_a_move(servo),
    }


if __name__ == "__main__":
    outcome = main()
    print(outcome["axes"])
    print(f"the servo holds 6 dB up to {outcome['reach']:.3g} Hz")
    both = {"servo": outcome["servo"], "H-infinity": outcome["hinf"]}
    print(fx.compare_loops(both, reference="tool_y:ref"))
    for name, size in outcome["errors"].items():
        print(f"peak error of the tool in the move, feedforward {name}: {1e6 * size:.3g} um")
