"""Goals: the equilibrium that holds a reference, and what the end of a horizon costs near it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.linear.horizon import one_step
from koopmpc.control.nonlinear.equilibrium import CLOSE, Rest, Rests
from koopmpc.control.nonlinear.model import LearnedMap
from koopmpc.control.riccati import stationary
from koopmpc.control.target import root
from koopmpc.control.tracking import Outputs
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State

_KEPT = 10_000  # goals remembered before the memory starts anew


@dataclass(frozen=True)
class Goal:
    """An equilibrium for a reference row, its u, and the cost ‖M of(x_N) + L x_N + V u_{N−1} − m‖² of an end.

    A constant push e of the state moves the equilibrium's u by about `slope` e.
    """

    rest: Rest
    u: Float[np.ndarray, " nu"]  # that of the equilibrium, or zero where the cost asks for it
    M: Float[np.ndarray, "nt nr"]  # nt = nx + nr, or nx + nu + nr where changes of u are weighed
    L: Float[np.ndarray, "nt nx"]
    V: Float[np.ndarray, "nt nu"]
    m: Float[np.ndarray, " nt"]
    slope: Float[np.ndarray, "nu nx"]

    @property
    def x(self) -> Float[np.ndarray, " nx"]:
        """The state of the equilibrium."""
        return self.rest.x


class Equilibria:
    """Reference row → Goal.

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
        of_state = isinstance(cost.of, State) and cost.of.whole
        if cost.Q_N is not None:
            checks.weight(cost.Q_N, "Q_N", model.ny)
            if not of_state:
                raise ShapeError("Q_N weighs x_N − r_N, but the reference is not of the state; leave Q_N out")
        self.rests = Rests(model, outputs, of_state=of_state)
        self._known: dict[bytes, Goal] = {}

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ: what is known is found anew, from where it was."""
        self._model = self.rests.model = model
        old, self._known = self._known, {}
        for key, goal in list(old.items())[-1:]:
            row = np.frombuffer(key)
            found = self.rests.near(goal.rest, row, np.zeros(model.nx))
            if found is not None:
                self._known[key] = self._goal(row, found)

    def __call__(self, row: Float[np.ndarray, " nr"]) -> Goal:
        """Return the goal of a reference row, kept for the next time."""
        key = row.tobytes()
        if key not in self._known:
            if len(self._known) > _KEPT:
                self._known.clear()
            self._known[key] = self._goal(row, self.rests.find(row))
        return self._known[key]

    def pushed(self, row: Float[np.ndarray, " nr"], e: Float[np.ndarray, " nx"], near: Goal | None) -> Goal:
        """Return the goal of a row where x = F(x, u) + e, from the goal `near` of the step before, mostly in one step.

        What that leaves is of the square of what e has moved, and gone once e rests.
        """
        goal = self(row)
        begin = (goal if near is None else near).rest
        rest = self.rests.near(begin, row, e, CLOSE) or self.rests.find(row, e, begin)
        held = rest.u if self._cost.u_target == "equilibrium" else np.zeros_like(rest.u)
        m = goal.m
        if self._cost.Q_N is None:
            of = self.rests.local(rest.x, rest.u, self._model.theta).of
            m = goal.M @ of + goal.L @ rest.x + goal.V @ held
        return replace(goal, rest=rest, u=held, m=m)

    def _goal(self, row: Float[np.ndarray, " nr"], rest: Rest) -> Goal:
        o, nx, nr, Q = self._outputs, self._model.nx, self._nr, self._outputs.Q
        hold = self._cost.u_target == "equilibrium"
        held = rest.u if hold else np.zeros_like(rest.u)
        at = self.rests.local(rest.x, rest.u, self._model.theta)
        slope = self.rests.slope(at) * hold
        if self._cost.Q_N is not None:
            M, L, V = (np.zeros((nx + nr, columns)) for columns in (nr, nx, len(held)))
            M[:nr] = root(checks.weight(self._cost.Q_N, "Q_N", nr))
            return Goal(rest, held, M, L, V, M @ row, slope)
        J = at.J
        seen = J.T @ Q @ J
        step = one_step(at.A, at.B, seen, o.R, o.R_delta)
        P = stationary(step.A, step.B, step.Q, step.R, self._most, step.M).P
        n, S, back = len(P), root(P), pseudo_inverse(J)
        M, L, V = (np.zeros((n + nr, columns)) for columns in (nr, nx, len(held)))
        M[:n] = S[:, :nx] @ back
        L[:n] = S[:, :nx] @ (np.eye(nx) - back @ J)
        V[:n, : n - nx] = S[:, nx:]
        mean = float((P[:nx, :nx] * pseudo_inverse(seen)).sum()) / max(np.linalg.matrix_rank(seen), 1)
        M[n:] = np.sqrt(max(mean, 1.0)) * root(Q) @ (np.eye(nr) - J @ back)
        return Goal(rest, held, M, L, V, M @ at.of + L @ rest.x + V @ held, slope)


def pseudo_inverse(J: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "n m"]:
    """Return J⁺, singular values below 1e-9 of the largest cut."""
    return np.asarray(np.linalg.pinv(J, rcond=1e-9), dtype=np.float64)
