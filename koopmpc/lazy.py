"""Names that a package serves from its files, each imported when it is first asked for (PEP 562)."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from sys import modules as loaded
from typing import Any


def attach(
    package: str, names: Mapping[str, str], modules: Mapping[str, str] | None = None, *, core: Sequence[str] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that serves names from its files.

    Parameters
    ----------
    package
        The package's `__name__`.
    names
        File below the package → the names that it gives, separated by spaces.
    modules
        Name → the module below ``koopmpc`` that it stands for; in `__dir__`, but not in `__all__`.
    core
        Files below the package that the first name brings along, so that no later call waits for an import.
    """
    home = {name: f"{package}.{file}" for file, given in names.items() for name in given.split()}
    rooms = {name: f"koopmpc.{file}" for name, file in (modules or {}).items()}

    waiting = [f"{package}.{file}" for file in core]

    def serve(name: str) -> Any:
        if name in rooms or name in home:
            while waiting:
                import_module(waiting.pop())
            ready = {known: getattr(loaded[file], known) for known, file in home.items() if file in loaded}
            loaded[package].__dict__.update(ready)
        if name in rooms:
            found = import_module(rooms[name])
        elif name in home:
            found = getattr(import_module(home[name]), name)
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(loaded[package], name, found)
        return found

    every = sorted(home)
    return serve, lambda: sorted([*every, *rooms]), every
