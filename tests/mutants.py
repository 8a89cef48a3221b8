"""Wrong code that the tests must notice: ``python tests/mutants.py [room ...] [--jobs 2]``.

Two kinds: each check that raises CertificateError, switched off, so that a wrong answer passes (a
test must hand it one); and the lines of `LINES`, a factor or term wrong in a place that matters. A
mutant is made in a copy of the package, and dies when a test of `test_certificates.py` or of its
room fails. Not part of the suite: some seconds for each that dies early. Prints which live.
"""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

TOP = Path(__file__).parents[1]
SOURCE = TOP / "src" / "flexplant"

#: module, right text, wrong text
LINES = [
    ("structure/unit_systems.py", "self.mass / self.time, ", "self.mass, "),
    ("lti/equations.py", "if not residual <= RESIDUAL:", "if False:"),
    ("lti/equations.py", "for term in (moved, bent, Q))) <= TYPED:", "for term in (Q,))) >= 0:"),
    ("lti/peaks.py", " + radius**3 * model.rest(apart, radius, 2)", ""),
    ("lti/peaks.py", "return centre[above[_largest(T0[above]) > level]], bound <= level",
     "return centre[above[_largest(T0[above]) > level]], bound <= 1.1 * level"),
    ("synthesis/hinf/lower_bound.py", "return bool(values[0] <", "return bool(values[0] + 1e300 <"),
    ("synthesis/hinf/tolerated_modes.py", "with_G = -1j *", "with_G = 1j *"),
    ("placement/convex.py", "<= RESIDUAL:", "<= 1e300:"),
    ("placement/branch_and_bound.py", "bound = max(bound, found)", "bound = 1.2 * found"),
    ("simulation/runs.py", "/= np.sqrt(hold)", "/= 1.0"),
    ("identification/refine.py", "self.cost += float(error @ error)",
     "self.cost += 2.0 * float(error @ error)"),
    ("lti/sampling.py", "np.asarray(asd)[loud] / np.sqrt(2.0)", "np.asarray(asd)[loud]"),
    ("lti/conversions.py", "np.arctan(0.5 * dt * omega)", "np.arctan(0.4 * dt * omega)"),
    ("lti/sampling.py", "decay * np.sin(turning) /", "1.2 * decay * np.sin(turning) /"),
    ("identification/spectra.py", "count / (1.0 + 2.0 * doubled)", "1.0 * count"),
    ("reduction/ranking.py", "np.sqrt(1 + 2 * a)", "np.sqrt(1 + a)"),
    ("estimation/steady_filter.py", "L_z @ m.R - 2.0 * N", "L_z @ m.R - N"),
    ("structure/additions.py", "ratio = 0.5 * (self.alpha", "ratio = 1.0 * (self.alpha"),
    ("plant/realisation.py", "-0.5 * trace / np", "-1.0 * trace / np"),
    ("loop/measured_loop.py", "0.5 * at_zero",
     "1.0 * at_zero"),
    ("loop/budget.py", "+ np.sum(one.D[row] ** 2)",
     ""),
    ("estimation/estimate.py", "+ model.A.T @ rest",
     "- model.A.T @ rest"),
    ("estimation/filter_models.py", "0.0)) / np.sqrt(2.0)",
     "0.0))"),
    ("estimation/consistency_tests.py", "2 * np.sum(covariance[1:] ** 2)",
     "np.sum(covariance[1:] ** 2)"),
    ("estimation/kalman.py", "left = model.C1 - rows @ model.C2",
     "left = model.C1"),
    ("plant/realisation.py", "-2.0 * zeta * size",
     "-1.0 * zeta * size"),
    ("plant/forces.py", "self.drift / np.sqrt(4 *",
     "self.drift / np.sqrt(2 *"),
    ("plant/forces.py", "2.0 * self.rms / np.sqrt(2",
     "1.0 * self.rms / np.sqrt(2"),
    ("placement/convex.py", "/ cost**2",
     "/ cost"),
    ("modes/matching.py", "** 2 / divisor(sizes)",
     "/ divisor(sizes)"),
    ("modes/solve.py", "response = response - phi @",
     "response = response - 0.0 * phi @"),
    ("joining/frf_coupling.py", "between, weighted.conj())",
     "between, weighted)"),
    ("simulation/motion.py", "t / 2.0 * (a",
     "t / 3.0 * (a"),
    ("simulation/errors_along.py", "(1.0 - share) * gains[i]",
     "1.0 * gains[i]"),
    ("synthesis/hinf/ncf.py", "gain, B.T @ X, -D.T)",
     "gain, B.T @ X, D.T)"),
    ("synthesis/laws/law.py", "float(np.sqrt(self.ratio))",
     "float(self.ratio)"),
    ("synthesis/aftercare/order.py", "(1.0 - loss) * before.margin",
     "0.0 * before.margin"),
    ("synthesis/hinf/moved_design.py", "np.mean([getattr(",
     "np.max([getattr("),
    ("synthesis/structured/judges.py", "own = 2.0 *",
     "own = 1.0 *"),
    ("synthesis/robustness/guarantees.py", "upper = float(np.sqrt(found.level))",
     "upper = float(found.level)"),
    ("lti/balancing.py", "2.0 * float(np.sum(values[r:]))",
     "1.0 * float(np.sum(values[r:]))"),
    ("lti/norms.py", "float(np.sum(g.D**2)) if g.dt",
     "0.0 if g.dt"),
    ("lti/frequency.py", "np.abs(two.data) ** 2",
     "np.abs(two.data)"),
    ("updating/discrepancy.py", "[s**2 * float",
     "[s * float"),
    ("updating/judgement/validation.py", "np.sqrt(chi2 / after.size)",
     "np.sqrt(chi2)"),
    ("identification/frf_estimation.py", "count * (count - 1)",
     "count * count"),
    ("identification/periodic.py", "1.0 - periods * noise /",
     "1.0 - noise /"),
    ("identification/lines.py", "power / (1.0 - fitted_share)",
     "power / 1.0"),
]  # fmt: skip


class Mutant(NamedTuple):
    """A module with some text between two places of its source replaced."""

    module: Path
    start: int
    end: int
    text: str

    @property
    def name(self) -> str:
        """Module, line and what stands there."""
        source = self.module.read_text()
        line = source[: self.start].count("\n") + 1
        return f"{self.module.relative_to(SOURCE)}:{line} {source[self.start : self.end]!r:.60}"

    @property
    def room(self) -> str:
        """Name of the folder of the package that it is in."""
        return self.module.relative_to(SOURCE).parts[0]


def guards() -> list[Mutant]:
    """Return a mutant for each condition under which CertificateError is raised."""
    found = []
    for module in sorted(SOURCE.rglob("*.py")):
        source = module.read_text()
        if "raise CertificateError" not in source:
            continue
        ends = [0]
        for line in source.encode().splitlines(keepends=True):
            ends.append(ends[-1] + len(line))
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.If) and _refuses(node.body):
                at = node.test
                start, end = (
                    len(source.encode()[: ends[line - 1] + column].decode())
                    for line, column in (
                        (at.lineno, at.col_offset),
                        (at.end_lineno or 0, at.end_col_offset or 0),
                    )
                )
                found.append(Mutant(module, start, end, "False"))
    return found


def _refuses(body: list[ast.stmt]) -> bool:
    return any(isinstance(one, ast.Raise) and "CertificateError" in ast.dump(one) for one in body)


def lines() -> list[Mutant]:
    """Return the mutants of `LINES`; KeyError where the right text is no longer there."""
    found = []
    for name, right, wrong in LINES:
        module = SOURCE / name
        start = module.read_text().find(right)
        if start < 0:
            raise KeyError(f"{name} has no {right!r}: the line moved, move the mutant with it.")
        found.append(Mutant(module, start, start + len(right), wrong))
    return found


def dies(mutant: Mutant) -> bool:
    """Return whether a test of the mutant's room fails: the fast ones run first."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "src"
        shutil.copytree(TOP / "src", copy, ignore=shutil.ignore_patterns("__pycache__"))
        module = copy / "flexplant" / mutant.module.relative_to(SOURCE)
        source = mutant.module.read_text()
        module.write_text(source[: mutant.start] + mutant.text + source[mutant.end :])
        setting = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        for speed in ("not slow and not benchmark", "slow and not benchmark"):
            command = [
                *(sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "-p", "no:cacheprovider"),
                *("-m", speed, "tests/test_certificates.py", *_tests(mutant)),
            ]
            done = subprocess.run(command, cwd=TOP, env=setting, capture_output=True, check=False)
            if done.returncode == 1:
                return True
    return False


def _tests(mutant: Mutant) -> list[str]:
    """Return the test files of the mutant's room, those that share words with its module first."""
    words = set(mutant.module.relative_to(SOURCE).with_suffix("").as_posix().split("/")[1:])
    words |= {part for word in words for part in word.split("_")}
    files = sorted((TOP / "tests").glob(f"test_{Path(mutant.room).stem}/test_*.py"))
    files += (TOP / "tests").glob(f"test_{Path(mutant.room).stem}.py")
    files.sort(key=lambda file: -len(words.intersection(file.stem.split("_"))))
    return [str(file) for file in files]


def main() -> None:
    """Print each mutant with whether it died, and how many did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rooms", nargs="*", help="folders of the package; all without")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    wanted = parser.parse_args()
    mutants = [m for m in guards() + lines() if not wanted.rooms or m.room in wanted.rooms]
    with ThreadPoolExecutor(wanted.jobs) as pool:
        dead = 0
        for mutant, died in zip(mutants, pool.map(dies, mutants), strict=True):
            dead += died
            print("died " if died else "LIVES", mutant.name, flush=True)
    print(f"{dead} of {len(mutants)} died")


if __name__ == "__main__":
    main()
