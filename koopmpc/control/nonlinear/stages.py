"""The problem of a horizon in the form that solvers by stages take, with the inputs or their changes as its inputs.

Where changes of the inputs are weighed or limited, or moves are blocked, v_k = u_k − u_{k−1} is the input of
s = [x; u_{k−1}; v_{k−1}], s⁺ = [F(x, u_{k−1} + v); u_{k−1} + v; v]: R weighs the second part of s, R_delta v, the
limits of u are limits of s, and a held input is v = 0. v_{k−1} is there for the changes whose limits are soft.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from koopmpc.control.limits import Interval, Softness
from koopmpc.control.nonlinear.terminal import Goal
from koopmpc.control.target import root
from koopmpc.control.tracking import Outputs


class Problem(NamedTuple):
    """s⁺ = F(s, v, θ), what is tracked and limited of s, the weights, and the stages that have an input."""

    F: ca.Function
    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Interval
    box: Interval
    softness: Softness
    free: Bool[np.ndarray, " N"]

    @property
    def nx(self) -> int:
        """Entries of s."""
        return self.F.size1_in(0)


class Aim(NamedTuple):
    """What a horizon tracks: reference rows of s_1 … s_N, inputs, and the end ‖M of(s_N) + L s_N − m‖²."""

    R: Float[np.ndarray, "N nr"]
    U: Float[np.ndarray, "N nu"]
    M: Float[np.ndarray, "nt nr"]  # nt = ns + nr
    L: Float[np.ndarray, "nt ns"]
    m: Float[np.ndarray, " nt"]


class Direct:
    """The inputs are the inputs: s = x."""

    def __init__(self, F: ca.Function, outputs: Outputs, blocks: tuple[int, ...]) -> None:
        o = outputs
        free = np.ones(sum(blocks), dtype=np.bool_)
        self.problem = Problem(F, o.tracked, o.limited, o.Q, o.R, o.inputs, o.box, o.softness, free)

    def start(self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " ns"]:
        """Return s_0."""
        return x

    def aim(self, R: Float[np.ndarray, "N nr"], U_r: Float[np.ndarray, "N nu"], goal: Goal) -> Aim:
        """Return what is tracked, of reference rows, their inputs and a goal."""
        return Aim(R, U_r, goal.M, goal.L, goal.m)

    def along(
        self,
        X: Float[np.ndarray, "N1 nx"],
        U: Float[np.ndarray, "N nu"],
        u_prev: Float[np.ndarray, " nu"],
    ) -> tuple[Float[np.ndarray, "N1 ns"], Float[np.ndarray, "N nu"]]:
        """Return a plan of states and inputs in s and v, its inputs inside their limits."""
        return X, np.clip(U, *self.problem.inputs)

    def plan(
        self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]
    ) -> tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]:
        """Return the states and inputs of a plan."""
        return S, V

    def first(self, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval, bool]:
        """Return the limits of v_0, and whether they had to be widened."""
        return self.problem.inputs, False


class Changes:
    """The changes of the inputs are the inputs, in the first step of each block."""

    def __init__(self, F: ca.Function, outputs: Outputs, blocks: tuple[int, ...]) -> None:
        o = outputs
        nx, nu, N = F.size1_in(0), F.size1_in(1), sum(blocks)
        self._nx, self._nu, self._outputs = nx, nu, o
        unlimited = Interval(np.full(nu, -np.inf), np.full(nu, np.inf))
        rates = unlimited if o.rates is None else o.rates
        given = np.isfinite(rates.low) | np.isfinite(rates.high)
        soft = np.flatnonzero(given & np.isfinite(o.rate_softness.linear))
        self._soft = soft
        low, high = rates.low.copy(), rates.high.copy()
        low[soft], high[soft] = -np.inf, np.inf
        self._free = np.zeros(N, dtype=np.bool_)
        starts = np.cumsum([0, *blocks[:-1]])
        self._free[starts] = True
        self._start_of = np.repeat(starts, blocks)

        sym, theta = ca.MX.sym("s", nx + nu + len(soft)), ca.MX.sym("theta", F.size1_in(2))
        v = ca.MX.sym("v", nu)
        u = sym[nx : nx + nu] + v
        after = ca.Function("F", [sym, v, theta], [ca.vertcat(F(sym[:nx], u, theta), u, v[soft.tolist(), 0])])
        after = after.expand("F") if F.is_a("SXFunction") else after
        s = ca.SX.sym("s", nx + nu + len(soft))
        x, last = s[:nx], s[nx : nx + nu]
        limited = ca.vertcat(last, s[nx + nu :], o.limited(x))
        never = np.full(nu, np.inf), np.zeros(nu)
        self.problem = Problem(
            after,
            ca.Function("tracked", [s], [ca.vertcat(o.tracked(x), last)]),
            ca.Function("limited", [s], [limited]),
            _diagonal(o.Q, o.R),
            np.zeros((nu, nu)) if o.R_delta is None else o.R_delta,
            Interval(low, high),
            Interval(*(np.concatenate([o.inputs[i], rates[i][soft], o.box[i]]) for i in (0, 1))),
            Softness(*(np.concatenate([never[i], o.rate_softness[i][soft], o.softness[i]]) for i in (0, 1))),
            self._free,
        )

    def start(self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " ns"]:
        """Return s_0."""
        return np.concatenate([x, u_prev, np.zeros(len(self._soft))])

    def aim(self, R: Float[np.ndarray, "N nr"], U_r: Float[np.ndarray, "N nu"], goal: Goal) -> Aim:
        """Return what is tracked, of reference rows, their inputs and a goal."""
        nx, nu, nr, n = self._nx, self._nu, R.shape[1], len(goal.m)
        ns = self.problem.nx
        M, L = np.zeros((ns + nr + nu, nr + nu)), np.zeros((ns + nr + nu, ns))
        m = np.zeros(len(M))
        last = slice(nx, nx + nu)
        M[:n, :nr], L[:n, :nx], L[:n, last], m[:n] = goal.M, goal.L, goal.V, goal.m
        weight = root(self._outputs.R)
        L[n : n + nu, last], m[n : n + nu] = weight, weight @ U_r[-1]
        return Aim(np.hstack([R, U_r]), np.zeros_like(U_r), M, L, m)

    def along(
        self,
        X: Float[np.ndarray, "N1 nx"],
        U: Float[np.ndarray, "N nu"],
        u_prev: Float[np.ndarray, " nu"],
    ) -> tuple[Float[np.ndarray, "N1 ns"], Float[np.ndarray, "N nu"]]:
        """Return a plan of states and inputs in s and v, its inputs held in each block and inside their limits."""
        held = np.clip(U[self._start_of], *self._outputs.inputs)
        before = np.vstack([u_prev, held])
        V = np.diff(before, axis=0)
        late = np.vstack([np.zeros(self._nu), V])[:, self._soft]
        return np.hstack([X, before, late]), V

    def plan(
        self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]
    ) -> tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]:
        """Return the states and inputs of a plan."""
        U = S[0, self._nx : self._nx + self._nu] + np.cumsum(V * self._free[:, None], axis=0)
        return S[:, : self._nx], np.clip(U, *self._outputs.inputs)

    def first(self, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval, bool]:
        """Return the limits of v_0: where they do not reach the limits of u, these win."""
        low, high = self.problem.inputs
        inputs = self._outputs.inputs
        widened = Interval(np.minimum(low, inputs.high - u_prev), np.maximum(high, inputs.low - u_prev))
        conflict = (widened.low < low - 1e-9).any() or (widened.high > high + 1e-9).any()
        return widened, bool(conflict)


def _diagonal(Q: Float[np.ndarray, "nr nr"], R: Float[np.ndarray, "nu nu"]) -> Float[np.ndarray, "n n"]:
    """Return the block diagonal of Q and R."""
    whole = np.zeros((len(Q) + len(R), len(Q) + len(R)))
    whole[: len(Q), : len(Q)], whole[len(Q) :, len(Q) :] = Q, R
    return whole
