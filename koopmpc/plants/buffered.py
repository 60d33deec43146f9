"""A CasADi function of vectors behind numpy arrays, at half a microsecond a call."""

import threading
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np


class Slot(NamedTuple):
    """The memory of one thread: fill `arguments`, call `evaluate`, read `results` before the next call."""

    arguments: tuple[np.ndarray, ...]
    results: tuple[np.ndarray, ...]
    evaluate: Callable[[], None]
    buffer: Any  # CasADi keeps no reference to the arrays, nor `evaluate` to its buffer


class Buffered:
    """`function` of float64 vectors; matrices come out flat, column after column.

    CasADi's FunctionBuffer writes into arrays that we own, one set a thread; a call returns fresh copies.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._local = threading.local()

    def __call__(self, *arguments: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return fresh results; `arguments` have the shapes of the function's inputs, (n,) each."""
        slot = self.slot()
        for place, value in zip(slot.arguments, arguments, strict=True):
            place[:] = value
        slot.evaluate()
        return tuple(result.copy() for result in slot.results)

    def slot(self) -> Slot:
        """Return this thread's memory."""
        try:
            return self._local.slot
        except AttributeError:
            self._local.slot = slot = _allocate(self.function)
            return slot

    def __reduce__(self) -> tuple[type["Buffered"], tuple[ca.Function]]:
        return Buffered, (self.function,)


def _allocate(function: ca.Function) -> Slot:
    buffer, evaluate = cast("tuple[Any, Callable[[], None]]", function.buffer())
    arguments = tuple(np.zeros(function.size1_in(i)) for i in range(function.n_in()))
    results = tuple(np.zeros(function.nnz_out(i)) for i in range(function.n_out()))
    for i, place in enumerate(arguments):
        if place.size:
            buffer.set_arg(i, place.data)
    for i, place in enumerate(results):
        if place.size:
            buffer.set_res(i, place.data)
    return Slot(arguments, results, evaluate, buffer)


def dense(function: ca.Function) -> ca.Function:
    """Return `function` with dense inputs and outputs; a buffer of a sparse one holds nonzeros alone."""
    sparsities = [function.sparsity_in(i) for i in range(function.n_in())]
    sparsities += [function.sparsity_out(i) for i in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in sparsities):
        return function
    arguments = [ca.MX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(result) for result in function.call(arguments)]
    result = ca.Function(function.name(), arguments, results, function.name_in(), function.name_out())
    return result.expand() if function.is_a("SXFunction") else result
