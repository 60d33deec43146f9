"""A step's QP and its solvers: what goes in, what comes out, and how several are asked one after the other."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers.stages import QPStages

INFINITY = 1e30  # OSQP and DAQP read a limit of this size as none


@dataclass(frozen=True)
class QP:
    """½ vᵀP v + qᵀv → min, low ≤ A v ≤ high; P ⪰ 0 dense, ±inf where there is no limit.

    Where there is a `softness`, a row whose linear price is finite may be broken by ε ≥ 0 at linear ε + quadratic ε².
    A solver that is not `exact` keeps such rows, too; its answer is that of the QP where no multiplier is above the
    linear price.
    """

    P: Float[np.ndarray, "n n"]
    q: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    softness: Softness | None = None


@dataclass(frozen=True, kw_only=True)
class StepQP(QP):
    """½ wᵀH w + Σ (linear ε + quadratic ε²) → min over w, low ≤ s (p + D w) ≤ high for a plan p.

    It is the cost unit · wᵀH w, and the price of slacks, divided by 2 unit. The rows limit the entries `source` of the
    plan times `scale`: their limits move by that product. `shift_primal` and `shift_dual` tell where the next stage's
    entry stands; one past the end stands for zero. The `allowance` of a soft row is in the unit of its limit.
    `rate_rows` limit the first change of the inputs `rate_inputs`, hard. `stages` are the same QP before it was
    condensed, where each stage is one step and none has rows of its own.
    """

    softness: Softness = field(kw_only=True)
    source: Int[np.ndarray, " m"]
    scale: Float[np.ndarray, " m"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]
    rate_rows: Int[np.ndarray, " r"]
    rate_inputs: Int[np.ndarray, " r"]
    stages: QPStages | None = None


@dataclass(slots=True)
class QPSolution:
    """Minimiser v, multipliers y of low ≤ A v ≤ high (positive at the upper end), status, and the solver's name."""

    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]
    status: Status
    iterations: int
    solver: str


_BELOW_ROUNDING = 1e26  # up to this ‖by‖², 1e30 less an entry of `by` still rounds to 1e30
_AFTER = 5e-5  # what a step still has to do after its solve [s]


def move_limits(limits: Interval, by: Float[np.ndarray, " m"]) -> Interval:
    """Return limits less `by`; those that a wild reading moves beyond 1e30 end there, as in C."""
    return Interval(np.minimum(limits.low - by, INFINITY), np.maximum(limits.high - by, -INFINITY))


class QPSolver(ABC):
    """A QP set up once in a solver with its own `settings`: limits move from solve to solve, P, q and A now and then.

    Copies go on from the last limits. Limits are checked here, for solvers take what is short, strided or NaN.
    """

    name: ClassVar[str]
    exact: ClassVar[bool]
    """Whether it knows soft rows, and its INFEASIBLE is certain."""
    impatient: ClassVar[Mapping[str, Any]] = {}
    """The settings with which it is asked first, while another one may still take over."""
    coordinates: ClassVar[Literal["auto", "riccati", "plain"]] = "riccati"
    """The coordinates of the condensed QP that suit it: in "riccati" the Hessian is the identity; see `condense`."""
    resumes = False
    """Whether `resume` can go on from the end of the last solve."""

    def __init__(self, qp: QP, settings: Mapping[str, Any] | None = None) -> None:
        self._settings, self._stale = dict(settings or {}), False
        self._hold(qp)
        self._setup()

    @staticmethod
    @abstractmethod
    def setting_names() -> frozenset[str]:
        """Return the names of the solver's own settings."""

    @abstractmethod
    def _setup(self) -> None:
        """Set up the QP that is held in the solver, with the limits `low` and `high`."""

    def _hold(self, qp: QP) -> None:
        """Make this the problem, its limits in arrays of their own, cut to ±INFINITY."""
        for name in ("P", "q", "A"):
            checks.array(getattr(qp, name), f"the QP's {name}")
        for name in ("low", "high"):
            checks.array(getattr(qp, name), f"the QP's {name}", infinite=True)
        m, n = qp.A.shape
        if qp.P.shape != (n, n) or qp.q.shape != (n,) or not qp.low.shape == qp.high.shape == (m,):
            raise ShapeError(
                f"the QP has A {qp.A.shape}, P {qp.P.shape}, q {qp.q.shape}, low {qp.low.shape} and"
                f" high {qp.high.shape}; pass A (m, n), P (n, n), q (n,), low and high (m,)"
            )
        checks.refuse_crossed(qp.low, qp.high, "the QP's")
        self._qp = qp
        self._own = np.stack([np.maximum(qp.low, -INFINITY), np.minimum(qp.high, INFINITY)])
        self._now = self._own.copy()
        self.low, self.high = self._now

    def shift(self, by: Float[np.ndarray, " m"]) -> None:
        """Set the limits to those of the QP less `by`, see `move_limits`; the old ones stay where that is refused."""
        if by.shape != self.low.shape:
            raise ShapeError(f"the limits move by shape {by.shape}, the QP has {len(self.low)} rows")
        if by.dot(by) < _BELOW_ROUNDING:
            np.subtract(self._own, by, out=self._now)
        else:
            self.set_bounds(*move_limits(Interval(self._qp.low, self._qp.high), by))

    def set_bounds(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits, ±inf where there is none; the old ones stay where they are refused."""
        if low.shape != self.low.shape or high.shape != self.low.shape:
            raise ShapeError(f"the limits have shapes {low.shape} and {high.shape}, the QP has {len(self.low)} rows")
        low, high = np.maximum(low, -INFINITY), np.minimum(high, INFINITY)
        if not (low <= high).all():
            raise DataError("the limits of the QP cross, hold NaN, or are beyond 1e30")
        self.low[:], self.high[:] = low, high

    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size."""
        self.__init__(qp, self._settings)

    def reset(self) -> None:
        """Have the next solve forget what earlier ones left behind."""
        self._stale, self.resumes = True, False

    @abstractmethod
    def _forget(self) -> None:
        """Forget what earlier solves left behind."""

    def solve(
        self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None = None
    ) -> QPSolution:
        """Solve from the warm start (v, y), within `time_limit` seconds: none by default, TIME_LIMIT if it is over."""
        if v.shape != self._qp.q.shape or y.shape != self.low.shape:
            shapes = f"{self._qp.q.shape}, {self.low.shape}"
            raise ShapeError(f"the warm start has shapes {v.shape} and {y.shape}, the QP is {shapes}")
        if time_limit is not None and not time_limit > 0:
            return QPSolution(v.copy(), y.copy(), Status.TIME_LIMIT, 0, self.name)
        if self._stale:
            self._forget()
            self._stale = False
        return self._solve(v, y, time_limit)

    def resume(self, time_limit: float | None = None) -> QPSolution:
        """Solve as `solve` does, from where the last solve ended; only while `resumes`."""
        raise NotImplementedError(f"{self.name} starts every solve from (v, y)")

    @abstractmethod
    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        """Solve within the limits `low` and `high`."""


class SolverTurn(NamedTuple):
    """A solver and its own settings."""

    solver: type[QPSolver]
    settings: Mapping[str, Any]


class StepSolver:
    """The QP of a step: a solver is asked from the last answer shifted by a step; what it leaves, the next one solves.

    Parameters
    ----------
    qp
        The QP; its limits move with the plan.
    turns
        The solver, and the exact one that finishes what it leaves; that one is set up when it is first needed.
    """

    def __init__(self, qp: StepQP, turns: Sequence[SolverTurn]) -> None:
        self._turns = turns
        self._last: QPSolution | None = None
        self._hold(qp)
        self.first = turns[0].solver(qp, turns[0].settings)
        self._solvers: list[QPSolver | None] = [self.first, *(None for _ in turns[1:])]

    def _hold(self, qp: StepQP) -> None:
        """Make this the QP; its rows are often those of the plan, one after the other."""
        self.qp = qp
        m, n = qp.A.shape
        first = int(qp.source[0]) if m else 0
        self._rows = slice(first, first + m) if qp.source.tolist() == list(range(first, first + m)) else qp.source
        self._soft = bool(np.isfinite(qp.softness.linear).any())
        self._moved, self._cold = np.zeros(m), (np.zeros(n), np.zeros(m))

    def update(self, qp: StepQP) -> None:
        """Go on with new matrices of the same size; the warm start is kept."""
        for solver in self._solvers:
            if solver is not None:
                solver.update(qp)
        self._hold(qp)

    def cool(self) -> None:
        """Forget the last answer."""
        self._last = None

    rest = cool  # the plan meets all limits

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        self.cool()
        for solver in self._solvers:
            if solver is not None:
                solver.reset()

    def solve(
        self,
        plan: Float[np.ndarray, " nv"],
        room: Interval | None,
        deadline: float | None,
        bounds: Interval | None = None,
    ) -> tuple[QPSolution, float]:
        """Return the least deviation w from the plan, and how far a soft limit gave way, 0 where none did.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        deadline
            The time by `perf_counter` at which the step must have ended; None for none.
        bounds
            Limits of this step in place of those of the QP.
        """
        moved, limits, conflict = self._limit(plan, room, bounds)
        found, answers = self._ask_all(moved, limits, deadline)
        if not answers or found.status is not Status.OPTIMAL:
            self._last = None
            return found, conflict
        self._last = found
        return found, max(conflict, self._gave_way(found, moved, limits)) if self._soft else conflict

    def _limit(
        self, plan: Float[np.ndarray, " nv"], room: Interval | None, bounds: Interval | None
    ) -> tuple[Float[np.ndarray, " m"], Interval | None, float]:
        """Return how far the plan moves the limits, these, None for the QP's own, and how far hard rates give way."""
        qp = self.qp
        moved = np.multiply(plan[self._rows], qp.scale, out=self._moved)
        if room is None:
            return moved, bounds, 0.0
        return moved, *self._widen_rates(room, bounds or Interval(qp.low, qp.high))

    def _ask_all(
        self, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Ask one solver after the other until one has the answer; return what the last one says, and if it answers."""
        found, answers = self._ask(0, moved, limits, deadline)
        iterations = found.iterations
        for i in range(1, len(self._solvers)):
            if answers:
                break
            if deadline is not None and perf_counter() >= deadline:
                found.status = Status.TIME_LIMIT
                break
            found, answers = self._ask(i, moved, limits, deadline)
            iterations += found.iterations
        if not answers and found.status is Status.OPTIMAL:  # it keeps a row that has to give way
            found.status = Status.FAILED
        found.iterations = iterations
        return found, answers

    def _ask(
        self, i: int, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Return what solver i finds, and whether it is the answer; one that is not exact has half of the time."""
        solver = self._solvers[i]
        if solver is None:
            solver = self._solvers[i] = self._turns[i].solver(self.qp, self._turns[i].settings)
        if limits is None:
            solver.shift(moved)
        else:
            solver.set_bounds(*move_limits(limits, moved))
        left = None
        if deadline is not None:
            left = deadline - perf_counter()
            left = left / 2 if i == 0 and not solver.exact else left
            left -= min(_AFTER, left / 2)
        last = self._last
        if last is None:
            found = solver.solve(*self._cold, left)
        elif solver.resumes:
            found = solver.resume(left)
        else:
            v, y = np.append(last.v, 0.0)[self.qp.shift_primal], np.append(last.y, 0.0)[self.qp.shift_dual]
            found = solver.solve(v, y, left)
        if solver.exact:
            return found, found.status is Status.OPTIMAL or found.status is Status.INFEASIBLE
        solved = found.status is Status.OPTIMAL
        return found, solved and (not self._soft or bool(np.all(np.abs(found.y) <= self.qp.softness.linear)))

    def _gave_way(self, found: QPSolution, moved: Float[np.ndarray, " m"], limits: Interval | None) -> float:
        """Return the largest violation of a soft row above its allowance, in the unit of its limit."""
        qp = self.qp
        pushed = np.abs(found.y) >= (1 - 1e-9) * qp.softness.linear
        if not pushed.any():
            return 0.0
        low, high = (qp.low, qp.high) if limits is None else limits
        rows = np.flatnonzero(pushed)
        value = qp.A[rows] @ found.v + moved[rows]
        past = np.maximum(value - high[rows], low[rows] - value) / qp.scale[rows]
        return float(past[past > qp.softness.allowance[rows]].max(initial=0.0))

    def _widen_rates(self, room: Interval, bounds: Interval) -> tuple[Interval, float]:
        """Return these limits, the first rates as wide as those of the inputs need, and by how much, in their unit."""
        qp = self.qp
        low, high = bounds.low.copy(), bounds.high.copy()
        rows, which = qp.rate_rows, qp.rate_inputs
        scale = qp.scale[rows]
        lowest = np.minimum(low[rows], room.high[which] * scale)
        highest = np.maximum(high[rows], room.low[which] * scale)
        below, above = lowest < low[rows], highest > high[rows]  # never where there is no limit
        past = np.where(below, low[rows], 0.0) - np.where(below, lowest, 0.0)
        past += np.where(above, highest, 0.0) - np.where(above, high[rows], 0.0)
        low[rows], high[rows] = lowest, highest
        return Interval(low, high), float(
            (past / scale)[past / scale > 1e-5 * qp.softness.allowance[rows]].max(initial=0.0)
        )
