"""The sources of koopmpc as trees, parsed once for all tests of a process."""

import ast
import gc
from functools import cache
from pathlib import Path

import koopmpc as km

ROOT = Path(km.__file__).parent


@cache
def texts() -> dict[Path, str]:
    """Return the text of each file, by its path inside the package."""
    return {path.relative_to(ROOT): path.read_text(encoding="utf-8") for path in sorted(ROOT.rglob("*.py"))}


@cache
def trees() -> dict[Path, ast.Module]:
    """Return the tree of each file; searches for garbage, of which trees have none, would take most of the time."""
    gc.disable()
    try:
        found = {path: ast.parse(text) for path, text in texts().items()}
    finally:
        gc.freeze()
        gc.enable()
    return found


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Return all nodes of a file."""
    return list(ast.walk(trees()[path]))
