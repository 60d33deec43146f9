"""CondensedProgram: a step of KoopmanMPC as data. A plan by one matrix, and the QP of the deviation from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.values import Value
from koopmpc.control.limits import Interval
from koopmpc.control.plan.bounds import BoundsProgram, PlanBounds
from koopmpc.control.program import LinearProgram
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.ball import Ball
from koopmpc.control.solvers.base import SolverTurn, StepQP
from koopmpc.control.solvers.daqp import DAQPSetup
from koopmpc.control.stepped.levels import HeldLevels, InputLevels
from koopmpc.control.stepped.search import LevelSearch, LevelSolver
from koopmpc.control.stepped.sequences import LevelsProgram
from koopmpc.estimate.observer import Estimator, EstimatorProgram, estimator_program, start_observer


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

    @property
    def is_driven(self) -> bool:
        """Whether disturbances move the plan, and its targets."""
        return self.disturbance.shape[1] > 0


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
