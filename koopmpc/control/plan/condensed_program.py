"""CondensedProgram: a step of KoopmanMPC as data. A plan by one matrix, and the QP of the deviation from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.checks import HUGE
from koopmpc.base.values import Value
from koopmpc.control.ask.levels import HeldLevels, InputLevels
from koopmpc.control.ask.limits import Interval
from koopmpc.control.program import LinearProgram
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.ball import Ball
from koopmpc.control.solvers.base import SolverTurn, StepQP
from koopmpc.control.solvers.levels import LevelSearch, LevelSolver
from koopmpc.control.solvers.scaled_qp import DAQPSetup
from koopmpc.control.solvers.sequences import LevelsProgram
from koopmpc.estimate.observer import Estimator, EstimatorProgram, estimator_program, start_observer
from koopmpc.models.predictors import LinearPredictor


class StepBounds(NamedTuple):
    """low ≤ t ≤ high in one step, and the largest |r| of a preview for which no limit moves a target."""

    low: Float[np.ndarray, " nt"]
    high: Float[np.ndarray, " nt"]
    reach: float

    def accepts(self, t: Float[np.ndarray, " n"], ball: Ball | None, levels: LevelSearch | None) -> bool:
        """Return whether the first entries t of a plan are inside, those of a ball by their norm, and on all levels."""
        low, high = self.low[: len(t)], self.high[: len(t)]
        if is_inside(t, low, high):
            return levels is None or levels.accepts(t)
        if ball is None or not ball.contains(t):
            return False
        others = slice(0, ball.rows.start), slice(ball.rows.stop, None)
        return all(is_inside(t[part], low[part], high[part]) for part in others)


def is_inside(v: Float[np.ndarray, " n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]) -> bool:
    """Return whether low ≤ v ≤ high in all entries; NaN is not. A search in bytes is five times as fast as all()."""
    return 0 not in (v >= low).tobytes() and 0 not in (v <= high).tobytes()


def find_reach(
    size: Float[np.ndarray, " nl"], low: Float[np.ndarray, "T nl"], high: Float[np.ndarray, "T nl"]
) -> Float[np.ndarray, " T"]:
    """Return the largest a for which low ≤ K r ≤ high wherever no |r_i| is above a; below 0 where there is none.

    `size` has the sum of |K| over the entries of r.
    """
    room, moved = np.minimum(high, -low), size > 0
    reach = np.where(moved, room / np.where(moved, size, 1.0), np.where(room >= 0, HUGE, -1.0))
    return np.minimum(reach.min(axis=-1, initial=HUGE), HUGE)


@runtime_checkable
class PlanBounds(Protocol):
    """The limits of a plan in step after step."""

    def at(self, k: int) -> StepBounds:
        """Return the limits of step k."""
        ...

    def place(self, k: int) -> int:
        """Return the row that step k reads: steps with the same one have the same limits."""
        ...

    def first(self, k: int) -> tuple[Interval, Interval | None]:
        """Return the box of the input that acts first in step k, and that of its change."""
        ...

    def hard_rates(self, k: int) -> Interval | None:
        """Return the hard limits of the first change in step k, ±inf in place of the others; None without any."""
        ...

    def moves(self, k: int) -> Interval:
        """Return the limits of all moves of step k, one after the other."""
        ...

    def targets(self, k: int) -> Interval | None:
        """Return the limits (N+1, nl) of the targets of the preview of step k; None for those of `Targets`."""
        ...

    def open_rates(self, k: int, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval | None, float]:
        """Return the limits of a plan after u_prev, None where they do not move, and how far rates had to give way."""
        ...


@dataclass(frozen=True, eq=False)
class ConstantBounds(Value):
    """Limits that hold: each step has the same; see `PlanBounds`."""

    step: StepBounds
    inputs: Interval
    rates: Interval | None
    hard: Interval | None
    all_moves: Interval

    def at(self, k: int) -> StepBounds:
        """Return the limits of any step."""
        return self.step

    def place(self, k: int) -> int:
        """Return 0, the only row."""
        return 0

    def first(self, k: int) -> tuple[Interval, Interval | None]:
        """Return the box of the first input, and that of its change."""
        return self.inputs, self.rates

    def hard_rates(self, k: int) -> Interval | None:
        """Return the hard limits of the first change."""
        return self.hard

    def moves(self, k: int) -> Interval:
        """Return the limits of all moves."""
        return self.all_moves

    def targets(self, k: int) -> Interval | None:
        """Return None: targets have limits of their own."""
        return None

    def open_rates(self, k: int, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval | None, float]:
        """Return None, for limits do not move."""
        return None, 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundsProgram(Value):
    """How rows of limits in time become the limits of a plan.

    Attributes
    ----------
    first, count
        (moves, nu) the first step of what holds the value of a move, and for how many steps it does.
    start
        (moves,) the first step of each move.
    held, tied
        Which moves keep the value of the one before; which of them have no limits of their own, one after the other.
    margin
        (N, outputs) by how much each stage moves the limits of outputs inwards.
    values
        What the limits of targets count from.
    checked
        The limits of targets that a plan is tested by.
    hard, allowance
        Which rates are hard, and by how much one may give way before that is reported.
    outputs
        Which of the states and observables have a limit, or may get one.
    """

    first: Int[np.ndarray, "moves nu"]
    count: Int[np.ndarray, "moves nu"]
    start: Int[np.ndarray, " moves"]
    held: Bool[np.ndarray, "moves nu"]
    tied: Bool[np.ndarray, " all_moves"]
    margin: Float[np.ndarray, "N outputs"]
    values: Float[np.ndarray, " nl"]
    checked: Int[np.ndarray, " nc"]
    hard: Bool[np.ndarray, " nu"]
    allowance: Float[np.ndarray, " nu"]
    outputs: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CondensedPlan(Value):
    """t = M [z; u_{−1}; g] + m(r), g = [w_0 … w_{N−1}; d]: the plan, and the QP of the deviation w where a limit acts.

    The first entries of t are the moves; they become t + deviation w. m(r) = offset + from_reference [r_0; …; r_N]
    + from_given [u_r; …] + from_target [α_0 − ᾱ_0; …; α_N − ᾱ_N], ᾱ the coordinates of a target as if there were no
    limits. The last entries of t are the lowest and highest values of the limits `checked` of the targets. Where one
    is outside [low, high], g has moved a target outside its limits, and from_target moves the plan to the nearest one
    inside.

    Attributes
    ----------
    M, low, high
        The plan's matrix, and the limits of t.
    offset, from_reference, from_target, from_given
        The parts of m(r).
    from_held
        The part of one row that is held over the horizon.
    aimed, unpushed
        Whether a target enters the plan; largest |r| of a preview for which no limit moves its targets.
    checked, disturbance
        The limits of the targets that g may break; (nz, ng) what g adds to z⁺ at the end of the horizon.
    qp, deviation
        ½ wᵀH w → min within low ≤ A w + scale t[source] ≤ high, and how w moves the moves.
    coordinates
        The variables of the QP: "plain", the inputs, or "riccati", in which H is the identity.
    ball
        The entries of t that a terminal ellipsoid limits; None without one.
    """

    M: Float[np.ndarray, "nt known"]
    low: Float[np.ndarray, " nt"]
    high: Float[np.ndarray, " nt"]
    offset: Float[np.ndarray, " planned"]
    from_reference: Float[np.ndarray, "planned preview"]
    from_held: Float[np.ndarray, "planned nr"]
    from_target: Float[np.ndarray, "planned target"]
    from_given: Float[np.ndarray, "planned inputs"]
    aimed: bool
    unpushed: float
    checked: Bool[np.ndarray, " checked"]
    disturbance: Float[np.ndarray, "nz ng"]
    qp: StepQP
    deviation: Float[np.ndarray, "moves nw"]
    coordinates: str
    ball: Ball | None


@runtime_checkable
class PlanProvider(Protocol):
    """The plan of each step."""

    def at(self, k: int) -> CondensedPlan:
        """Return the plan whose first input acts in step k."""
        ...


@dataclass(frozen=True, eq=False)
class ConstantPlans(Value):
    """One plan for all steps; see `PlanProvider`."""

    plan: CondensedPlan

    def at(self, k: int) -> CondensedPlan:
        """Return the plan of any step."""
        return self.plan


@dataclass(frozen=True, eq=False, kw_only=True)
class CondensedProgram(CondensedPlan, LinearProgram):
    """All of a controller that plans by one matrix: the plan of its weights, and what each step needs besides.

    Attributes
    ----------
    N, latency
        Steps of the plan, and steps until its first input acts.
    blocks, move_of
        Lengths of the blocks of held inputs; (N,) the move that is the input of each step.
    with_rates
        Whether u_{−1} is part of what the plan starts from.
    hard_rates
        Hard limits of the changes of inputs, ±inf where one has none; None without.
    plans
        The plan of each step: this one, or those of weights in time.
    step_bounds
        The limits of each step.
    bounds
        How limits in time move the plan's; None where none do.
    input_levels, priority
        The levels of the inputs, and the priority of each entry of a plan; None without.
    rule
        Estimates z and d; None where y is the state and d zero.
    time_limit
        Wall-clock time of a step [s]; None without.
    solver_name, solver_settings
        The solver that is asked first, "auto" for that of the rule, and its own settings.
    """

    COMPUTED: ClassVar[tuple[str, ...]] = (*LinearProgram.COMPUTED, "solver", "estimator", "levels")
    IN_PYTHON: ClassVar[frozenset[str]] = frozenset(
        (
            *("blocks", "plans", "step_bounds", "input_levels", "priority", "rule", "time_limit", "solver_name"),
            *("solver_settings", "coordinates", "ball", "from_held"),
        )
    )

    N: int
    latency: int
    blocks: tuple[int, ...]
    move_of: Int[np.ndarray, " N"]
    with_rates: bool
    hard_rates: Interval | None
    plans: PlanProvider | None
    step_bounds: PlanBounds
    bounds: BoundsProgram | None = None
    input_levels: InputLevels | None = None
    priority: Int[np.ndarray, " nv"] | None = None
    rule: Estimator | None = None
    time_limit: float | None = None
    solver_name: str = FINISHER.name
    solver_settings: Mapping[str, Any]

    @cached_property
    def solver(self) -> DAQPSetup:
        """The QP as DAQP solves it."""
        return FINISHER(self.qp, self.solver_settings).setup

    @property
    def gain(self) -> Float[np.ndarray, "moves nz"]:
        """How z moves the planned inputs: with `sizes` it tells what single precision costs."""
        return self.M[: len(self.deviation), : self.model.nz]

    @cached_property
    def estimator(self) -> EstimatorProgram:
        """How z and d follow from y; DataError where that is code."""
        return estimator_program(start_observer(self.rule, self.model, self.N), self.rule)

    @cached_property
    def levels(self) -> LevelsProgram | None:
        """The search for the best sequence of levels; None unless all inputs are on levels in all steps."""
        if self.input_levels is None:
            return None
        search = LevelSearch(HeldLevels(self.input_levels), self.blocks, self.model.nu)
        return LevelSolver(self.qp, SolverTurn(FINISHER, self.solver_settings), search).describe()


def planned_states(
    predictor: LinearPredictor,
    move_of: Int[np.ndarray, " N"],
    *,
    with_rates: bool,
    disturbed: bool,
    periodic: bool = False,
) -> Float[np.ndarray, "N1nx nvk"]:
    """Return the matrix that takes [moves; z; u_{−1}; w_0 … w_{N−1}; d; 1] to C z_0 … C z_N, one below the other.

    z_{k+1} = A z_k + B u_k + E w_k + d; u_{−1} is there `with_rates`, d where it is estimated. Move move_of[k] is u_k.
    """
    A, B, E, C, N = predictor.A, predictor.B, predictor.E, predictor.C, len(move_of)
    if periodic:  # [w_k; p_k] in place of w_k
        E = np.hstack([E, np.eye(len(A))])
    nx, nz, nu, nw = len(C), len(A), B.shape[1], E.shape[1]
    from_z = np.empty((N + 1, nx, nz))  # C Aᵏ
    from_z[0] = C
    for k in range(N):
        from_z[k + 1] = from_z[k] @ A
    from_u, from_w = np.zeros((N + 1, nx, int(move_of[-1]) + 1, nu)), np.zeros((N + 1, nx, N, nw))
    through_B, through_E = from_z @ B, from_z @ E
    for j in range(N):  # what acts at step j moves all states after it
        from_u[j + 1 :, :, move_of[j]] += through_B[: N - j]
        from_w[j + 1 :, :, j] = through_E[: N - j]
    parts = [from_u, from_z, np.zeros((N + 1, nx, nu * with_rates)), from_w]
    if disturbed:
        parts.append(np.concatenate([np.zeros((1, nx, nz)), np.cumsum(from_z[:-1], axis=0)]))
    parts.append(np.zeros((N + 1, nx, 1)))
    return np.concatenate([part.reshape((N + 1) * nx, -1) for part in parts], axis=1)
