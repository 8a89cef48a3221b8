"""The paper's plate with a hidden 0.5 kg, measured with noise; the truth is the oracle's."""

import numpy as np

import oracles_updating as oracle
from flexplant.lti import Frf
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce
from flexplant.structure import ModalDamping
from flexplant.updating import AddedDamping, AddedMass, FrfResidual, update
from plates import make_plate

FREQ = np.linspace(200, 720, 40)


def with_mass():
    """M, D, K of all 243 DOFs."""
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    return M, D, K


class Campaign:
    """Model, exact responses from a corner to two places, and the variance of 40 dB."""

    def __init__(self):
        model = make_plate()
        nearest = model.dofs.nearest
        grid = [nearest((0.15 * i, 0.15 * j, 0.0), "z") for j in range(5) for i in range(5)]
        self.at = nearest((0.3, 0.15, 0.0), "z")
        self.inputs, self.outputs = [grid[0]], [grid[4], grid[11]]
        channels = [self.at, *self.inputs, *self.outputs]
        modes = solve_modes(model, count=21, damping=ModalDamping(0.01), compliance_at=channels)
        self.rom = reduce(modes, DesiredDofs(grid))
        M, D, K = with_mass()
        index = model.dofs.index
        load = np.zeros(M.shape[0])
        load[index(grid[0])] = 1.0
        self.H = np.zeros((2, 1, FREQ.size), complex)
        for n, w in enumerate(2 * np.pi * FREQ):
            motion = np.linalg.solve(K - w**2 * M + 1j * w * D, load)
            self.H[:, 0, n] = motion[[index(place) for place in self.outputs]]
        power = np.mean(np.abs(self.H) ** 2, axis=2, keepdims=True)
        self.variance = 1e-4 * power * np.ones(self.H.shape)

    def fit(self, rng):
        """Return the update from one noisy measurement."""
        noise = rng.normal(size=self.H.shape) + 1j * rng.normal(size=self.H.shape)
        data = self.H + noise * np.sqrt(self.variance / 2)
        frf = Frf(FREQ, data, inputs=self.inputs, outputs=self.outputs, variance=self.variance)
        return update(self.rom, [AddedMass(self.at), AddedDamping(self.at)], [FrfResidual(frf)])


def judged(fits):
    """Return how often the 95 % interval holds the 0.5 kg, and the median relative error."""
    low, high = np.array([one.interval(0.95)[0] for one in fits]).T
    error = np.abs([one.values[0] - 0.5 for one in fits]) / 0.5
    return np.mean((low <= 0.5) & (high >= 0.5)), np.median(error)
