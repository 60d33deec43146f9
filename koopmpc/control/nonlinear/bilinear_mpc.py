"""BilinearMPC: real-time iteration on a bilinear predictor, or on any learned map, in the dimension of the state."""

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.base import MPCBase, PlanMemory, admitted, hard
from koopmpc.control.cost import Cost
from koopmpc.control.initial_condition import InitialCondition, Sizes, numbers
from koopmpc.control.limits import Limits, beyond, softened
from koopmpc.control.linear.horizon import blocked
from koopmpc.control.move import Move, Plan, Status
from koopmpc.control.nonlinear.iteration import SHORTEST, RealTimeIteration
from koopmpc.control.nonlinear.model import Source, learned_map
from koopmpc.control.nonlinear.stages import Changes, Direct
from koopmpc.control.nonlinear.terminal import Equilibria, Goal
from koopmpc.control.tracking import HUGE, outputs, reference_rows
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.measured import MeasuredState
from koopmpc.plants.step_map import StepMap

FIRST = 10  # passes of a first step, at most
SETTLED = 1e-6  # a first plan rests when no input and no state moves by more than this share of their size
GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)


class Ahead(NamedTuple):
    """A reference: its rows, the inputs that hold them and their slopes, which rows are the last, and its goal."""

    R: Float[np.ndarray, "N1 nr"]
    U: Float[np.ndarray, "N nu"]
    slopes: Float[np.ndarray, "N nu nx"]
    last: Bool[np.ndarray, " N"]
    goal: Goal


_HELD = ("_initial", "_memory", "_planned", "_warm", "_moved")  # what a copy takes over, with the plan


class BilinearMPC(MPCBase):
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, one linearisation a step.

    F is the predictor's re-lifted map x⁺ = C(A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)), so whatever the dictionary the problem
    has the dimension of x. Under an embedding x is the point ζ of the plant's state and its past, which the
    controller keeps: y, the cost, the limits and the disturbance are those of the plant's state.

    The controller keeps the planned states X_k as well as the inputs u_k and moves both on by one step. Each pass
    linearises at (X_k, u_k), with defects c_k = F(X_k, u_k) − X_{k+1} and δx_0 = x − X_0, and adds the solution of
    that quadratic program (Gauss–Newton in the tracked outputs), halved until F is near its linearisation along it.
    The inputs are never simulated over the horizon: on an unstable plant that multiplies the model's error a
    thousandfold, and a first plan along the free motion may end where no data were. A Riccati recursion solves the
    program; where its plan breaks a limit, an interior-point method whose steps are Riccati recursions. Where changes
    of the inputs count, or moves are blocked, they are its inputs, and the last input is part of the state.

    Parameters
    ----------
    predictor
        The lifted model; or a StepMap, learned or not.
    cost, limits
        As for KoopmanMPC; the observables are taken from their own liftings.
    horizon
        N steps of the model's dt.
    passes
        Linearisations a step. The first step starts from rest at x and may take up to ten.
    estimator
        A `LiftedDisturbance`: x⁺ = F(x, u) + d with d filtered from what F misses, so that no offset is left.
    latency, moves
        As for KoopmanMPC.
    time_limit
        Wall-clock time a step may take [s]. A pass that has not ended by then is given up for the fallback, and its
        plan is improved in the next step; what is late although it was found is used. Either way the status is
        TIME_LIMIT.

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon or passes below 1, an estimator that needs a linear predictor, or weights and limits that do not
        fit.

    References
    ----------
    Diehl, Bock & Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
    SIAM J. Control Optim. 43, 2005.
    """

    def __init__(
        self,
        predictor: Source,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        passes: int = 1,
        estimator: LiftedDisturbance | None = None,
        latency: int = 0,
        moves: int | Sequence[int] | None = None,
        time_limit: float | None = None,
    ) -> None:
        self._map = model = learned_map(predictor)
        super().__init__(predictor.dt, model.nu, cost, limits, horizon, latency, time_limit)
        self._passes = checks.count(passes, "passes")
        self._blocks = blocked(moves, self._N)
        self._outputs = o = outputs(predictor.states, model.nu, self.cost, self.limits, model.nx)
        self._with_rates = o.with_rates or len(self._blocks) < self._N
        self._staged = Changes(model.F, o, self._blocks) if self._with_rates else Direct(model.F, o, self._blocks)
        self._equilibria = Equilibria(model, self.cost, o, 10 * self._N)
        self._iteration = RealTimeIteration(self._staged.problem)
        self._iteration.theta[:] = model.theta
        self._hard_rates = hard(o.rates, o.rate_softness.linear)
        self._memory = PlanMemory(o.inputs, self._N, o.rates)
        self._estimator = estimator
        if estimator is not None:
            advice = "LiftedKalman filters a linear predictor's z; here y is the whole state"
            checks.kind(estimator, "estimator", LiftedDisturbance, advice)
        self._disturbed = estimator is not None or model.nw > 0
        self._initial = InitialCondition(
            model,
            MeasuredState(model) if estimator is None else estimator.watch(model),
            Sizes(model.nx, model.nu, model.nw, self._N),
            self._latency,
            with_rates=self._with_rates,
            estimated=estimator is not None,
            remembers=model.embedding is not None,
        )
        self._reference_key: bytes | None = None
        self._goal: Goal | None = None
        self._warm = False
        self.reset()

    def __reduce__(self) -> tuple[Callable[..., "BilinearMPC"], tuple[Any, ...], dict[str, Any]]:
        build = partial(
            BilinearMPC,
            passes=self._passes,
            estimator=self._estimator,
            latency=self._latency,
            moves=self._blocks,
            time_limit=self._time_limit,
        )
        held = {name: getattr(self, name) for name in _HELD}
        iteration = self._iteration
        held["plan"] = iteration.X.copy(), iteration.U.copy(), iteration.e.copy()
        return build, (self.predictor, self.cost, self.limits, self._N), held

    def __setstate__(self, held: dict[str, Any]) -> None:
        """Go on where the original was."""
        iteration = self._iteration
        iteration.X[:], iteration.U[:], iteration.e[:] = held.pop("plan")
        self.__dict__.update(held)
        self._goal, self._reference_key = None, None  # the next step aims anew

    @property
    def predictor(self) -> Source:
        """The model."""
        return self._map.source

    @property
    def step_map(self) -> StepMap:
        """The model as a map, x⁺ = F(x, u)."""
        source = self._map.source
        return source if isinstance(source, StepMap) else source.step_map()

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps; rates count from `u_prev`, which is held if the first step fails."""
        self._memory.reset(u_prev)
        self._initial.reset(x0, self._memory.last())
        self._planned = self._warm = self._moved = False
        self._goal, self._reference_key = None, None
        self._iteration.e[:] = 0.0

    def update(self, predictor: Source) -> None:
        """Go on with new A, B, N, C and E of the same lifting: the plan and the last input are kept.

        Raises
        ------
        DataError
            The predictor is of another kind, or has another lifting, dt, states, inputs or disturbances.
        """
        self._map = self._map.updated(predictor)
        self._iteration.theta[:] = self._map.theta
        self._equilibria.update(self._map)
        self._initial.update(self._map)
        self._initial.observer.update(self._map)
        self._reference_key = self._goal = None

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        if not self._planned:
            return None
        X, U = self._staged.plan(self._iteration.X, self._iteration.U)
        return Plan(X[:, : self._map.ny].copy(), U.copy())

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
    ) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        origin = self._initial
        origin.take(y, self._memory.last(), applied, w)
        x, u_prev = origin.z, self._known_input()
        target = numbers(reference, "reference")
        known = np.abs(x).max() < HUGE
        if known and self._disturbed:
            known = self._push()
        if not (known and self._aim(target)):
            return self._lose(applied, Status.BAD_MEASUREMENT, 0, start)
        s, conflict = self._staged.start(x, u_prev), False
        if self._with_rates:
            first, conflict = self._staged.first(u_prev)
            self._iteration.low[0, : self._nu], self._iteration.high[0, : self._nu] = first
        deadline = start + self._allowed
        status, iterations = Status.FAILED, 0
        if self._warm:
            self._move_on(u_prev)
            status, iterations = self._improve(s, u_prev, self._passes, deadline)
        if status not in GOOD and status is not Status.TIME_LIMIT:  # there is no plan, or it has lost the plant
            self._guess(x, u_prev)
            status, more = self._improve(s, u_prev, max(FIRST, self._passes), deadline)
            iterations += more
        if self.solver_fails:
            status = Status.FAILED
        if status not in GOOD:
            free = self._iteration.without_limits + (u_prev if self._with_rates else 0.0)
            return self._lose(applied, status, iterations, start, free)
        self._planned = self._warm = True
        U = self._staged.plan(self._iteration.X, self._iteration.U)[1].copy()
        if self._hard_rates is not None:
            U[0] = admitted(U[0], self._outputs.inputs, self._hard_rates, u_prev)
        self._memory.keep(U.ravel())
        slack = self._iteration.slack
        if conflict and self._hard_rates is not None:
            slack = max(slack, beyond(U[0] - u_prev, self._hard_rates))
        return self._move(U[0].copy(), Status.SOFTENED if conflict else status, iterations, start, slack)

    def _improve(
        self, s: Float[np.ndarray, " ns"], u_prev: Float[np.ndarray, " nu"], passes: int, deadline: float
    ) -> tuple[Status, int]:
        """Return how the last of these passes ended, and the iterations of all; they end early at a solution."""
        total, status, iteration = 0, Status.FAILED, self._iteration
        for k in range(passes):
            if k and perf_counter() > deadline:
                break  # what the passes before it found is used, and late
            found = iteration.step(s, deadline)
            total += found.iterations
            if found.status not in GOOD:
                return (status, total) if k and found.status is Status.TIME_LIMIT else (found.status, total)
            length = iteration.take(s, found)
            self._enter(*self._staged.plan(iteration.X, iteration.U), u_prev)
            iteration.slack = softened(found.slacks, iteration.soft_box)
            status = Status.SOFTENED if iteration.slack else found.status
            moved = (found.U, iteration.U), (found.X, iteration.X)
            if length < SHORTEST:
                status = Status.FAILED
            elif all(np.abs(d).max() <= SETTLED * (1 + np.abs(v).max()) for d, v in moved):
                break
        return status, total

    def _enter(
        self,
        X: Float[np.ndarray, "N1 nx"],
        U: Float[np.ndarray, "N nu"],
        u_prev: Float[np.ndarray, " nu"],
    ) -> None:
        """Make this the plan."""
        self._iteration.X[:], self._iteration.U[:] = self._staged.along(X, U, u_prev)

    def _guess(self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]) -> None:
        """Start a plan: rest at x. The free motion of a learned model may leave its data, and lead to a plan there."""
        u = np.clip(u_prev if self._with_rates else np.zeros(self._nu), *self._outputs.inputs)
        self._enter(np.tile(x, (self._N + 1, 1)), np.tile(u, (self._N, 1)), u_prev)

    def _move_on(self, u_prev: Float[np.ndarray, " nu"]) -> None:
        """Make the plan of the last step the start of this one; its last stage is one step of the model."""
        X, U = (part.copy() for part in self._staged.plan(self._iteration.X, self._iteration.U))
        X[:-1], U[:-1] = X[1:], U[1:]
        X[-1] = self._map.step(X[-2], U[-1]) + self._iteration.e[-1, : X.shape[1]]
        self._enter(X, U, u_prev)

    def _push(self) -> bool:
        """Hand e_k = E w_k + d to the iteration; False where it is not finite."""
        origin, e = self._initial, self._iteration.e[:, : self._map.nx]
        pushed = origin.W @ self._map.push.T
        if origin.d.size:
            pushed = pushed + origin.d
        if not np.abs(pushed).max() < HUGE:
            return False
        self._moved = self._moved or bool((pushed[-1] != e[-1]).any())
        e[:] = pushed
        return True

    def _aim(self, reference: Float[np.ndarray, "..."]) -> bool:
        """Hand the reference and its goals to the iteration; False where it is not finite."""
        key = reference.tobytes()
        if key == self._reference_key and not self._moved:
            return True
        if key != self._reference_key:
            R = reference_rows(self._previewed(reference), self._N, len(self._outputs.Q))
            self._reference_key = None
            if not np.isfinite(R).all():
                return False
            goals = [self._equilibria(row) for row in R]
            self._ahead = Ahead(
                R,
                np.array([goal.u for goal in goals[:-1]]),
                np.array([goal.slope for goal in goals[:-1]]),
                (R[:-1] == R[-1]).all(axis=1),
                goals[-1],
            )
            self._reference_key = key
        R, U_r, slopes, last, goal = self._ahead
        if self._disturbed:  # the last disturbance of the preview stays
            e = self._iteration.e[-1, : self._map.nx]
            goal = self._goal = self._equilibria.pushed(R[-1], e, self._goal)
            U_r = np.clip(U_r + slopes @ e, *self._outputs.inputs)
            U_r[last] = goal.u
        self._iteration.aim(self._staged.aim(R[1:], U_r, goal))
        self._moved = False
        return True

    def _lose(
        self,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
        free: Float[np.ndarray, " nu"] | None = None,
    ) -> Move:
        """Return what stands in for a failed step; the next one starts anew, unless there was no time."""
        self._warm = status is Status.TIME_LIMIT
        known = free is not None and bool((np.abs(free) < HUGE).all())
        return self._fail(free if known else None, applied, status, iterations, start)
