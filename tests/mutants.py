"""Wrong code that the tests must notice: ``python tests/mutants.py [room ...] [--jobs 2]``.

Two kinds: each check that raises CertificateError, switched off, so that a wrong answer passes (a
test must hand it one); and the lines of `LINES`, a factor or term wrong in a place that matters. A
mutant is made in a copy of the package, and dies when a fast test of `test_certificates.py` or of
its room fails. Not part of the suite: some seconds for each. Prints which live.
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
    ("structure/units.py", "self.mass / self.time)", "self.mass)"),
    ("lti/lyapunov.py", "if not residual <= TOLERANCE:", "if False:"),
    ("lti/equations.py", "for term in (moved, bent, Q))) <= _OFF:", "for term in (Q,))) >= 0:"),
    ("lti/peaks.py", " + radius**3 * model.rest(centre, radius, 2)", ""),
    ("lti/peaks.py", "return centre[unsure[_largest(T0[unsure]) > level]], bound <= level",
     "return centre[unsure[_largest(T0[unsure]) > level]], bound <= 1.1 * level"),
    ("synthesis/hinf/central.py", "return bool(values[0] <", "return bool(values[0] + 1e300 <"),
    ("synthesis/hinf/mode_channels.py", "with_G = -1j *", "with_G = 1j *"),
    ("placement/quadratic.py", "<= RESIDUAL:", "<= 1e300:"),
    ("placement/branch_and_bound.py", "bound = max(bound, found)", "bound = 1.2 * found"),
    ("simulation/runs.py", "/= np.sqrt(hold)", "/= 1.0"),
    ("identification/refine.py", "self.cost += float(error @ error)",
     "self.cost += 2.0 * float(error @ error)"),
    ("plant/sampling.py", "np.asarray(asd)[loud] / np.sqrt(2.0)", "np.asarray(asd)[loud]"),
    ("lti/discretisation.py", "np.asarray(asd)[active] / np.sqrt(2.0)", "np.asarray(asd)[active]"),
    ("lti/discretisation.py", "np.arctan(0.5 * dt * omega)", "np.arctan(0.4 * dt * omega)"),
    ("lti/discretisation.py", "np.sin(turning), -0.5 *", "np.sin(turning), -0.6 *"),
    ("identification/spectra.py", "count / (1.0 + 2.0 * doubled)", "1.0 * count"),
    ("reduction/ranking.py", "np.sqrt(1 + 2 * a)", "np.sqrt(1 + a)"),
    ("estimation/filter_model.py", "L_z @ m.R - 2.0 * N", "L_z @ m.R - N"),
    ("structure/damping.py", "ratio = 0.5 * (self.alpha", "ratio = 1.0 * (self.alpha"),
    ("loop/mode_tolerance.py", "zeta = -0.5 * trace", "zeta = -1.0 * trace"),
    ("updating/judgement/posterior.py", "return -0.5 * float(r @ r)", "return -float(r @ r)"),
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
    """Return whether a fast test of the mutant's room fails."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "src"
        shutil.copytree(TOP / "src", copy, ignore=shutil.ignore_patterns("__pycache__"))
        module = copy / "flexplant" / mutant.module.relative_to(SOURCE)
        source = mutant.module.read_text()
        module.write_text(source[: mutant.start] + mutant.text + source[mutant.end :])
        command = [
            *(sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"),
            *("-m", "not slow and not benchmark", "tests/test_certificates.py", *_tests(mutant)),
        ]
        setting = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=TOP, env=setting, capture_output=True, check=False)
    return done.returncode == 1


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
