"""A controller in machine code: the C of `export`, built with the compiler at hand, behind the Controller protocol."""

import ctypes
import subprocess
import warnings
from time import perf_counter
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import numbers
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.codegen.door import BoundPage, Frame, Rows, SingleFrame, point_to
from koopmpc.codegen.programs import make_tables, read_program
from koopmpc.codegen.runs import FALLBACKS, STATUSES, CompiledLoops, TargetTable
from koopmpc.codegen.sources import write_one_source
from koopmpc.codegen.tables import Precision
from koopmpc.control.ask.levels import HeldLevels
from koopmpc.control.ask.limits import Limits
from koopmpc.control.move import Controller, Fallback, Move, Plan, Status, alone, busy
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.plan.condensed_program import CondensedProgram, planned_states
from koopmpc.control.program import StepProgram
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.routines import find_compiler, find_private_cache, load_library
from koopmpc.plants.step_map import StepMap

_ROOM = 2**20  # numbers of a table of given input targets: 8 MB
_PAGE = 1024  # steps whose limits are made at once, which takes one of them 0.1 ms
_OWN_LIMITS = (
    "limits were passed, and this C code keeps its own; compile one whose limits have rows in time,"
    ' or Limits(rows=("u_max",))'
)


class NoCompilerWarning(UserWarning):
    """No C compiler was found, or it failed: the controller stays as it was, in Python."""


def compiled(controller: Controller, *, precision: Precision = "double") -> Controller:
    """Return the same controller in machine code: the C of `km.export`, several times as fast a step.

    It has the arguments and the moves of the original, and starts as after `reset`. A copy or a pickle is a controller
    of its own; a pickle is compiled again where it is loaded. Without a C compiler, or if that fails, koopmpc warns and
    returns the controller itself. The original does not change.

    Parameters
    ----------
    controller
        An LQR, a KoopmanMPC, a LinearMPC or a BilinearMPC.
    precision
        "double"; or "float", to see what the single precision of a microcontroller costs.

    Raises
    ------
    DataError
        No C code can be generated; the message says why, and what to do.
    """
    if not checks.among(precision, ("double", "float")):
        raise DataError(f'precision is {precision!r}; pass "double" or "float"')
    if isinstance(controller, Compiled):
        return controller
    program, command = read_program(controller, ()), find_compiler()
    if command is None:
        warnings.warn(
            "no C compiler was found ($CC, cc, gcc, clang); the controller stays in Python", NoCompilerWarning, 2
        )
        return controller
    try:
        return Compiled(controller, program, precision, command)
    except (OSError, subprocess.SubprocessError) as error:
        warnings.warn(
            f"the C compiler failed, the controller stays in Python: {_find_error(error)}", NoCompilerWarning, 2
        )
        return controller


def _find_error(error: Exception) -> str:
    """Return the first error that a compiler printed, else the text of the exception."""
    printed = getattr(error, "stderr", None) or b""
    text = printed.decode(errors="replace") if isinstance(printed, bytes) else str(printed)
    lines = [line for line in text.splitlines() if "error" in line.lower()]
    return lines[0] if lines else str(error)


class Compiled(CompiledLoops):
    """A controller in machine code; see `compiled`.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.
    """

    def __init__(self, controller: Controller, program: StepProgram, precision: Precision, command: list[str]) -> None:
        self.original, self.precision = controller, precision
        tables = make_tables(program, single=precision == "float", room=_ROOM)
        text = write_one_source(tables, single=precision == "float")
        self._code, sizes = load_library(text, command, find_private_cache(), native=True), tables.sizes
        self._code.koopmpc_state_size.restype, self._sizes = ctypes.c_long, sizes
        self._code.koopmpc_init.restype = self._code.koopmpc_call.restype = None
        self.dt, self.nu, self.horizon = program.dt, sizes["NU"], sizes["HORIZON"]
        self.cost, self.limits = getattr(controller, "cost", None), getattr(controller, "limits", None)
        self.model = program.model
        self._bounds = program.bounds if isinstance(program, CondensedProgram | StagedProgram) else None
        self._timed = self._bounds is not None and self.limits is not None and self.limits.in_time
        self._step, self._at_call = 0, None
        find = getattr(controller, "find_targets", None) if isinstance(program, StagedProgram) else None
        self._targets = None if find is None else TargetTable(find, np.float32 if precision == "float" else np.float64)
        self._states: Float[np.ndarray, "N1nx nvk"] | None = None  # takes a linear plan and its start to the states
        self._ny, self._nr, self._nw = sizes["NY"], sizes["NR"], sizes["NW"]
        self._memory = np.zeros(-(-int(self._code.koopmpc_state_size()) // 8))
        self._plant: tuple[StepMap, ctypes.CDLL] | None = None
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
        frame = self._frame = SingleFrame() if single else Frame()
        frame.state, frame.y, frame.u = (a.ctypes.data for a in (self._memory, self._y, self._u))
        frame.reference = Rows(self._reference.ctypes.data, 1)
        frame.w = Rows(self._w.ctypes.data, 0)
        self._applied_address = self._applied.ctypes.data
        self._pointer = ctypes.c_void_p(ctypes.addressof(frame))
        self._reference_pointer = ctypes.byref(frame.reference)
        self._call = self._code.koopmpc_call
        self._pages: dict[bool, BoundPage] = {}  # the controller's own limits, and those of a call
        self._in_c: BoundPage | None = None  # what C was passed last
        self._y_shape, self._row_shape, self._row = (self._ny,), (self._nr,), self._reference[0]
        self._rows_shape = self._reference.shape
        self._count, self._has_extras, self._is_double = 1, False, not single
        self._solver = "" if self._targets is not None else "sequences" if sizes.get("LEVELS") else "daqp"
        if self._targets is not None:
            self._aim(np.zeros((0, self._nr)))

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps; see the original."""
        kind, self._step, self._at_call = self._y.dtype, 0, None
        if u_prev is None and self._timed and self.limits is not None:
            box = self.limits.input_rows(self.nu, self._sizes["LATENCY"], 1)
            zero, levels = np.clip(np.zeros(self.nu), box.low[0], box.high[0]), self.limits.base.input_levels(self.nu)
            u_prev = zero if levels is None else HeldLevels(levels).round(zero)
        start, last = (
            None if value is None else np.ascontiguousarray(checks.array(value, name, (size,)), kind)
            for value, name, size in ((x0, "x0", self._sizes["NX"]), (u_prev, "u_prev", self.nu))
        )
        self._code.koopmpc_init(point_to(self._memory), point_to(start), point_to(last))
        self._in_c = None
        self._aim(np.zeros((0, self._nr)))

    def _aim(self, rows: Float[np.ndarray, "..."]) -> None:
        """Pass the targets of these rows to the C code of a BilinearMPC; other kinds have none.

        Without rows they are passed in any case: a start, or another memory, holds none.
        """
        if self._targets is not None:
            self._last_rows = rows.tobytes()
            table = self._targets.of(rows)
            if len(rows) and table is self._table:
                return
            self._table = table  # which C reads
            self._code.koopmpc_use_targets(point_to(self._memory), point_to(self._table), len(self._table))

    def _aim_next(self, rows: Float[np.ndarray, "..."]) -> None:
        """Let C find the targets of the rows in the frame, or Python, where C has none to start at.

        C starts at the nearest row that it knows. Python searches where that leads to no equilibrium, or to limits.
        """
        if len(self._table):
            self._last_rows = rows.tobytes()
            if not self._code.koopmpc_find_targets(point_to(self._memory), self._reference_pointer):
                return
        self._aim(rows)

    def _fill_bounds(self, limits: Limits, first: int, steps: int) -> BoundPage:
        """Return the limits that C is passed in so many steps, from step `first` on."""
        bounds, kind, ahead = self._bounds, self._y.dtype, self._sizes["HORIZON"] + 1
        assert bounds is not None, "only called where limits may move"
        count, nx = steps - 1 + ahead, self.model.nx
        outputs = limits.output_rows(nx, len(bounds.outputs) - nx, first, count)
        boxes = limits.input_rows(self.nu, first, count), limits.rate_rows(self.nu, first, count)
        ends = [*(end for box in boxes for end in box), *(end[:, bounds.outputs] for end in outputs)]
        arrays = [np.ascontiguousarray(np.clip(end, -checks.HUGE, checks.HUGE), kind) for end in ends]
        return BoundPage(first, arrays, ahead, steps)

    def _choose_limits(self, limits: Limits | None) -> None:
        """Pass the limits of this step, where C has others, and count it: of the call, or the controller's own."""
        now, timed = (self.limits, self._timed) if limits is None else (limits, False)
        if now is None:
            return
        if limits is not None and limits is not self._at_call:
            original = cast("Any", self.original)
            read = original.read_limits(limits)
            original.check_limits(read)
            self._called_with = read
        self._at_call, step = limits, self._step if timed else 0
        page = self._pages.get(limits is None)
        if page is None or page.of is not now or not 0 <= step - page.first < page.steps:
            read = now if limits is None else self._called_with
            page = self._pages[limits is None] = self._fill_bounds(read, step, _PAGE if timed else 1)
            page.of = now
        self._frame.bounds = page.at(step) if timed or page is not self._in_c else None
        self._in_c = page
        self._step += 1

    def _read_reference(self, reference: ArrayLike) -> None:
        """Write the rows of a reference into the frame, and find the targets of new ones."""
        target = numbers(reference, "reference")
        if target.shape == self._row_shape:
            self._row[:] = target
            count = 1
        elif target.shape == self._rows_shape:  # not by a method, for it costs a tenth of the step
            self._reference[:] = target
            count = len(target)
        else:
            count = self._copy_rows(target, self._reference, self._nr, "reference")
        if count != self._count:  # writing a field takes as long as the C step
            self._frame.reference.count = self._count = count
        if self._targets is not None and target.tobytes() != self._last_rows:
            self._aim_next(target)

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        limits: Limits | None = None,
    ) -> Move:
        """Return the next input for measurement y; the arguments are those of the original."""
        try:
            held = self._token.pop()
        except IndexError:
            raise busy(self) from None
        except BaseException:  # a Ctrl-C that came right after the pop
            self._token.append(0)
            raise
        try:
            start = perf_counter()
            frame = self._frame
            measured = numbers(y, "y")
            if measured.shape != self._y_shape:
                raise ShapeError(f"y has shape {measured.shape}, expected {self._y_shape}")
            self._y[:] = measured
            self._read_reference(reference)
            if applied is not None or w is not None or self._has_extras:
                self._pass_extras(applied, w)
            if self._bounds is not None:
                self._choose_limits(limits)
            elif limits is not None:
                raise DataError(_OWN_LIMITS)
            self._call(self._pointer)
            u = self._u.copy() if self._is_double else self._u.astype(np.float64)
            if not frame.status and not frame.refused:
                return Move(u, Status.UNCONSTRAINED, Fallback.NONE, perf_counter() - start, 0)
            return Move(
                u,
                STATUSES[int(frame.status)],
                FALLBACKS[int(frame.fallback)],
                perf_counter() - start,
                frame.iterations,
                frame.slack,
                self._solver if frame.iterations else "",
                refused=bool(frame.refused),
                gap=frame.gap,
            )
        finally:
            self._token.append(held)

    def rehearse(self) -> None:
        """Run the last step once more and forget it, so that the next step finds code and tables in the caches.

        After some milliseconds of sleep a call from Python takes ten times as long. A loop may wake a little early,
        call this, and then wait for the measurement. It changes no move and no plan.
        """
        if self._targets is None or self._last_rows:
            kept, step = self._memory.copy(), self._step
            self(self._y, self._reference[: self._count], limits=self._at_call)
            self._memory[:], self._step = kept, step

    def _pass_extras(self, applied: ArrayLike | None, w: ArrayLike | None) -> None:
        """Pass `applied` and `w`, or that both are missing."""
        frame = self._frame
        frame.applied, frame.w.count, self._has_extras = None, 0, False
        if applied is not None:
            got = numbers(applied, "applied")
            if got.shape != self._u.shape:
                raise ShapeError(f"applied has shape {got.shape}, expected {self._u.shape}")
            self._applied[:] = got
            frame.applied, self._has_extras = self._applied_address, True
        if w is not None:
            pushes = numbers(w, "w")
            if not self._nw:
                raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
            frame.w.count, self._has_extras = self._copy_rows(pushes, self._w, self._nw, "w"), True

    def _copy_rows(self, rows: Float[np.ndarray, "..."], to: Float[np.ndarray, "..."], width: int, name: str) -> int:
        """Copy the rows of a preview that the horizon reaches; return their number."""
        if rows.ndim > 2 or rows.shape[-1:] != (width,) or len(rows) == 0:
            raise ShapeError(
                f"{name} has shape {rows.shape}, expected ({width},), or rows of {width} for steps k … k+{len(to) - 1}"
            )
        table = rows.reshape(-1, width)[: len(to)]
        to[: len(table)] = table
        return len(table)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        sizes, memory, model = self._sizes, point_to(self._memory), self.model
        U = np.zeros((sizes["N"], self.nu), self._y.dtype)
        if not self._code.koopmpc_plan(memory, point_to(U)):
            return None
        if sizes["IS_STAGED"]:
            X = np.zeros((sizes["N"] + 1, sizes["NX"]), self._y.dtype)
            self._code.koopmpc_plan_states(memory, point_to(X))
            return Plan(X.astype(np.float64), U.astype(np.float64))
        if self._states is None:
            assert isinstance(model, LinearPredictor), "it plans by one matrix"
            rates, disturbed = bool(sizes["WITH_RATES"]), bool(sizes["ESTIMATOR"])
            steps = np.arange(sizes["N"])
            self._states = planned_states(model, steps, with_rates=rates, disturbed=disturbed)
        known = self._memory.view(self._y.dtype)[: sizes["KNOWN"]]
        X = self._states @ np.concatenate([U.ravel(), known, [1.0]], dtype=np.float64)
        return Plan(X.reshape(sizes["N"] + 1, -1), U.astype(np.float64))

    def __copy__(self) -> "Compiled":
        """Return a copy that shares no state with this one."""
        twin = object.__new__(Compiled)
        twin.__dict__.update(self.__dict__)
        twin._memory = self._memory.copy()
        twin._connect()
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> "Compiled":
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        limits = None if self._at_call is None else self._called_with
        return _rebuild, (self.original, self.precision, self._memory, self._step, limits)


def _rebuild(
    controller: Controller,
    precision: Precision,
    memory: Float[np.ndarray, " n"],
    step: int = 0,
    at_call: Limits | None = None,
) -> Controller:
    """Return the controller of a pickle, compiled here, in the state of the pickled one."""
    result = compiled(controller, precision=precision)
    if isinstance(result, Compiled) and result._memory.shape == memory.shape:
        result._memory[:], result._step = memory, step
        result._at_call = result._called_with = at_call
        result._aim(np.zeros((0, result._nr)))  # the address of the table is another one here
    return result
