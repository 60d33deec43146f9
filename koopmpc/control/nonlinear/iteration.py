"""Real-time iteration: linearise along the plan, solve the quadratic program of its stages, add the step.

Interior-point steps over the stages solve the program. If they end early, an active-set method finishes the program in
condensed form. Its variables w are defined by δx = δx_free + x̃ and δu_k = δu_free,k − K_k x̃_k + L_k⁻ᵀ w_k, where
S_k = R + BᵀP_{k+1}B = L_k L_kᵀ. The cost is that of the program without limits plus ½ ‖w‖²: the Hessian is the
identity, also of an unstable plant.

Diehl, Bock & Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control", SIAM
J. Control Optim. 43, 2005.
"""

from functools import partial
from time import perf_counter
from typing import Any, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.checks import HUGE
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.condensed_stages import (
    ConvexStage,
    Deviation,
    StageLevels,
    Stages,
    StageStep,
    least_deviation,
)
from koopmpc.control.nonlinear.stages import StagedProblem, StageTargets
from koopmpc.control.nonlinear.stagewise import (
    RiccatiSweeps,
    interior_step,
    linearisation,
    list_hard_outputs,
    list_prices,
    list_sides,
    plan_cost,
    simulation,
    solve_unconstrained,
    weights,
)
from koopmpc.plants.routines import Routine

MOST = 40  # interior-point steps, before an active-set method finishes the program
STALLED = 5  # after this many steps without half the μ, one step only returns to the central path
CENTRING = 0.3  # that step aims at this share of μ for every pair
# Relative tolerances of distances (by spans), of μ (by the curvature along an input's span) and of residuals
PRECISE = 1e-11  # stop here
ENOUGH = 1e-9  # accept this if large weights of slacks exhaust double precision
DIGITS = 1e-13  # share of the largest multiplier that rounding leaves in μ
NEAR = 0.2  # of a change: how far F may be from its linearisation
SHORTEST = 0.001  # of a step
STUCK = 1e-9  # a step this short leads nowhere


class RealTimeIteration:
    """The quadratic program along a plan X (N+1, nx), U (N, nu): δx_0 = x − X_0, c_k = F(X_k, U_k) + e_k − X_{k+1}.

    Each step reads `theta`, its part `W`, the w_k that multiply the state, `e`, and `low` and `high`, the limits of
    [U_k; g(X_{k+1})].

    Parameters
    ----------
    problem
        F, what is tracked and limited, and the stages.
    compiles_model
        Whether F and its derivatives become machine code, as all else does.
    """

    def __init__(self, problem: StagedProblem, *, compiles_model: bool = True) -> None:
        self.problem, N, nx, nu = problem, len(problem.free), problem.nx, problem.F.size1_in(1)
        nr, ng = len(problem.Q), len(problem.box.low)
        self._shape = N, nx, nu, ng
        self._sides, cost, R = list_sides(problem), plan_cost(problem), weights(problem)
        self._softness, self._compiles = list_prices(problem), compiles_model
        sweeps, simulate, linearise = RiccatiSweeps(nx, nu, N), simulation(problem), linearisation(problem)
        own = problem.stage is not None or problem.timed  # then R changes from program to program
        free = solve_unconstrained(sweeps, None if own else R)
        interior = interior_step(sweeps, None if own else R, self._sides, ng) if len(self._sides.row) else None
        self.low, self.high = problem.stage_limits
        ns, nsoft = len(self._sides.row), self._sides.soft
        zeros = np.zeros
        soft = self._sides.row[len(self._sides.row) - self._sides.soft :]
        self._allowance = problem.softness.allowance[soft - nu]
        self._hard = list_hard_outputs(problem.softness, nu * problem.with_rates)
        self._hard_allowance = problem.softness.allowance[self._hard]
        self.limits_outputs = bool(len(self._hard))
        self._outputs = problem.limited.map(N)
        self.length, self._defects = 1.0, zeros(nx)  # of the last step, and the defects that it has left
        self.slack = 0.0  # of the soft limit that the plan breaks most, where that is more than its allowance
        self.multipliers: Float[np.ndarray, " m"] | None = None  # of a program that the active-set method has finished
        self.X, self.U = zeros((N + 1, nx)), zeros((N, nu))
        self.theta, self.e = zeros(problem.theta_size), zeros((N, nx))
        self.W = self.theta[len(self.theta) - N * problem.scheduled :].reshape(N, problem.scheduled)
        self._R, self._U_r = zeros((N, nr)), zeros((N, nu))
        self._targets: StageTargets | None = None  # those that the routines have
        self._terminal = zeros((nr, nx + nr)), zeros((nx, nx + nr)), zeros(nx + nr)  # columns as rows
        A, B, F = zeros((N, nx, nx)), zeros((N, nu, nx)), zeros((N, nx))
        Q, q, r = zeros((N, nx, nx)), zeros((N, nx)), zeros((N, nu))
        self._g, self._G = zeros((N, ng)), zeros((N, nx, ng))
        self._F, self._c, self._x0 = F, zeros((N, nx)), zeros(nx)
        self._now, state = _views([(N, nx), (N, nu), (N, ns), (N, ns), (N, nsoft), (N, nsoft)])
        self._next, after = _views([each.shape for each in state])
        rated = problem.with_rates
        self._weights = [zeros((N, nr)), zeros((N, 0 if rated else nu))] if problem.timed else []
        plan = [self.X, self.U, self._R, self._U_r, *self._terminal, self.theta, *self._weights]
        self._base_R, self._R_k = R.reshape(nu, N, nu).transpose(1, 0, 2).copy(), zeros((N, nu, nu))
        self._R_k[:] = self._base_R
        self._A, self._B, self._stages = A, B, Stages(A, B, Q, self._R_k, self._G, problem.free)
        self._quadratic, self._gradients = (Q, self._R_k), (q, r)
        self._own_stage = (
            ConvexStage(problem, self.X, self.U, compiles=compiles_model) if problem.stage is not None else None
        )
        self._ahead, self._trial = (zeros((N, nx)), zeros((N, nu))), zeros((N, nx))
        self._simulate = Routine(simulate, [*self._ahead, self.theta], [self._trial], compiles=compiles_model)
        self._linearise = Routine(linearise, plan, [A, B, F, Q, q, r, self._g, self._G], compiles=compiles_model)
        curvature = zeros((N, nu))
        stages = [A, B, self._c, Q, q, r, self._x0, *([self._R_k] if own else [])]
        self.without_limits = zeros(nu)  # the first input of the last program, had it no limits
        self._dX, self._dU, self._t, self._lam, self._eps, self._nu = state
        parts = [self.X, self.U, self._R, self._U_r, *self._terminal, self.low, self.high, *self._weights]
        self._cost = zeros(1)
        self._weigh = Routine(cost, parts, [self._cost], compiles=False)
        self._free = Routine(free, stages, [self._dX, self._dU, curvature])
        self._d, self._measures, self._curvature = zeros((N, ns)), zeros(2), curvature
        self._centring = zeros(1)
        self._interior = interior and Routine(
            interior, [*stages, self._G, self._d, self._centring, *state], [*after, self._measures]
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy from the problem, since routines hold pointers to their own arrays; it has the plan and θ."""
        build = partial(RealTimeIteration, compiles_model=self._compiles)
        return build, (self.problem,), (self.X.copy(), self.U.copy(), self.theta.copy())

    def __setstate__(self, state: tuple[np.ndarray, ...]) -> None:
        self.X[:], self.U[:], self.theta[:] = state

    @property
    def stage_is_convex(self) -> bool:
        """Whether a custom stage cost was convex along the plan of the last program."""
        return self._own_stage is None or self._own_stage.convex

    @property
    def compiled(self) -> bool:
        """Whether the iterations run as machine code."""
        return self._linearise.compiled and self._free.compiled

    def step(
        self,
        x: Float[np.ndarray, " nx"],
        targets: StageTargets,
        deadline: float,
        levels: StageLevels | None = None,
    ) -> StageStep:
        """Return the solution of the quadratic program for the measured state x and these targets along the plan.

        With `levels` its inputs are on them.
        """
        if targets is not self._targets:
            self._targets = targets
            self._R[:], self._U_r[:] = targets.R, targets.U
            for place, value in zip(self._terminal, (targets.M.T, targets.L.T, targets.m), strict=True):
                place[:] = value
        self._linearise.call()
        if self._own_stage is not None:
            (Q, R), (q, r) = self._quadratic, self._gradients
            R[:] = self._base_R
            self._own_stage.add(Q, q, R, r)
        if self.problem.ends:  # a terminal set limits the last stage alone
            self._g[:-1, -self.problem.ends :], self._G[:-1, :, -self.problem.ends :] = 0.0, 0.0
        np.subtract(self._F, self.X[1:], out=self._c)
        self._c += self.e
        np.subtract(x, self.X[0], out=self._x0)
        self._free.call()
        self.without_limits = self.U[0] + self._dU[0]
        y = np.concatenate([self.U, self._g], axis=1)
        moved = np.matmul(self._dX[:, None, :], self._G)[:, 0]
        free = np.concatenate([self.U + self._dU, self._g + moved], axis=1)
        nothing = np.zeros_like(self._eps)
        if levels is not None:
            limits = Interval(self.low, self.high)
            found = (
                levels.solve(self._stages, free, limits, self._softness, deadline) if np.isfinite(free).all() else None
            )
            if found is None:
                return StageStep(self._dX, self._dU, nothing, Status.FAILED, 0)
            return self._deviate(free, self._dX.copy(), self._dU.copy(), found, 0)
        known = bool(np.abs(self._dX).max() < HUGE and np.abs(self._dU).max() < HUGE)  # as in C; False for NaN
        if known and ((free >= self.low) & (free <= self.high)).all():
            return StageStep(self._dX, self._dU, nothing, Status.UNCONSTRAINED, 0)
        if self._interior is None or not (known and np.isfinite(free).all()):
            return StageStep(self._dX, self._dU, nothing, Status.FAILED, 0)
        return self._solve_limited(y, free, deadline)

    def take(self, x: Float[np.ndarray, " nx"], found: StageStep) -> None:
        """Add the step to the plan, all of it or the half, quarter, … along which F is near its linearisation.

        Over the length α the defects should become (1 − α) c; a difference of more than a fifth of the largest change
        or defect of that state is too much. Far from a solution full steps lead to plans that no plant follows. Where
        no length will do, `length` is zero and the plan is what it was.
        """
        X, U = self.X[1:], self.U
        left = self._c.copy()
        left[0] += self._x0 @ self._A[0]  # δx_0 is taken whole
        change = np.maximum(np.abs(found.X).max(axis=0), np.abs(left).max(axis=0))
        reach = NEAR * change + 1e-9 * (self.problem.sizes + np.abs(X).max(axis=0))
        length = 1.0
        while True:
            X_new, U_new = X + length * found.X, U + length * found.U
            self._ahead[0][0], self._ahead[0][1:], self._ahead[1][:] = x, X_new[:-1], U_new
            self._simulate.call()
            error = np.abs(self._trial + self.e - X_new - (1 - length) * left).max(axis=0)
            if (error <= length * reach).all() or length < SHORTEST:
                break
            length /= 2
        if length < SHORTEST:  # F is nowhere near its linearisation: the plan stays as it was
            self.length, gap = 0.0, np.abs(left).max(axis=0)
        else:
            self.X[0], X[:], U[:] = x, X_new, U_new
            self.length, gap = length, error if length == 1 else np.abs(self._trial + self.e - X_new).max(axis=0)
        self._defects = gap
        self.note_slack(found)

    def find_defect(self) -> float:
        """Return the largest distance of a planned state from the model's, as a share of its size."""
        self._ahead[0][:], self._ahead[1][:] = self.X[:-1], self.U
        self._simulate.call()
        return float((np.abs(self._trial + self.e - self.X[1:]) / self.problem.sizes).max())

    def note_slack(self, found: StageStep) -> float:
        """Keep and return the violation of the soft limit that a step breaks most, above its allowance."""
        self.slack = float(found.slacks[found.slacks > self._allowance].max(initial=0.0))
        return self.slack

    def rests(self, found: StageStep, settled: float) -> bool:
        """Return whether no input and no state moved by more than this share of its size and the plan's."""
        u, x = self.problem.input_sizes, self.problem.sizes
        moved = (found.U / u, self.U / u), (found.X / x, self.X / x)
        return all(bool(np.abs(d).max() <= settled * (1 + np.abs(v).max())) for d, v in moved)

    @property
    def gap(self) -> float:
        """The largest defect that the last step has left, as a share of the range of its state in the plan."""
        return float((self._defects / (np.ptp(self.X, axis=0) + 1e-9 * (self.problem.sizes + np.abs(self.X[0])))).max())

    def end_excess(self) -> float:
        """Return by how much the plan's end leaves its terminal set, whose values are at most 1."""
        values = np.array(cast(ca.DM, self.problem.limited(self.X[-1])), dtype=np.float64).ravel()
        return float(values[len(values) - self.problem.ends :].max(initial=1.0)) - 1

    def excess(self) -> float:
        """Return by how much the inputs break a hard limit on the model, in units of what counts as broken.

        Where they break none, but the states of the plan do, the states become those of the model.
        """
        states = self.X.copy()
        for k, u in enumerate(self.U):
            states[k + 1] = np.array(cast(ca.DM, self.problem.F(states[k], u, self._theta_of(k)))).ravel() + self.e[k]
            if not np.abs(states[k + 1]).max() < HUGE:
                return np.inf
        past = self._past(states)
        if past <= 1 < self._past(self.X):
            self.X[:] = states
        return past

    def _theta_of(self, k: int) -> Float[np.ndarray, " nt"]:
        """Return θ of stage k."""
        if not self.problem.scheduled:
            return self.theta
        return np.concatenate([self.theta[: len(self.theta) - self.W.size], self.W[k]])

    def set_weights(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Set the diagonals of all stages, where weights move in time."""
        self._weights[0][:], self._weights[1][:] = Q, R
        if R.size:
            np.einsum("kii->ki", self._base_R)[:] = R  # a view of the diagonals
        self._R_k[:] = self._base_R

    def set_theta(self, theta: Float[np.ndarray, " nt"]) -> None:
        """Set the θ of a model; the w of all stages stay."""
        n = len(theta) - self.problem.scheduled
        self.theta[:n] = theta[:n]

    def _past(self, X: Float[np.ndarray, "N1 nx"]) -> float:
        """Return by how much these states break a hard limit, in units of what counts as broken."""
        values = np.array(self._outputs(X[1:].T), dtype=np.float64).T[:, self._hard]
        rows = self._shape[2] + self._hard
        past = np.maximum(self.low[:, rows] - values, values - self.high[:, rows])
        if self.problem.ends:
            past[:-1, self._hard >= self._shape[3] - self.problem.ends] = 0.0
        return float((past / self._hard_allowance).max())

    def cost(self) -> float:
        """Return what the plan costs, its breaches of soft limits included."""
        self._weigh.call()
        return float(self._cost[0])

    def _solve_limited(
        self, y: Float[np.ndarray, "N nq"], free: Float[np.ndarray, "N nq"], deadline: float
    ) -> StageStep:
        """Follow the central path from the unconstrained solution; where it ends early, an active-set method finishes.

        Interior points have nowhere to go between two equal limits; and they end early where a plant is lost, some
        slacks being 1e6 times as large as others. The next programs of the same step are then finished so at once.
        """
        s = self._sides
        rows = s.row
        unlimited = self._dX.copy(), self._dU.copy()
        if self._hard_limits_are_out_of_reach():
            return StageStep(*unlimited, np.zeros_like(self._eps), Status.INFEASIBLE, 0)
        hard = rows[: len(rows) - s.soft]
        roomy = (self.low[:, hard] < self.high[:, hard]).all()  # else there is no interior
        if self.multipliers is not None or not roomy:
            return self._finish(free, *unlimited, deadline, 0)
        bound = np.where(s.sign > 0, self.low[:, rows], self.high[:, rows])
        self._d[:] = s.sign * (y[:, rows] - bound) / s.span
        distance = s.sign * (free[:, rows] - bound) / s.span
        hard = len(rows) - s.soft
        unit = self._unit()
        worst = max(-float(distance.min()), 1e-3)
        start = min(worst, 1.0)
        np.maximum(distance, start, out=self._t)
        np.divide(unit * start * worst, self._t, out=self._lam)
        if s.soft:
            self._eps[:] = np.maximum(-distance[:, hard:], start)
            price = s.linear + s.quadratic * self._eps
            self._lam[:, hard:] = self._nu[:] = 0.5 * price
            self._lam[:, :hard] = 0.5 * float(price.mean()) * start / self._t[:, :hard]
        left, initial = 1.0, max(worst, float(self._lam.max()) / unit)
        iterations, mu, best, since, enough = 0, np.inf, np.inf, 0, False
        assert self._interior is not None, "there are limits"
        while iterations < MOST:
            if perf_counter() > deadline:
                return StageStep(self._dX, self._dU, self._eps, Status.TIME_LIMIT, iterations)
            self._centring[0] = CENTRING * (since == STALLED)
            since %= STALLED
            self._interior.call()
            iterations += 1
            length = float(self._measures[1])
            if not (np.isfinite(self._measures).all() and np.isfinite(self._next).all()):
                break
            self._now[:] = self._next
            left *= 1 - length
            mu = float(np.vdot(self._t, self._lam) + np.vdot(self._eps, self._nu)) / (self._t.size + self._eps.size)
            best, since = (mu, 0) if mu <= 0.5 * best else (best, since + 1)
            good = ENOUGH + DIGITS * float(self._lam.max()) / unit
            enough = mu <= good * unit and left * initial <= good
            precise = mu <= PRECISE * unit and left * initial <= PRECISE
            if precise or length < STUCK or (enough and since):
                break
        if enough:
            return StageStep(self._dX, self._dU, self._eps * s.span[hard:], Status.OPTIMAL, iterations)
        return self._finish(free, *unlimited, deadline, iterations)

    def _finish(
        self,
        free: Float[np.ndarray, "N nq"],
        dX: Float[np.ndarray, "N nx"],
        dU: Float[np.ndarray, "N nu"],
        deadline: float,
        iterations: int,
    ) -> StageStep:
        """Return the solution by an active-set method; (δX, δU) is the one without limits, `free` its values."""
        room = Interval(self.low - free, self.high - free)
        found = least_deviation(self._stages, room, self._softness, self.multipliers, deadline - perf_counter())
        if found is None:
            return StageStep(dX, dU, np.zeros_like(self._eps), Status.FAILED, iterations, finished=True)
        self.multipliers = found.multipliers if found.status is Status.OPTIMAL else None
        impossible = found.status is Status.INFEASIBLE and not self.limits_outputs  # inputs alone always have a plan
        if impossible or found.status is Status.MAX_ITERATIONS:  # which of both limits ends it rounding decides
            found = found._replace(status=Status.FAILED)
        return self._deviate(free, dX, dU, found, iterations)._replace(finished=True)

    def _deviate(
        self,
        free: Float[np.ndarray, "N nq"],
        dX: Float[np.ndarray, "N nx"],
        dU: Float[np.ndarray, "N nu"],
        found: Deviation,
        iterations: int,
    ) -> StageStep:
        """Return the solution without limits, (δX, δU) with the values `free`, and the deviation from it."""
        s, room = self._sides, Interval(self.low - free, self.high - free)
        self._dX[:], self._dU[:] = dX + found.X, dU + found.U
        moved = np.concatenate([found.U, np.matmul(found.X[:, None, :], self._G)[:, 0]], axis=1)
        rows, sign = s.row[len(s.row) - s.soft :], s.sign[len(s.row) - s.soft :]
        past = np.where(sign > 0, room.low[:, rows] - moved[:, rows], moved[:, rows] - room.high[:, rows])
        return StageStep(self._dX, self._dU, np.maximum(past, 0.0), found.status, iterations + found.iterations)

    def _hard_limits_are_out_of_reach(self) -> bool:
        """Return whether no first input inside its limits leads to a state inside its hard limits, row by row.

        So it is after most wild readings, and an active-set method would take its time to find that out.
        """
        if not self.limits_outputs:
            return False
        hard, nu = self._hard, self._shape[2]
        G = self._G[0][:, hard]
        gain, at = self._B[0] @ G, self._g[0, hard] + (self._c[0] + self._x0 @ self._A[0]) @ G
        ends = np.where(
            gain != 0, np.stack([each[0, :nu] - self.U[0] for each in (self.low, self.high)])[:, :, None], 0
        )
        reach = np.sort(ends * gain, axis=0).sum(axis=1)
        low, high = self.low[0, nu + hard], self.high[0, nu + hard]
        past = np.maximum(low - at - reach[1], at + reach[0] - high)
        return bool((past > self._hard_allowance).any())

    def _unit(self) -> float:
        """Return the mean curvature of the cost along the span of an input, or its size where it has no limits."""
        s, nu = self._sides, self._shape[2]
        span = self.problem.input_sizes.copy()
        mine = s.row < nu
        span[s.row[mine]] = s.span[mine]
        return max(float(np.mean(self._curvature[self.problem.free] * span**2)), 1e-300)


def _views(shapes: list[tuple[int, ...]]) -> tuple[Float[np.ndarray, " n"], list[Float[np.ndarray, "..."]]]:
    """Return one array of zeros, and views of these shapes that fill it."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    whole = np.zeros(int(ends[-1]))
    return whole, [part.reshape(shape) for part, shape in zip(np.split(whole, ends[:-1]), shapes, strict=True)]
