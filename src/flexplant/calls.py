"""Calls of the public names: where one fails, the argument that does not fit its annotation.

Arguments are checked by what uses them. What no check foresees (a DofSet where a plant is needed,
text for a number) fails inside with an error of the interpreter; a call from outside the package
then compares what it was given with its annotations, and raises a ModelError that names the first
argument that does not fit. A call that succeeds pays for a `try` only, and an error of a call
whose arguments all fit is left as it is.
"""

from __future__ import annotations

import collections.abc as abc
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import update_wrapper
from inspect import Parameter, signature, unwrap
from types import FunctionType, NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np
import numpy.typing as npt

from .errors import FlexplantError, ModelError, ShapeError, short, unknown_keyword

F = TypeVar("F", bound=Callable[..., Any])

#: what the interpreter, NumPy and SciPy raise where an argument is not of the kind that is used
FAILURES = (TypeError, ValueError, AttributeError, LookupError, ArithmeticError)
#: elements of a sequence or mapping that are looked at: more would take seconds
_LOOKED_AT = 1000
#: kinds of arrays of real numbers, in NumPy's letters
_REAL = "fiub"
#: what runs beneath this package
_BENEATH = ("flexplant", "numpy", "scipy", "pandas")
_MANY = (list, tuple, abc.Sequence, abc.Iterable, abc.Collection, abc.Set)
_WORDS = {str: "text", bool: "True or False", float: "a finite number", int: "a whole number"}


def answering(function: F) -> F:
    """Return a function that names, where it fails, the argument that does not fit."""
    failures, explained, frame = FAILURES, explanation, sys._getframe

    def call(*args: Any, **named: Any) -> Any:
        try:
            return function(*args, **named)
        except failures as error:
            found = explained(function, args, named, error, frame(1).f_globals)
            if found is None:
                raise
            raise found from error

    own = cast("FunctionType", function)
    if vars(own).get("answers"):
        return function
    # with the names of its module: there documentation and doctests look for what belongs to it
    made = FunctionType(call.__code__, own.__globals__, own.__name__, None, call.__closure__)
    vars(made)["answers"] = True
    return cast("F", update_wrapper(made, own))


def explanation(
    called: Any,
    args: tuple[Any, ...],
    named: Mapping[str, Any],
    error: Exception,
    caller: Mapping[str, Any],
) -> Exception | None:
    """Return the error that names the argument at fault; None: the error says it itself."""
    # calls from within the package are noted for the outermost one: its arguments are the user's,
    # and come first
    if isinstance(error, FlexplantError):
        return None
    inner = vars(error).setdefault("calls_of_flexplant", [])
    inner.append((called, args, named))
    if str(caller.get("__name__")).startswith("flexplant."):
        return None
    taken = signature(called).parameters
    unknown = [name for name in named if name not in taken]
    if unknown and not any(p.kind is p.VAR_KEYWORD for p in taken.values()):
        own = [name for name in taken if name not in ("self", "cls")]
        return unknown_keyword(called.__name__, unknown[0], own)
    outward = [(one, _annotated_arguments(one, *of)) for one, *of in reversed(inner)]
    for strict in (False, True):
        for one, given in outward:
            for name, (value, hint) in given.items():
                wanted = unfit(value, hint, strict=strict)
                if wanted:
                    return ModelError(
                        f"{name} of {one.__qualname__} must be {wanted}, got {short(value)} "
                        f"({type(value).__name__}). help() of {one.__qualname__} says what it is."
                    )
    shapes = [f"{n} {v.shape}" for n, (v, _) in outward[0][1].items() if isinstance(v, np.ndarray)]
    if shapes and isinstance(error, ValueError | IndexError | TypeError) and _is_ours(error):
        return ShapeError(
            f"{called.__qualname__} failed ({error}) with arrays {', '.join(shapes)}: their shapes "
            f"may not belong together. help() of {called.__qualname__} says which they must have."
        )
    return None


def _annotated_arguments(called: Any, args: Any, named: Any) -> dict[str, tuple[Any, Any]]:
    """Return the arguments of a call by name, each with its annotation."""
    taken = signature(called)
    try:
        given = taken.bind(*args, **named).arguments
    except TypeError:  # one too many, or one is missing: the interpreter says which
        return {}
    several = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
    named_ones = {n: v for n, v in given.items() if taken.parameters[n].kind not in several}
    return {n: (v, _hint(called, n)) for n, v in named_ones.items()}


def _hint(called: Any, name: str) -> Any:
    """Return the annotation of an argument; Any where its names are for checkers only."""
    if isinstance(called, type):  # that of the field, in the module of the kind that declares it
        owners = (k for k in called.__mro__ if name in vars(k).get("__annotations__", {}))
        owner = next(owners, object)
        hint = vars(owner).get("__annotations__", {}).get(name, Any)
        names = vars(sys.modules[owner.__module__])
    else:
        function = unwrap(called)
        hint, names = function.__annotations__.get(name, Any), function.__globals__
    try:
        return eval(hint, names) if isinstance(hint, str) else hint  # the package's own text
    except (NameError, TypeError, AttributeError):
        return Any


def _is_ours(error: Exception) -> bool:
    """Return whether an error was raised in this package or beneath it, by no code of the user."""
    trace = error.__traceback__
    packages = []
    while trace is not None:
        packages.append(str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0])
        trace = trace.tb_next
    return all(p in _BENEATH or p in sys.stdlib_module_names for p in packages)


def unfit(value: Any, hint: Any, *, strict: bool = False) -> str:
    """Return in words what an annotation wants, where a value is no such thing; else nothing.

    More fits than for a type checker: real numbers of any type, sequences as arrays (unless
    `strict`) and tuples.

    Examples
    --------
    >>> unfit("two", float | None)
    'a finite number or None'
    >>> unfit([1, 2], npt.NDArray[np.float64])
    ''
    """
    origin, inner = get_origin(hint), get_args(hint)
    kind = origin or hint
    if origin in (Union, UnionType) and hint != npt.ArrayLike:
        words = [unfit(value, one, strict=strict) for one in inner]
        return " or ".join(dict.fromkeys(words)) if all(words) else ""
    if hint == npt.ArrayLike or kind is np.ndarray:
        least = int(kind is np.ndarray)
        if strict and least and not isinstance(value, np.ndarray) and not hasattr(value, "tocsc"):
            return "an array of NumPy"
        fits = _fits_array(value, least, _REAL + "c" if "complex" in str(inner) else _REAL)
        return "" if fits else "an array of finite numbers"
    if hint is None or hint is NoneType:
        return "" if value is None else "None"
    if origin is Literal:
        return "" if isinstance(value, str) and value in inner else f"one of {list(inner)}"
    if kind in (float, int, complex):
        return "" if _fits_number(value, kind) else _WORDS.get(kind, "a number")
    if kind is Any:
        return ""
    if kind is abc.Callable:
        return "" if callable(value) else "a function"
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return ""
    if kind is bool:
        return "" if isinstance(value, bool | np.bool_) else _WORDS[bool]
    if kind in _MANY:
        return _unfit_elements(value, "a sequence", value, inner)
    if kind in (dict, Mapping) and isinstance(value, Mapping):
        return _unfit_elements(value, "a mapping", value.values(), inner[1:])
    return "" if isinstance(value, kind) else _WORDS.get(kind, f"a {kind.__name__}")


def _unfit_elements(value: Any, what: str, elements: Iterable[Any], inner: Sequence[Any]) -> str:
    """Return what a sequence or mapping must be of, where it or an element does not fit."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        return what
    if not inner or not isinstance(value, abc.Sized):  # an iterator is used up by a look
        return ""
    fixed = len(inner) > 1 and inner[1] is not Ellipsis
    if fixed and len(value) != len(inner):
        return f"{what} of {len(inner)}"
    hints = inner if fixed else [inner[0]] * min(len(value), _LOOKED_AT)
    words = (unfit(one, hint) for one, hint in zip(elements, hints, strict=False))
    said = next((word for word in words if word), "")
    return f"{what}, each {said}" if said else ""


def _fits_number(value: Any, kind: type) -> bool:
    """Return whether a value is one finite number of a kind that 64 bits hold."""
    array = _as_array(value)
    letters = {int: "iu", float: _REAL, complex: _REAL + "c"}[kind]
    return array is not None and array.ndim == 0 and _are_finite(array, letters)


def _fits_array(value: Any, least: int, letters: str) -> bool:
    """Return whether a value is a finite array of at least so many axes."""
    array = _as_array(value)
    if array is None or hasattr(value, "tocsc"):  # a sparse matrix is checked by what uses it
        return array is not None
    return array.ndim >= least and _are_finite(array, letters)


def _as_array(value: Any) -> npt.NDArray[Any] | None:
    try:
        return np.asarray(value)
    except (TypeError, ValueError, OverflowError):  # ragged, or no such thing
        return None


def _are_finite(array: npt.NDArray[Any], letters: str) -> bool:
    return array.dtype.kind in letters and bool(np.all(np.isfinite(array)))
