"""The operations that a graph may hold: what each does to numpy columns and to CasADi symbols."""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

Columns = np.ndarray | float


class Operation(NamedTuple):
    """One operation, twice: `columns(*operands, out)` for numpy and `symbol(*operands)` for CasADi."""

    operands: int
    columns: Callable[..., Any]
    symbol: Callable[..., Any]


def _where(condition: Columns, value: Columns, out: np.ndarray) -> None:
    out[...] = np.where(condition, value, 0.0)


def _twice(a: Columns, out: np.ndarray) -> None:
    np.add(a, a, out=out)


def _inverse(a: Columns, out: np.ndarray) -> None:
    np.divide(1.0, a, out=out)


def _symbolic_square(a: ca.SX) -> ca.SX:
    return a * a


def _symbolic_twice(a: ca.SX) -> ca.SX:
    return 2 * a


def _symbolic_inverse(a: ca.SX) -> ca.SX:
    return 1 / a


def _symbolic_where(condition: ca.SX, value: ca.SX) -> ca.SX:
    return ca.if_else(condition, value, 0)


# Named after CasADi's OP_ codes, whose numbers may change; a saved graph holds the names.
OPERATIONS = {
    "assign": Operation(1, np.positive, operator.pos),
    "add": Operation(2, np.add, operator.add),
    "sub": Operation(2, np.subtract, operator.sub),
    "mul": Operation(2, np.multiply, operator.mul),
    "div": Operation(2, np.divide, ca.rdivide),
    "neg": Operation(1, np.negative, operator.neg),
    "sq": Operation(1, np.square, _symbolic_square),
    "twice": Operation(1, _twice, _symbolic_twice),
    "inv": Operation(1, _inverse, _symbolic_inverse),
    "sqrt": Operation(1, np.sqrt, ca.sqrt),
    "pow": Operation(2, np.power, ca.power),
    "constpow": Operation(2, np.power, ca.power),
    "exp": Operation(1, np.exp, ca.exp),
    "expm1": Operation(1, np.expm1, ca.expm1),
    "log": Operation(1, np.log, ca.log),
    "log1p": Operation(1, np.log1p, ca.log1p),
    "hypot": Operation(2, np.hypot, ca.hypot),
    "sin": Operation(1, np.sin, ca.sin),
    "cos": Operation(1, np.cos, ca.cos),
    "tan": Operation(1, np.tan, ca.tan),
    "asin": Operation(1, np.arcsin, ca.asin),
    "acos": Operation(1, np.arccos, ca.acos),
    "atan": Operation(1, np.arctan, ca.atan),
    "atan2": Operation(2, np.arctan2, ca.atan2),
    "sinh": Operation(1, np.sinh, ca.sinh),
    "cosh": Operation(1, np.cosh, ca.cosh),
    "tanh": Operation(1, np.tanh, ca.tanh),
    "asinh": Operation(1, np.arcsinh, ca.asinh),
    "acosh": Operation(1, np.arccosh, ca.acosh),
    "atanh": Operation(1, np.arctanh, ca.atanh),
    "fabs": Operation(1, np.fabs, ca.fabs),
    "sign": Operation(1, np.sign, ca.sign),
    "floor": Operation(1, np.floor, ca.floor),
    "ceil": Operation(1, np.ceil, ca.ceil),
    "fmin": Operation(2, np.fmin, ca.fmin),
    "fmax": Operation(2, np.fmax, ca.fmax),
    "fmod": Operation(2, np.fmod, ca.fmod),
    "copysign": Operation(2, np.copysign, ca.copysign),
    "lt": Operation(2, np.less, operator.lt),
    "le": Operation(2, np.less_equal, operator.le),
    "eq": Operation(2, np.equal, operator.eq),
    "ne": Operation(2, np.not_equal, operator.ne),
    "not": Operation(1, np.logical_not, ca.logic_not),
    "and": Operation(2, np.logical_and, ca.logic_and),
    "or": Operation(2, np.logical_or, ca.logic_or),
    "if_else_zero": Operation(2, _where, _symbolic_where),
}
