"""The data of a step of KoopmanMPC: its plan as a matrix, and the QP of the deviation from it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.control.limits import Interval
from koopmpc.control.program import LinearProgram
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.solvers.daqp import DAQPSetup
from koopmpc.control.stepped.sequences import LevelsProgram
from koopmpc.estimate.observer import EstimatorProgram
from koopmpc.values import Value


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
class CondensedProgram(LinearProgram):
    """t = M [z; u_{−1}; g] + m(r), g = [w_0 … w_{N−1}; d]: the plan, and the QP of the deviation w where a limit acts.

    The first entries of t are the moves; they become t + deviation w. m(r) = offset + from_reference [r_0; …; r_N]
    + from_given [u_r; …] + from_target [α_0 − ᾱ_0; …; α_N − ᾱ_N], ᾱ the coordinates of a target as if there were no
    limits. The last entries of t are the lowest and highest values of the limits `checked` of the targets. Where one
    is outside [low, high], g has moved a target outside its limits, and from_target moves the plan to the nearest one
    inside.

    Attributes
    ----------
    N, latency
        Steps of the plan, and steps until its first input acts.
    move_of
        (N,) the move that is the input of each step.
    with_rates
        Whether u_{−1} is part of what the plan starts from.
    hard_rates
        Hard limits of the changes of inputs, ±inf where one has none; None without.
    bounds
        How limits in time move the plan's; None where none do.
    levels
        The search for the best sequence of levels; None where no input is on levels.
    M, low, high
        The plan's matrix, and the limits of t.
    offset, from_reference, from_target, from_given
        The parts of m(r).
    aimed, unpushed
        Whether a target enters the plan; largest |r| of a preview for which no limit moves its targets.
    checked, disturbance
        The limits of the targets that g may break; (nz, ng) what g adds to z⁺ at the end of the horizon.
    qp, deviation
        ½ wᵀw → min within low ≤ A w + scale t[source] ≤ high, and how w moves the moves.
    solver
        The same QP as DAQP solves it.
    estimator
        How z and d follow from y.
    """

    N: int
    latency: int
    move_of: Int[np.ndarray, " N"]
    with_rates: bool
    hard_rates: Interval | None
    M: Float[np.ndarray, "nt known"]
    low: Float[np.ndarray, " nt"]
    high: Float[np.ndarray, " nt"]
    offset: Float[np.ndarray, " planned"]
    from_reference: Float[np.ndarray, "planned preview"]
    from_target: Float[np.ndarray, "planned target"]
    from_given: Float[np.ndarray, "planned inputs"]
    aimed: bool
    unpushed: float
    checked: Bool[np.ndarray, " checked"]
    disturbance: Float[np.ndarray, "nz ng"]
    qp: StepQP
    deviation: Float[np.ndarray, "moves nw"]
    solver: DAQPSetup
    estimator: EstimatorProgram
    bounds: BoundsProgram | None = None
    levels: LevelsProgram | None = None
