"""Write a source file in which each of many changes can be turned on while it runs: the old text and the new one stand there.

So the library is imported and the tests are collected once, and each change costs no more than the tests that meet it.
"""

import ast
from collections.abc import Iterator, Mapping

from tests.mutation.changes import Mutant

STATEMENTS = ("Assign", "AugAssign", "Break", "Continue", "Expr", "Raise", "Return")


def switched(source: bytes, changes: Mapping[str, Mutant], mark: str) -> tuple[bytes, set[str], set[str]]:
    """Return the source with switches for the changes, the names of those it holds, and of those that an import runs.

    Where an import runs one, or one overlaps with another, each function notes the mark when it is entered.
    """
    outside = {name for name, change in changes.items() if not _is_inside(source, change)}
    edits = [(change.start, change.end, name) for name, change in changes.items()]
    held: dict[str, tuple[int, int, bytes]] = {}
    for start, end, name in sorted(edits, key=lambda edit: edit[1] - edit[0]):
        text = _both(source, changes[name], name)
        apart = all(end <= other[0] or other[1] <= start for other in held.values())
        if apart and text and _compiles(source[:start] + text + source[end:]):
            held[name] = (start, end, text)
    made = [*held.values(), *(_entries(source, mark) if outside or len(held) < len(changes) else ())]
    for start, end, text in sorted(made, key=lambda edit: edit[:2], reverse=True):
        source = source[:start] + text + source[end:]
    return source, set(held), outside


def _both(source: bytes, change: Mutant, name: str) -> bytes:
    """Return what takes the place of a change: the new text where it is on, the old one elsewhere."""
    old, new, asked = source[change.start : change.end], change.text.encode(), f'is_on("{name}")'.encode()
    if change.operator not in STATEMENTS:
        return b"(" + new + b" if " + asked + b" else " + old + b")"
    before = source[source.rfind(b"\n", 0, change.start) + 1 : change.start]
    return b"if " + asked + b": " + new + b"\n" + before + b"else: " + old if not before.strip() else b""


def _compiles(source: bytes) -> bool:
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def _functions(source: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield of each function where its body begins, where its first statement after its words does, and where it ends."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            said = ast.get_docstring(node, clean=False) is not None
            at = []
            for each in (node.body[0], node.body[min(said, len(node.body) - 1)]):
                line = min([each.lineno, *(d.lineno for d in getattr(each, "decorator_list", ()))])
                at.append(starts[line - 1] + each.col_offset)
            assert node.body[-1].end_lineno is not None
            yield at[0], at[1], starts[node.body[-1].end_lineno]


def _is_inside(source: bytes, change: Mutant) -> bool:
    return any(begins <= change.start < ends for begins, _, ends in _functions(source))


def _entries(source: bytes, mark: str) -> Iterator[tuple[int, int, bytes]]:
    for _, first, _ in _functions(source):
        before = source[source.rfind(b"\n", 0, first) + 1 : first]
        if not before.strip():
            yield first, first, f'is_on("{mark}")\n'.encode() + before
