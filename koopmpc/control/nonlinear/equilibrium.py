"""The equilibrium x = F(x, u) + e that holds a reference, or comes nearest to it inside the limits.

Near a guess by Gauss–Newton steps with the limits that are active held; from afar, or where these fail, by ipopt.
"""

from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Interval
from koopmpc.control.nonlinear.model import LearnedMap
from koopmpc.control.target import TOLERANCE, root
from koopmpc.control.tracking import Outputs
from koopmpc.plants.buffered import Buffered

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "error_on_fail": False}
SETTLED = 1e-10  # of the size of (x, u): a Gauss–Newton step that is the last
CLOSE = 1e-2  # the same where the next control step will go on: what it leaves is of the square of it
_NEWTON = 20  # steps
_AT = 1e-6  # of a limit: how near ipopt stays to one that is active
_STARTS = 12  # guesses of an equilibrium where the reference is not of the state
_MISSED = 1e-6  # share of ‖r‖²_Q that a good equilibrium may leave


class Rest(NamedTuple):
    """An equilibrium, and for each limited value of [u; g(x)] whether it is at its upper (1) or lower (−1) limit."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    active: Int[np.ndarray, " nl"]


class Linearised(NamedTuple):
    """F(x, u), its Jacobians A and B, of(x) and its Jacobian J, the limited outputs g and their Jacobian G."""

    F: Float[np.ndarray, " nx"]
    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    of: Float[np.ndarray, " nr"]
    J: Float[np.ndarray, "nr nx"]
    g: Float[np.ndarray, " ng"]
    G: Float[np.ndarray, "ng nx"]


class Local:
    """(x, u, θ) → Linearised."""

    def __init__(self, model: LearnedMap, outputs: Outputs) -> None:
        x, u, theta = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("t", len(model.theta))
        F, of, g = model.F(x, u, theta), outputs.tracked(x), outputs.limited(x)
        found = [F, ca.jacobian(F, x), ca.jacobian(F, u), of, ca.jacobian(of, x), g, ca.jacobian(g, x)]
        function = ca.Function("local", [x, u, theta], [ca.densify(each) for each in found])
        self._call = Buffered(function.expand() if model.F.is_a("SXFunction") else function)
        self._nx = model.nx

    def __call__(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], theta: Float[np.ndarray, " nt"]
    ) -> Linearised:
        """Return the linearisation at (x, u)."""
        F, A, B, of, J, g, G = self._call(x, u, theta)
        A, B = (M.reshape((self._nx, -1), order="F") for M in (A, B))
        J, G = (M.reshape((-1, self._nx), order="F") for M in (J, G))
        return Linearised(F, A, B, of, J, g, G)


class Rests:
    """Reference row, push e → Rest: minimises ‖of(x) − r‖²_Q inside all limits, or else the input limits.

    Of all that hold r it is the one of least size.
    """

    def __init__(self, model: LearnedMap, outputs: Outputs, *, of_state: bool) -> None:
        self.model = model
        self._outputs, self._of_state = outputs, of_state
        self.local = Local(model, outputs)
        self._least = 1e-8 * max(float(np.trace(outputs.Q)), 1e-12)
        self._solver = _solver(model, outputs, self._least)
        self._weight, self._small = root(outputs.Q), np.sqrt(1e-6 * self._least)
        inputs, box = outputs.inputs, outputs.box
        self._low, self._high = np.concatenate([inputs.low, box.low]), np.concatenate([inputs.high, box.high])

    def slope(self, at: Linearised) -> Float[np.ndarray, "nu nx"]:
        """Return ∂u/∂e of the equilibrium where no limit is active."""
        gain, free = _moves(np.hstack([at.A - np.eye(self.model.nx), at.B]))
        W = self._weighted(at)
        beta = np.linalg.lstsq(W @ free, W @ gain, rcond=None)[0]
        return (free @ beta - gain)[self.model.nx :]

    def near(
        self,
        begin: Rest,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"],
        enough: float = SETTLED,
    ) -> Rest | None:
        """Return the equilibrium by Gauss–Newton steps from `begin`, None where they do not lead to one.

        The limits that are active at `begin` are held, one that is broken is added, and one that only holds back is
        released. The last step is at most `enough` of the size of (x, u).
        """
        nx, nu, theta = self.model.nx, self.model.nu, self.model.theta
        s, active = np.concatenate([begin.x, begin.u]), begin.active.copy()
        limited = np.zeros((len(active), nx + nu))
        limited[:nu, nx:] = np.eye(nu)
        for _ in range(_NEWTON):
            at = self.local(s[:nx], s[nx:], theta)
            limited[nu:, :nx] = at.G
            values = np.concatenate([s[nx:], at.g])
            held = np.flatnonzero(active)
            ends = np.where(active > 0, self._high, self._low)
            E = np.vstack([np.hstack([at.A - np.eye(nx), at.B]), limited[held]])
            missed = np.concatenate([at.F + e - s[:nx], values[held] - ends[held]])
            gain, free = _moves(E)
            W = self._weighted(at)
            left = np.concatenate([self._weight @ (row - at.of), -self._small * s])
            step = -gain @ missed
            step += free @ np.linalg.lstsq(W @ free, left - W @ step, rcond=None)[0]
            if not np.isfinite(step).all():
                return None
            size = 1 + np.abs(s).max()
            s = s + step
            reached, tolerance = values + limited @ step, 1e-9 * (1 + np.abs(values))
            pull = active[held] * (gain.T @ (W.T @ (left - W @ step)))[nx:]  # multipliers, positive where it holds
            over = np.where(active == 0, np.maximum(reached - self._high, self._low - reached) - tolerance, -np.inf)
            if len(pull) and pull.min() < -1e-9 * np.abs(pull).max():
                active[held[pull.argmin()]] = 0
            elif over.size and over.max() > 0:
                worst = int(over.argmax())
                active[worst] = 1 if reached[worst] > self._high[worst] else -1
            elif np.abs(step).max() <= enough * size:
                if np.abs(E @ step + missed).max() > SETTLED * size:
                    return None
                return Rest(s[:nx], np.clip(s[nx:], *self._outputs.inputs), active)
        return None

    def find(
        self,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None = None,
        near: Rest | None = None,
    ) -> Rest:
        """Return the equilibrium that holds a reference row, by ipopt: from `near`, or from several guesses."""
        nx, inputs, box = self.model.nx, self._outputs.inputs, self._outputs.box
        push = np.zeros(nx) if e is None else e
        rest = np.clip(np.zeros(self.model.nu), *inputs)
        guesses = [np.concatenate([self.model.held(row, rest) if self._of_state else np.zeros(nx), rest])]
        if near is not None:
            guesses = [np.concatenate([near.x, near.u])]
        elif not self._of_state:  # the nearest stationary point may be a wrong one: hanging instead of upright
            scatter = np.random.default_rng(0).uniform(-np.pi, np.pi, (_STARTS - 1, nx))
            guesses += [np.concatenate([x, rest]) for x in scatter]
        free = np.full(len(box.low), np.inf)
        good = _MISSED * float(row @ self._outputs.Q @ row)
        best = guesses[0]
        for limits in (box, Interval(-free, free)):
            found, least = None, np.inf
            for guess in guesses:
                solved = cast(
                    "dict[str, Any]",
                    self._solver(
                        p=np.concatenate([row, self.model.theta, push]),
                        x0=guess,
                        lbx=np.concatenate([np.full(nx, -np.inf), inputs.low]),
                        ubx=np.concatenate([np.full(nx, np.inf), inputs.high]),
                        lbg=np.concatenate([np.zeros(nx), limits.low]),
                        ubg=np.concatenate([np.zeros(nx), limits.high]),
                    ),
                )
                if self._solver.stats()["success"] and float(solved["f"]) < least:
                    found, least = flat(solved["x"]), float(solved["f"])
                if least <= good:
                    break
            if found is not None:
                best = found
                break
        return self._rest(best)

    def _rest(self, s: Float[np.ndarray, " n"]) -> Rest:
        """Return s = [x; u] with the limits that it is at."""
        nx = self.model.nx
        values = np.concatenate([s[nx:], self.local(s[:nx], s[nx:], self.model.theta).g])
        reach = _AT * (1 + np.abs(values))
        above = (values >= self._high - reach).astype(np.intp)
        return Rest(s[:nx], s[nx:], np.where(values <= self._low + reach, -1, above))

    def _weighted(self, at: Linearised) -> Float[np.ndarray, "n m"]:
        """Return the matrix of the target's residuals on (x, u): of(x) first, then (x, u) at next to no weight."""
        (nr, nx), n = at.J.shape, self.model.nx + self.model.nu
        W = self._small * np.eye(nr + n, n, -nr)
        W[:nr, :nx] = self._weight @ at.J
        return W


def _moves(E: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n k"]]:
    """Return the pseudo-inverse of E, and a basis of its null space."""
    left, sigma, right = np.linalg.svd(E)
    rank = int((sigma > TOLERANCE * max(float(sigma[0]), 1e-300)).sum())
    return right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T


def flat(matrix: ca.DM) -> Float[np.ndarray, " m"]:
    """Return the entries as an array."""
    return np.asarray(matrix.full(), dtype=np.float64).ravel()


def _solver(model: LearnedMap, outputs: Outputs, least: float) -> ca.Function:
    x, u = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu)
    r, theta, e = ca.MX.sym("r", len(outputs.Q)), ca.MX.sym("t", len(model.theta)), ca.MX.sym("e", model.nx)
    error = outputs.tracked(x) - r
    f = ca.mtimes([error.T, ca.DM(outputs.Q), error]) + least * (ca.sumsqr(u) + ca.sumsqr(x))
    g = ca.vertcat(model.F(x, u, theta) + e - x, outputs.limited(x))
    return ca.nlpsol(
        "equilibrium", "ipopt", {"x": ca.vertcat(x, u), "p": ca.vertcat(r, theta, e), "f": f, "g": g}, QUIET
    )
