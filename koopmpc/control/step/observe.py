"""What a step reads: where the plan starts, from y and w; what the rows of a reference, and given inputs, add to it."""

from collections import deque
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg.blas import idamax

from koopmpc.base import checks
from koopmpc.base.checks import HUGE, numbers
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Interval
from koopmpc.control.plan.condensed_program import CondensedPlan, PlanBounds, StepBounds, is_inside
from koopmpc.control.target import Targets
from koopmpc.estimate.observer import Measured, StateObserver, state_model


class InitialCondition:
    """known = [z; u_{−1}; w_0 … w_{N−1}; d] of the step at which an input computed now acts, L steps from now.

    z is predicted over these L steps, z ← F(z, u) + E w + d with the inputs that are still to act. u_{−1} is there
    where the change of inputs counts, d where it is estimated. Where the observer forecasts a periodic disturbance,
    w_k is [w_k; p_k] in `known`.

    Parameters
    ----------
    model, observer
        The model, a predictor or a `StateModel`, predicts; the observer gives z and d of the step of y.
    N, latency
        Steps of the plan; L ≥ 0.
    with_rates, estimated
        Whether u_{−1} is needed, and whether the observer finds d.
    """

    def __init__(
        self, model: Any, observer: StateObserver, N: int, latency: int, *, with_rates: bool, estimated: bool
    ) -> None:
        model = state_model(model)
        self._model, self.observer, self._latency, self._N = model, observer, latency, N
        self._nz, self._nw, self._estimated = model.nz, model.nw, estimated
        more = estimated or latency or with_rates or model.nw or model.embedding is not None
        self._measured = None if more or not isinstance(observer, Measured) else observer  # set if z depends on y alone
        self._shape = (observer.ny,)
        self._np = model.nz if hasattr(observer, "forecast") else 0  # entries of a periodic disturbance
        self._first = model.nz + model.nu * with_rates  # where the disturbances begin
        self._d = self._first + N * (model.nw + self._np)  # where d begins
        self.known = np.zeros(self._d + model.nz * estimated)
        self.refused = False  # whether the observer refused the last y
        self._ahead = np.zeros((latency + 1, model.nw))
        self._sent: deque[Float[np.ndarray, " nu"]] = deque(maxlen=latency + 1)

    @property
    def z(self) -> Float[np.ndarray, " nz"]:
        """The state at which the plan starts."""
        return self.known[: self._nz]

    @property
    def u_prev(self) -> Float[np.ndarray, " nu"]:
        """The input before the plan's first one; empty where it does not count."""
        return self.known[self._nz : self._first]

    @property
    def drive(self) -> Float[np.ndarray, " ng"]:
        """All disturbances of the plan, one after the other."""
        return self.known[self._first :]

    @property
    def d(self) -> Float[np.ndarray, " nd"]:
        """The estimated disturbance; empty where none is."""
        return self.known[self._d :]

    @property
    def W(self) -> Float[np.ndarray, "N nw"]:
        """The measured disturbances w_0 … w_{N−1}."""
        return self._pushes[:, : self._nw]

    @property
    def periodic(self) -> Float[np.ndarray, "N np"]:
        """The forecast of a periodic disturbance; without columns where there is none."""
        return self._pushes[:, self._nw :]

    @property
    def _pushes(self) -> Float[np.ndarray, "N nw_np"]:
        return self.known[self._first : self._d].reshape(self._N, -1)

    def reset(self, x0: ArrayLike | None, last: Float[np.ndarray, " nu"]) -> None:
        """Start at x0, where it is known, with the input `last` acting until the first one arrives."""
        x0 = checks.start(x0, self._model.ny)
        self.refused = False
        if self._measured is None:  # else there is nothing that it remembers
            self.observer.reset(x0)
        self.known[self._first :] = 0.0
        self._sent.extend([last.copy()] * (self._latency + 1))
        self._w = np.zeros(self._nw)

    def update(self, model: Any) -> None:
        """Go on with another model of the same sizes."""
        self._model = state_model(model)
        self.observer.update(model)

    def take(
        self, y: ArrayLike, last: Float[np.ndarray, " nu"], applied: ArrayLike | None, w: ArrayLike | None
    ) -> None:
        """Take y_k and store where the plan starts; z is NaN where y cannot be used.

        Parameters
        ----------
        last
            The input that was computed last.
        applied
            The input that acted since the last call; if it is missing or not finite, the input that was computed L + 1
            calls ago.
        w
            (nw,), or rows w_k … w_{k+L+N−1}, the last repeated; zero by default.
        """
        measured, got = numbers(y, "y"), None if applied is None else numbers(applied, "applied")
        if got is not None and got.shape != last.shape:
            raise ShapeError(f"applied has shape {got.shape}, expected {last.shape}")
        if measured.shape != self._shape:
            what = "measurement of the estimator" if self._estimated else "state"
            raise ShapeError(f"y has shape {measured.shape}, expected {self._shape}, one value a {what}")
        if self._measured is not None and w is None:
            self._lift(self._measured, measured)
            return
        if self._nw or w is not None:  # before the input is stored: a w that is refused changes nothing
            self._preview(w)
        acted = self._find_acting(last, got if got is not None and (np.abs(got) < HUGE).all() else None)
        good = self.observer.observe(measured, acted, self._w)
        self.refused = getattr(self.observer, "refused", False)
        if self._nw:  # a disturbance that is not finite keeps its last value
            self._w = np.where(np.abs(self._ahead[0]) < HUGE, self._ahead[0], self._w)
            stand_in = getattr(self.observer, "stand_in_w", None)
            if stand_in is not None:
                self._hold(stand_in, w is None or np.ndim(w) == 1 or len(np.asarray(w)) == 1)
        self._predict(good)

    def _lift(self, plain: Measured, y: Float[np.ndarray, " ny"]) -> None:
        """Store z of y, where nothing else counts."""
        lift = plain.lift
        if lift is None:
            self.known[:] = y
        else:
            lift.arguments[0][:] = y
            lift.evaluate()
            self.known[:] = lift.results[0]
        plain.z = self.known

    def _find_acting(
        self, last: Float[np.ndarray, " nu"], got: Float[np.ndarray, " nu"] | None
    ) -> Float[np.ndarray, " nu"]:
        """Return the input that acted since the last call; store the one that acts before the plan's first."""
        if self._first > self._nz:
            self.u_prev[:] = last if got is None or self._latency else got
        if not self._latency:
            return last if got is None else got
        self._sent.append(last.copy())
        return self._sent[0] if got is None else got

    def _predict(self, good: bool) -> None:
        """Store z at the plan's start, and d; z is NaN where the observer has no good one."""
        observer, p = self.observer, np.zeros((self._latency, 1))
        z, d = observer.z if good else np.full_like(observer.z, np.nan), observer.d
        if self._np:
            forecast: np.ndarray = cast("Any", observer).forecast(self._latency + self._N)
            p, self.periodic[:] = forecast[: self._latency], forecast[self._latency :]
        for i in range(self._latency):
            z = self._model.advance(z, self._sent[i + 1], self._ahead[i], d + p[i])
        self.z[:] = z
        if self._estimated:
            self.d[:] = d

    def _hold(self, w: Float[np.ndarray, " nw"], constant: bool) -> None:
        """Plan with this w, the last one that was not wild; of a preview only its first row changes."""
        count = None if constant else 1
        self._ahead[:count] = w
        if constant or not self._latency:
            self.W[:count] = w

    def _preview(self, w: ArrayLike | None) -> None:
        """Store the preview of the measured disturbances."""
        if w is None:
            self.W[:] = self._ahead[:] = 0.0
            return
        rows, nw = numbers(w, "w"), self._nw
        if nw == 0:
            raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
        steps = self._N + self._latency
        if rows.shape != (nw,) and (rows.ndim != 2 or rows.shape[1] != nw or len(rows) == 0):
            raise ShapeError(f"w has shape {rows.shape}, expected ({nw},), or rows of {nw} for steps k … k+{steps - 1}")
        if rows.ndim == 2 and len(rows) != steps:
            rows = rows[np.minimum(np.arange(steps), len(rows) - 1)]
        rows = np.where(np.abs(rows) < HUGE, rows, np.nan)  # products with inf, or of what is larger, would warn
        self._ahead[:] = rows if rows.ndim == 1 else rows[: self._latency + 1]
        self.W[:] = rows if rows.ndim == 1 else rows[self._latency :]


class ReferenceShare:
    """m(r) of a plan t = M known + m(r) for rows r_k … r_{k+N} of a reference; see `CondensedPlan`.

    It is kept while reference, plan and limits stay.

    Parameters
    ----------
    targets
        The equilibria that rows aim at.
    N, nr, latency
        Steps of a plan, entries of a row, and the row that belongs to the plan's start.

    Attributes
    ----------
    rows, peak
        The rows of the last call, one where it is held; the largest |r|, −inf where it is beyond 1e30.
    """

    def __init__(self, targets: Targets, N: int, nr: int, latency: int) -> None:
        self._targets, self._N, self._nr, self._latency = targets, N, nr, latency
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._key: bytes | None = None
        self._plan: CondensedPlan | None = None
        self._pushed_at: tuple[PlanBounds, int] | None = None

    def take(self, reference: ArrayLike) -> bool:
        """Take the rows of a reference; return whether they are other ones than those of the last call."""
        given = numbers(reference, "reference")
        key = given.tobytes()
        if key == self._key:
            return False
        self._key = None  # one that is refused leaves no rows of the last one
        if given.shape == (self._nr,):
            self.rows = np.frombuffer(key).reshape(1, -1)
        elif self._latency or given.shape != (self._N + 1, self._nr):
            self.rows = checks.reference_rows(given, self._N, self._nr, self._latency)
        else:
            self.rows = np.frombuffer(key).reshape(given.shape)
        flat = self.rows.reshape(-1)
        peak = abs(flat.item(idamax(flat)))  # idamax passes over NaN, which gives a plan of NaN: it meets no limit
        self.peak = peak if peak < HUGE else -np.inf
        self._key, self._plan = key, None
        return True

    def at(self, plan: CondensedPlan, bounds: PlanBounds, k: int, reach: float) -> Float[np.ndarray, " nt"]:
        """Return m(r) under the limits of step k, which move no target for |r| ≤ reach."""
        if plan is not self._plan:
            self._share, self._plan, self._pushed_at = self._add_rows(plan), plan, None
        if self.peak <= reach:
            return self._share
        if self._pushed_at is None or self._pushed_at[0] is not bounds or self._pushed_at[1] != bounds.place(k):
            self._pushed, self._pushed_at = self._push(plan, bounds.targets(k)), (bounds, bounds.place(k))
        return self._pushed

    def _add_rows(self, plan: CondensedPlan) -> Float[np.ndarray, " nt"]:
        """Return m(r) as if no limit moved a target; NaN where a row is not finite."""
        rows = self.rows
        if self.peak < 0:
            return np.full(len(plan.M), np.nan)
        matrix = plan.from_held if len(rows) == 1 else plan.from_reference
        share = matrix.dot(rows.reshape(-1))
        share += plan.offset
        if len(share) == len(plan.M):
            return share
        values = (self._targets.nearest(rows) @ self._targets.rows.T)[:, plan.checked]
        return np.concatenate([share, values.min(axis=0), values.max(axis=0)])

    def _push(self, plan: CondensedPlan, box: Interval | None) -> Float[np.ndarray, " nt"]:
        """Return m(r) with targets moved inside their limits."""
        moved = self.find_push(None, box)
        return self._share if moved is None else self._share + plan.from_target.dot(moved)

    def find_push(self, e: Float[np.ndarray, " nz"] | None, box: Interval | None) -> Float[np.ndarray, " n"] | None:
        """Return by how much limits move the coordinates of all targets under a disturbance e; None by nothing."""
        rows = np.repeat(self.rows, self._N + 1, axis=0) if len(self.rows) == 1 else self.rows
        nearest = self._targets.nearest(rows, e)
        moved = self._targets.coordinates(rows, e, box)
        return None if np.array_equal(moved, nearest) else (moved - nearest).reshape(-1)


class GivenInputs:
    """What the rows of a given u_target, the last one held, add to a plan, F (u_k, …, u_{k+N}), in step after step."""

    def __init__(self, from_given: Float[np.ndarray, "nv Nnu"], rows: Float[np.ndarray, "T nu"]) -> None:
        self._N, self._last, self._from_given = from_given.shape[1] // rows.shape[1], len(rows) - 1, from_given
        self._rows = np.vstack([rows, np.tile(rows[-1], (self._N - 1, 1))])

    def at(self, k: int) -> Float[np.ndarray, " nv"]:
        """Return the share of the preview that begins with row k."""
        k = min(k, self._last)
        return self._from_given @ self._rows[k : k + self._N].reshape(-1)


class FirstInputPlan:
    """A plan whose first input alone was computed."""

    def __init__(
        self,
        plan: CondensedPlan,
        known: Float[np.ndarray, " known"],
        rows: Float[np.ndarray, "N1 nr"],
        given: Float[np.ndarray, " nv"] | None,
        u: Float[np.ndarray, " nu"],
    ) -> None:
        self._parts = plan, known, rows, given, u

    def compute(self) -> Float[np.ndarray, " nv"]:
        """Return the whole plan."""
        plan, known, rows, given, u = self._parts
        t = plan.M.dot(known) + plan.offset + plan.from_reference.dot(rows.reshape(-1))
        t += 0.0 if given is None else given
        t[: len(u)] = u
        return t


class FirstInput:
    """The first input of t = M known + f + F r for rows r of a preview, where all of t meets its limits.

    For the middle c of the rows, t = M known + f + F c + F (r − c). Entry i of the last part is at most
    Σ_j S_ij max|r_j − c_j|, S_ij the sum of |F| over the steps. Where the limits leave so much room, all of them are
    met. Then F is multiplied for the first input alone, and the plan is computed when it is asked for.

    Parameters
    ----------
    plan, nu
        The plan, and the number of inputs.
    """

    def __init__(self, plan: CondensedPlan, nu: int) -> None:
        self._plan, self._nu = plan, nu
        count, nr = plan.from_held.shape
        sizes = np.abs(plan.from_reference).reshape(count, -1, nr).sum(axis=1)
        # column by column, for a product with few columns takes half the time then; halves, for sums of two extremes
        self._M, self._half_held, self._half_sizes = (
            np.asfortranarray(part) for part in (plan.M, plan.from_held / 2, sizes / 2)
        )
        self._first = np.ascontiguousarray(plan.from_reference[:nu])

    def find(
        self,
        known: Float[np.ndarray, " known"],
        aim: ReferenceShare,
        limits: StepBounds,
        given: Float[np.ndarray, " nv"] | None,
    ) -> tuple[Float[np.ndarray, " nu"], FirstInputPlan] | None:
        """Return the first input and the plan to be; None where the bound fails, or a target may have to be moved."""
        rows, plan, nu = aim.rows, self._plan, self._nu
        if len(rows) == 1 or not 0 <= aim.peak <= limits.reach:
            return None
        signals = rows.T.copy()  # the extremes of rows of a few numbers take three times as long
        high, low = signals.max(axis=1), signals.min(axis=1)
        known = known.copy()
        middle = self._M.dot(known)
        middle += plan.offset
        if given is not None:
            middle += given
        u = middle[:nu] + self._first.dot(rows.reshape(-1))
        middle += self._half_held.dot(high + low)
        apart = self._half_sizes.dot(high - low)
        if not is_inside(middle, limits.low + apart, limits.high - apart):
            return None
        return u, FirstInputPlan(plan, known, rows, given, u)
