"""KoopmanMPC: the Riccati solution first, a QP only where a limit is active."""

from collections.abc import Mapping
from time import perf_counter
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.condense import Stage, condense
from koopmpc.control.cost import Cost
from koopmpc.control.fallback import PlanMemory
from koopmpc.control.lifted import HUGE, Tracking, buffered, reference_rows, tracking
from koopmpc.control.limits import Limits, softened
from koopmpc.control.move import Fallback, Move, Plan, Status
from koopmpc.control.program import program
from koopmpc.control.riccati import recursion, stationary
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.state import State
from koopmpc.plant.step_map import StepMap
from koopmpc.predict.linear import LinearPredictor


class KoopmanMPC:
    """Minimise the Cost over N steps of z⁺ = A z + B u, z_0 = ψ(x), within the Limits.

    The backward Riccati recursion gives the unconstrained plan as one matrix–vector product of [z, 1]; where that
    plan meets every limit it is the optimum (status UNCONSTRAINED). Otherwise OSQP solves the condensed QP for the
    deviation from it, warm-started with the last solution moved on by one step (OPTIMAL, or SOFTENED where a soft
    limit had to give way). A failed step falls back on the last plan, then on the clipped unconstrained input,
    then on the last input. Inputs never leave their limits.

    Parameters
    ----------
    predictor
        The lifted model.
    cost, limits
        What to minimise, within what.
    horizon
        N steps of the predictor's dt.
    solver
        "osqp".
    settings
        The solver's own settings, for example ``{"eps_abs": 1e-9, "eps_rel": 1e-9}``.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        A horizon below 1, crossed limits, sizes that do not fit.

    References
    ----------
    Korda & Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
    control", Automatica 93, 2018.
    """

    solver_fails = False  # set by fault injection alone, see control.move.Fallible

    def __init__(
        self,
        predictor: LinearPredictor,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        solver: Literal["osqp"] = "osqp",
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        if solver != "osqp":
            raise DataError(f'solver is {solver!r}; there is "osqp"')
        N = checks.count(horizon, "horizon")
        limits = Limits() if limits is None else limits
        self.predictor, self.cost, self.limits = predictor, cost, limits
        self._N, self._nu = N, predictor.nu
        track = tracking(predictor, cost, limits)
        stage = _stage(predictor, cost, track, N)
        stages = recursion(stage.A, stage.B, track.C.T @ track.Q @ track.C, track.R, stage.P_N, N)
        self._maps = condense(stage, stages, track.targets)
        self._track = track

        self._lift = buffered(predictor.lifting)
        nv, nz = self._maps.from_state.shape
        self._from_lifted = np.column_stack(
            [self._maps.from_state, np.zeros(nv)]
        )  # the last column: the reference's part
        self._lifted = np.append(np.zeros(nz), 1.0)
        self._z = self._lifted[:-1]
        low = np.concatenate([np.tile(track.inputs.low, N), np.tile(track.outputs.low, N)])
        high = np.concatenate([np.tile(track.inputs.high, N), np.tile(track.outputs.high, N)])
        self._low, self._high = np.maximum(low, -HUGE), np.minimum(high, HUGE)  # inf meets no limit
        self._met = bytearray(2 * nv)
        met = np.frombuffer(self._met, dtype=np.bool_)
        self._met_low, self._met_high = met[:nv], met[nv:]

        maps = self._maps
        self._program = program(maps.deviation, track.inputs, track.outputs, N, limits.slack, maps.unit)
        self._solver = OSQP(self._program.qp, settings)
        self._primal = np.zeros(len(self._program.qp.q) + 1)  # one more, always zero, for the shift
        self._dual = np.zeros(len(self._program.low) + 1)
        self._warm = False
        self._plan = np.zeros(nv)
        self._spare = np.zeros(nv)
        self._memory = PlanMemory(track.inputs, N)
        self._reference_key: bytes | None = None
        self._planned = False
        self.reset()

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.predictor.dt

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._nu

    @property
    def horizon(self) -> int:
        """Steps N of the plan."""
        return self._N

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit; `u_prev` is held if the first step fails."""
        self._memory.reset(u_prev)
        self._solver.reset()
        self._warm = self._planned = False

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return the first input of the plan for state y.

        Parameters
        ----------
        y
            (nx,) measured state.
        reference
            (nr,) held over the horizon, or rows r_k … r_{k+N}, the last repeated.
        applied
            (nu,) what the plant really got last; by default the last u returned.
        """
        start = perf_counter()
        (x,), (z,), lift, _ = self._lift.slot()
        measured = np.asarray(y, dtype=np.float64)
        if measured.shape != x.shape:
            raise ShapeError(f"y has shape {measured.shape}, expected {x.shape}, one value a state")
        x[:] = measured
        lift()
        self._z[:] = z
        target = np.asarray(reference, dtype=np.float64)
        key = target.tobytes()
        if key != self._reference_key:
            self._aim(target)
            self._reference_key = key

        v = self._spare
        np.dot(self._from_lifted, self._lifted, out=v)
        np.greater_equal(v, self._low, out=self._met_low)
        np.less_equal(v, self._high, out=self._met_high)
        if 0 not in self._met:  # every limit is met, and nothing is NaN
            self._warm = False
            self._keep(v)
            u = v[: self._nu].copy()
            return Move(u, Status.UNCONSTRAINED, Fallback.NONE, perf_counter() - start, 0)
        return self._constrained(v, applied, start)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        if not self._planned:
            return None
        U = self._plan[: self._N * self._nu].reshape(self._N, self._nu).copy()
        Z = np.empty((self._N + 1, self.predictor.nz))
        Z[0] = self._z
        for k in range(self._N):
            Z[k + 1] = self.predictor.A @ Z[k] + self.predictor.B @ U[k]
        return Plan(Z @ self.predictor.C.T, U)

    def _aim(self, reference: Float[np.ndarray, "..."]) -> None:
        """Write the reference's part of the plan into the last column."""
        R = reference_rows(reference, self._N, len(self._track.C))
        column = self._from_lifted[:, -1]
        if not np.isfinite(R).all():
            column[:] = np.nan
            return
        alpha = self._track.targets.coordinates(R)
        maps = self._maps
        column[:] = maps.from_reference @ R.ravel() + maps.from_target @ alpha.ravel() + maps.offset

    def _keep(self, v: Float[np.ndarray, " nv"]) -> None:
        """Make v the plan; the array of the plan before it is free for the next step."""
        self._plan, self._spare = v, self._plan
        self._memory.keep(v)
        self._planned = True

    def _constrained(self, v: Float[np.ndarray, " nv"], applied: ArrayLike | None, start: float) -> Move:
        """Solve the QP for the deviation from the plan v, which breaks a limit or is not finite."""
        if not np.abs(v).max() < HUGE:
            return self._fail(None, applied, Status.BAD_MEASUREMENT, 0, start)
        problem = self._program
        low, high = problem.low.copy(), problem.high.copy()
        moved = v[problem.source]
        low[: len(moved)] -= moved
        high[: len(moved)] -= moved
        self._solver.update(low, high)
        if self._warm:
            solution = self._solver.solve(self._primal[problem.shift_primal], self._dual[problem.shift_dual])
        else:
            solution = self._solver.solve(
                np.zeros(len(problem.shift_primal)), np.zeros(len(problem.shift_dual))
            )
        if self.solver_fails:
            solution.status = Status.FAILED
        if solution.status is not Status.OPTIMAL:
            return self._fail(v[: self._nu], applied, solution.status, solution.iterations, start)
        self._primal[:-1], self._dual[:-1] = solution.v, solution.y
        self._warm = True
        nw = self._N * self._nu
        v += self._maps.deviation @ solution.v[:nw]
        u = np.clip(v[:nw].reshape(self._N, self._nu), *self._track.inputs)
        v[:nw] = u.ravel()
        self._keep(v)
        status = (
            Status.SOFTENED
            if softened(solution.v[nw:].reshape(self._N, -1), self._track.outputs)
            else Status.OPTIMAL
        )
        return Move(u[0].copy(), status, Fallback.NONE, perf_counter() - start, solution.iterations)

    def _fail(
        self,
        free: Float[np.ndarray, " nu"] | None,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
    ) -> Move:
        """Return what stands in for a failed step, with the status that says why."""
        self._warm = self._planned = False
        u, fallback = self._memory.instead(free, applied)
        return Move(u, status, fallback, perf_counter() - start, iterations)


class LinearMPC(KoopmanMPC):
    """KoopmanMPC on the linearisation of `step_map` at (x, u): the linear MPC that a lifted one is compared with."""

    def __init__(
        self,
        step_map: StepMap,
        x: ArrayLike,
        u: ArrayLike,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(LinearPredictor.local(step_map, x, u), cost, limits, horizon, settings=settings)


def _stage(predictor: LinearPredictor, cost: Cost, track: Tracking, N: int) -> Stage:
    """Return the horizon's matrices with the terminal weight that the cost asks for."""
    A, B, C, nz, nx = predictor.A, predictor.B, track.C, predictor.nz, predictor.nx
    CQ_N = None
    if cost.Q_N is None:
        P_N = stationary(A, B, C.T @ track.Q @ C, track.R, 10 * N).P
    else:
        given = np.asarray(cost.Q_N)
        size = len(given) if given.ndim else nx
        on_state = size == nx and isinstance(cost.of, State)
        if size == nx != nz and not on_state:
            raise ShapeError(
                f"Q_N ({nx}, {nx}) weighs x_N − r_N, but the reference is not of the state; pass ({nz}, {nz})"
            )
        if size not in (nx, nz):
            raise ShapeError(
                f"Q_N has shape {given.shape}, expected ({nx}, {nx}) on the state or ({nz}, {nz}) on z"
            )
        P_N = checks.weight(given, "Q_N", size)
        if on_state:
            CQ_N = C.T @ P_N
            P_N = CQ_N @ C
    return Stage(A, B, C, track.G, track.Q, track.R, P_N, CQ_N)
