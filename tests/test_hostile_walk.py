"""Every public call that a docstring shows, with one argument made hostile: an error of ours.

The calls are those of the examples, recorded as they run: a new function joins by its example.
"""

import contextlib
import doctest
import importlib
import inspect
import io
import pkgutil
import sys
import warnings
from collections.abc import Callable as Function

import matplotlib.pyplot as plt
import numpy as np
import pytest

import flexplant as fx
from flexplant.calls import unfit
from flexplant.checks import Value
from flexplant.errors import FlexplantError

HUGE = 10**400


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """A text is a path to whoever writes files."""
    monkeypatch.chdir(tmp_path)


class Odd:
    """No kind of anything."""


HOSTILE = {
    "nan": float("nan"), "inf": float("inf"), "-1": -1, "half": 0.5, "huge": HUGE, "complex": 1j,
    "None": None, "odd": Odd(), "text": "a:b:c", "nothing": "", "[]": [], "[None]": [None],
    "{}": {}, "empty": np.empty(0), "[nan]": np.array([np.nan]), "cube": np.ones((2, 2, 2)),
}  # fmt: skip


def variants(value):
    """Yield what is put in place of a value: hostile ones, and itself spoilt."""
    yield from HOSTILE.items()
    if isinstance(value, np.ndarray) and value.size and value.dtype.kind in "fc":
        for name, wrong in (("spoilt", np.nan), ("endless", np.inf)):
            copy = np.array(value)
            copy.flat[0] = wrong
            yield name, copy
        yield "longer", np.concatenate([value, value])
        yield "narrower", value[..., :-1]
    if isinstance(value, list | tuple) and value:
        yield "doubled", [*value, *value]
        yield "odd within", [*value, Odd()]
    if isinstance(value, dict) and value:
        yield "odd value", {**value, next(iter(value)): Odd()}


def public(room):
    """Return {code: what is called} of the functions, kinds and methods that a room shows."""
    found = {}
    for name in dir(room):
        item = getattr(room, name)
        if inspect.isfunction(item):
            found[inspect.unwrap(item).__code__] = item
        elif inspect.isclass(item) and issubclass(item, Value):
            if inspect.isfunction(item.__init__):
                found[item.__init__.__code__] = item
            for key, method in vars(item).items():
                if not key.startswith("_") and inspect.isfunction(method):
                    found[inspect.unwrap(method).__code__] = method
    return found


def recorded(name):
    """Return {what is called: its first arguments by name} in the examples of a room."""
    room = importlib.import_module(name)
    wanted, found = public(room), {}

    def note(frame, event, _):
        if event == "call" and (called := wanted.get(frame.f_code)) and called not in found:
            found[called] = dict(frame.f_locals)

    for info in pkgutil.walk_packages(room.__path__, f"{name}."):
        for example in doctest.DocTestFinder().find(importlib.import_module(info.name)):
            sys.setprofile(note)
            with contextlib.redirect_stdout(io.StringIO()):  # functions of examples stay callable
                doctest.DocTestRunner(verbose=False).run(example, clear_globs=False)
            sys.setprofile(None)
            plt.close("all")
    return found


def call(called, given):
    """Call with arguments by name."""
    args, named = [], {}
    for parameter in inspect.signature(called).parameters.values():
        if parameter.name not in given:
            continue
        value = given[parameter.name]
        if parameter.kind is parameter.VAR_POSITIONAL:
            args.extend(value if isinstance(value, list | tuple) else [value])
        elif parameter.kind is parameter.VAR_KEYWORD:
            named.update(value)
        elif parameter.kind is parameter.KEYWORD_ONLY:
            named[parameter.name] = value
        else:
            args.append(value)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return called(*args, **named)


#: functions of users, which may raise what they like, what works for seconds, and what matplotlib
#: answers in full
LEFT_OUT = ("self", "cls", "progress", "executor", "build", "design", "trial", "color")


#: rooms by how long their walk takes; whose examples take a quarter of a minute: ``-m benchmark``
QUICK = ["lti", "modes", "structure", "reduction", "joining", "plant"]
LONG = [
    pytest.param(one, marks=pytest.mark.long)
    for one in ("loop", "identification", "updating", "placement", "io")
]
DESIGNS = [
    pytest.param(one, marks=pytest.mark.benchmark)
    for one in ("estimation", "simulation", "synthesis", "sparse", "testbeds", "plot")
]


@pytest.mark.slow
@pytest.mark.parametrize("room", [*QUICK, *LONG, *DESIGNS])
def test_hostile_arguments_meet_errors_of_ours(room):
    calls = recorded(f"flexplant.{room}")
    assert len(calls) >= 2
    raw = []
    for called, given in calls.items():
        for name, value in given.items():
            if name in LEFT_OUT:
                continue
            for kind, wrong in variants(value):
                try:
                    call(called, given | {name: wrong})
                except (FlexplantError, OSError):  # files of an example are gone
                    pass
                except Exception as error:
                    raw.append(f"{called.__qualname__}({name}={kind}): {error!r}")
                plt.close("all")
    assert not raw, "\n".join(raw)


def hooks():
    """Yield methods of values that functions call, with what each needs."""
    values = [
        *(
            fx.AddedMass("1:x"),
            fx.AddedStiffness("1:x"),
            fx.updating.MatrixParameter("k", dK=[[1]]),
        ),
        *(fx.PoiVariance(), fx.placement.PoiLqr(), fx.placement.ClosedLoopH2()),
        *(fx.synthesis.H2(), fx.synthesis.Hinf(), fx.synthesis.FixedOrder(2), fx.Riccati()),
        *(fx.simulation.Quantiser(1.0), fx.Eigenvalues(fx.MeasuredModes([-1 + 9j], modes=[1]))),
        *(
            fx.Spring("1:x", 1.0),
            fx.structure.Rayleigh(1.0, 1e-6),
            fx.Sensor("y", at="1:x"),
            fx.Notch(9.0),
        ),
        *(fx.Actuator("u", at="1:x"), fx.BaseAcceleration("b"), fx.reduction.ModalTruncation(3)),
    ]
    for value in values:
        for name in dir(type(value)):
            if not name.startswith("_") and inspect.isroutine(getattr(type(value), name)):
                taken = inspect.signature(getattr(value, name)).parameters.values()
                several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
                needed = [p.name for p in taken if p.default is p.empty and p.kind not in several]
                if needed:
                    yield getattr(value, name), needed


@pytest.mark.slow
def test_hooks_of_protocols_meet_errors_of_ours():
    wrong = [None, 3, Odd(), "text", [], np.ones((2, 2)), fx.testbeds.three_masses()]
    raw, count = [], 0
    for hook, needed in hooks():
        for one in wrong:
            count += 1
            try:
                call(hook, dict.fromkeys(needed, one))
            except (FlexplantError, OSError):
                pass
            except Exception as error:
                raw.append(f"{hook.__qualname__}({one!r:.20}): {error!r}")
    assert not raw, "\n".join(raw)
    assert count > 200


@pytest.mark.parametrize(
    ("value", "hint", "wanted"),
    [
        ("two", float | None, "a finite number or None"),
        (HUGE, int, "a whole number"),
        (np.int64(2), int, ""),
        (np.float32(2), float, ""),
        ([1, 2], np.ndarray, ""),
        ([1, np.nan], np.ndarray, "an array of finite numbers"),
        (3.0, np.ndarray, "an array of finite numbers"),
        ("abc", tuple[str, ...], "a sequence"),
        (["a", 1], tuple[str, ...], "a sequence, each text"),
        ((1.0,), tuple[float, float], "a sequence of 2"),
        ({"a": "b"}, dict[str, float], "a mapping, each a finite number"),
        (3, fx.Modes, "a Modes"),
        (3, Function[[int], int], "a function"),
    ],
)
def test_annotations_in_words(value, hint, wanted):
    assert unfit(value, hint) == wanted


def test_the_argument_at_fault_is_named_and_errors_of_users_are_left():
    with pytest.raises(FlexplantError, match=r"order of balanced must be a whole number or None"):
        fx.balanced(fx.testbeds.three_masses().system, order=float("nan"))
    with pytest.raises(FlexplantError, match=r"dofs of PointMass.added must be a DofSet, got 3"):
        fx.PointMass("1:z", 1.0).added(3)
    with pytest.raises(
        TypeError, match=r"assemble_plant takes no argument 'evaluaton'.*evaluation"
    ):
        fx.assemble_plant(None, None, evaluaton=None)

    def wrong(plant):
        raise ValueError("mine")

    plant = fx.testbeds.three_masses()
    with pytest.raises(ValueError, match=r"^mine$"):
        fx.score_sensors(plant, [["y1"]], wrong)
