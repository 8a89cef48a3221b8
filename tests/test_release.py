"""What is published: licences of all that it needs, Pythons and bounds that it declares."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

from packaging.requirements import Requirement

import flexplant as fx

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
#: what users install: all but the extras for work on the package
OWN = [*PROJECT["dependencies"]]
for extra, listed in PROJECT["optional-dependencies"].items():
    OWN += [] if extra in ("test", "lint") else listed
#: licences of what this package asks for itself, as its front page says
LICENCES = {
    "numpy": "BSD",
    "scipy": "BSD",
    "control": "BSD",
    "threadpoolctl": "BSD",
    "cvxpy": "Apache",
    "clarabel": "Apache",
    "filterpy": "MIT",
    "lazy-loader": "BSD",
    "matplotlib": "Python Software Foundation",
    "tqdm": "MPL",
    "h5py": "BSD",
    "pyuff": "MIT",
    "ansys-mapdl-reader": "MIT",
    "pdoc": "MIT-0|Public Domain",
    "latex2mathml": "MIT",
    "panel": "BSD",
}
#: a licence that asks nothing of those who use this package but to be named
ALLOWED = r"MIT|BSD|Apache|PSF|Python Software Foundation|MPL|Mozilla|ISC|Zlib|CC0|Public Domain"


def licence(found):
    """The SPDX expression, else the classifiers, else the text of a package's metadata."""
    kinds = [c for c in found.get_all("Classifier") or [] if c.startswith("License ::")]
    return found.get("License-Expression") or " ".join(kinds) or (found.get("License") or "")[:80]


def needed():
    """Return {package: licence} of all that is installed for users, through all levels."""
    found, left = {}, [(Requirement(text), ("",)) for text in OWN]
    while left:
        one, extras = left.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name in found or not (
            one.marker is None or any(one.marker.evaluate({"extra": e}) for e in extras)
        ):
            continue
        try:
            about = metadata(name)
        except PackageNotFoundError:  # of an extra that is not installed here
            continue
        found[name] = licence(about)
        inner = ("", *one.extras)
        left += [(Requirement(text), inner) for text in about.get_all("Requires-Dist") or []]
    return found


def test_licences_of_all_dependencies():
    found = needed()
    assert len(found) > 30, "through all levels"
    said = " ".join(fx.__doc__.split())
    said = said[said.index("**Licences.**") :]
    assert {Requirement(text).name for text in OWN} == set(LICENCES)
    for name, kind in LICENCES.items():
        assert re.search(rf"\b{name}\b", said, re.IGNORECASE), name
        if name in found:
            assert re.search(kind, found[name]), (name, found[name])
    for name, text in found.items():
        assert re.search(ALLOWED, text) or LICENCES.get(name) == "Intel", (name, text)
        assert not re.search(r"\bA?GPL", text), (name, text)


def test_what_is_declared():
    """Lower bounds and none above, which would hold others back; Pythons from the lowest on."""
    assert metadata("flexplant")["License-Expression"] == PROJECT["license"] == "MIT"
    pythons = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert pythons[0] == PROJECT["requires-python"].removeprefix(">=") and len(pythons) >= 3
    assert all(re.fullmatch(r"[\w-]+>=[\d.]+", text) for text in PROJECT["dependencies"])
    assert (Path(fx.__file__).parent / "py.typed").is_file()
