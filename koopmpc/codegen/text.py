"""C as text: numbers, arrays, and functions made of the operations of a graph."""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from koopmpc.errors import DataError
from koopmpc.plants.graph import Graph

_WIDTH = 118

# Each operation of `plants.graph` as C; {0} and {1} are its operands. Names of math.h go through KOOPMPC_FN, which
# takes the float version in single precision.
_UNARY = {
    "assign": "{0}",
    "neg": "-{0}",
    "sq": "{0} * {0}",
    "twice": "{0} + {0}",
    "inv": "1 / {0}",
    "not": "(koopmpc_real)({0} == 0)",
    "sign": "(koopmpc_real)(({0} > 0) - ({0} < 0))",
}
_BINARY = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "lt": "(koopmpc_real)({0} < {1})",
    "le": "(koopmpc_real)({0} <= {1})",
    "eq": "(koopmpc_real)({0} == {1})",
    "ne": "(koopmpc_real)({0} != {1})",
    "and": "(koopmpc_real)({0} != 0 && {1} != 0)",
    "or": "(koopmpc_real)({0} != 0 || {1} != 0)",
    "if_else_zero": "{0} != 0 ? {1} : 0",
    "pow": "KOOPMPC_FN(pow)({0}, {1})",
    "constpow": "KOOPMPC_FN(pow)({0}, {1})",
}
_HYPERBOLIC = ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
_MATH = ("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "fabs", "floor", "ceil")
_MATH_OF_TWO = ("hypot", "atan2", "fmin", "fmax", "fmod", "copysign")
EXPRESSIONS = (
    _UNARY
    | _BINARY
    | {name: f"KOOPMPC_FN({name})({{0}})" for name in (*_MATH, *_HYPERBOLIC)}
    | {name: f"KOOPMPC_FN({name})({{0}}, {{1}})" for name in _MATH_OF_TWO}
)
_FLOPS = {"assign": 0, "neg": 0}  # of one operation where it is not 1; a function of math.h counts 20
_CALL = 20


@dataclass(frozen=True)
class Language:
    """How numbers are written: in double or in single precision."""

    single: bool = False

    def number(self, value: float) -> str:
        """Return a literal that reads back as this number; what is beyond 1e30 becomes ±1e30."""
        value = float(np.clip(value, -1e30, 1e30))
        if self.single:
            short = f"{float(np.float32(value)):.9g}"
            return short + ("F" if any(mark in short for mark in ".en") else ".0F")
        return repr(value)

    def array(self, name: str, values: np.ndarray, kind: str = "koopmpc_real") -> str:
        """Return the definition of a constant array; an empty one holds one zero, for C has none of length 0."""
        flat = np.asarray(values).ravel()
        if kind == "int":
            words = [str(int(value)) for value in flat] or ["0"]
        else:
            words = [self.number(value) for value in flat] or [self.number(0.0)]
        lines = [f"static const {kind} {name}[{len(words)}] = {{"]
        line = " "
        for word in words:
            if len(line) + len(word) + 2 > _WIDTH:
                lines.append(line)
                line = " "
            line += f" {word},"
        return "\n".join([*lines, line, "};"])

    def arrays(self, table: Mapping[str, np.ndarray]) -> str:
        """Return the definitions of all arrays, integers for integer ones."""
        parts = [
            self.array(f"koopmpc_{name}", values, "int" if np.asarray(values).dtype.kind in "iu" else "koopmpc_real")
            for name, values in table.items()
        ]
        return "\n".join(parts) + "\n"


@dataclass
class Function:
    """A C function made of a graph, and what it costs."""

    text: str
    flops: int


def traced(function: ca.Function, what: str) -> Graph:
    """Return the graph of a function with one result.

    Raises
    ------
    DataError
        It holds what cannot be written in C; the message says what it is and what would do.
    """
    try:
        return Graph.trace(function)
    except DataError as error:
        raise DataError(f"{what} cannot be written in C: {error}") from error


def function(graph: Graph, name: str, arguments: Mapping[str, int], result: str, language: Language) -> Function:
    """Return ``void name(const real *argument, …, real *result)``, each register written once."""
    places: list[str] = [f"{argument}[{i}]" for argument, size in arguments.items() for i in range(size)]
    registers: dict[int, str] = {}
    results: list[str] = []
    lines: list[str] = []
    flops = 0
    for count, (step, (target, first, second)) in enumerate(zip(graph.steps, graph.places.tolist(), strict=True)):
        if step == "output":
            results.append(f"  {result}[{target}] = {registers[first]};")
            continue
        if step == "input":
            registers[target] = places[first]
            continue
        if step == "constant":
            value = float(graph.constants[first])
            text = language.number(value)
            registers[target] = f"({text})" if text.startswith("-") else text
            continue
        a, b = registers[first], registers.get(second, "")
        lines.append(f"  const koopmpc_real v{count} = {EXPRESSIONS[step].format(a, b)};")
        registers[target] = f"v{count}"
        flops += _FLOPS.get(step, _CALL if "KOOPMPC_FN" in EXPRESSIONS[step] else 1)
    # An argument may be the result's own array: it is read before it is written.
    heads = [f"const koopmpc_real *{argument}" for argument in arguments]
    unused = [f"  (void){argument};" for argument in arguments if not any(f"{argument}[" in s for s in lines + results)]
    body = "\n".join([*unused, *lines, *results])
    return Function(f"void {name}({', '.join(heads)}, koopmpc_real *{result}) {{\n{body}\n}}\n", flops)
