"""The equilibrium x = F(x, u) that holds a reference, and what the end of a horizon costs near it."""

from dataclasses import dataclass
from typing import Any, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Box
from koopmpc.control.outputs import Outputs
from koopmpc.control.riccati import stationary
from koopmpc.control.target import root
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State
from koopmpc.plant.step_map import StepMap

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "error_on_fail": False}
_KEPT = 10_000  # goals remembered before the memory starts anew
_STARTS = 12  # guesses of an equilibrium where the reference is not of the state
_MISSED = 1e-6  # share of ‖r‖²_Q that a good equilibrium may leave


@dataclass(frozen=True)
class Goal:
    """An equilibrium (x, u) for a reference row, and the cost ‖M of(x_N) + L x_N − m‖² of where a horizon ends."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    M: Float[np.ndarray, "nt nr"]  # nt = nx + nr
    L: Float[np.ndarray, "nt nx"]
    m: Float[np.ndarray, " nt"]


class Equilibria:
    """Reference row → Goal: minimises ‖of(x) − r‖²_Q over equilibria inside all limits, or else the input limits.

    The terminal cost is ‖d‖²_P, P the Riccati solution of the linearisation, or Q_N. The distance d is measured in
    the tracked outputs as far as they see it, d = J⁺(of(x_N) − of(x_r)) + (I − J⁺J)(x_N − x_r), J = ∂of/∂x: with
    sin θ and cos θ tracked it is the same at every turn of θ, and with of(x) = x it is x_N − x_r. The rest of
    of(x_N) − of(x_r), which no small motion changes, keeps its weight Q, times the mean size of P over JᵀQJ.

    Raises
    ------
    ShapeError
        Q_N weighs states, but the cost tracks something else.
    """

    def __init__(self, step_map: StepMap, cost: Cost, outputs: Outputs, most: int) -> None:
        self._step_map, self._cost, self._outputs, self._most = step_map, cost, outputs, most
        self._nr = len(outputs.Q)
        self._of_state = isinstance(cost.of, State) and cost.of.whole
        if cost.Q_N is not None:
            checks.weight(cost.Q_N, "Q_N", step_map.nx)
            if not self._of_state:
                raise ShapeError("Q_N weighs x_N − r_N, but the reference is not of the state; leave Q_N out")
        x = ca.SX.sym("x", step_map.nx)
        tracked = outputs.tracked(x)
        self._tracked = ca.Function("tracked", [x], [tracked, ca.densify(ca.jacobian(tracked, x))])
        self._solver = _solver(step_map, outputs)
        self._known: dict[bytes, Goal] = {}

    def __call__(self, row: Float[np.ndarray, " nr"]) -> Goal:
        """Return the goal of a reference row, kept for the next time."""
        key = row.tobytes()
        if key not in self._known:
            if len(self._known) > _KEPT:
                self._known.clear()
            self._known[key] = self._goal(row)
        return self._known[key]

    def _goal(self, row: Float[np.ndarray, " nr"]) -> Goal:
        x, u = self.find(row)
        held = u if self._cost.u_target == "equilibrium" else np.zeros_like(u)
        nx, Q = self._step_map.nx, self._outputs.Q
        M, L = np.zeros((nx + self._nr, self._nr)), np.zeros((nx + self._nr, nx))
        if self._cost.Q_N is not None:
            M[:nx] = root(checks.weight(self._cost.Q_N, "Q_N", nx))
            return Goal(row, held, M, L, M @ row)
        affine = self._step_map.linearize(x, u)
        of, J = (value.full() for value in cast("tuple[ca.DM, ca.DM]", self._tracked(x)))
        seen = J.T @ Q @ J
        P = stationary(affine.A, affine.B, seen, self._outputs.R, self._most).P
        back = pseudo_inverse(J)
        M[:nx] = root(P) @ back
        L[:nx] = root(P) @ (np.eye(nx) - back @ J)
        mean = float((P * pseudo_inverse(seen)).sum()) / max(np.linalg.matrix_rank(seen), 1)
        M[nx:] = np.sqrt(max(mean, 1.0)) * root(Q) @ (np.eye(self._nr) - J @ back)
        return Goal(x, held, M, L, M @ of.ravel() + L @ x)

    def find(
        self, row: Float[np.ndarray, " nr"]
    ) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]]:
        """Return the equilibrium (x, u) that holds a reference row, or comes nearest to it inside the limits."""
        nx, inputs, box = self._step_map.nx, self._outputs.inputs, self._outputs.box
        rest = np.clip(np.zeros(self._step_map.nu), *inputs)
        guesses = [np.concatenate([row if self._of_state else np.zeros(nx), rest])]
        if not self._of_state:  # the nearest stationary point may be a wrong one: hanging instead of upright
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
                        p=row,
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


def flat(matrix: ca.DM) -> Float[np.ndarray, " m"]:
    """Return the entries as an array."""
    return np.asarray(matrix.full(), dtype=np.float64).ravel()


def _solver(step_map: StepMap, outputs: Outputs) -> ca.Function:
    x, u = ca.MX.sym("x", step_map.nx), ca.MX.sym("u", step_map.nu)
    r = ca.MX.sym("r", len(outputs.Q))
    error = outputs.tracked(x) - r
    least = 1e-8 * max(float(np.trace(outputs.Q)), 1e-12)  # of all that hold r, the one of least size
    f = ca.mtimes([error.T, ca.DM(outputs.Q), error]) + least * (ca.sumsqr(u) + ca.sumsqr(x))
    g = ca.vertcat(step_map.F(x, u) - x, outputs.limited(x))
    return ca.nlpsol("equilibrium", "ipopt", {"x": ca.vertcat(x, u), "p": r, "f": f, "g": g}, QUIET)


def pseudo_inverse(J: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "n m"]:
    """Return J⁺, singular values below 1e-9 of the largest cut."""
    return np.asarray(np.linalg.pinv(J, rcond=1e-9), dtype=np.float64)
