"""Every public function under hostile input: a right answer or an error of ours.

The walk goes over the calls that the examples in the docstrings make, each argument in turn
replaced by what it should not be: a new function is in it with its docstring.
"""

import io
import signal
import warnings
from collections.abc import Mapping
from contextlib import contextmanager, redirect_stderr

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

import flexplant as fx
from flexplant.errors import FlexplantError, FlexplantWarning
from recorded_calls import Call, parameters, recorded, replayed
from test_doctests import MODULES

INF, HUGE = float("inf"), 10**400
#: for any argument
KINDS = {
    "nan": float("nan"), "inf": INF, "-inf": -INF, "complex": 1j, "huge": HUGE, "-huge": -HUGE,
    "large": 1e300, "no text": "", "colons": "a:b:c", "long": "x" * 200, "None": None,
    "True": True, "object": object(), "[]": [], "[[]]": [[]], "empty": np.empty((0, 0)),
    "[nan]": np.array([np.nan]), "nan matrix": np.full((2, 2), np.nan),
    "ragged": [[1.0], [1.0, 2.0]], "masked": np.ma.masked_array([1.0, 2.0], [False, True]),
    "series": pd.Series([1.0, 2.0]), "frame": pd.DataFrame({"a": [1.0], "b": [2.0]}), "{}": {},
    "{1: 2}": {1: 2}, "{a: nan}": {"a": float("nan")}, "bytes": b"a",
    "date": np.datetime64("2020-01-01"), "class": int, "three axes": np.zeros((2, 3, 4)),
    "[huge]": [HUGE], "doubled": ["a", "a"], "[no text]": [""], "[None]": [None], "-1": -1, "0": 0,
    "2.5": 2.5, "float32": np.float32(0.5), "no axes": np.array(0.5), "[complex]": [1j],
    "set": {1, 2},
}  # fmt: skip
SECONDS = 10.0


def bent(value):
    """Yield what is nearly the given argument: its type, and a fault in it."""
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int | float):
        yield "negative", -value
        yield "far off", value * 1e200
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fciu" and value.size:
        for bad in (np.nan, INF):
            faulty = value.astype(complex if value.dtype.kind == "c" else float)
            faulty.flat[-1] = bad
            yield f"{bad} in it", faulty
        yield "complex", value * (1 + 1j)
        yield "transposed", value.T
        yield "short", value[:-1]
        yield "an axis more", value[None]
        yield "none of it", value[:0]
    elif isinstance(value, list | tuple) and value:
        for bad in (float("nan"), None, "", HUGE, object()):
            yield f"{type(bad).__name__} in it", [*value[:-1], bad]
        yield "one twice", [*value, value[-1]]
        yield "short", list(value[:-1])
    elif isinstance(value, Mapping) and value:
        first = next(iter(value))
        for bad in (float("nan"), None, "", HUGE, object()):
            yield f"{type(bad).__name__} as value", {**value, first: bad}
        for bad in (None, "", 3, "z1", ()):
            yield f"{bad!r} as key", {**value, bad: value[first]}


class TooLongError(BaseException):
    """No Exception: nothing catches it on the way."""


@contextmanager
def at_most(seconds):
    def stop(*_):
        raise TooLongError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def answer(call, name, value):
    """Return what is wrong with the answer to a changed argument, or None.

    Files that the examples have removed since may be missing.
    """
    try:
        with at_most(SECONDS), redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", FlexplantWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            replayed(call, **{name: value})
    except (FlexplantError, OSError):
        return None
    except TooLongError:  # a number beyond all bounds is refused, not tried
        return f"more than {SECONDS:g} s" if value is HUGE else None
    except Exception as error:
        return f"{type(error).__name__}: {error!s:.100}"
    finally:
        plt.close("all")
    return None


#: public names that answer otherwise, and why: {function(argument): {kind, ...}}
OPEN = {
    # NumPy warns of inf times 0 before our error is raised; a check would cost a tenth of a step
    "KalmanEstimator.step(y)": {"inf in it"},
    "KalmanEstimator.step(u)": {"inf in it"},
}


def wrong_answers(module):
    """Return {function(argument): {kind: what is wrong}} of what a module itself defines."""
    found, seen = {}, set()
    for call in recorded(module):
        for name in parameters(call) if call.target.__module__ == module else ():
            if (call.name, name) in seen:
                continue
            seen.add((call.name, name))
            for kind, value in [*KINDS.items(), *bent(call.given.get(name))]:
                wrong = answer(call, name, value)
                if wrong:
                    found.setdefault(f"{call.name}({name})", {})[kind] = wrong
    return found


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_a_right_answer_or_an_error_of_ours(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of files are hostile too
    found = wrong_answers(module)
    lines = [
        f"{where}, {kind}: {wrong}"
        for where, kinds in found.items()
        for kind, wrong in kinds.items()
        if kind not in OPEN.get(where, ())
    ]
    assert not lines, "\n".join(lines)


def test_what_is_no_answer_is_found():
    """The walk sees errors of Python, overflows and what takes too long, and lets ours pass."""

    def crooked(x):
        if x == "a:b:c":
            raise fx.errors.LabelError("no such name. Known are: a, b")
        return 1.0 / float(x) ** 2

    call = Call("crooked", crooked, {"x": 1.0})
    said = {kind: answer(call, "x", KINDS[kind]) for kind in ("colons", "None", "huge", "2.5", "0")}
    assert said["colons"] is None and said["2.5"] is None
    assert said["None"].startswith("TypeError")
    assert said["huge"].startswith("OverflowError")
    assert said["0"].startswith("ZeroDivisionError")
    assert len(list(bent([1.0, 2.0]))) == 7


def test_attributes_that_are_not_there_answer_with_those_that_are():
    plant = fx.testbeds.three_masses()
    with pytest.raises(AttributeError, match=r"StandardPlant has no 'Gyy'. Close matches: .*Gyu"):
        _ = plant.Gyy
    with pytest.raises(AttributeError, match=r"Pictures are functions: flexplant\.plot"):
        _ = plant.plot
    assert not hasattr(plant, "_nothing")
