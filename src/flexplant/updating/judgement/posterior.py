"""The posterior of the parameters by sampling, where Laplace's approximation is not enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import FloatArray, between
from ...errors import ModelError
from ...parallel import Progress
from ...seeds import Rng, generator
from ...store import Value
from ..parameters import Parameter, checked_parameters
from ..search import Objective, checked_residuals
from ..update_result import UpdateResult

#: stretch of the moves
STRETCH = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Value):
    """Draws from the posterior distribution of the parameters.

    Parameters
    ----------
    parameters : sequence of q str
    draws : (n, q) array
        In order, walkers next to each other.
    acceptance : float
        Share of moves that were accepted. Stretch moves of one or two parameters of a nearly
        normal posterior are accepted in 0.6 to 0.8 of the cases, those of ten in 0.3 to 0.5;
        below 0.15 the walkers hardly move.
    walkers : int
    """

    parameters: tuple[str, ...]
    draws: FloatArray
    acceptance: float
    walkers: int

    @property
    def mean(self) -> FloatArray:
        """Means (q,) of the parameters."""
        return np.asarray(self.draws.mean(axis=0), dtype=np.float64)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (q, q) of the parameters."""
        return np.atleast_2d(np.cov(self.draws.T))

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return the central credible intervals (q, 2)."""
        level = between(level, "level", 0.0, 1.0, "Choose 0.95, say.")
        return np.quantile(self.draws, [(1 - level) / 2, (1 + level) / 2], axis=0).T

    def __repr__(self) -> str:
        text = ", ".join(
            f"{name} = {value:.5g} +- {std:.2g}"
            for name, value, std in zip(
                self.parameters[:4], self.mean, self.draws.std(axis=0), strict=False
            )
        )
        return f"<Posterior: {text}; {len(self.draws)} draws, acceptance {self.acceptance:.2f}>"


def sample_posterior(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Any],
    fit: UpdateResult,
    *,
    steps: int = 400,
    walkers: int | None = None,
    discard: float = 0.3,
    rng: Rng = 0,
    progress: bool | None = None,
) -> Posterior:
    """Draw from the posterior ``exp(-1/2 |r(p)|^2)`` (with priors, inside bounds).

    An ensemble of walkers with stretch moves, no tuning, spread by Laplace's approximation first.

    Parameters
    ----------
    model, parameters, residuals
        As given to `update`; the noise of all residuals must be known.
    fit : UpdateResult
        Of `update`.
    steps : int
        Moves of each walker.
    walkers : int, optional
        Even, twice the number of parameters at least; four times (at least 10) if not given.
    discard : float
        Share of the first steps left out.
    rng : int, SeedSequence or Generator
        Of all random numbers.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.

    Returns
    -------
    Posterior

    Raises
    ------
    ModelError
        When the noise is not known, or the counts make no sense.

    References
    ----------
    [GoodmanWeare2010]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2], covariance=[[1.0, 0.0], [0.0, 1.0]])
    >>> data, mass = [fx.Eigenvalues(measured)], [fx.AddedMass("3:x")]
    >>> fit = fx.update(drawing, mass, data)
    >>> draws = fx.updating.sample_posterior(drawing, mass, data, fit, steps=100)
    >>> draws.draws.shape[1]
    1
    """
    listed = checked_parameters(parameters)
    objective = Objective(model, listed, checked_residuals(residuals))
    q = len(listed)
    if not objective.noisy:
        raise ModelError("the posterior needs the noise of all residuals: give covariance or std.")
    if not isinstance(fit, UpdateResult) or fit.parameters != tuple(p.name for p in listed):
        raise ModelError("fit must be the UpdateResult of the same parameters.")
    count = max(10, 4 * q) if walkers is None else walkers
    if count % 2 or count < 2 * q or count < 4 or steps < 2 or not 0 <= discard < 1:
        raise ModelError(
            f"{count} walkers and {steps} steps: walkers must be even and at least "
            f"{max(4, 2 * q)}, steps 2, discard between 0 and 1."
        )
    draws = generator(rng)
    objective.follow([*fit.history.parameters, fit.values])

    def density(p: FloatArray) -> float:
        if np.any(p < objective.lower) or np.any(p > objective.upper):
            return -np.inf
        try:
            r = objective.values(objective.at(p))
        except ModelError:
            return -np.inf
        return -0.5 * float(r @ r)

    begin = np.clip(fit.sample(count, rng=draws), objective.lower, objective.upper)
    height = np.array([density(p) for p in begin])
    begin[~np.isfinite(height)] = fit.values
    height = np.array([density(p) for p in begin])
    kept, accepted = [], 0
    half = count // 2
    with Progress(steps, "posterior", progress=progress) as bar:
        for step in range(steps):
            for move in (np.arange(half), np.arange(half, count)):
                other = np.setdiff1d(np.arange(count), move)
                z = ((STRETCH - 1) * draws.random(half) + 1) ** 2 / STRETCH
                partner = begin[draws.choice(other, half)]
                trial = partner + z[:, None] * (begin[move] - partner)
                reached = np.array([density(p) for p in trial])
                with np.errstate(invalid="ignore"):
                    odds = (q - 1) * np.log(z) + reached - height[move]
                take = np.log(draws.random(half)) < odds
                begin[move[take]], height[move[take]] = trial[take], reached[take]
                accepted += int(take.sum())
            if step >= discard * steps:
                kept.append(begin.copy())
            bar.advance()
    return Posterior(
        parameters=tuple(p.name for p in listed),
        draws=np.concatenate(kept),
        acceptance=accepted / (steps * count),
        walkers=count,
    )
