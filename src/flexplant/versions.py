"""Versions of all that results depend on: for reports, and to be sent with a question."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .errors import counted

#: what is imported when it is needed, in the order in which it is listed
_PACKAGES = (
    *("numpy", "scipy", "control", "slycot", "cvxpy", "clarabel", "filterpy", "matplotlib"),
    *("threadpoolctl", "tqdm"),
)


def versions() -> dict[str, str]:
    """Return the versions of this package, Python, its libraries, BLAS, platform and threads."""
    from threadpoolctl import threadpool_info

    found = {"flexplant": sys.modules["flexplant"].__version__, "python": platform.python_version()}
    found |= {name: _version(name) for name in _PACKAGES}
    for pool in sorted(threadpool_info(), key=lambda pool: str(pool["filepath"])):
        kind = {"blas": "BLAS", "openmp": "OpenMP"}.get(pool["user_api"], pool["user_api"])
        parts = (pool.get("internal_api"), pool.get("version"), pool.get("architecture"))
        own = " ".join(str(part) for part in parts if part)
        path = Path(pool["filepath"])
        owner = next((n for n in ("numpy", "scipy") if f"{n}.libs" in path.parts), path.parent.name)
        name = f"{kind} of {owner}"
        found[name] = f"{own}, {counted(pool['num_threads'], 'thread')}"
    found["platform"] = platform.platform()
    found["processors"] = str(os.cpu_count())
    limits = [f"{n}={os.environ[n]}" for n in sorted(os.environ) if n.endswith("_NUM_THREADS")]
    found["limits of threads"] = ", ".join(limits) or "none set"
    return found


def show_versions() -> None:
    """Write the versions that results depend on to the standard output.

    Examples
    --------
    >>> show_versions()  # doctest: +ELLIPSIS
    flexplant ...
    """
    found = versions()
    width = max(map(len, found)) + 2
    sys.stdout.write("".join(f"{name:{width}s}{text}\n" for name, text in found.items()))


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
