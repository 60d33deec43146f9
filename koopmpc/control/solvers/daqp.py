# pyright: basic
"""DAQP behind our interface: the one file that imports it, checks what it accepts, and maps every exit flag.

DAQP is a dual active-set method: exact to rounding, and fast where few rows are active; but what it holds before
its end is infeasible. DAQP 0.11 ignores short vectors and unknown settings without a word, and takes NaN. It ignores a
row whose norm is below 3e-6, measures its tolerances in the units of the cost. It may call equalities that differ
by rounding contradictory, or a problem with a singular P unbounded when it starts warm. Nothing of that passes
here: rows, variables and cost are scaled; answers are measured where P is not diagonal; and a problem that is called
infeasible or unbounded is solved again, cold, with limits a tolerance wider, before that is believed. Scaling is
left out where nothing is far from one: each multiplication costs as much as an iteration.

Arnström, Bemporad & Axehill, "A dual active-set solver for embedded quadratic programming using recursive LDLᵀ
updates", IEEE Trans. Automatic Control 67(8), 2022.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import INFINITY, QP, QPSolution, QPSolver, StepQP

# eta_prox: DAQP's own 1e-6 is all that remains of its accuracy where P is singular.
DEFAULTS: Mapping[str, Any] = {"primal_tol": 1e-8, "eta_prox": 1e-9}
_WIDER = 1e-8  # relative widening of the limits before a problem is believed to have no solution
_ACCURACY = 1e-6  # of the scaled KKT conditions where P is not diagonal and definite, relative

_STEEP = 1e-8  # smallest over largest eigenvalue of AᵀA of the hard rows below which rounding makes them look dependent
_DAMPING = 1e7  # weight of a change of the hard rows in the first proximal step, by the size of P
_EASING = 10.0  # the weight changes by this factor if the step fails
_MOST_DAMPING = 1e9  # give up above this weight
_PASSES = 20  # proximal steps, at most
_LEAST = np.full(1, 1e-300)
_SLOW = 0.1  # share of what the step before missed above which the weight is eased
_CURVED = 1e-8  # least curvature of a price by its slope, per unit of a row: DAQP divides by it, and with 1e-10 it errs

FEW = 20  # active rows up to which the next solve goes on from them
MOVED = 6  # of more rows too, if a shift by one step changes at most so many
_MANY = 16  # iterations of a solve that tell how long one takes

_COLD = "cold_start"  # our own setting

# DAQP's exit flags
_OPTIMAL = 1
_INFEASIBLE = -1
_ITERATIONS = -4
_TIME_LIMIT = -7
# DAQP's senses of rows; _SOFT is added to another
_UPPER = 1  # active at the upper end
_LOWER = 3  # active at the lower end
_SOFT = 8
_STATUS = {
    _INFEASIBLE: Status.INFEASIBLE,
    _ITERATIONS: Status.MAX_ITERATIONS,
    _TIME_LIMIT: Status.TIME_LIMIT,
}


@dataclass(frozen=True, eq=False)
class DAQPSetup(Value):
    """½ xᵀH x → min, low ≤ M x ≤ high, v = D x: a QP with q = 0 as DAQP solves it.

    Attributes
    ----------
    H, M
        (n, n), (m, n).
    columns, rows
        (n,) the diagonal D, (m,) the factor of each row and of its limits.
    soft
        (m,) whether a row may be broken by ε ≥ 0 at the price linear ε + ½ curvature ε².
    linear, curvature
        (m,) these prices, by the scaled row.
    metric
        (n, n) AᵀA of the hard rows where these are so close to dependent that proximal points solve the QP; else None.
    settings
        All settings of DAQP.
    """

    H: Float[np.ndarray, "n n"]
    M: Float[np.ndarray, "m n"]
    columns: Float[np.ndarray, " n"]
    rows: Float[np.ndarray, " m"]
    soft: Bool[np.ndarray, " m"]
    linear: Float[np.ndarray, " m"]
    curvature: Float[np.ndarray, " m"]
    metric: Float[np.ndarray, "n n"] | None
    settings: Mapping[str, Any]


def daqp_settings(settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return all settings of DAQP: ours, and those that are given.

    Raises
    ------
    DataError
        DAQP has no such setting, or the value is out of range.
    """
    known = settings or {}
    return {**_model(known).settings, _COLD: bool(known.get(_COLD, False))}


class DAQP(QPSolver):
    """A QP set up once in DAQP; limits move, solves start from the active rows of the last one.

    Parameters
    ----------
    qp
        The problem.
    settings
        DAQP's own settings, for example ``{"iter_limit": 200}``; they override `DEFAULTS`. With ``"cold_start": True``
        every solve starts from no active rows.

    Raises
    ------
    DataError
        DAQP refuses the problem or a setting.
    """

    name = "daqp"
    exact = True  # to rounding in any coordinates, but its time grows with cond(H)

    @staticmethod
    def setting_names() -> frozenset[str]:
        """Return the names of DAQP's settings."""
        return frozenset([*_model({}).settings, _COLD])

    def _setup(self) -> None:
        self._model, self._cold = _model(self._settings), bool(self._settings.get(_COLD, False))
        known = self._model.settings
        self._time_limit = self._allowed = known["time_limit"]
        self._most = self._few = known["iter_limit"]
        self._last_most: int | None = None
        self._pace = 1e-9  # how long an iteration takes [s], once it is known
        self._scale()
        free = np.full(len(self.low), INFINITY)
        flag, _ = self._model.setup(self._H, self._f, self._M, free, -free, self._sense)
        if flag < 0:
            raise DataError(f"DAQP refuses the problem, exit flag {flag}; pass a convex QP, P ⪰ 0")
        self._mixed, self._unmet = self._soft and not self._sense.all(), False
        self._hard: DAQP | None = None  # the hard rows alone, set up when they are asked for
        self._is_steep: bool | None = None  # found out when it is asked
        self.resumes, self._none = False, np.zeros(len(self._f))
        self._lighter: dict[float, DAQP] = {}  # the solvers of `_approach`, by their weight
        self._far = (
            False  # whether a solution of many active rows had to be approached last, so that the next one is at once
        )
        if self._soft:
            linear, rho = (np.where(self._sense == _SOFT, part, 0.0) for part in (self._linear, 1 / self._curved))
            self._model.soft_weights(rho_l=rho, rho_u=rho, w_l=linear, w_u=linear)

    def __reduce__(self) -> tuple[type["DAQP"], tuple[QP, dict[str, Any]], tuple[Interval, bool]]:
        self.resumes = False  # a copy starts from y, and the original has to have the same iterates
        return (
            type(self),
            (self._qp, self._settings),
            (Interval(self.low, self.high), bool(self._far and not self._stale)),
        )

    def __setstate__(self, state: tuple[Interval, bool]) -> None:
        """Take over the limits that the original had, and how far from them its last solution was."""
        limits, self._far = state
        self.set_bounds(*limits)

    @property
    def setup(self) -> DAQPSetup:
        """The scaled problem and the settings."""
        return DAQPSetup(
            self._H,
            self._M,
            self._columns,
            self._rows,
            self._sense != 0,
            self._linear,
            self._curved,
            self._metric() if len(self._rows) and self._steep() else None,
            {**self._model.settings, _COLD: self._cold},
        )

    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size: DAQP's setup is one factorisation."""
        self.__init__(qp, self._settings)

    def _forget(self) -> None:
        """Forget how hard the last solve was: a solve starts from its y alone."""
        self._far = False

    def resume(self, time_limit: float | None = None) -> QPSolution:
        """Solve from the rows that the last solve ended with, whose factors DAQP still holds.

        That spares their factors: the cart-pole's step of N 50 with 25 active rows takes 7 µs in C instead of 17. Where
        the rows of the next step are others, it takes up to a hundred times as many iterations as to start from rows
        that have moved on by a step; therefore `resumes` is False where that move changes many rows.
        """
        return self._from(self._none, None, time_limit)

    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        """Solve from the rows that y pushes to."""
        self.resumes = False
        if self._cold:
            y, self._far, self._unmet = np.zeros_like(y), False, False
        if self._far:
            return self._approach(v, y, self._time_limit if time_limit is None else time_limit)
        if self._unmet and self._contradictory(time_limit):
            return QPSolution(v.copy(), y.copy(), Status.INFEASIBLE, 0, self.name)
        return self._from(v, y, time_limit)

    def _from(
        self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"] | None, time_limit: float | None
    ) -> QPSolution:
        """Solve from the rows that y pushes to, for None from those of the last solve.

        DAQP looks at the clock every 32 iterations, so that it gets as many as fit in, too. Where more rows than there
        are variables push, as on a plant that is lost, it needs either a few iterations or thousands; then it starts
        again from the hard rows alone, and needs one or two hundred.
        """
        limit = self._time_limit if time_limit is None else time_limit
        start = perf_counter() if limit else 0.0
        self._send(None if y is None else self._active(y))
        crowded = y is not None and self._soft and np.count_nonzero(y) > len(v)
        x, multipliers, flag, iterations = self._run(limit, len(v) if crowded else None)
        if y is not None and crowded and flag == _ITERATIONS:
            self._send(self._active(np.where(self._sense == _SOFT, 0.0, y)))
            x, multipliers, flag, more = self._run(max(limit - (perf_counter() - start), 1e-6) if limit else limit)
            iterations += more
        good = (flag == _OPTIMAL and self._exact) or (flag > 0 and self._accurate(x, multipliers))
        self.resumes = good and not self._cold and self._lasts(multipliers)
        if not good and flag != _TIME_LIMIT:
            steep = self._steep()
            if flag == _INFEASIBLE and self._mixed and not steep and self._contradictory(time_limit):
                self._unmet = True
            elif flag != _INFEASIBLE or not steep:
                left = limit - (perf_counter() - start) if limit else 0.0
                if left < 0:
                    flag = _TIME_LIMIT
                else:
                    self._send(self._sense, _WIDER)
                    x, multipliers, flag, more = self._run(left)
                    iterations += more
                    good = flag > 0 and self._accurate(x, multipliers)
            if not good and flag != _TIME_LIMIT and steep:
                rows = np.zeros_like(self.low) if y is None else y
                found = self._approach(v, rows, limit - (perf_counter() - start) if limit else 0.0)
                found.iterations += iterations
                return found
        status = Status.OPTIMAL if good else _STATUS.get(flag, Status.FAILED)
        if self._scaled:
            x, multipliers = self._columns * x, self._multipliers * multipliers
        return QPSolution(x, multipliers, status, iterations, self.name)

    def _lasts(self, multipliers: Float[np.ndarray, " m"]) -> bool:
        """Return whether few rows are active, or few change where a step moves them on."""
        qp, few = self._qp, int(np.count_nonzero(multipliers)) <= FEW
        if few or not isinstance(qp, StepQP):
            return few
        now = np.append(np.sign(multipliers), 0.0)
        return int(np.count_nonzero(now[:-1] != now[qp.shift_dual])) <= MOVED

    def _contradictory(self, time_limit: float | None) -> bool:
        """Return whether the hard rows alone have no point in common.

        Where soft rows are far outside, DAQP moves through all of these before it finds that out; it is asked at once
        where it was so in the last solve.
        """
        rows, qp = self._sense != _SOFT, self._qp
        if self._hard is None:
            self._hard = DAQP(QP(qp.P, qp.q, qp.A[rows], qp.low[rows], qp.high[rows]), self._settings)
        own = self._hard
        own.low[:], own.high[:] = self.low[rows], self.high[rows]
        found = own.solve(np.zeros_like(qp.q), np.zeros(len(own.low)), time_limit)
        self._unmet = found.status is Status.INFEASIBLE
        return self._unmet

    def _metric(self) -> Float[np.ndarray, "n n"]:
        """Return AᵀA of the hard rows, of all rows where none is hard, with the mean diagonal of P."""
        hard = self._qp.A[self._sense != _SOFT]
        rows = hard if len(hard) else self._qp.A
        gram = rows.T @ rows
        return gram * float(np.trace(self._qp.P) / max(np.trace(gram), 1e-300))

    def _steep(self) -> bool:
        """Return whether hard rows are so close to dependent that INFEASIBLE cannot be believed."""
        if self._is_steep is None:
            values = np.linalg.eigvalsh(self._metric())
            self._is_steep = bool(values[0] < _STEEP * values[-1] and (np.diag(self._qp.P) > 0).all())
        return self._is_steep

    def _approach(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], limit: float) -> QPSolution:
        """Solve by proximal points: v ← argmin ½vᵀPv + qᵀv + ½c ‖A_h (v − v_last)‖² within the limits.

        A_h are the hard rows. In plans of unstable plants these are inputs, of which some combinations take a v a
        million times as large as others: DAQP then takes independent rows for dependent ones. The added weight makes
        them alike, and two or three steps lead to the solution of the QP itself.

        Rockafellar, "Monotone operators and the proximal point algorithm", SIAM J. Control and Optimization 14, 1976.
        """
        start, qp, metric = perf_counter(), self._qp, self._metric()
        center, rows, weight, least, missed, iterations = np.zeros_like(v), y, _DAMPING, 0.0, np.inf, 0
        found, last = QPSolution(v.copy(), y.copy(), Status.INFEASIBLE, 0, self.name), None
        for _ in range(_PASSES):
            solver = self._weigh_changes(weight, metric)
            solver.pull(qp.q - weight * metric @ center)
            left = limit - (perf_counter() - start) if limit else None
            again = solver is last and found.status is Status.MAX_ITERATIONS  # the step before led here
            found, last = solver.resume(left) if again else solver.solve(center, rows, left), solver
            iterations += found.iterations
            if found.status is Status.OPTIMAL:
                before, missed = missed, weight * float(np.abs(metric @ (found.v - center)).max())
                missed /= max(float(np.abs(part).max()) for part in (qp.P @ found.v, found.y @ qp.A, _LEAST))
                if missed <= _ACCURACY:
                    break
                center, rows, found.status = found.v, found.y, Status.MAX_ITERATIONS
                if missed > _SLOW * before:
                    weight = max(weight / _EASING, least)
            elif found.status is Status.TIME_LIMIT or weight > _MOST_DAMPING:
                break
            else:  # as light a weight as this does not make the rows alike
                weight *= _EASING
                least = weight
        found.iterations = iterations
        self._far = found.status is Status.OPTIMAL and bool(2 * np.count_nonzero(found.y) > len(v))
        return found

    def _weigh_changes(self, weight: float, metric: Float[np.ndarray, "n n"]) -> "DAQP":
        """Return the solver of the same rows with the cost that this weight eases, whose INFEASIBLE is believed."""
        qp, solver = self._qp, self._lighter.get(weight)
        if solver is None:
            solver = DAQP(QP(qp.P + weight * metric, qp.q, qp.A, self.low, self.high, qp.softness), self._settings)
            self._lighter[weight] = solver
        solver.low[:], solver.high[:] = self.low, self.high
        solver._mixed = solver._unmet = solver._is_steep = False
        return solver

    def pull(self, q: Float[np.ndarray, " n"]) -> None:
        """Go on with another linear cost."""
        self._f = q * self._columns / self._unit
        self._model.update(f=self._f)

    def _active(self, y: Float[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """Return the rows with the ends that y pushes to as DAQP's senses."""
        return self._sense + (y > 0) * np.intc(_UPPER) + (y < 0) * np.intc(_LOWER)

    def _scale(self) -> None:
        """Set DAQP's problem H, f, M with v = D x: unit diagonal of H, unit rows of M, a cost of the size of v."""
        P, q, A = self._qp.P, self._qp.q, self._qp.A
        diagonal = np.diag(P)
        curved = diagonal > 0
        unit = float(np.exp(np.log(diagonal[curved]).mean())) if curved.any() else 1.0
        columns = np.sqrt(unit / np.where(curved, diagonal, unit))
        norms = np.linalg.norm(A * columns, axis=1)
        rows = 1.0 / np.where(norms > 0, norms, 1.0)
        self._exact = bool(curved.all()) and not np.count_nonzero(P - np.diag(diagonal))
        sizes = np.concatenate([[unit], columns, np.sqrt(rows)])
        self._scaled = bool(sizes.min() < 0.01 or sizes.max() > 100)
        if not self._scaled:
            unit, columns, rows = 1.0, np.ones_like(columns), np.ones_like(rows)
        self._H, self._f = P * np.outer(columns, columns) / unit, q * columns / unit
        self._M = A * columns * rows[:, None]
        self._columns, self._rows, self._multipliers, self._unit = columns, rows, rows * unit, unit
        softness = self._qp.softness
        none = np.full(len(rows), np.inf)
        linear, quadratic = (none, none) if softness is None else softness[:2]
        self._linear = linear / self._multipliers
        self._curved = np.maximum(2 * quadratic / (self._multipliers * rows), _CURVED * self._linear)
        self._sense = np.where(np.isfinite(linear), _SOFT, 0).astype(np.intc)
        self._soft = bool(self._sense.any())

    def _send(self, sense: Int[np.ndarray, " m"] | None, wider: float = 0.0) -> None:
        """Give DAQP the limits, relaxed by the share `wider` of 1 + their size, and the rows to start from."""
        self._low, self._high = self.low, self.high
        if self._scaled:
            self._low, self._high = self._rows * self._low, self._rows * self._high
        if wider:
            self._low = self._low - wider * (1 + np.abs(self._low))
            self._high = self._high + wider * (1 + np.abs(self._high))
        self._refused = 0  # DAQP fails to update no rows
        if len(self._rows):
            self._refused = self._model.update(bupper=self._high, blower=self._low, sense=sense)

    def _run(
        self, limit: float, most: int | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], int, int]:
        """Return what DAQP says of the limits that it has: x, multipliers, exit flag, iterations (at most `most`)."""
        if self._refused < 0:
            return np.zeros_like(self._f), np.zeros_like(self._rows), self._refused, 0
        if limit != self._allowed or most != self._last_most:
            few = self._most if not limit else min(self._most, 1 + int(limit / self._pace))
            few = few if most is None else min(few, most)
            self._model.settings = {"time_limit": limit, "iter_limit": few}
            self._allowed, self._few, self._last_most = limit, few, most
        x, _, flag, info = self._model.solve()
        iterations = info["iterations"]
        if limit and iterations > _MANY:
            self._pace += 0.5 * (info["solve_time"] / iterations - self._pace)
        if flag == _ITERATIONS and limit and self._few < (most or self._most):
            flag = _TIME_LIMIT
        return x, info["lam"], flag, iterations

    def _accurate(self, x: Float[np.ndarray, " n"], multipliers: Float[np.ndarray, " m"]) -> bool:
        """Tell whether H x + f + Mᵀλ = 0 holds, low ≤ M x ≤ high, and |λ| is the price of what a soft row gives way.

        Where soft rows are, λ must push to an end that M x is at, or beyond.
        """
        Hx, Mx, Ml = self._H @ x, self._M @ x, multipliers @ self._M
        size = max(float(np.abs(part).max(initial=1.0)) for part in (Hx, self._f, Ml))
        near = _ACCURACY * float(np.abs(Mx).max(initial=1.0))
        over, under = Mx - self._high, self._low - Mx
        outside = np.maximum(over, under)
        if float(np.abs(Hx + self._f + Ml).max()) > _ACCURACY * size:
            return False
        if not self._soft:
            return float(outside.max(initial=0.0)) <= near
        soft, push = self._sense == _SOFT, np.abs(multipliers)
        slack = np.maximum(outside, 0.0)[soft]
        price = self._linear[soft] + self._curved[soft] * slack
        little = _ACCURACY * (size + self._linear[soft])
        short = np.where(slack > near, price - push[soft], 0.0) - self._curved[soft] * near
        inside = -np.where(multipliers > 0, over, under)[push > _ACCURACY * size]
        return bool(
            outside[~soft].max(initial=0.0) <= near
            and (push[soft] - price <= little + self._curved[soft] * near).all()
            and (short <= little).all()
            and inside.max(initial=0.0) <= near
        )


def _model(settings: Mapping[str, Any]) -> Any:
    """Return an empty DAQP model with checked settings."""
    import daqp

    model, settings = daqp.Model(), {name: value for name, value in settings.items() if name != _COLD}
    known = model.settings
    for name, value in settings.items():
        if name not in known:
            raise DataError(f"DAQP has no setting {name!r}; it has {', '.join(known)}")
        if name.endswith("_tol"):
            checks.positive(value, f"DAQP's {name}")
        elif isinstance(known[name], int):
            checks.count(value, f"DAQP's {name}", least=1 if name == "iter_limit" else -1)
        else:
            checks.array(value, f"DAQP's {name}", ())
    model.settings = {**DEFAULTS, **settings}
    return model
