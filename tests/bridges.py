"""The pedestrian bridge of a published study: 274 DOFs, 15 unknown stiffnesses, 3 modes.

Data: Georgia Tech, structural model updating (GPL-3: read where present, never bundled).
"""

import warnings

import numpy as np
import scipy.io as sio

from flexplant import DofSet
from flexplant.errors import FlexplantWarning
from flexplant.identification import MeasuredModes
from flexplant.reduction import ReducedModel
from flexplant.updating import Eigenvalues, MatrixParameter, ModeShapes, update
from shared_data import data_file

FILE = data_file("fe/updating/SteelPedBrdg_sim_form1_LM.mat")

TRUTH = np.array(
    [0.05, 0.05, -0.05, -0.1, 0.1, -0.15, 0.15, -0.05, -0.1, 0.1, -0.2, -0.3, 0.6, -0.3, 0.6]
)


class Bridge:
    """The model as published, its DOFs without mass included."""

    def __init__(self):
        stored = sio.loadmat(FILE, squeeze_me=True, struct_as_record=False)
        model, modes = stored["structModel"], stored["expModes"]
        n = model.M0.shape[0]
        K = model.K0.toarray()
        dofs = DofSet(np.arange(1, n + 1), ["z"] * n, np.zeros((n, 3)))
        self.model = ReducedModel(
            M=model.M0.toarray(),
            D=np.zeros((n, n)),
            K=(K + K.T) / 2,
            T=np.eye(n),
            dofs=dofs,
            full_dofs=dofs,
            rigid_body=np.zeros((n, 0)),
            method="none",
        )
        self.changes = [(part + part.T) / 2 for part in model.K_j]
        self.squares, self.shapes = modes.lambdaExp, modes.psiExp
        self.at = [f"{i}:z" for i in modes.measDOFs]
        self.starts = stored["alpha0"].T

    def parameters(self, **options):
        return [
            MatrixParameter(f"a{i}", dK=part, **options) for i, part in enumerate(self.changes, 1)
        ]

    def residuals(self, rng=None):
        """Poles and shapes; with a generator 0.5 % on omega^2 and 1 % of each largest entry."""
        squares, shapes, covariance, std = self.squares, self.shapes, None, None
        if rng is not None:
            squares = squares * (1 + 0.005 * rng.normal(size=3))
            shapes = shapes + 0.01 * rng.normal(size=shapes.shape)
            # undamped: the imaginary part alone is wrong; E|d lambda|^2 counts both
            covariance, std = 2 * (0.0025**2) * squares, 0.01
        poles = MeasuredModes(1j * np.sqrt(squares), modes=[1, 2, 3], covariance=covariance)
        return [Eigenvalues(poles), ModeShapes(poles, shapes, self.at, std=std)]


def ends(bridge, starts):
    """Return the largest error of the parameters from each start; some do not converge."""
    unknowns, data = bridge.parameters(bounds=(-1, 1)), bridge.residuals()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        fits = [update(bridge.model, unknowns, data, start=p) for p in starts]
    return np.array([np.abs(fit.values - TRUTH).max() for fit in fits])


def noisy_fits(bridge, trials, seed=4, **known):
    """Return the rms error of the parameters, and that per stated standard deviation."""
    rng = np.random.default_rng(seed)
    errors, scores = [], []
    for _ in range(trials):
        fit = update(bridge.model, bridge.parameters(**known), bridge.residuals(rng), starts=1)
        errors.append(fit.values - TRUTH)
        scores.append(errors[-1] / fit.std)
    return np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(scores)))
