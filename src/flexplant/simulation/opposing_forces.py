"""Actuators that push against each other at the end of a run, with forces that move nothing."""

from __future__ import annotations

import numpy as np

from ..checks import FloatArray
from ..errors import some_names, warn
from ..loop import ClosedLoop
from ..plant.axes import opposing_part
from .response import Response

#: part of a run at its end in which forces are compared with their mean, and its fewest samples
_END, _FEWEST = 0.1, 20
#: steady force that is worth a warning, relative to the largest force of any actuator in the run
_SHARE = 0.05
#: times the standard deviation at the end, below which a mean is not called steady
_STEADY = 3.0


def warn_of_opposing_forces(loop: ClosedLoop, run: Response) -> None:
    """Warn of steady forces at the end of a run that move none of the axes of the POIs."""
    # whatever the run does, these forces only heat the actuators and bend what is between them
    count = max(_FEWEST, round(_END * run.time.size))
    if not loop.machine.ports.z or len(loop.driven) < 2 or run.time.size <= count:
        return
    efforts = np.stack([np.atleast_2d(run[name]) for name in loop.driven])  # (m, runs, n_time)
    most = np.abs(efforts).max(axis=(0, 2))
    end = efforts[..., -count:]
    mean = end.mean(axis=2)
    if not np.any(np.abs(mean) > _SHARE * most):
        return
    mean = opposing_part(loop.machine, loop.driven, mean)
    # the deviation of this part: of forces that move the machine there may be more
    about = opposing_part(loop.machine, loop.driven, end.reshape(len(end), -1)).reshape(end.shape)
    steady = np.abs(mean) > np.maximum(_SHARE * most, _STEADY * about.std(axis=2))
    opposed = np.sum(steady, axis=0) > 1  # no actuator pushes against another alone
    if np.any(opposed):
        worst = int(np.argmax(np.where(opposed, np.abs(mean).max(axis=0), -np.inf)))
        warn(_said(loop, mean[:, worst], steady[:, worst], float(most[worst])))


def _said(loop: ClosedLoop, mean: FloatArray, steady: FloatArray, most: float) -> str:
    """Return the warning of steady forces (m,), with the largest force of the run."""
    units = loop.units
    names = [
        f"{name} with {mean[i]:.3g} {units.get(name, '')}".rstrip()
        for i, name in enumerate(loop.driven)
        if steady[i]
    ]
    return (
        f"at the end of the run actuators keep pushing against each other: {some_names(names)}. "
        f"These forces move none of the POIs' axes; the largest force of the run is {most:.3g}. "
        "Command the actuators together (design_servo, fx.plant.driven_axes), correct the offsets "
        "and scales of their sensors, or give the difference of the forces a weight."
    )
