"""Adaptive: a controller whose model goes on learning while it runs."""

from collections import deque
from dataclasses import replace
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE, numbers
from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.control.ask.limits import Limits
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.kinds.koopman_mpc import KoopmanMPC
from koopmpc.control.move import Move, Plan
from koopmpc.control.program import Program, Published, SavedController, no_export
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.models.fits.online import OnlineEDMD
from koopmpc.models.predictors import LinearPredictor
from koopmpc.validate.drift import DriftReport, exceeds_usual, find_drift

_PERSISTENT = 3  # samples in sequence that are off before they count as a change of the plant


class LearnedPair(NamedTuple):
    """One step as it was: x, what acted, and where it led."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    w: Float[np.ndarray, " nw"]
    x_next: Float[np.ndarray, " nx"]


class Adaptive(Published):
    """A KoopmanMPC that goes on learning its model z⁺ = A z + B u + E w while it runs.

    Each step is a pair (x, u, x⁺), from which `online` learns unless it is faulty: a number is NaN, the state stands
    still to the bit, the controller's monitor does not know state and input, or the sample is off by far more than
    those before it. Three such samples in sequence count as a change of the plant, and are learned from.

    The controller keeps a short memory of recent pairs. If the model in use predicts it worse than the first model
    predicted its own data, the fit of all pairs so far, with the forgetting or the window of `online`, is put on trial.
    The trial waits until the memory holds only pairs that came later. Then both models forecast from each pair, as far
    ahead as the memory and the horizon reach; the new one is used if its error is less than a third of the other's.
    Pairs that came later are needed because a fit always predicts its own pairs well. If an earlier model forecasts
    the memory clearly better than the one in use, the earlier one is used again.

    Parameters
    ----------
    controller
        The controller; learning begins with its model, which is also the first to go back to. Its y is the state.
    online
        The fit that learns, of the same lifting. Start it with the data of the controller's model:
        ``OnlineEDMD.start(data, lifting, forgetting=0.98)``.
    every
        Steps between two looks at the memory.
    memory
        Recent pairs on which models are compared; by default the controller's horizon, at least 20.
    outlier
        A sample is off where its misfit is this many times the usual one.

    Attributes
    ----------
    learned, skipped
        Number of pairs that were learned from, and that were not.
    alarms
        How often the model in use began to fail the test of `find_drift` for the size of residuals: its errors in the
        memory exceed those on its own data by half, and by more than chance explains.
    renewed, returned, refused
        How often a new model came into use, an earlier one came back, and a new one was no better.

    Raises
    ------
    DataError
        The controller's model has an embedding, or another lifting, dt or names than what `online` learns; its
        estimator does not measure all states.
    """

    def __init__(
        self,
        controller: KoopmanMPC,
        online: OnlineEDMD,
        *,
        every: int = 5,
        memory: int | None = None,
        outlier: float = 8.0,
    ) -> None:
        checks.kind(controller, "controller", KoopmanMPC, "only its model can be learned by OnlineEDMD")
        checks.kind(online, "online", OnlineEDMD, "start one: km.OnlineEDMD.start(data, lifting, forgetting=0.98)")
        model = controller.predictor
        if model.embedding is not None:
            raise DataError("the controller's model has an embedding, and OnlineEDMD takes none; fit one without")
        observer = controller.observer
        if observer.ny != model.nx:
            raise DataError(
                f"the controller's estimator takes {observer.ny} measurements, and Adaptive learns from all {model.nx} "
                "states; pass a controller that measures the states"
            )
        online.check(model)
        self.controller, self.online = controller, online
        self.dt, self.nu, self.horizon = controller.dt, controller.nu, controller.horizon
        self._every, self._outlier = checks.count(every, "every"), checks.positive(outlier, "outlier")
        self._first = model
        self._usual = None if model.report is None else model.report.residual
        # pairs that the memory holds by default, where the horizon is shorter
        held = max(self.horizon, 20) if memory is None else checks.count(memory, "memory")
        self._memory: deque[LearnedPair] = deque(maxlen=held)
        # learned pairs that are compared with the data of a design
        self._recent: deque[LearnedPair] = deque(maxlen=500)
        self._clear()

    def as_data(self) -> SavedController:
        """Raise DataError: what `online` has learned so far is not data that can be saved."""
        raise DataError(
            "an Adaptive controller goes on learning, and its fit cannot be saved as data; save the controller inside "
            "it, and start an OnlineEDMD again where that is loaded"
        )

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(self, "its model changes while it runs", "the controller inside it")

    def _clear(self) -> None:
        self._memory.clear()
        self._recent.clear()
        self._changed_at = 0  # pairs learned before those that led to the model in use
        self._alarm: int | None = None  # pairs learned before those that the model in use does not suffice for
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray, bool] | None = None
        self._misfits: deque[float] = deque(maxlen=self._memory.maxlen)
        self._off = self._steps = 0
        self.learned = self.skipped = self.alarms = self.renewed = self.returned = self.refused = 0
        self._good: deque[LinearPredictor] = deque(maxlen=5)  # earlier models that can be gone back to
        self._on_trial: tuple[LinearPredictor, int] | None = None  # a new model, and the pairs learned before it

    @property
    def predictor(self) -> LinearPredictor:
        """The model in use."""
        return self.controller.predictor

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Begin a run with the first model of the controller; `online` keeps what it has learned."""
        if self.controller.predictor is not self._first:
            self.controller.update(self._first)
        self._clear()
        self.controller.reset(x0, u_prev)

    def find_drift(self, data: Episodes) -> DriftReport:
        """Name what has changed since the data of the design, as `km.validate.find_drift` does.

        New logs are the last 500 pairs that were learned from, from the first that the model in use does not predict
        as well as its own data. Where it suffices, they begin with the pairs that led to it, or with the run.

        Parameters
        ----------
        data
            The data of the first model.

        Raises
        ------
        DataError
            Nothing was learned in this run yet, or the data have other signals.
        """
        before = self._changed_at if self._alarm is None else self._alarm
        new = list(self._recent)[max(len(self._recent) - (self.learned - before), 0) :]
        if not new:
            raise DataError("nothing was learned in this run yet; call the controller first")
        ends = [i + 1 for i, (one, then) in enumerate(pairwise(new)) if one.x_next is not then.x]
        episodes: list[Episode] = []
        for first, end in pairwise([0, *ends, len(new)]):
            part = new[first:end]
            X, U = [*(pair.x for pair in part), part[-1].x_next], [pair.u for pair in part]
            episodes.append(Episode(X=np.array(X), U=np.array(U)))
        return find_drift(data, Episodes(episodes, self.dt, data.states, data.inputs))

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        return self.controller.plan()

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Learn from the step that led to y, and return the controller's move; arguments as for KoopmanMPC."""
        start = perf_counter()
        x = numbers(y, "y").copy()
        if self._before is not None:
            self._take(x, applied)
        self._steps += 1
        if self._steps % self._every == 0 and len(self._memory) >= min(self._every, cast("int", self._memory.maxlen)):
            self._renew()
        move = self.controller(x, reference, applied, w)
        watch = self.controller.watch
        now = np.zeros(self.predictor.nw) if w is None else np.atleast_2d(numbers(w, "w"))[0].copy()
        self._before = x, move.u.copy(), now, watch is None or watch.inside
        return replace(move, solve_time=perf_counter() - start)

    def _take(self, x: Float[np.ndarray, " nx"], applied: ArrayLike | None) -> None:
        """Learn from the step before, which led to x, unless it is faulty."""
        assert self._before is not None
        old, u, w, inside = self._before
        pair = LearnedPair(old, u if applied is None else numbers(applied, "applied").copy(), w, x)
        together = np.concatenate(pair)
        if not (inside and (np.abs(together) < HUGE).all()) or np.array_equal(old, x):
            self.skipped += 1
            return
        misfit = float(np.linalg.norm(self._errors(self.predictor, [pair])[0]))
        usual = float(np.median(self._misfits)) if len(self._misfits) >= _PERSISTENT else np.inf
        self._off = self._off + 1 if misfit > self._outlier * usual else 0
        if 0 < self._off < _PERSISTENT:
            self.skipped += 1
            return
        self._misfits.append(misfit)
        self._memory.append(pair)
        self._recent.append(pair)
        self.online.learn(pair.x, pair.u, pair.x_next, pair.w if len(w) else None)
        self.learned += 1

    def _errors(self, model: LinearPredictor, pairs: list[LearnedPair], steps: int = 1) -> Float[np.ndarray, "m nx"]:
        """Return the errors of forecasts 1 … `steps` ahead from each pair on, as far as pairs follow one another.

        Each state is in the size of its changes from step to step over the memory.
        """
        U, W = np.array([pair.u for pair in pairs]), np.array([pair.w for pair in pairs])
        after = np.array([pair.x_next for pair in pairs])
        goes_on = np.array([one.x_next is then.x for one, then in pairwise(pairs)] + [False])
        Z, at, size = np.array([model.lift(pair.x) for pair in pairs]), np.arange(len(pairs)), self._size
        errors: list[Float[np.ndarray, "m nx"]] = []
        for _ in range(steps):
            Z = Z @ model.A.T + U[at] @ model.B.T + W[at] @ model.E.T
            errors.append((after[at] - Z @ model.C.T) / size)
            Z, at = Z[goes_on[at]], at[goes_on[at]] + 1
            if not len(at):
                break
        return np.concatenate(errors)

    @property
    def _size(self) -> Float[np.ndarray, " nx"]:
        """Root mean square of each state's change from step to step in the memory; 1 where it does not move."""
        if not self._memory:
            return np.ones(self.predictor.nx)
        changes = np.array([pair.x_next - pair.x for pair in self._memory])
        size = np.sqrt((changes**2).mean(axis=0))
        return np.where(size > 0, size, 1.0)

    def _renew(self) -> None:
        """Put a new model on trial where the one in use does not suffice, end a trial, or go back to an earlier one."""
        pairs, used = list(self._memory), self.predictor
        if self._suffices(used, pairs):
            self._on_trial = self._alarm = None
            return
        if self._alarm is None:
            self._alarm = self.learned - len(pairs)
            self.alarms += 1
        if self._on_trial is None:
            try:
                self._on_trial = self.online.predictor(), self.learned
            except KoopmpcError:  # too little was learned for a fit
                return
        error = self._error(used, pairs)
        candidate, before = self._on_trial
        if self.learned - before >= cast("int", self._memory.maxlen):
            self._on_trial = None
            # of the error of the model in use that a new one may have on pairs that neither has seen
            if self._error(candidate, pairs) < (1 / 3) * error and self._use(candidate):
                self._good.append(used)
                self.renewed += 1
                return
            self.refused += 1
        earlier = [self._first, *self._good]
        errors = [self._error(model, pairs) for model in earlier]
        best = int(np.argmin(errors))
        # times the error of an earlier model from which on the model in use is given up for it
        if earlier[best] is not used and error > 1.25 * errors[best] and self._use(earlier[best]):
            self.returned += 1

    def _suffices(self, model: LinearPredictor, pairs: list[LearnedPair]) -> bool:
        """Return whether the model predicts these pairs as well as the first model did its own data."""
        usual = self._usual
        if usual is None:
            return False
        with np.errstate(over="ignore", invalid="ignore"):
            return not exceeds_usual(self._errors(model, pairs) * self._size, usual)

    def _error(self, model: LinearPredictor, pairs: list[LearnedPair]) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            found = float(np.sqrt((self._errors(model, pairs, self.horizon) ** 2).mean()))
        return found if np.isfinite(found) else np.inf

    def _use(self, model: LinearPredictor) -> bool:
        """Go on with this model; return False where no controller can be made of it."""
        used = self.predictor
        try:
            self.controller.update(model)
        except KoopmpcError:
            self.controller.update(used)
            return False
        assert self._alarm is not None, "only called where the model in use does not suffice"
        self._changed_at = self._alarm
        return True


def _build_learning(parts: Any, limits: Limits) -> Adaptive:
    problem = parts.problem
    mpc = KoopmanMPC(parts.model, problem.cost, limits, problem.horizon, monitor=parts.monitor_data)
    # in the bench a pair of 35 steps ago counts by half
    return Adaptive(mpc, OnlineEDMD.start(parts.data, problem.lifting, forgetting=0.98, ridge=problem.ridge))


register_controller(
    ControllerKind(
        Adaptive,
        bench=(
            BenchEntry(
                "adaptive",
                "koopman-mpc whose model goes on learning from every step of the run.",
                "linear",
                _build_learning,
                on_request=True,  # for plants that drift
            ),
        ),
    )
)
