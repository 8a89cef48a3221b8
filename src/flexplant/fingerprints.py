"""A digest of code and values: results in a file belong to what computed them, and to that only."""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import importlib
import importlib.util
import sys
import sysconfig
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import numpy as np
import scipy.sparse as sp

from .errors import ModelError

#: kinds whose repr is all there is to them
_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), type(NotImplemented))
#: kinds without contents that a result could depend on: locks, and caches of what is elsewhere
_EMPTY = (
    *(type(threading.Lock()), type(threading.RLock())),
    *(weakref.WeakKeyDictionary, weakref.WeakValueDictionary, weakref.WeakSet),
)
#: entries of a class that its other entries imply, or that describe it to a reader only
_IMPLIED = {
    *("__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "_abc_impl"),
    *("__dataclass_fields__", "__firstlineno__", "__static_attributes__", "__annotate_func__"),
    *("__orig_bases__", "__parameters__", "__annotations_cache__"),
}
#: folders of what is installed, whose functions count by name
_INSTALLED = {
    Path(__file__).parent.resolve(),
    *(Path(p).resolve() for name, p in sysconfig.get_paths().items() if name.endswith("lib")),
}
#: names of folders of other environments
_PACKAGES = ("site-packages", "dist-packages")


def fingerprint(items: Iterable[Any]) -> str:
    """Return a digest of values by content and of functions by code."""
    # code is the bytecode of functions, with their closures, defaults and the global values that
    # they reach in modules of the user; functions and classes of installed packages count by name
    reader = _Contents()
    try:
        parts = [reader.token(item, f"item {i}") for i, item in enumerate(items)]
        return _hashed("all", *parts, *reader.reached()).hex()
    except RecursionError:
        raise ModelError(
            "the values of a checkpoint are nested too deeply to be compared. Give the machines "
            "as plain values: numbers, arrays, names of files."
        ) from None


class _Contents:
    """Reads values and code once each; what is reached by a global name is read at the end."""

    def __init__(self) -> None:
        #: digests of what was read, which is kept so that no other value gets its id
        self._known: dict[int, tuple[Any, bytes]] = {}
        #: what is being read, from the outside to the inside
        self._open: list[int] = []
        self._path: list[str] = []
        #: values by module and global name
        self._names: dict[tuple[str, str], Any] = {}
        #: modules, each with the names for which it was searched
        self._searched: set[tuple[str, frozenset[str]]] = set()

    def reached(self) -> list[bytes]:
        """Return the tokens of all global values, in the order of their names."""
        found: dict[tuple[str, str], bytes] = {}
        while new := [key for key in self._names if key not in found]:
            for key in new:
                found[key] = self.token(self._names[key], ".".join(key))
        return [_hashed("global", _text(key), found[key]) for key in sorted(found)]

    def token(self, item: Any, name: str) -> bytes:
        """Return bytes that stand for a value; the name is for messages."""
        if type(item) in _PLAIN:
            return _text((type(item).__name__, hex(item) if type(item) is int else repr(item)))
        key = id(item)
        if key in self._known:
            return self._known[key][1]
        if key in self._open:  # it contains itself
            return _hashed("outer", _text(len(self._open) - self._open.index(key)))
        self._open.append(key)
        self._path.append(name)
        found = self._read(item)
        self._open.pop()
        self._path.pop()
        self._known[key] = item, found
        return found

    def _all(self, items: Iterable[Any], name: str = "") -> list[bytes]:
        return [self.token(item, f"{name}[{i}]") for i, item in enumerate(items)]

    def _named(self, items: Mapping[str, Any], without: Iterable[str] = ()) -> list[bytes]:
        """Return tokens of attributes by name, in whatever order they were set."""
        kept = sorted((str(name), value) for name, value in items.items() if name not in without)
        return [_text([n for n, _ in kept]), *(self.token(v, n) for n, v in kept)]

    def _read(self, item: Any) -> bytes:
        kind = type(item)
        if kind in (list, tuple):
            return _hashed(kind.__name__, *self._all(item))
        if kind in (set, frozenset):
            return _hashed("set", *sorted(self._all(item)))
        if kind in (dict, MappingProxyType):
            pairs = [self._all(pair, repr(pair[0])[:40]) for pair in item.items()]
            return _hashed("dict", *(token for pair in pairs for token in pair))
        if kind in (np.ndarray, np.memmap):
            values = self._all(item.ravel().tolist()) if item.dtype.hasobject else [item.tobytes()]
            return _hashed("array", _text((repr(item.dtype), item.shape)), *values)
        if sp.issparse(item):
            matrix: Any = item
            coo = matrix.tocoo(copy=True)
            coo.sum_duplicates()
            return _hashed(
                "sparse", _text((kind.__name__, coo.shape)), *self._all((*coo.coords, coo.data))
            )
        if isinstance(item, FunctionType):
            return self._function(item)
        if isinstance(item, CodeType):
            return self._code(item)
        if isinstance(item, type):
            return self._class(item)
        if isinstance(item, ModuleType):
            return self._module(item, None)
        return self._object(item)

    def _function(self, item: FunctionType) -> bytes:
        if _is_installed(item.__module__) and _is_found(item):
            return _hashed("name", _text((item.__module__, item.__qualname__)))
        code, home = item.__code__, str(item.__globals__.get("__name__", ""))
        if _is_installed(home):  # made by a decorator, say: its closure has what it calls
            parts = [_text((home, code.co_qualname))]
        else:
            parts = [self._code(code, item.__doc__), *self._globals(code, item.__globals__, home)]
        cells = []
        for cell in item.__closure__ or ():
            try:
                cells.append(cell.cell_contents)
            except ValueError:  # not assigned yet
                cells.append(None)
        parts += self._named(dict(zip(code.co_freevars, cells, strict=True)))
        parts += self._all((item.__defaults__, item.__kwdefaults__), "default")
        return _hashed("function", *parts, *self._named(vars(item)))

    def _code(self, code: CodeType, doc: str | None = None) -> bytes:
        """Return the token of bytecode: the same when comments, lines or the docstring change."""
        constants = code.co_consts
        if doc is not None and constants and constants[0] == doc:
            constants = constants[1:]
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        text, table = _text((counts, names)), code.co_exceptiontable
        return _hashed("code", text, code.co_code, table, *self._all(constants, "constant"))

    def _globals(self, code: CodeType, known: Mapping[str, Any], home: str) -> list[bytes]:
        """Return tokens of the global names and imports of a function and of those inside it."""
        read: set[str] = set()
        words: set[str] = set()
        imports: set[tuple[str, tuple[str, ...]]] = set()
        for one in _nested_code(code):
            words.update(one.co_names)
            steps = [s for s in dis.get_instructions(one) if s.opname != "EXTENDED_ARG"]
            for i, step in enumerate(steps):
                if step.opname.startswith("LOAD") and step.opname.endswith(
                    ("GLOBAL", "NAME", "GLOBALS")
                ):
                    read.add(step.argval)
                elif step.opname == "IMPORT_NAME":
                    level, wanted = steps[i - 2].argval, steps[i - 1].argval
                    imports.add(("." * level + step.argval, wanted or ()))
        parts = []
        for name in sorted(read & set(known)):
            parts += [_text(name), self._by_name(home, name, known[name], words)]
        package = known.get("__package__") or home.rpartition(".")[0]
        for name, wanted in sorted(imports):
            parts += [_text(name), self._imported(name, package, wanted, words)]
        return parts

    def _by_name(self, home: str, name: str, value: Any, words: set[str]) -> bytes:
        """Return the token of a global name; its value is read later, whatever it reaches."""
        if isinstance(value, ModuleType):
            return self._module(value, words)
        if self._names.setdefault((home, name), value) is not value:  # two modules of one name
            return self.token(value, name)
        return _hashed("name", _text((home, name)))

    def _imported(self, name: str, package: str, wanted: Iterable[str], words: set[str]) -> bytes:
        """Return the token of a module that a function imports when it runs."""
        try:
            name = importlib.util.resolve_name(name, package)
            if _is_installed(name):
                return _text(name)
            module = importlib.import_module(name)
            for part in wanted:
                if part not in vars(module) and hasattr(module, "__path__"):
                    importlib.import_module(f"{name}.{part}")
        except ImportError:  # it fails in the function as well
            return _text(name)
        return self._module(module, words)

    def _module(self, module: ModuleType, words: set[str] | None) -> bytes:
        """Return the token of a module: of those of its names that occur in code, else its file."""
        name = module.__name__
        if _is_installed(name):
            return _hashed("module", _text(name))
        if words is None:
            file = getattr(module, "__file__", None)
            return _hashed("module", _text(name), Path(file).read_bytes() if file else b"")
        key = name, frozenset(words)
        used = sorted(words & set(vars(module)))
        parts = []
        if key not in self._searched:
            self._searched.add(key)
            parts = [self._by_name(name, one, vars(module)[one], words) for one in used]
        return _hashed("module", _text((name, used)), *parts)

    def _class(self, item: type) -> bytes:
        if _is_installed(item.__module__) and _is_found(item):
            return _hashed("name", _text((item.__module__, item.__qualname__)))
        parts = self._all((type(item), *item.__bases__), "base")
        return _hashed(
            "class", _text(item.__qualname__), *parts, *self._named(vars(item), without=_IMPLIED)
        )

    def _object(self, item: Any) -> bytes:
        """Return the token of any other value: of its parts, as pickle takes it apart."""
        cls = type(item)
        if isinstance(item, _EMPTY):
            return _hashed("empty", self.token(cls, "type"))
        if isinstance(item, GetSetDescriptorType | MemberDescriptorType):
            return _hashed("slot", _text(item.__name__))
        if isinstance(item, MethodType):
            return _hashed("method", *self._all((item.__func__, item.__self__)))
        if isinstance(item, BuiltinFunctionType):
            owner = item.__self__
            owned = [] if isinstance(owner, ModuleType | None) else self._all([owner])
            return _hashed("builtin", _text((item.__module__, item.__qualname__)), *owned)
        if isinstance(item, property):
            return _hashed("property", *self._all((item.fget, item.fset, item.fdel)))
        if isinstance(item, cached_property):
            return _hashed("cached", self.token(item.func, "func"))
        if isinstance(item, staticmethod | classmethod | functools._lru_cache_wrapper):
            return _hashed(cls.__name__, self.token(item.__wrapped__, "wrapped"))
        try:
            reduce: Callable[..., Any] | None = copyreg.dispatch_table.get(cls)
            found = item.__reduce_ex__(4) if reduce is None else reduce(item)
        except Exception as error:
            if not hasattr(item, "__dict__") or _is_installed(cls.__module__):
                raise self._refused(item, error) from None
            found = (cls, (), vars(item))
        if isinstance(found, str):  # the name under which its module has it
            return _hashed("name", _text((getattr(item, "__module__", None), found)))
        make, given, state, entries, pairs = (*found, None, None, None)[:5]
        states = state if isinstance(state, tuple) and len(state) == 2 else (state,)
        parts = [self.token(cls, "type"), *self._all((make, given), "made")]
        for one in states:
            if isinstance(one, dict):  # without what was computed from the rest, and kept
                lazy = [n for n in one if isinstance(getattr(cls, str(n), None), cached_property)]
                parts += self._named(one, lazy)
            else:
                parts.append(self.token(one, "state"))
        parts += self._all((list(entries or ()), list(pairs or ())))
        return _hashed("object", *parts)

    def _refused(self, item: Any, error: Exception) -> ModelError:
        return ModelError(
            f"{' > '.join(self._path)} is a {type(item).__name__}, whose contents cannot be "
            f"compared ({error!s:.80}): with a checkpoint, results of other values could be taken "
            "for those of this one. Give plain values (numbers, arrays, names of files), or leave "
            "checkpoint= out."
        )


def _hashed(kind: str, *parts: bytes) -> bytes:
    digest = hashlib.sha256(kind.encode())
    for part in parts:
        digest.update(b"%d:" % len(part))
        digest.update(part)
    return digest.digest()


def _text(value: Any) -> bytes:
    return repr(value).encode("utf-8", "surrogatepass")


def _nested_code(code: CodeType) -> Iterator[CodeType]:
    """Yield code and that of all functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _nested_code(constant)


def _is_found(item: Any) -> bool:
    """Return whether a function or class is what its module has under its name."""
    found: Any = sys.modules.get(item.__module__)
    for part in item.__qualname__.split("."):
        found = getattr(found, part, None)
    return found is item


def _is_installed(name: str | None) -> bool:
    """Return whether a module is of Python, of this package or of another that was installed."""
    top = (name or "").partition(".")[0]
    module: Any = sys.modules.get(top)
    if module is None:
        try:
            spec = importlib.util.find_spec(top)
        except (ImportError, ValueError):
            spec = None
        file = None if spec is None or not spec.has_location else spec.origin
        folders = [] if spec is None else list(spec.submodule_search_locations or ())
    else:
        file, folders = getattr(module, "__file__", None), list(getattr(module, "__path__", ()))
    place = file or next(iter(folders), None)
    if place is None:
        return top in sys.stdlib_module_names or top in sys.builtin_module_names
    return _is_in_packages(place)


@functools.cache
def _is_in_packages(place: str) -> bool:
    folders = Path(place).resolve().parents
    return any(one in _INSTALLED or one.name in _PACKAGES for one in folders)
