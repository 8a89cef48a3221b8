"""What the package and its rooms show: public names, what others call them, versions."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any

from .errors import counted


def public_names(room: str) -> Callable[[], list[str]]:
    """Return the `__dir__` of a package: the names that it re-exports, not its modules.

    A name that the package lacks gets an error that says where it is.
    """

    def missing(name: str) -> Any:
        raise AttributeError(f"module {room!r} has no attribute {name!r}.{hint(name)}")

    sys.modules[room].__dict__["__getattr__"] = missing

    def names() -> list[str]:
        shown = vars(sys.modules[room]).items()
        return [
            name
            for name, item in shown
            if not name.startswith("_") and not isinstance(item, ModuleType)
        ]

    return names


def hint(name: str) -> str:
    """Return where a name is that a module lacks, in words; empty where nothing is known."""
    if name.startswith("_"):
        return ""
    package = sys.modules["flexplant"]
    rooms = [one for one in package.__all__ if isinstance(getattr(package, one), ModuleType)]
    homes = [f"flexplant.{room}" for room in rooms if name in dir(getattr(package, room))]
    homes = ["flexplant"] if name in package.__all__ else homes
    where = "".join(f" Use {home}.{name}." for home in homes)
    ours = OURS.get(name)
    return where or (f" What MATLAB or python-control call so is flexplant.{ours}." if ours else "")


#: what is called otherwise in MATLAB and python-control: its name here, and theirs
_THEIRS = {
    "StateSpace": "ss", "Frf": "frd", "StateSpace.poles": "pole damp",
    "StateSpace.zeros": "tzero zero",
    "StateSpace.dcgain": "dcgain dc_gain", "frequency_response": "freqresp evalfr",
    "plot.bode": "bode bode_plot bodeplot", "plot.singular_values": "sigma",
    "plot.nyquist": "nyquist nyquist_plot", "plot.pole_map": "pzmap",
    "lti.step (or plot.step)": "step step_response",
    "lti.impulse": "impulse impulse_response",
    "lti.lsim (or simulate)": "lsim forced_response initial initial_response",
    "lti.step_info": "stepinfo", "loop.report_loops": "margin",
    "synthesis.margins": "allmargin diskmargin disk_margins stability_margins",
    "loop.sensitivity": "loopsens", "lti.discretized": "c2d sample_system",
    "h2_norm (or hinf_norm)": "norm", "peak_gain": "getPeakGain", "minimal": "minreal",
    "balanced": "balred balreal", "modal_form": "canon", "lti.solve_lyapunov": "lyap",
    "lti.solve_stein": "dlyap", "lti.control_care": "care icare", "lti.control_dare": "dare idare",
    "plant.mixed_sensitivity": "augw", "plant.mixed_sensitivity, then design_hinf": "mixsyn",
    "design_hinf": "hinfsyn", "design_h2": "h2syn",
    "synthesis.lqr": "lqr dlqr", "synthesis.lqi": "lqi", "synthesis.lqg": "lqg lqgreg",
    "synthesis.place": "place acker",
    "design_kalman (or synthesis.lqe)": "kalman lqe dlqe",
    "lti.continuous": "d2c", "lti.resampled": "d2d", "lti.descriptor": "dss",
    "lti.controllability_gramian": "gram", "lti.hankel_values": "hsvd hankelsv",
    "lti.split_stable": "stabsep", "lti.linf_norm": "linfnorm",
    "plot.root_locus": "rlocus root_locus root_locus_plot",
    "balanced (or reduce)": "model_reduction modred",
    "design_ncf": "ncfsyn", "synthesis.ncf_margin": "ncfmargin",
    "synthesis.design_structured": "hinfstruct", "tune_loops": "systune",
    "synthesis.tune_pid (or design_servo)": "pidtune pid_tune",
    "synthesis.mu": "mussv", "synthesis.robust_stability": "robstab",
    "synthesis.uncertain_system": "uss lftdata", "plant.UnmodelledDynamics": "ultidyn",
    "synthesis.RepeatedScalar (or plant.Parameters)": "ureal ucomplex",
    "synthesis.robust_performance": "robustperf robgain",
    "synthesis.worst_case_gain": "wcgain", "synthesis.design_mu": "musyn",
    "estimate_frf": "tfestimate modalfrf",
    "identify_modes": "modalfit",
}  # fmt: skip
OURS = {foreign: ours for ours, names in _THEIRS.items() for foreign in names.split()}

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
