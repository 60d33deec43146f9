"""Rooms know one another by public names alone: no file uses an underscore name that another room defines."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import koopmpc

ROOT = Path(koopmpc.__file__).parent
ALLOWED = {
    "_asdict",
    "_exit",
    "_fields_",
    "_handle",
    "_replace",
}  # of NamedTuple, os and ctypes: public in spite of their names
OF_RERUN = {"_from_native", "_log_to_stream"}  # Rerun offers nothing else; recording/ alone asks for them


@pytest.fixture(scope="module")
def trees() -> dict[Path, ast.Module]:
    return {path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(ROOT.rglob("*.py"))}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name != "_"


def defined(tree: ast.Module) -> set[str]:
    """Names that a file binds: functions, classes, variables, attributes of its objects."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def used(tree: ast.Module) -> list[tuple[int, str]]:
    """Underscore names that a file imports, or reads of an object."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.Attribute):
            found.append((node.lineno, node.attr))
    return [(line, name) for line, name in found if is_private(name)]


def test_no_file_uses_an_underscore_name_that_another_room_or_library_defines(trees: dict[Path, ast.Module]):
    homes = defaultdict(set)
    for path, tree in trees.items():
        for name in defined(tree):
            homes[name].add(path.parts[0])
    foreign = [
        f"{path}:{line} {name}"
        for path, tree in trees.items()
        for line, name in used(tree)
        if path.parts[0] not in homes[name]
        and name not in ALLOWED
        and not (name in OF_RERUN and path.parts[0] == "recording")
    ]
    assert foreign == []


def test_code_generation_reads_no_underscore_name_of_an_object_but_its_own(trees: dict[Path, ast.Module]):
    for path, tree in trees.items():
        if path.parts[0] == "codegen":
            own = defined(tree)
            assert [(line, name) for line, name in used(tree) if name not in own] == [], path
