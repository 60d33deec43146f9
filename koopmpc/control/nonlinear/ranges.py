"""Interval arithmetic on a function's operations: whether it is a number, with its slopes, whatever it is given."""

from collections.abc import Callable
from math import exp, inf, isfinite, pi

import casadi as ca

Range = tuple[float, float]
_ALL: Range = (-inf, inf)
_LARGE = 700.0  # exp of more is infinite


def _square(a: Range) -> Range:
    ends = a[0] * a[0], a[1] * a[1]
    return (0.0 if a[0] <= 0 <= a[1] else min(ends)), max(ends)


def _absolute(a: Range) -> Range:
    return (0.0 if a[0] <= 0 <= a[1] else min(map(abs, a))), max(map(abs, a))


def _product(a: Range, b: Range) -> Range:
    """Return the range of a product, where 0 times infinity is 0."""
    ends = [x * y if x and y else 0.0 for x in a for y in b]
    return min(ends), max(ends)


def _power(a: Range, b: Range) -> Range:
    return (0.0, inf) if a[0] >= 0 or b[0] % 2 == 0 else _ALL


def _is_power_at_zero(a: Range, b: Range) -> bool:
    """Return whether a base may be 0 or negative while its exponent is not a whole number above 0."""
    return not (a[0] > 0 or (b[0] == b[1] and b[0] >= 1 and b[0] % 1 == 0))


Rule = Callable[[Range, Range], Range]  # the range of an operation, from those of its operands; one alone comes twice


def _between(low: float, high: float) -> Rule:
    return lambda _, __: (low, high)


_RANGES: dict[str, Rule] = {
    **dict.fromkeys(("SIN", "COS", "TANH", "ERF", "SIGN"), _between(-1.0, 1.0)),
    **dict.fromkeys(("ASINH", "LOG", "LOG1P"), _between(-inf, inf)),
    **dict.fromkeys(("NOT", "LT", "LE", "EQ", "NE", "AND", "OR"), _between(0.0, 1.0)),
    **dict.fromkeys(("SQRT", "HYPOT"), _between(0.0, inf)),
    **dict.fromkeys(("POW", "CONSTPOW"), _power),
    "ATAN": _between(-pi / 2, pi / 2),
    "ASSIGN": lambda a, _: a,
    "LIFT": lambda a, _: a,
    "NEG": lambda a, _: (-a[1], -a[0]),
    "TWICE": lambda a, _: (2 * a[0], 2 * a[1]),
    "SQ": lambda a, _: _square(a),
    "FABS": lambda a, _: _absolute(a),
    "FLOOR": lambda a, _: (a[0] - 1, a[1]),
    "CEIL": lambda a, _: (a[0], a[1] + 1),
    "EXP": lambda a, _: (0.0, inf if a[1] > _LARGE else exp(a[1])),
    "INV": lambda a, _: (0.0, inf) if a[0] > 0 else (-inf, 0.0),
    "ADD": lambda a, b: (a[0] + b[0], a[1] + b[1]),
    "SUB": lambda a, b: (a[0] - b[1], a[1] - b[0]),
    "MUL": _product,
    "DIV": lambda a, b: _product(a, (1 / b[1], 1 / b[0])),
    "FMIN": lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    "FMAX": lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
    "IF_ELSE_ZERO": lambda _, b: (min(0.0, b[0]), max(0.0, b[1])),
    "COPYSIGN": lambda a, _: (-_absolute(a)[1], _absolute(a)[1]),
}
# operation → condition on its operands under which it, or its slope, is undefined; and the words for it
_UNDEFINED: dict[str, tuple[Callable[[Range, Range], bool], str]] = {
    "SQRT": (lambda a, _: a[0] <= 0, "a root of what may be 0 or negative"),
    "LOG": (lambda a, _: a[0] <= 0, "a logarithm of what may be 0 or negative"),
    "LOG1P": (lambda a, _: a[0] <= -1, "a logarithm of what may be 0 or negative"),
    "EXP": (lambda a, _: a[1] > _LARGE, "an exponential of what has no upper bound"),
    "INV": (lambda a, _: a[0] <= 0 <= a[1], "a division by what may be 0"),
    "DIV": (lambda _, b: b[0] <= 0 <= b[1], "a division by what may be 0"),
    "POW": (lambda a, b: b[0] != b[1] or _is_power_at_zero(a, b), "a power of what may be 0, or that is not constant"),
    "CONSTPOW": (_is_power_at_zero, "a power of what may be 0 or negative"),
    "HYPOT": (lambda a, b: a[0] <= 0 <= a[1] and b[0] <= 0 <= b[1], "a length of what may be 0"),
}
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
        if name == "INPUT":
            work[written[0]] = _ALL
            continue
        if name == "CONST":
            value = float(function.instruction_constant(k))
            if not isfinite(value):
                return "a constant that is not finite"
            work[written[0]] = value, value
            continue
        a, b = work[read[0]], work[read[-1]]
        if name not in _RANGES:
            return f"CasADi's operation {name}"
        if name in _UNDEFINED and _UNDEFINED[name][0](a, b):
            return _UNDEFINED[name][1]
        work[written[0]] = _square(a) if name == "MUL" and read[0] == read[1] else _RANGES[name](a, b)
    return None
