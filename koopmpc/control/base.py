"""What predictive controllers share beside their step: names, a monitor, files and copies."""

import copy
from time import perf_counter
from typing import Any

from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.control.move import Move, Token
from koopmpc.control.plan.task import MoveBlocks
from koopmpc.control.plan.tracking import Tracking
from koopmpc.control.program import Published, Restored, SavedController
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.watching import StepWatch
from koopmpc.estimate.observer import Estimator, StateObserver
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.step_map import StepMap


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
    def _initial(self) -> InitialCondition:
        """Where the plan of a step starts."""
        raise NotImplementedError

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
    def from_data(cls: type[Restored], saved: SavedController) -> Restored:
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
