"""Changes of a source file that a good test notices: each at one place, the rest of the file as it was."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Mutant:
    """One change: bytes `start` to `end` of a file become `text`; `first` and `last` are the lines around it.

    `operator` is the kind of what is changed: Compare, Constant, Return, …
    """

    file: str
    first: int
    last: int
    start: int
    end: int
    text: str
    operator: str = ""

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
# What nobody could notice is left out: a comparison with a tolerance or a clock is an accident at the very end of it, a
# number that stands for "next to nothing" or "far too much" may be twice as large, and a most that is never reached one
# more; CasADi's common subexpressions (cse) only save time; and what a column of zeros is divided by, the last 1 in
# np.where(size > 0, size, 1), may be any number but zero.
TOLERANCES = ("reach", "tolerance", "slack", "good", "enough", "close", "settled", "perf_counter", "monotonic")
TINY, SMALL, VAST, MANY = 1e-5, 0.01, 1e5, 10
SKIPPED = (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom, ast.Assert)  # what stands in them is said, not done


def _text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _tolerance(node: ast.AST) -> bool:
    """Return whether a tolerance or a time is part of this: a small float, or a name of one."""
    for each in ast.walk(node):
        name = each.id if isinstance(each, ast.Name) else each.attr if isinstance(each, ast.Attribute) else ""
        if name in TOLERANCES or (len(name.strip("_")) > 2 and name.isupper()):
            return True
        if isinstance(each, ast.Constant) and isinstance(each.value, float) and 0 < each.value < SMALL:
            return True
    return False


def _changed(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield the nodes to replace here, each with what takes its place."""
    match node:
        case ast.Compare(left, operators, others):
            for i, operator in enumerate(operators):
                if isinstance(operator, ast.Lt | ast.LtE | ast.Gt | ast.GtE) and _tolerance(node):
                    continue
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
        case ast.Constant(float(value)) if value == 0 or TINY < value < VAST:
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
    if isinstance(node, ast.Dict):
        kept = [(k, v) for k, v in zip(node.keys, node.values, strict=True) if not (k and _most(ast.unparse(k)))]
        yield from (child for pair in kept for child in pair if child is not None)
        return
    if isinstance(node, ast.Call) and len(node.args) == 3 and ast.unparse(node.func) == "np.where":
        where, own, instead = node.args
        if isinstance(instead, ast.Constant) and instead.value and ast.unparse(where) == f"{ast.unparse(own)} > 0":
            yield from (where, own)
            return
    for name, value in ast.iter_fields(node):
        if name not in DECLARED:
            yield from (
                child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST)
            )


def _most(key: str) -> bool:
    return "max_iter" in key or key.strip("'") == "cse"


def _is_skipped(node: ast.AST) -> bool:
    """Return whether a node is a union of types, an import for them, a warning's words, zip's assertion, or a most."""
    if isinstance(node, ast.keyword) and (node.arg == "strict" or _most(node.arg or "")):
        return True
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return True
    if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant) and isinstance(node.targets[0], ast.Name):
        value = node.value.value
        return node.targets[0].id.isupper() and type(value) is int and value >= MANY
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
                type(node).__name__,
            )
        for child in _children(node):
            yield from visit(child, statement)

    tree = ast.parse(source)
    yield from visit(tree, tree)
