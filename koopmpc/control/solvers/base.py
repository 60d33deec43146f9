"""One QP in, one solution out: the record of a QP, what all solvers share, and the QP of a step, started warm."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.control.limits import Interval
from koopmpc.control.move import Status
from koopmpc.errors import DataError, ShapeError

INFINITY = 1e30  # what OSQP and DAQP take for no limit
_BELOW_ROUNDING = 1e26  # ‖by‖² up to which 1e30 less an entry of it is 1e30
_AFTER = 5e-5  # what a step still has to do after its solve [s]


@dataclass(frozen=True)
class QP:
    """½ vᵀP v + qᵀv → min, low ≤ A v ≤ high; P ⪰ 0 dense, ±inf where there is no limit."""

    P: Float[np.ndarray, "n n"]
    q: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]

    def __post_init__(self) -> None:
        for name in ("P", "q", "A"):
            checks.array(getattr(self, name), f"the QP's {name}")
        for name in ("low", "high"):
            checks.array(getattr(self, name), f"the QP's {name}", infinite=True)
        m, n = self.A.shape
        if self.P.shape != (n, n) or self.q.shape != (n,) or not self.low.shape == self.high.shape == (m,):
            raise ShapeError(
                f"the QP has A {self.A.shape}, P {self.P.shape}, q {self.q.shape}, low {self.low.shape} and"
                f" high {self.high.shape}; pass A (m, n), P (n, n), q (n,), low and high (m,)"
            )
        checks.crossed(self.low, self.high, "the QP's")

    def sparse(self) -> tuple[scipy.sparse.csc_matrix, scipy.sparse.csc_matrix]:
        """Return the upper triangle of P, and A, in compressed columns."""
        return scipy.sparse.csc_matrix(np.triu(self.P)), scipy.sparse.csc_matrix(self.A)


@dataclass(frozen=True)
class StepQP(QP):
    """½ wᵀH w + Σ (linear ε + quadratic ε²)/(2 unit) → min over [w; ε], low ≤ s (p + D w) ≤ high for a plan p.

    It is the cost unit · wᵀH w + Σ (linear ε + quadratic ε²), divided by 2 unit. Soft rows are relaxed by their
    ε ≥ 0. The first rows limit the entries `source` of the plan times `scale`: their limits move by that product; the
    rest are ε ≥ 0. `shift_primal` and `shift_dual` tell where the next stage's entry stands; one past the end stands
    for zero. A slack above its `allowance` is reported, `slack_unit` times as large: in the unit of its limit. Where
    soft rows are held hard, their multipliers must be at most `most` for the solution to be that of the soft QP.
    `rate_rows` limit the first change of the inputs `rate_inputs`, hard.
    """

    source: Int[np.ndarray, " m1"]
    scale: Float[np.ndarray, " m1"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]
    allowance: Float[np.ndarray, " ns"]
    slack_unit: Float[np.ndarray, " ns"]
    most: Float[np.ndarray, " m"]
    rate_rows: Int[np.ndarray, " r"]
    rate_inputs: Int[np.ndarray, " r"]


@dataclass(slots=True)
class QPSolution:
    """Minimiser v, multipliers y of low ≤ A v ≤ high (positive at the upper end), and how the solve ended."""

    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]
    status: Status
    iterations: int


class QPSolver(ABC):
    """A QP set up once in a solver with its own `settings`: limits move from solve to solve, P, q and A now and then.

    Copies go on from the last limits. Limits are checked here, for solvers take what is short, strided or NaN.
    """

    goes_on: ClassVar[bool]
    """Whether a solve starts from where the last one ended, whatever its (v, y)."""

    def __init__(self, qp: QP, settings: Mapping[str, Any] | None = None) -> None:
        self._settings = dict(settings or {})
        self._hold(qp)

    def _hold(self, qp: QP) -> None:
        """Make this the problem, its limits in arrays of their own, cut to ±INFINITY."""
        m = len(qp.low)
        self._qp = qp
        self._own = np.stack([np.maximum(qp.low, -INFINITY), np.minimum(qp.high, INFINITY)])
        self._now, self._spare = self._own.copy(), np.empty((2, m))
        self.low, self.high = self._now
        self._in_order = bytearray(m)  # a search in bytes is five times as fast as all()
        self._in_order_array = np.frombuffer(self._in_order, bool)

    def shift(self, by: Float[np.ndarray, " m"]) -> None:
        """Set the limits to those of the QP less `by`; the old ones stay where that is refused.

        Raises
        ------
        ShapeError
            `by` has the wrong length.
        DataError
            It holds NaN, or moves a limit beyond 1e30.
        """
        if by.shape != self.low.shape:
            raise ShapeError(f"the limits move by shape {by.shape}, the QP has {len(self.low)} rows")
        if by.dot(by) < _BELOW_ROUNDING:
            np.subtract(self._own, by, out=self._now)
        else:
            self.set_bounds(self._qp.low - by, self._qp.high - by)

    def set_bounds(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits, ±inf where there is none; the old ones stay where they are refused.

        Raises
        ------
        ShapeError
            They have the wrong length.
        DataError
            They hold NaN or cross.
        """
        if low.shape != self.low.shape or high.shape != self.low.shape:
            raise ShapeError(f"the limits have shapes {low.shape} and {high.shape}, the QP has {len(self.low)} rows")
        new_low, new_high = self._spare
        np.maximum(low, -INFINITY, out=new_low)
        np.minimum(high, INFINITY, out=new_high)
        np.less_equal(new_low, new_high, out=self._in_order_array)
        if 0 in self._in_order:
            raise DataError("the limits of the QP cross, hold NaN, or are beyond 1e30")
        self._now, self._spare = self._spare, self._now
        self.low, self.high = self._now

    @abstractmethod
    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size."""

    @abstractmethod
    def reset(self) -> None:
        """Forget what earlier solves left behind."""

    def solve(
        self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None = None
    ) -> QPSolution:
        """Solve from the warm start (v, y), within `time_limit` seconds: none by default, TIME_LIMIT if it is over."""
        if v.shape != self._qp.q.shape or y.shape != self.low.shape:
            shapes = f"{self._qp.q.shape}, {self.low.shape}"
            raise ShapeError(f"the warm start has shapes {v.shape} and {y.shape}, the QP is {shapes}")
        if time_limit is not None and not time_limit > 0:
            return QPSolution(v.copy(), y.copy(), Status.TIME_LIMIT, 0)
        return self._solve(v, y, time_limit)

    @abstractmethod
    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        """Solve within the limits `low` and `high`."""


class WarmQP:
    """A StepQP, its solver, and the last solution, which the next solve starts from moved on by one step."""

    def __init__(self, qp: StepQP, solver: type[QPSolver], settings: Mapping[str, Any]) -> None:
        self.qp, self.warm = qp, False
        self._solver = solver(qp, settings)
        m, n = qp.A.shape
        self._primal, self._dual = np.zeros(n + 1), np.zeros(m + 1)  # one more, always zero, for the shift
        self._cold = np.zeros(n), np.zeros(m)
        self._moved = np.zeros(m)  # rows of slacks stay

    def update(self, qp: StepQP) -> None:
        """Go on with new matrices of the same size; the warm start is kept."""
        self.qp = qp
        self._solver.update(qp)

    def reset(self) -> None:
        """Forget all earlier solves."""
        self.warm = False
        self._solver.reset()

    def solve(
        self, plan: Float[np.ndarray, " nv"], room: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the solution, and how far the input limits are out of the hard rates' reach; see `StepSolver`."""
        qp, solver, conflict = self.qp, self._solver, 0.0
        moved = self._moved
        np.multiply(plan[qp.source], qp.scale, out=moved[: len(qp.source)])
        if room is None:
            solver.shift(moved)
        else:
            low, high, conflict = self._widened(room)
            solver.set_bounds(low - moved, high - moved)
        start = self._cold
        if self.warm and not solver.goes_on:
            start = self._primal[qp.shift_primal], self._dual[qp.shift_dual]
        left = None if deadline is None else deadline - perf_counter()
        found = solver.solve(*start, None if left is None else left - min(_AFTER, left / 2))
        self.warm = found.status is Status.OPTIMAL
        if self.warm and not solver.goes_on:
            self._primal[:-1], self._dual[:-1] = found.v, found.y
        return found, conflict

    def _widened(self, room: Interval) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], float]:
        """Return the limits with the first rates as wide as the input limits need, and by how much, in their unit."""
        qp = self.qp
        low, high = qp.low.copy(), qp.high.copy()
        rows, which = qp.rate_rows, qp.rate_inputs
        scale = qp.scale[rows]
        lowest = np.minimum(low[rows], room.high[which] * scale)
        highest = np.maximum(high[rows], room.low[which] * scale)
        below, above = lowest < low[rows], highest > high[rows]  # never where there is no limit
        past = np.where(below, low[rows], 0.0) - np.where(below, lowest, 0.0)
        past += np.where(above, highest, 0.0) - np.where(above, high[rows], 0.0)
        low[rows], high[rows] = lowest, highest
        return low, high, float((past / scale)[past > 1e-9].max(initial=0.0))


class StepSolver:
    """The QP of a step, all rows hard first; where that has no solution, or is not that of the soft QP, the soft one.

    Parameters
    ----------
    hard, soft
        All rows hard; and soft where the limits say so, None where none is.
    solver
        The solver of both.
    settings, soft_settings
        The solver's own settings, of each.
    """

    def __init__(
        self,
        hard: StepQP,
        soft: StepQP | None,
        solver: type[QPSolver],
        settings: Mapping[str, Any],
        soft_settings: Mapping[str, Any],
    ) -> None:
        self._hard = WarmQP(hard, solver, settings)
        self._soft = None if soft is None else WarmQP(soft, solver, soft_settings)

    def update(self, hard: StepQP, soft: StepQP | None) -> None:
        """Go on with new matrices of the same size; the warm starts are kept."""
        self._hard.update(hard)
        if self._soft is not None and soft is not None:
            self._soft.update(soft)

    def cool(self) -> None:
        """Forget the warm starts."""
        self._hard.warm = False
        if self._soft is not None:
            self._soft.warm = False

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        self._hard.reset()
        if self._soft is not None:
            self._soft.reset()

    def solve(
        self, plan: Float[np.ndarray, " nv"], room: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the least deviation w from the plan, and how far a soft limit gave way, 0 where none did.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        deadline
            The time by `perf_counter` at which the step must have ended; None for none.
        """
        found, conflict = self._hard.solve(plan, room, deadline)
        if self._soft is None or found.status is Status.TIME_LIMIT:
            return found, conflict
        iterations = found.iterations
        if found.status is Status.OPTIMAL and (np.abs(found.y) <= self._hard.qp.most).all():
            self._soft.warm = False
            return found, conflict
        found, conflict = self._soft.solve(plan, room, deadline)
        nw, qp = len(self._hard.qp.q), self._soft.qp
        slacks = found.v[nw:]
        given = slacks > qp.allowance
        gave_way = max(conflict, float((slacks * qp.slack_unit)[given].max(initial=0.0)))
        found.v, found.iterations = found.v[:nw], iterations + found.iterations
        return found, gave_way
