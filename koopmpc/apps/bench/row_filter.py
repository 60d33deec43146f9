"""RowFilter: comparisons of the figures of a run, such as ``"violation > 0.01 and controller == 'lqr'"``."""

import ast
from collections.abc import Callable, Mapping
from operator import eq, ge, gt, le, lt, ne
from typing import Any

from koopmpc.base.errors import DataError


class RowFilter:
    """Comparisons of figures and names with numbers and texts, joined by and, or, not; no code is run.

    Raises
    ------
    DataError
        The text is something else.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._tree = ast.parse(text, mode="eval").body
        except (SyntaxError, ValueError) as error:
            raise DataError(f'--where "{text}" is not a comparison; write for example "violation > 0.01"') from error

    def holds(self, values: Mapping[str, Any]) -> bool:
        """Return whether it holds for these figures."""
        return bool(self._value(self._tree, values))

    def _value(self, node: ast.expr, values: Mapping[str, Any]) -> Any:
        match node:
            case ast.Constant(value=value):
                return value
            case ast.Name(id=name):
                if name not in values:
                    raise DataError(
                        f'--where "{self.text}": there is no figure {name!r}; there are {", ".join(values)}'
                    )
                return values[name]
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                return not self._value(inner, values)
            case ast.UnaryOp(op=ast.USub(), operand=inner):
                return -self._value(inner, values)
            case ast.BoolOp(op=op, values=parts):
                every = (bool(self._value(part, values)) for part in parts)
                return all(every) if isinstance(op, ast.And) else any(every)
            case ast.Compare(left=left, ops=ops, comparators=rest):
                sides = [self._value(each, values) for each in (left, *rest)]
                return all(self._compare(op, *pair) for op, *pair in zip(ops, sides[:-1], sides[1:], strict=True))
            case _:
                raise DataError(f'--where "{self.text}" holds more than comparisons, and, or, not')

    def _compare(self, op: ast.cmpop, left: Any, right: Any) -> bool:
        how = _COMPARISONS.get(type(op))
        try:
            if how is not None:
                return how(left, right)
        except TypeError as error:
            raise DataError(f'--where "{self.text}" compares {left!r} with {right!r}') from error
        raise DataError(f'--where "{self.text}" holds more than comparisons, and, or, not')


_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: lt, ast.LtE: le, ast.Gt: gt, ast.GtE: ge, ast.Eq: eq, ast.NotEq: ne,
}  # fmt: skip
