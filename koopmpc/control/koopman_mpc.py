"""KoopmanMPC: the Riccati solution first, a QP only where a limit is active."""

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.condense import Coordinates
from koopmpc.control.constrained import Constrained
from koopmpc.control.cost import Cost
from koopmpc.control.fallback import PlanMemory, admitted
from koopmpc.control.horizon import blocked
from koopmpc.control.lifted import reference_rows
from koopmpc.control.limits import Box, Limits
from koopmpc.control.move import Fallback, Move, Plan, Status
from koopmpc.control.origin import Origin
from koopmpc.control.plan_map import PlanMap
from koopmpc.errors import DataError, ShapeError
from koopmpc.estimate.observer import Estimator, Observer
from koopmpc.lifting.buffered import HUGE
from koopmpc.predict.linear import LinearPredictor

_VIEWS = ("_z", "_u_prev", "_W", "_d", "_drive", "_met", "_met_low", "_met_high")


class KoopmanMPC:
    """Minimise the Cost over N steps of z⁺ = A z + B u + E w + d, z_0 = ψ(x), within the Limits.

    The backward Riccati recursion gives the unconstrained plan as one matrix–vector product of [z, 1], or of
    [z, u_{−1}, w, d, 1] where those matter; where that plan meets every limit it is the optimum (status
    UNCONSTRAINED). Otherwise the condensed QP is solved for the deviation from it, warm-started with the last
    solution moved on by one step (OPTIMAL, or SOFTENED where a limit had to give way). A failed step falls back on
    the last plan, then on the clipped unconstrained input, then on the last input. Inputs never leave their limits,
    nor their rates where these are hard and within reach of the limits.

    Parameters
    ----------
    predictor
        The lifted model.
    cost, limits
        What to minimise, within what.
    horizon
        N steps of the predictor's dt.
    moves
        How many inputs the plan has: M of them, the last held to the end of the horizon, or the lengths of the
        blocks of steps in which each is held. By default one a step.
    estimator
        Estimates z and a disturbance d of every lifted coordinate, so that no offset is left: `LiftedDisturbance`
        where y is the state, `LiftedKalman` where y is some of it. Without one y is the state, and d zero.
    latency
        Steps until an input acts: 1 where it is computed during a step and applied at its end. The plan starts
        from the state predicted for then, under the inputs that are still to act; zero moved inside the limits
        acts before the first. `horizon` grows by it: more of the reference is read.
    disturbed
        True makes room for a constant disturbance d of every lifted coordinate, which `disturb` sets.
    coordinates
        Variables of the QP: "plain", the inputs; "riccati", those in which the Hessian is the identity however
        unstable the plant; "auto" takes the plain ones where their Hessian is well conditioned.
    solver
        "osqp", or "daqp", an active-set method that the extra ``koopmpc[daqp]`` installs.
    settings
        The solver's own settings, for example ``{"eps_abs": 1e-9, "eps_rel": 1e-9}``.
    time_limit
        Wall-clock time a step may take [s]. A QP that is not solved by then is given up for the fallback; what is
        late although it was solved is used. Either way the status is TIME_LIMIT.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        A horizon below 1, crossed limits, sizes that do not fit.

    References
    ----------
    Korda & Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
    control", Automatica 93, 2018.
    """

    solver_fails = False  # set by fault injection alone, see control.move.Fallible

    def __init__(
        self,
        predictor: LinearPredictor,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: int | Sequence[int] | None = None,
        disturbed: bool = False,
        coordinates: Coordinates = "auto",
        solver: Literal["osqp", "daqp"] = "osqp",
        settings: Mapping[str, Any] | None = None,
        time_limit: float | None = None,
    ) -> None:
        if coordinates not in ("auto", "riccati", "plain"):
            raise DataError(f'coordinates is {coordinates!r}; pass "auto", "riccati" or "plain"')
        self._N, self._nu = checks.count(horizon, "horizon"), predictor.nu
        self._blocks = blocked(moves, self._N)
        self.predictor, self.cost, self.limits = predictor, cost, Limits() if limits is None else limits
        self._latency = checks.count(latency, "latency", 0)
        self._disturbed = disturbed or estimator is not None
        self._map = PlanMap(
            predictor, cost, self.limits, self._blocks, disturbed=self._disturbed, coordinates=coordinates
        )
        track = self._map.track
        self._constrained = Constrained(self._map.hard, self._map.soft, solver, settings)
        self._allowed = np.inf if time_limit is None else checks.positive(time_limit, "time_limit", "s")
        self._planned = False
        self._rated = self._map.horizon.rated
        self._signals = self._rated or predictor.nw > 0
        self._hard_rates = _hard(track.rates, track.rate_softness.linear)
        self._move_of = np.repeat(np.arange(len(self._blocks)), self._blocks)
        self._memory = PlanMemory(track.inputs, self._N, track.rates, self._move_of)

        self._origin = Origin(predictor, estimator, self._latency)
        self._ahead = np.zeros((self._latency + 1, predictor.nw))
        self._estimated = estimator is not None
        rows, columns = self._map.matrix.shape
        self._known = np.zeros(columns)
        self._known[-1] = 1.0
        self._plan, self._spare = np.zeros(rows), np.zeros(rows)
        self._reference = np.zeros((self._N + 1, len(track.C)))
        self._reference_key: bytes | None = None
        self._see()
        self.reset()

    def _see(self) -> None:
        """Make the views of the arrays that a step fills; a copy of the controller makes its own."""
        predictor, nw = self.predictor, self._N * self.predictor.nw
        self._z = self._known[: predictor.nz]
        first = predictor.nz + self._nu * self._rated
        self._u_prev = self._known[predictor.nz : first]
        self._drive = self._known[first:-1]
        self._W, self._d = self._drive[:nw].reshape(self._N, predictor.nw), self._drive[nw:]
        rows = len(self._plan)
        self._met = bytearray(2 * rows)
        met = np.frombuffer(self._met, dtype=np.bool_)
        self._met_low, self._met_high = met[:rows], met[rows:]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._see()

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.predictor.dt

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._nu

    @property
    def horizon(self) -> int:
        """Steps of preview: N of the plan, after those of the latency."""
        return self._N + self._latency

    @property
    def observer(self) -> Observer:
        """The estimate now: its z, and its disturbance d."""
        return self._origin.observer

    @property
    def coordinates(self) -> str:
        """The coordinates of the QP: "riccati" or "plain"."""
        return self._map.maps.coordinates

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit.

        `u_prev`, zero moved inside the limits by default, is where rates count from, and is held if the first step
        fails. A disturbance that `disturb` set is forgotten too. A filter starts at x0, by default at zero.
        """
        self._memory.reset(u_prev)
        self._constrained.reset()
        self._planned = False
        self._drive[:] = 0.0
        self._origin.reset(x0, self._memory.last())

    def update(self, predictor: LinearPredictor) -> None:
        """Go on with new A, B, C and E: the plan, the warm start and the last input are kept.

        Raises
        ------
        DataError
            The predictor has another lifting, dt, other states, inputs or disturbances than the last one.
        """
        old = self.predictor
        for name in ("lifting", "dt", "states", "inputs", "disturbances"):
            if getattr(predictor, name) != getattr(old, name):
                raise DataError(
                    f"the predictor has another {name} than the controller's; make a new controller"
                )
        self._map = PlanMap(
            predictor,
            self.cost,
            self.limits,
            self._blocks,
            disturbed=self._disturbed,
            coordinates="plain" if self.coordinates == "plain" else "riccati",
        )
        self.predictor = predictor
        self._constrained.adopt(self._map.hard, self._map.soft)
        self._reference_key = None
        self._origin.adopt(predictor)

    def disturb(self, d: ArrayLike) -> None:
        """Set the disturbance d (nz,) of z⁺ = A z + B u + E w + d from the next step on.

        Raises
        ------
        DataError
            The controller was not made with ``disturbed=True``, or its estimator finds d.
        ShapeError
            d has another length than z.
        """
        if self._estimated:
            raise DataError("the estimator finds the disturbance; make the controller without one to set it")
        if not self._disturbed:
            raise DataError("the controller has no room for a disturbance; make it with disturbed=True")
        values = np.asarray(d, dtype=np.float64)
        if values.shape != self._d.shape:
            raise ShapeError(f"d has shape {values.shape}, expected {self._d.shape}, one value an observable")
        self.observer.d[:] = values

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
    ) -> Move:
        """Return the first input of the plan for measurement y.

        Parameters
        ----------
        y
            (nx,) measured state, or the (ny,) measurements of the estimator; there NaN is a missed one.
        reference
            (nr,) held over the horizon, or rows r_k … r_{k+N}, the last repeated; r_{k+N+latency} with latency.
        applied
            (nu,) what the plant really got last; by default the last u returned.
        w
            (nw,) measured disturbances, held over the horizon, or rows w_k … w_{k+N−1}, the last repeated,
            w_{k+N+latency−1} with latency; by default zero.
        """
        start = perf_counter()
        if self._signals or w is not None:
            self._take(applied, w)
        self._begin(np.asarray(y, dtype=np.float64), applied)
        target = np.asarray(reference, dtype=np.float64)
        key = target.tobytes()
        if key != self._reference_key:
            self._aim(target)
            self._reference_key = key

        t = self._spare
        np.dot(self._map.matrix, self._known, out=t)
        np.greater_equal(t, self._map.low, out=self._met_low)
        np.less_equal(t, self._map.high, out=self._met_high)
        if 0 not in self._met:  # every limit is met, and nothing is NaN
            return self._unconstrained(t, start)
        return self._limited(t, applied, start)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        if not self._planned:
            return None
        A, B, E, C = self.predictor.A, self.predictor.B, self.predictor.E, self.predictor.C
        moves = self._plan[: len(self._blocks) * self._nu].reshape(-1, self._nu)
        U = moves[self._move_of]
        push = self._W @ E.T
        if self._disturbed:
            push = push + self._d
        Z = np.empty((self._N + 1, self.predictor.nz))
        Z[0] = self._z
        for k in range(self._N):
            Z[k + 1] = A @ Z[k] + B @ U[k] + push[k]
        return Plan(Z @ C.T, U)

    def _begin(self, y: Float[np.ndarray, "..."], applied: ArrayLike | None) -> None:
        """Write down where the plan starts."""
        origin = self._origin
        origin.take(y, self._memory.last(), applied, self._ahead)
        self._z[:] = origin.z
        if self._disturbed:
            self._d[:] = origin.d

    def _aim(self, reference: Float[np.ndarray, "..."]) -> None:
        """Write the reference's part of the plan into the last column."""
        if reference.ndim == 2:
            reference = reference[min(self._latency, len(reference) - 1) :]
        self._reference = reference_rows(reference, self._N, self._reference.shape[1])
        self._map.aim(self._reference)

    def _take(self, applied: ArrayLike | None, w: ArrayLike | None) -> None:
        """Write down the last input and the preview of disturbances."""
        if self._rated:
            computed = applied is None or self._latency  # what acted before the plan's first input
            last = self._memory.last() if computed else np.asarray(applied, dtype=np.float64)
            if last.shape != self._u_prev.shape:
                raise ShapeError(f"applied has shape {last.shape}, expected {self._u_prev.shape}")
            self._u_prev[:] = last
        if w is None:
            self._W[:] = self._ahead[:] = 0.0
            return
        rows, nw = np.asarray(w, dtype=np.float64), self.predictor.nw
        if nw == 0:
            raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
        steps = self._N + self._latency
        if rows.shape != (nw,) and (rows.ndim != 2 or rows.shape[1] != nw or len(rows) == 0):
            raise ShapeError(
                f"w has shape {rows.shape}, expected ({nw},), or rows of {nw} for steps k … k+{steps - 1}"
            )
        if rows.ndim == 2 and len(rows) != steps:
            rows = rows[np.minimum(np.arange(steps), len(rows) - 1)]
        self._ahead[:] = rows if rows.ndim == 1 else rows[: self._latency + 1]
        self._W[:] = rows if rows.ndim == 1 else rows[self._latency :]

    def _unconstrained(self, t: Float[np.ndarray, " nt"], start: float) -> Move:
        self._constrained.cool()
        self._keep(t)
        taken = perf_counter() - start
        status = Status.UNCONSTRAINED if taken <= self._allowed else Status.TIME_LIMIT
        return Move(t[: self._nu].copy(), status, Fallback.NONE, taken, 0)

    def _keep(self, t: Float[np.ndarray, " nt"]) -> None:
        """Make t the plan; the array of the plan before it is free for the next step."""
        self._plan, self._spare = t, self._plan
        self._memory.keep(t)
        self._planned = True

    def _limited(self, t: Float[np.ndarray, " nt"], applied: ArrayLike | None, start: float) -> Move:
        """Go on where the plan breaks a limit, its target does, or something is not finite."""
        plan = self._map
        if self._rated and not (np.abs(self._u_prev) < HUGE).all():  # what was applied is not known
            self._u_prev[:] = self._memory.last()
            np.dot(plan.matrix, self._known, out=t)
        if not np.abs(t).max() < HUGE:
            return self._fail(None, applied, Status.BAD_MEASUREMENT, 0, start)
        n = plan.planned
        v = t[:n]
        if not ((t[n:] >= plan.low[n:]).all() and (t[n:] <= plan.high[n:]).all()):
            v += plan.correction(self._reference, self._drive)
        if (v >= plan.low[:n]).all() and (v <= plan.high[:n]).all():
            return self._unconstrained(t, start)
        nw, inputs = len(self._blocks) * self._nu, plan.track.inputs
        room = None
        if self._hard_rates is not None:
            room = Box(inputs.low - self._u_prev, inputs.high - self._u_prev)
        deadline = None if np.isinf(self._allowed) else start + self._allowed
        found = self._constrained.solve(v, room, nw, deadline)
        status = Status.FAILED if self.solver_fails else found.status
        if status is not Status.OPTIMAL:
            return self._fail(v[: self._nu], applied, status, found.iterations, start)
        v += plan.maps.deviation @ found.w
        u = np.clip(v[:nw].reshape(-1, self._nu), *inputs)
        if self._hard_rates is not None:
            u[0] = admitted(u[0], inputs, self._hard_rates, self._u_prev)
        v[:nw] = u.ravel()
        self._keep(t)
        taken = perf_counter() - start
        status = Status.SOFTENED if found.gave_way else Status.OPTIMAL
        status = status if taken <= self._allowed else Status.TIME_LIMIT
        return Move(u[0].copy(), status, Fallback.NONE, taken, found.iterations)

    def _fail(
        self,
        free: Float[np.ndarray, " nu"] | None,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
    ) -> Move:
        """Return what stands in for a failed step, with the status that says why."""
        self._constrained.cool()
        self._planned = False
        u, fallback = self._memory.instead(free, applied)
        return Move(u, status, fallback, perf_counter() - start, iterations)


def _hard(rates: Box | None, linear: Float[np.ndarray, " nu"]) -> Box | None:
    """Return the hard rate limits, ±inf where they are soft."""
    if rates is None or not np.isinf(linear).any():
        return None
    return Box(
        *(np.where(np.isinf(linear), end, free) for end, free in zip(rates, (-np.inf, np.inf), strict=True))
    )
