"""MPCBase: where a plan starts, blocks of moves, deadlines, the fallback of a failed step, the data for a file."""

import copy
from collections import deque
from collections.abc import Sequence
from time import perf_counter
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE, numbers
from koopmpc.control.cost import Tracking
from koopmpc.control.limits import Interval, clip_input
from koopmpc.control.move import Fallback, Move, Status, Token
from koopmpc.control.program import Published, SavedController
from koopmpc.control.stepped.blocks import Moves, find_move_blocks
from koopmpc.control.stepped.levels import HeldLevels
from koopmpc.control.watching import StepMonitor, StepWatch
from koopmpc.errors import DataError, ShapeError
from koopmpc.estimate.observer import (
    Estimator,
    Measured,
    StateModel,
    StateObserver,
    state_model,
)
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.values import LINE, Value, Viewing

_Restored = TypeVar("_Restored")  # a class of controller that is made again of its data


class InitialCondition(Viewing):
    """known = [z; u_{−1}; w_0 … w_{N−1}; d; 1] of the step at which an input computed now acts, L steps from now.

    z is predicted over these L steps, z ← F(z, u) + E w + d with the inputs that are still to act. u_{−1} is there
    where the change of inputs counts, d where it is estimated. The parts are views: `z`, `u_prev`, `W`, `d`, and
    `drive`, which is W and d. Where the observer forecasts a periodic disturbance, w_k is [w_k; p_k] in `known`, and
    `periodic` is a view of p.

    Parameters
    ----------
    model, observer
        The model predicts; the observer gives z and d of the step of y.
    N, latency
        Steps of the plan; L ≥ 0.
    with_rates, estimated
        Whether u_{−1} is needed, and whether the observer finds d.
    room
        Numbers that a plan keeps behind `known`, in the array `buffer` that holds both.
    """

    _VIEWS = ("known", "z", "u_prev", "drive", "W", "periodic", "d")

    def __init__(
        self,
        model: LinearPredictor | StateModel,
        observer: StateObserver,
        N: int,
        latency: int,
        *,
        with_rates: bool,
        estimated: bool,
        room: int = 0,
    ) -> None:
        self._model, self.observer, self._latency = state_model(model), observer, latency
        self._sizes = model.nz, model.nu, model.nw, N
        self._with_rates, self._estimated = with_rates, estimated
        more = estimated or latency or with_rates or model.nw or model.embedding is not None
        self._measured = None if more or not isinstance(observer, Measured) else observer  # set if z depends on y alone
        self._shape = (observer.ny,)
        self._np = model.nz if hasattr(observer, "forecast") else 0  # entries of a periodic disturbance
        drives = N * (model.nw + self._np)
        self._count = model.nz + model.nu * with_rates + drives + model.nz * estimated + 1
        self.buffer = np.zeros(self._count + room)
        self.buffer[self._count - 1] = 1.0
        self.refused = False  # whether the observer refused the last y
        self._ahead = np.zeros((latency + 1, model.nw))
        self._sent: deque[Float[np.ndarray, " nu"]] = deque(maxlen=latency + 1)
        self._see()

    def _see(self) -> None:
        """Make the views; see `Viewing`."""
        nz, nu, nw, N = self._sizes
        first = nz + nu * self._with_rates
        self.known = self.buffer[: self._count]
        self.z = self.known[:nz]
        self.u_prev = self.known[nz:first]
        self.drive = self.known[first:-1]
        whole = nw + self._np
        ahead = self.drive[: N * whole].reshape(N, whole)
        self.W, self.periodic, self.d = ahead[:, :nw], ahead[:, nw:], self.drive[N * whole :]

    def reset(self, x0: ArrayLike | None, last: Float[np.ndarray, " nu"]) -> None:
        """Start at x0, where it is known, with the input `last` acting until the first one arrives."""
        x0 = checks.start(x0, self._model.ny)
        self.refused = False
        if self._measured is None:  # else there is nothing that it remembers
            self.observer.reset(x0)
        self.drive[:] = 0.0
        self._sent.extend([last.copy()] * (self._latency + 1))
        self._w = np.zeros(self._sizes[2])

    def update(self, model: LinearPredictor | StateModel) -> None:
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
        measured, observer = numbers(y, "y"), self.observer
        got = None if applied is None else numbers(applied, "applied")
        if got is not None and got.shape != last.shape:
            raise ShapeError(f"applied has shape {got.shape}, expected {last.shape}")
        plain = self._measured
        if plain is not None and w is None and measured.shape == self._shape:
            if plain.lift is None:
                self.z[:] = measured
            else:
                plain.lift.arguments[0][:] = measured
                plain.lift.evaluate()
                self.z[:] = plain.lift.results[0]
            plain.z = self.z
            return
        if measured.shape != self._shape:
            what = "measurement of the estimator" if self._estimated else "state"
            raise ShapeError(f"y has shape {measured.shape}, expected {self._shape}, one value a {what}")
        if got is not None and not (np.abs(got) < HUGE).all():
            got = None
        if self._with_rates:  # what acts before the plan's first input
            self.u_prev[:] = last if got is None or self._latency else got
        if self.W.size or w is not None:
            self._preview(w)
        acted = last
        if self._latency:
            self._sent.append(last.copy())
            acted = self._sent[0]
        if got is not None:
            acted = got
        good = observer.observe(measured, acted, self._w)
        self.refused = getattr(observer, "refused", False)
        if self._ahead.size:  # a disturbance that is not finite keeps its last value
            self._w = np.where(np.abs(self._ahead[0]) < HUGE, self._ahead[0], self._w)
            held = getattr(observer, "stand_in_w", None)
            if held is not None:
                self._hold(held, w is None or np.ndim(w) == 1 or len(np.asarray(w)) == 1)
        z, d = observer.z if good else np.full_like(observer.z, np.nan), observer.d
        p = np.zeros((self._latency, 1))
        if self._np:
            forecast: np.ndarray = cast("Any", observer).forecast(self._latency + len(self.periodic))
            p, self.periodic[:] = forecast[: self._latency], forecast[self._latency :]
        for i in range(self._latency):
            z = self._model.advance(z, self._sent[i + 1], self._ahead[i], d + p[i])
        self.z[:] = z
        if self._estimated:
            self.d[:] = d

    def _hold(self, held: Float[np.ndarray, " nw"], constant: bool) -> None:
        """Plan with this w, the last one that was not wild; of a preview only its first row changes."""
        count = None if constant else 1
        self._ahead[:count] = held
        if constant or not self._latency:
            self.W[:count] = held

    def _preview(self, w: ArrayLike | None) -> None:
        """Store the preview of the measured disturbances."""
        if w is None:
            self.W[:] = self._ahead[:] = 0.0
            return
        rows, (_, _, nw, N) = numbers(w, "w"), self._sizes
        if nw == 0:
            raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
        steps = N + self._latency
        if rows.shape != (nw,) and (rows.ndim != 2 or rows.shape[1] != nw or len(rows) == 0):
            raise ShapeError(f"w has shape {rows.shape}, expected ({nw},), or rows of {nw} for steps k … k+{steps - 1}")
        if rows.ndim == 2 and len(rows) != steps:
            rows = rows[np.minimum(np.arange(steps), len(rows) - 1)]
        rows = np.where(np.abs(rows) < HUGE, rows, np.nan)  # products with inf, or of what is larger, would warn
        self._ahead[:] = rows if rows.ndim == 1 else rows[: self._latency + 1]
        self.W[:] = rows if rows.ndim == 1 else rows[self._latency :]


class MPCBase(Published):
    """A controller whose plan has N steps, of an input that acts `latency` steps after it was computed.

    A subclass calls `_keep` with every good plan, ends a step with `_move` or `_fail`, and returns in `_made_of` the
    data for `save`. A failed step returns the next input of the last good plan; if there is none the unconstrained
    input, clipped; if that is unknown the last input.

    One thread at a time may call it: a second one gets a ThreadError. Give each thread a copy of its own.

    Parameters
    ----------
    dt
        Sampling time [s].
    model
        The model of the plan.
    tracking
        The tracked and limited outputs, with their weights and limits.
    moves, horizon
        N steps, and which of them hold their inputs, see `find_blocks`.
    inputs
        Names of the inputs.
    observer, estimator
        The observer of this controller, and the rule that started it, None where y is the state.
    latency
        Steps until the first input of a plan acts.
    time_limit
        Wall-clock time of a step [s].
    stagewise
        True: a plan has an input for each step, with a change of 0 in held ones. False: one for each block.
    monitor
        Says of each step whether the model knows it; None without a monitor.
    """

    solver_fails = False  # fault injection sets it, see control.move.Fallible
    _initial: InitialCondition

    def __init__(
        self,
        dt: float,
        model: LinearPredictor | StateModel,
        tracking: Tracking[Any],
        moves: Moves,
        horizon: int,
        inputs: Sequence[str],
        observer: StateObserver,
        estimator: Estimator | None,
        latency: int,
        time_limit: float | None,
        *,
        stagewise: bool,
        monitor: StepMonitor | None = None,
    ) -> None:
        self.cost, self.limits = tracking.cost, tracking.limits
        self._inputs, self._rates, self._hard_rates = tracking.inputs, tracking.rates, tracking.hard_rates
        self.dt, self.nu = dt, len(self._inputs.low)
        self._moves = find_move_blocks(moves, horizon, inputs)
        self._blocks = blocks = self._moves.lengths
        self._N = N = sum(blocks)
        self._latency = checks.count(latency, "latency", 0)
        self.horizon = N + self._latency  # steps of preview
        self._move_of: Int[np.ndarray, " N"] = np.arange(N) if stagewise else np.repeat(np.arange(len(blocks)), blocks)
        self._with_rates = tracking.with_rates or (stagewise and (len(blocks) < N or self._moves.own))
        self._time_limit = time_limit
        self._allowed = np.inf if time_limit is None else checks.positive(time_limit, "time_limit", "s")
        self._estimator = estimator
        self._initial = InitialCondition(
            model,
            observer,
            N,
            self._latency,
            with_rates=self._with_rates,
            estimated=estimator is not None,
            room=0 if stagewise else (N + 1) * len(tracking.Q) + LINE,
        )
        levels = self.limits.base.input_levels(self.nu)
        self._held = None if levels is None else HeldLevels(levels)
        self._token: Token = [0]
        self._inside = 0
        self._watch = None if monitor is None else monitor.watch(model, self._latency)
        MPCBase.reset(self)

    @property
    def latency(self) -> int:
        """Steps until an input that is computed now acts."""
        return self._latency

    @property
    def watch(self) -> StepWatch | None:
        """The monitor's answer on the last step; None without a monitor."""
        return self._watch

    def __copy__(self) -> "MPCBase":
        """Return a copy that shares no state with this one."""
        return copy.deepcopy(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._token, self._inside = [0], 0  # another thread may hold the token of the original

    @property
    def observer(self) -> StateObserver:
        """The estimate now: its z, and its disturbance d."""
        return self._initial.observer

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit; a filter starts at x0 (nx,), by default at zero.

        Rates count from `u_prev`, zero moved inside the limits by default; it is held if the first step fails.

        Raises
        ------
        DataError
            x0 or u_prev is of another length, or holds what is no finite number; pass None where it is not known.
        """
        zero = np.clip(np.zeros(self.nu), *self._present_limits()[0])
        self._kept: Float[np.ndarray, " nv"] | None = None
        self._age, self._planned = 0, False
        self._given = zero if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))
        if self._held is not None:
            if u_prev is None:
                self._held.reset(zero)  # no dwell time of an earlier run counts
                self._given = self._held.round(zero)
            self._held.reset(self._given)
        self._initial.reset(x0, self._given)
        if self._watch is not None:
            self._watch.reset()

    def as_data(self) -> SavedController:
        """Return what the controller was made of.

        Raises
        ------
        DataError
            Its model is a StepMap, whose equations are code, or its estimator is no class of koopmpc.
        """
        kind, model, options = self._made_of()
        if isinstance(model, StepMap):
            raise DataError("the controller's model is a StepMap, which is code and cannot be saved; fit a predictor")
        if not isinstance(self._estimator, Value | None):
            raise DataError(
                f"{checks.article(self._estimator)} is not an estimator of koopmpc and cannot be saved as data"
            )
        return SavedController(
            kind,
            model,
            self.cost,
            self.limits,
            sum(self._blocks),
            self._estimator,
            self._latency,
            self._moves.given,
            self._time_limit,
            options,
            None if self._watch is None else self._watch.monitor,
        )

    def _made_of(self) -> tuple[str, LinearPredictor | BilinearPredictor | StepMap, dict[str, Any]]:
        """Return the class, the model, and the arguments that only this class has."""
        raise NotImplementedError

    @classmethod
    def from_data(cls: type[_Restored], saved: SavedController) -> _Restored:
        """Return the controller that is made of these data."""
        build: Any = cls
        return build(
            saved.model,
            saved.cost,
            saved.limits,
            saved.horizon,
            estimator=saved.estimator,
            latency=saved.latency,
            moves=saved.moves,
            time_limit=saved.time_limit,
            monitor=saved.monitor,
            **saved.options,
        )

    def _count_held(self, applied: ArrayLike | None) -> None:
        """Count the step for which the input that acted, or that was returned last, held its levels."""
        if self._held is not None:
            self._held.take(self._given if self._latency else self._find_last(applied))

    def _find_last(self, applied: ArrayLike | None) -> Float[np.ndarray, " nu"]:
        """Return the input that acted last, as far as `applied` is one; else the last one returned."""
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape == (self.nu,) and (np.abs(got) < HUGE).all():
                return got
        return self._given

    def _round(self, u: Float[np.ndarray, " nu"], before: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        """Return the input on the levels that limits, dwell times and rates allow."""
        if self._held is None:
            return u
        box, rates = self._present_limits()
        reach = None if rates is None else Interval(before + rates.low, before + rates.high)
        return self._held.round(u, reach, box)

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        """Return the box of the next input and that of its change; a subclass knows where they move in time."""
        return self._inputs, self._rates

    def _keep(self, plan: Float[np.ndarray, " nv"]) -> None:
        """Keep a good plan (by reference, for speed); its first entries are the moves."""
        self._kept, self._age, self._planned = plan, 0, True
        self._given = plan[: self.nu]

    def _judge_step(self, watch: StepWatch, move: Move, applied: ArrayLike | None, start: float) -> Move:
        """Return the move with `known` set: whether the model knows this step."""
        move.known = watch.look(self._initial, move.u, applied)
        move.solve_time = perf_counter() - start
        return move

    def _move(
        self,
        u: Float[np.ndarray, " nu"],
        status: Status,
        iterations: int,
        start: float,
        slack: float = 0.0,
        solver: str = "",
    ) -> Move:
        """Return a good step; a late one says so."""
        taken = perf_counter() - start
        status = status if taken <= self._allowed else Status.TIME_LIMIT
        return Move(u, status, Fallback.NONE, taken, iterations, slack, solver)

    def _settle(self) -> None:
        """Compute what the plan of the last step lacks; most controllers return whole plans."""

    def _fail(
        self,
        free: Float[np.ndarray, " nu"] | None,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
        solver: str = "",
    ) -> Move:
        """Return the move that replaces a failed step, with the status that says why; TIME_LIMIT where it is late.

        Parameters
        ----------
        free
            The unconstrained optimum, if it is known.
        applied
            The input that acted last, if it is not the last input returned.
        """
        self._settle()
        self._planned = False
        before = self._find_last(applied)
        late = self._held is not None and status is Status.TIME_LIMIT  # no plan was found: hold the levels
        if late:
            u, fallback = before, Fallback.HOLD
        elif self._kept is not None and self._age + 1 < self._N:
            self._age += 1
            first = self.nu * int(self._move_of[self._age])
            u, fallback = self._kept[first : first + self.nu], Fallback.SHIFTED_PLAN
        else:
            self._kept = None
            u, fallback = (before, Fallback.HOLD) if free is None else (free, Fallback.CLIPPED_LQR)
        self._given = self._round(clip_input(u, *self._present_limits(), before), before)
        taken = perf_counter() - start
        status = status if taken <= self._allowed else Status.TIME_LIMIT
        return Move(self._given.copy(), status, fallback, taken, iterations, solver=solver)
