"""A CasADi expression as a list of whitelisted operations, for numpy columns, for symbols and for files."""

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.plants.routines import make_dense

Columns = np.ndarray | float


class Operation(NamedTuple):
    """One operation in two forms: `columns(*operands, out)` for numpy and `symbol(*operands)` for CasADi."""

    operands: int
    columns: Callable[..., Any]
    symbol: Callable[..., Any]


def _where(condition: Columns, value: Columns, out: np.ndarray) -> None:
    out[...] = np.where(condition, value, 0.0)


def _erf(value: Columns, out: np.ndarray) -> None:
    from scipy.special import erf  # here, because few graphs need it and its import takes a while

    erf(value, out)


def _symbolic_square(a: ca.SX) -> ca.SX:
    return a * a


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
    "twice": Operation(1, partial(np.multiply, 2.0), partial(operator.mul, 2)),
    "inv": Operation(1, partial(np.divide, 1.0), partial(ca.rdivide, 1)),
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
    "erf": Operation(1, _erf, ca.erf),
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


_NAMES = {cast("int", getattr(ca, f"OP_{name.upper()}")): name for name in OPERATIONS} | {
    ca.OP_INPUT: "input",
    ca.OP_CONST: "constant",
    ca.OP_OUTPUT: "output",
}
_CHUNK = 4096  # rows that are evaluated at once: a few dozen registers of 32 KiB stay in the cache


@dataclass(frozen=True, eq=False)
class Graph(Value):
    """The function y = g(v) of `n` scalars as steps of a register machine; it does not need CasADi to run.

    Step i writes register ``places[i, 0]``: the operation ``steps[i]`` of registers ``places[i, 1:]``, or the
    element ``places[i, 1]`` of v (step "input") or of `constants` (step "constant"). A step "output" makes
    register ``places[i, 1]`` the result ``places[i, 0]``. The arguments of a function follow each other in v.
    """

    steps: tuple[str, ...]
    places: Int[np.ndarray, "steps 3"]
    constants: Float[np.ndarray, " c"]
    n: int
    m: int

    def __post_init__(self) -> None:
        registers, outputs = set[int](), set[int]()
        if len(self.steps) != len(self.places):
            raise ShapeError(f"places has {len(self.places)} rows, expected {len(self.steps)}, one a step")
        for step, (target, first, second) in zip(self.steps, self.places.tolist(), strict=True):
            if step in ("input", "constant"):
                known = 0 <= first < (self.n if step == "input" else len(self.constants))
            elif step == "output":
                known = first in registers and 0 <= target < self.m
                outputs.add(target)
            else:
                if step not in OPERATIONS:
                    raise DataError(f"a graph has no operation {step!r}; it has {', '.join(OPERATIONS)}")
                known = registers.issuperset((first, second)[: OPERATIONS[step].operands])
            if not known or not 0 <= target < len(self.steps):
                raise DataError(f"step {step!r} at {(target, first, second)} uses a missing register")
            if step != "output":
                registers.add(target)
        if len(outputs) != self.m:
            raise DataError(f"{len(outputs)} of {self.m} results are written")

    @classmethod
    @raise_swallowed()
    def trace(cls, function: ca.Function) -> "Graph":
        """Return the graph of a CasADi function with one result, of any number of arguments.

        Raises
        ------
        DataError
            The function holds an operation that a graph cannot hold; the message names it.
        """
        steps: list[str] = []
        places: list[tuple[int, int, int]] = []
        constants: list[float] = []
        scalar = _expand_to_scalars(function)
        starts = np.cumsum([0] + [scalar.numel_in(i) for i in range(scalar.n_in())]).tolist()
        for k in range(scalar.n_instructions()):
            code, read, written = scalar.instruction_id(k), scalar.instruction_input(k), scalar.instruction_output(k)
            if code not in _NAMES:
                raise DataError(
                    f"{function.name()} uses the operation {_name_operation(code)!r}, which cannot be written as data; "
                    "use those of koopmpc.plants.graph.OPERATIONS"
                )
            name = _NAMES[code]
            if name == "constant":
                place = (written[0], len(constants), 0)
                constants.append(scalar.instruction_constant(k))
            elif name == "input":
                place = (written[0], starts[read[0]] + read[1], 0)
            elif name == "output":
                place = (written[1], read[0], 0)
            else:
                place = (written[0], read[0], read[1] if len(read) == 2 else 0)
            steps.append(name)
            places.append(place)
        table = np.array(places, dtype=np.int64).reshape(len(places), 3)
        return cls(tuple(steps), table, np.array(constants), starts[-1], scalar.numel_out(0))

    def evaluate(self, columns: ArrayLike) -> Float[np.ndarray, "M m"]:
        """Return y = g(v) row by row: (M, m) from `columns` (M, n)."""
        rows = checks.array(columns, "columns", (None, self.n), finite=False)
        result = np.empty((len(rows), self.m))
        for start in range(0, len(rows), _CHUNK):
            part = np.ascontiguousarray(rows[start : start + _CHUNK].T)
            self.run(part, result[start : start + _CHUNK].T, self.scratch(part.shape[1]))
        return result

    def symbolic(self, *arguments: ca.SX) -> ca.SX:
        """Return y = g(v) as an expression (m, 1) of the arguments' elements, one after the other."""
        v = ca.vertcat(*arguments)
        if v.shape != (self.n, 1):
            raise ShapeError(f"the arguments have shape {v.shape} together, expected ({self.n}, 1)")
        results = [ca.SX(0)] * self.m
        for target, value in self._walk([v[i] for i in range(self.n)], None):
            results[target] = value
        return ca.vertcat(*results) if results else ca.SX(0, 1)

    def scratch(self, rows: int) -> list[np.ndarray]:
        """Return the registers that `run` needs for a batch of `rows`."""
        return list(np.empty((int(self.places[:, 0].max(initial=0)) + 1, rows)))

    def run(self, inputs: np.ndarray | Sequence[Columns], results: np.ndarray, scratch: list[np.ndarray]) -> None:
        """Write y = g(v) into `results` (m, M); `inputs` is v, (n, M), or n items that are rows (M,) or numbers."""
        with np.errstate(all="ignore"):
            for target, value in self._walk(inputs, scratch):
                results[target] = value

    @cached_property
    def _program(self) -> list[tuple[str, Operation | None, int, int, int]]:
        rows = zip(self.steps, self.places.tolist(), strict=True)
        return [(step, OPERATIONS.get(step), *place) for step, place in rows]

    def _walk(self, inputs: Any, scratch: list[np.ndarray] | None) -> Iterator[tuple[int, Any]]:
        """Yield (result, value) for each output: numpy columns in `scratch`, or symbols without it."""
        registers: dict[int, Any] = {}
        for step, operation, target, first, second in self._program:
            if operation is not None:
                unary = operation.operands == 1
                operands = (registers[first],) if unary else (registers[first], registers[second])
                if scratch is None:
                    registers[target] = operation.symbol(*operands)
                else:
                    operation.columns(*operands, scratch[target])
                    registers[target] = scratch[target]
            elif step == "input":
                registers[target] = inputs[first]
            elif step == "constant":
                constant = float(self.constants[first])
                registers[target] = ca.SX(constant) if scratch is None else constant
            else:
                yield target, registers[first]


def _expand_to_scalars(function: ca.Function) -> ca.Function:
    """Return `function` as an SX function of dense scalars."""
    if function.n_out() != 1:
        raise ShapeError(f"{function.name()} has {function.n_out()} results, expected one")
    if function.is_a("SXFunction"):
        return make_dense(function)
    try:
        return make_dense(function.expand())
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise DataError(f"{function.name()} cannot be written as scalar operations: {reason}") from error


def _name_operation(code: int) -> str:
    """Return CasADi's name of an operation."""
    return next(name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == code)[3:].lower()
