"""What a plant makes of the compliance beyond its modes: fast states, or a feedthrough."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from ..checks import Value, checked, instance, positive
from ..errors import ModelError, warn
from .realisation import MODAL, ModalRealisation, Structure, realise


class ResidualForm(Value):
    """How the residual compliance of a reduction appears in a plant."""

    @abstractmethod
    def applied(self, realisation: ModalRealisation) -> ModalRealisation:
        """Return the realisation in this form."""


@dataclass(frozen=True, eq=False)
class FastStates(ResidualForm):
    """Attachment vectors stay modes of their own, at their own high frequencies (the default).

    The plant stays strictly proper between forces and displacements, so that it can be sampled
    without delay, filtered for white forces and simulated; it costs two states a vector.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.FastStates()
    FastStates()
    """

    def applied(self, realisation: ModalRealisation) -> ModalRealisation:
        """Return the realisation unchanged."""
        return realisation


@dataclass(frozen=True, eq=False)
class Feedthrough(ResidualForm):
    """Attachment vectors, or all modes above a frequency, become their static flexibility.

    Displacements then answer forces at once: D12, D22 and D11 hold ``phi phi' / omega^2`` of what
    was left out. Velocities and accelerations of that part are left out, being zero below its
    frequencies. White forces then reach displacements directly (a sample would have infinite
    variance: shape them for Kalman filters and simulation), and a simulation needs the delay of
    at least a sample that every machine has.

    Parameters
    ----------
    above : float [Hz], optional
        Also the modes above this frequency; only the attachment vectors when not given.

    Raises
    ------
    ModelError
        When above is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses(rate=None).assembled
    >>> fx.plant.Feedthrough(above=1e3)
    Feedthrough(above=1000.0)
    """

    above: float | None = field(default=None, metadata=checked(positive))

    def applied(self, realisation: ModalRealisation) -> ModalRealisation:
        """Return the realisation with its fast pairs replaced by their static gain.

        Raises
        ------
        ModelError
            When nothing would be replaced, or everything.
        """
        b = realisation.pairs.shape[0]
        fast = np.array([name.startswith("residual") for name in realisation.names[::2]])
        if self.above is not None:
            omega = np.sqrt(np.abs(np.linalg.det(realisation.pairs)))
            fast |= omega > 2.0 * np.pi * self.above
        if not fast.any() or fast.all():
            which = "attachment vectors" if self.above is None else f"modes above {self.above:g} Hz"
            raise ModelError(
                f"the model has {'nothing but' if fast.any() else 'no'} {which}: "
                "fx.plant.Feedthrough(above=...) says which modes become static, and "
                "solve_modes(..., compliance_at=...) keeps the compliance of those left out."
            )
        n = realisation.outputs.shape[0]
        pairs = realisation.pairs[fast]
        see = realisation.outputs.reshape(n, b, 2)[:, fast].reshape(n, -1)
        push = realisation.inputs.reshape(n, b, 2)[:, fast]
        settled = -np.einsum("bij,nbj->nbi", np.linalg.inv(pairs), push).reshape(n, -1)
        kept = np.repeat(~fast, 2)
        coupling = realisation.coupling
        if coupling is not None:
            # damping between a mode that stays and one that answers at once is left out with it
            coupling = coupling[np.ix_(~fast, ~fast)]
        return replace(
            realisation,
            pairs=realisation.pairs[~fast],
            inputs=realisation.inputs[:, kept],
            outputs=realisation.outputs[:, kept],
            names=tuple(n for n, keep in zip(realisation.names, kept, strict=True) if keep),
            static_outputs=np.hstack([realisation.static_outputs, see]),
            static_inputs=np.hstack([realisation.static_inputs, settled]),
            coupling=coupling,
        )


def plant_modes(
    model: Structure | ModalRealisation, residual: ResidualForm | None = None
) -> ModalRealisation:
    """Return the modes of a structure as a plant takes them; FastStates where nothing is given."""
    way = FastStates() if residual is None else residual
    instance(way, ResidualForm, "residual", "Pass fx.plant.FastStates() or fx.plant.Feedthrough().")
    realisation = realise(model)
    if realisation.form != MODAL and realisation is not model:
        warn(
            f"this plant is not in modal blocks but {realisation.form}. It is exact all the same; "
            "the damping couples its modes, so that what costs O(n) a frequency or sample costs "
            "O(n^2) or more, and mode by mode uncertainty is not defined. See plant.form."
        )
    return way.applied(realisation)
