"""Multiple shooting: the nonlinear program of a horizon, its bounds, and its solution moved on by one step.

Bock & Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC 1984.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Box
from koopmpc.control.move import Status
from koopmpc.plant.step_map import StepMap

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "error_on_fail": False}
_STATUS = {
    "Solve_Succeeded": Status.OPTIMAL,
    "Solved_To_Acceptable_Level": Status.OPTIMAL,
    "Maximum_Iterations_Exceeded": Status.MAX_ITERATIONS,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}


class Horizon(NamedTuple):
    """A solution: inputs, states and slacks, stage by stage, and how the solver ended."""

    U: Float[np.ndarray, "N nu"]
    X: Float[np.ndarray, "N nx"]
    slacks: Float[np.ndarray, "N ns"]
    status: Status
    iterations: int


class Aim(NamedTuple):
    """What a horizon tracks: reference rows of x_1 … x_N, inputs u_r, and ‖x_N − x_r‖²_P at its end."""

    R: Float[np.ndarray, "N nr"]
    U: Float[np.ndarray, "N nu"]
    x: Float[np.ndarray, " nx"]
    P: Float[np.ndarray, "nx nx"]


class Shooting:
    """Variables [U; X; slacks], constraints x_{k+1} = F(x_k, u_k) and the limits; solved by IPOPT.

    Parameters
    ----------
    step_map
        F.
    tracked, limited
        CasADi functions of x: the tracked outputs, and the outputs that `outputs` limits.
    Q, R
        Stage weights.
    inputs, outputs
        Their limits; `slack` (linear, quadratic) relaxes those of the outputs, None does not.
    N
        Steps.
    options
        CasADi's options of the solver.
    """

    def __init__(
        self,
        step_map: StepMap,
        tracked: ca.Function,
        limited: ca.Function,
        Q: Float[np.ndarray, "nr nr"],
        R: Float[np.ndarray, "nu nu"],
        inputs: Box,
        outputs: Box,
        slack: tuple[float, float] | None,
        N: int,
        options: Mapping[str, Any],
    ) -> None:
        nx, nu, nr, ng = step_map.nx, step_map.nu, len(Q), len(outputs.low)
        ns = 0 if slack is None else ng
        U, X, E = ca.MX.sym("U", nu, N), ca.MX.sym("X", nx, N), ca.MX.sym("E", ns, N)
        x0, r, u_r = ca.MX.sym("x0", nx), ca.MX.sym("r", nr, N), ca.MX.sym("u_r", nu, N)
        x_r, P = ca.MX.sym("x_r", nx), ca.MX.sym("P", nx, nx)

        gaps = step_map.F.map(N)(ca.horzcat(x0, X[:, : N - 1]), U) - X
        end = X[:, N - 1] - x_r
        f = _weighted(U - u_r, R) + ca.mtimes([end.T, P, end])
        if N > 1:
            f += _weighted(tracked.map(N - 1)(X[:, : N - 1]) - r[:, : N - 1], Q)
        g, low, high = [ca.vec(gaps)], [np.zeros(N * nx)], [np.zeros(N * nx)]
        self._rows = [nx]  # entries of each block of constraints, a stage
        if ng:
            values = limited.map(N)(X)
            infinite = np.full(N * ng, np.inf)
            tiled = np.tile(outputs.low, N), np.tile(outputs.high, N)
            if slack is None:
                g, low, high = [*g, ca.vec(values)], [*low, tiled[0]], [*high, tiled[1]]
                self._rows += [ng]
            else:
                f += slack[0] * ca.sum1(ca.vec(E)) + slack[1] * ca.sumsqr(E)
                g += [ca.vec(values - E), ca.vec(values + E)]
                low, high = [*low, -infinite, tiled[0]], [*high, tiled[1], infinite]
                self._rows += [ng, ng]
        self._sizes = [nu, nx, ns]
        self._N = N
        free = np.full(N * nx, np.inf)
        self._bounds = {
            "lbx": np.concatenate([np.tile(inputs.low, N), -free, np.zeros(N * ns)]),
            "ubx": np.concatenate([np.tile(inputs.high, N), free, np.full(N * ns, np.inf)]),
            "lbg": np.concatenate(low),
            "ubg": np.concatenate(high),
        }
        nlp = {
            "x": ca.vertcat(ca.vec(U), ca.vec(X), ca.vec(E)),
            "p": ca.vertcat(x0, ca.vec(r), ca.vec(u_r), x_r, ca.vec(P)),
            "f": f,
            "g": ca.vertcat(*g),
        }
        expand = step_map.F.is_a("SXFunction")
        self._solver = ca.nlpsol("shooting", "ipopt", nlp, {**QUIET, **options, "expand": expand})
        self._rest = np.clip(np.zeros(nu), *inputs)
        self._warm: dict[str, Float[np.ndarray, ...]] | None = None

    def reset(self) -> None:
        """Forget the last solution: the next start is rest at x_0."""
        self._warm = None

    def solve(self, x0: Float[np.ndarray, " nx"], aim: Aim) -> Horizon:
        """Solve from the last solution moved on by one step, multipliers included."""
        p = np.concatenate([x0, aim.R.ravel(), aim.U.ravel(), aim.x, aim.P.ravel()])
        N = self._N
        start = self._warm or {
            "x0": np.concatenate([np.tile(self._rest, N), np.tile(x0, N), np.zeros(N * self._sizes[2])])
        }
        found = cast("dict[str, Any]", self._solver(p=p, **self._bounds, **start))
        stats = self._solver.stats()
        status = _STATUS.get(str(stats["return_status"]), Status.FAILED)
        primal = flat(found["x"])
        U, X, slacks = self._blocks(primal, self._sizes)
        if status is Status.OPTIMAL:
            self._warm = {
                "x0": self._moved_on(primal, self._sizes),
                "lam_x0": self._moved_on(flat(found["lam_x"]), self._sizes),
                "lam_g0": self._moved_on(flat(found["lam_g"]), self._rows),
            }
        else:
            self._warm = None
        return Horizon(U, X, slacks, status, int(stats.get("iter_count", 0)))

    def _blocks(self, values: Float[np.ndarray, " m"], sizes: list[int]) -> list[Float[np.ndarray, "N n"]]:
        ends = np.cumsum([self._N * size for size in sizes])[:-1]
        return [
            block.reshape(self._N, size) for block, size in zip(np.split(values, ends), sizes, strict=True)
        ]

    def _moved_on(self, values: Float[np.ndarray, " m"], sizes: list[int]) -> Float[np.ndarray, " m"]:
        blocks = self._blocks(values, sizes)
        return np.concatenate([np.vstack([block[1:], block[-1:]]).ravel() for block in blocks])


def flat(matrix: ca.DM) -> Float[np.ndarray, " m"]:
    """Return the entries as an array."""
    return np.asarray(matrix.full(), dtype=np.float64).ravel()


def _weighted(columns: ca.MX, Q: Float[np.ndarray, "n n"]) -> ca.MX:
    """Return Σ over columns of eᵀQe."""
    return ca.sum1(ca.sum2(columns * ca.mtimes(ca.DM(Q), columns)))
