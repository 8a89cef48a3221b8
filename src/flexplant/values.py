"""The base of all values, and the checks at the public door."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from .errors import LabelError, ModelError, ShapeError

FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
IntArray: TypeAlias = npt.NDArray[np.int64]
#: a (n, n) matrix, dense or sparse
Matrix: TypeAlias = "FloatArray | sp.csc_array"


class Value:
    """A frozen dataclass whose arrays are read-only copies, also after pickling and loading."""

    registry: ClassVar[dict[str, type[Value]]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        Value.registry[cls.__name__] = cls

    def _set(self, **values: Any) -> None:
        """Set fields during construction; arrays become read-only copies."""
        for name, value in values.items():
            object.__setattr__(self, name, frozen(value))

    def _fields(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def __reduce__(self) -> tuple[Any, ...]:
        state = {
            name: dict(value) if isinstance(value, MappingProxyType) else value
            for name, value in self._fields().items()
        }
        return rebuild, (type(self), state)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, checked like a new one."""
        return replace(self, **changes)  # type: ignore[type-var]

    def save(self, path: str | Path) -> None:
        """Write the value to one `.npz` file (arrays and JSON, no pickle), atomically.

        Parameters
        ----------
        path : str or Path
            The file; `flexplant.load` reads it back.
        """
        from .store import save

        save(self, path)


def rebuild(cls: type[Value], state: Mapping[str, Any]) -> Value:
    """Return a value from its fields as they were, without the checks of construction."""
    value = object.__new__(cls)
    for name, item in state.items():
        object.__setattr__(value, name, frozen(item))
    return value


def frozen(value: Any) -> Any:
    """Return a read-only copy of an array, sparse matrix or mapping; anything else as it is."""
    if isinstance(value, np.ndarray):
        if not value.flags.writeable and value.base is None:
            return value
        value = np.array(value)
        value.flags.writeable = False
    elif sp.issparse(value):
        sparse: Any = value
        value = sp.csc_array(sparse, copy=True)
        value.sum_duplicates()
        for part in (value.data, value.indices, value.indptr):
            part.flags.writeable = False
    elif type(value) is tuple and value and isinstance(value[0], np.ndarray):
        value = tuple(frozen(item) for item in value)
    elif isinstance(value, Mapping) and not isinstance(value, MappingProxyType | Value):
        value = MappingProxyType({key: frozen(item) for key, item in value.items()})
    return value


def real_array(value: Any, name: str, shape: tuple[int | None, ...] | None = None) -> FloatArray:
    """Return `value` as a finite float64 array of the given shape (None: any length).

    Raises
    ------
    ShapeError
        When the shape differs.
    ModelError
        When entries are complex, NaN or infinite.
    """
    array = np.asarray(value)
    if np.iscomplexobj(array):
        raise ModelError(f"{name} must be real, got complex entries. Pass its real part if meant.")
    try:
        array = np.array(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name} must hold numbers, got {value!r:.80}.") from error
    if shape is not None and (
        array.ndim != len(shape)
        or any(
            want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
        )
    ):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ShapeError(f"{name} must have shape {wanted}, got {array.shape}.")
    if not np.all(np.isfinite(array)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ModelError(
            f"{name} has a NaN or infinite entry, the first at index {where}: "
            "no result could be trusted. Remove it at its source."
        )
    return array


def positive(value: Any, name: str, *, zero: bool = False) -> float:
    """Return `value` as a positive (or, with `zero`, non-negative) float.

    Raises
    ------
    ModelError
        When it is not.
    """
    number = float(real_array(value, name, ()))
    if number < 0 or (number == 0 and not zero):
        raise ModelError(f"{name} must be {'zero or ' if zero else ''}positive, got {number:g}.")
    return number


def signal_names(names: Iterable[str], count: int, prefix: str, side: str) -> tuple[str, ...]:
    """Return `count` unique signal names, `prefix1`, `prefix2`, ... when none are given.

    Raises
    ------
    LabelError
        When names are doubled, empty, hold a '.' or begin with '-' (python-control refuses those).
    ShapeError
        When their number is not `count`.
    """
    listed = (names,) if isinstance(names, str) else tuple(str(name) for name in names or ())
    if not listed:
        return tuple(f"{prefix}{i}" for i in range(1, count + 1))
    if len(listed) != count:
        raise ShapeError(
            f"{count} {side} need {count} names, got {len(listed)}: {list(listed)!r:.120}."
        )
    check_names(listed, side)
    return listed


def check_names(names: Sequence[str], side: str) -> None:
    """Raise LabelError unless the names are unique and of the allowed form."""
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
