"""The end of a plan as a constant disturbance moves it: mostly one Gauss–Newton step from that of the last step."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.nonlinear.equilibrium import CLOSE, Equilibrium, Response
from koopmpc.control.plan.row_targets import RowTarget, RowTargets, TerminalCost

AWAY = 2.0  # an equilibrium at limits may be so many sizes of a state from that of its row


class End(NamedTuple):
    """Where a plan ends: the equilibrium, the reference input there, and the terminal cost."""

    equilibrium: Equilibrium
    u: Float[np.ndarray, " nu"]
    cost: TerminalCost


class _Chord(NamedTuple):
    """The Gauss–Newton step from s₀, and the slopes of the limited values [u; g] there on (x, u) by sizes."""

    s: Float[np.ndarray, " n"]
    response: Response
    limited: Float[np.ndarray, "nl n"]


class MovingEnd:
    """Row target and e, where x⁺ = F(x, u) + e → End.

    The error that one step leaves is of the square of the change of e, and gone once e rests. The step takes the
    factors of an earlier one as long as that was close by: repeated, it converges the faster the closer that was, at a
    fraction of the time.
    """

    def __init__(self, targets: RowTargets) -> None:
        self._targets = targets
        self.forget()

    def forget(self) -> None:
        """Begin at the target of the row, for it is of another model or of another w."""
        self._last: Equilibrium | None = None
        self._chord: _Chord | None = None

    def at(self, target: RowTarget, e: Float[np.ndarray, " nx"]) -> End:
        """Return the end of a row under e.

        Where no Gauss–Newton steps lead to an equilibrium, or only e makes limits active and the equilibrium is far, as
        under noise beyond what inputs hold, it is that of the row: ipopt went on to equilibria thousands of sizes away,
        to which no loop should be led.
        """
        search, cost, own = self._targets.equilibria, self._targets.finish_at(target), target.equilibrium
        begin = own if self._last is None else self._last
        rest = self._follow(begin, target.row, e) or search.near(begin, target.row, e, CLOSE)
        if rest is None or not target.is_found or self._is_far(rest, own):
            self._last = own
            return End(own, target.u, cost)
        self._last = rest
        u = rest.u * self._targets.holds
        if not self._targets.ends_given:
            of = search.linearise(rest.x, rest.u).of
            cost = cost._replace(m=cost.M @ of + cost.L @ rest.x + cost.V @ u)
        return End(rest, u, cost)

    def _follow(
        self, begin: Equilibrium, row: Float[np.ndarray, " nr"], e: Float[np.ndarray, " nx"]
    ) -> Equilibrium | None:
        """Return the equilibrium by one step from `begin`; None where it is not close, or a limit is active."""
        if begin.active.any():
            return None
        search, nx = self._targets.equilibria, len(begin.x)
        s, at = np.concatenate([begin.x, begin.u]) / search.size, search.linearise(begin.x, begin.u)
        close = CLOSE * (1 + np.abs(s).max())
        if self._chord is None or np.abs(s - self._chord.s).max() > close:
            nu = len(begin.u)
            limited = np.zeros((nu + len(at.G), nx + nu))
            limited[:nu, nx:], limited[nu:, :nx] = np.eye(nu), at.G
            self._chord = _Chord(s, search.respond(at), limited * search.size)
        _, (H, T), limited = self._chord
        step = H @ ((at.F + e - begin.x) / search.size[:nx]) + T @ search.residuals(at, row, s)
        reached = np.concatenate([begin.u, at.g]) + limited @ step
        if not np.abs(step).max() <= close or (reached > search.high).any() or (reached < search.low).any():
            return None
        x, u = np.split((s + step) * search.size, [nx])
        return Equilibrium(x, u, begin.active)

    def _is_far(self, rest: Equilibrium, own: Equilibrium) -> bool:
        """Return whether an equilibrium at limits is several sizes of the state from one that meets them."""
        away = (np.abs(rest.x - own.x) / self._targets.equilibria.size[: len(own.x)]).max()
        return bool(rest.active.any() and not own.active.any() and away > AWAY)
