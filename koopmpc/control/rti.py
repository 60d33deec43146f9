"""One pass of a real-time iteration: linearise along the plan, solve the quadratic program of its stages.

Diehl, Bock & Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control", SIAM
J. Control Optim. 43, 2005.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.equilibrium import Goal
from koopmpc.control.move import Status
from koopmpc.control.outputs import Outputs
from koopmpc.control.stagewise import Passes, Sides, interior_step, linearisation, unconstrained
from koopmpc.plant.routine import Routine
from koopmpc.plant.step_map import StepMap

MOST = 60  # interior-point steps
PRECISE = (
    1e-9  # of spans for distances, of the curvature along an input's span for μ and what is left of residuals
)
NEAR = 0.2  # of a change: how far F may be from its linearisation
SHORTEST = 0.02  # of a step
STUCK = 1e-9  # a step this short leads nowhere


class Pass(NamedTuple):
    """The step (δX, δU) of a pass, how far each soft output gave way, how it ended, and after how many iterations."""

    X: Float[np.ndarray, "N nx"]
    U: Float[np.ndarray, "N nu"]
    slacks: Float[np.ndarray, "N nsoft"]
    status: Status
    iterations: int


class RealTimeIteration:
    """The quadratic program along a plan X (N+1, nx), U (N, nu): δx_0 = x − X_0, c_k = F(X_k, U_k) − X_{k+1}.

    Parameters
    ----------
    step_map
        F.
    outputs
        What is tracked and limited.
    N
        Steps.
    """

    def __init__(self, step_map: StepMap, outputs: Outputs, N: int) -> None:
        nx, nu, nr, ng = step_map.nx, step_map.nu, len(outputs.Q), len(outputs.box.low)
        self._shape = N, nx, nu, ng
        self._inputs, self._box = outputs.inputs, outputs.box
        self._sides = sides(outputs)
        ns, nsoft = len(self._sides.row), self._sides.soft
        zeros = np.zeros
        self.X, self.U = zeros((N + 1, nx)), zeros((N, nu))
        self._R, self._U_r = zeros((N, nr)), zeros((N, nu))
        self._goal = zeros((nr, nx + nr)), zeros((nx, nx + nr)), zeros(nx + nr)  # columns as rows
        A, B, F = zeros((N, nx, nx)), zeros((N, nu, nx)), zeros((N, nx))
        Q, q, r = zeros((N, nx, nx)), zeros((N, nx)), zeros((N, nu))
        self._g, self._G = zeros((N, ng)), zeros((N, nx, ng))
        self._F, self._c, self._x0 = F, zeros((N, nx)), zeros(nx)
        plan = [self.X, self.U, self._R, self._U_r, *self._goal]
        self._A = A
        self._ahead, self._trial = (zeros((N, nx)), zeros((N, nu))), zeros((N, nx))
        F_map = step_map.F.map(N)
        self._simulate = Routine(F_map, self._ahead, [self._trial])
        self._linearise = Routine(
            linearisation(step_map, outputs, N), plan, [A, B, F, Q, q, r, self._g, self._G]
        )
        passes, curvature = Passes(nx, nu, N), zeros((N, nu))
        problem = [A, B, self._c, Q, q, r, self._x0]
        self._now, state = _views([(N, nx), (N, nu), (N, ns), (N, ns), (N, nsoft), (N, nsoft)])
        self._next, after = _views([each.shape for each in state])
        self._dX, self._dU, self._t, self._lam, self._eps, self._nu = state
        self._free = Routine(unconstrained(passes, outputs.R), problem, [self._dX, self._dU, curvature])
        self._d, self._measures, self._curvature = zeros((N, ns)), zeros(2), curvature
        interior = interior_step(passes, outputs.R, self._sides, ng) if ns else None
        self._interior = interior and Routine(
            interior, [*problem, self._G, self._d, *state], [*after, self._measures]
        )

    @property
    def soft_rows(self) -> list[int]:
        """Which limited output each soft side belongs to."""
        s = self._sides
        return [int(i) - self._shape[2] for i in s.row[len(s.row) - s.soft :]]

    @property
    def compiled(self) -> bool:
        """Whether the passes run as machine code."""
        return self._linearise.compiled and self._free.compiled

    def aim(self, R: Float[np.ndarray, "N nr"], U_r: Float[np.ndarray, "N nu"], goal: Goal) -> None:
        """Set the reference rows of x_1 … x_N, the inputs u_r, and the goal at the end."""
        self._R[:], self._U_r[:] = R, U_r
        for place, value in zip(self._goal, (goal.M.T, goal.L.T, goal.m), strict=True):
            place[:] = value

    def step(self, x: Float[np.ndarray, " nx"]) -> Pass:
        """Return the solution of the quadratic program for the measured state x along the plan."""
        self._linearise.call()
        np.subtract(self._F, self.X[1:], out=self._c)
        np.subtract(x, self.X[0], out=self._x0)
        self._free.call()
        y = self._quantities()
        free = np.concatenate([self.U + self._dU, y[:, self._shape[2] :] + self._moved()], axis=1)
        low = np.concatenate([self._inputs.low, self._box.low])
        high = np.concatenate([self._inputs.high, self._box.high])
        nothing = np.zeros_like(self._eps)
        if ((free >= low) & (free <= high)).all() and np.isfinite(self._dX).all():
            return Pass(self._dX, self._dU, nothing, Status.UNCONSTRAINED, 0)
        if self._interior is None or not np.isfinite(free).all():
            return Pass(self._dX, self._dU, nothing, Status.FAILED, 0)
        return self._limited(y, free)

    def take(self, x: Float[np.ndarray, " nx"], found: Pass) -> float:
        """Add the step to the plan, all of it or the half, quarter, … along which F is near its linearisation.

        Over the length α the defects should become (1 − α) c; a difference of more than half of the largest change of
        that state in the plan is too much. Far from a solution full steps lead to plans that no plant follows.
        """
        X, U = self.X[1:], self.U
        left = self._c.copy()
        left[0] += self._x0 @ self._A[0]  # δx_0 is taken whole
        reach = NEAR * np.abs(found.X).max(axis=0) + 1e-9 * (1 + np.abs(X).max(axis=0))
        length = 1.0
        while True:
            X_new, U_new = X + length * found.X, U + length * found.U
            self._ahead[0][0], self._ahead[0][1:], self._ahead[1][:] = x, X_new[:-1], U_new
            self._simulate.call()
            error = np.abs(self._trial - X_new - (1 - length) * left).max(axis=0)
            if (error <= length * reach).all() or length < SHORTEST:
                break
            length /= 2
        self.X[0], X[:], U[:] = x, X_new, np.clip(U_new, *self._inputs)
        return length

    def _limited(self, y: Float[np.ndarray, "N nq"], free: Float[np.ndarray, "N nq"]) -> Pass:
        """Follow the central path from the unconstrained solution."""
        s = self._sides
        rows = s.row
        self._d[:] = s.sign * (y[:, rows] - s.bound) / s.span
        distance = s.sign * (free[:, rows] - s.bound) / s.span
        hard = self._d.shape[1] - s.soft
        unit = self._unit()
        worst = max(-float(distance.min()), 1e-3)
        start = min(worst, 1.0)
        np.maximum(distance, start, out=self._t)
        level = unit * start * worst
        np.divide(level, self._t, out=self._lam)
        if s.soft:
            self._eps[:] = np.maximum(-distance[:, hard:], start)
            self._lam[:, hard:] = np.minimum(self._lam[:, hard:], 0.5 * (s.linear + s.quadratic * self._eps))
            self._nu[:] = s.linear + s.quadratic * self._eps - self._lam[:, hard:]
        left, initial = 1.0, max(worst, float(self._lam.max()) / unit)
        iterations, status = 0, Status.MAX_ITERATIONS
        assert self._interior is not None, "there are limits"
        while iterations < MOST:
            self._interior.call()
            iterations += 1
            self._now[:] = self._next
            mu, length = self._measures
            if not np.isfinite(mu) or not np.isfinite(length):
                return Pass(self._dX, self._dU, self._eps, Status.FAILED, iterations)
            left *= 1 - length
            if length < STUCK:
                break
            mu = float(np.vdot(self._t, self._lam) + np.vdot(self._eps, self._nu)) / (
                self._t.size + self._eps.size
            )
            if mu <= PRECISE * unit and left * initial <= PRECISE:
                status = Status.OPTIMAL
                break
        if status is not Status.OPTIMAL and left * worst > 1e-6:
            status = Status.INFEASIBLE
        return Pass(self._dX, self._dU, self._eps * s.span[hard:], status, iterations)

    def _quantities(self) -> Float[np.ndarray, "N nq"]:
        return np.concatenate([self.U, self._g], axis=1)

    def _moved(self) -> Float[np.ndarray, "N ng"]:
        return np.matmul(self._dX[:, None, :], self._G)[:, 0]

    def _unit(self) -> float:
        """Return the mean curvature of the cost along the span of an input."""
        s, nu = self._sides, self._shape[2]
        span = np.ones(nu)
        mine = s.row < nu
        span[s.row[mine]] = s.span[mine]
        return max(float(np.mean(self._curvature * span**2)), 1e-300)


def sides(outputs: Outputs) -> Sides:
    """Return the finite ends of all limits, those that are hard first."""
    nu, inputs, box = len(outputs.R), outputs.inputs, outputs.box
    low, high = np.concatenate([inputs.low, box.low]), np.concatenate([inputs.high, box.high])
    linear = np.concatenate([np.full(nu, np.inf), outputs.softness.linear])
    quadratic = np.concatenate([np.zeros(nu), outputs.softness.quadratic])
    finite = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high, 0.0))
    with np.errstate(invalid="ignore"):
        span = np.where(np.isfinite(high - low) & (high > low), high - low, 1 + np.abs(finite))
    ends = [
        (i, sign)
        for soft in (False, True)
        for sign, end in ((1.0, low), (-1.0, high))
        for i in range(len(low))
        if np.isfinite(end[i]) and np.isfinite(linear[i]) == soft
    ]
    row = np.array([i for i, _ in ends], dtype=np.intp)
    sign = np.array([s for _, s in ends], dtype=np.float64)
    given = row[np.isfinite(linear[row])]
    return Sides(
        row=row,
        sign=sign,
        bound=np.where(sign > 0, low[row], high[row]),
        span=span[row],
        soft=len(given),
        linear=0.5 * linear[given] * span[given],
        quadratic=quadratic[given] * span[given] ** 2,
    )


def _views(shapes: list[tuple[int, ...]]) -> tuple[Float[np.ndarray, " n"], list[Float[np.ndarray, "..."]]]:
    """Return one array of zeros, and views of these shapes that fill it."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    whole = np.zeros(int(ends[-1]))
    return whole, [
        part.reshape(shape) for part, shape in zip(np.split(whole, ends[:-1]), shapes, strict=True)
    ]
