"""NonlinearMPC: multiple shooting and IPOPT; the oracle that the others are measured against."""

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, cast

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.fallback import PlanMemory
from koopmpc.control.lifted import reference_rows
from koopmpc.control.limits import Box, Limits, softened
from koopmpc.control.move import Fallback, Move, Plan, Status
from koopmpc.control.riccati import stationary
from koopmpc.control.shooting import QUIET, Aim, Shooting, flat
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State
from koopmpc.plant.step_map import StepMap

_KEPT = 10_000  # targets remembered before the memory starts anew


@dataclass(frozen=True)
class _Target:
    """An equilibrium that holds a reference row, and the weight P of the distance from it."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    P: Float[np.ndarray, "nx nx"]


class NonlinearMPC:
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, by multiple shooting and IPOPT.

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
    settings
        IPOPT's own settings by CasADi's names, for example ``{"ipopt.tol": 1e-10}``.

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
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self._N = checks.count(horizon, "horizon")
        self.step_map, self.cost = step_map, cost
        self.limits = Limits() if limits is None else limits
        self._inputs = self.limits.inputs(step_map.nu)
        tracked = cost.of.bind(step_map.states)
        self._nr = tracked.nz
        self._Q, self._R = cost.matrices(self._nr, step_map.nu)
        if cost.Q_N is not None:
            checks.weight(cost.Q_N, "Q_N", step_map.nx)
            if not isinstance(tracked, State):
                raise ShapeError("Q_N weighs x_N − r_N, but the reference is not of the state; leave Q_N out")
        x = ca.SX.sym("x", step_map.nx)
        self._of = ca.Function("of", [x], [ca.densify(tracked.symbolic(x))])
        self._of_jacobian = ca.Function("of_x", [x], [ca.densify(ca.jacobian(tracked.symbolic(x), x))])
        self._limited, self._outputs = _limited(self.limits, step_map)
        options = {"ipopt.max_iter": 300, "ipopt.warm_start_init_point": "yes", **(settings or {})}
        self._shooting = Shooting(
            step_map,
            self._of,
            self._limited,
            self._Q,
            self._R,
            self._inputs,
            self._outputs,
            self.limits.slack,
            self._N,
            options,
        )
        self._equilibrium = self._equilibrium_solver()
        self._memory = PlanMemory(self._inputs, self._N)
        self._targets: dict[bytes, _Target] = {}
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
        self._shooting.reset()
        self._plan = None

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        return self._plan

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        x0 = checks.array(y, "y", (self.step_map.nx,), finite=False)
        R = reference_rows(np.asarray(reference, dtype=np.float64), self._N, self._nr)
        if not (np.isfinite(x0).all() and np.isfinite(R).all()):
            return self._fail(applied, Status.BAD_MEASUREMENT, 0, start)
        targets = [self._target(row) for row in R]
        aim = Aim(R[1:], np.array([t.u for t in targets[:-1]]), targets[-1].x, targets[-1].P)
        found = self._shooting.solve(x0, aim)
        if self.solver_fails:
            found = found._replace(status=Status.FAILED)
        if found.status is not Status.OPTIMAL:
            return self._fail(applied, found.status, found.iterations, start)
        U = np.clip(found.U, *self._inputs)
        self._memory.keep(U.ravel())
        self._plan = Plan(np.vstack([x0, found.X]), U.copy())
        status = Status.SOFTENED if softened(found.slacks, self._outputs) else Status.OPTIMAL
        return Move(U[0].copy(), status, Fallback.NONE, perf_counter() - start, found.iterations)

    def _fail(self, applied: ArrayLike | None, status: Status, iterations: int, start: float) -> Move:
        self._shooting.reset()
        self._plan = None
        u, fallback = self._memory.instead(None, applied)
        return Move(u, status, fallback, perf_counter() - start, iterations)

    def _target(self, row: Float[np.ndarray, " nr"]) -> _Target:
        """Return the equilibrium for a reference row, kept for the next time."""
        key = row.tobytes()
        if key not in self._targets:
            if len(self._targets) > _KEPT:
                self._targets.clear()
            self._targets[key] = self._find_target(row)
        return self._targets[key]

    def _find_target(self, row: Float[np.ndarray, " nr"]) -> _Target:
        """Minimise ‖of(x) − r‖²_Q over equilibria x = F(x, u) inside all limits, or else the input limits."""
        nx, nu = self.step_map.nx, self.step_map.nu
        guess = np.concatenate(
            [row if self._nr == nx else np.zeros(nx), np.clip(np.zeros(nu), *self._inputs)]
        )
        v = guess
        free = np.full(len(self._outputs.low), np.inf)
        for outputs in (self._outputs, Box(-free, free)):
            found = cast(
                "dict[str, Any]",
                self._equilibrium(
                    p=row,
                    x0=guess,
                    lbx=np.concatenate([np.full(nx, -np.inf), self._inputs.low]),
                    ubx=np.concatenate([np.full(nx, np.inf), self._inputs.high]),
                    lbg=np.concatenate([np.zeros(nx), outputs.low]),
                    ubg=np.concatenate([np.zeros(nx), outputs.high]),
                ),
            )
            if self._equilibrium.stats()["success"]:
                v = flat(found["x"])
                break
        x, u = v[:nx], v[nx:]
        held = u if self.cost.u_target == "equilibrium" else np.zeros(nu)
        if self.cost.Q_N is not None:
            return _Target(row, held, checks.weight(self.cost.Q_N, "Q_N", nx))
        affine = self.step_map.linearize(x, u)
        J = self._of_jacobian(x).full()
        P = stationary(affine.A, affine.B, J.T @ self._Q @ J, self._R, 10 * self._N).P
        return _Target(x, held, P)

    def _equilibrium_solver(self) -> ca.Function:
        x, u = ca.MX.sym("x", self.step_map.nx), ca.MX.sym("u", self.step_map.nu)
        r = ca.MX.sym("r", self._nr)
        error = self._of(x) - r
        least = 1e-8 * max(float(np.trace(self._Q)), 1e-12)  # of all that hold r, the one of least size
        f = ca.mtimes([error.T, ca.DM(self._Q), error]) + least * (ca.sumsqr(u) + ca.sumsqr(x))
        g = ca.vertcat(self.step_map.F(x, u) - x, self._limited(x))
        nlp = {"x": ca.vertcat(x, u), "p": r, "f": f, "g": g}
        return ca.nlpsol("equilibrium", "ipopt", nlp, QUIET)


def _limited(limits: Limits, step_map: StepMap) -> tuple[ca.Function, Box]:
    """Return the limited states and observables as a function of x, and their limits."""
    x = ca.SX.sym("x", step_map.nx)
    low, high = limits.states(step_map.nx)
    values = x
    if limits.of is not None:
        of = limits.of.bind(step_map.states)
        y = limits.outputs(of.nz)
        values = ca.vertcat(x, of.symbolic(x))
        low, high = np.concatenate([low, y.low]), np.concatenate([high, y.high])
    kept = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
    function = ca.Function("limited", [x], [ca.densify(values[kept.tolist(), :])])
    return function, Box(low[kept], high[kept])
