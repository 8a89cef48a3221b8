"""Forces of a move by the plant's regularised inverse, which acts ahead of the set-point."""

from __future__ import annotations

import numpy as np

from ..arrays import ComplexArray, FloatArray, divisor, instance, positive
from ..errors import CertificateError, ModelError, warn
from ..loop import ClosedLoop, close_loop
from ..loop.blocks import force_name
from ..lti.response_solvers import responder
from ..plant import driven_axes
from ..plant.axes import resting_frequency
from ..plant.partitioned import require_sampled
from ..tolerances import MISSED, NEGLIGIBLE
from .feedforward import design_feedforward, force_axes, known_forces, tracked
from .motion import SetPointProfile
from .sampled_runs import simulate


def inverse_forces(
    loop: ClosedLoop,
    move: SetPointProfile,
    *,
    duration: float,
    bandwidth: float,
    reference: str | None = None,
) -> dict[str, FloatArray]:
    """Return the forces that make the POI follow a set-point, by a regularised plant inverse.

    P is the response of the POI (point of interest) to the forces u, and r is the set-point. The
    forces minimise ``|r - P u|^2 + rho |u|^2``. At each frequency the solution is ``U = P* (P P* +
    rho)^-1 R`` with the spectra U of u and R of r. With u in units of acceleration, the weight rho
    is ``(2 pi bandwidth)^-4``. Far below the bandwidth the plant is therefore inverted, and far
    above it the force is zero.

    If the plant has zeros outside the stability region, its causal inverse is unstable. This is
    common for sampled plants, and for sensors away from actuators. The inverse used here is stable,
    but acts before the set-point changes (preview). All axes of the POI are included, and those
    without a reference stay at rest. If the sensors do not move like the POI, the feedback reacts
    to the move. This reaction is computed on the model and subtracted.

    Parameters
    ----------
    loop : ClosedLoop
        Loop of the controller around a model: a sampled plant, assembled from a free structure.
    move : SetPointProfile
        Move that begins with a rest. If the rest is too short for the preview, a warning is given.
    duration : float [s]
        Duration of the run.
    bandwidth : float [Hz]
        Frequency up to which the plant is inverted.
    reference : str, optional
        Channel of the reference; by default the only one of the plant.

    Returns
    -------
    dict {channel: (n_time,) array}
        Forces as arrays, named `u1:feedforward` and so on. They are references for a loop with the
        block `known_forces(plant)`.

    Raises
    ------
    LabelError, AssumptionError
        As for `design_feedforward`.
    CertificateError
        When the forces are not the minimum at one of five frequencies, computed from the plant's
        matrices.
    ModelError
        When the plant is continuous or held, `move` is not a set-point profile, or a number is not
        positive.

    Warns
    -----
    FlexplantWarning
        When forces above 0.1 % of the largest force would act before the beginning or after the end
        of the run.

    References
    ----------
    [VanZundertOomen2018]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo, fx.simulation.known_forces(plant))
    >>> move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    >>> sorted(fx.simulation.inverse_forces(loop, move, duration=0.2, bandwidth=60.0))
    ['u1:feedforward']
    """
    instance(loop, ClosedLoop, "loop", "Use close_loop(plant, ...).")
    plant, poi, axis, name = tracked(loop.machine, reference)
    instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
    require_sampled(plant, "the inverse is of samples", ModelError)
    steps = round(positive(duration, "duration") / plant.dt)
    reach = 2.0 * np.pi * positive(bandwidth, "bandwidth") * plant.dt
    axes, T = force_axes(plant)
    low = design_feedforward(plant, reference=name, order=2)
    if np.any(low.gains[:, :, :2]):
        raise ModelError(
            "the plant is held, so that it takes a force to stay away from rest: this inverse is "
            "of free machines. Use design_feedforward(plant)."
        )
    channels = list(axes)
    # effects that wrap around have three lengths to decay
    size = 1 << int(np.ceil(np.log2(4 * steps)))
    freq: FloatArray = np.asarray(np.fft.rfftfreq(size, plant.dt), dtype=np.float64)
    P = np.moveaxis(responder(plant.system.select(channels, plant.u))(freq[1:]), 2, 0) @ T
    z = np.exp(2j * np.pi * freq[1:] * plant.dt)
    second = z - 2.0 + 1.0 / z  # the second difference of a motion: finite at rest, as P s^2
    H = P * second[:, None, None]
    # in units in which a unit force accelerates its own axis by one unit per sample^2
    masses = np.abs(driven_axes(plant, freq=resting_frequency(plant)).T).sum(axis=0)
    scale = np.diag(masses / plant.dt**2)
    H = H @ scale
    damping = (np.abs(second) / reach**2) ** 2
    back = H.conj().swapaxes(1, 2)
    gram = H @ back + damping[:, None, None] * np.eye(len(axes))
    position = np.asarray(move.at((np.arange(-1, steps + 1)) * plant.dt).position)
    spectrum = np.fft.rfft(np.diff(position, 2), size)
    target = np.zeros((freq.size - 1, len(axes), 1), dtype=np.complex128)
    target[:, axes.index(poi.channel(axis)), 0] = spectrum[1:]
    U = np.zeros((freq.size, len(axes)), dtype=np.complex128)
    U[1:] = (back @ np.linalg.solve(gram, target))[:, :, 0]
    U[0] = low.gains[0, :, 2] / masses * spectrum[0].real
    for k in np.unique(np.geomspace(1, np.count_nonzero(freq <= bandwidth), 5).astype(int)) - 1:
        g, rate = plant.system.select(channels, plant.u), second[k]
        direct = g.C @ np.linalg.solve(z[k] * np.eye(g.n_states) - g.A, g.B) + g.D
        _check_minimum(
            rate * direct @ T @ scale, target[k, :, 0], U[k + 1], damping[k], freq[k + 1]
        )
    force = np.fft.irfft(U, size, axis=0) @ (T @ scale).T
    outside = float(np.max(np.abs(force[steps:])))
    if outside > NEGLIGIBLE * float(np.max(np.abs(force))):
        late = np.flatnonzero(np.max(np.abs(force), axis=1) > NEGLIGIBLE * np.abs(force).max())
        ahead = (size - late[late > size // 2].min(initial=size)) * plant.dt
        warn(
            f"forces up to {outside:.3g} N fall outside the run and are cut off: the inverse acts "
            f"{ahead:.3g} s before the run begins, or after it ends. Give the set-point a longer "
            "rest and the run more time, or lower the bandwidth."
        )
    own = force[:steps] - _feedback(loop, force[:steps], move, name)
    return {force_name(actuator): own[:, i] for i, actuator in enumerate(plant.u)}


def _check_minimum(
    H: ComplexArray, target: ComplexArray, U: ComplexArray, damping: float, freq: float
) -> None:
    """Refuse forces at which the gradient of ``|target - H U|^2 + damping |U|^2`` is not zero."""
    back = H.conj().T
    off = float(np.linalg.norm(back @ (target - H @ U) - damping * U))
    alone = float(np.linalg.norm(back @ target))
    if not off <= MISSED * alone:
        raise CertificateError(
            f"forces do not minimise the error at {freq:.4g} Hz: from the plant's matrices the "
            f"gradient is {off / divisor(alone):.2g} of its value without forces."
        )


def _feedback(loop: ClosedLoop, force: FloatArray, move: SetPointProfile, name: str) -> FloatArray:
    """Return what the controller adds (n_time, nu) while these forces move its own plant."""
    plant = loop.machine.replace(evaluation=None)
    names = [force_name(u) for u in plant.u]
    alone = close_loop(plant, known_forces(plant))
    given = {one: force[:, i] for i, one in enumerate(names)}
    duration = len(force) * plant.dt
    run = simulate(alone, reference={**given, name: move}, duration=duration, noise=False)
    # a loop that passes forces on already would count them twice
    passed = {name for block in loop.blocks for name in block.inputs}
    more = () if passed.issuperset(names) else (known_forces(plant),)
    both = close_loop(plant, *loop.blocks, *more)
    law, x = both.controller, np.zeros(both.controller.n_states)
    sensed = [one for one in plant.y if one not in names]
    y_at, f_at = law.input_index(sensed), law.input_index(names)
    rows = law.output_index(plant.u)
    read = np.array([run[one] for one in sensed]).T
    direct = np.linalg.inv(law.D[np.ix_(rows, f_at)])
    known = np.zeros_like(force)
    for k, y in enumerate(read):
        # the force in addition to the controller's own that makes the sum what is wanted
        known[k] = direct @ (force[k] - law.C[rows] @ x - law.D[np.ix_(rows, y_at)] @ y)
        x = law.A @ x + law.B[:, y_at] @ y + law.B[:, f_at] @ known[k]
    return force - known
