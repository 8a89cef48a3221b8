"""The base of all values, and their files: .npz with a JSON header, without pickle."""

from __future__ import annotations

import json
import os
import re
import sys
import uuid
from abc import ABC
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from html import escape
from importlib import import_module
from itertools import groupby
from pathlib import Path
from pkgutil import iter_modules
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np
import scipy.sparse as sp

from .errors import FlexplantError, plain_repr, unknown_attribute

_HEADER = "__flexplant__"


def checked(check: Callable[..., Any], *, unit: str = "", **rules: Any) -> dict[str, Any]:
    """Return the metadata of a field of a Value: ``check(value, name=..., **rules)`` returns it."""
    # `name`, in messages, is the field's unless the rules have another; a default None passes;
    # a `shape` may name fields: as many entries are due there as these have
    return {"check": (check, rules), "unit": unit}


def _annotated(cls: type) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", vars(cls).get("__annotations__", {}))


class Value(ABC):  # noqa: B024, kinds declare the abstract methods
    """A frozen dataclass whose arrays are read-only copies, also after pickling and loading.

    Construction refuses a field that does not fit its description: with ShapeError where sizes do
    not fit, LabelError where names do not, otherwise ModelError.
    """

    registry: ClassVar[dict[str, type[Value]]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        Value.registry[cls.__name__] = cls

    def __post_init__(self) -> None:
        """Check each field by the rule in its declaration, and make it read-only.

        Rules for several fields together are checked after this, in the method of the class.
        """
        values = self._fields()
        for field in fields(self):  # type: ignore[arg-type]
            given = values[field.name]
            if "check" in field.metadata and (given is not None or field.default is not None):
                check, rules = field.metadata["check"]
                rules = {"name": field.name} | rules
                if "shape" in rules:
                    sizes = (len(values[n]) if isinstance(n, str) else n for n in rules["shape"])
                    rules["shape"] = tuple(sizes)
                values[field.name] = check(given, **rules)
        self._set(**values)

    def _set(self, **values: Any) -> None:
        """Set fields during construction; arrays become read-only copies."""
        for name, value in values.items():
            object.__setattr__(self, name, frozen(value))

    def _put_off(self, **computed: Callable[[], Any]) -> Self:
        """Have fields without a default value computed where they are first read or copied."""
        for name in computed:
            self.__dict__.pop(name)
        self.__dict__.setdefault("_computed", {}).update(computed)
        return self

    def _fields(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def __repr__(self) -> str:
        """Return the name of the class with its fields and their units.

        Fields that are None or empty are left out, and so are strings and bools that have their
        default value.
        """
        shown = ", ".join(f"{name}={text}" for name, text in self._stated().items())
        return f"{type(self).__name__}({shown})"

    def _stated(self) -> dict[str, str]:
        """Return the text of each field that says something."""
        shown = {}
        for field in fields(self):  # type: ignore[arg-type]
            value, unit = getattr(self, field.name), field.metadata.get("unit")
            usual = isinstance(value, bool | str) and value == field.default
            text = _field_text(value)
            if not usual and text not in ("None", "''", "[]", "{}"):
                shown[field.name] = f"{text}{' ' + unit if unit else ''}"
        return shown

    if not TYPE_CHECKING:  # a type checker would take any attribute for known

        def __getattr__(self, name: str) -> Any:
            """Compute a field that was put off; say which attributes are near to others."""
            late = self.__dict__.get("_computed", {}).get(name)
            if late is not None:
                try:
                    self._set(**{name: late()})
                except AttributeError as error:  # getattr and hasattr would take it for absence
                    raise RuntimeError(f"{name} cannot be computed: {error}") from error
                self.__dict__["_computed"].pop(name, None)  # with all that it holds
                return self.__dict__[name]
            known = {n for cls in type(self).__mro__ for n in (*vars(cls), *_annotated(cls))}
            # an existing property that fails raises its own error
            if name.startswith("_") or name in known:
                return object.__getattribute__(self, name)
            raise unknown_attribute(type(self).__name__, name, known - {"registry"})

    def __reduce__(self) -> tuple[Any, ...]:
        state = {
            name: dict(value) if isinstance(value, MappingProxyType) else value
            for name, value in self._fields().items()
        }
        return rebuild, (type(self), state)

    def __dir__(self) -> list[str]:
        """Return what is for use: fields, properties and methods, no private or inherited ones."""
        public = {n for cls in type(self).__mro__ for n in vars(cls)} - {"registry"}
        names = {field.name for field in fields(self)}  # type: ignore[arg-type]
        return sorted(n for n in public | names if not n.startswith("_"))

    def _repr_html_(self) -> str:
        """Return what notebooks show: the repr, laid out, or a table of the fields."""
        text, kind = repr(self), type(self).__name__
        if text.startswith(f"{kind}("):
            text = "\n  ".join([f"<{kind}>", *(f"{n}: {t}" for n, t in self._stated().items())])
        return as_html(text)

    def _repr_mimebundle_(self, **_: Any) -> dict[str, str]:
        """Return what Jupyter shows: the repr, laid out, and the picture of kinds that have one."""
        picture = import_module(f"{__package__}.plot.notebook").picture_of(self)
        return {"text/plain": repr(self), "text/html": self._repr_html_() + picture}

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed; it is checked like a new value."""
        return replace(self, **self._completed_changes(changes))  # type: ignore[type-var]

    def _completed_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return the changes of `replace` with those that follow from them."""
        return changes

    def save(self, path: str | Path) -> None:
        """Write the value to one `.npz` file. If writing fails, a previous file is kept.

        Parameters
        ----------
        path : str or Path
            Path of the file; `flexplant.load` reads it back.
        """
        save(self, path)


def _field_text(value: Any) -> str:
    """Return a field's value for a repr: large arrays by their shape, long lists by their ends."""
    if isinstance(value, float):
        return f"{value:g}"
    if sp.issparse(value) or (isinstance(value, np.ndarray) and not 0 < value.size <= 6):
        return f"array {value.shape}" if value.size else "[]"  # type: ignore[union-attr]
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, tuple | list):
        listed = [_field_text(part) for part in value]
        if len(listed) > 4:
            listed[3:-1] = [f"... {len(listed) - 4} more ..."]
        return f"[{', '.join(listed)}]"
    if isinstance(value, MappingProxyType):
        return plain_repr(dict(value))
    text = plain_repr(value)
    long = isinstance(value, Value) and len(text) > 80
    return f"<{type(value).__name__} ...>" if long else text


#: a class of values
Kind = TypeVar("Kind", bound=Value)


def rebuild(cls: type[Kind], state: Mapping[str, Any]) -> Kind:
    """Return a value from its fields as they were, without the checks of construction."""
    value = object.__new__(cls)
    for name, item in state.items():
        object.__setattr__(value, name, frozen(item))
    return value


def frozen(value: Any) -> Any:
    """Return a read-only copy of an array, sparse matrix or mapping; anything else as it is."""
    # plain kinds first: questions about abstract classes are slow, and values are made often
    if value is None or isinstance(value, (str, float, int, MappingProxyType)):
        return value
    if type(value) is tuple:
        arrays = value and isinstance(value[0], np.ndarray)
        return tuple(frozen(item) for item in value) if arrays else value
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
    elif isinstance(value, Mapping) and not isinstance(value, Value):
        value = MappingProxyType({key: frozen(item) for key, item in value.items()})
    return value


def save(value: Value, path: str | Path) -> None:
    """Write `value` to `path` as .npz; a crash or a power cut leaves the old file or none."""
    arrays: dict[str, Any] = {}
    header = json.dumps(_encode(value, arrays))
    arrays[_HEADER] = np.array(header)
    with written(path) as file:
        np.savez_compressed(file, **arrays)


def named_file(path: Any, name: str = "path") -> Path:
    """Return the path of a file; whether it exists is checked when it is opened."""
    if not isinstance(path, str | Path) or not Path(path).name or "\0" in str(path):
        raise FlexplantError(
            f"{name} must name a file, got {path!r:.80}. Pass a text such as 'plant.npz' or a Path."
        )
    return Path(path)


@contextmanager
def written(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a new file that replaces `path` only when all its data are on the disk."""
    target = named_file(path)
    part = target.with_name(f"{target.name}.{uuid.uuid4().hex}.part")
    try:
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, target)
    except OSError as error:
        raise FlexplantError(
            f"the file {target} cannot be written ({error.strerror or error}): what it held before "
            "is kept. Make room, give the right to write, or name another folder."
        ) from error
    finally:  # if it was written, it has been renamed to the file
        with suppress(OSError):  # it does not exist if it could not be opened
            part.unlink()


def load(path: str | Path) -> Any:
    """Return the value that `.save(path)` wrote.

    Parameters
    ----------
    path : str or Path
        Path of the file.

    Returns
    -------
    Value
        Value of the type that was saved; its arrays are read-only.

    Raises
    ------
    FlexplantError
        When the file was not written by flexplant, or holds a kind of value of another module
        that is not imported yet.

    Notes
    -----
    The file contains the name of the module of each value. If this room of flexplant has not been
    used in the session yet, it is imported. No other module is imported, in particular none from
    outside flexplant.

    Examples
    --------
    >>> import os, tempfile
    >>> import flexplant as fx
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "chain.npz")
    ...     fx.chain(masses=[1.0, 2.0], stiffnesses=[100.0]).save(path)
    ...     fx.load(path)
    <FEModel 'chain': 2 DOFs, sparse, 1 rigid-body motion, D not given>
    """
    foreign = FlexplantError(
        f"{str(path)!r} was not written by flexplant. Use flexplant.io for foreign formats."
    )
    with Path(path).open("rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)
        except Exception:  # no archive of arrays, whatever its bytes led to
            raise foreign from None
        if not isinstance(archive, np.lib.npyio.NpzFile) or _HEADER not in archive:
            raise foreign
        try:
            arrays = {name: archive[name] for name in archive.files}
            return _decode(json.loads(str(arrays[_HEADER])), arrays)
        except FlexplantError:
            raise
        except Exception as error:
            raise FlexplantError(
                f"{str(path)!r} is damaged ({type(error).__name__}: {error!s:.80}). Save the value "
                "again."
            ) from None


def _encode(item: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(item, np.generic):
        item = item.item()
    if item is None or isinstance(item, bool | int | str):
        return item
    if isinstance(item, float):
        return item if np.isfinite(item) else {"float": repr(item)}
    if isinstance(item, complex):
        return {"complex": [item.real, item.imag]}
    if isinstance(item, np.ndarray):
        return {"array": _keep(item, arrays)}
    if sp.issparse(item):
        sparse: Any = item
        coo = sparse.tocoo()
        parts = [_keep(np.asarray(part), arrays) for part in (coo.data, *coo.coords)]
        return {"sparse": parts, "shape": list(coo.shape)}
    if isinstance(item, Value):
        fields = {name: _encode(part, arrays) for name, part in item._fields().items()}
        kind = type(item)
        return {"value": kind.__name__, "module": kind.__module__, "fields": fields}
    if isinstance(item, Mapping):
        return {"mapping": [[_encode(k, arrays), _encode(v, arrays)] for k, v in item.items()]}
    if isinstance(item, tuple):
        return {"tuple": [_encode(part, arrays) for part in item]}
    if isinstance(item, list):
        return [_encode(part, arrays) for part in item]
    raise FlexplantError(
        f"cannot save a {type(item).__name__}: files hold values, arrays, numbers and names only."
    )


def _kind(name: str, module: str) -> type[Value]:
    """Return the kind of that name; rooms are imported until it is known, its own room first."""
    package, *below = module.split(".")
    if package == __package__:
        rooms = [found.name for found in iter_modules(sys.modules[package].__path__)]
        for room in sorted(rooms, key=lambda room: [room] != below[:1]):
            if name in Value.registry:
                break
            import_module(f"{package}.{room}")
    if name in Value.registry:
        return Value.registry[name]
    raise FlexplantError(
        f"the file holds a {name!r}, which this version of flexplant lacks. Load it with the "
        "version that wrote it."
        if package == __package__
        else f"the file holds a {name!r} of the module {module!r}, which this session lacks. "
        "Import that module, then load the file again."
    )


def _rebuilt(cls: type[Value], state: Mapping[str, Any]) -> Value:
    """Return a value; fields that came after the file was written have their defaults."""
    known: set[str] = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    strange = sorted(set(state) - known)
    missing = sorted(name for name in known - set(state) if not hasattr(cls, name))
    if strange or missing:
        raise FlexplantError(
            f"the file's {cls.__name__} is of another version of flexplant: it has "
            f"{strange or 'no more'} and lacks {missing or 'nothing'}. Make it again and save it."
        )
    return rebuild(cls, {name: state.get(name, getattr(cls, name, None)) for name in known})


def _keep(array: Any, arrays: dict[str, Any]) -> str:
    name = f"a{len(arrays)}"
    arrays[name] = array
    return name


def _decode(item: Any, arrays: Mapping[str, Any]) -> Any:
    if isinstance(item, list):
        return [_decode(part, arrays) for part in item]
    if not isinstance(item, dict):
        return item
    if "value" in item:
        cls = _kind(item["value"], item.get("module", __package__))
        return _rebuilt(cls, {name: _decode(part, arrays) for name, part in item["fields"].items()})
    if "array" in item:
        return arrays[item["array"]]
    if "sparse" in item:
        data, *coords = (arrays[name] for name in item["sparse"])
        return sp.csc_array((data, tuple(coords)), shape=tuple(item["shape"]))
    if "mapping" in item:
        return {_decode(k, arrays): _decode(v, arrays) for k, v in item["mapping"]}
    if "tuple" in item:
        return tuple(_decode(part, arrays) for part in item["tuple"])
    if "complex" in item:
        return complex(*item["complex"])
    return float(item["float"])


#: `name: text` or `name = text` after two spaces of indent, as values print what they hold; columns
#: separated by two spaces are not entries
_ENTRY = re.compile(r"^  (?! )((?:(?!  ).){1,48}?)(?:: | = )(\S.*)$")
_CELL = "padding:.1em .8em .1em 0;text-align:left;vertical-align:top;border:0;background:none"


def as_html(text: str) -> str:
    """Return the repr of a value as HTML: a heading, named entries as rows, the rest as it is."""
    # lines that are aligned by spaces, tables among them, keep their alignment
    first, *rest = text.split("\n")
    parts = []
    if first.startswith("<"):
        if rest and not first.endswith(">"):  # it ends where the last line does
            rest[-1] = rest[-1].removesuffix(">")
        first = first[1:].removesuffix(">")
        kind = re.match(r"\w+", first)
        end = kind.end() if kind else 0
        parts.append(f"<div><b>{escape(first[:end])}</b>{escape(first[end:])}</div>")
    else:
        rest = [first, *rest]
    for shape, lines in groupby(rest, key=_line_kind):
        part = list(lines)
        if shape == "entry":
            rows = "".join(_html_row(line) for line in part)
            parts.append(f'<table style="border-collapse:collapse"><tbody>{rows}</tbody></table>')
        elif shape == "text":
            parts += [f"<div>{escape(line.strip())}</div>" for line in part]
        else:
            shown = escape("\n".join(part))
            parts.append(f'<pre style="margin:.2em 0;line-height:1.35">{shown}</pre>')
    return f'<div class="flexplant">{"".join(parts)}</div>'


def _line_kind(line: str) -> str:
    """Return whether a line is a named entry, a sentence, or part of a table."""
    if _ENTRY.match(line):
        return "entry"
    indent = len(line) - len(line.lstrip())
    return "text" if indent <= 2 and "  " not in line.strip() else "table"


def _html_row(line: str) -> str:
    name, text = cast(re.Match[str], _ENTRY.match(line)).groups()
    return (
        f'<tr><th style="{_CELL};font-weight:600">{escape(name.strip())}</th>'
        f'<td style="{_CELL}">{escape(text)}</td></tr>'
    )
