"""ControlTask: what a controller on a linear model is asked to do, with names and units resolved; its blocks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import null_space

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.horizon import Condensed, Coordinates
from koopmpc.control.plan.tracking import LiftedTracking, lifted_tracking
from koopmpc.control.solvers import order
from koopmpc.control.solvers.priorities import weigh_priorities
from koopmpc.estimate.observer import Estimator
from koopmpc.models.predictors import LinearPredictor

Blocking = int | Sequence[int]
Moves = Blocking | Mapping[str, Blocking] | None


class MoveBlocks(NamedTuple):
    """The blocks of a plan: an input may change at the first step of each, unless it is `held` there.

    Attributes
    ----------
    lengths
        Steps of each block; they sum to N.
    held
        (blocks, nu) whether an input keeps its value from the block before.
    given
        What makes the same blocks again: `lengths`, or the lengths of each input by its name.
    """

    lengths: tuple[int, ...]
    held: Bool[np.ndarray, "blocks nu"]
    given: tuple[int, ...] | Mapping[str, tuple[int, ...]]

    @property
    def own(self) -> bool:
        """Whether some input has blocks of its own."""
        return bool(self.held.any())

    def origins(self) -> Int[np.ndarray, "blocks nu"]:
        """Return the block that each input's value comes from, in each block."""
        index = np.where(self.held, 0, np.arange(len(self.held))[:, None])
        return np.maximum.accumulate(index, axis=0)


def find_blocks(moves: Blocking | None, horizon: int) -> tuple[int, ...]:
    """Return the lengths of the blocks of steps in which a plan of N steps holds its inputs: move blocking.

    They are N ones, or M moves of which the last is held, or `moves` itself.
    """
    N = checks.count(horizon, "horizon")
    if moves is None:
        return (1,) * N
    if isinstance(moves, Sequence):
        lengths = tuple(checks.count(b, "a block of moves") for b in moves)
        if sum(lengths) != N:
            raise DataError(f"the blocks of moves {lengths} sum to {sum(lengths)}, the horizon is {N}")
        return lengths
    if not isinstance(cast(object, moves), int | np.integer):
        raise DataError(
            f"moves is {moves!r}; pass how many moves there are, a tuple of the blocks' lengths, or one by the name of"
            ' each input, {"pump": (1, 1, 2, 4)}'
        )
    M = checks.count(moves, "moves")
    if M > N:
        raise DataError(f"moves is {M}, the horizon {N}; a horizon has at most a move a step")
    return (1,) * (M - 1) + (N - M + 1,)


def find_move_blocks(moves: Moves, horizon: int, inputs: Sequence[str]) -> MoveBlocks:
    """Return the blocks of a plan whose inputs have these names; an input that is left out may change at every step."""
    if not isinstance(moves, Mapping):
        lengths = find_blocks(moves, horizon)
        return MoveBlocks(lengths, np.zeros((len(lengths), len(inputs)), dtype=np.bool_), lengths)
    each = [find_blocks(given, horizon) for given in checks.order_entries(moves, "moves", inputs)]
    starts = [set(np.cumsum([0, *lengths[:-1]]).tolist()) for lengths in each]
    union = sorted(set[int]().union(*starts))
    held = np.array([[start not in own for own in starts] for start in union], dtype=np.bool_)
    lengths = tuple(int(b) for b in np.diff([*union, sum(each[0])]))
    return MoveBlocks(lengths, held, dict(zip(inputs, each, strict=True)) if held.any() else lengths)


def tie_moves(maps: Condensed, held: Bool[np.ndarray, "moves nu"]) -> Condensed:
    """Return the maps of a plan whose inputs keep their value from the move before where they are `held`.

    In Riccati coordinates a plan costs unit · ‖w‖² above the one without ties, v + D w. The ties are T (v + D w) = 0,
    so the cheapest plan that keeps them has w = −(T D)⁺ T v, and every other one adds a w of the null space of T D.
    The null space is turned so that its first column moves the first free input and all later ones, and so on; the
    entries of w that are left over move nothing.
    """
    moves, nu = held.shape
    n, none = moves * nu, np.zeros(maps.deviation.shape)
    tied, free = np.flatnonzero(held.ravel()), np.flatnonzero(~held.ravel())
    D = maps.deviation
    T = np.zeros((len(tied), n))
    T[np.arange(len(tied)), tied], T[np.arange(len(tied)), tied - nu] = 1.0, -1.0
    TD = T @ D[:n]
    back = -D @ np.linalg.pinv(TD)
    basis = null_space(TD)
    basis = basis @ np.linalg.qr((D[free] @ basis).T)[0]
    none[:, free] = D @ basis

    def tie(rows: Float[np.ndarray, "nv m"]) -> Float[np.ndarray, "nv m"]:
        return rows + back @ (T @ rows[:n])

    def exact(rows: Float[np.ndarray, "nv m"]) -> Float[np.ndarray, "nv m"]:
        """Return rows in which a tied input is that of the move before, to the bit."""
        for i in tied:
            rows[i] = rows[i - nu]
        return rows

    return replace(
        maps,
        from_state=exact(tie(maps.from_state)),
        from_reference=exact(tie(maps.from_reference)),
        from_target=exact(tie(maps.from_target)),
        from_given=exact(tie(maps.from_given)),
        from_drive=exact(tie(maps.from_drive)),
        offset=exact(tie(maps.offset[:, None]))[:, 0],
        deviation=exact(none),
    )


_LIKE = ("lifting", "dt", "states", "inputs", "disturbances")  # of a predictor that takes the place of another one


@dataclass(frozen=True, kw_only=True)
class ControlTask:
    """What is asked of a controller.

    Attributes
    ----------
    predictor, track
        The model, and what is tracked and limited.
    moves, latency
        The blocks of held inputs, and steps until an input acts.
    estimator, time_limit
        Those of the controller; `None` without.
    periodic
        Whether the estimator forecasts a periodic disturbance.
    solver, settings
        The solver that is asked first, by name, and its own settings.
    auto
        Whether the solver was left to the rule, so that a sparse one may be asked, too.
    coordinates
        Variables of the QP.
    by_weights
        Whether weights stand for priorities, as in C.
    """

    predictor: LinearPredictor
    track: LiftedTracking
    moves: MoveBlocks
    latency: int
    estimator: Estimator | None
    time_limit: float | None
    periodic: bool
    solver: str
    settings: Mapping[str, Any]
    auto: bool
    coordinates: Coordinates
    by_weights: bool = False

    @property
    def N(self) -> int:
        """Steps of the plan."""
        return sum(self.moves.lengths)

    def with_predictor(self, predictor: LinearPredictor) -> "ControlTask":
        """Return the task on another predictor of the same lifting."""
        checks.kind(predictor, "predictor", LinearPredictor, "it replaces another LinearPredictor")
        for name in _LIKE:
            if getattr(predictor, name) != getattr(self.predictor, name):
                raise DataError(f"the predictor has another {name} than the controller's; make a new controller")
        track = _track(predictor, self.track.cost, self.track.limits, by_weights=self.by_weights)
        return replace(self, predictor=predictor, track=track)

    def for_c(self, solver: str) -> "ControlTask":
        """Return the task as C solves it: by the finisher, in Riccati coordinates, with weights for priorities."""
        weighed = self.track.limits.priority is not None
        track = _track(self.predictor, self.track.cost, self.track.limits, by_weights=True) if weighed else self.track
        settings: Mapping[str, Any] = self.settings if self.solver == solver else {}
        return replace(
            self, track=track, solver=solver, settings=settings, auto=False, coordinates="riccati", by_weights=weighed
        )


def read_task(
    predictor: LinearPredictor,
    cost: Cost,
    limits: Limits | None,
    horizon: int,
    moves: Moves,
    latency: int,
    solver: str,
    settings: Mapping[str, Any],
) -> ControlTask:
    """Return the task of a controller without an estimator."""
    first = order.order_solvers(solver, settings)[0].solver
    return ControlTask(
        predictor=predictor,
        track=_track(predictor, cost, limits, by_weights=False),
        moves=find_move_blocks(moves, checks.count(horizon, "horizon"), predictor.inputs),
        latency=checks.count(latency, "latency", 0),
        estimator=None,
        time_limit=None,
        periodic=False,
        solver=first.name,
        settings=settings,
        auto=solver == "auto",
        coordinates=first.coordinates,
    )


def _track(predictor: LinearPredictor, cost: Cost, limits: Limits | None, *, by_weights: bool) -> LiftedTracking:
    """Return what is tracked and limited; beside levels, and in C, weights stand for priorities."""
    track = lifted_tracking(predictor, cost, limits, in_time=True)
    if track.limits.priority is None or not (by_weights or track.limits.levels is not None):
        return track
    who = "its C code" if by_weights else "a KoopmanMPC with levels"
    return replace(track, softness=weigh_priorities(track.softness, track.limits, predictor.states, who))
