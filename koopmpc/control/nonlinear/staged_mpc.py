"""What BilinearMPC and NonlinearMPC share: a `StagedTask` and the `StagedStep` that follows its plans."""

import copy
import io
import pickle
from dataclasses import replace
from time import perf_counter
from typing import Any

from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.base import PredictiveController
from koopmpc.control.move import Move, Plan, alone
from koopmpc.control.nonlinear.stages import ModelOrMap
from koopmpc.control.nonlinear.task import StagedTask, read_staged_task
from koopmpc.control.plan.task import Moves
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.step.staged import PlanSolver, StagedStep
from koopmpc.control.watching import StepMonitor, find_monitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.observer import Estimator, start_observer
from koopmpc.plants.step_map import StepMap


class StagedMPC(PredictiveController):
    """An MPC on x⁺ = F(x, u) + E w + d, whose solver works stage by stage; parameters as in `BilinearMPC`."""

    def __init__(
        self,
        model: ModelOrMap,
        cost: Cost,
        limits: Limits | None,
        horizon: int,
        moves: Moves,
        estimator: Estimator | None,
        latency: int,
        time_limit: float | None,
        monitor: StepMonitor | Episodes | None,
    ) -> None:
        task = read_staged_task(
            model, cost, limits, horizon, moves, latency, estimator, time_limit, checks.article(self)
        )
        observer = start_observer(estimator, task.map, task.N)
        watch = None if monitor is None else find_monitor(monitor, model).watch(task.map, task.latency)
        super().__init__(model.dt, task.outputs, task.moves, latency, estimator, time_limit, watch)
        self._task, self._step = task, StagedStep(task, observer, self._make_solver)
        self._step.reset(None, None)

    def _make_solver(self, task: StagedTask, levels: LevelSearch | None) -> PlanSolver:
        """Return what finds the plans of a step."""
        raise NotImplementedError

    def __deepcopy__(self, memo: dict[int, Any]) -> "StagedMPC":
        """Return a copy with solvers of its own: CasADi's copies share one, and two threads in one end the process.

        An estimator of the user's own, and its observer, are copied by deepcopy: their classes may be local.
        """
        candidates = (part for part in (self._estimator, self.observer) if part is not None)
        parts = {id(part): part for part in candidates if not type(part).__module__.startswith("koopmpc.")}
        stream = io.BytesIO()
        pickler, unpickler = pickle.Pickler(stream), pickle.Unpickler(stream)
        pickler.persistent_id = lambda obj: id(obj) if id(obj) in parts else None
        pickler.dump(self)
        copies = copy.deepcopy(parts, memo)
        stream.seek(0)
        unpickler.persistent_load = copies.__getitem__
        return unpickler.load()

    @property
    def _initial(self) -> InitialCondition:
        return self._step.initial

    @property
    def model(self) -> ModelOrMap:
        """The model as it was given."""
        return self._task.map.model

    @property
    def step_map(self) -> StepMap:
        """The model as a map, x⁺ = F(x, u)."""
        return self.model if isinstance(self.model, StepMap) else self.model.step_map()

    @property
    def solver_fails(self) -> bool:
        """While it is True, the answer of the solver is dropped and the step is FAILED; see `Fallible`."""
        return self._step.fails

    @solver_fails.setter
    def solver_fails(self, fails: bool) -> None:
        self._step.fails = fails

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit; a filter starts at x0 (nx,), by default at zero.

        Rates count from `u_prev`, zero moved inside the limits by default; it is held if the first step fails.

        Raises
        ------
        DataError
            x0 or u_prev is of another length, or holds what is no finite number; pass None where it is not known.
        """
        self._step.reset(x0, u_prev)
        if self._watch is not None:
            self._watch.reset()

    @alone
    def update(self, model: ModelOrMap) -> None:
        """Go on with new A, B, N, C and E of the same lifting: the plan and the last input are kept.

        Raises
        ------
        DataError
            The model is of another kind, has another lifting, dt, states, inputs or disturbances, or is a StepMap.
        """
        self._task = replace(self._task, map=self._task.map.replace_model(model))
        self._step.update(self._task)
        if self._watch is not None:
            self._watch.update(self._task.map)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        step = self._step
        return Plan(step.X[:, : self._task.map.ny].copy(), step.U.copy()) if step.memory.is_planned else None

    @alone
    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        limits: Limits | None = None,
    ) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        called = None if limits is None else self._step.bounds.at_call(limits)
        move = self._step(y, reference, applied, w, called, start=start)
        return move if self._watch is None else self._judge_step(self._watch, move, applied, start)

    def read_limits(self, limits: Limits) -> Limits:
        """Return the limits of a call with arrays in place of names.

        Raises
        ------
        DataError
            They differ from the controller's own in more than bounds.
        """
        return self._step.bounds.read(limits)

    def check_limits(self, limits: Limits) -> None:
        """Raise where limits of a call cross, have no row in the stages, or too few rows."""
        self._step.bounds.check(limits)
