"""NonlinearMPC: multiple shooting and a nonlinear program a step; the oracle that others are measured against."""

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.equilibrium import Equilibria
from koopmpc.control.fallback import PlanMemory
from koopmpc.control.lifted import reference_rows
from koopmpc.control.limits import Box, Limits, softened
from koopmpc.control.move import Fallback, Move, Plan, Status
from koopmpc.control.outputs import outputs
from koopmpc.control.shooting import Aim, Shooting, Solver, Start
from koopmpc.errors import DataError
from koopmpc.plant.step_map import StepMap

_HELD = 5  # steps for which a random guess holds an input
_WIDE = 1.0  # what stands for an input limit where there is none


class NonlinearMPC:
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, by multiple shooting.

    The states x_1 … x_N and the inputs u_0 … u_{N−1} are the variables and F the constraints. Every step starts
    from the last solution moved on by one step, multipliers included. Without a Q_N the terminal weight is the
    Riccati solution of the linearisation at the equilibrium that holds the last reference row. It finds a local
    optimum, as every method of its kind.

    Parameters
    ----------
    step_map
        The model.
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

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon below 1, or weights and limits that do not fit.

    References
    ----------
    Wächter & Biegler, "On the implementation of an interior-point filter line-search algorithm for large-scale
    nonlinear programming", Math. Prog. 106, 2006.
    """

    solver_fails = False  # set by fault injection alone, see control.move.Fallible

    def __init__(
        self,
        step_map: StepMap,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        solver: Solver = "ipopt",
        starts: int = 1,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self._N = checks.count(horizon, "horizon")
        if solver not in ("ipopt", "fatrop", "sqpmethod"):
            raise DataError(f'solver is {solver!r}; pass "ipopt", "fatrop" or "sqpmethod"')
        self.step_map, self.cost = step_map, cost
        self.limits = Limits() if limits is None else limits
        self._outputs = outputs(step_map, cost, self.limits)
        soft = np.isfinite(self._outputs.softness.linear)
        self._soft = Box(*(end[soft] for end in self._outputs.box))
        self._equilibria = Equilibria(step_map, cost, self._outputs, 10 * self._N)
        self._shooting = Shooting(step_map, self._outputs, self._N, solver, settings or {})
        self._starts = checks.count(starts, "starts")
        self._memory = PlanMemory(self._outputs.inputs, self._N)
        self._warm: Start | None = None
        self._plan: Plan | None = None

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.step_map.dt

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.step_map.nu

    @property
    def horizon(self) -> int:
        """Steps N of the plan."""
        return self._N

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget the last plan; `u_prev` is held if the first step fails."""
        self._memory.reset(u_prev)
        self._warm = self._plan = None

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        return self._plan

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        x0 = checks.array(y, "y", (self.step_map.nx,), finite=False)
        R = reference_rows(np.asarray(reference, dtype=np.float64), self._N, len(self._outputs.Q))
        if not (np.isfinite(x0).all() and np.isfinite(R).all()):
            return self._fail(applied, Status.BAD_MEASUREMENT, 0, start)
        goals = [self._equilibria(row) for row in R]
        aim = Aim(R[1:], np.array([goal.u for goal in goals[:-1]]), goals[-1])
        begin = self._first(x0) if self._warm is None else [self._warm]
        solved = [self._shooting.solve(x0, aim, each) for each in begin]
        iterations = sum(horizon.iterations for horizon, _ in solved)
        if self.solver_fails:
            return self._fail(applied, Status.FAILED, iterations, start)
        good = [each for each in solved if each[0].status is Status.OPTIMAL]
        if not good:
            return self._fail(applied, solved[0][0].status, iterations, start)
        found, self._warm = min(good, key=lambda each: each[0].cost)
        U = np.clip(found.U, *self._outputs.inputs)
        self._memory.keep(U.ravel())
        self._plan = Plan(np.vstack([x0, found.X]), U.copy())
        status = Status.SOFTENED if softened(found.slacks, self._soft) else Status.OPTIMAL
        return Move(U[0].copy(), status, Fallback.NONE, perf_counter() - start, iterations)

    def _fail(self, applied: ArrayLike | None, status: Status, iterations: int, start: float) -> Move:
        self._warm = self._plan = None
        u, fallback = self._memory.instead(None, applied)
        return Move(u, status, fallback, perf_counter() - start, iterations)

    def _first(self, x0: Float[np.ndarray, " nx"]) -> list[Start]:
        """Return the guesses of a first step: rest at x_0, then where random held inputs lead."""
        N, inputs = self._N, self._outputs.inputs
        rest = np.clip(np.zeros(self.nu), *inputs)
        guesses = [self._shooting.at(np.tile(x0, (N, 1)), np.tile(rest, (N, 1)))]
        rng = np.random.default_rng(0)
        low, high = np.maximum(inputs.low, rest - _WIDE), np.minimum(inputs.high, rest + _WIDE)
        for _ in range(self._starts - 1):
            U = np.repeat(rng.uniform(low, high, (-(-N // _HELD), self.nu)), _HELD, axis=0)[:N]
            X = self.step_map.rollout(x0, U)[1:]
            if np.isfinite(X).all():
                guesses.append(self._shooting.at(X, U))
        return guesses
