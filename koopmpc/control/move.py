"""What a controller returns: a Move with a Status; one thread at a time; what answers a step that has no plan."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import wraps
from threading import get_ident
from time import perf_counter
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import ThreadError
from koopmpc.base.values import Interval, Value
from koopmpc.control.ask.levels import HeldLevels

TurnTaker = TypeVar("TurnTaker", bound=Callable[..., Any])
# One thread at a time: each controller, and each copy of one, has a token of its own: a list of one element, [0].
# `pop` and `append` are atomic and take 20 ns each.
Token = list[int]


class Status(Enum):
    """How a step ended.

    The first four are regular. The others come with a Fallback; only with TIME_LIMIT it may be NONE: an answer that was
    found too late is used.
    """

    UNCONSTRAINED = 0  # the unconstrained optimum meets every limit
    OPTIMAL = 1  # a QP or NLP was solved to its tolerance
    SOFTENED = 2  # solved, and a soft limit gave way by more than the tolerance
    SATURATED = 3  # a feedback law was clipped to the limits of the inputs, or of their rates
    MAX_ITERATIONS = 4  # the solver ended before its tolerance
    TIME_LIMIT = 5  # the step took longer than it may
    INFEASIBLE = 6  # no plan meets the hard limits
    BAD_MEASUREMENT = 7  # NaN or inf in y or in the reference, or a nonlinear model overflows from y
    FAILED = 8  # the solver gave no usable answer


class Fallback(Enum):
    """The input that replaces the answer of a failed step; always inside the input limits."""

    NONE = 0
    SHIFTED_PLAN = 1  # the last good plan, moved on by one step
    CLIPPED_LQR = 2  # the unconstrained optimum, clipped to the input limits
    HOLD = 3  # the last input again
    OTHER_CONTROLLER = 4  # the move of the standby controller, where the model does not know the step


@dataclass(slots=True)
class Move:
    """One step of a controller.

    Attributes
    ----------
    u
        (nu,) input to apply, a fresh array.
    status, fallback
        How the step ended.
    solve_time
        Wall-clock time of the whole step, from y to u [s].
    iterations
        Iterations of all solvers; 0 where none ran.
    slack
        How far the plan breaks the soft limit, or the rate, that gives way most, in its own unit; 0 but for SOFTENED.
    solver
        Name of the solver that answered, "osqp", "daqp", or "sequences" of levels; if none did, of the last one asked.
    known
        Whether the step is like the data of the model: state and input inside their region, the measurement as
        predicted. None without a monitor.
    refused
        Whether the measurement was too far from its prediction: it entered neither the estimate nor the history of
        delays, and the prediction stood in.
    gap
        With inputs on levels, the share of the plan's cost above that of the plan without limits that a better plan
        may save; 0 where the plan is the best one.
    actor
        Who acted, of a `Station`: "manual", "automatic" or "standby"; empty elsewhere.
    """

    u: Float[np.ndarray, " nu"]
    status: Status
    fallback: Fallback
    solve_time: float
    iterations: int
    slack: float = 0.0
    solver: str = ""
    known: bool | None = None
    refused: bool = False
    actor: str = ""
    gap: float = 0.0

    @classmethod
    def hold(cls, u: Float[np.ndarray, " nu"], status: Status, solve_time: float = 0.0) -> "Move":
        """Return the move of a step without an answer, which holds the last input u."""
        return cls(u, status, Fallback.HOLD, solve_time, 0)


@dataclass(frozen=True, eq=False)
class Plan(Value):
    """The plan behind a Move: X (N+1, nx) from the measured state on, U (N, nu) with U[0] the move."""

    X: Float[np.ndarray, "N1 nx"]
    U: Float[np.ndarray, "N nu"]


@runtime_checkable
class Fallible(Protocol):
    """A controller whose solver can be made to fail, for tests of its fallback."""

    solver_fails: bool
    """While it is True, the answer of the solver is dropped and the step is FAILED."""


@runtime_checkable
class Controller(Protocol):
    """y, reference → Move, once every dt."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        ...

    @property
    def nu(self) -> int:
        """Number of inputs."""
        ...

    @property
    def horizon(self) -> int:
        """Steps of preview that the controller reads: it takes reference rows k … k + horizon."""
        ...

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget the last plan; `u_prev` is the input that is held if the first step fails."""
        ...

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return the next input for measurement y.

        Parameters
        ----------
        y
            (ny,) measurement: the state, or what the estimator takes.
        reference
            (nr,), or rows r_k … r_{k+horizon}, the last repeated.
        applied
            (nu,) what the plant really got last; by default the last u returned.
        w
            (nw,) measured disturbances, or rows from step k on, the last repeated; zero by default.
        """
        ...


def busy(controller: object) -> ThreadError:
    """Return the error for a second thread that enters a controller."""
    name = type(controller).__name__
    return ThreadError(f"two threads entered one {name} at once; give each thread a copy: copy.copy(controller)")


def alone(method: TurnTaker) -> TurnTaker:
    """Let a method raise ThreadError while another thread is in a method of the same object.

    Methods of one thread may call each other.
    """

    @wraps(method)
    def enter(self: Any, *arguments: Any, **options: Any) -> Any:
        me = get_ident()
        if self._inside == me:
            return method(self, *arguments, **options)
        try:
            held = self._token.pop()
        except IndexError:
            raise busy(self) from None
        except BaseException:  # a Ctrl-C that came right behind the pop
            self._token.append(0)
            raise
        self._inside = me
        try:
            return method(self, *arguments, **options)
        finally:
            self._inside = 0
            self._token.append(held)

    return cast("TurnTaker", enter)


@runtime_checkable
class LatePlan(Protocol):
    """A plan of which a step has computed the first input alone."""

    def compute(self) -> Float[np.ndarray, " nv"]:
        """Return the whole plan."""
        ...


class PlanMemory:
    """The last good plan and the last input, and what they answer in a failed step.

    Parameters
    ----------
    nu, move_of
        Number of inputs, and the move that is the input of each step of a plan.
    levels, latency
        The levels of the inputs now, None where they have none; steps until an input acts.
    allowed
        Wall-clock time of a step [s]; inf for any.

    Attributes
    ----------
    given
        The last input returned.
    is_planned
        Whether the last step had a plan.
    """

    def __init__(
        self, nu: int, move_of: Int[np.ndarray, " N"], levels: HeldLevels | None, latency: int, allowed: float
    ) -> None:
        self._nu, self._move_of, self._levels, self._latency, self.allowed = nu, move_of, levels, latency, allowed

    def reset(self, u_prev: ArrayLike | None, box: Interval) -> None:
        """Forget the plan; u_prev is the input that acts, by default zero moved inside this box."""
        zero, levels = np.clip(np.zeros(self._nu), *box), self._levels
        self.given: Float[np.ndarray, " nu"] = zero if u_prev is None else checks.array(u_prev, "u_prev", (self._nu,))
        if levels is not None:
            if u_prev is None:
                levels.reset(zero)  # no dwell time of an earlier run counts
                self.given = levels.round(zero)
            levels.reset(self.given)
        self._plan: Float[np.ndarray, " nv"] | LatePlan | None = None
        self._age, self.is_planned = 0, False

    def take(self, applied: ArrayLike | None) -> None:
        """Count the step for which the input that acted, or that was returned last, held its levels."""
        if self._levels is not None:
            self._levels.take(self.given if self._latency else self.find_last(applied))

    @property
    def plan(self) -> Float[np.ndarray, " nv"] | None:
        """The last good plan, its moves first, one behind the other."""
        if self._plan is not None and not isinstance(self._plan, np.ndarray):
            self._plan = self._plan.compute()
        return self._plan

    def keep(self, plan: "Float[np.ndarray, ' nv'] | LatePlan", u: Float[np.ndarray, " nu"]) -> None:
        """Keep a good plan, by reference, whose first input is u."""
        self._plan, self._age, self.is_planned, self.given = plan, 0, True, u

    def judge_time(self, status: Status, start: float) -> tuple[Status, float]:
        """Return the status, which is TIME_LIMIT of a late step, and how long the step took."""
        taken = perf_counter() - start
        return (status if taken <= self.allowed else Status.TIME_LIMIT), taken

    def find_last(self, applied: ArrayLike | None) -> Float[np.ndarray, " nu"]:
        """Return the input that acted last, as far as `applied` is one; else the last one returned."""
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape == (self._nu,) and (np.abs(got) < HUGE).all():
                return got
        return self.given

    def fall_back(
        self,
        status: Status,
        start: float,
        applied: ArrayLike | None,
        limits: tuple[Interval, Interval | None],
        free: Float[np.ndarray, " nu"] | None = None,
        iterations: int = 0,
        solver: str = "",
    ) -> Move:
        """Return the move that replaces a failed step, with the status that says why; TIME_LIMIT where it is late.

        Parameters
        ----------
        applied
            The input that acted last, if it is not the last input returned.
        limits
            The box of the next input, and that of its change.
        free
            The unconstrained optimum, if it is known.
        iterations, solver
            Of the solver that was asked.
        """
        before, plan = self.find_last(applied), self.plan
        self.is_planned = False
        if self._levels is not None and status is Status.TIME_LIMIT:  # no plan was found: hold the levels
            u, fallback = before, Fallback.HOLD
        elif plan is not None and self._age + 1 < len(self._move_of):
            self._age += 1
            first = self._nu * int(self._move_of[self._age])
            u, fallback = plan[first : first + self._nu], Fallback.SHIFTED_PLAN
        else:
            self._plan = None
            u, fallback = (before, Fallback.HOLD) if free is None else (free, Fallback.CLIPPED_LQR)
        box, rates = limits
        reach = None if rates is None else Interval(before + rates.low, before + rates.high)
        u = np.clip(u if reach is None else np.clip(u, *reach), *box)
        self.given = u if self._levels is None else self._levels.round(u, reach, box)
        status, taken = self.judge_time(status, start)
        return Move(self.given.copy(), status, fallback, taken, iterations, solver=solver)
