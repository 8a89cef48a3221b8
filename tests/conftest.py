"""Profiles of hypothesis, a backend without windows, oracles on the path, a rule on tolerances."""

import os
import re
import sys
from collections import Counter
from pathlib import Path

# before NumPy is loaded: the matrices here are small, and BLAS threads would wait for each other
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("MPLBACKEND", "Agg")

# oracles and small machines live here; tests in the folders below import them by name
sys.path.insert(0, str(Path(__file__).parent))

# before the tests are imported
from tolerances import guard

guard()

# many processes read the same modules, here and in what the tests start: compiled once for all
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

settings.register_profile(
    "dev",
    max_examples=20,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("nightly", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "dev"))


def pytest_configure(config):
    """Hand out files in their order: by the number of tests, the long single ones would be last."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_itemcollected(item):
    """Count long tests among the slow ones."""
    if item.get_closest_marker("long"):
        item.add_marker("slow")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Leave out static checks unless their file is named; put files with slow tests first."""
    named = {Path(argument.split("::")[0]).name for argument in config.args}
    static = [one for one in items if one.get_closest_marker("static")]
    left_out = {one for one in static if one.path.name not in named}
    config.hook.pytest_deselected(items=list(left_out))
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    # the files with the most slow tests ahead, so that none is left for the end; the sort is
    # stable: a file stays in one piece
    items[:] = sorted(
        (one for one in items if one not in left_out), key=lambda one: -slow[one.path]
    )


def pytest_ignore_collect(collection_path, config):
    """Leave out benchmarks, and the peers that they import, in a run that does not name them."""
    named = re.search(r"(?<!not )benchmark", config.option.markexpr)
    return True if collection_path.name == "benchmarks" and not named else None


@pytest.fixture(autouse=True)
def _no_figure_is_left():
    """Close what a test draws: which files share a process is left to the scheduler."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
