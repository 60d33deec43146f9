"""What a controller returns: a Move with a Status; a controller's protocol; one thread at a time."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import wraps
from threading import get_ident
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.errors import ThreadError
from koopmpc.values import Value

TurnTaker = TypeVar("TurnTaker", bound=Callable[..., Any])
# One thread at a time: each controller, and each copy of one, has a token of its own: a list of one element, [0].
# `pop` and `append` are atomic and take 20 ns each.
Token = list[int]


class Status(Enum):
    """How a step ended.

    The first four are as intended; the others come with a Fallback, but for TIME_LIMIT, where an answer that was found
    too late is used all the same: its Fallback is NONE.
    """

    UNCONSTRAINED = 0  # the unconstrained optimum meets every limit
    OPTIMAL = 1  # a QP or NLP was solved to its tolerance
    SOFTENED = 2  # solved, and a soft limit gave way by more than the tolerance
    SATURATED = 3  # a feedback law was clipped to the limits of the inputs, or of their rates
    MAX_ITERATIONS = 4  # the solver ended before its tolerance
    TIME_LIMIT = 5  # the step took longer than it may
    INFEASIBLE = 6  # no plan meets the hard limits
    BAD_MEASUREMENT = 7  # NaN or inf in y or in the reference
    FAILED = 8  # the solver gave no usable answer


class Fallback(Enum):
    """What replaced the answer of a failed step; always inside the input limits."""

    NONE = 0
    SHIFTED_PLAN = 1  # the last good plan, moved on by one step
    CLIPPED_LQR = 2  # the unconstrained optimum, clipped to the input limits
    HOLD = 3  # the last input again
    OTHER_CONTROLLER = 4  # the move of the controller that stands by where the model does not know


@dataclass(slots=True)
class Move:
    """One step of a controller.

    Attributes
    ----------
    u
        (nu,) input to apply, a fresh array.
    status, fallback
        How it came about.
    solve_time
        Wall-clock time of the whole step, from y to u [s].
    iterations
        Iterations of all solvers; 0 where none ran.
    slack
        How far the plan breaks the soft limit, or the rate, that gives way most, in its own unit; 0 but for SOFTENED.
    solver
        Whose answer it is where several may solve a step: "osqp" or "daqp", the last asked where none had one.
    known
        Whether state and input lie where the data of the model were, and what came is what it predicted; None where
        the controller has no monitor.
    """

    u: Float[np.ndarray, " nu"]
    status: Status
    fallback: Fallback
    solve_time: float
    iterations: int
    slack: float = 0.0
    solver: str = ""
    known: bool | None = None


class WholeRun(NamedTuple):
    """The steps of a run that a controller has made at once: numbers of Status and Fallback, and the rest of a Move."""

    status: Int[np.ndarray, " T"]
    fallback: Int[np.ndarray, " T"]
    iterations: Int[np.ndarray, " T"]
    slack: Float[np.ndarray, " T"]
    solve_time: Float[np.ndarray, " T"]


@dataclass(frozen=True, eq=False)
class Plan(Value):
    """The plan behind a Move: X (N+1, nx) from the measured state on, U (N, nu) with U[0] the move."""

    X: Float[np.ndarray, "N1 nx"]
    U: Float[np.ndarray, "N nu"]


@runtime_checkable
class Fallible(Protocol):
    """A controller whose solver can be made to fail, to see what it does then."""

    solver_fails: bool
    """While True, the solver runs, but its answer is lost and the step is FAILED."""


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
    """Return the error of a thread that found another one inside."""
    name = type(controller).__name__
    return ThreadError(f"two threads entered one {name} at once; give each thread a copy: copy.copy(controller)")


def alone(method: TurnTaker) -> TurnTaker:
    """Return the method so that it raises ThreadError while another thread is in a method of the same object.

    Methods of one thread may call each other.
    """

    @wraps(method)
    def entered(self: Any, *arguments: Any, **options: Any) -> Any:
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

    return cast("TurnTaker", entered)
