"""Changes of a source file that a good test notices: each at one place, the rest of the file as it was."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Mutant:
    """One change: bytes `start` to `end` of a file become `text`; `first` and `last` are the lines around it."""

    file: str
    first: int
    last: int
    start: int
    end: int
    text: str

    def of(self, source: bytes) -> bytes:
        """Return the source with the change in it."""
        return source[: self.start] + self.text.encode() + source[self.end :]

    def lines(self, source: bytes) -> tuple[str, str]:
        """Return what stands in these lines before and after, each as one line."""
        before, after = source.decode().splitlines(), self.of(source).decode().splitlines()
        end = self.last + len(after) - len(before)
        return " ".join(" ".join(before[self.first - 1 : self.last]).split()), " ".join(
            " ".join(after[self.first - 1 : end]).split()
        )


SWAPPED: dict[type[Any], type[Any]] = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult},
    **{ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd},
}
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any"}
DECLARED = ("annotation", "returns", "decorator_list", "bases")  # fields that hold types
SKIPPED = (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom, ast.Assert)  # what stands in them is said, not done


def _text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _changed(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield the nodes to replace here, each with what takes its place."""
    match node:
        case ast.Compare(left, operators, others):
            for i, operator in enumerate(operators):
                swapped = [*operators[:i], SWAPPED[type(operator)](), *operators[i + 1 :]]
                yield node, ast.Compare(left, swapped, others)
        case ast.BoolOp(operator, values):
            yield node, ast.BoolOp(SWAPPED[type(operator)](), values)
        case ast.BinOp(left, operator, right) if type(operator) in SWAPPED and not (_text(left) or _text(right)):
            yield node, ast.BinOp(left, SWAPPED[type(operator)](), right)
        case ast.AugAssign(target, operator, value) if type(operator) in SWAPPED and not _text(value):
            yield node, ast.AugAssign(target, SWAPPED[type(operator)](), value)
            yield node, ast.Pass()
        case ast.UnaryOp(ast.Not() | ast.USub(), operand) if not isinstance(operand, ast.Constant):
            yield node, operand
        case ast.Constant(bool(value)):
            yield node, ast.Constant(not value)
        case ast.Constant(int(value)):
            yield node, ast.Constant(value + 1)
        case ast.Constant(float(value)):
            yield node, ast.Constant(2 * value or 1.0)
        case ast.Call(ast.Name(name) as function) if name in NAMES:
            yield function, ast.Name(NAMES[name])
        case ast.Attribute(value, name) if name in NAMES:
            yield node, ast.Attribute(value, NAMES[name])
        case ast.Return(ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield node, ast.Return(ast.Constant(None))
        case ast.Expr(ast.Call()) | ast.Raise() | ast.Continue() | ast.Break():
            yield node, ast.Pass()
        case ast.Assign([ast.Attribute() | ast.Subscript(), *_]):
            yield node, ast.Pass()
        case ast.If(test) | ast.IfExp(test) | ast.While(test) if not isinstance(test, ast.UnaryOp | ast.Constant):
            yield test, ast.UnaryOp(ast.Not(), test)
        case _:
            pass


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what stands in this node and does something: no types, and nothing that is only said."""
    if isinstance(node, SKIPPED):
        return
    for name, value in ast.iter_fields(node):
        if name not in DECLARED:
            yield from (
                child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST)
            )


def _is_skipped(node: ast.AST) -> bool:
    """Return whether a node is a union of types, an import for them, a warning's words, or zip's assertion."""
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return True
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return True
    if isinstance(node, ast.Call):
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        return name in ("isinstance", "warn", "cast", "Literal")
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr) and ast.unparse(node.right)[:1].isupper()


def mutants(file: str, source: bytes) -> Iterator[Mutant]:
    """Yield every change of this file; words, types and declarations stay as they are."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def visit(node: ast.AST, statement: ast.AST) -> Iterator[Mutant]:
        if _is_skipped(node):
            return
        statement = node if isinstance(node, ast.stmt) else statement
        for old, new in _changed(node):
            text = ast.unparse(new)
            yield Mutant(
                file,
                statement.lineno,
                old.end_lineno,
                starts[old.lineno - 1] + old.col_offset,
                starts[old.end_lineno - 1] + old.end_col_offset,
                text if isinstance(new, ast.stmt | ast.Name | ast.Attribute | ast.Constant) else f"({text})",
            )
        for child in _children(node):
            yield from visit(child, statement)

    tree = ast.parse(source)
    yield from visit(tree, tree)
