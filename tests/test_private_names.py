"""Rooms know one another by public names alone: no file uses an underscore name that another room defines."""

import ast
from collections import defaultdict
from pathlib import Path

from tests.sources import nodes, trees

ALLOWED = {
    "_asdict",
    "_exit",
    "_fields_",
    "_handle",
    "_replace",
}  # of NamedTuple, os and ctypes: public in spite of their names
OF_RERUN = {"_from_native", "_log_to_stream"}  # Rerun offers nothing else; views/recording/ alone asks for them


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name != "_"


def defined(path: Path) -> set[str]:
    """Names that a file binds: functions, classes, variables, attributes of its objects."""
    names = set()
    for node in nodes(path):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def used(path: Path) -> list[tuple[int, str]]:
    """Underscore names that a file imports, or reads of an object."""
    found = []
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.Attribute):
            found.append((node.lineno, node.attr))
    return [(line, name) for line, name in found if is_private(name)]


def test_no_file_uses_an_underscore_name_that_another_room_or_library_defines() -> None:
    homes = defaultdict(set)
    for path in trees():
        for name in defined(path):
            homes[name].add(path.parts[0])
    foreign = [
        f"{path}:{line} {name}"
        for path in trees()
        for line, name in used(path)
        if path.parts[0] not in homes[name]
        and name not in ALLOWED
        and not (name in OF_RERUN and path.parts[:2] == ("views", "recording"))
    ]
    assert foreign == []


def test_code_generation_reads_no_underscore_name_of_an_object_but_its_own() -> None:
    for path in trees():
        if path.parts[0] == "codegen":
            own = defined(path)
            assert [(line, name) for line, name in used(path) if name not in own] == [], path
