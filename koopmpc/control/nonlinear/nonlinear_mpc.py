"""NonlinearMPC: multiple shooting and a nonlinear program a step; the oracle that others are measured against."""

import pickle
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.base import MPCBase, PlanMemory, admitted, hard
from koopmpc.control.cost import Cost
from koopmpc.control.initial_condition import InitialCondition, Sizes, numbers
from koopmpc.control.limits import Interval, Limits, beyond, softened
from koopmpc.control.linear.horizon import blocked
from koopmpc.control.move import Move, Plan, Status
from koopmpc.control.nonlinear.model import Source, learned_map
from koopmpc.control.nonlinear.shooting import Shooting, Solver, Start
from koopmpc.control.nonlinear.stages import Changes, Direct
from koopmpc.control.nonlinear.terminal import Equilibria
from koopmpc.control.tracking import outputs, reference_rows
from koopmpc.errors import DataError
from koopmpc.estimate.measured import MeasuredState
from koopmpc.lifting.buffered import HUGE
from koopmpc.plants.step_map import StepMap

_HELD = 5  # steps for which a random guess holds an input
_WIDE = 1.0  # what stands for an input limit where there is none


class NonlinearMPC(MPCBase):
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, by multiple shooting.

    The states x_1 … x_N and the inputs u_0 … u_{N−1} are the variables and F the constraints; where changes of the
    inputs count they are the variables. Every step starts from the last solution moved on by one step, multipliers
    included. Without a Q_N the terminal weight is the Riccati solution of the linearisation at the equilibrium that
    holds the last reference row. It finds a local optimum, as every method of its kind.

    Parameters
    ----------
    step_map
        The model; a predictor stands for its re-lifted `step_map()`, and where it has an embedding y is the plant's
        state and the controller keeps the past.
    cost, limits
        As for KoopmanMPC; the observables are taken from their own liftings.
    horizon
        N steps of the model's dt.
    solver
        "ipopt"; "fatrop", an interior point method that uses the stages; "sqpmethod", sequential quadratic programs
        solved by qrqp.
    starts
        Solve the first step, and one after a failure, from this many guesses, rest at x_0 and random inputs, and
        keep the best: several where this controller is the oracle, so that a local optimum is not the reference.
    settings
        The solver's own settings by CasADi's names, for example ``{"ipopt.tol": 1e-10}``.
    latency, moves
        As for KoopmanMPC.
    time_limit
        Wall-clock time a step may take [s]. Ipopt stops at it, and a fallback stands in; the other solvers know no
        such limit. What is late although it was solved is used. Either way the status is TIME_LIMIT.

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon below 1, settings that the solver does not know, or weights and limits that do not fit.

    References
    ----------
    Wächter & Biegler, "On the implementation of an interior-point filter line-search algorithm for large-scale
    nonlinear programming", Math. Prog. 106, 2006.
    """

    def __init__(
        self,
        step_map: Source,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        solver: Solver = "ipopt",
        starts: int = 1,
        settings: Mapping[str, Any] | None = None,
        latency: int = 0,
        moves: int | Sequence[int] | None = None,
        time_limit: float | None = None,
    ) -> None:
        model = learned_map(step_map, "step_map").fixed()
        super().__init__(step_map.dt, model.nu, cost, limits, horizon, latency, time_limit)
        if solver not in ("ipopt", "fatrop", "sqpmethod"):
            raise DataError(f'solver is {solver!r}; pass "ipopt", "fatrop" or "sqpmethod"')
        self.step_map = step_map if isinstance(step_map, StepMap) else step_map.step_map()
        self._ny, blocks = model.ny, blocked(moves, self._N)
        self._outputs = o = outputs(step_map.states, model.nu, self.cost, self.limits, model.nx)
        with_rates = o.with_rates or len(blocks) < self._N
        self._staged = Changes(model.F, o, blocks) if with_rates else Direct(model.F, o, blocks)
        problem = self._staged.problem
        soft = np.isfinite(problem.softness.linear)
        self._soft = Interval(*(end[soft] for end in problem.box))
        self._equilibria = Equilibria(model, self.cost, o, 10 * self._N)
        given = dict(settings or {})
        if solver == "ipopt" and time_limit is not None:
            given = {"ipopt.max_wall_time": self._allowed} | given
        self._shooting = Shooting(problem, solver, given)
        self._starts = checks.count(starts, "starts")
        self._memory = PlanMemory(o.inputs, self._N, o.rates)
        self._hard_rates = hard(o.rates, o.rate_softness.linear)
        observer, sizes = MeasuredState(model), Sizes(model.nx, self._nu, 0, self._N)
        self._initial = InitialCondition(
            model,
            observer,
            sizes,
            self._latency,
            with_rates=with_rates,
            estimated=False,
            remembers=model.embedding is not None,
        )
        self._warm: Start | None = None
        self._plan: Plan | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> "NonlinearMPC":
        """Return a copy with solvers of its own: CasADi's copies share one, and two threads in one end the process."""
        return pickle.loads(pickle.dumps(self))

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget the last plan; rates count from `u_prev`, which is held if the first step fails."""
        self._memory.reset(u_prev)
        self._initial.reset(x0, self._memory.last())
        self._warm = self._plan = None

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        return self._plan

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        self._initial.take(y, self._memory.last(), applied, None)
        x0, u_prev = self._initial.z, self._known_input()
        target = self._previewed(numbers(reference, "reference"))
        R = reference_rows(target, self._N, len(self._outputs.Q))
        self._plan = None
        if not (np.abs(x0).max() < HUGE and np.isfinite(R).all()):
            return self._lose(applied, Status.BAD_MEASUREMENT, 0, start)
        goals = [self._equilibria(row) for row in R]
        aim = self._staged.aim(R[1:], np.array([goal.u for goal in goals[:-1]]), goals[-1])
        begin = self._first(x0, u_prev) if self._warm is None else [self._warm]
        first, conflict = self._staged.first(u_prev)
        s0 = self._staged.start(x0, u_prev)
        solved = [self._shooting.solve(s0, aim, each, first) for each in begin]
        iterations = sum(horizon.iterations for horizon, _ in solved)
        if self.solver_fails:
            return self._lose(applied, Status.FAILED, iterations, start)
        good = [each for each in solved if each[0].status is Status.OPTIMAL]
        if not good:
            return self._lose(applied, solved[0][0].status, iterations, start)
        found, self._warm = min(good, key=lambda each: each[0].cost)
        X, U = self._staged.plan(np.vstack([s0, found.X]), found.U)
        U = np.clip(U, *self._outputs.inputs)
        if self._hard_rates is not None:
            U[0] = admitted(U[0], self._outputs.inputs, self._hard_rates, u_prev)
        self._memory.keep(U.ravel())
        self._plan = Plan(X[:, : self._ny].copy(), U.copy())
        slack = softened(found.slacks, self._soft)
        if conflict and self._hard_rates is not None:
            slack = max(slack, beyond(U[0] - u_prev, self._hard_rates))
        soft = conflict or slack > 0
        return self._move(U[0].copy(), Status.SOFTENED if soft else Status.OPTIMAL, iterations, start, slack)

    def _lose(self, applied: ArrayLike | None, status: Status, iterations: int, start: float) -> Move:
        self._warm = None
        return self._fail(None, applied, status, iterations, start)

    def _first(self, x0: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]) -> list[Start]:
        """Return the guesses of a first step: rest at x_0, then where random held inputs lead."""
        N, inputs = self._N, self._outputs.inputs
        rest = np.clip(np.zeros(self.nu), *inputs)
        guesses = [(np.tile(x0, (N + 1, 1)), np.tile(rest, (N, 1)))]
        rng = np.random.default_rng(0)
        low, high = np.maximum(inputs.low, rest - _WIDE), np.minimum(inputs.high, rest + _WIDE)
        for _ in range(self._starts - 1):
            U = np.repeat(rng.uniform(low, high, (-(-N // _HELD), self.nu)), _HELD, axis=0)[:N]
            X = self.step_map.rollout(x0, U)
            if np.isfinite(X).all():
                guesses.append((X, U))
        along = [self._staged.along(X, U, u_prev) for X, U in guesses]
        return [self._shooting.at(S[1:], V) for S, V in along]
