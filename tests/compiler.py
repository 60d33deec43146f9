"""The C compiler that koopmpc finds, for tests that compile what it wrote or that need machine code."""

import re
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import koopmpc
from koopmpc.plants.routines import find_compiler as find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")


def avoid_compiling(monkeypatch):
    """Leave functions and step maps to the interpreter, for loops that are shorter than their compilation."""
    _import_finders()
    monkeypatch.setattr("koopmpc.plants.routines.find_compiler", lambda: None)


@cache
def _import_finders():
    """Import what takes the function by its name: imported while it is replaced, it would never find a compiler."""
    home = Path(koopmpc.__file__).parent
    for file in home.rglob("*.py"):
        if re.search(r"^from koopmpc\.plants\.routines import .*\bfind_compiler\b", file.read_text(), re.MULTILINE):
            import_module(".".join(file.relative_to(home.parent).with_suffix("").parts))
