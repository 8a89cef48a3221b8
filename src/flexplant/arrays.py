"""Types of arrays, and the checks of arguments: numbers, seeds, names, instances of a class."""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from .errors import FlexplantError, LabelError, ModelError, ShapeError, short
from .tolerances import PRECISION

#: above this, x**3 overflows
TOO_LARGE = 1e100
FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
#: lengths along the axes; None is any
Shape: TypeAlias = tuple[int | None, ...]
#: a (n, n) matrix, dense or sparse
Matrix: TypeAlias = FloatArray | sp.csc_array

#: what seeds chance
Rng: TypeAlias = int | np.random.SeedSequence | np.random.Generator | None
#: number of refused draws in a row after which there is nothing to draw
REFUSED = 200
#: draws, runs, machines or starts in one call: days on any computer, so that more is a mistake
MOST_DRAWS = 10**7
#: node numbers stay exact as floats, and their keys in 64 bits
LARGEST_NODE = int(2 / PRECISION)
#: number of numbers of a piece of work that stays in the cache of a processor
CACHED = 200_000
#: number of columns that are processed together: one pass over a matrix serves all of them
COLUMNS = 32


def real_array(
    value: Any,
    name: str,
    shape: Shape | None = None,
    *,
    limit: float = TOO_LARGE,
    copy: bool = True,
) -> FloatArray:
    """Return `value` as a finite float64 array of the given shape (None: any length)."""
    # records of a loop that diverges may be larger than the numbers that one calculates with. Not
    # copied, an array of float64 comes back itself: for values, whose own copies are read-only
    array = floats(value, name, shape)
    if copy:
        array = np.array(array)
    if shape is not None and (
        array.ndim != len(shape)
        or any(
            want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
        )
    ):
        got = str(array.shape) if array.ndim else f"the number {array:g}"
        raise ShapeError(f"{name} must {_shape_text(shape)}, got {got}. Pass it in that form.")
    if array.size and not -limit < array.min() <= array.max() < limit:
        raise _no_finite(array, name, masked=_masks(value))
    return array


def _no_finite(array: npt.NDArray[Any], name: str, *, masked: bool) -> ModelError:
    """Return the error of an array with an entry that is NaN, infinite or too large."""
    finite = np.isfinite(array)
    if finite.all():
        return ModelError(
            f"{name} has an entry of {array.flat[np.argmax(np.abs(array))]:.3g}: its powers "
            "exceed the range of float64. Check its unit (SI)."
        )
    if not array.ndim:
        return ModelError(
            f"{name} has a NaN or infinite value ({array:g}): no result could be trusted. "
            "Pass a finite number."
        )
    where = ", ".join(str(int(i)) for i in np.argwhere(~finite)[0])
    kind = "masked" if masked else "NaN or infinite"
    return ModelError(
        f"{name} has a {kind} entry, the first at index ({where}): "
        "no result could be trusted. Remove it at its source."
    )


def complex_array(value: Any, name: str, shape: Shape | None = None) -> ComplexArray:
    """Return `value` as a finite complex128 array of the given shape (None: any length)."""
    array = _array_of(value, name)
    if np.iscomplexobj(array):
        masked = isinstance(array, np.ma.MaskedArray)
        parts: ComplexArray = np.asarray(np.ma.filled(array, np.nan) if masked else array)
    else:
        parts = np.asarray(floats(value, name, shape))
    if shape is not None:
        real_array(np.zeros(parts.shape), name, shape)
    size = np.abs(parts)
    if size.size and not size.max() < TOO_LARGE:
        raise _no_finite(size, name, masked=_masks(value))
    return np.array(parts, dtype=np.complex128)


def real_or_complex(value: Any, name: str, shape: Shape | None = None) -> FloatArray | ComplexArray:
    """Return `value` as a finite array of a shape; it is complex if `value` is complex."""
    return (complex_array if np.iscomplexobj(value) else real_array)(value, name, shape)


def floats(value: Any, name: str, shape: Shape | None = None) -> FloatArray:
    """Return real numbers as float64, of any shape, finite or not; masked entries are NaN."""
    # an array of float64 comes back itself, not a copy
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    array = _array_of(value, name)
    if np.iscomplexobj(array):
        raise ModelError(
            f"{name} must be real, got complex entries. Pass its real part if that is meant."
        )
    if array.dtype.kind not in "biufO" or (array.dtype.kind == "O" and _holds_none(array)):
        raise _no_numbers(value, name, shape)
    try:
        if isinstance(array, np.ma.MaskedArray):
            return np.asarray(np.ma.filled(np.ma.asarray(array, dtype=np.float64), np.nan))
        return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _no_numbers(value, name, shape) from error
    except OverflowError as error:
        raise ModelError(
            f"{name} has a number beyond float64: {short(value)}. Check its unit (SI)."
        ) from error


def _array_of(value: Any, name: str) -> npt.NDArray[Any]:
    """Return anything as an array of any kind; ModelError for rows of different lengths."""
    try:
        # asarray would hand over what lies under a mask as if it were data
        return np.ma.asarray(value) if _masks(value) else np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ModelError(
            f"{name} must be an array of numbers, got {short(value)}: its rows have different "
            "lengths. Give every row the same number of entries."
        ) from error


def _masks(value: Any) -> bool:
    """Return whether a value is a masked array, or a list or tuple with one in it."""
    if isinstance(value, list | tuple):
        return any(isinstance(part, np.ma.MaskedArray) for part in value)
    return isinstance(value, np.ma.MaskedArray)


def _holds_none(array: npt.NDArray[Any]) -> bool:
    return any(item is None or isinstance(item, str | bytes) for item in array.ravel())


def _no_numbers(value: Any, name: str, shape: Shape | None) -> ModelError:
    form = "be one number" if shape == () else "hold numbers"
    return ModelError(f"{name} must {form}, got {short(value)}. Pass numbers, in SI units.")


def _shape_text(shape: Shape) -> str:
    """Return in words what a shape requires."""
    if not shape:
        return "be one number"
    if shape == (None, None):
        return "be a matrix, of shape (rows, columns)"
    sizes = ", ".join("any" if n is None else str(n) for n in shape)
    return f"have shape ({sizes}{',' if len(shape) == 1 else ''})"


def number(value: Any, name: str) -> float:
    """Return `value` as one finite float."""
    return float(real_array(value, name, ()))


def floats_of(value: Any, name: str, count: int) -> tuple[float, ...]:
    """Return a number of finite numbers as a tuple."""
    return tuple(real_array(value, name, (count,)).tolist())


def positive(value: Any, name: str, *, zero: bool = False) -> float:
    """Return `value` as a positive (or, with `zero`, non-negative) float."""
    if isinstance(value, bool | np.bool_):
        raise ModelError(f"{name} must be one number, got {value}. Pass the number that is meant.")
    plain = type(value) is float and abs(value) < TOO_LARGE
    number = value if plain else float(real_array(value, name, ()))
    if number < 0 or (number == 0 and not zero):
        raise ModelError(
            f"{name} must be {'zero or ' if zero else ''}positive, got {number:g}. "
            "Check its sign and its unit (SI)."
        )
    return number


def whole(value: Any, name: str, *, minimum: int = 1, maximum: int | None = None) -> int:
    """Return `value` as an int between bounds; floats and bools are refused."""
    least = f"at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ModelError(f"{name} must be a whole number {least}, got {short(value)}. Pass an int.")
    number = int(value)
    if number < minimum or (maximum is not None and number > maximum):
        raise ModelError(f"{name} must be a whole number {least}, got {number}. Choose one there.")
    return number


def node_numbers(nodes: Any) -> IntArray:
    """Return node numbers as int64; LabelError when one is not whole or too large."""
    try:
        numbers = np.asarray(nodes if isinstance(nodes, np.ndarray) else list(nodes))
        if np.iscomplexobj(numbers):
            raise ValueError(numbers)
        with np.errstate(invalid="ignore"):  # NaN is refused below
            whole = numbers.astype(np.int64)
    except (TypeError, ValueError, OverflowError):
        numbers, whole = np.zeros(1), np.ones(1, dtype=np.int64)
    if numbers.dtype == bool or np.any(whole != numbers) or np.any(abs(whole) > LARGEST_NODE):
        raise LabelError(
            f"node numbers must be whole numbers, got {nodes!r:.80}. Give the nodes numbers, from "
            "1 say, and keep the foreign program's names elsewhere."
        )
    return np.asarray(whole, dtype=np.int64)


def positions(values: Any, name: str, count: int) -> IntArray:
    """Return positions, from 0 to below the count, as int64 (n,)."""
    array = real_array(values, name, (None,))
    if np.any(array != np.round(array)) or np.any((array < -count) | (array >= count)):
        raise ModelError(
            f"{name} must be whole numbers from 0 to {count - 1}, got {short(values)}. Choose some "
            "of them."
        )
    return np.asarray(array, dtype=np.int64)


def between(value: Any, name: str, low: float, high: float, hint: str, *, ends: str = "") -> float:
    """Return `value` as a float between two bounds."""
    number = positive(value, name, zero=low == 0.0)
    above = number >= low if "[" in ends else number > low
    if not above or not (number <= high if "]" in ends else number < high):
        where = f"be above {low:g}" if np.isinf(high) else f"lie between {low:g} and {high:g}"
        bound = " (the bound itself is excluded)" if number in (low, high) else ""
        raise ModelError(f"{name} must {where}, got {number:g}{bound}. {hint}")
    return number


def below_half_rate(freq: Any, name: str, rate: float) -> float:
    """Return a positive frequency [Hz], which must lie below half the rate [Hz] (0: continuous)."""
    number = positive(freq, name)
    if rate and number >= 0.5 * rate:
        raise ModelError(
            f"{name} is at {number:g} Hz, not below half the rate, {0.5 * rate:g} Hz: sampled, it "
            "would be another frequency. Leave it out, lower it, or raise the rate."
        )
    return number


def frequency_band(
    band: Any, name: str = "band", least: float = 0.0, most: float = np.inf
) -> tuple[float, float]:
    """Return (low, high) [Hz], increasing; the band must overlap that of two frequencies."""
    low, high = real_array(band, name, (2,)).tolist()
    if not 0 <= low < high or high < least or low > most:
        where = f"{name} must be (low, high) in Hz, within {least:g} .. {most:g}"
        raise ModelError(f"{where}, got ({low:g}, {high:g}). Give the lower end first.")
    return low, high


def positive_array(
    value: Any,
    name: str,
    shape: Shape | None = None,
    *,
    hint: str = "Check its sign and its unit (SI).",
    zero: bool = False,
) -> FloatArray:
    """Return `value` as a finite array of a shape whose entries are positive, or not negative."""
    array = real_array(value, name, shape)
    least = float(array.min(initial=np.inf))
    if least < 0.0 or (least == 0.0 and not zero):
        must = "must not be negative" if zero else "must be positive"
        raise ModelError(f"{name} {must}, got {least:g}. {hint}")
    return array


def spread_array(value: Any, name: str, shape: tuple[int, ...]) -> FloatArray:
    """Return positive numbers of a shape; a number or an array of fewer axes is broadcast."""
    given = positive_array(value, name)
    try:
        return np.broadcast_to(given, shape).copy()
    except ValueError:
        raise ShapeError(
            f"{name} of shape {given.shape} does not spread to the data: {shape}. Pass one number, "
            "or one for each."
        ) from None


def element_mask(value: Any, name: str) -> npt.NDArray[np.bool_]:
    """Return which elements of a mesh are chosen; at least one must be."""
    mask = np.asarray(_array_of(value, name))
    if mask.dtype != bool or not mask.any():
        raise ShapeError(
            f"{name} must be True or False for each element and choose some, got {short(value)}. "
            "Pass a comparison, x < 0.3, say."
        )
    return mask


def known_units(units: Any, names: Iterable[str]) -> dict[str, str]:
    """Return the units of some channels; those of other names are left out."""
    if not isinstance(units, Mapping) or not all(isinstance(u, str) for u in units.values()):
        raise ModelError(
            f"units must be a mapping {{channel: unit}}, got {short(units)}: {{'y1': 'm'}}."
        )
    return {name: units[name] for name in names if name in units}


def flag(value: Any, name: str) -> bool:
    """Return `value` as a bool; it must be True or False, not a number."""
    if not isinstance(value, bool | np.bool_):
        raise ModelError(f"{name} must be True or False, got {short(value)}. Pass one of them.")
    return bool(value)


def instance(
    value: Any, kind: Any, name: str, hint: str, error: type[FlexplantError] = ModelError
) -> Any:
    """Return `value`, which must be of a class, or of one of several."""
    if not isinstance(value, kind) or (kind is Iterable and not several(value)):
        listed = [one.__name__ for one in getattr(kind, "__args__", (kind,))]
        kinds = " or ".join(name for name in listed if name != "NoneType")
        raise error(f"{name} must be of type {kinds}, got {type(value).__name__}. {hint}")
    return value


def one_of(value: Any, name: str, choices: Iterable[str]) -> str:
    """Return the allowed text that `value` is equal to; an underscore counts as a space."""
    listed = list(choices)
    if isinstance(value, str) and value in listed:
        return value
    spaced = [one for one in listed if isinstance(value, str) and one == value.replace("_", " ")]
    if not spaced:
        raise ModelError(f"{name} must be one of {listed}, got {short(value)}. Pass one of them.")
    return spaced[0]


def signal_names(names: Iterable[str], count: int, prefix: str, side: str) -> tuple[str, ...]:
    """Return `count` unique signal names, `prefix1`, `prefix2`, ... when none are given."""
    listed = name_list(names, side) if names is not None else ()
    if not listed:
        return tuple(f"{prefix}{i}" for i in range(1, count + 1))
    if len(listed) != count:
        raise ShapeError(
            f"{count} {side} need {count} names, got {len(listed)}: {short(listed)}. Name each "
            f"once, or none to have {prefix}1, {prefix}2, ..."
        )
    check_names(listed, side)
    return listed


def several(value: Any) -> bool:
    """Return whether a value is iterable (a list, a generator, an array), but not a text."""
    if isinstance(value, str | bytes) or (isinstance(value, np.ndarray) and not value.ndim):
        return False
    return isinstance(value, Iterable)


def as_list(items: Any, name: str, form: str) -> list[Any]:
    """Return items as a list; LabelError when there is nothing to list."""
    if not several(items):
        raise LabelError(f"{name} must be {form}, got {items!r:.60}. Pass it in [...].")
    return list(items)


def name_list(names: Any, name: str) -> tuple[str, ...]:
    """Return names as a tuple of str; one str is one name."""
    if type(names) is tuple and set(map(type, names)) <= {str}:
        return names
    if isinstance(names, str):
        return (names,)
    if not several(names):
        raise LabelError(f"{name} are chosen by name, got {short(names)}. Pass a list of names.")
    listed = tuple(names)
    wrong = [one for one in listed if not isinstance(one, str)]
    if wrong:
        raise LabelError(
            f"{name} are chosen by name, got {short(wrong[0])} among them. Pass a list of names."
        )
    return tuple(str(one) for one in listed)


def inner_names(names: Iterable[str], taken: Iterable[str]) -> tuple[str, ...]:
    """Return internal names, lengthened by '|' until they differ from all names of the user."""
    found, known = tuple(names), set(taken)
    while not known.isdisjoint(found):
        found = tuple(f"{name}|" for name in found)
    return found


def check_names(names: Sequence[str], side: str) -> None:
    """Raise LabelError unless the names are unique and of the allowed form."""
    text = "\n".join(["", *names, ""])
    if not ("." in text or "\n-" in text or "\n\n" in text) and len(set(names)) == len(names):
        return
    for name in names:
        if not name or "." in name or name.startswith("-"):
            raise LabelError(
                f"{name!r} cannot name one of the {side}: names are not empty, hold no '.' and do "
                "not begin with '-' (python-control refuses those). Rename it."
            )
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise LabelError(
            f"the {side} hold {doubled} more than once: names select channels, so each must be "
            "unique. Rename all but one."
        )


def members(values: Any, kind: Any, name: str, hint: str, *, least: int = 1) -> tuple[Any, ...]:
    """Return several values as a tuple, all of a class."""
    listed = tuple(values) if several(values) else ()
    if (
        not several(values)
        or len(listed) < least
        or not all(isinstance(one, kind) for one in listed)
    ):
        kinds = " or ".join(one.__name__ for one in getattr(kind, "__args__", (kind,)))
        many = "" if not least else "at least one " if least == 1 else f"at least {least} "
        raise ModelError(f"{name} must be a list of {many}{kinds}, got {short(values)}. {hint}")
    return listed


def mapping(
    value: Any,
    name: str,
    hint: str,
    *,
    least: int = 0,
    kind: Any = object,
    error: type[FlexplantError] = ModelError,
) -> dict[Any, Any]:
    """Return a mapping with a least number of entries, all of a class, as a dict."""
    if not isinstance(value, Mapping) or len(value) < least:
        filled = f" with {least} or more entries" if least else ""
        raise error(f"{name} must be a mapping{filled}, got {short(value)}. {hint}")
    return {
        key: instance(one, kind, f"{key!r} of {name}", hint, error) for key, one in value.items()
    }


def why_not_called(function: Any, *arguments: Any) -> str:
    """Return why a function does not take such arguments; empty if it does, or cannot be told."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        return str(error)
    except ValueError:  # a function of C has no signature
        pass
    return ""


def function(value: Any, name: str, hint: str) -> Any:
    """Return `value`, which must be callable."""
    if not callable(value):
        raise ModelError(f"{name} must be a function, got {short(value)}. {hint}")
    return value


def divisor(size: Any) -> FloatArray:
    """Return sizes to divide by, with 1 in place of zero."""
    return np.asarray(np.where(size > 0, size, 1.0))


def seed_sequence(rng: Any, name: str = "rng") -> np.random.SeedSequence:
    """Return the SeedSequence that a seed, SeedSequence, Generator or None stands for."""
    # a Generator is drawn from, so that two calls with the same one differ
    if isinstance(rng, np.random.SeedSequence):
        return rng
    if isinstance(rng, np.random.Generator):
        return np.random.SeedSequence(rng.integers(0, 2**32, size=4).tolist())
    if rng is None:
        return np.random.SeedSequence()
    numbers = [rng] if isinstance(rng, int | np.integer) else rng
    single = isinstance(numbers, np.ndarray) and not numbers.ndim
    if isinstance(numbers, list | tuple | np.ndarray) and not single:
        entropy = [n for n in numbers if isinstance(n, int | np.integer) and n >= 0]
        if len(entropy) == len(numbers) and not any(isinstance(n, bool) for n in numbers):
            given = [int(n) for n in entropy]
            return np.random.SeedSequence(given[0] if numbers is not rng else given)
    raise ModelError(
        f"{name} must be a seed (a whole number from 0, or several), a SeedSequence, a Generator "
        f"or None, got {short(rng)}. Pass an int to have the same draw again."
    )


def seed_of(sequence: np.random.SeedSequence) -> int | tuple[int, ...]:
    """Return the number, or numbers, that give the same draws as a SeedSequence when passed as rng.

    For a spawned SeedSequence it is a list: four words of entropy, then the key of its place.
    """
    entropy: Any = sequence.entropy
    given = entropy if isinstance(entropy, Sequence | np.ndarray) else (entropy,)
    numbers = tuple(int(number) for number in given)
    if not sequence.spawn_key:
        return numbers[0] if given is not entropy else numbers
    words = [n >> k & 0xFFFFFFFF for n in numbers for k in range(0, max(n.bit_length(), 1), 32)]
    return (*words, *(0,) * (sequence.pool_size - len(words)), *sequence.spawn_key)


def generator(rng: Any, name: str = "rng") -> np.random.Generator:
    """Return the Generator that a seed, SeedSequence, Generator or None stands for."""
    if isinstance(rng, np.random.Generator):
        return rng
    return np.random.default_rng(seed_sequence(rng, name))
