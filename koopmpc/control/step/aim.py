"""Reference rows and the disturbance that lasts → what each stage of a nonlinear plan tracks and what its end costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base import checks
from koopmpc.control.nonlinear.equilibrium import CLOSE, Equilibrium, Response
from koopmpc.control.nonlinear.motion import BEYOND, Course, can_drift, extend_rows, shift_end
from koopmpc.control.nonlinear.problem import StagedProblem, StageTargets
from koopmpc.control.plan.row_targets import RowTarget, RowTargets, TerminalCost
from koopmpc.control.plan.tracking import StateTracking

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


class _Preview(NamedTuple):
    """What the rows of a reference ask for, before disturbances.

    R holds the rows r_0 … r_N, U and `slopes` the reference inputs and ∂u/∂e of all but the last, `held` says which of
    these equal the last one, and `target` is the last one's. `beyond` is how the reference goes on.
    """

    R: Float[np.ndarray, "N1 nr"]
    U: Float[np.ndarray, "N nu"]
    slopes: Float[np.ndarray, "N nu nx"]
    held: Bool[np.ndarray, " N"]
    target: RowTarget
    beyond: Course


class StageAim:
    """Reference, e and the weight of the last input → StageTargets, the same object until one of them moves.

    Parameters
    ----------
    targets, outputs, problem
        The targets of rows, what the cost tracks, and the stages.
    latency
        Steps until the first input of a plan acts.
    disturbed
        Whether disturbances, measured or estimated, move the target.
    """

    end: End  # of the last step

    def __init__(
        self, targets: RowTargets, outputs: StateTracking, problem: StagedProblem, latency: int, *, disturbed: bool
    ) -> None:
        self.targets, self._outputs, self._problem, self._latency = targets, outputs, problem, latency
        self._disturbed, self._moving = disturbed, MovingEnd(targets)
        self._goes_on = outputs.cost.moves_on and outputs.given is None
        tables = [table for table in (outputs.given, outputs.shift) if table is not None]
        self._last_row = max((len(table) for table in tables), default=1) - 1  # of inputs that are given in rows
        self.restart()

    def restart(self) -> None:
        """Begin at the first row of inputs that are given in rows."""
        self._row = 0
        self.forget()

    def forget(self) -> None:
        """Have the next step search its targets again."""
        self._seen: bytes | None = None  # the reference of the preview; None where rows are missing
        self._key: tuple[bytes, bytes, bytes, int] | None = None
        self._moving.forget()

    def at(
        self,
        reference: Float[np.ndarray, "..."],
        e: Float[np.ndarray, " nx"],
        root: Float[np.ndarray, "nu nu"],
        deadline: float,
    ) -> StageTargets | None:
        """Return the targets of the stages; None where the reference is not finite.

        e is the last disturbance of the preview without its periodic part: it goes on. `root` is S of the weight SᵀS of
        the last input. Where the deadline leaves rows out, the next step searches on.
        """
        seen = reference.tobytes()
        key = seen, e.tobytes(), root.tobytes(), self._row
        if key == self._key:
            return self.stages
        if seen != self._seen:
            self._seen = self._key = None
            R = checks.reference_rows(reference, len(self._problem.free), len(self._outputs.Q), self._latency)
            if not np.isfinite(R).all():
                return None
            self._preview, late = self._look_ahead(R, deadline)
            self._seen = None if late else seen
        self._key = None if self._seen is None else key
        self.stages = self._aim(self._preview, e, root)
        self._row = min(self._row + 1, self._last_row)
        return self.stages

    def _look_ahead(self, R: Float[np.ndarray, "N1 nr"], deadline: float) -> tuple[_Preview, bool]:
        """Return what these rows ask for, and whether there was no time to search all of them."""
        N, nu, nx = len(R) - 1, len(self._outputs.R), self.targets.equilibria.model.nx
        if self.targets.holds:
            (*before, last), late = self.targets.find(list(R), deadline)
            U, slopes = np.array([target.u for target in before]), np.array([target.slope for target in before])
        else:  # no input is asked for
            (last,), late = self.targets.find([R[-1]], deadline)
            U, slopes = np.zeros((N, nu)), np.zeros((N, nu, nx))
        beyond = extend_rows(R, BEYOND * (self._goes_on and last.is_found))
        return _Preview(R, U, slopes, (R[:-1] == R[-1]).all(axis=1), last, beyond), late

    def _aim(self, preview: _Preview, e: Float[np.ndarray, " nx"], root: Float[np.ndarray, "nu nu"]) -> StageTargets:
        R, U, slopes, held, target, _ = preview
        o, N = self._outputs, len(U)
        if self._disturbed:
            self.end = self._moving.at(target, e)
            U = np.clip(U + slopes @ e, *o.inputs)
            U[held] = self.end.u
        else:
            self.end = End(target.equilibrium, target.u, self.targets.finish_at(target))
        ahead, cost = np.arange(N + 1) + self._row + self._latency, self.end.cost
        if o.given is not None:  # row k of a given u_target counts at the k-th step
            given = o.given[np.minimum(ahead, len(o.given) - 1)]
            U, cost = given[:-1], cost._replace(m=cost.m + cost.V @ given[-1])
        if o.shift is not None:
            U = U + o.shift[np.minimum(ahead[:-1], len(o.shift) - 1)]
        cost = self._move_end(preview, self._weigh_last(R, cost, trajectory=o.given is not None and not held[-1]))
        R = R[1:] if o.pull is None else R[1:] + o.pull
        if not self._problem.with_rates:
            return StageTargets(R, U, cost.M, cost.L, cost.m)
        return _add_last_input(R, U, cost, root, self._problem.nx)

    def _weigh_last(self, R: Float[np.ndarray, "N1 nr"], cost: TerminalCost, *, trajectory: bool) -> TerminalCost:
        """Return Q of the last row where the plan has no tail; a `trajectory` of inputs ends at no equilibrium."""
        o = self._outputs
        if o.cost.Q_N is not None or not (trajectory or o.cost.tail == 0):
            return cost
        M = np.zeros_like(cost.M)
        M[: R.shape[1]] = o.Q_root
        last = R[-1] if o.pull is None else R[-1] + o.pull
        return TerminalCost(M, np.zeros_like(cost.L), np.zeros_like(cost.V), M @ last)

    def _move_end(self, preview: _Preview, cost: TerminalCost) -> TerminalCost:
        """Return the terminal cost where the reference goes on beyond its rows."""
        R, beyond, o, search = preview.R, preview.beyond, self._outputs, self.targets.equilibria
        if not len(beyond.rows):
            return cost
        rest = self.end.equilibrium
        at = search.linearise(rest.x, rest.u)
        followed = search.follow_row(at)
        if beyond.drifts and not can_drift(at, followed, o.Q_root, R):
            return cost
        held = followed[len(rest.x) :] if self.targets.holds else None
        return shift_end(cost, rest.u, at, (o.Q, o.R), search.size, np.vstack([R[-1], beyond.rows]), held)


def _add_last_input(
    R: Float[np.ndarray, "N nr"],
    U: Float[np.ndarray, "N nu"],
    cost: TerminalCost,
    root: Float[np.ndarray, "nu nu"],
    ns: int,
) -> StageTargets:
    """Return the targets of stages whose state holds the last input, at the cost ‖root (u_{N−1} − u_r)‖²."""
    M, L, V, m = cost
    (n, nr), nx, nu = M.shape, L.shape[1], U.shape[1]
    M_s, L_s, m_s = np.zeros((ns + nr + nu, nr + nu)), np.zeros((ns + nr + nu, ns)), np.zeros(ns + nr + nu)
    last = slice(nx, nx + nu)
    M_s[:n, :nr], L_s[:n, :nx], L_s[:n, last], m_s[:n] = M, L, V, m
    L_s[n : n + nu, last], m_s[n : n + nu] = root, root @ U[-1]
    return StageTargets(np.hstack([R, U]), np.zeros_like(U), M_s, L_s, m_s)
