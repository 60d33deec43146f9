"""Frozen data: equality to the bit, and a plain tree of numbers and names in place of a pickle.

A `Value` is a frozen dataclass of numbers, strings, enums, tuples, arrays and other Values. `to_data` writes it
as a JSON-able tree, `from_data` builds it again. Only classes of koopmpc are looked up, by name, they are built
through their own constructors, and their fields must be of the types that the class declares: loading a file runs
no code of that file.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import cache
from hashlib import sha256
from types import UnionType
from typing import (
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Protocol,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    no_type_check,
    runtime_checkable,
)
from zlib import crc32

import numpy as np
from jaxtyping import Float, jaxtyped  # pyright: ignore[reportUnknownVariableType]
from numpy.typing import NDArray

from koopmpc.base.errors import DataError, LogError
from koopmpc.base.lazy import find_public

Array = NDArray[Any]
Arrays = dict[str, Array]


class Interval(NamedTuple):
    """low ≤ v ≤ high, entry by entry; ±inf where there is no limit."""

    low: Float[np.ndarray, "*rows n"]
    high: Float[np.ndarray, "*rows n"]


@runtime_checkable
class Keyed(Protocol):
    """Arrays by their key: a dict, or the members of a file, which are read when they are asked for."""

    def __getitem__(self, key: str, /) -> Array: ...


_SHOWN = 4  # a repr shows this many items of a field
_LONG = 80  # a repr shows this many characters of a field


class Value:
    """Base of frozen dataclasses that hold arrays; `==` compares to the bit and NaN equals NaN."""

    _kinds: ClassVar[dict[str, type["Value"]]] = {}
    _FORMER: ClassVar[Mapping[str, str]] = {}
    """Field of older files → its name today; "" where it has gone."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Register the classes of the library itself, and no others, for `from_data`; keep the short repr."""
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = Value.__repr__  # a dataclass writes one of its own where the class itself has none
        if cls.__module__.split(".")[0] == "koopmpc":
            Value._kinds[cls.__name__] = cls

    @classmethod
    def is_registered(cls) -> bool:
        """Return whether this very class can be named in a file."""
        return Value._kinds.get(cls.__name__) is cls

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if type(self) is not type(other):
            return NotImplemented
        return all(same(getattr(self, f), getattr(other, f)) for f in _fields(self))

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # arrays have no hash

    def __repr__(self) -> str:
        """Return the class and its fields in a line: of arrays the shape, of other Values the name."""
        parts = [f"{f}={_brief(getattr(self, f))}" for f in _fields(self)]
        return f"{type(self).__name__}({', '.join(parts)})"

    def as_saved(self) -> "Value":
        """Return the Value that stands for this one in a file; itself unless a class says otherwise."""
        return self


class Named:
    """Base of classes with named states, inputs and measured disturbances, which count them."""

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(cast("Any", self).states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(cast("Any", self).inputs)

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return len(getattr(cast("Any", self), "disturbances", ()))


def freeze(value: object, **fields: object) -> None:
    """Set fields of a frozen dataclass; only its own constructor does so."""
    for name, field in fields.items():
        object.__setattr__(value, name, field)


def same(a: Any, b: Any) -> bool:
    """Return True where two trees of values are equal to the bit."""
    x, y = a, b  # a match narrows the types of a and b
    match a, b:
        case np.ndarray(), np.ndarray():
            return bool(x.dtype == y.dtype) and x.shape == y.shape and x.tobytes() == y.tobytes()
        case float(), float():
            return a.hex() == b.hex()  # which tells −0 from 0, and no NaN from another
        case ((tuple() | list()), (tuple() | list())):
            return len(x) == len(y) and all(map(same, x, y))
        case Mapping(), Mapping():
            return x.keys() == y.keys() and all(same(x[key], y[key]) for key in x)
        case _:
            return not any(isinstance(each, np.ndarray) for each in (x, y)) and bool(x == y)


def to_data(value: Any, arrays: Arrays | None = None) -> Any:
    """Return a JSON-able tree; with `arrays`, arrays go there and leave a key behind, else they become lists."""
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return float(value)
        case Enum():
            return {"kind": type(value).__name__, "name": value.name}
        case np.ndarray():
            return _array_to_data(cast("Array", value), arrays)
        case np.generic():
            return cast("Any", value).item()
        case Value():
            stands = value.as_saved()
            name = type(stands).__name__
            if not stands.is_registered():
                raise DataError(f"{name} is not a class of koopmpc and cannot be saved as data")
            return {"kind": name} | {f: to_data(getattr(stands, f), arrays) for f in _fields(stands)}
        case tuple() | list():
            return [to_data(item, arrays) for item in cast("Sequence[Any]", value)]
        case dict():
            items = cast("dict[Any, Any]", value)
            return {"kind": "dict", "items": [[str(k), to_data(v, arrays)] for k, v in items.items()]}
        case _:
            raise DataError(f"a {type(value).__name__} cannot be saved as data; use numbers, names and arrays")


def from_data(tree: Any, arrays: Keyed | None = None, enums: Sequence[type[Enum]] = ()) -> Any:
    """Build the value that `to_data` wrote; lists come back as tuples.

    Raises
    ------
    LogError
        The tree names a class that koopmpc does not have, or a class refuses what it holds.
    """
    if isinstance(tree, list):
        return tuple(from_data(item, arrays, enums) for item in cast("list[Any]", tree))
    if not isinstance(tree, dict):
        return tree
    node = cast("dict[str, Any]", tree)
    kind = node.get("kind")
    try:
        if kind == "array":
            return _array(node, {} if arrays is None else arrays)
        if kind == "dict":
            return {key: from_data(item, arrays, enums) for key, item in node["items"]}
        for enum in enums:
            if enum.__name__ == kind:
                return enum[node["name"]]
        cls = class_of(kind) if isinstance(kind, str) else None
        if cls is None:
            raise LogError(f"the file holds a {kind!r}, which this version of koopmpc does not know")
        build = cast("Callable[..., Any]", cls)
        names = {key: cls._FORMER.get(key, key) for key in node if key != "kind"}
        value = build(**{name: from_data(node[key], arrays, enums) for key, name in names.items() if name})
        _check_types(value)
        return value
    except LogError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise LogError(f"the file holds a {kind!r} that cannot be built: {error}") from error


class Viewing:
    """Base of objects that keep views of their own arrays: copies and pickles leave these out, and make their own."""

    _VIEWS: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that `_see` makes."""

    def _see(self) -> None:
        """Make the views."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in self._VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._see()


def class_of(name: str) -> type[Value] | None:
    """Return the Value of koopmpc that has this name; None where there is none.

    What a package serves is imported when it is first asked for. A class that is not known yet is therefore looked up
    in the tables of koopmpc and of its rooms; the name in the file only chooses among their names.
    """
    if name not in Value._kinds:
        find_public(name)
    return Value._kinds.get(name)


def _check_types(value: Value) -> None:
    """Raise where a field is of another type than its class declares."""
    hints = _hints(type(value))
    with jaxtyped("context"):  # so that a letter in the shapes of a class has one size
        for name in _fields(value):
            got = getattr(value, name)
            if not _is_a(got, hints[name]):
                raise LogError(
                    f"the file holds a {type(value).__name__!r} with {name}={_brief(got)}, which is of another type"
                )


@cache
def _hints(cls: type[Value]) -> dict[str, Any]:
    return get_type_hints(cls)


@no_type_check  # not a checked function of its own, because in that no letter would have its size yet
def _is_a(value: Any, hint: Any) -> bool:
    """Return True where `value` is of the type that `hint` declares; an int passes for a float.

    Types that stand in no file, such as callables and numpy's ArrayLike, are left to the constructors.
    """
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_is_a(value, arg) for arg in args)
    if origin is Literal:
        return not isinstance(value, np.ndarray) and value in args
    if origin in (tuple, Sequence):
        fixed = origin is tuple and args[-1:] != (...,)
        kinds = args if fixed or not isinstance(value, tuple) else args[:1] * len(value)
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(_is_a, value, kinds))
    if origin in (dict, Mapping):
        parts = (tuple(value), tuple(value.values())) if isinstance(value, Mapping) else (None, None)
        return all(map(_is_a, parts, (tuple[args[0], ...], tuple[args[1], ...])))
    if hint is Any or not isinstance(hint, type) or origin is not None:
        return True
    return isinstance(value, (float, int) if hint is float else hint)


def _brief(value: Any) -> str:
    """Return `value` in a few characters."""
    match value:
        case np.ndarray():
            return f"array{cast('Array', value).shape}"
        case Value():
            return type(value).__name__
        case Enum():
            return f"{type(value).__name__}.{value.name}"
        case tuple() | list():
            items = cast("Sequence[Any]", value)
            shown = [_brief(item) for item in items[:_SHOWN]]
            shown += [f"… {len(items)} in all"] if len(items) > _SHOWN else []
            return f"({', '.join(shown)}{',' if len(items) == 1 else ''})"
        case Mapping():
            pairs = list(cast("Mapping[Any, Any]", value).items())
            shown = [f"{key!r}: {_brief(item)}" for key, item in pairs[:_SHOWN]]
            shown += [f"… {len(pairs)} in all"] if len(pairs) > _SHOWN else []
            return f"{{{', '.join(shown)}}}"
        case _:
            text = repr(value)
            return text if len(text) <= _LONG else f"{text[: _LONG - 1]}…"


def _array_to_data(array: Array, arrays: Arrays | None) -> dict[str, Any]:
    if arrays is None:
        values = array.ravel().view(_parts(array.dtype)).tolist()  # JSON knows no complex numbers
        return {"kind": "array", "dtype": str(array.dtype), "shape": list(array.shape), "values": values}
    key = f"array{len(arrays)}"
    arrays[key] = array
    return {"kind": "array", "key": key}


def _array(node: dict[str, Any], arrays: Keyed) -> Array:
    held = np.asarray(arrays[node["key"]]) if "key" in node else None
    dtype = np.dtype(node["dtype"]) if held is None else held.dtype
    if dtype.kind not in "fiubc":
        raise LogError(f"the file holds an array of {dtype}; only numbers are read")
    if held is not None:
        return held
    return np.array(node["values"], dtype=_parts(dtype)).view(dtype).reshape(node["shape"])


def _parts(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of the real and imaginary parts of a complex type; any other type itself."""
    return np.dtype(f"f{dtype.itemsize // 2}") if dtype.kind == "c" else dtype


def _fields(value: Value) -> list[str]:
    return [f.name for f in dataclasses.fields(cast(Any, value)) if f.init and f.compare]


def checksum(*parts: Any, start: int = 0) -> int:
    """Return the CRC-32 of parts of bytes, one behind the other; `start` is that of the parts before, to go on from."""
    for part in parts:
        start = crc32(part, start)
    return start


def fingerprint(content: bytes) -> str:
    """Return the SHA-256 of the content in hexadecimal digits: other contents have other fingerprints."""
    return sha256(content).hexdigest()
