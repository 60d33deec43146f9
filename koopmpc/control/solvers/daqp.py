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
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import INFINITY, QP, QPSolution, QPSolver, StepQP
from koopmpc.control.solvers.scaled_qp import ACCURACY, DAQPSetup, ScaledQP

# eta_prox: DAQP's own 1e-6 is all that remains of its accuracy where P is singular.
DEFAULTS: Mapping[str, Any] = {"primal_tol": 1e-8, "eta_prox": 1e-9}
_WIDER = 1e-8  # relative widening of the limits before a problem is believed to have no solution

_STEEP = 1e-8  # smallest over largest eigenvalue of AᵀA of the hard rows below which rounding makes them look dependent
_DAMPING = 1e7  # weight of a change of the hard rows in the first proximal step, by the size of P
_EASING = 10.0  # the weight changes by this factor if the step fails
_MOST_DAMPING = 1e9  # give up above this weight
_PASSES = 20  # proximal steps, at most
_LEAST = np.full(1, 1e-300)
_SLOW = 0.1  # share of what the step before missed above which the weight is eased

FEW = 20  # active rows up to which the next solve goes on from them
MOVED = 6  # of more rows too, if a shift by one step changes at most so many
_MANY = 16  # iterations of a solve that tell how long one takes

_COLD = "cold_start"  # our own setting


class _Flag:
    """DAQP's exit flags."""

    OPTIMAL = 1
    INFEASIBLE = -1
    ITERATIONS = -4
    TIME_LIMIT = -7
    UNMET = -100  # our own: the answer does not meet its conditions


class _Sense:
    """DAQP's senses of rows; SOFT is added to another."""

    UPPER = 1  # active at the upper end
    LOWER = 3  # active at the lower end
    SOFT = 8


_STATUS = {
    _Flag.OPTIMAL: Status.OPTIMAL,
    _Flag.INFEASIBLE: Status.INFEASIBLE,
    _Flag.ITERATIONS: Status.MAX_ITERATIONS,
    _Flag.TIME_LIMIT: Status.TIME_LIMIT,
}


def daqp_settings(settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return all settings of DAQP: ours, and those that are given."""
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
        self._scaled = ScaledQP(self._qp)
        self._sense = np.where(self._scaled.is_soft, _Sense.SOFT, 0).astype(np.intc)
        self._soft = bool(self._sense.any())
        free = np.full(len(self.low), INFINITY)
        flag, _ = self._model.setup(self._scaled.H, self._scaled.f, self._scaled.M, free, -free, self._sense)
        if flag < 0:
            raise DataError(f"DAQP refuses the problem, exit flag {flag}; pass a convex QP, P ⪰ 0")
        self._mixed, self._unmet = self._soft and not self._sense.all(), False
        self._hard: DAQP | None = None  # the hard rows alone, set up when they are asked for
        self._is_steep: bool | None = None  # found out when it is asked
        self.resumes, self._none = False, np.zeros(len(self._qp.q))
        self._lighter: dict[float, DAQP] = {}  # the solvers of `_approach`, by their weight
        self._far = False  # whether the last solve had to approach a solution of many active rows: the next one does
        if self._soft:
            prices = self._scaled.linear, 1 / self._scaled.curvature
            linear, rho = (np.where(self._sense == _Sense.SOFT, part, 0.0) for part in prices)
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
        scaled = self._scaled
        return DAQPSetup(
            scaled.H,
            scaled.M,
            scaled.columns,
            scaled.rows,
            self._sense != 0,
            scaled.linear,
            scaled.curvature,
            self._metric() if len(scaled.rows) and self._steep() else None,
            {**self._model.settings, _COLD: self._cold},
        )

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
        end = perf_counter() + limit if limit else 0.0
        self._send(None if y is None else self._active(y))
        crowded = y is not None and self._soft and np.count_nonzero(y) > len(v)
        x, multipliers, flag, iterations = self._run(limit, len(v) if crowded else None)
        if y is not None and crowded and flag == _Flag.ITERATIONS:
            self._send(self._active(np.where(self._sense == _Sense.SOFT, 0.0, y)))
            x, multipliers, flag, more = self._run(max(end - perf_counter(), 1e-6) if limit else limit)
            iterations += more
        good = flag == _Flag.OPTIMAL and self._scaled.is_exact
        good = good or (flag > 0 and self._scaled.is_met(x, multipliers, self._low, self._high))
        self.resumes = good and not self._cold and self._lasts(multipliers)
        if good or flag == _Flag.TIME_LIMIT:
            return self._unscale(x, multipliers, _Flag.OPTIMAL if good else flag, iterations)
        return self._solve_again(v, y, (x, multipliers, flag, iterations), end)

    def _solve_again(
        self,
        v: Float[np.ndarray, " n"],
        y: Float[np.ndarray, " m"] | None,
        ended: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], int, int],
        end: float,
    ) -> QPSolution:
        """Solve what DAQP could not: cold, with limits a tolerance wider; then by proximal points, if rows are steep.

        `ended` is what `_run` returned, `end` the time by `perf_counter` at which this has to be over, 0 for none.
        """
        (x, multipliers, flag, iterations), steep = ended, self._steep()
        if flag == _Flag.INFEASIBLE and self._mixed and not steep and self._contradictory(_find_left(end)):
            self._unmet = True
        elif flag != _Flag.INFEASIBLE or not steep:
            left = _find_left(end)
            if left is not None and left < 0:
                flag = _Flag.TIME_LIMIT
            else:
                self._send(self._sense, _WIDER)
                x, multipliers, flag, more = self._run(left or 0.0)
                iterations += more
                if flag > 0:
                    met = self._scaled.is_met(x, multipliers, self._low, self._high)
                    flag = _Flag.OPTIMAL if met else _Flag.UNMET
        if steep and flag not in (_Flag.OPTIMAL, _Flag.TIME_LIMIT):
            found = self._approach(v, np.zeros_like(self.low) if y is None else y, _find_left(end) or 0.0)
            found.iterations += iterations
            return found
        return self._unscale(x, multipliers, flag, iterations)

    def _unscale(
        self, x: Float[np.ndarray, " n"], multipliers: Float[np.ndarray, " m"], flag: int, iterations: int
    ) -> QPSolution:
        """Return the solution in the units of the QP."""
        if not self._scaled.is_plain:
            x, multipliers = self._scaled.columns * x, self._scaled.multipliers * multipliers
        return QPSolution(x, multipliers, _STATUS.get(flag, Status.FAILED), iterations, self.name)

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
        rows, qp = self._sense != _Sense.SOFT, self._qp
        if self._hard is None:
            self._hard = DAQP(QP(qp.P, qp.q, qp.A[rows], qp.low[rows], qp.high[rows]), self._settings)
        own = self._hard
        own.low[:], own.high[:] = self.low[rows], self.high[rows]
        found = own.solve(np.zeros_like(qp.q), np.zeros(len(own.low)), time_limit)
        self._unmet = found.status is Status.INFEASIBLE
        return self._unmet

    def _metric(self) -> Float[np.ndarray, "n n"]:
        """Return AᵀA of the hard rows, of all rows where none is hard, with the mean diagonal of P."""
        hard = self._qp.A[self._sense != _Sense.SOFT]
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
            scaled = solver._scaled
            scaled.f = (qp.q - weight * metric @ center) * scaled.columns / scaled.unit
            solver._model.update(f=scaled.f)
            left = limit - (perf_counter() - start) if limit else None
            again = solver is last and found.status is Status.MAX_ITERATIONS  # the step before led here
            found, last = solver.resume(left) if again else solver.solve(center, rows, left), solver
            iterations += found.iterations
            if found.status is Status.OPTIMAL:
                before, missed = missed, weight * float(np.abs(metric @ (found.v - center)).max())
                missed /= max(float(np.abs(part).max()) for part in (qp.P @ found.v, found.y @ qp.A, _LEAST))
                if missed <= ACCURACY:
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

    def _active(self, y: Float[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """Return the rows with the ends that y pushes to as DAQP's senses."""
        return self._sense + (y > 0) * np.intc(_Sense.UPPER) + (y < 0) * np.intc(_Sense.LOWER)

    def _send(self, sense: Int[np.ndarray, " m"] | None, wider: float = 0.0) -> None:
        """Give DAQP the limits, relaxed by the share `wider` of 1 + their size, and the rows to start from."""
        self._low, self._high, rows = self.low, self.high, self._scaled.rows
        if not self._scaled.is_plain:
            self._low, self._high = rows * self._low, rows * self._high
        if wider:
            self._low = self._low - wider * (1 + np.abs(self._low))
            self._high = self._high + wider * (1 + np.abs(self._high))
        self._refused = 0  # DAQP fails to update no rows
        if len(rows):
            self._refused = self._model.update(bupper=self._high, blower=self._low, sense=sense)

    def _run(
        self, limit: float, most: int | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], int, int]:
        """Return what DAQP says of the limits that it has: x, multipliers, exit flag, iterations (at most `most`)."""
        if self._refused < 0:
            return np.zeros_like(self._scaled.f), np.zeros_like(self._scaled.rows), self._refused, 0
        if limit != self._allowed or most != self._last_most:
            few = self._most if not limit else min(self._most, 1 + int(limit / self._pace))
            few = few if most is None else min(few, most)
            self._model.settings = {"time_limit": limit, "iter_limit": few}
            self._allowed, self._few, self._last_most = limit, few, most
        x, _, flag, info = self._model.solve()
        iterations = info["iterations"]
        if limit and iterations > _MANY:
            self._pace += 0.5 * (info["solve_time"] / iterations - self._pace)
        if flag == _Flag.ITERATIONS and limit and self._few < (most or self._most):
            flag = _Flag.TIME_LIMIT
        return x, info["lam"], flag, iterations


def _find_left(end: float) -> float | None:
    """Return the seconds until `end` by `perf_counter`; None where that is 0, for no end."""
    return end - perf_counter() if end else None


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
