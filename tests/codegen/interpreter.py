"""A `Program` in a plain loop of numpy and DAQP: what its fields say, with no line of the controllers' own code."""

import math
from collections import deque

import daqp
import numpy as np

import koopmpc as km

BRIDGED = 5  # missed readings in sequence through which predictions go on
FINE = {"primal_tol": 1e-12, "dual_tol": 1e-13, "iter_limit": 10_000}
HUGE = 1e30
UNARY = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "sq": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "inv": lambda a: 1 / a,
    "not": lambda a: float(a == 0),
    "sign": lambda a: math.copysign(1.0, a) if a else 0.0,
    "fabs": abs,
    **{name: getattr(math, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh")},
}
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "constpow": lambda a, b: a**b,
    "lt": lambda a, b: float(a < b),
    "le": lambda a, b: float(a <= b),
    "eq": lambda a, b: float(a == b),
    "ne": lambda a, b: float(a != b),
    "and": lambda a, b: float(a != 0 and b != 0),
    "or": lambda a, b: float(a != 0 or b != 0),
    "fmin": lambda a, b: float(np.fmin(a, b)),
    "fmax": lambda a, b: float(np.fmax(a, b)),
    "if_else_zero": lambda a, b: b if a else 0.0,
}


def evaluate(graph, *arguments):
    v, registers, result = np.concatenate([np.ravel(a) for a in arguments]), {}, np.zeros(graph.m)
    for step, (target, first, second) in zip(graph.steps, graph.places, strict=True):
        if step == "input":
            registers[target] = v[first]
        elif step == "constant":
            registers[target] = graph.constants[first]
        elif step == "output":
            result[target] = registers[first]
        elif step in UNARY:
            registers[target] = UNARY[step](registers[first])
        else:
            registers[target] = BINARY[step](registers[first], registers[second])
    return result


def usable(*arrays):
    return all((np.abs(a) < HUGE).all() for a in arrays)


def least(H, f, A, low, high, softness=None):
    """Minimise ½vᵀHv + fᵀv within the rows, soft ones broken by ε at linear ε + quadratic ε²; None without a point."""
    n, m = len(f), len(low)
    soft = np.zeros(0, int) if softness is None else np.flatnonzero(np.isfinite(softness[0]))
    k = len(soft)
    eased = np.zeros((m, k))
    eased[soft, np.arange(k)] = 1.0
    linear, quadratic = (np.zeros(k), np.zeros(k)) if softness is None else (softness[0][soft], softness[1][soft])
    unit = 1 / np.sqrt(2 * quadratic) if k else np.zeros(0)  # ε by sizes of which the curvature is 1
    whole = np.block([[H, np.zeros((n, k))], [np.zeros((k, n)), np.eye(k)]])
    rows = np.vstack(
        [np.hstack([A, -eased * unit]), np.hstack([A, eased * unit]), np.hstack([np.zeros((k, n)), np.eye(k)])]
    )
    free = np.full(m, HUGE)
    upper, lower = np.concatenate([high, free, np.full(k, HUGE)]), np.concatenate([-free, low, np.zeros(k)])
    hard = np.setdiff1d(np.arange(m), soft)
    upper[m + hard] = HUGE
    lower[hard], lower[m + hard] = low[hard], -HUGE
    kept = (upper < HUGE) | (lower > -HUGE)
    sizes = np.maximum(np.linalg.norm(rows[kept], axis=1), 1e-300)
    ends = (np.clip(end[kept] / sizes, -HUGE, HUGE) for end in (upper, lower))
    rows = rows[kept] / sizes[:, None]
    v, _, flag, _ = daqp.solve(whole, np.concatenate([f, linear * unit]), rows, *ends, **FINE)
    return v[:n] if flag > 0 else None


def clip_changes(u, box, rates, before):
    if rates is not None:
        u = np.clip(u, before + rates.low, before + rates.high)
    return np.clip(u, *box)


class Estimate:
    """z and d of y, by an EstimatorProgram."""

    def __init__(self, program, advance):
        self.program, self.rule, self.advance = program, getattr(program, "estimator", None), advance
        self.embedding = getattr(program.model, "embedding", None)
        self.zeta, self.ny = None, len(program.model.states)
        self.z, self.d = np.zeros(program.lifting.m), np.zeros(program.lifting.m)
        self.kind = type(self.rule).__name__
        self.last, self.bridged = None, 0
        self.forget()
        self.missed, self.queue = 0, None
        self.gate = self.rule.gate
        self.memory = None if self.gate is None else np.zeros(self.gate.m - 2)
        self.refused, self.opened, self.lost, self.stood_in = False, False, False, False
        if self.kind == "FilterProgram":
            zeta = np.zeros(program.lifting.n)
            self.s = np.concatenate([evaluate(program.lifting, zeta)[self.rule.kept], np.zeros(len(self.rule.F))])
            self.start = self.s = self.s[: len(self.rule.F)]

    def forget(self):
        self.newest, self.mean, self.sizes, self.learned, self.fresh = None, 0.0, np.zeros(self.ny), 0, 0.0
        self.d, self.zeta = np.zeros(self.program.lifting.m), None

    def point(self, x, u):
        if self.embedding is None:
            return x
        past = np.concatenate([u, x]) if self.embedding.inputs else x
        if self.zeta is None:
            zeta = np.concatenate([x] + [past] * self.embedding.steps)
            self.zeta = zeta if np.isfinite(x).all() else None
            return zeta
        head = u if self.embedding.inputs else u[:0]
        zeta = np.concatenate([x, head, self.zeta[: len(self.zeta) - len(past)]])
        known = x if np.isfinite(x).all() else self.zeta[: len(x)]
        self.zeta = np.concatenate([known, zeta[len(x) :]])
        return zeta

    def judge(self, y, expected):
        """Whether y is refused; NaN in `expected` is no prediction."""
        refused, opened, *memory = evaluate(self.gate, y, expected, self.memory)
        self.memory, self.refused, self.opened, self.lost = np.array(memory), bool(refused), opened == 1, opened == 2
        return self.refused

    def take(self, y, u, w):
        if self.kind == "FilterProgram":
            return self.filtered(y, u, w)
        ahead = None
        if self.gate is not None:
            expected = np.full(self.ny, np.nan)
            if self.last is not None:
                ahead = self.advance(self.last, u, w, self.d)
                staged = type(self.program).__name__ == "StagedProgram"
                expected = ahead[: self.ny] if staged else self.program.model.C @ ahead
            y = expected if self.judge(y, expected) else y
            if self.lost:
                self.forget()
                self.last = ahead = None
        zeta = self.point(y, u)
        z = evaluate(self.program.lifting, zeta) if np.isfinite(zeta).all() else np.full(self.program.lifting.m, np.nan)
        known = bool(np.isfinite(z).all())
        if self.kind == "DisturbanceProgram" and known:
            if self.opened:
                self.learned, self.fresh = 0, 1.0
            elif self.last is not None and not (self.refused or self.stood_in):
                self.learn(np.where(self.rule.known, 0.0, z - self.advance(self.last, u, w, 0.0)), z - self.last)
        bridges = not known and ahead is not None and self.bridged < BRIDGED
        self.bridged, self.stood_in = self.bridged + 1 if bridges else 0, self.refused or bridges
        self.last, self.z = z if known else ahead if bridges else None, z
        return known

    def learn(self, misfit, step):
        C, gain = self.rule.C, max(self.rule.gain, self.fresh)
        self.fresh /= 1 + self.fresh
        f, moved = C @ misfit, C @ step
        self.sizes = np.maximum(self.sizes, np.maximum(f**2, moved**2))
        rough = f**2 - (0.5 * (f - self.newest) ** 2 if self.learned else 0.0)
        new = np.concatenate([misfit, rough])
        self.mean = self.mean + gain * (new - self.mean)
        if self.learned:
            changed = (f - self.newest) ** 2
        count, self.newest, self.learned = int(self.learned), f, self.learned + 1
        m, mean_rough = self.mean[: len(misfit)], self.mean[len(misfit) :]
        weights = np.divide(1.0, self.sizes, out=np.zeros_like(self.sizes), where=self.sizes > 0)
        varied = (np.maximum(mean_rough - (C @ m) ** 2, 0) * weights).sum()
        most = (np.maximum((C @ m) ** 2, (C @ self.d) ** 2) * weights).sum()
        share, exact = max(1 - varied / most, 0) if most else 0.0, 0.0
        if count and self.rule.reach:
            change = (changed * weights).sum()
            self.change = change if count == 1 else self.change + gain * (change - self.change)
            largest = (np.maximum(f**2, (C @ self.d) ** 2) * weights).sum()
            exact = max(1 - self.rule.reach**2 * self.change / largest, 0) if largest else 0.0
        self.d = self.d + (exact * (misfit - self.d) if share < exact or exact > 0.99 else share * (m - self.d))

    def filtered(self, y, u, w):
        rule = self.rule
        if self.queue is None:
            self.queue = deque()
        else:
            self.queue.append(np.concatenate([u, w]))
        if len(self.queue) > rule.delay:
            self.s = rule.F @ self.s + rule.G @ self.queue.popleft() + rule.f
        came = np.isfinite(y)
        due = len(self.queue) >= rule.delay
        if due:
            self.judge(y, rule.M @ self.s + rule.h)
            if self.lost:
                self.s = self.start.copy()
                if rule.shows and came.all():
                    self.zeta, kept = None, rule.kept
                    self.s[: len(kept)] = evaluate(self.program.lifting, self.point(y, u))[kept]
        if due and came.any() and not self.refused:
            M = rule.M[came]
            S = M @ rule.P @ M.T + rule.R[np.ix_(came, came)]
            self.s = self.s + rule.P @ M.T @ np.linalg.solve(S, y[came] - M @ self.s - rule.h[came])
        self.missed = 0 if came.any() else self.missed + 1
        s = self.s
        for v in self.queue:
            s = rule.F @ s + rule.G @ v + rule.f
        self.z, self.d = rule.to_z @ s + rule.one, rule.to_d @ s
        return self.missed <= rule.patience


class Interpreter:
    """A controller that is nothing but its Program."""

    def __init__(self, program):
        self.p, self.row = program, 0
        self.nu = program.model.nu
        self.given = np.clip(np.zeros(self.nu), *program.inputs)
        self.observer = Estimate(program, self.advance)
        self.kept, self.age = None, 0
        latency = getattr(program, "latency", 0)
        self.sent = deque([self.given] * (latency + 1), maxlen=latency + 1)
        self.w = None
        self.step = {
            "FeedbackProgram": self.feedback,
            "CondensedProgram": self.condensed,
            "StagedProgram": self.staged,
        }[type(program).__name__]
        self.plan, self.last_target, self.chord, self.e = None, None, None, None

    # where a plan starts

    def advance(self, z, u, w, d):
        p, model = self.p, self.p.model
        if type(p).__name__ == "StagedProgram":
            return evaluate(p.functions["map"], z, u) + p.E @ w + d
        return model.A @ z + model.B @ u + model.E @ w + d

    def start(self, y, applied, w):
        """Return z, u_{−1}, the preview of w, d: where an input computed now acts."""
        p, nw = self.p, self.p.E.shape[1] if hasattr(self.p, "E") else self.p.model.nw
        got = applied is not None and usable(applied)
        before = applied if got and not p.latency else self.given
        rows = np.zeros((1, nw)) if w is None else np.atleast_2d(w)
        W = rows[np.minimum(np.arange(p.N + p.latency), len(rows) - 1)]
        self.sent.append(self.given)
        acted = applied if got else self.sent[0]
        good = self.observer.take(y, acted, np.zeros(nw) if self.w is None else self.w)
        now = W[0] if len(W) else np.zeros(nw)
        self.w = np.where(np.abs(now) < HUGE, now, np.zeros(nw) if self.w is None else self.w)
        z, d = self.observer.z if good else np.full_like(self.observer.z, np.nan), self.observer.d
        for i in range(p.latency):
            z = self.advance(z, self.sent[i + 1], W[i], d) if np.isfinite(z).all() else z
        return z, before, W[p.latency :], d

    def ahead(self, reference, N, latency):
        rows = np.atleast_2d(reference)
        return rows[np.minimum(np.arange(N + 1) + latency, len(rows) - 1)]

    def fall_back(self, free, applied):
        p = self.p
        before = applied if applied is not None and usable(applied) else self.given
        move_of = getattr(p, "move_of", np.arange(p.N))
        if self.kept is not None and self.age + 1 < p.N:
            self.age += 1
            u = self.kept[move_of[self.age]]
        else:
            self.kept, u = None, before if free is None else free
        self.given = clip_changes(u, p.inputs, p.rates, before)
        return self.given.copy()

    def keep(self, moves):
        self.kept, self.age, self.given = moves, 0, moves[0]
        return moves[0].copy()

    # targets of linear models

    def alpha(self, r, e=None, inside=True):
        t = self.p.targets
        alpha = t.from_reference @ r + t.offset + (0 if e is None else t.from_disturbance @ e)
        if not inside:
            return alpha
        pushed = 0 if e is None else t.rows_disturbance @ e
        value, low, high = t.rows @ alpha, t.low - pushed, t.high - pushed
        reach = 1e-9 * (np.abs(value) + t.size)
        if ((value >= low - reach) & (value <= high + reach)).all():
            return alpha
        H = t.weighted.T @ t.weighted
        H = H / max(np.trace(H), 1e-300) + 1e-9 * np.eye(len(H))
        for count in (len(t.rows), t.hard):
            moved = least(H, np.zeros(len(H)), t.rows[:count], (low - value)[:count], (high - value)[:count])
            if moved is not None:
                return alpha + moved
        return np.zeros_like(alpha)

    # u = feedforward − K z

    def feedback(self, y, reference, applied=None, w=None):
        p, t, model = self.p, self.p.targets, self.p.model
        r, w = np.atleast_2d(reference)[0], np.zeros(model.nw) if w is None else np.atleast_2d(w)[0]
        good = usable(r, w)
        if p.given is not None:
            u_r = p.given[min(self.row, len(p.given) - 1)]
        elif good:
            e = model.E @ w
            u_r = t.u0 + t.W @ self.alpha(r, e) + t.u_disturbance @ e
        self.row += 1
        if applied is not None and usable(applied):
            self.given = applied
        self.observer.take(y, self.given, w)
        u = None
        if good:
            u = p.feedforward @ np.concatenate([w, r, u_r]) - p.K @ self.observer.z
            u = u - p.K_rate @ self.given if p.K_rate.size else u
        free = self.given if u is None or not usable(u) else u
        self.given = clip_changes(free, p.inputs, p.rates, self.given)
        return self.given.copy()

    # one matrix, and a condensed QP

    def condensed(self, y, reference, applied=None, w=None):
        p, nv = self.p, len(self.p.offset)
        z, u_prev, W, d = self.start(y, applied, w)
        estimated = type(p.estimator).__name__ != "EstimatorProgram"
        drive = np.concatenate([W.ravel(), d if estimated else d[:0]])
        R = self.ahead(reference, p.N, p.latency)
        m = np.zeros(len(p.M))
        m[:nv] = p.offset + p.from_reference @ R.ravel()
        if p.given is not None:
            ahead = np.minimum(np.arange(p.N + 1) + self.row + p.latency, len(p.given) - 1)
            m[:nv] += p.from_given @ p.given[ahead].ravel()
            self.row = min(self.row + 1, len(p.given) - 1)
        driven = p.disturbance.shape[1] > 0
        good = usable(R, z)
        if p.aimed and good:
            alphas = np.array([self.alpha(r, inside=False) for r in R])
            if not driven:
                m[:nv] += p.from_target @ np.ravel([self.alpha(r) for r in R] - alphas)
            if p.checked.any():
                values = alphas @ p.targets.rows[p.checked].T
                m[nv:] = np.concatenate([values.min(axis=0), values.max(axis=0)])
        known = np.concatenate([z, u_prev if p.with_rates else u_prev[:0], drive])
        t = p.M @ known + m
        moves = len(p.deviation) // self.nu
        if not good or not usable(t):
            return self.fall_back(None, applied)
        if ((t >= p.low) & (t <= p.high)).all():
            return self.keep(t[: len(p.deviation)].reshape(moves, -1))
        if not ((t[nv:] >= p.low[nv:]) & (t[nv:] <= p.high[nv:])).all():
            e = p.disturbance @ drive
            t[:nv] += p.from_target @ np.ravel([self.alpha(r, e) - self.alpha(r, e, inside=False) for r in R])
            if ((t[:nv] >= p.low[:nv]) & (t[:nv] <= p.high[:nv])).all():
                return self.keep(t[: len(p.deviation)].reshape(moves, -1))
        qp = p.qp
        low, high, moved = qp.low.copy(), qp.high.copy(), qp.scale * t[qp.source]
        for row, which in zip(qp.rate_rows, qp.rate_inputs, strict=True):  # the input's own limit wins over its rate
            highest = (p.inputs.high - u_prev)[which] * qp.scale[row]
            lowest = (p.inputs.low - u_prev)[which] * qp.scale[row]
            low[row], high[row] = min(low[row], highest), max(high[row], lowest)
        found = least(qp.P, qp.q, qp.A, low - moved, high - moved, qp.softness)
        if found is None:
            return self.fall_back(t[: self.nu], applied)
        U = np.clip(t[: len(p.deviation)] + p.deviation @ found, p.low[: len(p.deviation)], p.high[: len(p.deviation)])
        U = U.reshape(moves, -1)
        if p.hard_rates is not None:
            U[0] = clip_changes(U[0], p.inputs, p.hard_rates, u_prev)
        return self.keep(U)

    # one linearisation a step, stage by stage

    def target(self, r):
        """Return (x, u, active, reference input, ∂u/∂e, M, L, V, m) of a row of the table."""
        p, nx, nu, nr = self.p, self.p.nx, self.nu, self.p.nr
        (row,) = (row for row in p.table if (row[:nr] == r).all())
        ng = len(row) - 1 - nr - nx - 2 * nu - nu * nx
        goal = nx + nr + nu * (p.weighs_changes and p.end != "given")
        ng -= goal * (nr + nx + nu + 1)
        sizes = [nr, nx, nu, ng, nu, nu * nx, goal * nr, goal * nx, goal * nu, goal]
        parts = np.split(row, np.cumsum(sizes))
        x, u, active, u_r, slope, M, L, V, m = parts[1:10]
        M, L, V = (a.reshape(goal, -1) for a in (M, L, V))
        return x, u, active, u_r, slope.reshape(nu, nx), M, L, V, m

    def staged(self, y, reference, applied=None, w=None):
        p, N, nx, nu, nr = self.p, self.p.N, self.p.nx, self.nu, self.p.nr
        x, u_prev, W, d = self.start(y, applied, w)
        e = np.zeros((N, nx)) if not p.disturbed else W @ p.E.T + d
        R = self.ahead(reference, N, p.latency)
        if not usable(x, R, e):
            self.warm = False
            return self.fall_back(None, applied)
        low, high = p.v_limits
        self.first = low, high
        s = x
        if p.with_rates:
            self.first = np.minimum(low, p.inputs.high - u_prev), np.maximum(high, p.inputs.low - u_prev)
            s = np.concatenate([x, u_prev, np.zeros(len(p.soft_rates))])
        targets = {r.tobytes(): self.target(r) for r in R}
        U = np.array([targets[r.tobytes()][3] for r in R[:-1]])
        slopes = np.array([targets[r.tobytes()][4] for r in R[:-1]])
        rest_x, rest_u, active, u_r, _, M, L, V, m = targets[R[-1].tobytes()]
        held = (R[:-1] == R[-1]).all(axis=1)
        if p.disturbed:
            begin = self.last_target or (rest_x, rest_u)
            assert not active.any(), "a loop whose equilibria are inside their limits"
            rest_x, rest_u = self.last_target = self.follow(begin, R[-1], e[-1])
            u_r = rest_u * p.holds
            if p.end != "given":
                m = M @ self.local(rest_x, rest_u)[3] + L @ rest_x + V @ u_r
            U = np.clip(U + slopes @ e[-1], *p.inputs)
            U[held] = u_r
        if p.given is not None:
            rows = p.given[np.minimum(np.arange(N + 1) + self.row + p.latency, len(p.given) - 1)]
            U, m, self.row = rows[:-1], m + V @ rows[-1], min(self.row + 1, len(p.given) - 1)
        if p.end == "stage" or (p.end != "given" and p.given is not None and not held[-1]):
            M, L, V = np.zeros_like(M), np.zeros_like(L), np.zeros_like(V)
            M[:nr] = p.Q_root
            m = M @ R[-1]
        self.R, self.U_r, self.end = R[1:], U, (M, L, m)
        if p.with_rates:
            n, ns = len(M), p.ns
            M_s, L_s, m_s = np.zeros((n + nu, nr + nu)), np.zeros((n + nu, ns)), np.zeros(n + nu)
            M_s[:n, :nr], L_s[:n, :nx], L_s[:n, nx : nx + nu], m_s[:n] = M, L, V, m
            L_s[n:, nx : nx + nu], m_s[n:] = p.R_root, p.R_root @ U[-1]
            self.R, self.U_r, self.end = np.hstack([R[1:], U]), np.zeros_like(U), (M_s, L_s, m_s)
        self.e = np.hstack([e, np.zeros((N, p.ns - nx))])
        self.rest_x = rest_x
        good = self.solve(s, x, u_prev)
        self.warm = good
        if not good:
            return self.fall_back(None, applied)
        U = self.trajectory()[1]
        u = U[0] if p.hard_rates is None else clip_changes(U[0], p.inputs, p.hard_rates, u_prev)
        U = np.vstack([u, U[1:]])
        self.given, self.kept, self.age = u, U, 0
        return u.copy()

    warm = False

    def solve(self, s, x, u_prev):
        p = self.p
        if self.warm and (np.abs(s[: p.nx] - self.S[1, : p.nx]) / p.stage_sizes[: p.nx]).max() <= 3.0:
            X, U = self.trajectory()
            X, U = np.vstack([X[1:], X[-1:]]), np.vstack([U[1:], U[-1:]])
            X[-1] = evaluate(p.functions["map"], X[-2], U[-1]) + self.e[-1, : p.nx]
            self.S, self.V = self.stages(X, U, u_prev)
            if self.improve(s, u_prev, p.iterations, 1e-6):
                return True
        best = None
        u = np.clip(u_prev if p.with_rates else np.zeros(self.nu), *p.inputs)
        U, rest = np.tile(u, (p.N, 1)), np.tile(x, (p.N + 1, 1))
        starts = [rest, rest + np.linspace(0, 1, p.N + 1)[:, None] * (self.rest_x - x)]
        if isinstance(p.model, km.StepMap):
            motion = rest.copy()
            for k in range(p.N):
                motion[k + 1] = evaluate(p.functions["map"], motion[k], u) + self.e[k, : p.nx]
            starts += [motion] if usable(motion) else []
        for X in starts:
            self.S, self.V = self.stages(X, U, u_prev)
            if self.improve(s, u_prev, 12, 1e-2):
                gap = self.gap()
                rank = (0, self.cost()) if gap < 0.02 else (1, gap)
                if best is None or rank < best[0]:
                    best = rank, self.S.copy(), self.V.copy()
        if best is None:
            return False
        _, self.S, self.V = best
        if not self.improve(s, u_prev, max(10, p.iterations), 1e-6):
            _, self.S, self.V = best
        return True

    def stages(self, X, U, u_prev):
        p = self.p
        U = np.clip(U, *p.inputs)
        if not p.with_rates:
            return X.copy(), U
        before = np.vstack([u_prev, U[p.held_from]])
        V = np.diff(before, axis=0)
        return np.hstack([X, before, np.vstack([np.zeros(self.nu), V])[:, p.soft_rates]]), V

    def trajectory(self):
        p, U = self.p, self.V
        if p.with_rates:
            U = self.S[0, p.nx : p.nx + self.nu] + np.cumsum(self.V * p.free[:, None], axis=0)
        return self.S[:, : p.nx], np.clip(U, *p.inputs)

    def improve(self, s, u_prev, most, settled):
        for k in range(most):
            found = self.program_of_deviations(s)
            if found is None:
                return False
            dS, dV = found
            if not self.take(s, dS, dV):
                return self.gap() < 0.2
            self.S, self.V = self.stages(*self.trajectory(), u_prev)
            moved = (
                (dV / self.p.input_sizes, self.V / self.p.input_sizes),
                (
                    dS / self.p.stage_sizes,
                    self.S[1:] / self.p.stage_sizes,
                ),
            )
            if k + 1 < most and all(np.abs(a).max() <= settled * (1 + np.abs(b).max()) for a, b in moved):
                break
        return True

    def program_of_deviations(self, s):
        """Return (δs_1 … δs_N, δv_0 … δv_{N−1}), the solution of the quadratic program along the plan."""
        p, N, ns, nu = self.p, self.p.N, self.p.ns, self.nu
        free = np.flatnonzero(p.free)
        place = {k: i for i, k in enumerate(free)}
        to = np.zeros((N + 1, ns, nu * len(free) + 1))  # δs_k as [δv of free stages; 1]
        to[0, :, -1] = s - self.S[0]
        n = nu * len(free)
        H, f = np.zeros((n, n)), np.zeros(n)
        self.c, self.A0 = np.zeros((N, ns)), None
        rows, low, high, linear, quadratic = [], [], [], [], []
        M, L, m = self.end
        box = [end[:, nu:] for end in p.stage_limits]
        for k in range(N):
            out = evaluate(p.functions["slopes"], self.S[k], self.V[k])
            A, B = out[: ns * ns].reshape(ns, ns), out[ns * ns : ns * (ns + nu)].reshape(ns, nu)
            self.c[k] = out[ns * (ns + nu) :] + self.e[k] - self.S[k + 1]
            self.A0 = A if k == 0 else self.A0
            to[k + 1] = A @ to[k]
            to[k + 1, :, -1] += self.c[k]
            if k in place:
                at = slice(nu * place[k], nu * place[k] + nu)
                to[k + 1][:, at] += B
                H[at, at] += p.R
                f[at] += p.R @ (self.V[k] - self.U_r[k])
                ends = self.first if k == 0 else p.v_limits
                rows.append(np.eye(nu, n, nu * place[k]))
                low.append(ends[0] - self.V[k])
                high.append(ends[1] - self.V[k])
                linear.append(np.full(nu, np.inf))
                quadratic.append(np.zeros(nu))
            state = self.S[k + 1]
            of = evaluate(p.functions["tracked"], state)
            nr = len(p.Q)
            of, J = of[:nr], of[nr:].reshape(nr, ns)
            if k + 1 < N:
                Q, q = J.T @ p.Q @ J, J.T @ p.Q @ (of - self.R[k])
            else:
                E = M @ J + L
                Q, q = E.T @ E, E.T @ (M @ of + L @ state - m)
            G, g0 = to[k + 1][:, :-1], to[k + 1][:, -1]
            H += G.T @ Q @ G
            f += G.T @ (Q @ g0 + q)
            if len(p.box.low):
                ng = len(p.box.low)
                out = evaluate(p.functions["limited"], state)
                J = out[ng:].reshape(ng, ns)
                rows.append(J @ G)
                value = out[:ng] + J @ g0
                low.append(box[0][k] - value)
                high.append(box[1][k] - value)
                linear.append(0.5 * p.softness.linear)
                quadratic.append(0.5 * p.softness.quadratic)
        half = 0.5 * (H + H.T)
        factor = np.linalg.cholesky(half)  # in v = L⁻ᵀ w the Hessian is the identity
        back = np.linalg.inv(factor).T
        arrays = np.vstack(rows) @ back, np.concatenate(low), np.concatenate(high)
        w = least(np.eye(n), back.T @ f, *arrays, (np.concatenate(linear), np.concatenate(quadratic)))
        if w is None:
            return None
        v = back @ w
        V = np.zeros((N, nu))
        V[free] = v.reshape(-1, nu)
        return to[1:] @ np.append(v, 1.0), V

    def take(self, s, dS, dV):
        p = self.p
        X, left = self.S[1:], self.c.copy()
        left[0] += self.A0 @ (s - self.S[0])
        change = np.maximum(np.abs(dS).max(axis=0), np.abs(left).max(axis=0))
        reach = 0.2 * change + 1e-9 * (p.stage_sizes + np.abs(X).max(axis=0))
        length = 1.0
        while True:
            X_new, V_new = X + length * dS, self.V + length * dV
            before = np.vstack([s, X_new[:-1]])
            trial = np.array([evaluate(p.functions["stage_map"], a, b) for a, b in zip(before, V_new, strict=True)])
            error = np.abs(trial + self.e - X_new - (1 - length) * left).max(axis=0)
            if (error <= length * reach).all() or length < 0.001:
                break
            length /= 2
        if length < 0.001:
            self.defects = np.abs(left).max(axis=0)
            return False
        self.S, self.V = np.vstack([s, X_new]), V_new
        self.defects = np.abs(trial + self.e - X_new).max(axis=0)
        return True

    def gap(self):
        spread = np.ptp(self.S, axis=0) + 1e-9 * (self.p.stage_sizes + np.abs(self.S[0]))
        return (self.defects / spread).max()

    def cost(self):
        p, (M, L, m), nr, total = self.p, self.end, len(self.p.Q), 0.0
        for k, state in enumerate(self.S[1:]):
            of = evaluate(p.functions["tracked"], state)[:nr]
            if k + 1 < p.N:
                total += (of - self.R[k]) @ p.Q @ (of - self.R[k])
            else:
                total += ((M @ of + L @ state - m) ** 2).sum()
            v = self.V[k] - self.U_r[k]
            total += v @ p.R @ v
            if len(p.box.low):
                value = evaluate(p.functions["limited"], state)[: len(p.box.low)]
                low, high = (end[k, len(v) :] for end in p.stage_limits)
                over = np.maximum(np.maximum(low - value, value - high), 0)
                soft = np.isfinite(p.softness.linear)
                total += p.softness.linear[soft] @ over[soft] + p.softness.quadratic[soft] @ over[soft] ** 2
        return total

    def local(self, x, u):
        p, nx, nu = self.p, self.p.nx, self.nu
        out = evaluate(p.functions["local"], x, u)
        nr, ng = p.nr, len(p.rest.low) - nu
        sizes = [nx, nx * nx, nx * nu, nr, nr * nx, ng]
        F, A, B, of, J, g, G = np.split(out, np.cumsum(sizes))
        return F, A.reshape(nx, nx), B.reshape(nx, nu), of, J.reshape(nr, nx), g[:ng], G.reshape(ng, nx)

    def follow(self, begin, r, e):
        """Return the equilibrium by one Gauss–Newton step from the last one, with factors of an earlier one close by."""
        (x, u), rest, nx = begin, self.p.rest, self.p.nx
        s, nr = np.concatenate([x, u]) / rest.size, self.p.nr
        close = 1e-2 * (1 + np.abs(s).max())
        F, A, B, of, J, *_ = self.local(x, u)
        if self.chord is None or np.abs(s - self.chord[0]).max() > close:
            E = np.hstack([A - np.eye(nx), B]) * rest.size / rest.size[:nx, None]
            left, sigma, right = np.linalg.svd(E)
            rank = int((sigma > 1e-12 * sigma[0]).sum())
            gain, free = right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T
            T = 1e-7 * np.eye(nr + len(s), len(s), -nr)
            T[:nr, :nx] = rest.weight @ J * rest.size[:nx]
            along = T @ free
            top = along[:nr]
            top[np.abs(top) < 1e-12 * np.abs(T).max()] = 0.0
            back = free @ np.linalg.pinv(along)
            self.chord = s, back @ T @ gain - gain, back
        _, H, T = self.chord
        residual = np.concatenate([rest.weight @ (r - of), -1e-7 * s])
        step = H @ ((F + e - x) / rest.size[:nx]) + T @ residual
        assert np.abs(step).max() <= close, "a loop whose disturbance moves slowly"
        x, u = np.split((s + step) * rest.size, [nx])
        return x, u
