"""A hash of values by their contents; it shows to which values the results of a file belong."""

from __future__ import annotations

import copyreg
import hashlib
from collections.abc import Iterable, Mapping
from functools import cached_property
from types import BuiltinFunctionType, FunctionType, MappingProxyType, ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp

from .errors import ModelError

#: kinds whose repr is all there is to them
_PLAIN = (bool, int, float, complex, str, bytes, type(None))
#: kinds that count by their name, whatever their code
_NAMED = (type, FunctionType, BuiltinFunctionType, ModuleType)


def fingerprint(items: Iterable[Any]) -> str:
    """Return a hash of values by content; functions and classes count by name only."""
    try:
        return _hashed("all", *(_token(item, ()) for item in items)).hex()
    except RecursionError:
        raise ModelError(
            "the values of a checkpoint are nested too deeply to be compared. Give the machines "
            "as plain values: numbers, arrays, names of files."
        ) from None


def _token(item: Any, inside: tuple[int, ...]) -> bytes:
    """Return bytes that stand for a value; `inside` holds the ids of what contains it."""
    kind = type(item)
    if kind in _PLAIN:
        return _text(kind.__name__, hex(item) if kind is int else repr(item))
    if id(item) in inside:  # it contains itself
        return _text("outer", len(inside) - inside.index(id(item)))
    inside = (*inside, id(item))

    def all_of(parts: Iterable[Any]) -> list[bytes]:
        return [_token(part, inside) for part in parts]

    if kind in (list, tuple):
        return _hashed(kind.__name__, *all_of(item))
    if kind in (set, frozenset):
        return _hashed("set", *sorted(all_of(item)))
    if kind in (dict, MappingProxyType):
        return _hashed("dict", *(token for pair in item.items() for token in all_of(pair)))
    if isinstance(item, np.ndarray):
        values = all_of(item.ravel().tolist()) if item.dtype.hasobject else [item.tobytes()]
        return _hashed("array", _text(repr(item.dtype), item.shape), *values)
    if sp.issparse(item):
        matrix: Any = item
        coo = matrix.tocoo(copy=True)
        coo.sum_duplicates()
        return _hashed("sparse", _text(kind.__name__, coo.shape), *all_of((*coo.coords, coo.data)))
    if isinstance(item, _NAMED):
        return _name_of(item)
    return _hashed("object", _name_of(kind), *all_of(_state_of(item)))


def _state_of(item: Any) -> list[Any]:
    """Return what a value is made of, as pickle takes it apart, without cached properties."""
    cls = type(item)
    reduce = copyreg.dispatch_table.get(cls)
    try:
        found = item.__reduce_ex__(4) if reduce is None else reduce(item)
    except Exception as error:
        raise ModelError(
            f"a value of the type {cls.__name__} cannot be compared by its contents "
            f"({error!s:.80}): with a checkpoint, results of other values could be taken for those "
            "of this one. Give plain values (numbers, arrays, names of files), or leave "
            "checkpoint= out."
        ) from None
    if isinstance(found, str):  # the name under which its module has it
        return [getattr(item, "__module__", None), found]
    make, given, state, entries, pairs = (*found, None, None, None)[:5]
    states = state if isinstance(state, tuple) and len(state) == 2 else (state,)
    parts: list[Any] = [make, given]
    for one in states:
        if isinstance(one, Mapping):
            cached = {n for n in one if isinstance(getattr(cls, str(n), None), cached_property)}
            parts.append(sorted((str(n), value) for n, value in one.items() if n not in cached))
        else:
            parts.append(one)
    return [*parts, list(entries or ()), list(pairs or ())]


def _name_of(item: Any) -> bytes:
    name = getattr(item, "__qualname__", None) or item.__name__
    return _text("name", getattr(item, "__module__", None), name)


def _text(*parts: Any) -> bytes:
    return repr(parts).encode("utf-8", "surrogatepass")


def _hashed(kind: str, *parts: bytes) -> bytes:
    digest = hashlib.sha256(kind.encode())
    for part in parts:
        digest.update(b"%d:" % len(part))
        digest.update(part)
    return digest.digest()
