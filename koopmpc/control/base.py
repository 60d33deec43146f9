"""What predictive controllers share beside their step: names, files, copies; the base of those that plan in stages."""

import copy
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Interval, Value
from koopmpc.control.ask.levels import HeldLevels
from koopmpc.control.move import Fallback, Move, PlanMemory, Status, Token
from koopmpc.control.plan.task import MoveBlocks
from koopmpc.control.plan.tracking import Tracking
from koopmpc.control.program import Published, SavedController
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.watching import StepMonitor, StepWatch
from koopmpc.estimate.observer import Estimator, StateModel, StateObserver
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.step_map import StepMap

_Restored = TypeVar("_Restored")  # a class of controller that is made again of its data


class PredictiveController(Published):
    """What predictive controllers have in common beside their step: names, a monitor, files, copies.

    One thread at a time may call one: a second one gets a ThreadError. Give each thread a copy of its own.

    Parameters
    ----------
    dt
        Sampling time [s].
    tracking
        The tracked and limited outputs, with their weights and limits.
    moves, latency
        The blocks of held inputs, and steps until an input acts.
    estimator, time_limit
        The rule that finds z and d, None where y is the state; wall-clock time of a step [s].
    watch
        Says of each step whether the model knows it; None without a monitor.
    """

    _initial: InitialCondition

    def __init__(
        self,
        dt: float,
        tracking: Tracking[Any],
        moves: MoveBlocks,
        latency: int,
        estimator: Estimator | None,
        time_limit: float | None,
        watch: StepWatch | None,
    ) -> None:
        self.cost, self.limits = tracking.cost, tracking.limits
        self.dt, self.nu = dt, len(tracking.inputs.low)
        self._moves, self._latency = moves, checks.count(latency, "latency", 0)
        self.horizon = sum(moves.lengths) + self._latency  # steps of preview
        self._time_limit = None if time_limit is None else checks.positive(time_limit, "time_limit", "s")
        self._estimator, self._watch = estimator, watch
        self._token: Token = [0]
        self._inside = 0

    @property
    def latency(self) -> int:
        """Steps until an input that is computed now acts."""
        return self._latency

    @property
    def watch(self) -> StepWatch | None:
        """The monitor's answer on the last step; None without a monitor."""
        return self._watch

    @property
    def observer(self) -> StateObserver:
        """The estimate now: its z, and its disturbance d."""
        return self._initial.observer

    def __copy__(self) -> "PredictiveController":
        """Return a copy that shares no state with this one."""
        return copy.deepcopy(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._token, self._inside = [0], 0  # another thread may hold the token of the original

    def as_data(self) -> SavedController:
        """Return what the controller was made of.

        Raises
        ------
        DataError
            Its model is a StepMap, whose equations are code, or its estimator is no class of koopmpc.
        """
        kind, model, options = self._made_of()
        if isinstance(model, StepMap):
            raise DataError("the controller's model is a StepMap, which is code and cannot be saved; fit a predictor")
        if not isinstance(self._estimator, Value | None):
            raise DataError(
                f"{checks.article(self._estimator)} is not an estimator of koopmpc and cannot be saved as data"
            )
        return SavedController(
            kind,
            model,
            self.cost,
            self.limits,
            sum(self._moves.lengths),
            self._estimator,
            self._latency,
            self._moves.given,
            self._time_limit,
            options,
            None if self._watch is None else self._watch.monitor,
        )

    def _made_of(self) -> tuple[str, LinearPredictor | BilinearPredictor | StepMap, dict[str, Any]]:
        """Return the class, the model, and the arguments that only this class has."""
        raise NotImplementedError

    @classmethod
    def from_data(cls: type[_Restored], saved: SavedController) -> _Restored:
        """Return the controller that is made of these data."""
        build: Any = cls
        return build(
            saved.model,
            saved.cost,
            saved.limits,
            saved.horizon,
            estimator=saved.estimator,
            latency=saved.latency,
            moves=saved.moves,
            time_limit=saved.time_limit,
            monitor=saved.monitor,
            **saved.options,
        )

    def _judge_step(self, watch: StepWatch, move: Move, applied: ArrayLike | None, start: float) -> Move:
        """Return the move with `known` set: whether the model knows this step."""
        move.known = watch.look(self._initial, move.u, applied)
        move.solve_time = perf_counter() - start
        return move


class MPCBase(PredictiveController):
    """A controller that plans stage by stage, of an input that acts `latency` steps after it was computed.

    A subclass calls `_keep` with every good plan, ends a step with `_move` or `_fail`, and returns in `_made_of` the
    data for `save`.

    Parameters
    ----------
    dt
        Sampling time [s].
    model
        The model of the plan.
    tracking
        The tracked and limited outputs, with their weights and limits.
    moves
        N steps, and which of them hold their inputs; a plan has an input for each step, with a change of 0 in held
        ones.
    observer, estimator
        The observer of this controller, and the rule that started it, None where y is the state.
    latency
        Steps until the first input of a plan acts.
    time_limit
        Wall-clock time of a step [s].
    monitor
        Says of each step whether the model knows it; None without a monitor.
    """

    solver_fails = False  # fault injection sets it, see control.move.Fallible

    def __init__(
        self,
        dt: float,
        model: StateModel,
        tracking: Tracking[Any],
        moves: MoveBlocks,
        observer: StateObserver,
        estimator: Estimator | None,
        latency: int,
        time_limit: float | None,
        *,
        monitor: StepMonitor | None = None,
    ) -> None:
        watch = None if monitor is None else monitor.watch(model, checks.count(latency, "latency", 0))
        super().__init__(dt, tracking, moves, latency, estimator, time_limit, watch)
        self._inputs, self._rates, self._hard_rates = tracking.inputs, tracking.rates, tracking.hard_rates
        self._blocks, self._N = moves.lengths, sum(moves.lengths)
        self._with_rates = tracking.with_rates or len(self._blocks) < self._N or moves.own
        self._allowed = np.inf if self._time_limit is None else self._time_limit
        self._initial = InitialCondition(
            model, observer, self._N, self._latency, with_rates=self._with_rates, estimated=estimator is not None
        )
        levels = tracking.levels
        self._held = None if levels is None else HeldLevels(levels)
        self._memory = PlanMemory(self.nu, np.arange(self._N), self._held, self._latency, self._allowed)
        MPCBase.reset(self)

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit; a filter starts at x0 (nx,), by default at zero.

        Rates count from `u_prev`, zero moved inside the limits by default; it is held if the first step fails.

        Raises
        ------
        DataError
            x0 or u_prev is of another length, or holds what is no finite number; pass None where it is not known.
        """
        self._memory.reset(u_prev, self._present_limits()[0])
        self._initial.reset(x0, self._memory.given)
        if self._watch is not None:
            self._watch.reset()

    @property
    def _planned(self) -> bool:
        """Whether the last step had a plan."""
        return self._memory.is_planned

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        """Return the box of the next input and that of its change; a subclass knows where they move in time."""
        return self._inputs, self._rates

    def _keep(self, plan: Float[np.ndarray, " nv"]) -> None:
        """Keep a good plan (by reference, for speed); its first entries are the moves."""
        self._memory.keep(plan, plan[: self.nu])

    def _move(
        self, u: Float[np.ndarray, " nu"], status: Status, iterations: int, start: float, slack: float = 0.0
    ) -> Move:
        """Return a good step; a late one says so."""
        status, taken = self._memory.judge_time(status, start)
        return Move(u, status, Fallback.NONE, taken, iterations, slack)

    def _fail(
        self,
        free: Float[np.ndarray, " nu"] | None,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
    ) -> Move:
        """Return the move that replaces a failed step; see `PlanMemory`."""
        return self._memory.fall_back(status, start, applied, self._present_limits(), free, iterations)
