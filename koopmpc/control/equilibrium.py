"""The equilibrium x = F(x, u) that holds a reference, and what the end of a horizon costs near it."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.horizon import one_step
from koopmpc.control.learned_map import LearnedMap
from koopmpc.control.limits import Box
from koopmpc.control.outputs import Outputs
from koopmpc.control.stationary import stationary
from koopmpc.control.target import TOLERANCE, root
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State
from koopmpc.plant.buffered import Buffered

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "error_on_fail": False}
_KEPT = 10_000  # goals remembered before the memory starts anew
_STARTS = 12  # guesses of an equilibrium where the reference is not of the state
_NEWTON = 20  # steps
_SETTLED = 1e-10  # of the size of (x, u)
_MISSED = 1e-6  # share of ‖r‖²_Q that a good equilibrium may leave


@dataclass(frozen=True)
class Goal:
    """An equilibrium (x, u) for a reference row, and the cost ‖M of(x_N) + L x_N + V u_{N−1} − m‖² of an end.

    A constant push e of the state moves the equilibrium's u by about `slope` e.
    """

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    M: Float[np.ndarray, "nt nr"]  # nt = nx + nr, or nx + nu + nr where changes of u are weighed
    L: Float[np.ndarray, "nt nx"]
    V: Float[np.ndarray, "nt nu"]
    m: Float[np.ndarray, " nt"]
    slope: Float[np.ndarray, "nu nx"]


class Equilibria:
    """Reference row → Goal: minimises ‖of(x) − r‖²_Q over equilibria inside all limits, or else the input limits.

    The terminal cost is ‖d‖²_P, P the Riccati solution of the linearisation, or Q_N. The distance d is measured in
    the tracked outputs as far as they see it, d = J⁺(of(x_N) − of(x_r)) + (I − J⁺J)(x_N − x_r), J = ∂of/∂x: with
    sin θ and cos θ tracked it is the same at every turn of θ, and with of(x) = x it is x_N − x_r. The rest of
    of(x_N) − of(x_r), which no small motion changes, keeps its weight Q, times the mean size of P over JᵀQJ. With
    R_delta, P weighs [d; u_{N−1} − u_r].

    Raises
    ------
    ShapeError
        Q_N weighs states, but the cost tracks something else.
    """

    def __init__(self, model: LearnedMap, cost: Cost, outputs: Outputs, most: int) -> None:
        self._model, self._cost, self._outputs, self._most = model, cost, outputs, most
        self._nr = len(outputs.Q)
        self._of_state = isinstance(cost.of, State) and cost.of.whole
        if cost.Q_N is not None:
            checks.weight(cost.Q_N, "Q_N", model.ny)
            if not self._of_state:
                raise ShapeError("Q_N weighs x_N − r_N, but the reference is not of the state; leave Q_N out")
        self._local = Local(model, outputs)
        self._solver = _solver(model, outputs)
        self._known: dict[bytes, Goal] = {}
        self._least = 1e-8 * max(float(np.trace(outputs.Q)), 1e-12)

    def adopt(self, model: LearnedMap) -> None:
        """Go on with another θ: what is known is found anew, from where it was."""
        self._model = model
        old, self._known = self._known, {}
        for key, goal in list(old.items())[-1:]:
            row = np.frombuffer(key)
            found = self._rest(goal.x, goal.u, row, np.zeros(model.nx))
            if found is not None:
                self._known[key] = self._goal(row, *found)

    def __call__(self, row: Float[np.ndarray, " nr"]) -> Goal:
        """Return the goal of a reference row, kept for the next time."""
        key = row.tobytes()
        if key not in self._known:
            if len(self._known) > _KEPT:
                self._known.clear()
            self._known[key] = self._goal(row, *self.find(row))
        return self._known[key]

    def pushed(self, row: Float[np.ndarray, " nr"], e: Float[np.ndarray, " nx"], near: Goal | None) -> Goal:
        """Return the goal of a row where x = F(x, u) + e; its search starts at the goal `near`."""
        goal = self(row)
        begin = goal if near is None else near
        found = self._rest(begin.x, begin.u, row, e) or self.find(row, e, begin)
        x, u = found
        held = u if self._cost.u_target == "equilibrium" else np.zeros_like(u)
        m = goal.m
        if self._cost.Q_N is None:
            of = self._local(x, u, self._model.theta).of
            m = goal.M @ of + goal.L @ x + goal.V @ held
        return replace(goal, x=x, u=held, m=m)

    def _goal(
        self, row: Float[np.ndarray, " nr"], x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]
    ) -> Goal:
        o, nx, Q = self._outputs, self._model.nx, self._outputs.Q
        hold = self._cost.u_target == "equilibrium"
        held = u if hold else np.zeros_like(u)
        at = self._local(x, u, self._model.theta)
        slope = self._slope(at) * hold
        if self._cost.Q_N is not None:
            M, L, V = (
                np.zeros((nx + self._nr, self._nr)),
                np.zeros((nx + self._nr, nx)),
                np.zeros((nx + self._nr, len(u))),
            )
            M[: self._nr] = root(checks.weight(self._cost.Q_N, "Q_N", self._nr))
            return Goal(x, held, M, L, V, M @ row, slope)
        J = at.J
        seen = J.T @ Q @ J
        step = one_step(at.A, at.B, seen, o.R, o.R_delta)
        P = stationary(step.A, step.B, step.Q, step.R, self._most, step.M).P
        n, S, back = len(P), root(P), pseudo_inverse(J)
        M, L, V = (
            np.zeros((n + self._nr, self._nr)),
            np.zeros((n + self._nr, nx)),
            np.zeros((n + self._nr, len(u))),
        )
        M[:n] = S[:, :nx] @ back
        L[:n] = S[:, :nx] @ (np.eye(nx) - back @ J)
        V[:n, : n - nx] = S[:, nx:]
        mean = float((P[:nx, :nx] * pseudo_inverse(seen)).sum()) / max(np.linalg.matrix_rank(seen), 1)
        M[n:] = np.sqrt(max(mean, 1.0)) * root(Q) @ (np.eye(self._nr) - J @ back)
        return Goal(x, held, M, L, V, M @ at.of + L @ x + V @ held, slope)

    def _moves(self, at: "Linearised") -> tuple[Float[np.ndarray, "n nx"], Float[np.ndarray, "n nz"]]:
        """Return the least motion of (x, u) per gain of F(x, u) − x, and a basis of the motions without any."""
        E = np.hstack([at.A - np.eye(self._model.nx), at.B])
        left, sigma, right = np.linalg.svd(E)
        rank = int((sigma > TOLERANCE * max(float(sigma[0]), 1e-300)).sum())
        return right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T

    def _weighted(self, at: "Linearised") -> Float[np.ndarray, "n m"]:
        """Return the matrix of the target's residuals on (x, u): of(x) first, then (x, u) at next to no weight."""
        nx, nu = self._model.nx, self._model.nu
        tracked = np.hstack([root(self._outputs.Q) @ at.J, np.zeros((self._nr, nu))])
        return np.vstack([tracked, np.sqrt(1e-6 * self._least) * np.eye(nx + nu)])

    def _slope(self, at: "Linearised") -> Float[np.ndarray, "nu nx"]:
        """Return ∂u/∂e of the equilibrium where no limit is active."""
        gain, free = self._moves(at)
        W = self._weighted(at)
        beta = np.linalg.lstsq(W @ free, W @ gain, rcond=None)[0]
        return (free @ beta - gain)[self._model.nx :]

    def _rest(
        self,
        x: Float[np.ndarray, " nx"],
        u: Float[np.ndarray, " nu"],
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"],
    ) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]] | None:
        """Return the equilibrium by Gauss–Newton steps from (x, u); None where a limit or convergence fails."""
        nx, o = self._model.nx, self._outputs
        weight, small = root(o.Q), np.sqrt(1e-6 * self._least)
        for _ in range(_NEWTON):
            at = self._local(x, u, self._model.theta)
            gain, free = self._moves(at)
            step = -gain @ (at.F + e - x)
            W, s = self._weighted(at), np.concatenate([x, u])
            left = np.concatenate([weight @ (row - at.of), -small * s])
            step += free @ np.linalg.lstsq(W @ free, left - W @ step, rcond=None)[0]
            if not np.isfinite(step).all():
                return None
            x, u = x + step[:nx], u + step[nx:]
            if np.abs(step).max() <= _SETTLED * (1 + np.abs(s).max()):
                at = self._local(x, u, self._model.theta)
                missed = np.abs(at.F + e - x).max() > _SETTLED * (1 + np.abs(x).max())
                g = at.g
                inside = (u >= o.inputs.low).all() and (u <= o.inputs.high).all()
                return (
                    None
                    if missed or not inside or (g < o.box.low).any() or (g > o.box.high).any()
                    else (x, u)
                )
        return None

    def find(
        self,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None = None,
        near: Goal | None = None,
    ) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]]:
        """Return the equilibrium (x, u) that holds a reference row, or comes nearest to it inside the limits."""
        nx, inputs, box = self._model.nx, self._outputs.inputs, self._outputs.box
        push = np.zeros(nx) if e is None else e
        rest = np.clip(np.zeros(self._model.nu), *inputs)
        guesses = [np.concatenate([self._model.held(row, rest) if self._of_state else np.zeros(nx), rest])]
        if near is not None:
            guesses = [np.concatenate([near.x, near.u])]
        elif (
            not self._of_state
        ):  # the nearest stationary point may be a wrong one: hanging instead of upright
            scatter = np.random.default_rng(0).uniform(-np.pi, np.pi, (_STARTS - 1, nx))
            guesses += [np.concatenate([x, rest]) for x in scatter]
        free = np.full(len(box.low), np.inf)
        good = _MISSED * float(row @ self._outputs.Q @ row)
        for limits in (box, Box(-free, free)):
            best, least = None, np.inf
            for guess in guesses:
                found = cast(
                    "dict[str, Any]",
                    self._solver(
                        p=np.concatenate([row, self._model.theta, push]),
                        x0=guess,
                        lbx=np.concatenate([np.full(nx, -np.inf), inputs.low]),
                        ubx=np.concatenate([np.full(nx, np.inf), inputs.high]),
                        lbg=np.concatenate([np.zeros(nx), limits.low]),
                        ubg=np.concatenate([np.zeros(nx), limits.high]),
                    ),
                )
                if self._solver.stats()["success"] and float(found["f"]) < least:
                    best, least = flat(found["x"]), float(found["f"])
                if least <= good:
                    break
            if best is not None:
                return best[:nx], best[nx:]
        return guesses[0][:nx], guesses[0][nx:]


class Linearised(NamedTuple):
    """F(x, u), its Jacobians A and B, of(x) and its Jacobian J, and the limited outputs g."""

    F: Float[np.ndarray, " nx"]
    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    of: Float[np.ndarray, " nr"]
    J: Float[np.ndarray, "nr nx"]
    g: Float[np.ndarray, " ng"]


class Local:
    """(x, u, θ) → Linearised."""

    def __init__(self, model: LearnedMap, outputs: Outputs) -> None:
        x, u, theta = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("t", len(model.theta))
        F, of = model.F(x, u, theta), outputs.tracked(x)
        found = [F, ca.jacobian(F, x), ca.jacobian(F, u), of, ca.jacobian(of, x), outputs.limited(x)]
        function = ca.Function("local", [x, u, theta], [ca.densify(each) for each in found])
        self._call = Buffered(function.expand() if model.F.is_a("SXFunction") else function)
        self._nx = model.nx

    def __call__(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], theta: Float[np.ndarray, " nt"]
    ) -> Linearised:
        """Return the linearisation at (x, u)."""
        F, A, B, of, J, g = self._call(x, u, theta)
        A, B = (M.reshape((self._nx, -1), order="F") for M in (A, B))
        return Linearised(F, A, B, of, J.reshape((-1, self._nx), order="F"), g)


def flat(matrix: ca.DM) -> Float[np.ndarray, " m"]:
    """Return the entries as an array."""
    return np.asarray(matrix.full(), dtype=np.float64).ravel()


def _solver(model: LearnedMap, outputs: Outputs) -> ca.Function:
    x, u = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu)
    r, theta, e = ca.MX.sym("r", len(outputs.Q)), ca.MX.sym("t", len(model.theta)), ca.MX.sym("e", model.nx)
    error = outputs.tracked(x) - r
    least = 1e-8 * max(float(np.trace(outputs.Q)), 1e-12)  # of all that hold r, the one of least size
    f = ca.mtimes([error.T, ca.DM(outputs.Q), error]) + least * (ca.sumsqr(u) + ca.sumsqr(x))
    g = ca.vertcat(model.F(x, u, theta) + e - x, outputs.limited(x))
    return ca.nlpsol(
        "equilibrium", "ipopt", {"x": ca.vertcat(x, u), "p": ca.vertcat(r, theta, e), "f": f, "g": g}, QUIET
    )


def pseudo_inverse(J: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "n m"]:
    """Return J⁺, singular values below 1e-9 of the largest cut."""
    return np.asarray(np.linalg.pinv(J, rcond=1e-9), dtype=np.float64)
