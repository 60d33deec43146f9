"""What a reference row asks of a plan on a nonlinear model: its equilibrium, its input, and what the end costs."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import ShapeError
from koopmpc.base.values import Value
from koopmpc.control.nonlinear.equilibrium import CLOSE, MISSED, Equilibria, Equilibrium, Response
from koopmpc.control.nonlinear.stages import LearnedMap
from koopmpc.control.plan.tracking import StateTracking
from koopmpc.control.riccati import one_step, stationary
from koopmpc.control.terminal_cost import tail_of, tail_stage
from koopmpc.lifting.state import State

PSEUDO = 1e-9  # singular values of the tracked outputs' slopes below this share of the largest count as zero


class TerminalCost(NamedTuple):
    """The cost ‖M of(x_N) + L x_N + V u_{N−1} − m‖² of a plan's end."""

    M: Float[np.ndarray, "nt nr"]  # nt = nx + nr, or nx + nu + nr where changes of u are weighed
    L: Float[np.ndarray, "nt nx"]
    V: Float[np.ndarray, "nt nu"]
    m: Float[np.ndarray, " nt"]


@dataclass(eq=False)
class RowTarget:
    """A reference row under w: its equilibrium, or where the search begins, and the reference input.

    The reference input `u` is that of the equilibrium, or zero where the cost asks for it. A constant disturbance e of
    the state moves it by about `slope` e. `end` is there once the row was the last one of a plan.
    """

    row: Float[np.ndarray, " nr"]
    w: Float[np.ndarray, " nw"]
    equilibrium: Equilibrium
    is_found: bool
    u: Float[np.ndarray, " nu"]
    slope: Float[np.ndarray, "nu nx"]
    end: TerminalCost | None = None


@dataclass(frozen=True, eq=False)
class TailProgram(Value):
    """What the terminal cost of a row is made of, in the sizes of x, u and the rows; see `RowTargets`.

    Attributes
    ----------
    steps
        Steps of the tail; 0 for as many as its gain takes to rest.
    row_size, scale
        Sizes of the tracked outputs, and of the cost.
    Q, R, R_delta
        Weights in these sizes; zeros where changes have no weight.
    end
        (nr, nr) S with SᵀS = Q_N where the cost has one, else zeros.
    """

    steps: int
    row_size: Float[np.ndarray, " nr"]
    scale: float
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"]
    end: Float[np.ndarray, "nr nr"]


class RowTargets:
    """Reference row and w → RowTarget, kept for the next time.

    A row is searched from the equilibrium of the row before it; by ipopt where there is none, or where that leads to
    limits or away from a row far off. Where a measured disturbance multiplies the state, the equilibrium is that of
    w = 0, moved with w: so two programs find the same one, and not a local optimum each. Where the row ended the last
    step, and no limit is active, it is moved from there.

    The terminal cost is ‖d‖²_P, P that of the tail along the linearisation, or Q_N. The distance d is measured in
    the tracked outputs as far as they see it, d = J⁺(of(x_N) − of(x_r)) + (I − J⁺J)(x_N − x_r), J = ∂of/∂x: with
    sin θ and cos θ tracked it is the same at every turn of θ, and with of(x) = x it is x_N − x_r. The part of
    of(x_N) − of(x_r) that no small motion changes keeps its weight Q, times the mean size of P over JᵀQJ. With
    R_delta, P weighs [d; u_{N−1} − u_r].

    Parameters
    ----------
    most
        Steps after which the Riccati difference equation ends, settled or not.

    Raises
    ------
    ShapeError
        Q_N weighs neither states nor what the cost tracks.
    """

    def __init__(self, model: LearnedMap, outputs: StateTracking, most: int) -> None:
        cost, self._outputs, self._most, nr = outputs.cost, outputs, most, len(outputs.Q)
        self.ends_given = cost.Q_N is not None
        self.holds = isinstance(cost.u_target, str) and cost.u_target == "equilibrium"
        Q_N = cast("ArrayLike | None", cost.Q_N)
        of_state = isinstance(cost.of, State) and cost.of.selects_all
        _check_end(Q_N, nr, of_state=of_state)
        self.equilibria = Equilibria(model, outputs)
        self._end_root = None if Q_N is None else checks.root(checks.weight(Q_N, "Q_N", nr))
        self._known: dict[tuple[bytes, bytes], RowTarget] = {}
        self._map, self._w = model, np.zeros(model.nw)
        self._last: RowTarget | None = None  # the one found last for w = 0
        self._end: RowTarget | None = None  # that of the last row of the last step

    def program(self) -> TailProgram:
        """Return the data of the terminal cost."""
        o, nr, su = self._outputs, len(self._outputs.Q), self._outputs.sizes.inputs
        scale, weights = o.sizes.scale, o.Q.diagonal()
        size = np.sqrt(scale / np.where(weights > 0, weights, scale))
        if self.equilibria.of_state:
            size = self.equilibria.size[:nr]
        changes = np.zeros_like(o.R) if o.R_delta is None else o.R_delta
        end = np.zeros((nr, nr)) if self._end_root is None else self._end_root
        R, R_delta = (weight * np.outer(su, su) / scale for weight in (o.R, changes))
        return TailProgram(o.cost.tail or 0, size, scale, o.Q * np.outer(size, size) / scale, R, R_delta, end)

    def find(self, rows: Sequence[Float[np.ndarray, " nr"]], deadline: float = np.inf) -> tuple[list[RowTarget], bool]:
        """Return the targets of rows, and whether there was no time for all of them.

        After the deadline no search begins but the first one; a row that is left out has the target of one without an
        equilibrium.
        """
        targets, late, searched = list[RowTarget](), False, False
        for row in rows:
            known = self._known.get((row.tobytes(), self._w.tobytes()))
            if known is None and searched and perf_counter() > deadline:
                late, known = True, self._describe(row, self._w, None)
            elif known is None:
                searched, known = True, self._find(row, self._w)
            targets.append(known)
        return targets, late

    def find_still(self, row: Float[np.ndarray, " nr"]) -> RowTarget:
        """Return the target of a row without measured disturbances, with its terminal cost."""
        still = np.zeros_like(self._w)
        target = self._find(row, still)
        self._move_map(still)
        self.weigh_end(target)
        self._move_map(self._w)
        return target

    def finish_at(self, target: RowTarget) -> TerminalCost:
        """Return the terminal cost of the last row of a step, from which the search for the next w begins."""
        self._end = target
        return self.weigh_end(target)

    def schedule(self, w: Float[np.ndarray, " nw"]) -> None:
        """Go on with another w that multiplies the state."""
        self._w = w + 0.0
        self._move_map(self._w)

    def reset(self) -> None:
        """Look again for the equilibria that were not found, and begin as if no row had been asked for."""
        self._known = {key: target for key, target in self._known.items() if target.is_found and not target.w.any()}
        self._last = self._end = None
        if self._w.any():
            self.schedule(np.zeros_like(self._w))

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ: the last target is searched again, from where it was."""
        end, self._last, self._end, self._map, self._known = self._end, None, None, model, {}
        self._move_map(self._w)
        if end is not None and (end.w == self._w).all():
            equilibrium = self.equilibria.near(end.equilibrium, end.row)
            if equilibrium is not None:
                self._keep(self._describe(end.row, end.w, equilibrium))

    def _move_map(self, w: Float[np.ndarray, " nw"]) -> None:
        self.equilibria.update(self._map.at(w))

    def _keep(self, target: RowTarget, most: int = 10_000) -> None:
        """Keep a target; beyond so many rows the memory is cleared."""
        if len(self._known) > most:
            self._known.clear()
        self._known[target.row.tobytes(), target.w.tobytes()] = target

    def _find(self, row: Float[np.ndarray, " nr"], w: Float[np.ndarray, " nw"]) -> RowTarget:
        """Return the target of a row under w, of which the map is afterwards."""
        target = self._known.get((row.tobytes(), w.tobytes()))
        if target is None:
            equilibrium = self._move_with(w, row) if w.any() else self._search(row)
            target = self._describe(row.copy(), w.copy(), equilibrium)
            self._keep(target)
            if not w.any():
                self._last = target if target.is_found else None
        return target

    def _search(self, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return the equilibrium of a row for w = 0: from the last one, or from afar."""
        self._move_map(np.zeros_like(self._w))
        equilibria, last = self.equilibria, self._last
        if last is not None:
            equilibrium = equilibria.near(last.equilibrium, row)
            if equilibrium is not None and (self._is_beside(last.row, row) or self._is_held(equilibrium, row)):
                return equilibrium
        return self._search_afar(row)

    def _search_afar(self, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return the equilibrium of a row by ipopt, and to rounding by Gauss–Newton steps, as C finds it.

        Where several inputs hold a row, these steps go on to the smallest, and ipopt may have stopped far before.
        """
        rough = self.equilibria.find(row)
        exact = None if rough is None else self.equilibria.near(rough, row)
        if rough is None or exact is None:
            return rough
        return exact if self.equilibria.is_nearer(exact, rough, row) else rough

    def _is_beside(self, last: Float[np.ndarray, " nr"], row: Float[np.ndarray, " nr"], near: float = 0.3) -> bool:
        """Return whether a row is within this share of a row's size of the last one: then equilibria are beside."""
        size = self.equilibria.size[: len(row)] if self.equilibria.of_state else np.zeros_like(row)
        way, *sizes = (float(np.linalg.norm(self._outputs.Q_root @ part)) for part in (row - last, row, last, size))
        return way <= near * max(sizes)

    def _is_held(self, equilibrium: Equilibrium, row: Float[np.ndarray, " nr"]) -> bool:
        """Return whether an equilibrium holds its row without active limits, among the data: none is better then."""
        if equilibrium.active.any() or self.equilibria.is_outside(equilibrium.x):
            return False
        weight, of = self.equilibria.weight, self.equilibria.linearise(equilibrium.x, equilibrium.u).of
        missed, size = weight @ (row - of), weight @ row
        return bool(missed @ missed <= MISSED * (1 + size @ size))

    def _move_with(
        self, w: Float[np.ndarray, " nw"], row: Float[np.ndarray, " nr"], pieces: int = 40, patience: int = 5
    ) -> Equilibrium | None:
        """Return the equilibrium of a row under w, moved there from that of the last step, or of w = 0.

        The way from w = 0 has at most so many pieces; at its end there are `patience` times as many steps.
        """
        equilibria, end = self.equilibria, self._end
        if end is not None and end.is_found and (end.row == row).all() and not end.equilibrium.active.any():
            self._move_map(w)
            equilibrium = equilibria.near(end.equilibrium, row)
            if equilibrium is not None and not equilibrium.active.any():
                return equilibrium
        begin, done, stride = self._find(row, np.zeros_like(w)).equilibrium, 0.0, 1.0
        for _ in range(pieces):
            share = min(done + stride, 1.0)
            self._move_map(share * w)
            equilibrium = equilibria.near(begin, row, careful=True)
            if equilibrium is None:
                stride /= 2
                continue
            begin, done, stride = equilibrium, share, 2 * stride
            if done == 1:
                return equilibrium
        self._move_map(w)
        equilibrium = equilibria.near(begin, row, careful=True, patience=patience)
        return self._search_afar(row) if equilibrium is None else equilibrium

    def _describe(
        self, row: Float[np.ndarray, " nr"], w: Float[np.ndarray, " nw"], equilibrium: Equilibrium | None
    ) -> RowTarget:
        """Return the target of a row; without an equilibrium inputs count from zero."""
        model, equilibria = self._map, self.equilibria
        point = equilibria.guess(row) if equilibrium is None else equilibrium
        slope = np.zeros((model.nu, model.nx))
        if equilibrium is not None and self.holds:
            slope = equilibria.slope(equilibria.linearise(point.x, point.u))
        return RowTarget(row, w, point, equilibrium is not None, point.u * self.holds, slope)

    def weigh_end(self, target: RowTarget) -> TerminalCost:
        """Return the terminal cost of a row, whose w the map has; kept with the row."""
        if target.end is None:
            weighs_alone = self._end_root is not None or not target.is_found
            target.end = self._weigh_row(target) if weighs_alone else self._weigh_tail(target)
        return target.end

    def _weigh_row(self, target: RowTarget) -> TerminalCost:
        """Return ‖of(x_N) − r‖² by Q_N or Q."""
        o, model, nr = self._outputs, self._map, len(target.row)
        n = model.nx + model.nu * (o.R_delta is not None and self._end_root is None) + nr
        M, L, V = (np.zeros((n, columns)) for columns in (nr, model.nx, model.nu))
        M[:nr] = checks.root(o.Q) if self._end_root is None else self._end_root
        return TerminalCost(M, L, V, M @ target.row)

    def _weigh_tail(self, target: RowTarget) -> TerminalCost:
        """Return the cost of the tail along the linearisation at the equilibrium of a row."""
        o, tail, (x, u, _), nr = self._outputs, self.program(), target.equilibrium, len(target.row)
        nx, at = len(x), self.equilibria.linearise(x, u)
        sx, su = np.split(self.equilibria.size, [nx])
        sr, Q, R = tail.row_size, tail.Q, tail.R
        R_delta = None if o.R_delta is None else tail.R_delta
        A, B, J = at.A * sx / sx[:, None], at.B * su / sx[:, None], at.J * sx / sr[:, None]
        seen = J.T @ Q @ J
        back, inverse = (np.linalg.pinv(slopes, rcond=PSEUDO) for slopes in (J, seen))
        P = stationary(one_step(A, B, seen, R, R_delta), self._most).P
        if tail.steps:
            P = tail_of(tail_stage(A, B, np.eye(nx), J, Q, R, R_delta), tail.steps).P
        n, S = len(P), np.sqrt(tail.scale) * checks.root(P)
        M, L, V = (np.zeros((n + nr, columns)) for columns in (nr, nx, len(u)))
        M[:n] = S[:, :nx] @ back / sr
        L[:n] = S[:, :nx] @ (np.eye(nx) - back @ J) / sx
        V[:n, : n - nx] = S[:, nx:] / su[: n - nx]
        mean = float((P[:nx, :nx] * inverse).sum()) / max(np.linalg.matrix_rank(seen), 1)
        M[n:] = np.sqrt(max(mean, 1.0)) * o.Q_root @ (np.eye(nr) - sr[:, None] * (J @ back) / sr)
        return TerminalCost(M, L, V, M @ at.of + L @ x + V @ target.u)


def _check_end(Q_N: ArrayLike | None, nr: int, *, of_state: bool) -> None:
    """Raise a ShapeError where Q_N weighs neither states nor what the cost tracks."""
    shape = np.shape(Q_N) if Q_N is not None else ()
    if Q_N is not None and not of_state and shape != (nr, nr):
        raise ShapeError(
            f"Q_N weighs x_N − r_N, but the reference is not of the state; pass ({nr}, {nr}) on what the cost"
            " tracks, or leave Q_N out"
        )
    if of_state and shape and shape[0] != nr:
        raise ShapeError(
            f"Q_N has shape {shape}, expected ({nr}, {nr}) of the tracked states; for lifted coordinates let"
            " the cost track the lifting of the model: of=model.lifting, with references as long"
        )


AWAY = 2.0  # an equilibrium at limits may be so many sizes of a state from that of its row


class End(NamedTuple):
    """Where a plan ends: the equilibrium, the reference input there, and the terminal cost."""

    equilibrium: Equilibrium
    u: Float[np.ndarray, " nu"]
    cost: TerminalCost


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
        self._chord: tuple[np.ndarray, Response, np.ndarray] | None = None  # s₀, the step, slopes of [u; g] on s

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
        if self._chord is None or np.abs(s - self._chord[0]).max() > close:
            nu = len(begin.u)
            limited = np.zeros((nu + len(at.G), nx + nu))
            limited[:nu, nx:], limited[nu:, :nx] = np.eye(nu), at.G
            self._chord = s, search.respond(at), limited * search.size
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
