"""The equilibrium x = F(x, u) + e that holds a reference row, or comes nearest to it inside the limits.

Near a guess it is found by Gauss–Newton steps that keep the active limits; from afar, or where these fail, by ipopt.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Interval, Value
from koopmpc.control.ask.bounds import SOFTENED
from koopmpc.control.nonlinear.stages import LearnedMap, point_sizes
from koopmpc.control.plan.tracking import StateTracking
from koopmpc.lifting.state import State
from koopmpc.plants.routines import Buffered

RANK = 1e-12  # singular values below this share of the largest are rounding; ipopt meets all others too


class GaussNewtonStep(NamedTuple):
    """A Gauss–Newton step on s = (x, u) by sizes: `back` to the conditions E s = …, `along` them to the row.

    The conditions are those of an equilibrium and of the limits `held`. `values` are [u; g] by sizes, `limited` their
    slopes, `gain` is the pseudo-inverse of E, and W s + … the residuals, which are `left` before the step.
    """

    back: Float[np.ndarray, " n"]
    along: Float[np.ndarray, " n"]
    E: Float[np.ndarray, "m n"]
    missed: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, "n m"]
    free: int  # directions in which an equilibrium may move
    held: Int[np.ndarray, " nh"]
    values: Float[np.ndarray, " nl"]
    limited: Float[np.ndarray, "nl n"]
    W: Float[np.ndarray, "nw n"]
    left: Float[np.ndarray, " nw"]

    def multipliers(self, step: Float[np.ndarray, " n"], active: Int[np.ndarray, " nl"]) -> Float[np.ndarray, " nh"]:
        """Return the multipliers of the limits held, positive where a limit holds the row back."""
        pull = self.gain.T @ (self.W.T @ (self.left - self.W @ step))
        return active[self.held] * pull[len(self.E) - len(self.held) :]


def exchange_limits(
    step: GaussNewtonStep,
    whole: Float[np.ndarray, " n"],
    active: Int[np.ndarray, " nl"],
    limits: Interval,
    *,
    careful: bool,
) -> tuple[Int[np.ndarray, " nl"], float] | None:
    """Return the limits active after a step, and the share of it to take; None where a corner has no way out.

    At a corner nothing is free to move. For the new limit another one gives way: the one whose multiplier would
    change its sign first.
    """
    multipliers, after = step.multipliers(whole, active), active.copy()
    if len(multipliers) and multipliers.min() < -1e-9 * np.abs(multipliers).max():
        after[step.held[multipliers.argmin()]] = 0
        return after, 1.0
    hit, share = _find_hit(step.values, step.limited @ whole, limits, active, careful=careful)
    if not hit:
        return after, 1.0
    if careful and not step.free:
        toward = step.gain.T @ (np.sign(hit) * step.limited[abs(hit) - 1])
        push = active[step.held] * toward[len(toward) - len(step.held) :]
        if not (push > RANK).any():
            return None
        shares = np.maximum(multipliers, 0.0) / np.where(push > RANK, push, np.nan)
        after[step.held[np.nanargmin(shares)]] = 0
    after[abs(hit) - 1] = np.sign(hit)
    return after, share


def invert(E: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n k"]]:
    """Return the pseudo-inverse of E, and a basis of its null space."""
    left, sigma, right = np.linalg.svd(E)
    rank = int((sigma > RANK * max(float(sigma[0]), 1e-300)).sum())
    return right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T


def find_length(
    last: tuple[np.ndarray, np.ndarray] | None, now: Float[np.ndarray, " n"], bent: float = 0.25, least: float = 0.05
) -> float:
    """Return the length of a Gauss–Newton step: below 1 where the cost bent more than it knows along the last one.

    `last` are the step that was taken and the whole one. From that to `now` it has changed by as much as its slope
    along the one that was taken tells. A step is shorter where the cost bends by more than the share `bent` beyond its
    Gauss–Newton part, and no shorter than `least`.

    References
    ----------
    Barzilai & Borwein, "Two-point step size gradient methods", IMA J. Numer. Anal. 8, 1988.
    """
    if last is None:
        return 1.0
    taken, whole = last
    bend, size = float(taken @ (whole - now)), float(taken @ taken)
    return max(size / bend, least) if bend > (1 + bent) * size else 1.0


def _find_hit(
    values: Float[np.ndarray, " nl"],
    moved: Float[np.ndarray, " nl"],
    limits: Interval,
    active: Int[np.ndarray, " nl"],
    *,
    careful: bool,
) -> tuple[int, float]:
    """Return the limit that a step breaks first, i + 1 if it is an upper one, else −i − 1, and the share up to it.

    (0, 1) where it breaks none. If not `careful`, or where values are outside already, the one that is broken most, and
    the whole step.
    """
    low, high = limits
    over, under, rounding = values + moved - high, low - values - moved, 1e-9 * (1 + np.abs(values))
    past = np.where(active == 0, np.maximum(over, under) - rounding, -np.inf)
    broken = np.flatnonzero(past > 0)
    if not len(broken):
        return 0, 1.0
    ends = np.where(over[broken] > under[broken], high[broken], low[broken])
    room = np.where(over[broken] > under[broken], ends - values[broken], values[broken] - ends)
    if not careful or (room < -rounding[broken]).any():
        i, share = int(broken[past[broken].argmax()]), 1.0
    else:
        shares = np.maximum(room, 0.0) / np.abs(moved[broken])
        i, share = int(broken[shares.argmin()]), float(shares.min())
    return (i + 1 if over[i] > under[i] else -i - 1), share


SETTLED = 1e-10  # the last Gauss–Newton step is at most this share of the size of (x, u)
CLOSE = 1e-2  # steps below this share of the size of (x, u) leave an error of the square of this share
SMALL = 1e-7  # weight of (x, u) by their sizes in the residuals: of all equilibria that hold a row the least is found
MISSED = 1e-6  # share of ‖r‖²_Q that an equilibrium may leave and still hold its row
_QUIET = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "error_on_fail": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
}


class Equilibrium(NamedTuple):
    """An equilibrium; `active` is 1 (−1) where a limited value of [u; g(x)] is at its upper (lower) limit, else 0."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    active: Int[np.ndarray, " nl"]


class Linearisation(NamedTuple):
    """F(x, u), its Jacobians A and B, of(x) and its Jacobian J, the limited outputs g and their Jacobian G."""

    F: Float[np.ndarray, " nx"]
    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    of: Float[np.ndarray, " nr"]
    J: Float[np.ndarray, "nr nx"]
    g: Float[np.ndarray, " ng"]
    G: Float[np.ndarray, "ng nx"]


class Response(NamedTuple):
    """How (x, u), by their sizes, follow F(x, u) + e − x and the residuals of a row where no limit is active.

    A Gauss–Newton step is H (F(x, u) + e − x) + T residuals.
    """

    H: Float[np.ndarray, "n nx"]
    T: Float[np.ndarray, "n m"]


@dataclass(frozen=True, eq=False)
class RestProgram(Value):
    """The search for the equilibrium x = F(x, u) + e that holds a reference, from the last one, where e moves it.

    Attributes
    ----------
    weight
        (nr, nr) S with SᵀS = Q, by the size of the cost.
    size, limit_size
        Sizes of (x, u), and of the limited values [u; g(x)].
    low, high
        Limits of [u; g(x)].
    """

    weight: Float[np.ndarray, "nr nr"]
    size: Float[np.ndarray, " n"]
    limit_size: Float[np.ndarray, " nl"]
    low: Float[np.ndarray, " nl"]
    high: Float[np.ndarray, " nl"]


@dataclass(frozen=True)
class _Patience:
    """How many Gauss–Newton steps are tried, whole ones, or those of a careful way, which may be shorter.

    `starts` is the number of ipopt's guesses where the reference is not of the state.
    """

    whole: int = 20
    shortened: int = 40
    starts: int = 12


_PATIENCE = _Patience()


class Equilibria:
    """Reference row and disturbance e → Equilibrium: minimises ‖of(x) − r‖²_Q inside all limits.

    Where none is inside all limits, those of the inputs alone count. Of all that hold r it has the least x and u, by
    their sizes.
    """

    @raise_swallowed()
    def __init__(self, model: LearnedMap, outputs: StateTracking) -> None:
        cost, self.model, self._outputs, o = outputs.cost, model, outputs, outputs
        self.of_state = isinstance(cost.of, State) and cost.of.selects_all
        x, u, theta = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("t", len(model.theta))
        F, of, g = model.F(x, u, theta), o.tracked(x), o.limited(x)
        values = [F, ca.jacobian(F, x), ca.jacobian(F, u), of, ca.jacobian(of, x), g, ca.jacobian(g, x)]
        local = ca.Function("local", [x, u, theta], [ca.densify(value) for value in values])
        self._local = Buffered(local.expand() if model.F.is_a("SXFunction") else local)
        self._scale, inputs = o.sizes.scale, o.sizes.inputs
        self.size = np.concatenate([point_sizes(model, o), inputs])
        self._limit_size = np.concatenate([inputs, o.softness.allowance / SOFTENED])
        r, e, s = ca.MX.sym("r", len(o.Q)), ca.MX.sym("e", model.nx), ca.MX.sym("s", model.nx + model.nu)
        least = 1e-8 * ca.sumsqr(s)  # s, the rows and f are x and u, x and limits, and the cost by their sizes
        f = ca.mtimes([(of - r).T, ca.DM(o.Q / self._scale), of - r])
        rows = ca.vertcat((F + e - x) / self.size[: model.nx], g / self._limit_size[model.nu :])
        raw = ca.Function("raw", [x, u, r, theta, e], [f, rows])
        scaled = raw(s[: model.nx] * self.size[: model.nx], s[model.nx :] * inputs, r, theta, e)
        nlp = {"x": s, "p": ca.vertcat(r, theta, e), "f": scaled[0] + least, "g": scaled[1]}
        self._solver = ca.nlpsol("equilibrium", "ipopt", nlp, _QUIET)
        self.weight = o.Q_root / np.sqrt(self._scale)
        self.low, self.high = (np.concatenate([o.inputs[i], o.outputs[i]]) for i in (0, 1))

    def __reduce__(self) -> tuple[type["Equilibria"], tuple[LearnedMap, StateTracking]]:
        return Equilibria, (self.model, self._outputs)

    def program(self) -> RestProgram:
        """Return the data of the search from a last equilibrium."""
        return RestProgram(self.weight, self.size, self._limit_size, self.low, self.high)

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ."""
        self.model = model

    def linearise(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Linearisation:
        """Return the linearisation at (x, u)."""
        nx = len(x)
        F, A, B, of, J, g, G = self._local(x, u, self.model.theta)
        A, B = (M.reshape((nx, -1), order="F") for M in (A, B))
        J, G = (M.reshape((-1, nx), order="F") for M in (J, G))
        return Linearisation(F, A, B, of, J, g, G)

    def residuals(
        self, at: Linearisation, row: Float[np.ndarray, " nr"], s: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " m"]:
        """Return the residuals of a row, and those of (x, u) at next to no weight, s in their sizes."""
        return np.concatenate([self.weight @ (row - at.of), -SMALL * s])

    def respond(self, at: Linearisation) -> Response:
        """Return the Gauss–Newton step where no limit is active."""
        gain, free = invert(self._holding(at))
        W = self._residual_slopes(at)
        T = free @ np.linalg.pinv(self._along(W, free))
        return Response(T @ W @ gain - gain, T)

    def slope(self, at: Linearisation) -> Float[np.ndarray, "nu nx"]:
        """Return ∂u/∂e of the equilibrium where no limit is active."""
        nx = len(at.A)
        return self.size[nx:, None] * self.respond(at).H[nx:] / self.size[:nx]

    def follow_row(self, at: Linearisation) -> Float[np.ndarray, "n nr"]:
        """Return ∂(x, u)/∂r of the equilibrium where no limit is active."""
        return self.size[:, None] * (self.respond(at).T[:, : len(self.weight)] @ self.weight)

    def near(
        self,
        begin: Equilibrium,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None = None,
        enough: float = SETTLED,
        *,
        careful: bool = False,
        patience: int = 1,
    ) -> Equilibrium | None:
        """Return the equilibrium by Gauss–Newton steps from `begin`, None where they do not lead to one.

        The limits that are active at `begin` are held. A limit that is broken is added, and one whose multiplier has
        the wrong sign is released. The last step is at most `enough` of the size of (x, u). `careful` steps end at the
        first limit that they would break. Where they would swing, as far from a row that cannot be reached, they are as
        short as Barzilai and Borwein's; there may be `patience` times as many.
        """
        nx, e = self.model.nx, np.zeros(self.model.nx) if e is None else e
        s, active = cast("np.ndarray", np.concatenate([begin.x, begin.u]) / self.size), begin.active
        limits = Interval(self.low / self._limit_size, self.high / self._limit_size)
        last: tuple[np.ndarray, np.ndarray] | None = None  # the step along, taken and whole, while limits stay
        for _ in range(patience * _PATIENCE.shortened if careful else _PATIENCE.whole):
            try:
                step = self._find_step(s, active, row, e)
            except RuntimeError:  # an implicit step does not converge, or CVODES gives up
                return None
            length = find_length(last, step.along) if careful else 1.0
            taken = cast("np.ndarray", length * step.along)
            whole = step.back + taken
            reach = 1 + float(np.abs(s).max())
            if not np.isfinite(whole).all():
                return None
            exchanged = exchange_limits(step, whole, active, limits, careful=careful)
            if exchanged is None:
                return None
            changed, share = exchanged
            last, same = (taken, step.along), np.array_equal(changed, active)
            s, active = cast("np.ndarray", s + share * whole), changed
            if not same:
                last = None
                continue
            last_step = enough if length == 1.0 else SETTLED  # steps that swing leave more than their square
            if np.abs(step.back + step.along).max() <= last_step * reach:
                if np.abs(step.E @ whole + step.missed).max() > SETTLED * reach:
                    return None
                x, u = np.split(s * self.size, [nx])
                return Equilibrium(x, np.clip(u, *self._outputs.inputs), active)
        return None

    def _find_step(
        self,
        s: Float[np.ndarray, " n"],
        active: Int[np.ndarray, " nl"],
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"],
    ) -> GaussNewtonStep:
        """Return the Gauss–Newton step from s with these limits active."""
        (nx, nu), size, sizes = (self.model.nx, self.model.nu), self.size, self._limit_size
        x, u = np.split(s * size, [nx])
        at = self.linearise(x, u)
        limited = np.zeros((len(active), nx + nu))
        limited[:nu, nx:], limited[nu:, :nx] = np.eye(nu), at.G * size[:nx] / sizes[nu:, None]
        values, held = np.concatenate([u, at.g]) / sizes, np.flatnonzero(active)
        ends = np.where(active > 0, self.high, self.low)[held] / sizes[held]
        E = np.vstack([self._holding(at), limited[held]])
        missed = np.concatenate([(at.F + e - x) / size[:nx], values[held] - ends])
        (gain, free), W, left = invert(E), self._residual_slopes(at), self.residuals(at, row, s)
        back = -gain @ missed
        along: Float[np.ndarray, " n"] = free @ np.linalg.lstsq(self._along(W, free), left - W @ back, rcond=None)[0]
        return GaussNewtonStep(back, along, E, missed, gain, free.shape[1], held, values, limited, W, left)

    def guess(self, row: Float[np.ndarray, " nr"]) -> Equilibrium:
        """Return where the search for the equilibrium of a row begins: the state that it names, inputs at zero."""
        model, u = self.model, np.clip(np.zeros(self.model.nu), *self._outputs.inputs)
        x = np.zeros(model.nx)
        if self.of_state:
            weighed, cloud = self._outputs.Q.any(axis=0), model.cloud  # of other states a reference may say nothing
            x = row if cloud is None else np.where(weighed, row, cloud[0])
            x = x if model.embedding is None else model.embedding.repeat(x, u)
        return Equilibrium(x, u, np.zeros(len(self.low), dtype=np.intp))

    def find(
        self,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None = None,
        near: Equilibrium | None = None,
    ) -> Equilibrium | None:
        """Return the equilibrium that holds a row, by ipopt, from `near` or several guesses, or None.

        A learned model may hold a row at several states. Where the one that is found first lies outside its data, one
        among them is looked for.
        """
        x, u, _ = self.guess(row)
        guesses = [np.concatenate([x, u] if near is None else [near.x, near.u])]
        if near is None and not self.of_state:  # the nearest stationary point may be wrong: hanging, not upright
            scatter = np.random.default_rng(0).uniform(-np.pi, np.pi, (_PATIENCE.starts - 1, self.model.nx))
            guesses += [np.concatenate([x, u]) for x in scatter]
        nearest = self._minimise(row, e, guesses)
        if near is not None or nearest is None or not self.is_outside(nearest.x):
            return nearest
        others = [self._minimise(row, e, [guess]) for guess in self._guess_among_data(row, u)]
        least = self.measure_miss(nearest.x, row)
        as_good = [other for other in others if other is not None and self.measure_miss(other.x, row) <= least]
        return min([nearest, *as_good], key=lambda equilibrium: self.is_outside(equilibrium.x))

    def _guess_among_data(
        self, row: Float[np.ndarray, " nr"], u: Float[np.ndarray, " nu"]
    ) -> list[Float[np.ndarray, " n"]]:
        """Return two guesses among the data, with the inputs u and with inputs amid their limits."""
        model, of, (low, high) = self.model, self._outputs.cost.of, self._outputs.inputs
        assert model.cloud is not None, "outside of data that are known"
        y, both, amid = model.cloud[0].copy(), np.isfinite(low) & np.isfinite(high), u.copy()
        if isinstance(of, State):
            chosen = np.array(cast("State", of.bind(model.model.states)).state_indices)
            weighed = self._outputs.Q.any(axis=0)
            y[chosen[weighed]] = row[weighed]
        amid[both] = (low[both] + high[both]) / 2
        states = [y if model.embedding is None else model.embedding.repeat(y, inputs) for inputs in (u, amid)]
        return [np.concatenate(pair) for pair in zip(states, (u, amid), strict=True)]

    def is_outside(self, x: Float[np.ndarray, " nx"]) -> float:
        """Return by how many standard deviations x is further from the mean of the model's data than 3; 0 if inside."""
        if self.model.cloud is None:
            return 0.0
        center, spread = self.model.cloud
        away = np.abs(x[: len(center)] - center) / np.maximum(spread, 1e-12 * (1 + np.abs(center)))
        return max(float(away.max()) - 3.0, 0.0)

    def is_nearer(self, exact: Equilibrium, rough: Equilibrium, row: Float[np.ndarray, " nr"]) -> bool:
        """Return whether an equilibrium is close to another one, or a smaller one that holds the row as well."""
        now, before = (np.concatenate([point.x, point.u]) / self.size for point in (exact, rough))
        if np.abs(now - before).max() <= CLOSE:
            return True
        smaller = float(now @ now) <= float(before @ before) and self.is_outside(exact.x) <= self.is_outside(rough.x)
        return smaller and self.measure_miss(exact.x, row) <= self.measure_miss(rough.x, row)

    def measure_miss(self, x: Float[np.ndarray, " nx"], row: Float[np.ndarray, " nr"]) -> float:
        """Return ‖of(x) − r‖²_Q by its size; what a good equilibrium may leave counts as that."""
        off = self.linearise(x, np.zeros(self.model.nu)).of - row
        return max(float(off @ self._outputs.Q @ off), MISSED * float(row @ self._outputs.Q @ row))

    def _minimise(
        self,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None,
        guesses: Sequence[Float[np.ndarray, " n"]],
    ) -> Equilibrium | None:
        """Return the best equilibrium from these guesses, or the first that is good."""
        (nx, nu), sizes = (self.model.nx, self.model.nu), self._limit_size
        p = np.concatenate([row, self.model.theta, np.zeros(nx) if e is None else e])
        good = MISSED * float(row @ self._outputs.Q @ row) / self._scale
        low, high, unlimited = self.low / sizes, self.high / sizes, np.full(len(sizes) - nu, np.inf)
        best, least = None, np.inf
        for outputs in ((low[nu:], high[nu:]), (-unlimited, unlimited)):
            bounds = {
                "lbx": np.concatenate([np.full(nx, -np.inf), low[:nu]]),
                "ubx": np.concatenate([np.full(nx, np.inf), high[:nu]]),
                "lbg": np.concatenate([np.zeros(nx), outputs[0]]),
                "ubg": np.concatenate([np.zeros(nx), outputs[1]]),
            }
            for guess in guesses:
                with raise_swallowed():
                    try:
                        solved = cast("dict[str, Any]", self._solver(p=p, x0=guess / self.size, **bounds))
                    except RuntimeError:  # CasADi refuses bounds that overflow
                        continue
                    success, f, s = self._solver.stats()["success"], float(solved["f"]), solved["x"].full().ravel()
                if success and f < least:
                    best, least = s * self.size, f
                if least <= good:
                    break
            if best is not None:
                break
        return None if best is None else self._mark_limits(*np.split(best, [nx]))

    def _mark_limits(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Equilibrium:
        """Return ipopt's equilibrium with the limits that are active there, up to a millionth of their sizes."""
        values = np.concatenate([u, self.linearise(x, u).g])
        reach = 1e-6 * (self._limit_size + np.abs(values))
        above = (values >= self.high - reach).astype(np.intp)
        return Equilibrium(x, u, np.where(values <= self.low + reach, -1, above))

    def _holding(self, at: Linearisation) -> Float[np.ndarray, "nx n"]:
        """Return [A − 1, B] by sizes: the conditions of an equilibrium."""
        nx, size = len(at.A), self.size
        return np.hstack([at.A - np.eye(nx), at.B]) * size / size[:nx, None]

    def _along(self, W: Float[np.ndarray, "n m"], free: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n k"]:
        """Return W free with zeros where it is rounding: else what the outputs miss would move inputs along that."""
        product = W @ free
        outputs = product[: len(self.weight)]
        outputs[np.abs(outputs) < RANK * np.abs(W).max()] = 0.0
        return product

    def _residual_slopes(self, at: Linearisation) -> Float[np.ndarray, "m n"]:
        """Return the slopes of the residuals on (x, u) by sizes: of(x) first, then (x, u) at next to no weight."""
        (nr, nx), n = at.J.shape, len(self.size)
        W = SMALL * np.eye(nr + n, n, -nr)
        W[:nr, :nx] = self.weight @ at.J * self.size[:nx]
        return W
