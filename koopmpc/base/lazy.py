"""Names that a package serves from its files, each imported when it is first asked for (PEP 562)."""

import ast
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from sys import modules as loaded
from types import UnionType
from typing import Any, ForwardRef, Union, cast, get_args, get_origin

from koopmpc.base.interrupts import raise_swallowed

_ROOMS: list[str] = []
"""Modules that the front door serves as rooms: `find_public` looks into them in this order."""

_JOINTS: dict[str, tuple[str, ...]] = {}
"""Joint → modules that register themselves there, as the front door lists them."""


def attach(
    package: str,
    modules: Mapping[str, str] | None = None,
    *,
    core: Sequence[str] = (),
    moved: Mapping[str, str] | None = None,
    joints: Mapping[str, Sequence[str]] | None = None,
    hints: Mapping[str, str] | None = None,
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that serves the names which type checkers see.

    These are the names that its own ``if TYPE_CHECKING:`` imports, as ``from koopmpc.file import Name as Name``.

    Parameters
    ----------
    package
        The package's `__name__`.
    modules
        Name → the module below ``koopmpc`` that it stands for; in `__dir__`, but not in `__all__`. A module that the
        package imports from itself, as ``from koopmpc import data as data``, is one of them.
    core
        Files below the package that the first name brings along, so that no later call waits for an import.
    moved
        Names that stood here once → the room of `km` that has them now; asking for one says so.
    joints
        Joint → files below the package that register themselves there; `load_joint` imports them. Only the front door,
        which stands above all rooms, has joints.
    hints
        Name that users of other libraries try → what to write here.
    """
    imported = read_imports(package)
    rooms = {name: f"{package}.{name}" for name, file in imported.items() if file == package}
    rooms |= {name: f"koopmpc.{file}" for name, file in (modules or {}).items()}
    home = {name: file for name, file in imported.items() if name not in rooms}
    waiting = [f"{package}.{file}" for file in core]
    if joints is not None:
        _JOINTS.update({joint: tuple(map(f"{package}.{{}}".format, files)) for joint, files in joints.items()})
        _ROOMS[:] = [package, *dict.fromkeys(rooms.values())]

    @raise_swallowed()  # libraries take a Ctrl-C while they are imported for an ImportError, or a RuntimeError
    def serve(name: str) -> Any:
        if name in rooms or name in home:
            while waiting:
                import_module(waiting.pop())
            _serve_loaded(package, home)
            value = import_module(rooms[name]) if name in rooms else getattr(import_module(home[name]), name)
        elif name == "__version__" and package == "koopmpc":
            from importlib.metadata import version  # 10 ms, paid by who asks

            value = version(package)
        else:
            raise AttributeError(_explain_missing(package, name, [*home, *rooms], moved or {}, hints or {}))
        shorten_annotations(value)
        setattr(loaded[package], name, value)
        return value

    return serve, lambda: sorted([*home, *rooms]), sorted(home)


def _serve_loaded(package: str, home: Mapping[str, str]) -> None:
    """Serve the names of all files that are loaded meanwhile, without a further call."""
    names = loaded[package].__dict__
    for name, file in home.items():
        value = getattr(loaded[file], name) if file in loaded else None
        # the file itself may stand there, under the same name
        if value is not None and names.get(name) is not value:
            shorten_annotations(value)
            names[name] = value


def _explain_missing(
    package: str, name: str, known: Sequence[str], moved: Mapping[str, str], hints: Mapping[str, str]
) -> str:
    """Return what to write in place of a name that the package does not have."""
    short = package.replace("koopmpc", "km", 1)
    if name in moved:
        return f"{short}.{name} has moved: it is km.{moved[name]}.{name} now"
    near = next((f"it is {short}.{other}" for other in known if other.lower() == name.lower()), "")
    hint = hints.get(name) or near
    return f"module {package!r} has no attribute {name!r}" + (f"; {hint}" if hint else "")


def shorten_annotations(value: Any) -> None:
    """Write ``ArrayLike`` in place of its parts in the annotations of a function or a constructor, which `help` shows.

    The name is a forward reference: it resolves in the module of the function, which imports it from numpy.typing.
    Where beartype is loaded the annotations stay, for it reads them while the program runs.
    """
    function = value.__dict__.get("__init__") if isinstance(value, type) else value
    notes = getattr(function, "__annotations__", None)
    typing = loaded.get("numpy.typing")
    ours = str(getattr(value, "__module__", "")).startswith("koopmpc")
    if not notes or typing is None or not ours or "beartype" in loaded:
        return
    parts = get_args(typing.ArrayLike)
    for name, note in notes.items():
        notes[name] = _name_array_like(note, parts)


def _name_array_like(note: Any, parts: tuple[Any, ...]) -> Any:
    """Return an annotation with a reference to ``ArrayLike`` in place of the parts of it; itself where it has none."""
    own = get_args(note)
    if len(own) >= len(parts) and all(part in own for part in parts):
        rest = [_name_array_like(part, parts) for part in own if part not in parts]
        return Union[ForwardRef("ArrayLike"), *rest]
    inner = [
        [_name_array_like(part, parts) for part in cast("list[Any]", one)]
        if isinstance(one, list)
        else _name_array_like(one, parts)
        for one in own
    ]
    if inner == list(own):
        return note
    origin: Any = get_origin(note)
    return Union[tuple(inner)] if origin in (Union, UnionType) else origin[tuple(inner)]  # noqa: UP007


def find_public(name: str) -> Any:
    """Return the object that koopmpc or one of its rooms serves by this name; None where none does."""
    for room in _ROOMS:
        module = import_module(room)
        if name in getattr(module, "__all__", ()):
            return getattr(module, name)
    return None


def load_joint(joint: str, until: Callable[[], bool] | None = None) -> tuple[str, ...]:
    """Import the modules that register themselves at this joint, so that a room never imports one above it.

    Once `until` is true no further one is imported. The names of all modules are returned, in the order of the table in
    ``koopmpc/__init__.py``.
    """
    for file in _JOINTS[joint]:
        if until is not None and until():
            break
        import_module(file)
    return _JOINTS[joint]


def read_imports(package: str) -> dict[str, str]:
    """Return name → file of the imports below ``if TYPE_CHECKING:`` in the source of a package that is being loaded."""
    loader: Any = loaded[package].__loader__
    tree = ast.parse(loader.get_source(package))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module or "" for node in imports for alias in node.names}
