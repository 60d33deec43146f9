"""C functions from graphs: straight lines while they are few, and beyond that tables which one loop reads.

A compiler takes more than a line's time for each further line of one function; tables are read as fast as they are
long.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.codegen.tables import CFunction
from koopmpc.plants.graph import OPERATIONS, Graph

_LARGEST = 4000  # operations of a function that is written line by line: gcc takes 0.5 s for 5,000, 6 s for 20,000
_WIDTH = 118
_LONG = 5000  # numbers from which on an array is hexadecimal: gcc reads those in half of the time
_INTEGERS = {np.dtype(np.uint16): "unsigned short", np.dtype(np.intc): "int"}

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
_MATH = ("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "erf")
_WHOLE = ("fabs", "floor", "ceil")
_MATH_OF_TWO = ("hypot", "atan2", "fmin", "fmax", "fmod", "copysign")
EXPRESSIONS = (
    _UNARY
    | _BINARY
    | {name: f"KOOPMPC_FN({name})({{0}})" for name in (*_MATH, *_WHOLE, *_HYPERBOLIC)}
    | {name: f"KOOPMPC_FN({name})({{0}}, {{1}})" for name in _MATH_OF_TWO}
)
_FLOPS = {"assign": 0, "neg": 0}  # of one operation where it is not 1; a function of math.h counts 20
_CALL = 20


@dataclass(frozen=True)
class Language:
    """How numbers are written: in double or in single precision."""

    single: bool = False

    def number(self, value: float) -> str:
        """Return a literal that reads back as this number; numbers beyond ±1e30 become ±1e30."""
        value = float(np.clip(value, -1e30, 1e30))
        if self.single:
            short = f"{float(np.float32(value)):.9g}"
            return short + ("F" if any(mark in short for mark in ".en") else ".0F")
        return repr(value)

    def array(self, name: str, values: np.ndarray) -> str:
        """Return the definition of a constant array, of integers or of numbers as `values` are.

        An empty array becomes one zero: C has no array of length 0.
        """
        flat = np.asarray(values).ravel()
        if flat.dtype.kind in "iu":
            kind, words = _INTEGERS.get(flat.dtype, "int"), [str(int(value)) for value in flat] or ["0"]
        else:
            clipped = np.clip(flat.astype(np.float64), -1e30, 1e30)
            kind, words = "koopmpc_real", self._words(clipped) or [self.number(0.0)]
        lines = [f"static const {kind} {name}[{len(words)}] = {{"]
        line = " "
        for word in words:
            if len(line) + len(word) + 2 > _WIDTH:
                lines.append(line)
                line = " "
            line += f" {word},"
        return "\n".join([*lines, line, "};"])

    def _words(self, flat: Float[np.ndarray, " n"]) -> list[str]:
        """Return the literal of each number, as `number` writes it; of a long array in hexadecimal."""
        if len(flat) >= _LONG:
            end, rounded = ("F", flat.astype(np.float32)) if self.single else ("", flat)
            return [value.hex() + end for value in rounded.tolist()]
        return [self.number(value) for value in flat] if self.single else list(map(repr, flat.tolist()))

    def arrays(self, table: Mapping[str, np.ndarray]) -> str:
        """Return the definitions of all arrays."""
        return "\n".join(self.array(f"koopmpc_{name}", values) for name, values in table.items()) + "\n"


def count_function_flops(graph: Graph) -> int:
    """Return the floating-point operations of a function; one of math.h counts 20."""
    return sum(
        _FLOPS.get(step, _CALL if "KOOPMPC_FN" in EXPRESSIONS[step] else 1)
        for step in graph.steps
        if step in EXPRESSIONS
    )


def write_functions(functions: Mapping[str, CFunction], language: Language) -> str:
    """Return the C of these functions; large ones are tables, and one loop that runs them stands before all."""
    plans = {name: plan_runs(each.graph) for name, each in functions.items() if _is_large(each.graph)}
    most = max((max(plan.places.max(), *(count for _, count in plan.runs)) for plan in plans.values()), default=0)
    kind = np.dtype(np.uint16 if most <= np.iinfo(np.uint16).max else np.intc)
    texts = [_write_loop(sorted({word for plan in plans.values() for word, _ in plan.runs}), kind)] if plans else []
    for name, each in functions.items():
        if name in plans:
            texts.append(_write_table(plans[name], kind, each, name, language))
        else:
            texts.append(write_function(each, name, language))
    return "\n".join(texts)


def _is_large(graph: Graph) -> bool:
    return sum(step in EXPRESSIONS for step in graph.steps) > _LARGEST


def _write_head(each: CFunction, name: str) -> str:
    heads = [f"const koopmpc_real *{argument}" for argument in each.arguments]
    return f"void {name}({', '.join(heads)}, koopmpc_real *{each.result})"


def write_function(each: CFunction, name: str, language: Language) -> str:
    """Return ``void name(const real *argument, …, real *result)``, each register written once."""
    graph, arguments, result = each
    places: list[str] = [f"{argument}[{i}]" for argument, size in arguments.items() for i in range(size)]
    registers: dict[int, str] = {}
    results: list[str] = []
    lines: list[str] = []
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
    # The result may be an argument's own array: all reads come before the writes.
    unused = [f"  (void){argument};" for argument in arguments if not any(f"{argument}[" in s for s in lines + results)]
    body = "\n".join([*unused, *lines, *results])
    return f"{_write_head(each, name)} {{\n{body}\n}}\n"


class RunPlan(NamedTuple):
    """A graph as runs of one operation each: what is done, and how often in a row.

    Row i of `places` holds the register that is written and those that are read; the first `n` registers hold the
    arguments. An "output" writes the result, a "constant" reads the array `constants`.
    """

    runs: list[tuple[str, int]]
    places: Int[np.ndarray, "steps 3"]
    registers: int


def plan_runs(graph: Graph) -> RunPlan:
    """Return the steps of a graph in long runs of one operation, in few registers.

    Of the operations whose operands are known the most frequent one is next, as long as there are any, those included
    that become known meanwhile. So the terms of a long sum are one run, and are added in the graph's order.
    """
    producer: dict[int, int] = {}  # of each register of the graph
    values: list[tuple[str, int, tuple[int, ...]]] = []  # operation, place of the constant or result, operands
    for step, (target, first, second) in zip(graph.steps, graph.places.tolist(), strict=True):
        if step == "output":
            values.append((step, target, (producer[first],)))
            continue
        if step in ("input", "constant"):
            operands = ()
        else:
            operands = tuple(producer[place] for place in (first, second)[: OPERATIONS[step].operands])
        producer[target] = len(values)
        values.append((step, first, operands))
    readers: dict[int, list[int]] = defaultdict(list)
    missing = [len(set(operands)) for _, _, operands in values]
    for i, (_, _, operands) in enumerate(values):
        for operand in set(operands):
            readers[operand].append(i)
    ready: dict[str, list[int]] = defaultdict(list)
    for i, count in enumerate(missing):
        if not count:
            heappush(ready[values[i][0]], i)
    order: list[int] = []
    runs: list[tuple[str, int]] = []
    while ready:
        word = max(ready, key=lambda name: (name == "input", name == "constant", name == "output", len(ready[name])))
        begin, queue = len(order), ready[word]
        while queue:
            i = heappop(queue)
            order.append(i)
            for reader in readers.get(i, ()):
                missing[reader] -= 1
                if not missing[reader]:
                    heappush(ready[values[reader][0]], reader)
        del ready[word]
        if word != "input":
            runs.append((word, len(order) - begin))
    return RunPlan(runs, *_assign_registers(graph.n, values, order, readers))


def _assign_registers(
    inputs: int, values: list[tuple[str, int, tuple[int, ...]]], order: list[int], readers: Mapping[int, list[int]]
) -> tuple[Int[np.ndarray, "steps 3"], int]:
    """Return the places of the steps in this order, and the number of registers; one is free after its last reader."""
    when = {i: k for k, i in enumerate(order)}
    last = {i: max(map(when.__getitem__, others)) for i, others in readers.items()}
    register: dict[int, int] = {}
    free: list[int] = []
    count = inputs
    rows: list[tuple[int, int, int]] = []
    for k, i in enumerate(order):
        word, place, operands = values[i]
        if word == "input":
            register[i] = place
            continue
        read = [register[operand] for operand in operands]
        for operand in set(operands):
            if values[operand][0] != "input" and last[operand] == k:
                heappush(free, register[operand])
        if word == "output":
            rows.append((place, read[0], 0))
            continue
        if free:
            register[i] = heappop(free)
        else:
            register[i], count = count, count + 1
        if i not in last:
            heappush(free, register[i])
        first, second = (place, 0) if word == "constant" else (read[0], read[-1])
        rows.append((register[i], first, second))
    return np.array(rows, dtype=np.int64).reshape(len(rows), 3), count


def _write_loop(words: list[str], kind: np.dtype[Any]) -> str:
    """Return the C loop that runs tables of these operations."""
    special = {"output": "result[p[0]] = v[p[1]]", "constant": "v[p[0]] = constants[p[1]]"}
    cases = [
        f"      case {_number_operation(word)}:\n"
        f"        for (; p < end; p += 3) {special.get(word) or assign(word)};\n        break;\n"
        for word in words
    ]
    arguments = "const koopmpc_index *runs, int count, const koopmpc_index *p, const koopmpc_real *constants"
    return (
        f"typedef {_INTEGERS[kind]} koopmpc_index;\n\n"
        "/* Runs a table: of each run the operation and its number, of each step the places written and read. */\n"
        f"static void koopmpc_run_table({arguments}, koopmpc_real *v,\n                              "
        "koopmpc_real *result) {\n  (void)constants;\n  for (int i = 0; i < count; i++) {\n"
        "    const koopmpc_index *const end = p + 3 * (long)runs[2 * i + 1];\n    switch (runs[2 * i]) {\n"
        + "".join(cases)
        + "    }\n  }\n}\n"
    )


def assign(word: str) -> str:
    """Return the C statement of one step of a table."""
    return f"v[p[0]] = {EXPRESSIONS[word].format('v[p[1]]', 'v[p[2]]')}"


def _number_operation(word: str) -> int:
    return [*EXPRESSIONS, "output", "constant"].index(word)


def _write_table(plan: RunPlan, kind: np.dtype[Any], each: CFunction, name: str, language: Language) -> str:
    """Return a function as tables, under the signature that it would have line by line."""
    runs = np.array([(_number_operation(word), count) for word, count in plan.runs])
    parts = {"runs": runs, "places": plan.places}
    tables = [language.array(f"{name}_{what}", values.astype(kind)) for what, values in parts.items()]
    tables.append(language.array(f"{name}_constants", each.graph.constants))
    copies, offset = list[str](), 0
    for argument, size in each.arguments.items():
        copies.append(f"  for (int i = 0; i < {size}; i++) registers[{offset} + i] = {argument}[i];")
        offset += size
    lines = "\n".join(
        [*tables, f"{_write_head(each, name)} {{", f"  koopmpc_real registers[{plan.registers}];", *copies]
    )
    call = f"koopmpc_run_table({name}_runs, {len(runs)}, {name}_places, {name}_constants, registers, {each.result});"
    return f"{lines}\n  {call}\n}}\n"
