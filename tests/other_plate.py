"""A plate of another kind with five hidden changes, its full model solved densely by hand."""

import numpy as np
import scipy.linalg as la

from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.sparse.symmetric import dense
from flexplant.structure import ModalDamping, kirchhoff_plate
from flexplant.updating import AddedMass, Eigenvalues, FrfResidual, MatrixParameter, ModeShapes

SIZE, ELEMENTS, ZETA = (0.5, 0.36), (6, 5), 0.008
#: kg, kg, E of the left part, E of all, damping of all
TRUTH = np.array([0.25, 0.12, 0.04, -0.03, 0.2])
FREQ = np.linspace(150.0, 900.0, 40)


def build(E=70e9):
    return kirchhoff_plate(
        size=SIZE,
        thickness=0.012,
        elements=ELEMENTS,
        density=2700,
        youngs_modulus=E,
        poisson_ratio=0.3,
    )


class OtherPlate:
    """Model, reduced model (18 modes in 18 DOFs, nothing for the rest) and exact data."""

    def __init__(self, count=18):
        self.full = build().with_damping(ModalDamping(ZETA))
        dofs = self.full.dofs
        grid = [
            dofs.nearest((x, y, 0.0), "z")
            for x in np.linspace(0, SIZE[0], 7)
            for y in (0.0, 0.144, 0.36)
        ]
        modes = solve_modes(build(), count=count, damping=ModalDamping(ZETA))
        self.rom = reduce(modes, DesiredDofs(select_dofs(modes, count, required=grid[:4])))
        mask = np.zeros(ELEMENTS, dtype=bool)
        mask[:2] = True
        region = MatrixParameter.regions(build, {"E left": mask}, value=70e9)
        self.unknowns = [
            AddedMass(dofs.nearest((0.2, 0.14, 0.0), "z"), name="m1"),
            AddedMass(dofs.nearest((0.42, 0.29, 0.0), "z"), name="m2"),
            *region,
            MatrixParameter("E", dK=self.full.K),
            MatrixParameter("damping", dD=self.full.D),
        ]
        self.inputs, self.outputs = [grid[0], grid[20]], [grid[0], grid[7], grid[12]]
        self.sensors = grid[:12]
        self.dense = [dense(part) for part in (self.full.M, self.full.D, self.full.K)]
        self.changes = [
            [None if part is None else dense(part) for part in q.matrices(self.full)]
            for q in self.unknowns
        ]
        self.H = self.exact(TRUTH)
        power = np.mean(np.abs(self.H) ** 2, axis=2, keepdims=True)
        self.variance = 1e-4 * power * np.ones(self.H.shape)
        self.poles, self.shapes = self.exact_modes()

    def parts(self, p):
        """M, D and K with the five changes."""
        M, D, K = (np.array(part) for part in self.dense)
        for changes, value in zip(self.changes, p, strict=True):
            for whole, part in zip((M, D, K), changes, strict=True):
                whole += 0.0 if part is None else value * part
        return M, D, K

    def exact(self, p):
        """Responses (3, 2, lines) of the full structure."""
        M, D, K = self.parts(p)
        index = self.full.dofs.index
        loads = np.zeros((M.shape[0], 2))
        loads[[index(label) for label in self.inputs], [0, 1]] = 1.0
        w = 2 * np.pi * FREQ[:, None, None]
        motion = np.linalg.solve(K - w**2 * M + 1j * w * D, loads[None] + 0j)
        return np.moveaxis(motion[:, [index(label) for label in self.outputs]], 0, 2)

    def exact_modes(self):
        """Complex poles and shapes at the sensors of the first eight elastic modes."""
        M, D, K = self.parts(TRUTH)
        # in the coordinates of the undamped modes
        omega2, phi = la.eigh(K, M)
        omega = np.sqrt(np.maximum(omega2, 0))
        A = np.block([[0 * M, np.diag(omega)], [-np.diag(omega), -phi.T @ D @ phi]])
        values, states = la.eig(A)
        keep = np.flatnonzero(values.imag > 1.0)
        keep = keep[np.argsort(np.abs(values[keep]))][:8]
        rows = [self.full.dofs.index(label) for label in self.sensors]
        shapes = (phi @ states[omega.size :, keep])[rows]
        return values[keep], shapes / shapes[np.argmax(np.abs(shapes), axis=0), range(8)]

    def responses(self, rng):
        """Measured responses at 40 dB."""
        noise = rng.normal(size=self.H.shape) + 1j * rng.normal(size=self.H.shape)
        data = self.H + noise * np.sqrt(self.variance / 2)
        frf = Frf(FREQ, data, inputs=self.inputs, outputs=self.outputs, variance=self.variance)
        return [FrfResidual(frf)]

    def modes(self, rng):
        """Measured poles (2e-4, and 2 % of the damping) and shapes (1 %)."""
        std = 2e-4 * np.abs(self.poles)
        noise = (rng.normal(size=8) + 1j * rng.normal(size=8)) * std / np.sqrt(2)
        poles = MeasuredModes(self.poles + noise, modes=range(4, 12), covariance=std**2)
        size = self.shapes.shape
        shapes = self.shapes + 0.01 / np.sqrt(2) * (
            rng.normal(size=size) + 1j * rng.normal(size=size)
        )
        return [Eigenvalues(poles), ModeShapes(poles, shapes, self.sensors, std=0.01)]
