"""Systems of python-control and SciPy, read as the fields of ours."""

from __future__ import annotations

from typing import Any

from ..errors import ModelError
from .sections import matrix_fields, tf_fields, zpk_fields


def foreign_fields(sys: Any) -> dict[str, Any]:
    """Return the fields of a `StateSpace` that a system of python-control or SciPy has.

    A transfer function becomes sections in series (`tf_fields`), each channel of a matrix with
    states of its own: `minimal` removes what they share.
    """
    dt = _sampling_time(sys)
    if all(hasattr(sys, part) for part in ("A", "B", "C", "D")):
        fields = {part: getattr(sys, part) for part in ("A", "B", "C", "D")}
    elif all(hasattr(sys, part) for part in ("zeros", "poles", "gain")):
        fields = zpk_fields(sys.zeros, sys.poles, sys.gain, dt)
    elif hasattr(sys, "input_labels"):
        fields = matrix_fields(
            [
                [tf_fields(*pair, dt) for pair in zip(*row, strict=True)]
                for row in zip(sys.num, sys.den, strict=True)
            ]
        )
    else:
        fields = tf_fields(sys.num, sys.den, dt)
    named = {"inputs": "input_labels", "outputs": "output_labels", "states": "state_labels"}
    labels = {ours: getattr(sys, theirs) for ours, theirs in named.items() if hasattr(sys, theirs)}
    return {**fields, **labels, "dt": dt, "name": getattr(sys, "name", None)}


def _sampling_time(sys: Any) -> float:
    matrices, ratio = (hasattr(sys, "A") and hasattr(sys, "B")), hasattr(sys, "den")
    if not (hasattr(sys, "dt") and (matrices or ratio or hasattr(sys, "gain"))):
        raise ModelError(
            f"need a system of flexplant, python-control or SciPy, got {type(sys).__name__}. "
            "Make one: StateSpace(A, B, C, D), fx.lti.tf(num, den), control.ss(...)."
        )
    if sys.dt is None and type(sys).__module__.startswith("scipy"):
        return 0.0  # SciPy's sign of continuous time
    if sys.dt is None or sys.dt is True:
        raise ModelError(
            f"the sampling time of {getattr(sys, 'name', sys)!r} is {sys.dt}: state it in seconds "
            "(0 for continuous time), frequencies depend on it."
        )
    return float(sys.dt)
