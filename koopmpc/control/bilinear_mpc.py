"""BilinearMPC: real-time iteration on a bilinear predictor, or on any learned map, in the dimension of the state."""

from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.equilibrium import Equilibria
from koopmpc.control.fallback import PlanMemory
from koopmpc.control.lifted import HUGE, reference_rows
from koopmpc.control.limits import Box, Limits, softened
from koopmpc.control.move import Fallback, Move, Plan, Status
from koopmpc.control.outputs import outputs
from koopmpc.control.rti import SHORTEST, RealTimeIteration
from koopmpc.errors import ShapeError
from koopmpc.plant.step_map import StepMap
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor

FIRST = 10  # passes of a first step, at most
SETTLED = 1e-6  # a first plan rests when no input moves by more than this share of its size
GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)


class BilinearMPC:
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, one linearisation a step.

    F is the predictor's re-lifted map x⁺ = C(A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)), so whatever the dictionary the problem
    has the dimension of x. The controller keeps the planned states X_k as well as the inputs u_k and moves both on by
    one step. Each pass linearises at (X_k, u_k), with defects c_k = F(X_k, u_k) − X_{k+1} and δx_0 = x − X_0, and
    adds the solution of that quadratic program (Gauss–Newton in the tracked outputs), halved until F is
    near its linearisation along it. The inputs are never simulated over the horizon, save for a first plan, the free
    motion: on an unstable plant that multiplies the model's error a thousandfold. A Riccati recursion solves the
    program; where its plan breaks a limit, an interior-point method whose steps are Riccati recursions.

    Parameters
    ----------
    predictor
        The lifted model; or a StepMap, learned or not.
    cost, limits
        As for KoopmanMPC; the observables are taken from their own liftings.
    horizon
        N steps of the model's dt.
    passes
        Linearisations a step. The first step starts from rest at x and may take up to thirty.

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon or passes below 1, or weights and limits that do not fit.

    References
    ----------
    Diehl, Bock & Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
    SIAM J. Control Optim. 43, 2005.
    """

    solver_fails = False  # set by fault injection alone, see control.move.Fallible

    def __init__(
        self,
        predictor: BilinearPredictor | LinearPredictor | StepMap,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        passes: int = 1,
    ) -> None:
        self.predictor, self.cost = predictor, cost
        self.limits = Limits() if limits is None else limits
        self.step_map = predictor if isinstance(predictor, StepMap) else predictor.step_map()
        self._N = checks.count(horizon, "horizon")
        self._passes = checks.count(passes, "passes")
        self._outputs = outputs(self.step_map, cost, self.limits)
        self._equilibria = Equilibria(self.step_map, cost, self._outputs, 10 * self._N)
        self._iteration = RealTimeIteration(self.step_map, self._outputs, self._N)
        s = self._iteration.soft_rows
        self._soft_box = Box(self._outputs.box.low[s], self._outputs.box.high[s])
        self._memory = PlanMemory(self._outputs.inputs, self._N)
        self._reference_key: bytes | None = None
        self._planned = False
        self.reset()

    def __reduce__(self) -> tuple[Callable[..., "BilinearMPC"], tuple[Any, ...]]:
        build = partial(BilinearMPC, passes=self._passes)
        return build, (self.predictor, self.cost, self.limits, self._N)

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
        """Forget the plan; `u_prev` is held if the first step fails."""
        self._memory.reset(u_prev)
        self._planned = False

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        if not self._planned:
            return None
        return Plan(self._iteration.X.copy(), self._iteration.U.copy())

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        x = np.asarray(y, dtype=np.float64)
        if x.shape != (self.step_map.nx,):
            raise ShapeError(f"y has shape {x.shape}, expected ({self.step_map.nx},), one value a state")
        target = np.asarray(reference, dtype=np.float64)
        key = target.tobytes()
        known = key == self._reference_key or self._aim(target, key)
        if not known or not np.abs(x).max() < HUGE:
            return self._fail(applied, Status.BAD_MEASUREMENT, 0, start)
        status, iterations = Status.FAILED, 0
        if self._planned:
            self._move_on()
            status, iterations = self._improve(x, self._passes)
        if status not in GOOD:  # there is no plan, or it has lost the plant
            self._guess(x)
            status, more = self._improve(x, max(FIRST, self._passes))
            iterations += more
        if self.solver_fails:
            status = Status.FAILED
        if status not in GOOD:
            return self._fail(applied, status, iterations, start)
        self._planned = True
        U = self._iteration.U.copy()
        self._memory.keep(U.ravel())
        return Move(U[0].copy(), status, Fallback.NONE, perf_counter() - start, iterations)

    def _improve(self, x: Float[np.ndarray, " nx"], passes: int) -> tuple[Status, int]:
        """Return how the last of these passes ended, and the iterations of all; they end early at a solution."""
        total, status = 0, Status.FAILED
        for _ in range(passes):
            found = self._iteration.step(x)
            total += found.iterations
            if found.status not in GOOD:
                return found.status, total
            length = self._iteration.take(x, found)
            status = Status.SOFTENED if softened(found.slacks, self._soft_box) else found.status
            if length < SHORTEST:
                status = Status.FAILED
            elif np.abs(found.U).max() <= SETTLED * (1 + np.abs(self._iteration.U).max()):
                break
        return status, total

    def _guess(self, x: Float[np.ndarray, " nx"]) -> None:
        """Start a plan: the free motion of the model from x, or rest at x where that leaves the finite numbers."""
        X, U = self._iteration.X, self._iteration.U
        U[:] = np.clip(0.0, *self._outputs.inputs)
        X[:] = self.step_map.rollout(x, U)
        if not np.abs(X).max() < HUGE:
            X[:] = x

    def _move_on(self) -> None:
        """Make the plan of the last step the start of this one; its last stage is one step of the model."""
        X, U = self._iteration.X, self._iteration.U
        X[:-1], U[:-1] = X[1:], U[1:]
        X[-1] = self.step_map(X[-2], U[-1])

    def _aim(self, reference: Float[np.ndarray, "..."], key: bytes) -> bool:
        """Hand the reference and its goals to the iteration; False where it is not finite."""
        R = reference_rows(reference, self._N, len(self._outputs.Q))
        self._reference_key = None
        if not np.isfinite(R).all():
            return False
        goals = [self._equilibria(row) for row in R]
        self._iteration.aim(R[1:], np.array([goal.u for goal in goals[:-1]]), goals[-1])
        self._reference_key = key
        return True

    def _fail(self, applied: ArrayLike | None, status: Status, iterations: int, start: float) -> Move:
        """Return what stands in for a failed step; the next one starts anew."""
        self._planned = False
        u, fallback = self._memory.instead(None, applied)
        return Move(u, status, fallback, perf_counter() - start, iterations)
