"""The pedestrian bridge of a published study: 274 DOFs, 15 unknown stiffnesses, 3 modes.

Data: Georgia Tech, structural model updating (GPL-3: read where present, never bundled).
"""

import os
import time
from pathlib import Path

import numpy as np
import pytest
import scipy.io as sio

from flexplant.identification import MeasuredModes
from flexplant.labels import DofSet
from flexplant.reduction import ReducedModel
from flexplant.updating import Eigenvalues, MatrixParameter, ModeShapes, update

DATA = Path(os.environ.get("FLEXPLANT_DATA", Path(__file__).parents[3] / "shared" / "data"))
FILE = DATA / "fe" / "updating" / "SteelPedBrdg_sim_form1_LM.mat"
pytestmark = pytest.mark.skipif(not FILE.exists(), reason="the bridge's data are not here")

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


@pytest.fixture(scope="module")
def bridge():
    return Bridge()


def ends(bridge, starts):
    """Return the largest error of the parameters from each start."""
    return [
        np.abs(
            update(
                bridge.model, bridge.parameters(bounds=(-1, 1)), bridge.residuals(), start=p
            ).values
            - TRUTH
        ).max()
        for p in starts
    ]


def test_the_truth_is_reached_from_stored_starts(bridge):
    assert max(ends(bridge, bridge.starts[:2])) < 1e-8


def noisy_fits(bridge, trials, **known):
    rng = np.random.default_rng(4)
    errors, scores = [], []
    for _ in range(trials):
        fit = update(bridge.model, bridge.parameters(**known), bridge.residuals(rng))
        errors.append(fit.values - TRUTH)
        scores.append(errors[-1] / fit.std)
    return np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(scores)))


@pytest.mark.slow
def test_noise_leaves_the_published_error_and_an_honest_doubt(bridge):
    error, score = noisy_fits(bridge, 40, bounds=(-1, 1))
    assert error < 0.11
    assert 0.8 < score < 1.25
    assert error < 0.5 * np.sqrt(np.mean(TRUTH**2))
    # the prior does it
    plain, _ = noisy_fits(bridge, 6)
    assert plain > 1.3 * error


@pytest.mark.benchmark
def test_a_hundred_starts(bridge):
    begun = time.process_time()
    found = np.array(ends(bridge, bridge.starts))
    taken = time.process_time() - begun
    print(f"bridge: {np.sum(found < 1e-8)} of {found.size} starts in {taken:.1f} s")
    assert np.sum(found < 1e-8) >= 90
    assert taken < 60
