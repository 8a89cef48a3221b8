"""Which of many candidate changes explain a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import require_known
from ...values import FloatArray, Value
from .goodness import chance, is_bad

#: single candidates within this of the best BIC are as good
ALIKE = 2.0
#: share of the residual by which rivals explain less than the best at most
NEAR = 0.01
#: names in a line of a repr, lines in a table
SHOWN, ROWS = 6, 12


@dataclass(frozen=True, eq=False, repr=False)
class Localisation(Value):
    """Which candidates explain a measurement.

    Parameters
    ----------
    candidates : sequence of c str
        Names, in the order given.
    values : (c,) array
        What each candidate would have to be if it were the only change; NaN when it could not
        be fitted.
    score : (c,) array
        The share of the residual's sum of squares that each explains alone, at most 1.
    bic : (c,) array
        Extended Bayesian information criterion of each alone.
    chosen : sequence of str
        The subset of least BIC; empty when nothing at all is best.
    chosen_values : array
        Its values.
    chosen_bic, nothing_bic : float
        BIC of the subset, and of no change.
    nuisance : sequence of n str
        Parameters that were fitted along with every candidate, and with none.
    nuisance_values : (n,) array
        Theirs beside the chosen subset.
    chi2 : float or None
        What the chosen subset leaves, None where the noise is not known.
    dof : int
        Residuals less the parameters that were fitted.
    units : sequence of c str, optional
        Of the candidates.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e5, 3e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> heavier = fx.chain(masses=[1.0, 2.0, 1.8], stiffnesses=[4e5, 3e5])
    >>> measured = fx.MeasuredModes(poles=fx.solve_modes(heavier, count=3).poles[1:], modes=[2, 3])
    >>> masses = [fx.AddedMass(place, name=place) for place in drawing.dofs.labels]
    >>> found = fx.localise(drawing, [fx.Eigenvalues(measured)], masses, most=1)
    >>> found.chosen, found.chosen_values.round(6)
    (('3:x',), array([0.3]))
    """

    candidates: tuple[str, ...]
    values: FloatArray
    score: FloatArray
    bic: FloatArray
    chosen: tuple[str, ...]
    chosen_values: FloatArray
    chosen_bic: float
    nothing_bic: float
    nuisance: tuple[str, ...] = ()
    nuisance_values: FloatArray = field(default_factory=lambda: np.zeros(0))
    chi2: float | None = None
    dof: int = 0
    units: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> float:
        """Return the score of a candidate."""
        require_known("candidate", [name], self.candidates)
        return float(self.score[self.candidates.index(name)])

    @property
    def p_value(self) -> float | None:
        """The probability that noise leaves a larger `chi2`, None when that is not known."""
        return chance(self.chi2, self.dof)

    @property
    def ranking(self) -> tuple[str, ...]:
        """All candidates, the best score first."""
        order = np.argsort(-self.score, kind="stable")
        return tuple(self.candidates[i] for i in order)

    @property
    def leading(self) -> tuple[str, ...]:
        """The best dozen candidates alone, and those chosen that are not among them."""
        best = self.ranking[:ROWS]
        return (*best, *(name for name in self.chosen if name not in best))

    @property
    def alike(self) -> tuple[str, ...]:
        """Single candidates that the data cannot distinguish from the best one (BIC within 2).

        On a symmetric structure poles alone leave all mirror images alike.
        """
        near = np.flatnonzero(self.bic <= np.min(self.bic) + ALIKE)
        return tuple(self.candidates[i] for i in near[np.argsort(self.bic[near], kind="stable")])

    @property
    def rivals(self) -> tuple[str, ...]:
        """Candidates that alone explain nearly as much as the best one, at most 1 % less.

        The data distinguish those that are not `alike` from the best, but only by a small part of
        the residual, which an error of the model itself could make or hide: mirror images on a
        symmetric structure.
        """
        least = float(np.max(self.score)) - NEAR
        return tuple(name for name in self.ranking[1:] if self[name] >= least)

    @property
    def table(self) -> str:
        """The leading candidates in lines: value alone, share explained, BIC above the least."""
        width = max(len("candidate"), *(len(name) for name in self.leading))
        lines = [f"{'candidate':{width}s}{'value alone':>13s}{'explained':>11s}{'BIC +':>10s}"]
        least = float(np.min(self.bic))
        for name in self.leading:
            i = self.candidates.index(name)
            known = np.isfinite(self.bic[i])
            more = f"{self.bic[i] - least:10.1f}" if known else f"{'-':>10s}"
            mark = "  chosen" if name in self.chosen else ""
            others = len(self.alike) > 1 and name in self.alike
            mark += "  alike" if others else "  rival" if name in self.rivals else ""
            lines.append(f"{name:{width}s}{self.values[i]:13.5g}{self.score[i]:11.4f}{more}{mark}")
        rest = len(self.candidates) - len(lines) + 1
        return "\n".join([*lines, *([f"and {rest} more"] if rest else [])])

    def __repr__(self) -> str:
        best = ", ".join(f"{name} {self[name]:.4f}" for name in self.ranking[:3])
        found = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in zip(self.chosen[:4], self.chosen_values.tolist(), strict=False)
        )
        if self.nuisance:
            beside = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.nuisance, self.nuisance_values.tolist(), strict=True)
            )
            found = f"{found or 'no change'} beside {beside}"
        text = (
            f"<Localisation: {found or 'no change'} (BIC {self.chosen_bic:.4g}, no change "
            f"{self.nothing_bic:.4g})\n  explained alone: {best}"
        )
        if len(self.alike) > 1 and self.chosen:
            text += f"\n  AMBIGUOUS, {len(self.alike)} alike: {_shown(self.alike)}"
        rivals = [name for name in self.rivals if len(self.alike) < 2 or name not in self.alike]
        if rivals and self.chosen:
            text += f"\n  differs by less than {NEAR:.0%} of the data from: {_shown(rivals)}"
        if is_bad(self.p_value):
            text += f"\n  MORE THAN NOISE IS LEFT: chi2 {self.chi2:.4g} for {self.dof} dof"
        return text + ">"


def _shown(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
