"""Interval arithmetic on a function's operations: whether it is a number, with its slopes, whatever it is given."""

from collections.abc import Callable
from math import exp, inf, isfinite, pi

import casadi as ca

Range = tuple[float, float]
_ALL: Range = (-inf, inf)
_UNIT: Range = (-1.0, 1.0)
_LARGE = 700.0  # exp of more is infinite
# Of each operation of one argument: its range, from that of the argument.
_ALONE: dict[str, Callable[[float, float], Range]] = {
    "ASSIGN": lambda low, high: (low, high),
    "LIFT": lambda low, high: (low, high),
    "NEG": lambda low, high: (-high, -low),
    "TWICE": lambda low, high: (2 * low, 2 * high),
    "SQ": lambda low, high: _square(low, high),
    "FABS": lambda low, high: (0.0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high))),
    "SIN": lambda _, __: _UNIT,
    "COS": lambda _, __: _UNIT,
    "TANH": lambda _, __: _UNIT,
    "ERF": lambda _, __: _UNIT,
    "SIGN": lambda _, __: _UNIT,
    "ATAN": lambda _, __: (-pi / 2, pi / 2),
    "ASINH": lambda _, __: _ALL,
    "FLOOR": lambda low, high: (low - 1, high),
    "CEIL": lambda low, high: (low, high + 1),
    "NOT": lambda _, __: (0.0, 1.0),
    "EXP": lambda _, high: (0.0, inf if high > _LARGE else exp(high)),
    "SQRT": lambda _, __: (0.0, inf),
    "LOG": lambda _, __: _ALL,
    "LOG1P": lambda _, __: _ALL,
    "INV": lambda low, high: (0.0, inf) if low > 0 else (-inf, 0.0),
}
_PAIRS: dict[str, Callable[[Range, Range], Range]] = {
    "ADD": lambda a, b: (a[0] + b[0], a[1] + b[1]),
    "SUB": lambda a, b: (a[0] - b[1], a[1] - b[0]),
    "MUL": lambda a, b: _product(a, b),
    "DIV": lambda a, b: _product(a, (1 / b[1], 1 / b[0])),
    "CONSTPOW": lambda a, b: (0.0, inf) if a[0] >= 0 or b[0] % 2 == 0 else _ALL,
    "POW": lambda a, b: (0.0, inf) if a[0] >= 0 or b[0] % 2 == 0 else _ALL,
    "FMIN": lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    "FMAX": lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
    "IF_ELSE_ZERO": lambda _, b: (min(0.0, b[0]), max(0.0, b[1])),
    "HYPOT": lambda _, __: (0.0, inf),
    "COPYSIGN": lambda a, _: (-max(abs(a[0]), abs(a[1])), max(abs(a[0]), abs(a[1]))),
}
_COMPARED = {"LT", "LE", "EQ", "NE", "AND", "OR"}
_NAMES = {int(getattr(ca, name)): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}


def find_undefined_operation(function: ca.Function) -> str | None:
    """Return an operation that may be no number, or have no slope, for some arguments; None where all are numbers.

    Each value is bounded by an interval, from the constants on; inputs are any number. Bounds do not know that two
    values belong together, so a function that is a number everywhere may be refused. Only values that
    overflow pass unseen.
    """
    if not function.is_a("SXFunction"):
        return "an operation that CasADi does not write out"
    work: dict[int, Range] = {}
    for k in range(function.n_instructions()):
        name = _NAMES[function.instruction_id(k)]
        read, written = function.instruction_input(k), function.instruction_output(k)
        if name == "OUTPUT":
            continue
        found: Range | str = _ALL
        if name == "CONST":
            value = float(function.instruction_constant(k))
            found = (value, value) if isfinite(value) else "a constant that is not finite"
        elif name == "MUL" and read[0] == read[1]:
            found = _square(*work[read[0]])
        elif name != "INPUT":
            found = _range(name, [work[i] for i in read])
        if isinstance(found, str):
            return found
        work[written[0]] = found
    return None


def _range(name: str, read: list[Range]) -> Range | str:
    """Return the range of an operation, or why it may be no number."""
    if len(read) == 1 and name in _ALONE:
        return _refuse(name, *read[0]) or _ALONE[name](*read[0])
    if name in _COMPARED:
        return 0.0, 1.0
    if len(read) == 2 and name in _PAIRS:
        return _refuse_pair(name, *read) or _PAIRS[name](*read)
    return f"CasADi's operation {name}"


def _refuse(name: str, low: float, high: float) -> str | None:
    """Return why an operation on an argument in this range may be no number, or have no slope."""
    if name == "SQRT" and not low > 0:
        return "a root of what may be 0 or negative"
    if name in ("LOG", "LOG1P") and not low > (0 if name == "LOG" else -1):
        return "a logarithm of what may be 0 or negative"
    if name == "EXP" and high > _LARGE:
        return "an exponential of what has no upper bound"
    if name == "INV" and low <= 0 <= high:
        return "a division by what may be 0"
    return None


def _refuse_pair(name: str, a: Range, b: Range) -> str | None:
    """Return why an operation on two arguments in these ranges may be no number, or have no slope."""
    if name == "DIV" and b[0] <= 0 <= b[1]:
        return "a division by what may be 0"
    if name in ("POW", "CONSTPOW"):
        whole = b[0] == b[1] and b[0] >= 1 and b[0] % 1 == 0
        if not whole and not a[0] > 0:
            return "a power of what may be 0 or negative"
        if b[0] != b[1]:
            return "a power whose exponent is not constant"
    if name == "HYPOT" and a[0] <= 0 <= a[1] and b[0] <= 0 <= b[1]:
        return "a length of what may be 0"
    return None


def _square(low: float, high: float) -> Range:
    most = max(low * low, high * high)
    return (0.0 if low <= 0 <= high else min(low * low, high * high)), most


def _product(a: Range, b: Range) -> Range:
    """Return the range of a product, where 0 times infinity is 0."""
    ends = [x * y if x and y else 0.0 for x in a for y in b]
    return min(ends), max(ends)
