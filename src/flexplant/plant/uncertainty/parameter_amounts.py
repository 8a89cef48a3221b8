"""Parameters of the model that are known within some amounts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from ...arrays import FloatArray, instance, positive
from ...errors import ModelError
from ...labels import Place
from ...lti.frequency import QUANTITIES, Quantity
from ...sparse.symmetric import dense, orthonormalised
from ...tolerances import ROUNDING
from ...updating.parameters import Parameter
from ..building import continuous_plant
from ..machine_plants import MachineParts
from ..partitioned import Partition
from ..port import ForcePort, SensorPort
from ..realisation import ModalRealisation
from .channels import Opened
from .delta import Delta, Uncertainty


@dataclass(frozen=True, eq=False)
class ParameterDelta(Delta):
    """A parameter of the model, its value plus ``scale delta``: M, D and K change."""

    parameter: Any = None
    model: Any = None

    kind: ClassVar[str] = "parameter"
    stage: ClassVar[int] = 0
    of_own_model: ClassVar[bool] = True

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine of other matrices."""
        own = self.model or machine.plant.model
        model = own if machine.model is None else machine.model
        realisation = machine.plant.assembled.realisation
        changes: dict[str, Any] = {}
        for name, part in zip("MDK", self.parameter.change(own, amount), strict=True):
            if part is None:
                continue
            moved: Any = elastic_part(own, realisation, dense(part)) if name == "D" else part
            old = getattr(model, name)
            if sp.issparse(old):
                moved = sp.csc_array(moved)
            changes[name] = moved if old is None else old + moved
        return machine.replace(model=model.replace(**changes) if changes else model)

    @property
    def text(self) -> str:
        """Name and amount at delta = 1, in the parameter's own unit."""
        return f"{self.name} +- {self.scale:.3g} {self.parameter.unit}"

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Delta]) -> Opened:
        """Return the continuous plant with channels for parameters: exact for any damping."""
        # `(M + sum d_i dM_i) q'' + (D + sum d_i dD_i) q' + (K + sum d_i dK_i) q = f`: with
        # `dM_i = U s U'` the change is the force `-U s d_i U' q''`, a feedback around the
        # (absolute) acceleration, and so for velocities and displacements. Each Delta has as many
        # channels as its matrices have rank
        realisation, ports = plant.assembled.realisation, plant.assembled.ports
        loads: list[_Load] = []
        felt: list[_Felt] = []
        sizes = []
        for one in deltas:
            before = len(loads)
            for order, (value, along) in _directions(plant.model, realisation, one):
                name = f"{one.name}:{len(loads) - before + 1}"
                size = np.sqrt(one.scale * abs(value))
                loads.append(_Load(f"{name}:w", -np.sign(value) * size * along))
                felt.append(_Felt(f"{name}:z", size * along, quantity=QUANTITIES[order]))
            sizes.append((one.name, len(loads) - before))
        wider = ports.replace(w=[*loads, *ports.w], y=[*ports.y, *felt])
        system = continuous_plant(type(plant), realisation, wider, None).system
        chosen = system.select(
            [*(port.name for port in felt), *plant.z, *plant.y],
            [*(port.name for port in loads), *plant.w, *plant.u],
        )
        return Opened(chosen, tuple(sizes))


def _directions(
    model: Any, realisation: ModalRealisation, delta: Any
) -> list[tuple[int, tuple[float, FloatArray]]]:
    """Return time derivatives (0 to 2), eigenvalues and eigenvectors of a parameter's matrices."""
    found = []
    for order, part in zip((2, 1, 0), delta.parameter.matrices(model), strict=True):
        if part is None:
            continue
        whole = dense(part)
        if order == 1:
            whole = elastic_part(model, realisation, whole)
        values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
        kept = np.flatnonzero(np.abs(values) > ROUNDING * np.abs(values).max()).tolist()
        found += [(order, (float(values[i]), vectors[:, i])) for i in kept]
    return found


@dataclass(frozen=True, eq=False)
class _Load(ForcePort):
    """A force along a vector over the model's DOFs."""

    name: str
    along: FloatArray

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the vector."""
        return self.along


@dataclass(frozen=True, eq=False)
class _Felt(SensorPort):
    """A motion along a vector over the model's DOFs; accelerations are absolute, as inertia is."""

    name: str
    along: FloatArray
    at: Place = ""
    quantity: Quantity = "displacement"

    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the vector."""
        return self.along


def elastic_part(model: Any, realisation: ModalRealisation, D: FloatArray) -> FloatArray:
    """Return what a damper does to elastic motion: rigid-body motion is undamped by convention."""
    # all of it where the plant's own dampers slow rigid-body motion down
    r = realisation.n_rigid
    coupled = realisation.coupling is not None and np.any(realisation.coupling[:r])
    if not model.rigid_body.shape[1] or coupled or np.any(realisation.pairs[:r, 1, 1]):
        return D
    rigid = orthonormalised(model.M, model.rigid_body)
    elastic = np.eye(rigid.shape[0]) - rigid @ np.asarray(model.M @ rigid).T
    return np.asarray(elastic.T @ D @ elastic)


def require_matrices(plant: Partition) -> None:
    """Raise ModelError unless the plant was assembled from a model with M, D and K."""
    if not hasattr(plant.model, "rigid_body") or not hasattr(plant.model, "replace"):
        raise ModelError(
            "parameters change the matrices of a model, and this plant was not assembled from "
            "one: assemble it from a ReducedModel or an FEModel."
        )


@dataclass(frozen=True, eq=False, repr=False)
class Parameters(Uncertainty):
    """Uncertain parameters of the model, which change all modes and mode shapes.

    The frequency or the damping of a mode may be uncertain at the same time. This changes K or D of
    the nominal plant: an uncertain frequency adds a fraction of ``omega^2 (M phi)(M phi)'`` to K,
    where phi is the mode shape and omega the natural frequency.

    Parameters
    ----------
    amounts : mapping {Parameter: float}
        Error of each parameter at delta = 1, in the unit of the parameter:
        ``{AddedMass("41:z"): 0.025}`` for 0.5 kg within 5 %.

    Raises
    ------
    ModelError
        When `amounts` is empty, a key is not a parameter, or an amount is not positive. Also when
        the plant was not assembled from a model with matrices.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0]), count=2)
    >>> model = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x"]))
    >>> ports = fx.Ports(u=[fx.Actuator("u1", at="1:x")], y=[fx.Sensor("y1", at="2:x")])
    >>> plant = fx.assemble_plant(model, ports)
    >>> plant.uncertain(fx.plant.Parameters({fx.AddedMass("2:x"): 0.05}))
    <UncertainPlant: 1 real Delta at 2 std
      mass at 2:x +- 0.05 kg>
    """

    amounts: Mapping[Parameter, float]

    def __post_init__(self) -> None:
        if not isinstance(self.amounts, Mapping) or not self.amounts:
            raise ModelError("the mapping is empty: name at least one, {AddedMass('41:z'): 0.025}.")
        for parameter in self.amounts:
            given: Any = parameter
            instance(given, Parameter, "a key of the amounts", "Such as AddedMass('41:z').")
        sizes = {p: positive(size, f"amount of {p.name}") for p, size in self.amounts.items()}
        self._set(amounts=sizes)

    def deltas(self, plant: Partition) -> list[Delta]:
        """Return a Delta for each parameter."""
        require_matrices(plant)
        return [ParameterDelta(p.name, size, parameter=p) for p, size in self.amounts.items()]
