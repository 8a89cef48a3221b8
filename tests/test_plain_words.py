"""Docstrings, comments, messages and names are in the plain words of a textbook."""

import re
from pathlib import Path

import flexplant

ROOT = Path(flexplant.__file__).parent
#: figures of speech that make sentences hard to read, and what to write instead
FIGURES = {
    "told|tells?|telling": "distinguish, determine, show",
    "ask|asks|asked|asking": "request, require, choose",
    "knows|believes?|thinks?|speaks?|hears?|heard|listens?|feigns?": "has, includes, contains",
    r"doubt\w*": "uncertainty, variance",
    "(?:looked|to look|looking) at": "examined, used, checked",
    r"aloud|screwed|reseat\w*|lessened|drown\w*|undying|culprits?|deaf|blind": "the plain word",
    "doors?|hands? (?:back|out)|runs? away|goes on and on": "constructor, returns, diverges",
    "(?:route|norm) of (?:its|their) own": "by another computation",
}
WORDS = re.compile(rf"\b(?:{'|'.join(FIGURES)})\b".replace(" ", r"\s+"), re.IGNORECASE)


def figures(source):
    """Return (line, word) of each figure of speech."""
    return [(source.count("\n", 0, m.start()) + 1, m[0]) for m in WORDS.finditer(source)]


def advice(word):
    plain = " ".join(word.split())
    return next(a for figure, a in FIGURES.items() if re.fullmatch(figure, plain, re.IGNORECASE))


def test_the_words_are_plain():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {word!r}: write {advice(word)}"
        for path in sorted(ROOT.rglob("*.py"))
        for line, word in figures(path.read_text())
    ]
    assert not wrong, "\n".join(wrong)


def test_the_check_can_fail():
    source = '"""What the filter knows."""\n# to look at\nraise ValueError(f"ask for {1} less")\n'
    assert figures(source) == [(1, "knows"), (2, "to look at"), (3, "ask")]
    assert figures("x\n  of the doors")[0] == (2, "doors")
    assert advice("doubted") == "uncertainty, variance"
