"""Whole closed loops in C: of one controller, from many states, or of many copies side by side."""

import ctypes
import subprocess
from collections.abc import Callable, Mapping
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.codegen.door import AbreastStep, gather_run, point_to
from koopmpc.codegen.functions import Language
from koopmpc.codegen.sources import write_plant_functions
from koopmpc.control.move import Fallback, Status, Token, alone
from koopmpc.plants.routines import find_compiler, find_private_cache, load_library
from koopmpc.plants.step_map import StepMap

STATUSES = list(Status)
FALLBACKS = list(Fallback)
_ROWS = 100_000  # reference rows whose targets a controller keeps
# head of the C file of a plant
_PLANT_HEAD = "#include <math.h>\ntypedef double koopmpc_real;\n#define KOOPMPC_FN(name) name\n"


class ManyRuns(NamedTuple):
    """Closed loops side by side: X (E, T+1, nx), U (E, T, nu), and of every step Status, Fallback and slack."""

    X: Float[np.ndarray, "E T1 nx"]
    U: Float[np.ndarray, "E T nu"]
    status: Int[np.ndarray, "E T"]
    fallback: Int[np.ndarray, "E T"]
    slack: Float[np.ndarray, "E T"]


class TargetTable:
    """The targets of the reference rows that a BilinearMPC in machine code meets, found in Python; copies share it."""

    def __init__(self, find: Callable[[np.ndarray], np.ndarray], kind: type[np.floating]) -> None:
        self._find, self._kind, self._lock = find, kind, Lock()
        self._known: set[bytes] = set()
        self._room = self._table = np.zeros((0, 1), kind)

    def of(self, reference: Float[np.ndarray, "..."]) -> Float[np.ndarray, "found size"]:
        """Return the table with the rows of this reference in it: the same array while no row is new."""
        with self._lock:
            rows = np.ascontiguousarray(np.atleast_2d(reference))
            keys, width = rows.tobytes(), rows.shape[1] * rows.itemsize
            if self._known.issuperset([keys[i : i + width] for i in range(0, len(keys), width)]):
                return self._table
            rows = rows[np.abs(rows).max(axis=1, initial=0.0) < checks.HUGE]
            finite = {row.tobytes(): row for row in rows}
            new = [key for key in finite if key not in self._known]
            if new and len(self._known) + len(new) > _ROWS:
                self._known, self._table, new = set(), np.zeros((0, 1), self._kind), list(finite)
            if new:
                self._append(self._find(np.array([finite[key] for key in new])))
                self._known.update(new)
            return self._table

    def _append(self, found: Float[np.ndarray, "new size"]) -> None:
        """Add rows. A table that was returned before keeps its rows, for C may still read it."""
        first = len(self._table)
        last = first + len(found)
        if first == 0 or last > len(self._room):
            self._room = np.zeros((2 * last, found.shape[1]), self._kind)
            self._room[:first] = self._table
        self._room[first:last] = found
        self._table = self._room[:last]


class ControllersAbreast:
    """E copies of one controller in double precision, each with a state of its own; see `Compiled.start_abreast`.

    `U` (E, nu) and `reports` (E, 2) hold the last input of each, and the numbers of its Status and Fallback.

    Parameters
    ----------
    code, sizes
        The machine code of the controller, and the sizes of its program.
    rows
        (E, R, nr) reference of each; step k gets the rows k … k + N, so that R is at least the steps + N.
    x0
        (E, nx) states in which the estimators begin; None where they begin without one.
    W
        (w, nw) measured disturbances, the same at every step, at least N rows; None where there are none.
    targets
        Table of the targets of all reference rows; None for a controller without one.
    """

    def __init__(
        self,
        code: ctypes.CDLL,
        sizes: Mapping[str, int],
        rows: Float[np.ndarray, "E R nr"],
        x0: Float[np.ndarray, "E nx"] | None,
        W: Float[np.ndarray, "w nw"] | None,
        targets: Float[np.ndarray, "found size"] | None,
    ) -> None:
        self._code, self._rows = code, np.ascontiguousarray(rows)
        self._kept = targets  # every state holds the address of this table
        self.U = np.zeros((len(rows), sizes["NU"]))
        self.reports = np.zeros((len(rows), 2), dtype=np.intc)
        self._nr, self._ny = sizes["NR"], sizes["NY"]
        self._W = None if W is None else np.ascontiguousarray(W)
        words = -(-int(code.koopmpc_state_size()) // 8)
        self._states = np.zeros((len(rows), words))
        for e, state in enumerate(self._states):
            start = None if x0 is None else np.ascontiguousarray(x0[e])
            code.koopmpc_init(point_to(state), point_to(start), None)
            if targets is not None:
                code.koopmpc_use_targets(point_to(state), point_to(targets), len(targets))

    def step(self, k: int, Y: Float[np.ndarray, "E ny"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "E nu"]:
        """Return the inputs after step k of the controllers `which`; rows of the others are those of before."""
        Y, places = np.ascontiguousarray(Y, dtype=np.float64), np.ascontiguousarray(which, dtype=np.dtype("long"))
        assert Y.shape == (len(self.U), self._ny), "a row of measurements for each controller"
        rows = self._rows
        assert k + 1 <= rows.shape[1], "the reference has a row for this step"
        arguments = AbreastStep(
            len(places),
            self._states.strides[0],
            rows.shape[1] * rows.shape[2],
            int(k == 0),
            int(self._W is not None),
            places.ctypes.data,
            self._states.ctypes.data,
            Y.ctypes.data,
            rows.ctypes.data + 8 * k * self._nr,
            0 if self._W is None else self._W.ctypes.data,
            self.U.ctypes.data,
            self.reports.ctypes.data,
        )
        self._code.koopmpc_step_abreast(ctypes.byref(arguments))
        return self.U


class CompiledLoops:
    """A controller in machine code that runs whole closed loops; `Compiled` makes it and takes single steps."""

    nu: int
    horizon: int
    _token: Token
    _inside: int
    _code: ctypes.CDLL
    _sizes: dict[str, int]
    _pointer: ctypes.c_void_p
    _plant: tuple[StepMap, ctypes.CDLL] | None
    _targets: TargetTable | None
    _timed: bool
    _is_double: bool
    _ny: int
    _nr: int
    _nw: int

    def _aim(self, rows: Float[np.ndarray, "..."]) -> None:
        """Pass the targets of these rows to the C code."""
        raise NotImplementedError

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps."""
        raise NotImplementedError

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
    ) -> dict[str, Any] | None:
        """Write a whole run from X[0] and Y[0] into X, Y and U; None where the plant cannot be written in C.

        Return the columns of its moves, as `StepRows` has them.

        `simulate` uses it if nothing between two steps needs Python.
        """
        misfit = (
            self._timed  # each step has limits of its own
            or self._sizes.get("LEVELS")  # each step has a gap
            or rows.shape[1] != self._nr
            or Y.shape[1] != self._ny
            or (W is not None and W.shape[1] != self._nw)
        )
        code = None if misfit else self._compile_plant(plant)
        if code is None:
            return None
        self._aim(rows)
        rows, W = np.ascontiguousarray(rows), None if W is None else np.ascontiguousarray(W)
        slack, times, reports = np.zeros(len(U)), np.zeros(len(U)), np.zeros((len(U), 4), dtype=np.intc)
        arrays = {"rows": rows, "X": X, "Y": Y, "U": U, "slack": slack, "times": times, "reports": reports}
        whole = gather_run(code, len(U), arrays, W, preview=preview)
        self._code.koopmpc_run(self._pointer, ctypes.c_void_p(ctypes.addressof(whole)))
        status, fallback, iterations = reports.T.tolist()[:3]
        return {
            "status": tuple([STATUSES[i] for i in status]),
            "fallback": tuple([FALLBACKS[i] for i in fallback]),
            "iterations": reports[:, 2].astype(np.int64),
            "refused": reports[:, 3].astype(np.int64),
            "solver": tuple(["daqp" if i else "" for i in iterations]),
            "slack": slack,
            "solve_time": times,
        }

    def start_abreast(
        self,
        rows: Float[np.ndarray, "E R nr"],
        x0: Float[np.ndarray, "E nx"] | None = None,
        W: Float[np.ndarray, "w nw"] | None = None,
    ) -> ControllersAbreast:
        """Return copies after a reset, one for each reference, that step side by side; see `ControllersAbreast`."""
        if rows.shape[-1] != self._nr or (W is not None and W.shape[1] != self._nw) or not self._is_double:
            raise ShapeError(f"the reference has shape {rows.shape}, expected (E, R, {self._nr}), for a double")
        targets = None
        if self._targets is not None:
            targets = np.ascontiguousarray(self._targets.of(np.unique(rows.reshape(-1, self._nr), axis=0)))
        return ControllersAbreast(self._code, self._sizes, rows, x0, W, targets)

    @alone
    def runs(self, plant: StepMap, x0: ArrayLike, reference: ArrayLike, *, steps: int) -> ManyRuns:
        """Run the closed loop from many states in C, each time after a reset.

        Parameters
        ----------
        plant
            x⁺ = F(x, u), y = h(x).
        x0
            (E, nx), a row a run.
        reference
            (nr,) for all steps, or (steps+1, nr); the same for all runs. The controller gets the rows ahead.

        Raises
        ------
        DataError
            The plant cannot be written in C, or the controller is in single precision.
        ShapeError
            Sizes do not fit.
        """
        if self._timed:
            raise DataError("the limits have rows in time, which Python passes step by step; use km.simulate")
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
        code = self._compile_plant(plant)
        if code is None:
            raise DataError("the plant, or a controller of floats, cannot run in C as a whole; use km.simulate")
        rows = np.ascontiguousarray(given[np.minimum(np.arange(T + self.horizon + 1), len(given) - 1)])
        E, Y = len(starts), np.empty((T + 1, self._ny))
        X, U = np.empty((E, T + 1, starts.shape[1])), np.empty((E, T, self.nu))
        X[:, 0] = starts
        slack, reports = np.zeros((E, T)), np.zeros((E, T, 4), dtype=np.intc)
        self._aim(given)
        for e, start in enumerate(starts):
            self.reset(start if len(start) == self._sizes["NX"] else None)
            code.plant_measure(point_to(X[e]), point_to(Y))
            arrays = {"rows": rows, "X": X[e], "Y": Y, "U": U[e], "slack": slack[e], "reports": reports[e]}
            whole = gather_run(code, T, arrays, None, preview=True)
            self._code.koopmpc_run(self._pointer, ctypes.c_void_p(ctypes.addressof(whole)))
        return ManyRuns(X, U, reports[..., 0], reports[..., 1], slack)

    def _compile_plant(self, plant: StepMap) -> ctypes.CDLL | None:
        """Return the plant in machine code, compiled unless it is the last one; None where it cannot be."""
        if self._plant is not None and self._plant[0] is plant:
            return self._plant[1]
        command = find_compiler() if self._is_double else None
        if command is None:
            return None
        try:
            code = load_library(
                _PLANT_HEAD + write_plant_functions(plant.F, plant.h, Language()), command, find_private_cache()
            )
        except (DataError, OSError, subprocess.SubprocessError):
            return None
        self._plant = plant, code
        return code
