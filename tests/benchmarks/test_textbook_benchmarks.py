"""H-infinity and loop shaping, 22 kinds of textbook plants: right, loose, wrong, refused, by kind.

Run with ``-m benchmark -s``; TEXTBOOK_SEEDS="100 108" draws other problems of every kind.
"""

import os
from collections import Counter

import pytest

from flexplant.errors import FlexplantError
from test_synthesis.test_textbook_plants import KINDS, judged, shaped_loop

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
