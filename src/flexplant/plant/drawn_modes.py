"""Modes of a machine whose mass and stiffness differ from those of a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray
from ..labels import Place
from .realisation import ModalRealisation, modes_as_states, natural


@dataclass(frozen=True, eq=False, repr=False)
class DrawnModes(ModalRealisation):
    """Modes of a drawn machine over columns (n, c) of DOFs, which all machines share."""

    over: FloatArray = None  # type: ignore[assignment]

    def row(self, at: Place, direction: str) -> FloatArray:
        """Return the row (c,) over the columns for a place."""
        return self.load(super().row(at, direction))

    def load(self, forces: FloatArray) -> FloatArray:
        """Return forces on the model's DOFs over the columns."""
        return np.asarray(forces @ self.over)


class ModeSpace:
    """The modes of a realisation that may be mixed, and the blocks that stay as they are.

    Mixed are rigid-body motions and real modes that swing. Modes with complex shapes, overdamped
    and unstable ones keep their shapes.
    """

    def __init__(self, whole: ModalRealisation) -> None:
        omega, zeta = natural(whole.pairs)
        r = self.n_rigid = whole.n_rigid
        mixed = (omega > 0.0) & (zeta < 1.0) & ~np.any(whole.inputs[:, ::2], axis=0)
        mixed[:r] = True
        self.whole, self.own, self.rest = whole, np.flatnonzero(mixed), np.flatnonzero(~mixed)
        self.omega, self.zeta = omega[self.own], zeta[self.own]
        self.omega[:r] = 0.0
        self.shapes: FloatArray = np.ascontiguousarray(whole.inputs[:, 1::2][:, self.own])
        self._others = np.repeat(2 * self.rest, 2) + np.tile([0, 1], self.rest.size)
        fixed = (
            whole.inputs[:, self._others],
            whole.outputs[:, self._others],
            whole.static_inputs,
            whole.static_outputs,
        )
        self.over: FloatArray = np.hstack([self.shapes, *fixed])

    def mixed(self, M: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return omega (b,) and shapes (b, b) of mass and stiffness over the modes that mix.

        None where either is not positive.
        """
        r = self.n_rigid
        try:
            values, V = la.eigh(K, M)
            V[:, :r] = 0.0
            V[:r, :r] = la.inv(la.cholesky(M[:r, :r])) if r else 0.0
        except la.LinAlgError:
            return None
        if values.size > r and values[r] <= 0.0:
            return None
        return np.append(np.zeros(r), np.sqrt(values[r:])), V

    def realisation(
        self, omega: FloatArray, zeta: FloatArray, V: FloatArray, rest: FloatArray
    ) -> DrawnModes:
        """Return modes by their frequency, with the blocks `rest` (k, 2, 2) that do not mix."""
        whole, r, b = self.whole, self.n_rigid, omega.size
        own = modes_as_states(whole.model, omega, zeta, V, r, whole.n_modes)
        pairs = np.concatenate([own.pairs, rest])
        columns, k, p = self.over.shape[1], 2 * len(rest), whole.static_inputs.shape[1]
        inputs, outputs = np.zeros((columns, 2 * b + k)), np.zeros((columns, 2 * b + k))
        inputs[:b, : 2 * b], outputs[:b, : 2 * b] = own.inputs, own.outputs
        inputs[b : b + k, 2 * b :] = np.eye(k)
        outputs[b + k : b + 2 * k, 2 * b :] = np.eye(k)
        order = np.argsort(np.append(omega, natural(rest)[0]), kind="stable")
        states = np.repeat(2 * order, 2) + np.tile([0, 1], order.size)
        static = np.eye(columns)[:, b + 2 * k :]
        return DrawnModes(
            **whole._fields()
            | {
                "pairs": pairs[order],
                "inputs": inputs[:, states],
                "outputs": outputs[:, states],
                "static_inputs": static[:, :p],
                "static_outputs": static[:, p:],
            },
            over=self.over,
        )
