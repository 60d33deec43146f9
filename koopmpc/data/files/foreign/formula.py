"""Algebraic conversions that a log states as text, computed without running any of the text."""

import ast
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import LogError

_LONGEST = 1000  # characters of a formula; a conversion is one short line
_NAMES = {"inf": np.inf, "nan": np.nan, "pi": np.pi}  # asammdf turns each x into X, so case says nothing
_FUNCTIONS: dict[str, tuple[int, Callable[..., np.ndarray]]] = {  # name: number of arguments, function
    **{name: (1, getattr(np, name)) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "log10")},
    **{name: (1, getattr(np, name)) for name in ("sqrt", "abs", "floor", "ceil", "arcsin", "arccos", "arctan")},
    **{"asin": (1, np.arcsin), "acos": (1, np.arccos), "atan": (1, np.arctan), "ln": (1, np.log)},
    **{"pow": (2, np.power), "atan2": (2, np.arctan2), "arctan2": (2, np.arctan2)},
}
_OPERATORS: dict[type[ast.AST], Callable[..., np.ndarray]] = {
    **{ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power},
    **{ast.UAdd: np.positive, ast.USub: np.negative},
}

Values = Float[np.ndarray, "*n"]


def read_formula(text: str, channel: str) -> Callable[[Values], Values]:
    """Return the function X → value of a conversion's formula, as MDF's standard writes it.

    A formula has numbers, ``X`` or ``X1``, + − * / and the power ^ or ``**``, parentheses, and functions such as
    ``sqrt``, ``exp``, ``log`` and ``sin``.

    Raises
    ------
    LogError
        The formula holds anything else; it is not computed.
    """
    try:
        if len(text) > _LONGEST:
            raise ValueError(f"it has {len(text)} characters")
        formula = _build(ast.parse(text.strip().replace("^", "**"), mode="eval").body)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
        reason = error.args[0] if isinstance(error, ValueError) else "the text cannot be parsed"
        raise LogError(
            f"channel {channel!r} is converted by the formula {text[:60]!r}, which is not computed: {reason}; export "
            "the log with converted values, for only arithmetic of X and functions such as sqrt and log are computed"
        ) from error

    def convert(raw: Values) -> Values:
        with np.errstate(all="ignore"):
            return np.broadcast_to(formula(np.asarray(raw, dtype=np.float64)), raw.shape).copy()

    return convert


def _build(node: ast.AST) -> Callable[[Values], Values]:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            number = np.array(float(value))
            return lambda _: number
        case ast.Name(id="X" | "X1"):
            return lambda x: x
        case ast.Name(id=name) if name.lower() in _NAMES:
            named = np.array(_NAMES[name.lower()])
            return lambda _: named
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _OPERATORS:
            apply, arguments = _OPERATORS[type(sign)], [_build(operand)]
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
            apply, arguments = _OPERATORS[type(sign)], [_build(left), _build(right)]
        case ast.Call(func=ast.Name(id=name), args=operands, keywords=[]) if name.lower() in _FUNCTIONS:
            count, apply = _FUNCTIONS[name.lower()]
            if len(operands) != count:
                raise ValueError(f"{name.lower()} takes {count} number{'s' * (count > 1)}")
            arguments = [_build(operand) for operand in operands]
        case _:
            raise ValueError(f"it holds {ast.unparse(node)[:30]!r}")
    return lambda x: apply(*(argument(x) for argument in arguments))
