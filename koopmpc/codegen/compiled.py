"""A controller in machine code: the C of `export`, built with the compiler at hand, behind the Controller protocol."""

import ctypes
import platform
import subprocess
import warnings
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import numbers
from koopmpc.codegen.sources import Language, one_source, plant_functions, tables_of
from koopmpc.codegen.staged import TargetTable
from koopmpc.codegen.tables import Exportable, Precision, exportable
from koopmpc.control.linear.plan import planned_states
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller, Fallback, Move, Plan, Status, WholeRun, alone, busy
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.errors import DataError, ShapeError
from koopmpc.plants.routines import compiler, library, private_cache
from koopmpc.plants.step_map import StepMap

_STATUS, _FALLBACK = list(Status), list(Fallback)
_PLANTS = 8  # plants whose machine code a controller keeps
# What stands above a plant in C.
_PLANT_HEAD = "#include <math.h>\ntypedef double koopmpc_real;\n#define KOOPMPC_FN(name) name\n"


class NoCompilerWarning(UserWarning):
    """No C compiler was found, or it failed: the controller stays as it was, in Python."""


def compiled(controller: Controller, *, precision: Precision = "double") -> Controller:
    """Return the same controller in machine code: the C of `km.export`, several times as fast a step.

    It takes and returns what the original does, from the state after `reset`. Copies and pickles are controllers of
    their own; a pickle is built again where it is loaded. Where there is no C compiler, or it fails, a warning says so
    and the controller itself is returned. The original is left alone.

    Parameters
    ----------
    controller
        An LQR, a KoopmanMPC, a LinearMPC or a BilinearMPC.
    precision
        "double", or "float": the numbers of a microcontroller, to look at what they cost.

    Raises
    ------
    DataError
        A part of the controller cannot be written in C; the message says which, and what would do.
    """
    if not checks.among(precision, ("double", "float")):
        raise DataError(f'precision is {precision!r}; pass "double" or "float"')
    if isinstance(controller, Compiled):
        return controller
    original, command = exportable(controller), compiler()
    if command is None:
        warnings.warn(
            "no C compiler was found ($CC, cc, gcc, clang); the controller stays in Python", NoCompilerWarning, 2
        )
        return controller
    try:
        return Compiled(original, precision, command)
    except (OSError, subprocess.SubprocessError) as error:
        warnings.warn(
            f"the C compiler failed, the controller stays in Python: {_first_error(error)}", NoCompilerWarning, 2
        )
        return controller


def _first_error(error: Exception) -> str:
    """Return the first error that a compiler printed, or what the system says."""
    printed = getattr(error, "stderr", None) or b""
    text = printed.decode(errors="replace") if isinstance(printed, bytes) else str(printed)
    lines = [line for line in text.splitlines() if "error" in line.lower()]
    return lines[0] if lines else str(error)


def _processor() -> str:
    """Return what tells this processor from others whose machine code it may not run."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("flags")), platform.processor())


def _built(controller: Exportable, precision: Precision, command: list[str]) -> tuple[ctypes.CDLL, dict[str, int]]:
    """Return the machine code of a controller, for this very processor where the compiler takes its flags, and sizes.

    Raises
    ------
    OSError, subprocess.SubprocessError
        The compiler fails or its output does not load.
    """
    single = precision == "float"
    tables = tables_of(controller, single=single)
    text = one_source(tables, single=single) + f"/* {_processor()} */\n"
    cache = private_cache()
    machine = ["-march=native", "-fvisibility=default"] if platform.machine() in ("x86_64", "AMD64") else []
    try:
        code = library(text, [*command, *machine], cache)
    except subprocess.SubprocessError:
        code = library(text, command, cache)  # it may not know this processor
    code.koopmpc_state_size.restype = ctypes.c_long
    code.koopmpc_init.restype = code.koopmpc_call.restype = None
    return code, tables.sizes


class ManyRuns(NamedTuple):
    """Closed loops side by side: X (E, T+1, nx), U (E, T, nu), and of every step Status, Fallback and slack."""

    X: Float[np.ndarray, "E T1 nx"]
    U: Float[np.ndarray, "E T nu"]
    status: Int[np.ndarray, "E T"]
    fallback: Int[np.ndarray, "E T"]
    slack: Float[np.ndarray, "E T"]


def _at(array: np.ndarray | None) -> ctypes.c_void_p | None:
    """Return the address of an array's first number, for C; None, C's null pointer, for None."""
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


# One call with one pointer: that is what ctypes does fastest. The structures are those of c/door.c.
class _Rows(ctypes.Structure):
    """Rows of a preview: their address, and how many count."""

    _fields_ = (("values", ctypes.c_void_p), ("count", ctypes.c_int))


_FIELDS = (
    ("state", ctypes.c_void_p),
    ("y", ctypes.c_void_p),
    ("reference", _Rows),
    ("applied", ctypes.c_void_p),
    ("w", _Rows),
    ("u", ctypes.c_void_p),
    ("status", ctypes.c_int),
    ("fallback", ctypes.c_int),
    ("iterations", ctypes.c_int),
)


class _Frame(ctypes.Structure):
    """What a call passes; the same fields as in C."""

    _fields_ = (*_FIELDS, ("slack", ctypes.c_double))


class _SingleFrame(ctypes.Structure):
    """A `_Frame` in single precision."""

    _fields_ = (*_FIELDS, ("slack", ctypes.c_float))


class _Whole(ctypes.Structure):
    """What a whole run passes; the same fields as in C."""

    _fields_ = (
        ("steps", ctypes.c_long),
        *((name, ctypes.c_int) for name in ("nx", "ny", "preview", "measured")),
        *((name, ctypes.c_void_p) for name in ("step", "measure", "rows", "W", "X", "Y", "U")),
        *((name, ctypes.c_void_p) for name in ("slack", "times", "reports")),
    )


class Compiled:
    """A controller in machine code; see `compiled`.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.
    """

    def __init__(self, controller: Exportable, precision: Precision, command: list[str]) -> None:
        self.original, self.precision = controller, precision
        self._code, self._sizes = _built(controller, precision, command)
        sizes = self._sizes
        self.dt, self.nu, self.horizon = controller.dt, sizes["NU"], sizes["HORIZON"]
        self.cost, self.limits = controller.cost, controller.limits
        self._targets = TargetTable(controller) if isinstance(controller, BilinearMPC) else None
        self._states: Float[np.ndarray, "N1nx nvk"] | None = None  # of a linear plan, from its inputs and its start
        self._ny, self._nr, self._nw = sizes["NY"], sizes["NR"], sizes["NW"]
        self._memory = np.zeros(-(-int(self._code.koopmpc_state_size()) // 8))
        self._plants: dict[int, tuple[StepMap, ctypes.CDLL]] = {}
        self._connect()
        self.reset()

    def _connect(self) -> None:
        """Make the arrays and the frame that a call passes."""
        self._token, self._inside = [0], 0
        single = self.precision == "float"
        kind, sizes = np.float32 if single else np.float64, self._sizes
        rows = sizes["HORIZON"] + 1
        self._y, self._u, self._applied = (np.zeros(n, kind) for n in (self._ny, self.nu, self.nu))
        self._reference = np.zeros((rows, self._nr), kind)
        self._w = np.zeros((rows, max(1, self._nw)), kind)
        frame = self._frame = _SingleFrame() if single else _Frame()
        frame.state, frame.y, frame.u = (a.ctypes.data for a in (self._memory, self._y, self._u))
        frame.reference = _Rows(self._reference.ctypes.data, 1)
        frame.w = _Rows(self._w.ctypes.data, 0)
        self._applied_address = self._applied.ctypes.data
        self._pointer = ctypes.c_void_p(ctypes.addressof(frame))
        self._call = self._code.koopmpc_call
        self._y_shape, self._row_shape, self._row = (self._ny,), (self._nr,), self._reference[0]
        self._count, self._told, self._is_double = 1, False, not single
        self._solver = "" if self._targets is not None else "daqp"
        if self._targets is not None:
            self._aim(np.zeros((0, self._nr)))

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps; see the original."""
        kind = self._y.dtype
        start, last = (
            None if value is None else np.ascontiguousarray(checks.array(value, name, (size,)), kind)
            for value, name, size in ((x0, "x0", self._sizes["NX"]), (u_prev, "u_prev", self.nu))
        )
        self._code.koopmpc_init(_at(self._memory), _at(start), _at(last))
        self._aim(np.zeros((0, self._nr)))

    def _aim(self, rows: Float[np.ndarray, "..."]) -> None:
        """Give the C the targets of these rows; only that of a BilinearMPC asks for them."""
        if self._targets is not None:
            self._aimed = rows.tobytes()
            self._table = self._targets.of(rows).astype(self._y.dtype)
            self._code.koopmpc_use_targets(_at(self._memory), _at(self._table), len(self._table))

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return the next input for measurement y; the arguments are those of the original."""
        try:
            held = self._token.pop()
        except IndexError:
            raise busy(self) from None
        except BaseException:  # a Ctrl-C that came right behind the pop
            self._token.append(0)
            raise
        try:
            start = perf_counter()
            frame = self._frame
            measured = numbers(y, "y")
            if measured.shape != self._y_shape:
                raise ShapeError(f"y has shape {measured.shape}, expected {self._y_shape}")
            self._y[:] = measured
            target = numbers(reference, "reference")
            if target.shape == self._row_shape:
                self._row[:] = target
                count = 1
            else:
                count = self._rows(target, self._reference, self._nr, "reference")
            if count != self._count:  # a field that is written takes as long as the C step
                frame.reference.count = self._count = count
            if self._targets is not None and target.tobytes() != self._aimed:
                self._aim(target)
            if applied is not None or w is not None or self._told:
                self._tell(applied, w)
            self._call(self._pointer)
            u = self._u.copy() if self._is_double else self._u.astype(np.float64)
            if not frame.status:
                return Move(u, Status.UNCONSTRAINED, Fallback.NONE, perf_counter() - start, 0)
            return Move(
                u,
                _STATUS[int(frame.status)],
                _FALLBACK[int(frame.fallback)],
                perf_counter() - start,
                frame.iterations,
                frame.slack,
                self._solver if frame.iterations else "",
            )
        finally:
            self._token.append(held)

    def rehearse(self) -> None:
        """Run the last step once more and forget it, so that the next one finds its code and tables in the caches.

        After some milliseconds of sleep any call from Python takes ten times as long and more. A loop that wakes a
        little early calls this first, and then waits for the measurement. No answer and no plan changes by it.
        """
        if self._targets is None or self._aimed:
            kept = self._memory.copy()
            self(self._y, self._reference[: self._count])
            self._memory[:] = kept

    def _tell(self, applied: ArrayLike | None, w: ArrayLike | None) -> None:
        """Write down what acted and what disturbs, or that nothing is told."""
        frame = self._frame
        frame.applied, frame.w.count, self._told = None, 0, False
        if applied is not None:
            got = numbers(applied, "applied")
            if got.shape != self._u.shape:
                raise ShapeError(f"applied has shape {got.shape}, expected {self._u.shape}")
            self._applied[:] = got
            frame.applied, self._told = self._applied_address, True
        if w is not None:
            pushes = numbers(w, "w")
            if not self._nw:
                raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
            frame.w.count, self._told = self._rows(pushes, self._w, self._nw, "w"), True

    def _rows(self, rows: Float[np.ndarray, "..."], to: Float[np.ndarray, "..."], width: int, name: str) -> int:
        """Copy a preview; return how many of its rows count."""
        if rows.ndim > 2 or rows.shape[-1:] != (width,) or len(rows) == 0:
            raise ShapeError(
                f"{name} has shape {rows.shape}, expected ({width},), or rows of {width} for steps k … k+{len(to) - 1}"
            )
        table = rows.reshape(-1, width)[: len(to)]
        to[: len(table)] = table
        return len(table)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        original, sizes, memory = self.original, self._sizes, _at(self._memory)
        if isinstance(original, LQR):
            return None
        U = np.zeros((sizes["N"], self.nu), self._y.dtype)
        if not self._code.koopmpc_plan(memory, _at(U)):
            return None
        if isinstance(original, BilinearMPC):
            X = np.zeros((sizes["N"] + 1, sizes["NX"]), self._y.dtype)
            self._code.koopmpc_plan_states(memory, _at(X))
            return Plan(X.astype(np.float64), U.astype(np.float64))
        if self._states is None:
            rates, disturbed = bool(sizes["WITH_RATES"]), bool(sizes["ESTIMATOR"])
            steps = np.arange(sizes["N"])
            self._states = planned_states(original.predictor, steps, with_rates=rates, disturbed=disturbed)
        known = self._memory.view(self._y.dtype)[: sizes["KNOWN"]]
        X = self._states @ np.concatenate([U.ravel(), known, [1.0]], dtype=np.float64)
        return Plan(X.reshape(sizes["N"] + 1, -1), U.astype(np.float64))

    @alone
    def whole_run(
        self,
        plant: StepMap,
        rows: Float[np.ndarray, "rows nr"],
        W: Float[np.ndarray, "wrows nw"] | None,
        X: Float[np.ndarray, "T1 nx"],
        Y: Float[np.ndarray, "T1 ny"],
        U: Float[np.ndarray, "T nu"],
        *,
        preview: bool,
    ) -> WholeRun | None:
        """Write a whole run from X[0] and Y[0] into X, Y and U; None where the plant cannot be written in C.

        `simulate` asks for it where nothing between two steps needs Python.
        """
        misfit = rows.shape[1] != self._nr or Y.shape[1] != self._ny or (W is not None and W.shape[1] != self._nw)
        code = None if misfit else self._machine_of(plant)
        if code is None:
            return None
        self._aim(rows)
        rows, W = np.ascontiguousarray(rows), None if W is None else np.ascontiguousarray(W)
        slack, times, reports = np.zeros(len(U)), np.zeros(len(U)), np.zeros((len(U), 3), dtype=np.intc)
        arrays = {"rows": rows, "X": X, "Y": Y, "U": U, "slack": slack, "times": times, "reports": reports}
        whole = _whole_call(code, len(U), arrays, W, preview=preview)
        self._code.koopmpc_run(self._pointer, ctypes.c_void_p(ctypes.addressof(whole)))
        return WholeRun(reports[:, 0], reports[:, 1], reports[:, 2], slack, times)

    @alone
    def runs(self, plant: StepMap, x0: ArrayLike, reference: ArrayLike, *, steps: int) -> ManyRuns:
        """Run the closed loop from many states in C, each time from the beginning; nothing of a run is judged or kept.

        Parameters
        ----------
        plant
            x⁺ = F(x, u), y = h(x).
        x0
            (E, nx), a row a run.
        reference
            (nr,) held, or (steps+1, nr), the same for all runs; the controller gets the rows ahead.

        Raises
        ------
        DataError
            The plant cannot be written in C, or the controller is in single precision.
        ShapeError
            Sizes do not fit.
        """
        T = checks.count(steps, "steps")
        starts = checks.array(x0, "x0", (None, len(plant.states)))
        given = np.atleast_2d(checks.array(reference, "reference"))
        if given.shape[1] != self._nr or len(given) not in (1, T + 1):
            raise ShapeError(f"reference has shape {given.shape}, expected ({self._nr},) or ({T + 1}, {self._nr})")
        if (len(plant.outputs), len(plant.inputs)) != (self._ny, self.nu):
            raise ShapeError(
                f"the plant measures {len(plant.outputs)} values and takes {len(plant.inputs)} inputs, the controller "
                f"takes {self._ny} and returns {self.nu}"
            )
        code = self._machine_of(plant)
        if code is None:
            raise DataError("the plant, or a controller of floats, cannot run in C as a whole; use km.simulate")
        rows = np.ascontiguousarray(given[np.minimum(np.arange(T + self.horizon + 1), len(given) - 1)])
        self._aim(given)
        E = len(starts)
        X, U = np.empty((E, T + 1, starts.shape[1])), np.empty((E, T, self.nu))
        X[:, 0] = starts
        slack, reports = np.zeros((E, T)), np.zeros((E, T, 3), dtype=np.intc)
        arrays = {"rows": rows, "X": X, "Y": np.empty((T + 1, self._ny)), "U": U, "slack": slack, "reports": reports}
        whole = _whole_call(code, T, arrays, None, preview=True)
        self._code.koopmpc_runs(self._pointer, ctypes.c_void_p(ctypes.addressof(whole)), ctypes.c_long(E))
        return ManyRuns(X, U, reports[..., 0], reports[..., 1], slack)

    def _machine_of(self, plant: StepMap) -> ctypes.CDLL | None:
        """Return the plant in machine code, built when it is first driven; None where it cannot run with this one."""
        known = self._plants.get(id(plant))
        if known is not None:
            return known[1]
        command = compiler() if self.precision != "float" else None
        if command is None:
            return None
        try:
            code = library(_PLANT_HEAD + plant_functions(plant.F, plant.h, Language()), command, private_cache())
        except (DataError, OSError, subprocess.SubprocessError):
            return None
        while len(self._plants) >= _PLANTS:
            self._plants.pop(next(iter(self._plants)))
        self._plants[id(plant)] = plant, code
        return code

    def __copy__(self) -> "Compiled":
        """Return a copy that shares nothing with this one that moves in a step."""
        twin = object.__new__(Compiled)
        twin.__dict__.update(self.__dict__)
        twin._memory = self._memory.copy()
        twin._connect()
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> "Compiled":
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.original, self.precision, self._memory)


def _whole_call(
    code: ctypes.CDLL,
    steps: int,
    arrays: dict[str, np.ndarray],
    W: Float[np.ndarray, "wrows nw"] | None,
    *,
    preview: bool,
) -> _Whole:
    """Return what a whole run passes; it holds no reference to the arrays."""
    whole = _Whole(steps, arrays["X"].shape[-1], arrays["Y"].shape[-1], preview, W is not None)
    for name, routine in (("step", code.plant_step), ("measure", code.plant_measure)):
        setattr(whole, name, ctypes.cast(routine, ctypes.c_void_p))
    for name, array in ({"W": W} | arrays if W is not None else arrays).items():
        assert array.flags.c_contiguous, "machine code reads contiguous arrays"
        setattr(whole, name, array.ctypes.data)
    return whole


def _rebuilt(controller: Exportable, precision: Precision, memory: Float[np.ndarray, " n"]) -> Controller:
    """Return the controller of a pickle, built here; it goes on where the pickled one was."""
    result = compiled(controller, precision=precision)
    if isinstance(result, Compiled) and result._memory.shape == memory.shape:
        result._memory[:] = memory
        result._aim(np.zeros((0, result._nr)))  # the table is where it is now
    return result
