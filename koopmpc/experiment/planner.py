"""Planner: draws candidates, simulates them on all members, and takes the safe ones of the largest gain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solve_discrete_are

from koopmpc.control.limits import Interval
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.experiment.candidates import CandidateBatch, ExperimentRoom, InputLimiter, draw_candidates
from koopmpc.experiment.ensemble import Ensemble
from koopmpc.experiment.plan import ExperimentPlan, describe_gain
from koopmpc.experiment.standing import draw_set_points, simulate_standing
from koopmpc.experiment.visits import Visits
from koopmpc.lifting.base import strip_unit
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.asked import DesignTask
from koopmpc.text import with_unit

_STABLE = 0.995  # a linearised model with a larger spectral radius is held by feedback during an experiment
_FINALISTS = 12  # so many candidates, those of the largest gain first, run on all members at a time


class UnsafePlanError(DataError):
    """No candidate is safe from a start; `worst` says which state would leave its limits where."""

    def __init__(self, worst: str) -> None:
        """Say what would help."""
        self.worst = worst
        super().__init__(
            f"no safe plan exists: {worst}; plan fewer steps, start further inside, widen the limits, or record logs "
            "that stay near a start first, so that the bands become narrow"
        )

    def __reduce__(self) -> tuple[type["UnsafePlanError"], tuple[str]]:
        return UnsafePlanError, (self.worst,)


@dataclass(frozen=True, eq=False)
class Hold:
    """The gain of a loop around the middle of the visits, and whether the plant needs it."""

    K: Float[np.ndarray, "nu n"]
    needed: bool


@dataclass(frozen=True, eq=False)
class SafeCandidate:
    """A candidate whose band is inside the limits: inputs, states, half-width of the band, and rows φ."""

    U: Float[np.ndarray, "T nu"]
    X: Float[np.ndarray, "T1 nx"]
    half: Float[np.ndarray, "T1 nx"]
    rows: Float[np.ndarray, "T q"]
    name: str
    set_points: Float[np.ndarray, "T1 nr"] | None


@dataclass(frozen=True, eq=False)
class Planner:
    """Chooses the episodes of a plan one by one.

    Attributes
    ----------
    asked, data
        The task, and the logs.
    ensemble, visits
        Models, and what the designed loop visits on them.
    reach
        Half-width of a band in spreads of the members.
    steps
        Steps of an episode.
    rng
        Draws candidates and residuals.
    free
        Whether a start without a safe plan may be passed over.
    """

    asked: DesignTask
    data: Episodes
    ensemble: Ensemble
    visits: Visits
    reach: float
    steps: int
    rng: np.random.Generator
    free: bool = False

    def plan(
        self,
        episodes: int,
        level: float,
        model: LinearPredictor | BilinearPredictor,
        standing: Any,
        notes: Sequence[str],
    ) -> ExperimentPlan:
        """Return the plan of so many episodes.

        Raises
        ------
        DataError
            No candidate is safe.
        """
        room = self._find_room()
        hold = self._find_hold(room)
        K = hold.K if hold.needed and standing is None else np.zeros_like(hold.K)
        information = self.visits.information
        chosen: list[SafeCandidate] = []
        starts = list(self.asked.starts)
        while len(chosen) < episodes:
            x0 = starts[len(chosen) % len(starts)]
            start = self.ensemble.start(x0, room.u)
            try:
                if standing is None:
                    best = self._choose_inputs(start, room, hold, K, information)
                else:
                    best = self._choose_set_points(start, standing, information)
            except UnsafePlanError:
                if not self.free or len(starts) == 1:
                    raise
                starts = [one for one in starts if one is not x0]
                continue
            information = information + best.rows.T @ best.rows
            chosen.append(best)
        X, half = np.array([one.X for one in chosen]), np.array([one.half for one in chosen])
        half[:, 0] = half[:, 1]  # the start is measured, too
        x_low, x_high = self.asked.limits.states(self.data.nx)
        points = [one.set_points for one in chosen if one.set_points is not None]
        moment = self.visits.weights @ self.visits.rows**2
        falls = moment * np.diag(np.linalg.inv(self.visits.information) - np.linalg.inv(information))
        return ExperimentPlan(
            U=np.array([one.U for one in chosen]),
            X=X,
            low=X - half,
            high=X + half,
            K=K,
            embedding=model.embedding,
            box=self._box,
            rates=self._rates,
            x_low=x_low,
            x_high=x_high,
            set_points=np.array(points) if points else None,
            controller=standing,
            dt=self.data.dt,
            states=self.data.states,
            inputs=self.data.inputs,
            level=level,
            before=self.visits.before,
            after=self.visits.variance(information),
            information=self.visits.spread_gain(np.concatenate([one.rows for one in chosen])),
            kinds=tuple(one.name for one in chosen),
            teaches=describe_gain(_name_terms(model), falls[: len(self.ensemble.size)]),
            notes=tuple(notes),
        )

    @cached_property
    def _box(self) -> Interval:
        """Limits of the inputs, and their range in the data where there are none."""
        U = np.concatenate([e.U for e in self.data])
        low, high = self.asked.limits.inputs(self.data.nu)
        return Interval(
            np.where(np.isfinite(low), low, U.min(axis=0)), np.where(np.isfinite(high), high, U.max(axis=0))
        )

    @cached_property
    def _rates(self) -> Interval:
        nu = self.data.nu
        rates = self.asked.limits.rates(nu)
        return Interval(np.full(nu, -np.inf), np.full(nu, np.inf)) if rates is None else rates

    def _find_room(self) -> ExperimentRoom:
        """Return the middle of the visits, and how far inputs and set points may move from it."""
        nx, box = self.data.nx, self._box
        x, u = self.visits.middle[:nx], np.clip(self.visits.middle[nx:], box.low, box.high)
        low, high = self.asked.limits.states(nx)
        reach = np.maximum(2 * self.visits.width[:nx], 0.25 * (self.asked.high - self.asked.low))
        return ExperimentRoom(x, u, box, Interval(np.maximum(low, x - reach), np.minimum(high, x + reach)))

    def _find_hold(self, room: ExperimentRoom) -> Hold:
        """Return an LQR around the middle of the visits, by differences of the model's step."""
        point = self.ensemble.start(room.x, room.u)
        n, nu, nx = len(point), len(room.u), len(room.x)
        sizes = 1e-4 * np.concatenate(
            [np.maximum(self._widths(point), 1e-9), np.maximum(room.inputs.high - room.inputs.low, 1e-9)]
        )
        both = np.concatenate([point, room.u]) + np.vstack([np.diag(sizes), -np.diag(sizes)])
        ends = self.ensemble.step(both[None, :, :n], both[None, :, n:])[0]
        J = ((ends[: n + nu] - ends[n + nu :]) / (2 * sizes[:, None])).T
        A, B = J[:, :n], J[:, n:]
        Q, R = np.zeros((n, n)), self.asked.cost.matrices(self._outputs(room.x[None]).shape[1], nu)[1]
        Q[:nx, :nx] = self.asked.weigh_states(room.x, self.data.states, nu)
        tiny = 1.0 / np.maximum(self._widths(point), 1e-9) ** 2
        Q += 1e-6 * np.trace(Q) * np.diag(tiny / tiny.sum())
        R = R + 1e-3 * np.trace(Q) * np.diag(1.0 / np.maximum(room.inputs.high - room.inputs.low, 1e-9) ** 2)
        modes = np.asarray(np.linalg.eigvals(np.nan_to_num(A)), dtype=np.complex128)
        needed = not np.isfinite(A).all() or bool((np.abs(modes) >= _STABLE).any())
        try:
            P = np.asarray(solve_discrete_are(A, B, Q, R), dtype=np.float64)
            return Hold(np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), dtype=np.float64), needed)
        except (np.linalg.LinAlgError, ValueError):  # not stabilisable on this model
            return Hold(np.zeros((nu, n)), needed)

    def _outputs(self, X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M nr"]:
        return self.asked.cost.of.bind(self.data.states)(X)

    def _widths(self, point: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        widths = self.asked.high - self.asked.low
        if self.ensemble.embedding is None:
            return widths
        return self.ensemble.embedding.spread(widths, np.maximum(self._box.high - self._box.low, 1e-9))

    def _choose_inputs(
        self,
        start: Float[np.ndarray, " n"],
        room: ExperimentRoom,
        hold: Hold,
        K: Float[np.ndarray, "nu n"],
        information: Float[np.ndarray, "q q"],
    ) -> SafeCandidate:
        """Return the safe plan of inputs with the largest gain."""
        X0, U0 = start[: self.data.nx], np.concatenate([e.U for e in self.data])
        near = replace(room, x=X0, u=np.clip(np.median(U0, axis=0), room.inputs.low, room.inputs.high))
        batch = draw_candidates([room, near], self.steps, self.rng)
        points, U = self._run_alone(batch, start, hold.K)
        inside = self._find_inside(points[..., : self.data.nx], 0.0)
        values = np.array(
            [
                self.visits.gain(self.visits.inform(points[:-1, i], U[:, i]), information) if inside[i] else -np.inf
                for i in range(len(inside))
            ]
        )
        order = [int(i) for i in np.argsort(-values, kind="stable") if inside[i]]
        worst = "every candidate leaves the limits on the model itself"
        for first in range(0, len(order), _FINALISTS):
            some = order[first : first + _FINALISTS]
            members = self._run_members(points[:, some], U[:, some], K)
            half = self.reach * self.ensemble.spread(members[..., : self.data.nx])
            safe = self._find_inside(points[:, some, : self.data.nx], half)
            if safe.any():
                place = int(np.argmax(safe))
                i = some[place]
                return SafeCandidate(
                    U[:, i],
                    points[:, i, : self.data.nx],
                    half[:, place],
                    self.visits.inform(points[:-1, i], U[:, i]),
                    batch.names[i],
                    None,
                )
            worst = self._explain(points[:, some, : self.data.nx], half)
        raise UnsafePlanError(worst)

    def _choose_set_points(
        self, start: Float[np.ndarray, " n"], standing: Any, information: Float[np.ndarray, "q q"]
    ) -> SafeCandidate:
        """Return the safe plan of set points with the largest gain."""
        library = draw_set_points(
            self.asked, start[: self.data.nx], self.data.states, self.steps, standing.horizon, self.rng
        )
        worst, best = "", None
        for name, rows in library:
            points, U = simulate_standing(self.ensemble, standing, start, rows, self.steps, self._box, self.rng)
            X = points[..., : self.data.nx]
            half = self.reach * self.ensemble.spread(X)
            if not self._find_inside(X[:, 0], half)[0]:
                worst = worst or self._explain(X[:, 0], half)
                continue
            features = self.visits.inform(points[:-1, 0, 0], U[:, 0, 0])
            value = self.visits.gain(features, information)
            if best is None or value > best[0]:
                one = SafeCandidate(U[:, 0, 0], X[:, 0, 0], half[:, 0], features, name, rows[: self.steps + 1])
                best = value, one
        if best is None:
            raise UnsafePlanError(worst)
        return best[1]

    def _run_alone(
        self, batch: CandidateBatch, start: Float[np.ndarray, " n"], K: Float[np.ndarray, "nu n"]
    ) -> tuple[Float[np.ndarray, "T1 loops n"], Float[np.ndarray, "T loops nu"]]:
        """Return points and inputs of all candidates on the model alone."""
        limit = InputLimiter(self._box, self._rates)
        rest = np.array([self._rest(row) for row in batch.target.reshape(-1, self.data.nx)])
        target = rest.reshape(*batch.target.shape[:2], -1)

        def law(k: int, point: Float[np.ndarray, "one loops n"]) -> Float[np.ndarray, "one loops nu"]:
            back = batch.on[:, None] * ((point[0] - target[k]) @ K.T)
            return limit(batch.base[k] - back)[None]

        points, U = self.ensemble.simulate(np.tile(start, (len(batch.names), 1)), law, self.steps)
        return points[:, 0], U[:, 0]

    def _rest(self, x: Float[np.ndarray, " nx"]) -> Float[np.ndarray, " n"]:
        return self.ensemble.start(x, self.visits.middle[self.data.nx :])

    def _run_members(
        self, points: Float[np.ndarray, "T1 loops n"], U: Float[np.ndarray, "T loops nu"], K: Float[np.ndarray, "nu n"]
    ) -> Float[np.ndarray, "T1 members loops n"]:
        """Return the points of all members under these plans, with residuals of the data."""
        limit = InputLimiter(self._box, self._rates)

        def law(k: int, point: Float[np.ndarray, "members loops n"]) -> Float[np.ndarray, "members loops nu"]:
            return limit(U[k] - (point - points[k]) @ K.T)

        found, _ = self.ensemble.simulate(points[0], law, self.steps, self.rng)
        found[:, 0] = points  # the plan itself, without residuals
        return found

    def _find_inside(
        self, X: Float[np.ndarray, "T1 loops nx"], half: Float[np.ndarray, "T1 loops nx"] | float
    ) -> Bool[np.ndarray, " loops"]:
        """Return which plans keep the limits of states and observables from step 1 on, with this margin."""
        low, high = self.asked.limits.states(self.data.nx)
        ok = np.asarray(((X - half)[1:] >= low).all(axis=(0, 2)) & ((X + half)[1:] <= high).all(axis=(0, 2)))
        room = 2.0 * np.maximum(self.asked.high - self.asked.low, 1e-12)  # no plan goes far beyond all data
        least, most = self.asked.low - room, self.asked.high + room
        ok &= np.asarray(((least <= X) & (most >= X)).all(axis=(0, 2)))
        of = self.asked.limits.of
        if of is not None:
            bound = of.bind(self.data.states)
            box = self.asked.limits.outputs(bound.nz)
            for i in np.flatnonzero(ok):
                corners = [X[1:, i]]
                if isinstance(half, np.ndarray):
                    corners += [X[1:, i] + sign * half[1:, i] * unit for sign in (-1, 1) for unit in np.eye(X.shape[2])]
                Y = bound(np.concatenate(corners))
                ok[i] = bool(((box.low <= Y) & (box.high >= Y)).all())
        return ok

    def _explain(self, X: Float[np.ndarray, "T1 loops nx"], half: Float[np.ndarray, "T1 loops nx"]) -> str:
        """Return which state would leave its limit first in the calmest of these plans."""
        low, high = self.asked.limits.states(self.data.nx)
        over = np.maximum(X + half - high, low - X + half)[1:]
        over = over / np.maximum(self.asked.high - self.asked.low, 1e-12)
        calm = int(np.argmin(over.max(axis=(0, 2))))
        k, i = divmod(int(np.argmax(over[:, calm])), over.shape[2])
        end = high[i] if X[k + 1, calm, i] + half[k + 1, calm, i] > high[i] else low[i]
        reach = with_unit(self.data.states[i], f"= {X[k + 1, calm, i]:.4g} ± {half[k + 1, calm, i]:.4g}")
        return f"in the calmest plan at step {k + 1} the band {reach} crosses the limit {end:.4g}"


def _name_terms(model: LinearPredictor | BilinearPredictor) -> tuple[str, ...]:
    """Return the names of the terms of φ, without units; u × 1 is u itself."""
    own = [strip_unit(name) for name in model.lifting.names]
    inputs = [strip_unit(name) for name in model.inputs]
    if isinstance(model, BilinearPredictor):
        return (*own, *inputs, *(u if z == "1" else f"{u} × {z}" for u in inputs for z in own))
    return (*own, *inputs, *map(strip_unit, model.disturbances))
