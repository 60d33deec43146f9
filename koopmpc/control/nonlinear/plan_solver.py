"""What a step asks of what solves it: the plan from a start, on a nonlinear map."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.learned_map import LearnedMap
from koopmpc.control.nonlinear.problem import StageTargets

GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)


class PlanStart(NamedTuple):
    """Where the plan of a step starts, and what it is asked for.

    Attributes
    ----------
    s, u_prev
        s_0, and the input before the plan.
    first, conflict
        Limits of v_0, and whether rates were widened for those of u.
    box
        Limits of the inputs, (nu,) or a row a stage.
    targets, rest
        What the stages track, and the state at which the plan should end.
    e, W
        (N, nx) disturbances of x, and (N, nw) the measured ones.
    warm, deadline
        Whether the last step had a plan, and when to stop [s of `perf_counter`].
    """

    s: Float[np.ndarray, " ns"]
    u_prev: Float[np.ndarray, " nu"]
    first: Interval
    conflict: bool
    box: Interval
    targets: StageTargets
    rest: Float[np.ndarray, " nx"]
    e: Float[np.ndarray, "N nx"]
    W: Float[np.ndarray, "N nw"]
    warm: bool
    deadline: float


class StagePlan(NamedTuple):
    """The plan of a step in the s and v of its stages, how it was found, and the soft limit's violation.

    `free` is the first input of the program without limits, where it is known.
    """

    S: Float[np.ndarray, "N1 ns"]
    V: Float[np.ndarray, "N nu"]
    status: Status
    iterations: int
    slack: float = 0.0
    free: Float[np.ndarray, " nu"] | None = None


class PlanSolver(ABC):
    """What finds the plan of a step, and keeps what the next step starts from."""

    @abstractmethod
    def solve(self, start: PlanStart) -> StagePlan:
        """Return the plan from a start."""

    @abstractmethod
    def go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        """Make this the plan from which the next step starts."""

    @abstractmethod
    def limit(self, stages: Interval) -> None:
        """Take over the limits (N, n) of [v_k; limited(s_{k+1})]."""

    @abstractmethod
    def weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Take over the diagonals that weigh the tracked outputs of s_1 … s_N, and v_0 … v_{N−1} without rates."""

    @abstractmethod
    def update(self, model: LearnedMap) -> None:
        """Go on with another θ."""
