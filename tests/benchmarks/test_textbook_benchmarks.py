"""H-infinity and loop shaping, 22 kinds of textbook plants: right, loose, wrong, refused, by kind.

Run with ``-m benchmark -s``; TEXTBOOK_SEEDS="100 108" draws other problems of every kind.
"""

import os
import time
from collections import Counter
from itertools import product

import pytest

from flexplant.errors import FlexplantError
from flexplant.synthesis import Lmi, design_hinf
from flexplant.synthesis.hinf.lower_bound import relaxed_bound
from flexplant.synthesis.preparation import prepared
from test_synthesis.test_riccati_synthesis import compleib, problems
from test_synthesis.test_textbook_plants import (
    KINDS,
    himat,
    judged,
    least_h2,
    oracle,
    posed,
    problem,
    shaped_loop,
)

SEEDS = range(*map(int, os.environ.get("TEXTBOOK_SEEDS", "0 8").split()))


def word(judge, kind, seed):
    try:
        return judge(kind, seed).word
    except FlexplantError:
        return "refused"


@pytest.mark.benchmark
@pytest.mark.parametrize("judge", [judged, shaped_loop], ids=["hinf", "ncf"])
def test_textbook_plants(judge, capsys):
    rows, total = [], Counter()
    for kind in KINDS:
        found = Counter(word(judge, kind, seed) for seed in SEEDS)
        total += found
        rows.append(f"{kind:20}" + ", ".join(f"{count} {name}" for name, count in found.items()))
    with capsys.disabled():
        print("\n" + "\n".join(rows))
        print("all: " + ", ".join(f"{count} {name}" for name, count in total.items()))
    assert total["right"] >= 0.99 * sum(total.values())


@pytest.mark.benchmark
def test_linear_matrix_inequalities_are_right_or_refused(capsys):
    """The smallest gamma of LMIs: none is false or loose, one in ten may be refused."""
    found, slowest = Counter(), 0.0
    for kind, seed in product(KINDS, SEEDS):
        before = time.process_time()
        found[word(lambda *which: judged(*which, Lmi()), kind, seed)] += 1
        slowest = max(slowest, time.process_time() - before)
    with capsys.disabled():
        print(f"\nLmi(): {dict(found)}, the slowest in {slowest:.1f} s, its judgement included")
    assert found.keys() <= {"right", "refused"}
    assert found["right"] >= 0.9 * sum(found.values())


@pytest.mark.benchmark
@pytest.mark.filterwarnings("ignore:Input:RuntimeWarning")  # of SciPy's Lyapunov solver
def test_the_least_h2_norms(capsys):
    """SciPy's Riccati equations reach no less than `design_h2`, wherever the norm is finite."""
    found = Counter()
    for kind, seed in product([kind for kind in KINDS if kind != "sampled"], SEEDS):
        gamma, norm, best = least_h2(kind, seed)
        found[abs(norm / gamma - 1.0) < 1e-3 and gamma <= 1.002 * best] += 1
    with capsys.disabled():
        print(f"\ndesign_h2: {found[True]} of {sum(found.values())} right")
    assert not found[False]


@pytest.mark.benchmark
def test_lower_bounds(capsys):
    """None is above the optimum by more than 0.3 %: the relaxed problem's, and those of designs.

    Of the collected plants the optimum is the best known one, of the others SLICOT's.
    """
    given = {name: (compleib(name), best) for name, best in problems().items()}
    for p in (himat(), *(problem(kind, seed) for kind, seed in product(KINDS, SEEDS[:2]))):
        P = posed(p)
        given[f"{p.kind} {len(given)}"] = (P.system, P.u, P.y), oracle.smallest_norm(p)
    relaxed, lower = {}, {}
    for name, ((P, u, y), best) in given.items():
        ready = prepared(P, u, y)
        relaxed[name] = max(relaxed_bound(ready, k * best, 0.0) for k in (1.02, 1.05, 1.5)) / best
        found = design_hinf(P, u=u, y=y, progress=False)
        lower[name] = found.lower / best
    with capsys.disabled():
        for kind, bounds in (("relaxed problem", relaxed), ("design_hinf", lower)):
            most = max(bounds, key=bounds.get)
            print(f"\n{kind}: largest bound over the optimum {bounds[most]:.5f} ({most})")
    assert max(*relaxed.values(), *lower.values()) <= 1.003
