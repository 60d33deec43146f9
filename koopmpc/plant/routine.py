"""A CasADi function on arrays of our own: machine code where a compiler is found, else CasADi's interpreter."""

import ctypes
import subprocess
from collections.abc import Callable, Sequence
from typing import Any, cast

import casadi as ca
import numpy as np

from koopmpc.plant import compiled

_CALL = """
#ifdef _WIN32
__declspec(dllexport)
#endif
int koopmpc_call(const double** arg, double** res, casadi_int* iw, double* w) {
  return %s(arg, res, iw, w, 0);
}
"""


class Routine:
    """`function` that reads `arguments` and writes `results`, float64 arrays that hold matrices column by column.

    Both routes give the same numbers. What the interpreter alone can do (implicit integrators), it does.
    """

    def __init__(
        self, function: ca.Function, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> None:
        sizes = [function.nnz_in(i) for i in range(function.n_in())]
        sizes += [function.nnz_out(i) for i in range(function.n_out())]
        for size, array in zip(sizes, [*arguments, *results], strict=True):
            assert array.dtype == np.float64, "machine code reads float64"
            assert array.flags.c_contiguous, "machine code reads contiguous arrays"
            assert array.size == size, f"an array has {array.size} entries, the function {size}"
        self._kept: list[Any] = [*arguments, *results]  # neither route holds the arrays that it points to
        call = _machine(function, arguments, results, self._kept)
        self.compiled = call is not None
        self.call: Callable[[], object] = call or _interpreter(function, arguments, results, self._kept)


def _machine(
    function: ca.Function, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], kept: list[Any]
) -> Callable[[], object] | None:
    command = compiled.compiler()
    if command is None:
        return None
    try:
        generator = ca.CodeGenerator("koopmpc", {"with_header": False})
        generator.add(function)
        text = "#define CASADI_SYMBOL_EXPORT static\n" + generator.dump() + _CALL % function.name()
        code = compiled.library(text, command, compiled.private_cache())
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return None
    call = code.koopmpc_call
    arg = (ctypes.c_void_p * (function.sz_arg() + 1))(*(a.ctypes.data for a in arguments))
    res = (ctypes.c_void_p * (function.sz_res() + 1))(*(r.ctypes.data for r in results))
    w = np.zeros(function.sz_w() + 1)
    iw = np.zeros(function.sz_iw() + 1, dtype=np.int64)
    kept += [code, arg, res, iw, w]
    pointers = [ctypes.c_void_p(ctypes.addressof(each)) for each in (arg, res)]
    pointers += [ctypes.c_void_p(each.ctypes.data) for each in (iw, w)]
    return lambda: call(*pointers)


def _interpreter(
    function: ca.Function, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], kept: list[Any]
) -> Callable[[], object]:
    buffer, evaluate = cast("tuple[Any, Callable[[], None]]", function.buffer())
    for i, array in enumerate(arguments):
        if array.size:
            buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        if array.size:
            buffer.set_res(i, array.data)
    kept.append(buffer)
    return evaluate
