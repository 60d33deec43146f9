"""The reference of the site: a page a room with an entry for each public name, and a page for the commands.

The names come from the tables that serve them (`koopmpc/__init__.py` and those of its rooms), the words from the
docstrings and from `koopmpc COMMAND --help`.
"""

import inspect
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

import koopmpc as km
from koopmpc.apps.cli.app import app
from koopmpc.base.lazy import read_imports

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOMS = {
    "plants": (
        "Plants",
        "Equations, step functions and Gymnasium environments become x⁺ = F(x, u).",
    ),
    "data": (
        "Data and excitation",
        "Episodes of states and inputs: collected from a plant, or read from files.",
    ),
    "lifting": (
        "Liftings",
        "Observables z = ψ(x). `a + b` joins two families, `a * b` is all products.",
    ),
    "models": (
        "Models and fits",
        "z⁺ = A z + B u with x ≈ C z, its bilinear kin, their spectrum; fits on the same moments.",
    ),
    "validate": (
        "Whether to trust",
        "Is a model good, and where: before a controller stands on it.",
    ),
    "estimate": (
        "Estimators",
        "What the sensors do not show, and what the model lacks.",
    ),
    "control": (
        "Controllers",
        "One `Cost`, one `Limits`; every call gives a `Move` with a status.",
    ),
    "loop": (
        "Closed loops",
        "`simulate` drives a plant by a controller; faults break it; `km.supervise` watches and hands over.",
    ),
    "guarantees": (
        "Guarantees",
        "What is proved, with its assumptions; what is promised, with its probability.",
    ),
    "synthesis": (
        "From data to a controller",
        "Choose a model, choose a controller, with evidence from closed loops.",
    ),
    "codegen": (
        "C code",
        "The same controller as C99 without a heap, in a folder or behind Python's protocol.",
    ),
    "views": (
        "Figures, logs and the viewer",
        "`km.plot`: Matplotlib figures; a run as one .rrd file, written, read back and looked at in Rerun.",
    ),
    "apps": (
        "Problems, sweeps and papers",
        "A problem is a plant with its data, cost, limits and cases; sweeps compare controllers on it.",
    ),
    "base": (
        "Errors and scenes",
        "Mistakes raise one of `km.errors`, each also a builtin; `km.scene`: the shapes of an animation.",
    ),
}


class Entry(NamedTuple):
    """A public name, where it is defined, and the object itself."""

    name: str  # as users write it: km.edmd, km.faults.NaNSensor
    path: str  # koopmpc.models.fits.edmd.edmd
    found: Any

    @property
    def room(self) -> str:
        """Return the room that defines it."""
        return self.path.split(".")[1]

    @property
    def first_line(self) -> str:
        """Return the first line of its docstring; nothing for plain data."""
        words = inspect.getdoc(self.found) if callable(self.found) else ""
        return (words or "").partition("\n")[0].replace("|", "\\|")


def entries() -> list[Entry]:
    """Return every public name once, under its shortest spelling, in the order of the tables."""
    found = list(_served("km", km))
    for name in dir(km):
        room = getattr(km, name)
        if name not in km.__all__:
            found += _served(f"km.{name}", room)
    spelled: dict[str, Entry] = {}
    for entry in found:
        spelled.setdefault(entry.path, entry)
    return list(spelled.values())


def _served(prefix: str, module: ModuleType) -> Iterator[Entry]:
    """Yield what a module serves from its files, or, where it has no table, what it defines."""
    if hasattr(module, "__all__") and not hasattr(module, "__path__"):
        homes = dict.fromkeys(module.__all__, module.__name__)
    elif hasattr(module, "__all__"):
        homes = {name: home for name, home in read_imports(module.__name__).items() if name in module.__all__}
    else:
        homes = {name: module.__name__ for name, value in vars(module).items() if _defined(name, value, module)}
    for name, home in homes.items():
        yield Entry(f"{prefix}.{name}", f"{home}.{name}", getattr(module, name))


def _defined(name: str, value: object, module: ModuleType) -> bool:
    return not name.startswith("_") and getattr(value, "__module__", None) == module.__name__


def page(room: str, named: list[Entry]) -> str:
    """Return the page of a room: what it is for, its names in a table, and an entry for each."""
    title, words = ROOMS[room]
    lines = [f"# {title}", "", words, "", *table(named), ""]
    for entry in named:
        lines += [
            f"::: {entry.path}",
            "    options:",
            f"      heading: {entry.name}",
            f"      toc_label: {entry.name}",
            "",
        ]
    return "\n".join(lines)


def table(named: list[Entry], page: str = "") -> list[str]:
    """Return a table of names that lead to their entries, each with the first line of its docstring."""
    return ["| name | |", "|---|---|", *(f"| [`{e.name}`]({page}#{e.path}) | {e.first_line} |" for e in named)]


def index(named: list[Entry]) -> str:
    """Return the page that names everything, by rooms."""
    lines = [
        "# Every public name",
        "",
        "What is imported by `import koopmpc as km`, in the order in which data go through the library. ",
    ]
    lines += ["The commands of the shell have [a page of their own](commands.md).", ""]
    for room, (title, words) in ROOMS.items():
        lines += [f"## {title}", "", words, "", *table([e for e in named if e.room == room], f"{room}.md"), ""]
    return "\n".join(lines)


def commands() -> str:
    """Return the page of the commands: what `koopmpc COMMAND --help` says."""
    group: Any = typer.main.get_command(app)
    lines = ["# Commands", "", "What `koopmpc COMMAND --help` says.", ""]
    for name, command in group.commands.items():
        context = typer.Context(command, info_name=name)
        usage = " ".join(command.collect_usage_pieces(context)).replace("{", "").replace("}", "")
        lines += [f"## koopmpc {name}", "", inspect.cleandoc(command.help), "", f"    koopmpc {name} {usage}", ""]
        rows = [(_spelled(p), (p.help or "").replace("|", "\\|")) for p in command.params]
        lines += [
            *(["| argument | |", "|---|---|"] if rows else []),
            *(f"| {left} | {right} |" for left, right in rows),
            "",
        ]
    return "\n".join(lines)


def _spelled(parameter: Any) -> str:
    """Return how an argument or an option is written."""
    words = parameter.opts if parameter.param_type_name == "option" else [(parameter.metavar or parameter.name).upper()]
    return ", ".join(f"`{word}`" for word in words)


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the pages to the site (a hook of MkDocs)."""
    from mkdocs.structure.files import File

    named = entries()
    pages = {room: page(room, [e for e in named if e.room == room]) for room in ROOMS}
    for name, text in {"index": index(named), "commands": commands(), **pages}.items():
        boost = 2 if name == "commands" else 0.5  # in the search: the pages that tell how come before the entries
        content = f"---\nsearch: {{boost: {boost}}}\n---\n\n{text}"
        files.append(File.generated(config, f"reference/{name}.md", content=content))
    return files
