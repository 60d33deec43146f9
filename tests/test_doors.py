"""Doors only downwards: each import, within functions and by strings too, leads to the own room or to one below it."""

import ast
import tomllib
from collections.abc import Iterable, Iterator

import pytest

from koopmpc.base.lazy import load_joint
from tests.sources import ROOT, nodes, texts

SETTINGS = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))
LAYERS: list[str] = next(c for c in SETTINGS["tool"]["importlinter"]["contracts"] if c.get("exhaustive"))["layers"]
RANK = {room: -i for i, room in enumerate(LAYERS)}
MODULES = {".".join(["koopmpc", *file.with_suffix("").parts]).removesuffix(".__init__"): file for file in texts()}
FRONT_DOOR = ("koopmpc", "koopmpc.__main__")
BY_NAME = ("koopmpc.base.lazy", "koopmpc.apps.papers")  # import modules by names that they compute


def room(module: str) -> str:
    return module.split(".")[1]


def imported(found: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of each module of koopmpc that the source imports, or names in a string."""
    for node in found:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "koopmpc":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield node.lineno, inner if inner in MODULES else str(node.module)
        elif isinstance(node, ast.Import):
            yield from ((node.lineno, a.name) for a in node.names if a.name.split(".")[0] == "koopmpc")
        elif isinstance(node, ast.Constant) and node.value in MODULES and node.value not in FRONT_DOOR:
            yield node.lineno, node.value


def upward(module: str, found: Iterable[ast.AST]) -> list[str]:
    """Return the imports of a module that lead to a room above its own, or to the front door."""
    return [
        f"{module}:{line} imports {target}"
        for line, target in imported(found)
        if target in FRONT_DOOR or RANK[room(target)] > RANK[room(module)]
    ]


def test_no_room_imports_one_above_it_in_any_way() -> None:
    inside = [name for name in MODULES if name not in FRONT_DOOR]
    assert [fault for name in inside for fault in upward(name, nodes(MODULES[name]))] == []


def test_modules_are_imported_by_computed_names_in_three_files_alone() -> None:
    computed = {
        name
        for name, file in MODULES.items()
        for node in nodes(file)
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", getattr(node.func, "attr", "")) in ("import_module", "__import__")
        and not isinstance(node.args[0], ast.Constant)
    }
    assert computed == set(BY_NAME)


@pytest.mark.parametrize(
    "source",
    [
        "from koopmpc.loop.run import Run",
        "def f():\n    from koopmpc import recording",
        "if TYPE_CHECKING:\n    import koopmpc.apps.cli.app",
        "import_module('koopmpc.views.recording.reader')",
        "import koopmpc",
    ],
)
def test_each_way_up_is_seen(source: str) -> None:
    assert len(upward("koopmpc.data.episodes", ast.walk(ast.parse(source)))) == 1
    downward = ast.walk(ast.parse("from koopmpc.base.values import Value"))
    assert upward("koopmpc.data.episodes", downward) == []


@pytest.mark.parametrize("joint", ["log formats", "monitor", "controllers"])
def test_modules_of_a_joint_are_there(joint: str) -> None:
    assert set(load_joint(joint)) <= set(MODULES)
