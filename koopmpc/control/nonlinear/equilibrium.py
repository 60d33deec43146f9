"""The equilibrium x = F(x, u) + e that holds a reference, or comes nearest to it, and what the end of a horizon costs.

Near a guess it is found by Gauss–Newton steps that hold the active limits; from afar, or where these fail, by ipopt.
Where steps fail under a disturbance, the equilibrium without it stays, as in C: ipopt went on to equilibria thousands
of sizes away, to which no loop should be led.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost, StateTracking
from koopmpc.control.limits import SOFTENED, Interval
from koopmpc.control.nonlinear.problem import LearnedMap, point_sizes
from koopmpc.control.riccati import one_step, stationary
from koopmpc.control.terminal_cost import tail_of, tail_stage
from koopmpc.errors import ShapeError
from koopmpc.interrupts import raise_swallowed
from koopmpc.lifting.state import State
from koopmpc.plants.routines import Buffered
from koopmpc.values import Value

SETTLED = 1e-10  # the last Gauss–Newton step is at most this share of the size of (x, u)
RANK = 1e-12  # singular values below this share of the largest are rounding; ipopt meets all others too
PSEUDO = 1e-9  # singular values of the tracked outputs' slopes below this share of the largest count as zero
CLOSE = 1e-2  # the same where the next control step goes on: the error left is of the square of this share
_QUIET = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "error_on_fail": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
}
_NEWTON = 20  # whole Gauss–Newton steps, at most
_SHORTENED = 40  # Gauss–Newton steps that may be shorter, at most
_PATIENCE = 5  # times as many at the end of a way in pieces that leads nowhere else
_AWAY = 2.0  # an equilibrium at limits may be so many sizes of a state from that of its row
_BENT = 0.25  # where the cost bends by more than this share beyond its Gauss–Newton part, steps are shorter
_LEAST = 0.05  # shortest length of such a step, 1 being the longest
_PIECES = 40  # pieces of the way from w = 0 to a measured disturbance, at most
_AT = 1e-6  # share of a limit's size and value within which ipopt ends at a limit that is active
_BESIDE = 0.3  # share of a reference row within which the next one is sought from its equilibrium
_STARTS = 12  # guesses of an equilibrium where the reference is not of the state
_MISSED = 1e-6  # share of ‖r‖²_Q that a good equilibrium may leave
_FAR = 3.0  # standard deviations from the mean of the data, beyond which another equilibrium is looked for
_MOST = 10_000  # terminal targets kept in memory; it is cleared beyond
# what a copy takes over
_MEMORY = ("_known", "_inputs", "_found", "_missed", "_last", "_w", "_still", "_end")


class Equilibrium(NamedTuple):
    """An equilibrium; `active` is 1 (−1) where a limited value of [u; g(x)] is at its upper (lower) limit, else 0."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    active: Int[np.ndarray, " nl"]


class TerminalTarget(NamedTuple):
    """The equilibrium of a reference row, the reference input, and the cost ‖M of(x_N) + L x_N + V u_{N−1} − m‖².

    The reference input `u` is that of the equilibrium, or zero where the cost asks for it. A constant disturbance e of
    the state moves it by about `slope` e.
    """

    equilibrium: Equilibrium
    u: Float[np.ndarray, " nu"]
    M: Float[np.ndarray, "nt nr"]  # nt = nx + nr, or nx + nu + nr where changes of u are weighed
    L: Float[np.ndarray, "nt nx"]
    V: Float[np.ndarray, "nt nu"]
    m: Float[np.ndarray, " nt"]
    slope: Float[np.ndarray, "nu nx"]


class ReferenceInput(NamedTuple):
    """The reference input of a row, and by how much a constant disturbance moves it; see `TerminalTarget`."""

    u: Float[np.ndarray, " nu"]
    slope: Float[np.ndarray, "nu nx"]


class Linearisation(NamedTuple):
    """F(x, u), its Jacobians A and B, of(x) and its Jacobian J, the limited outputs g and their Jacobian G."""

    F: Float[np.ndarray, " nx"]
    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    of: Float[np.ndarray, " nr"]
    J: Float[np.ndarray, "nr nx"]
    g: Float[np.ndarray, " ng"]
    G: Float[np.ndarray, "ng nx"]


class Chord(NamedTuple):
    """A Gauss–Newton step from s₀ without active limits, H (F(x, u) + e − x) + T residuals; `limited` is ∂[u; g]/∂s.

    s is [x; u] by its sizes, and so is F(x, u) + e − x.
    """

    s: Float[np.ndarray, " n"]
    H: Float[np.ndarray, "n nx"]
    T: Float[np.ndarray, "n m"]
    limited: Float[np.ndarray, "nl n"]


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


@dataclass(frozen=True, eq=False)
class TailProgram(Value):
    """What the terminal cost of a row is made of, in the sizes of x, u and the rows; see `TerminalTargets`.

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


class Equilibria:
    """Reference row and disturbance e → Equilibrium: minimises ‖of(x) − r‖²_Q inside all limits.

    Where none is inside all limits, those of the inputs alone count. Of all that hold r it has the least x and u, by
    their sizes.
    """

    @raise_swallowed()
    def __init__(self, model: LearnedMap, cost: Cost, outputs: StateTracking) -> None:
        self.model, self._cost, self._outputs, o = model, cost, outputs, outputs
        self.of_state = isinstance(cost.of, State) and cost.of.selects_all
        self._names = model.model.states
        x, u, theta = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("t", len(model.theta))
        F, of, g = model.F(x, u, theta), o.tracked(x), o.limited(x)
        found = [F, ca.jacobian(F, x), ca.jacobian(F, u), of, ca.jacobian(of, x), g, ca.jacobian(g, x)]
        local = ca.Function("local", [x, u, theta], [ca.densify(each) for each in found])
        self._local = Buffered(local.expand() if model.F.is_a("SXFunction") else local)
        values = ca.Function("values", [x, u, theta], [ca.densify(each) for each in (F, of, g)])
        self._values = Buffered(values.expand() if model.F.is_a("SXFunction") else values)
        self.chord: Chord | None = None  # of the last search that followed another one
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
        self._weight, self._small = o.Q_root / np.sqrt(self._scale), 1e-7
        self._low, self._high = (np.concatenate([o.inputs[i], o.outputs[i]]) for i in (0, 1))

    def __reduce__(self) -> tuple[type["Equilibria"], tuple[LearnedMap, Cost, StateTracking]]:
        return Equilibria, (self.model, self._cost, self._outputs)

    def program(self) -> RestProgram:
        """Return the data of the search from a last equilibrium."""
        return RestProgram(self._weight, self.size, self._limit_size, self._low, self._high)

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ."""
        self.model, self.chord = model, None

    def values(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]
    ) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nr"], Float[np.ndarray, " ng"]]:
        """Return F(x, u), of(x) and the limited outputs g(x)."""
        F, of, g = self._values(x, u, self.model.theta)
        return F, of, g

    def linearise(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Linearisation:
        """Return the linearisation at (x, u)."""
        nx, local = len(x), self._local
        local.arguments[0][:], local.arguments[1][:], local.arguments[2][:] = x, u, self.model.theta
        local.evaluate()
        F, A, B, of, J, g, G = (result.copy() for result in local.results)
        A, B = (M.reshape((nx, -1), order="F") for M in (A, B))
        J, G = (M.reshape((-1, nx), order="F") for M in (J, G))
        return Linearisation(F, A, B, of, J, g, G)

    def slope(self, at: Linearisation) -> Float[np.ndarray, "nu nx"]:
        """Return ∂u/∂e of the equilibrium where no limit is active."""
        nx, size = len(at.A), self.size
        gain, back, W = self._solve_step(at)
        return size[nx:, None] * (back @ W @ gain - gain)[nx:] / size[:nx]

    def follow_row(self, at: Linearisation) -> Float[np.ndarray, "n nr"]:
        """Return ∂(x, u)/∂r of the equilibrium where no limit is active."""
        return self.size[:, None] * (self._solve_step(at)[1][:, : len(self._weight)] @ self._weight)

    def _solve_step(
        self, at: Linearisation
    ) -> tuple[Float[np.ndarray, "n nx"], Float[np.ndarray, "n m"], Float[np.ndarray, "m n"]]:
        """Return the pseudo-inverse of [A − 1, B], the map from residuals to a step in its null space, and their ∂."""
        nx, size = len(at.A), self.size
        gain, free = _inverse(np.hstack([at.A - np.eye(nx), at.B]) * size / size[:nx, None])
        W = self._residuals(at)
        return gain, free @ np.linalg.pinv(self._along(W, free)), W

    def near(
        self,
        begin: Equilibrium,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"],
        enough: float = SETTLED,
        *,
        careful: bool = False,
        patience: int = 1,
    ) -> Equilibrium | None:
        """Return the equilibrium by Gauss–Newton steps from `begin`, None where they do not lead to one.

        The limits that are active at `begin` are held. A limit that is broken is added, and one whose multiplier has
        the wrong sign is released. The last step is at most `enough` of the size of (x, u). `careful` steps end at the
        first limit that they would break. Where nothing is free to move, another limit gives way for it: the one whose
        multiplier would change its sign first. Where they would swing, as far from a row that cannot be reached, they
        are as short as Barzilai and Borwein's; there may be `patience` times as many.
        """
        (nx, nu), size, sizes = (self.model.nx, self.model.nu), self.size, self._limit_size
        s, active = np.concatenate([begin.x, begin.u]) / size, begin.active.copy()
        limited = np.zeros((len(active), nx + nu))
        limited[:nu, nx:] = np.eye(nu)
        low, high = self._low / sizes, self._high / sizes
        before: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]] | None = None  # steps, while limits stay
        for _ in range(patience * _SHORTENED if careful else _NEWTON):
            x, u = np.split(s * size, [nx])
            try:
                at = self.linearise(x, u)
            except RuntimeError:  # an implicit step does not converge, or CVODES gives up
                return None
            limited[nu:, :nx] = at.G * size[:nx] / sizes[nu:, None]
            values = np.concatenate([u, at.g]) / sizes
            held = np.flatnonzero(active)
            ends = np.where(active > 0, high, low)
            E = np.vstack([np.hstack([at.A - np.eye(nx), at.B]) * size / size[:nx, None], limited[held]])
            missed = np.concatenate([(at.F + e - x) / size[:nx], values[held] - ends[held]])
            gain, free = _inverse(E)
            W = self._residuals(at)
            left = np.concatenate([self._weight @ (row - at.of), -self._small * s])
            back = -gain @ missed
            along: Float[np.ndarray, " n"] = (
                free @ np.linalg.lstsq(self._along(W, free), left - W @ back, rcond=None)[0]
            )
            length: float = 1.0 if before is None or not careful else _find_length(*before, along)
            taken: Float[np.ndarray, " n"] = length * along
            before, step = (taken, along), back + taken
            if not np.isfinite(step).all():
                return None
            reach, moved = 1 + np.abs(s).max(), limited @ step
            multipliers = active[held] * (gain.T @ (W.T @ (left - W @ step)))[nx:]  # positive where a limit holds
            if len(multipliers) and multipliers.min() < -1e-9 * np.abs(multipliers).max():
                active[held[multipliers.argmin()]], before = 0, None
            else:
                hit, share = _find_hit(values, moved, Interval(low, high), active, careful=careful)
                if hit and careful and not free.shape[1]:  # a corner: for the new limit another one gives way
                    push = active[held] * (gain.T @ (np.sign(hit) * limited[abs(hit) - 1]))[nx:]
                    if not (push > RANK).any():
                        return None
                    shares = np.maximum(multipliers, 0.0) / np.where(push > RANK, push, np.nan)
                    active[held[np.nanargmin(shares)]] = 0
                if hit:
                    active[abs(hit) - 1], before = np.sign(hit), None
                    step = share * step
            s = s + step
            last = enough if length == 1.0 else SETTLED  # Gauss–Newton steps that swing leave more than their square
            if before is not None and np.abs(back + along).max() <= last * reach:
                if np.abs(E @ step + missed).max() > SETTLED * reach:
                    return None
                x, u = np.split(s * size, [nx])
                return Equilibrium(x, np.clip(u, *self._outputs.inputs), active)
        return None

    def follow(
        self, begin: Equilibrium, row: Float[np.ndarray, " nr"], e: Float[np.ndarray, " nx"]
    ) -> Equilibrium | None:
        """Return the equilibrium by one step from `begin`; None where it is not close, or a limit is active.

        The step takes the factors of an earlier one as long as that was close by: repeated, it converges the faster
        the closer that was, at a fraction of the time.
        """
        nx, size = self.model.nx, self.size
        if begin.active.any():
            return None
        s, chord = np.concatenate([begin.x, begin.u]) / size, self.chord
        close = CLOSE * (1 + np.abs(s).max())
        if chord is None or np.abs(s - chord.s).max() > close:
            chord = self.chord = self._factors(begin, s)
        F, of, g = self.values(begin.x, begin.u)
        left = np.concatenate([self._weight @ (row - of), -self._small * s])
        step = chord.H @ ((F + e - begin.x) / size[:nx]) + chord.T @ left
        reached = np.concatenate([begin.u, g]) + chord.limited @ step
        if not np.abs(step).max() <= close or (reached > self._high).any() or (reached < self._low).any():
            return None
        x, u = np.split((s + step) * size, [nx])
        return Equilibrium(x, u, begin.active)

    def _factors(self, here: Equilibrium, s: Float[np.ndarray, " n"]) -> Chord:
        """Return the Gauss–Newton step at an equilibrium, s in its sizes."""
        nx, nu = self.model.nx, self.model.nu
        at = self.linearise(here.x, here.u)
        gain, back, W = self._solve_step(at)
        limited = np.zeros((nu + len(at.G), nx + nu))
        limited[:nu, nx:], limited[nu:, :nx] = np.eye(nu), at.G
        return Chord(s, back @ W @ gain - gain, back, limited * self.size)

    def guess(self, row: Float[np.ndarray, " nr"]) -> Equilibrium:
        """Return where the search for the equilibrium of a row begins: the state that it names, inputs at zero."""
        model, u = self.model, np.clip(np.zeros(self.model.nu), *self._outputs.inputs)
        x = np.zeros(model.nx)
        if self.of_state:
            weighed, center = self._outputs.Q.any(axis=0), model.center  # of other states a reference may say nothing
            x = row if center is None else np.where(weighed, row, center)
            x = x if model.embedding is None else model.embedding.repeat(x, u)
        return Equilibrium(x, u, np.zeros(len(self._low), dtype=np.intp))

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
            scatter = np.random.default_rng(0).uniform(-np.pi, np.pi, (_STARTS - 1, self.model.nx))
            guesses += [np.concatenate([x, u]) for x in scatter]
        first = self._minimise(row, e, guesses)
        if near is not None or first is None or not self._outside(first.x):
            return first
        others = [self._minimise(row, e, [guess]) for guess in self._among(row, u)]
        held = [
            each
            for each in others
            if each is not None and self._measure_miss(each.x, row) <= self._measure_miss(first.x, row)
        ]
        return min([first, *held], key=lambda each: self._outside(each.x))

    def _among(self, row: Float[np.ndarray, " nr"], u: Float[np.ndarray, " nu"]) -> list[Float[np.ndarray, " n"]]:
        """Return two guesses among the data, with the inputs u and with inputs amid their limits."""
        model, of, (low, high) = self.model, self._cost.of, self._outputs.inputs
        assert model.center is not None, "outside of data that are known"
        y, both, amid = model.center.copy(), np.isfinite(low) & np.isfinite(high), u.copy()
        if isinstance(of, State):
            chosen = cast("State", of.bind(self._names)).state_indices
            weighed = [bool(column.any()) for column in self._outputs.Q.T]
            for i, value, counts in zip(chosen, row, weighed, strict=True):
                y[i] = value if counts else y[i]
        amid[both] = (low[both] + high[both]) / 2
        held = [y if model.embedding is None else model.embedding.repeat(y, each) for each in (u, amid)]
        return [np.concatenate(pair) for pair in zip(held, (u, amid), strict=True)]

    def _outside(self, x: Float[np.ndarray, " nx"]) -> float:
        """Return by how many standard deviations x is further from the mean of the model's data than 3; 0 if inside."""
        center, spread = self.model.center, self.model.spread
        if center is None or spread is None:
            return 0.0
        away = np.abs(x[: len(center)] - center) / np.maximum(spread, 1e-12 * (1 + np.abs(center)))
        return max(float(away.max()) - _FAR, 0.0)

    def is_nearer(self, exact: Equilibrium, found: Equilibrium, row: Float[np.ndarray, " nr"]) -> bool:
        """Return whether an equilibrium is close to another one, or a smaller one that holds the row as well."""
        now, before = (np.concatenate([each.x, each.u]) / self.size for each in (exact, found))
        if np.abs(now - before).max() <= CLOSE:
            return True
        smaller = float(now @ now) <= float(before @ before) and self._outside(exact.x) <= self._outside(found.x)
        return smaller and self._measure_miss(exact.x, row) <= self._measure_miss(found.x, row)

    def _measure_miss(self, x: Float[np.ndarray, " nx"], row: Float[np.ndarray, " nr"]) -> float:
        """Return ‖of(x) − r‖²_Q by its size; what a good equilibrium may leave counts as that."""
        off = self.values(x, np.zeros(self.model.nu))[1] - row
        return max(float(off @ self._outputs.Q @ off), _MISSED * float(row @ self._outputs.Q @ row))

    def _minimise(
        self,
        row: Float[np.ndarray, " nr"],
        e: Float[np.ndarray, " nx"] | None,
        guesses: Sequence[Float[np.ndarray, " n"]],
    ) -> Equilibrium | None:
        """Return the best equilibrium from these guesses, or the first that is good."""
        model, inputs, box = self.model, self._outputs.inputs, self._outputs.outputs
        nx, e = model.nx, np.zeros(model.nx) if e is None else e
        size, limit_size = self.size, self._limit_size
        unlimited = np.full(len(box.low), np.inf)
        good = _MISSED * float(row @ self._outputs.Q @ row) / self._scale
        best = None
        for limits in (box, Interval(-unlimited, unlimited)):
            found, least = None, np.inf
            for guess in guesses:
                bounds = {
                    "lbx": np.concatenate([np.full(nx, -np.inf), inputs.low / size[nx:]]),
                    "ubx": np.concatenate([np.full(nx, np.inf), inputs.high / size[nx:]]),
                    "lbg": np.concatenate([np.zeros(nx), limits.low / limit_size[model.nu :]]),
                    "ubg": np.concatenate([np.zeros(nx), limits.high / limit_size[model.nu :]]),
                }
                p = np.concatenate([row, model.theta, e])
                with raise_swallowed():
                    try:
                        solved = cast("dict[str, Any]", self._solver(p=p, x0=guess / size, **bounds))
                    except RuntimeError:  # CasADi refuses bounds that overflow
                        continue
                    success, f, s = self._solver.stats()["success"], float(solved["f"]), solved["x"].full().ravel()
                if success and f < least:
                    found, least = s * size, f
                if least <= good:
                    break
            if found is not None:
                best = found
                break
        if best is None:
            return None
        x, u = best[:nx], best[nx:]
        values = np.concatenate([u, self.linearise(x, u).g])
        reach = _AT * (limit_size + np.abs(values))
        above = (values >= self._high - reach).astype(np.intp)
        return Equilibrium(x, u, np.where(values <= self._low + reach, -1, above))

    def _along(self, W: Float[np.ndarray, "n m"], free: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n k"]:
        """Return W free with zeros where it is rounding: else what the outputs miss would move inputs along that."""
        product, nr = W @ free, len(self._weight)
        outputs = product[:nr]
        outputs[np.abs(outputs) < RANK * np.abs(W).max()] = 0.0
        return product

    def _residuals(self, at: Linearisation) -> Float[np.ndarray, "n m"]:
        """Return the matrix of the residuals on (x, u) by sizes: of(x) first, then (x, u) at next to no weight."""
        (nr, nx), n = at.J.shape, self.model.nx + self.model.nu
        W = self._small * np.eye(nr + n, n, -nr)
        W[:nr, :nx] = self._weight @ at.J * self.size[:nx]
        return W


class TerminalTargets:
    """Reference row → TerminalTarget.

    Where a measured disturbance multiplies the state, the equilibrium of a row is that of w = 0, moved with w: so two
    programs find the same one, and not a local optimum each. Where the row was that of the last step, and no limit is
    active, it is moved from there.

    The terminal cost is ‖d‖²_P, P that of the tail along the linearisation, or Q_N. The distance d is measured in
    the tracked outputs as far as they see it, d = J⁺(of(x_N) − of(x_r)) + (I − J⁺J)(x_N − x_r), J = ∂of/∂x: with
    sin θ and cos θ tracked it is the same at every turn of θ, and with of(x) = x it is x_N − x_r. The part of
    of(x_N) − of(x_r) that no small motion changes keeps its weight Q, times the mean size of P over JᵀQJ. With
    R_delta, P weighs [d; u_{N−1} − u_r].

    Attributes
    ----------
    deadline, sought, late
        After the deadline no search begins but the first of a step, which is `sought`; `late` says that a row was left
        out, whose target is then that of a row without an equilibrium.

    Parameters
    ----------
    most
        Steps after which the Riccati difference equation ends, settled or not.

    Raises
    ------
    ShapeError
        Q_N weighs neither states nor what the cost tracks.
    """

    def __init__(self, model: LearnedMap, cost: Cost, outputs: StateTracking, most: int) -> None:
        self._cost, self._outputs, self._most = cost, outputs, most
        self._hold = isinstance(cost.u_target, str) and cost.u_target == "equilibrium"
        self.equilibria = Equilibria(model, cost, outputs)
        self._end_weight = cast("ArrayLike | None", cost.Q_N)
        if self._end_weight is not None:
            nr = len(outputs.Q)
            if not self.equilibria.of_state and np.shape(self._end_weight) != (nr, nr):
                raise ShapeError(
                    f"Q_N weighs x_N − r_N, but the reference is not of the state; pass ({nr}, {nr}) on what the cost"
                    " tracks, or leave Q_N out"
                )
            shape = np.shape(self._end_weight)
            if self.equilibria.of_state and shape and shape[0] != nr:
                raise ShapeError(
                    f"Q_N has shape {shape}, expected ({nr}, {nr}) of the tracked states; for lifted coordinates let"
                    " the cost track the lifting of the model: of=model.lifting, with references as long"
                )
            checks.weight(self._end_weight, "Q_N", nr)
        self._known: dict[bytes, TerminalTarget] = {}
        self._inputs: dict[bytes, ReferenceInput] = {}
        self._found: dict[bytes, Equilibrium | None] = {}  # None where there is none
        self._missed: set[bytes] = set()  # reference rows whose equilibrium was not found
        self._last: tuple[Float[np.ndarray, " nr"], Equilibrium] | None = None  # the row found last, and where
        self._map, self._w = model, np.zeros(model.nw)
        self._still: dict[bytes, Equilibrium | None] = {}  # `_found` of w = 0, while w is another one
        self._end: tuple[bytes, Equilibrium] | None = None  # the last row of the last step, and its equilibrium
        self.deadline, self.sought, self.late = np.inf, False, False

    def program(self) -> TailProgram:
        """Return the data of the terminal cost."""
        o, nr, su = self._outputs, len(self._outputs.Q), self._outputs.sizes.inputs
        scale, weights, Q_N = o.sizes.scale, o.Q.diagonal(), self._end_weight
        size = np.sqrt(scale / np.where(weights > 0, weights, scale))
        if self.equilibria.of_state:
            size = self.equilibria.size[:nr]
        changes = np.zeros_like(o.R) if o.R_delta is None else o.R_delta
        end = np.zeros((nr, nr)) if Q_N is None else checks.root(checks.weight(Q_N, "Q_N", nr))
        R, R_delta = (weight * np.outer(su, su) / scale for weight in (o.R, changes))
        return TailProgram(self._cost.tail or 0, size, scale, o.Q * np.outer(size, size) / scale, R, R_delta, end)

    def memory(self) -> dict[str, Any]:
        """Return what was found until now, for a copy."""
        return {name: getattr(self, name) for name in _MEMORY} | {"chord": self.equilibria.chord}

    def remember(self, memory: dict[str, Any]) -> None:
        """Go on with what another one of the same model had found."""
        chord = memory.pop("chord")
        self.__dict__.update(memory)
        if self._w.any():
            self.equilibria.update(self._map.at(self._w))
        self.equilibria.chord = chord

    def is_missed(self, row: Float[np.ndarray, " nr"]) -> bool:
        """Return whether no equilibrium was found for a row that was asked for."""
        return row.tobytes() in self._missed

    def forget_missed(self) -> None:
        """Look again for the equilibria that were not found, and begin no search at the last step."""
        for key in self._missed:
            for kept in (self._known, self._inputs, self._found, self._still):
                kept.pop(key, None)
        self._missed.clear()
        self._end = None

    def schedule(self, w: Float[np.ndarray, " nw"]) -> None:
        """Go on with another w that multiplies the state."""
        if not self._w.any():
            self._still = self._found
        self._w = w.copy()
        self._known, self._inputs, self._found = {}, {}, {} if w.any() else self._still
        self._missed = {key for key, found in self._found.items() if found is None}
        self.equilibria.update(self._map.at(w))

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ: the last target is searched again, from where it was."""
        self._map, self._still = model, {}
        if self._w.any():
            model = model.at(self._w)
        self.equilibria.update(model)
        self.forget_missed()
        self._last = None
        last, self._known, self._inputs, self._found = list(self._known.items())[-1:], {}, {}, {}
        for key, target in last:
            row = np.frombuffer(key)
            found = self.equilibria.near(target.equilibrium, row, np.zeros(model.nx))
            if found is not None:
                self._known[key] = self._target(row, found)

    def begin_with(self, model: LearnedMap) -> None:
        """Forget all targets, and find those of this θ."""
        self.equilibria.update(model)
        self._map, self._w, self._end = model, np.zeros(model.nw), None
        self._known, self._inputs, self._found, self._still, self._last = {}, {}, {}, {}, None
        self._missed.clear()

    def __call__(self, row: Float[np.ndarray, " nr"]) -> TerminalTarget:
        """Return the target of a row, kept for the next time, or until `forget_missed` where none was found."""
        key = row.tobytes()
        if key not in self._known:
            found = self._find(key, row)
            target = self._target_without_equilibrium(row) if found is None else self._target(row, found)
            if key not in self._found:  # there was no time to search
                return target
            self._known[key] = target
        return self._known[key]

    def find_input(self, row: Float[np.ndarray, " nr"]) -> ReferenceInput:
        """Return the reference input of a row before the last one, whose terminal cost nothing asks for.

        A reference of the state that asks for no input needs no equilibrium at all.
        """
        key, nu = row.tobytes(), self.equilibria.model.nu
        if self.equilibria.of_state and not self._hold:
            return ReferenceInput(np.zeros(nu), np.zeros((nu, self.equilibria.model.nx)))
        if key in self._known:
            return ReferenceInput(self._known[key].u, self._known[key].slope)
        if key not in self._inputs:
            found = self._find(key, row)
            if found is None:
                target = self._target_without_equilibrium(row)
                asked = ReferenceInput(target.u, target.slope)
            else:
                slope = self.equilibria.slope(self.equilibria.linearise(found.x, found.u))
                asked = ReferenceInput(found.u * self._hold, slope * self._hold)
            if key not in self._found:  # there was no time to search
                return asked
            self._inputs[key] = asked
        return self._inputs[key]

    def _find(self, key: bytes, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return the equilibrium of a row, kept for the next time, or None: there is none, or no time to search."""
        if key in self._found:
            return self._found[key]
        if self.sought and perf_counter() > self.deadline:
            self.late = True
            return None
        self.sought = True
        if len(self._found) + len(self._still) > _MOST:
            for kept in (self._known, self._inputs, self._found, self._still, self._missed):
                kept.clear()
        found = self._search(row) if not self._w.any() else self._follow_w(key, row)
        if found is None:
            self._missed.add(key)
        self._found[key] = found
        return found

    def _search(self, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        found = self._beside(row) or self._polish(self.equilibria.find(row), row)
        self._last = None if found is None else (row.copy(), found)
        return found

    def _follow_w(self, key: bytes, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return the equilibrium of a row under w, moved there from that of the last step, or of w = 0."""
        equilibria, nothing = self.equilibria, np.zeros(self._map.nx)
        if self._end is not None and self._end[0] == key and not self._end[1].active.any():
            found = equilibria.near(self._end[1], row, nothing)
            if found is not None and not found.active.any():
                return found
        if key not in self._still:
            equilibria.update(self._map)
            self._still[key] = self._search(row)
        begin, done, stride = self._still[key] or equilibria.guess(row), 0.0, 1.0
        try:
            for _ in range(_PIECES):
                share = min(done + stride, 1.0)
                equilibria.update(self._map.at(share * self._w))
                found = equilibria.near(begin, row, nothing, careful=True)
                if found is None:
                    stride /= 2
                    continue
                begin, done, stride = found, share, 2 * stride
                if done == 1:
                    return found
            equilibria.update(self._map.at(self._w))
            found = equilibria.near(begin, row, nothing, careful=True, patience=_PATIENCE)
            if found is not None:
                return found
        finally:
            equilibria.update(self._map.at(self._w))
        return self._polish(equilibria.find(row), row)

    def end_at(self, row: Float[np.ndarray, " nr"]) -> TerminalTarget:
        """Return the target of the last row of a step, from which the search for the next w begins."""
        target = self(row)
        if self._map.scheduled:
            self._end = None if self.is_missed(row) else (row.tobytes(), target.equilibrium)
        return target

    def _beside(self, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return the equilibrium of a row close to the last one, from where that was; None where it is not close."""
        if self._last is None:
            return None
        weight, (last, begin) = self._outputs.Q_root, self._last
        own = self.equilibria.size[: len(row)] if self.equilibria.of_state else np.zeros_like(row)
        sizes = [float(np.linalg.norm(weight @ each)) for each in (row - last, row, last, own)]
        if sizes[0] > _BESIDE * max(sizes[1:]):
            return None
        return self.equilibria.near(begin, row, np.zeros(self.equilibria.model.nx))

    def _polish(self, found: Equilibrium | None, row: Float[np.ndarray, " nr"]) -> Equilibrium | None:
        """Return an equilibrium of ipopt to rounding, by Gauss–Newton steps, as C finds it.

        Where several inputs hold a row, these steps go on to the smallest, and ipopt may have stopped far before.
        """
        exact = None if found is None else self.equilibria.near(found, row, np.zeros(self.equilibria.model.nx))
        if found is None or exact is None:
            return found
        return exact if self.equilibria.is_nearer(exact, found, row) else found

    def _target_without_equilibrium(self, row: Float[np.ndarray, " nr"]) -> TerminalTarget:
        """Return the target of a row whose equilibrium was not found: ‖of(x_N) − r‖²_Q, and inputs at zero."""
        o, (nx, nu, nr) = self._outputs, (self.equilibria.model.nx, self.equilibria.model.nu, len(row))
        n = nx + nu * (o.R_delta is not None and self._cost.Q_N is None) + nr
        M, L, V = (np.zeros((n, columns)) for columns in (nr, nx, nu))
        end = self._end_weight
        M[:nr] = checks.root(o.Q if end is None else checks.weight(end, "Q_N", nr))
        begin = self.equilibria.guess(row)
        return TerminalTarget(begin, begin.u * self._hold, M, L, V, M @ row, np.zeros((nu, nx)))

    def find_disturbed(
        self, row: Float[np.ndarray, " nr"], e: Float[np.ndarray, " nx"], last: TerminalTarget | None
    ) -> TerminalTarget:
        """Return the target of a row where x⁺ = F(x, u) + e, mostly by one step from that of the last control step.

        The error that this leaves is of the square of the change of e, and gone once e rests. Where no Gauss–Newton
        steps lead to an equilibrium, or only e makes limits active and the equilibrium is far, as under noise beyond
        what inputs hold, it returns the target of the row.
        """
        target = self(row)
        begin = (target if last is None else last).equilibrium
        each = self.equilibria
        found = each.follow(begin, row, e) or each.near(begin, row, e, CLOSE)
        if found is None or self.is_missed(row) or self._is_far(found, target.equilibrium):
            return target
        u, m = found.u * self._hold, target.m
        if self._cost.Q_N is None:
            m = target.M @ each.values(found.x, found.u)[1] + target.L @ found.x + target.V @ u
        return target._replace(equilibrium=found, u=u, m=m)

    def _is_far(self, found: Equilibrium, own: Equilibrium) -> bool:
        """Return whether an equilibrium at limits is several sizes of the state from one that meets them."""
        nx = len(own.x)
        away = (np.abs(found.x - own.x) / self.equilibria.size[:nx]).max()
        return bool(found.active.any() and not own.active.any() and away > _AWAY)

    def _target(self, row: Float[np.ndarray, " nr"], found: Equilibrium) -> TerminalTarget:
        o, nx, nr = self._outputs, len(found.x), len(row)
        at, u = self.equilibria.linearise(found.x, found.u), found.u * self._hold
        slope = self.equilibria.slope(at) * self._hold
        end = self._end_weight
        if end is not None:
            M, L, V = (np.zeros((nx + nr, columns)) for columns in (nr, nx, len(u)))
            M[:nr] = checks.root(checks.weight(end, "Q_N", nr))
            return TerminalTarget(found, u, M, L, V, M @ row, slope)
        (sx, su), tail = np.split(self.equilibria.size, [nx]), self.program()
        sr, scale, Q_s, R = tail.row_size, tail.scale, tail.Q, tail.R
        R_delta = None if o.R_delta is None else tail.R_delta
        A, B, J = at.A * sx / sx[:, None], at.B * su / sx[:, None], at.J * sx / sr[:, None]
        seen = J.T @ Q_s @ J
        back, inverse = (np.linalg.pinv(each, rcond=PSEUDO) for each in (J, seen))
        P = stationary(one_step(A, B, seen, R, R_delta), self._most).P
        if self._cost.tail:
            P = tail_of(tail_stage(A, B, np.eye(nx), J, Q_s, R, R_delta), self._cost.tail).P
        n, S = len(P), np.sqrt(scale) * checks.root(P)
        M, L, V = (np.zeros((n + nr, columns)) for columns in (nr, nx, len(u)))
        M[:n] = S[:, :nx] @ back / sr
        L[:n] = S[:, :nx] @ (np.eye(nx) - back @ J) / sx
        V[:n, : n - nx] = S[:, nx:] / su[: n - nx]
        mean = float((P[:nx, :nx] * inverse).sum()) / max(np.linalg.matrix_rank(seen), 1)
        M[n:] = np.sqrt(max(mean, 1.0)) * o.Q_root @ (np.eye(nr) - sr[:, None] * (J @ back) / sr)
        return TerminalTarget(found, u, M, L, V, M @ at.of + L @ found.x + V @ u, slope)


def _inverse(E: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n k"]]:
    """Return the pseudo-inverse of E, and a basis of its null space."""
    left, sigma, right = np.linalg.svd(E)
    rank = int((sigma > RANK * max(float(sigma[0]), 1e-300)).sum())
    return right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T


def _find_length(taken: Float[np.ndarray, " n"], last: Float[np.ndarray, " n"], now: Float[np.ndarray, " n"]) -> float:
    """Return the length of a Gauss–Newton step: below 1 where the cost bent more than it knows along the last one.

    From `last` to `now` the step has changed by as much as its slope along `taken` tells.

    References
    ----------
    Barzilai & Borwein, "Two-point step size gradient methods", IMA J. Numer. Anal. 8, 1988.
    """
    bend, size = float(taken @ (last - now)), float(taken @ taken)
    return max(size / bend, _LEAST) if bend > (1 + _BENT) * size else 1.0


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
