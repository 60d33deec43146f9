"""Multiple shooting: the nonlinear program of a horizon, its bounds, and its solution moved on by one step.

Bock & Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC 1984.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.equilibrium import flat
from koopmpc.control.nonlinear.stages import Aim, Problem
from koopmpc.errors import DataError

Solver = Literal["ipopt", "fatrop", "sqpmethod"]
_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "ipopt": {
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 300,
        "ipopt.warm_start_init_point": "yes",
    },
    "fatrop": {"fatrop.print_level": 0, "fatrop.max_iter": 300, "structure_detection": "manual"},
    "sqpmethod": {
        "qpsol": "qrqp",
        "max_iter": 100,
        "convexify_strategy": "eigen-clip",
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
    },
}
_STATUS = {
    "Solve_Succeeded": Status.OPTIMAL,
    "Solved_To_Acceptable_Level": Status.OPTIMAL,
    "Maximum_Iterations_Exceeded": Status.MAX_ITERATIONS,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "SOLVER_RET_SUCCESS": Status.OPTIMAL,
    "SOLVER_RET_LIMITED": Status.MAX_ITERATIONS,
    "SOLVER_RET_INFEASIBLE": Status.INFEASIBLE,
}


class Horizon(NamedTuple):
    """A solution: inputs, states and slacks, stage by stage, its cost, and how the solver ended."""

    U: Float[np.ndarray, "N nu"]
    X: Float[np.ndarray, "N nx"]
    slacks: Float[np.ndarray, "N ns"]
    cost: float
    status: Status
    iterations: int


class Start(NamedTuple):
    """Where a solver begins: variables, and multipliers of their bounds and of the constraints."""

    v: Float[np.ndarray, " n"]
    bounds: Float[np.ndarray, " n"]
    constraints: Float[np.ndarray, " m"]


class Shooting:
    """Variables (u_k, x_{k+1}, ε_{k+1}) stage by stage, constraints x_{k+1} = F(x_k, u_k) and the limits.

    Parameters
    ----------
    problem
        F, what is tracked and limited, and the stages.
    solver, options
        CasADi's solver, and its options by CasADi's names.

    Raises
    ------
    DataError
        The solver refuses its options.
    """

    def __init__(self, problem: Problem, solver: Solver, options: Mapping[str, Any]) -> None:
        outputs, N = problem, len(problem.free)
        nx, nu, nr, ng = problem.nx, problem.F.size1_in(1), len(outputs.Q), len(outputs.box.low)
        x, u = ca.MX.sym("x", nx), ca.MX.sym("u", nu)
        F = ca.Function("F", [x, u], [problem.F(x, u, ca.DM(0, 1))])
        smooth = problem.F.is_a("SXFunction")
        linear, quadratic = outputs.softness
        soft = np.flatnonzero(np.isfinite(linear))
        ns = len(soft)
        W = ca.MX.sym("W", nu + nx + ns, N)
        U, X, E = W[:nu, :], W[nu : nu + nx, :], W[nu + nx :, :]
        x0, r, u_r = ca.MX.sym("x0", nx), ca.MX.sym("r", nr, N), ca.MX.sym("u_r", nu, N)
        M, L, m = (ca.MX.sym("goal", nx + nr, columns) for columns in (nr, nx, 1))

        gaps = X - F.map(N)(ca.horzcat(x0, X[:, : N - 1]), U)  # the sign that fatrop wants
        end = M @ outputs.tracked(X[:, N - 1]) + L @ X[:, N - 1] - m
        f = _weighted(U - u_r, outputs.R) + ca.sumsqr(end)
        if N > 1:
            f += _weighted(outputs.tracked.map(N - 1)(X[:, : N - 1]) - r[:, : N - 1], outputs.Q)
        paths, low, high = [ca.MX(0, N)], [np.zeros(0)], [np.zeros(0)]
        if ng:
            values, infinite = outputs.limited.map(N)(X), np.full(ng, np.inf)
            relaxed = ca.DM(np.eye(ng)[:, soft]) @ E if ns else ca.MX(ng, N)
            if ns:
                weights = ca.DM(linear[soft]), ca.DM(quadratic[soft])
                f += ca.sum2(weights[0].T @ E + weights[1].T @ E**2)
            paths = [values - relaxed, values + relaxed]
            low, high = [-infinite, outputs.box.low], [outputs.box.high, infinite]
        path = ca.vertcat(*paths)
        npath = path.shape[0]
        # gap_1; gap_2, path_1; …; gap_N, path_{N−1}; path_N: the order in which fatrop finds the stages
        g = [
            gaps[:, k] if part == 0 else path[:, k - part]
            for k in range(N + 1)
            for part in (0, 1)
            if part <= k < N + part and (npath or part == 0)
        ]
        places = np.arange(N)[:, None] * (nx + npath)
        gap_at = places - npath + np.arange(nx)
        gap_at[0] += npath
        path_at = places + nx + nx + np.arange(npath)
        path_at[-1] -= nx
        self._next_g = np.empty(N * (nx + npath), dtype=np.intp)
        for at in (gap_at, path_at):
            self._next_g[at] = np.vstack([at[1:], at[-1:]])
        stages = np.arange(W.numel()).reshape(N, -1)
        self._next_v = np.vstack([stages[1:], stages[-1:]]).ravel()
        lows, highs = np.zeros(len(self._next_g)), np.zeros(len(self._next_g))
        lows[path_at], highs[path_at] = np.concatenate(low), np.concatenate(high)
        unlimited, zero = np.full(nx, np.inf), np.zeros(ns)
        lowest = np.tile(np.concatenate([outputs.inputs.low, -unlimited, zero]), (N, 1))
        highest = np.tile(np.concatenate([outputs.inputs.high, unlimited, np.full(ns, np.inf)]), (N, 1))
        lowest[~problem.free, :nu] = highest[~problem.free, :nu] = 0.0
        self._bounds = {
            "lbx": lowest.ravel(),
            "ubx": highest.ravel(),
            "lbg": lows,
            "ubg": highs,
        }
        parameters = ca.vertcat(x0, ca.vec(r), ca.vec(u_r), ca.vec(M), ca.vec(L), m)
        nlp = {"x": ca.vec(W), "p": parameters, "f": f, "g": ca.vertcat(*g)}
        given: dict[str, Any] = {"expand": smooth, "error_on_fail": False}
        if solver == "fatrop":
            given |= {
                "N": N,
                "nx": [0] + [nx] * N,
                "nu": [nu] + [ns + nu] * (N - 1) + [ns],
                "ng": [0] + [npath] * N,
            }
        try:
            self._solver = ca.nlpsol(
                "shooting", solver, nlp, {"print_time": False, **_OPTIONS[solver], **given, **options}
            )
        except (RuntimeError, NotImplementedError, TypeError) as error:
            reason = [line for line in str(error).splitlines() if line.strip()][-1].strip()
            raise DataError(
                f"{solver} was not built with settings {dict(options)}: {reason}; pass its own settings by CasADi's "
                'names, for example {"ipopt.tol": 1e-8}'
            ) from error
        self._shape, self._split = (N, nu + nx + ns), (nu, nu + nx)

    def at(self, X: Float[np.ndarray, "N nx"], U: Float[np.ndarray, "N nu"]) -> Start:
        """Return a start with these states x_1 … x_N and inputs."""
        W = np.zeros(self._shape)
        W[:, : self._split[0]], W[:, self._split[0] : self._split[1]] = U, X
        return Start(W.ravel(), np.zeros(W.size), np.zeros(len(self._next_g)))

    def solve(self, x0: Float[np.ndarray, " nx"], aim: Aim, start: Start, first: Interval) -> tuple[Horizon, Start]:
        """Solve from `start` with u_0 inside `first`; return the solution, and the start that it leaves."""
        nu = self._split[0]
        self._bounds["lbx"][:nu], self._bounds["ubx"][:nu] = first
        p = [x0, aim.R.ravel(), aim.U.ravel(), aim.M.ravel("F"), aim.L.ravel("F"), aim.m]
        begin = {"x0": start.v, "lam_x0": start.bounds, "lam_g0": start.constraints}
        found = cast("dict[str, Any]", self._solver(p=np.concatenate(p), **self._bounds, **begin))
        stats = self._solver.stats()
        unified = str(stats.get("unified_return_status"))
        status = _STATUS.get(str(stats["return_status"]), _STATUS.get(unified, Status.FAILED))
        v = flat(found["x"])
        if not np.isfinite(v).all():
            status = Status.FAILED
        U, X, slacks = np.split(v.reshape(self._shape), self._split, axis=1)
        after = Start(v[self._next_v], flat(found["lam_x"])[self._next_v], flat(found["lam_g"])[self._next_g])
        return Horizon(U, X, slacks, float(found["f"]), status, int(stats.get("iter_count", 0))), after


def _weighted(columns: ca.MX, Q: Float[np.ndarray, "n n"]) -> ca.MX:
    """Return Σ over columns of eᵀQe."""
    return ca.sum1(ca.sum2(columns * ca.mtimes(ca.DM(Q), columns)))
