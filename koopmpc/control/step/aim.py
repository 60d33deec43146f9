"""Reference rows and the disturbance that lasts → what each stage of a nonlinear plan tracks and what its end costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base import checks
from koopmpc.control.nonlinear.equilibrium import Linearisation
from koopmpc.control.nonlinear.stages import StageTargets
from koopmpc.control.nonlinear.task import StagedTask
from koopmpc.control.plan.row_targets import End, MovingEnd, RowTarget, RowTargets, TerminalCost

BEYOND = 10  # horizons for which a reference goes on beyond its rows
ORDERS = (2, 3, 4, 6)  # of linear recurrences with a constant: a ramp or a sine has 2, two sines have 4
FITS = 1e-9  # share of a column's spread by which the recurrence may miss a row of the preview
GROWS = 1e-3  # a recurrence may grow by this share a step
DRIFTS = 1e-7  # a recurrence whose coefficients sum to 1 up to this drifts: it goes on for one horizon, then rests
FOLLOWS = 1e-2  # a reference drifts on where equilibria follow it up to this share of its way
RESTS = 3  # equal rows at the end of a preview that say that the reference rests
STILL = 1e-12  # share of the largest row below which a column does not move
TERMS = 1e-11  # directions of a column's past below this share of the largest have no coefficient
ROUNDING = 1e-13  # directions of the inputs below this share of the largest have no gain
REST_STEPS = 2**20  # steps, slow ones too, in which the loop behind the end brings each tracked output to rest
LEFT = 0.1  # share of an output's errors that may be left then
SEEN = 1e-5  # directions of x_N below this share of the largest cost nothing at the end


class Course(NamedTuple):
    """Rows of a reference behind a moving preview, none without a recurrence, and whether it drifts, as a ramp does."""

    rows: Float[np.ndarray, "T nr"]
    drifts: bool = False


def extend_rows(R: Float[np.ndarray, "N1 nr"], horizons: int = BEYOND) -> Course | None:
    """Return the rows after R by the shortest linear recurrence r_k = Σ c_i r_{k−i} + c that all rows of R obey.

    (0, nr) if a column obeys no such recurrence, or one that grows; None if the last rows rest. A column that drifts
    goes on for one horizon and rests then.
    """
    if not horizons or (R[-RESTS:] == R[-1]).all():
        return None
    columns = [_extend_column(column, horizons * (len(R) - 1)) for column in R.T]
    known = [column for column in columns if column is not None]
    if len(known) < len(columns):
        return Course(np.zeros((0, R.shape[1])))
    return Course(np.column_stack([rows for rows, _ in known]), any(drifts for _, drifts in known))


def _extend_column(r: Float[np.ndarray, " N1"], count: int) -> tuple[Float[np.ndarray, " T"], bool] | None:
    spread = np.ptp(r)
    if spread <= STILL * np.abs(r).max() or (r[-RESTS:] == r[-1]).all():
        return np.full(count, r[-1]), False
    z = (r - r[-1]) / spread
    for order in ORDERS:
        rows = len(z) - order
        if rows < order + 2:
            break
        past = np.column_stack([*(z[i : rows + i] for i in range(order)), np.ones(rows)])
        c: Float[np.ndarray, " n"] = np.asarray(np.linalg.lstsq(past, z[order:], rcond=TERMS)[0], dtype=np.float64)
        if np.abs(past @ c - z[order:]).max() > FITS or _grows(c[:order]):
            continue
        step = np.eye(order + 1, k=1)
        step[order - 1], step[order] = c, np.eye(order + 1)[order]
        ahead = (step @ np.append(z[-order:], 1.0))[None]
        while len(ahead) < count:  # rows 1 … 2ⁿ, from 1 … 2ⁿ⁻¹
            ahead, step = np.vstack([ahead, ahead @ step.T]), step @ step
        values, drifts = ahead[:count, order - 1], bool(abs(1 - c[:order].sum()) < DRIFTS)
        if drifts:
            values[len(r) - 1 :] = values[len(r) - 2]
        return r[-1] + spread * values, drifts
    return None


def _grows(c: Float[np.ndarray, " n"]) -> bool:
    """Return whether r_k = Σ c_i r_{k−n+i} has a root beyond 1 + GROWS, by the Schur–Cohn recursion."""
    a = -c[::-1] / (1 + GROWS) ** np.arange(1, len(c) + 1)
    while len(a):
        last = a[-1]
        if not abs(last) < 1:
            return True
        a = (a[:-1] - last * a[-2::-1]) / (1 - last**2) if len(a) > 1 else a[:0]
    return False


def can_drift(
    at: Linearisation,
    followed: Float[np.ndarray, "n nr"],
    Q_root: Float[np.ndarray, "nr nr"],
    R: Float[np.ndarray, "N1 nr"],
) -> bool:
    """Return whether equilibria hold what the rows R move through: J ∂x/∂r d = d for d from the first to the last."""
    d = R[-1] - R[0]
    missed = at.J @ (followed[: len(at.A)] @ d) - d
    return bool(np.linalg.norm(Q_root @ missed) <= FOLLOWS * np.linalg.norm(Q_root @ d))


def shift_end(
    end: TerminalCost,
    u: Float[np.ndarray, " nu"],
    at: Linearisation,
    weights: tuple[Float[np.ndarray, "nr nr"], Float[np.ndarray, "nu nu"]],
    size: Float[np.ndarray, " n"],
    rows: Float[np.ndarray, "T1 nr"],
    held: Float[np.ndarray, "nu nr"] | None,
) -> TerminalCost | None:
    """Return the cost of x_N where the rows r_N, r_{N+1}, … come, by the linear tracking problem behind x_N.

    A single row, after which nothing is known, takes the place of of(x_r). None where the loop of the linearisation
    leaves errors of the tracked outputs: a vehicle at rest cannot move sideways, and its tail would invent a motion.

    u is the input of the equilibrium x_r. With x̃ = x − x_r and δ_k = r_k − of(x_r) the cost-to-go is
    x̃ᵀP x̃ − 2 p_Nᵀx̃ + …, so the target moves by P⁺p_N. Backward from p = 0 after the last row,
    p_k = JᵀQ δ_k + (A − B K)ᵀ p_{k+1} − Kᵀ R v_k. v_k is the input that costs nothing, from u_r on: `held` δ_k where
    inputs count from the one that holds a row, else −u_r. P is the end's cost. `weights` are a root of Q, and R;
    `size` that of x and u.

    References
    ----------
    Anderson & Moore, "Optimal Control: Linear Quadratic Methods", 1990, section 4.3 (servo and tracking problems).
    """
    nx = len(at.A)
    sx, su = np.split(size, [nx])
    A, B, J = at.A * sx / sx[:, None], at.B * su / sx[:, None], at.J * sx
    Q_root, R = weights[0], weights[1] * np.outer(su, su)
    S = (end.M @ at.J + end.L) * sx
    PB = S.T @ (S @ B)
    K: Float[np.ndarray, "nu nx"] = np.asarray(np.linalg.lstsq(R + B.T @ PB, PB.T @ A, rcond=ROUNDING)[0])
    D = rows - at.of
    wanted = np.tile(-u / su, (len(D), 1)) if held is None else D @ (held / su[:, None]).T
    closed, seen = A - B @ K, Q_root @ J
    p = D @ Q_root.T @ seen - wanted @ (R @ K)
    with np.errstate(over="ignore", invalid="ignore"):
        left = np.linalg.norm(seen @ np.linalg.matrix_power(closed, REST_STEPS), axis=1)
        while len(p) > 1:  # Σ closedᵀᵏ p_k: neighbours at once
            if len(p) % 2:
                p = np.vstack([p, np.zeros(nx)])
            p, closed = p[::2] + p[1::2] @ closed, closed @ closed
    if not ((left <= LEFT * np.linalg.norm(seen, axis=1)).all() and np.abs(p).max() < checks.HUGE):
        return None
    return end._replace(m=end.m + (p[0] @ np.linalg.pinv(S, rcond=SEEN) if len(D) > 1 else end.M @ D[0]))


class _Preview(NamedTuple):
    """What the rows of a reference ask for, before disturbances.

    R holds the rows r_0 … r_N, U and `slopes` the reference inputs and ∂u/∂e of all but the last, `held` says which of
    these equal the last one, and `target` is the last one's. `beyond` is how the reference goes on, None where it rests
    or the end is not to follow.
    """

    R: Float[np.ndarray, "N1 nr"]
    U: Float[np.ndarray, "N nu"]
    slopes: Float[np.ndarray, "N nu nx"]
    held: Bool[np.ndarray, " N"]
    target: RowTarget
    beyond: Course | None


class StageAim:
    """Reference, e and the weight of the last input → StageTargets, the same object until one of them moves."""

    end: End  # of the last step

    def __init__(self, task: StagedTask) -> None:
        outputs = self._outputs = task.outputs
        self.targets = RowTargets(task.map, outputs, 10 * task.N)
        self._problem, self._latency = task.problem, task.latency
        self._disturbed, self._moving = task.disturbed, MovingEnd(self.targets)
        self._goes_on = outputs.cost.moves_on and outputs.given is None
        tables = [table for table in (outputs.given, outputs.shift) if table is not None]
        self._last_row = max((len(table) for table in tables), default=1) - 1  # of inputs that are given in rows

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
        """Return the terminal cost where the reference moves at its last row."""
        R, beyond, o, search = preview.R, preview.beyond, self._outputs, self.targets.equilibria
        if beyond is None:
            return cost
        rest = self.end.equilibrium
        at = search.linearise(rest.x, rest.u)
        followed = search.follow_row(at)
        goes_on = not beyond.drifts or can_drift(at, followed, o.Q_root, R)
        rows = np.vstack([R[-1], beyond.rows]) if goes_on else R[-1:]
        held = followed[len(rest.x) :] if self.targets.holds else None
        moved = shift_end(cost, rest.u, at, (o.Q_root, o.R), search.size, rows, held)
        return self._weigh_last(R, cost, trajectory=True) if moved is None else moved


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
