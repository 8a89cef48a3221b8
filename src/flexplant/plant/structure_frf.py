"""frequency_response: of a system, and of a structure between its ports without a plant."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, overload

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..arrays import ComplexArray, FloatArray, instance, positive, real_array, whole
from ..errors import ModelError, counted, warn
from ..lti.frequency import Frf
from ..lti.frequency import frequency_response as system_response
from ..lti.frequency_sweep import sampled_freq
from ..lti.response_solvers import responses
from ..lti.statespace import StateSpace, System
from ..modes import Modes
from ..modes.dynamic_basis import DynamicBasis, checked_response
from ..modes.solve import modes_reaching
from ..modes.sparse_modes import held_factor
from ..parallel import Progress
from ..reduction import ReducedModel
from ..store import checked
from ..structure import Damping, FEModel
from .building import port_rows
from .ports import Ports
from .realisation import Structure, none, plant_modes

#: fields: a number at each frequency of the check
_CHECKED = checked(real_array, shape=("check_freq",))


@dataclass(frozen=True, eq=False, repr=False)
class StructureFrf(Frf):
    """Responses of a structure between its ports, with the error that direct solutions found.

    Parameters
    ----------
    freq, data, inputs, outputs, quantity, coherence, variance, correlation, resolution
        As for `Frf`.
    window, overlap, freedom, units : as for `Frf`
    route : str
        Method by which the responses were computed.
    check_freq : (c,) array [Hz]
        Frequencies at which ``(K - omega^2 M + i omega D) q = f`` was solved with the full
        matrices.
    error : (c,) array
        Error of the worst channel at each of these frequencies, relative to the largest magnitude
        of this channel over all frequencies.
    error_there : (c,) array
        Error of the worst channel, relative to its own magnitude at this frequency.

    Examples
    --------
    >>> import flexplant as fx
    >>> two = fx.chain(masses=[1, 2], stiffnesses=[5e4])
    >>> ports = fx.Ports(u=[fx.Actuator("u1", "1:x", "x")], y=[fx.Sensor("y1", "2:x", "x")])
    >>> found = fx.frequency_response(two, ports, [10.0, 40.0], damping=fx.ModalDamping(0.01))
    >>> type(found).__name__, bool(found.error.max() < 1e-9)
    ('StructureFrf', True)
    """

    route: str = ""
    check_freq: FloatArray = field(
        default_factory=none, metadata=checked(real_array, shape=(None,))
    )
    error: FloatArray = field(default_factory=none, metadata=_CHECKED)
    error_there: FloatArray = field(default_factory=none, metadata=_CHECKED)

    def __repr__(self) -> str:
        lines = [super().__repr__()[:-1], f"by {self.route}"]
        if self.check_freq.size:
            lines.append(
                f"direct solutions at {self.check_freq.size} frequencies differ by "
                f"{self.error.max():.1g} of the peak, {self.error_there.max():.1g} of the "
                "response there"
            )
        return "\n  ".join(lines) + ">"


@overload
def frequency_response(
    model: System, ports: npt.ArrayLike | None = None, freq: npt.ArrayLike | None = None
) -> Frf: ...


@overload
def frequency_response(
    model: Structure,
    ports: Ports,
    freq: npt.ArrayLike,
    *,
    damping: Damping | None = None,
    checks: int = 4,
    tolerance: float = 1e-4,
) -> StructureFrf: ...


def frequency_response(
    model: Any,
    ports: Any = None,
    freq: Any = None,
    *,
    damping: Damping | None = None,
    checks: int = 4,
    tolerance: float = 1e-4,
) -> Frf:
    """Return the responses of a structure between its ports, or of a system.

    ``frequency_response(model, ports, freq)`` returns the responses from all disturbances and
    actuators to all POIs and sensors, with their filters and latencies. A large FEModel is not
    solved frequency by frequency: its responses are computed in a basis of modes and static
    responses. The modes go up to 1.5 times the last frequency of `freq`; the static responses are
    those to unit loads at all inputs and outputs. This basis is checked by direct solutions with
    the full matrix ``K + i omega D - omega^2 M`` at a few frequencies: at resonances, at
    antiresonances, at the ends of the band, and at random ones. Where the two differ by more than
    `tolerance`, the direct solution is added to the basis.

    ``frequency_response(system, freq)`` returns ``C (s I - A)^-1 B + D``; see
    `flexplant.lti.frequency_response`.

    Parameters
    ----------
    model : FEModel, Modes or ReducedModel; or StateSpace
        The structure or the system. If modes of an FEModel that `solve_modes` found are still in
        memory, they are used again.
    ports : Ports
        Channels of a structure. For a system, `freq` is the second argument instead.
    freq : (n_freq,) array [Hz]
        Frequencies, increasing. For a system, None uses those of `default_freq`.
    damping : Damping, optional
        Damping of an FEModel, in place of its D. `Rayleigh` damping is used as a matrix. Modal
        damping applies to the modes and static responses of the basis; all other motions have the
        damping of the last mode.
    checks : int
        Number of direct solutions of an FEModel that check the modes; 0 for none.
    tolerance : float
        Largest allowed difference, relative to the largest response of a channel.

    Returns
    -------
    Frf
        Response; for a structure it is a `StructureFrf`, with the error that was found.

    Raises
    ------
    ModelError
        When a response is infinite at one of the frequencies, the ports have no inputs or no
        outputs, or the arguments do not fit together.
    SolverError
        When a direct solution is spoilt by rounding.

    Warns
    -----
    FlexplantWarning
        When the error found stays above the tolerance.

    Examples
    --------
    >>> from flexplant.structure import ModalDamping, chain
    >>> from flexplant.plant import Actuator, Sensor
    >>> two = chain(masses=[1, 2], stiffnesses=[5e4])
    >>> ports = Ports(u=[Actuator("u1", "1:x", "x")], y=[Sensor("y1", "2:x", "x")])
    >>> found = frequency_response(two, ports, [10.0, 20.0, 40.0], damping=ModalDamping(0.01))
    >>> found.route, bool(found.error.max() < 1e-9)
    ('2 modes and 0 static shapes', True)
    """
    if not isinstance(model, FEModel | Modes | ReducedModel):
        if ports is not None and freq is not None:
            raise ModelError(
                f"ports go with a structure, got {type(model).__name__}: a system has channels of "
                "its own. Call frequency_response(system, freq)."
            )
        return system_response(model, ports if freq is None else freq)
    instance(ports, Ports, "ports", "Call frequency_response(model, ports, freq).")
    if freq is None:
        raise ModelError("freq is missing: call frequency_response(model, ports, freq), in Hz.")
    if damping is not None:
        instance(damping, Damping, "damping", "Pass ModalDamping(0.01) for 1 %.")
        if not isinstance(model, FEModel):
            raise ModelError(
                f"{type(model).__name__} are damped already: damping= is for an FEModel. Leave it "
                "out."
            )
    grid = sampled_freq(freq, 0.0)
    through = _PortChannels(model, ports)
    through.check_start(grid)
    if not isinstance(model, FEModel):
        data = through.seen(grid, _realised(model, grid, through.rows, through.loads))
        route = f"all modes of the {type(model).__name__}"
        return through.frf(grid, data, route=route)
    limit, most = positive(tolerance, "tolerance"), whole(checks, "checks", minimum=0, maximum=1000)
    rows, loads = through.rows, through.loads
    advice = "A lower last frequency needs fewer modes; those that you hold are used again."
    with Progress(0, "frequency response", advice=advice):
        modes = modes_reaching(model, float(grid.max(initial=0.0)))
        factor = held_factor(model)  # one for the static shapes and the check
        basis = DynamicBasis(model, modes, np.hstack([loads, rows.T]), damping)
        basis, data, check = checked_response(
            basis, grid, rows, loads, checks=most, tolerance=limit, seen=through.seen
        )
        del factor
    if check.freq.size and not check.holds(limit):
        warn(
            f"the responses of {model!r:.60} are not good to {limit:g}: {check}. Give more modes, "
            "solve_modes(model, below=...), which are used while you hold them."
        )
    return through.frf(
        grid,
        data,
        route=f"{counted(basis.n_modes, 'mode')} and {counted(basis.n_shapes, 'static shape')}",
        check_freq=check.freq,
        error=check.of_peak,
        error_there=check.there,
    )


class _PortChannels:
    """The channels of ports over the coordinates of a model: loads, rows, filters, latencies."""

    def __init__(self, model: Structure, ports: Ports) -> None:
        own = port_rows(_all_motions(model), ports)
        self.inputs, self.outputs, self.units = own.inputs, own.outputs, ports.units
        seen_as = {sensor.quantity for sensor in ports.y} | {"displacement" for _ in ports.z}
        self._quantity = seen_as.pop() if len(seen_as) == 1 else None
        self.loads = own.push.T
        n = self.loads.shape[0]
        # rows of displacements, and the channel and the time derivative that each is part of
        rows = np.array([one.row.reshape(3, n) for one in own.seen])
        self._channel, self._derivative = np.nonzero(rows.any(axis=2))
        self.rows = rows[self._channel, self._derivative]
        self._carried = np.array([one.carried for one in own.seen]) @ own.ground.T
        self._orders, self._added = np.array(own.orders), own.added
        late = ports.latencies
        pois = len(own.seen) - len(ports.y)
        self._before = [(port.filter, late.get(port.name, 0.0)) for port in ports.forces]
        self._after: list[tuple[StateSpace | None, float]] = [(None, 0.0)] * pois
        self._after += [(s.filter, late.get(s.name, 0.0)) for s in ports.y]
        self._free = bool(getattr(model, "n_rigid", 0))
        if isinstance(model, FEModel | ReducedModel):
            self._free = model.rigid_body.shape[1] > 0

    def frf(self, freq: FloatArray, data: ComplexArray, **found: Any) -> StructureFrf:
        """Return responses (f, p, q) of the channels as an Frf."""
        return StructureFrf(
            freq,
            np.moveaxis(data, 0, 2),
            inputs=self.inputs,
            outputs=self.outputs,
            units=self.units,
            quantity=self._quantity,
            **found,
        )

    def check_start(self, freq: FloatArray) -> None:
        """Refuse 0 Hz where a response is infinite there."""
        moving = np.any(self._carried[self._orders < 2])
        if freq.size and freq[0] == 0 and (self._free or moving):
            raise ModelError(
                "a structure that is free, or moves with the ground, has no response at 0 Hz. "
                "Begin above it."
            )

    def seen(self, freq: FloatArray, response: ComplexArray) -> ComplexArray:
        """Return the responses (f, p, q) of the channels, of those of the displacement rows."""
        s = 2j * np.pi * freq
        found = np.zeros((freq.size, *self._carried.shape), dtype=np.complex128)
        for i, (channel, order) in enumerate(zip(self._channel, self._derivative, strict=True)):
            found[:, channel] += s[:, None] ** order * response[:, i]
        for i in np.flatnonzero(np.any(self._carried, axis=1)).tolist():
            found[:, i] += s[:, None] ** (self._orders[i] - 2) * self._carried[i]
        after = np.array([_passed(*part, freq) for part in self._after])
        before = np.array([_passed(*part, freq) for part in self._before])
        return np.asarray((found + self._added) * after.T[:, :, None] * before.T[:, None])


def _all_motions(model: Structure) -> Any:
    """Return what ports read of a realisation, with the states (q, dq/dt, d2q/dt2) of all DOFs."""
    n = model.row(model.full_dofs.labels[0]).size
    nothing: Any = sp.csr_array((n, 3 * n))

    def motion(row: FloatArray, derivative: int) -> FloatArray:
        whole_row = np.zeros((3, n))
        whole_row[derivative] = row
        return whole_row.ravel()

    return SimpleNamespace(
        model=model,
        row=model.row,
        load=lambda forces: forces,
        inputs=nothing,
        outputs=nothing,
        motion=motion,
        at_once=lambda row: np.zeros(n),
        once=lambda key, found: found(),
    )


def _passed(part: StateSpace | None, latency: float, freq: FloatArray) -> ComplexArray:
    """Return the response (f,) of a filter and a delay."""
    late = np.exp(-2j * np.pi * freq * latency)
    return np.asarray(late if part is None else late * responses(part, freq)[0, 0])


def _realised(
    model: Modes | ReducedModel, freq: FloatArray, rows: FloatArray, loads: FloatArray
) -> ComplexArray:
    """Return the responses (f, p, q) of a model by its modes."""
    own = plant_modes(model)
    system = StateSpace(
        own.A,
        np.array([own.force(load) for load in loads.T]).T,
        own.motion(rows, 0),
        (rows @ own.static_outputs) @ (own.static_inputs.T @ loads),
        blocks=own.blocks,
    )
    return np.moveaxis(responses(system, freq), 2, 0)
