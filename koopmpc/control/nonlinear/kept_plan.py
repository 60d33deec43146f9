"""`PlanKeeper`: the accepted plan of a controller whose terminal set has a feedback; only a better one replaces it."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.terminal import TerminalSet, read_terminal_set, terminal_feedback
from koopmpc.control.nonlinear.stages import LearnedMap, StagedProblem, StageTargets
from koopmpc.control.nonlinear.stagewise import plan_cost

_BROKEN = 1.0  # a plan is accepted that breaks no hard limit by more than this many allowances
_MOVED = 1.01  # a kept plan may break one by this many: the model rounds otherwise from the measured state
_END = 1e-6  # share of its size by which an accepted plan may end outside the set
_COSTS_MORE = 1e-9  # share of its cost by which a plan has to be dearer than the kept one to be refused


class JudgedPlan(NamedTuple):
    """Inputs of a plan, its stages on the model, its cost, and by how much it breaks hard and soft limits.

    `excess` counts in units of what counts as broken, `slack` in those of the soft limit that gives way most.
    """

    U: Float[np.ndarray, "N nu"]
    S: Float[np.ndarray, "N1 ns"]
    V: Float[np.ndarray, "N nu"]
    cost: float
    excess: float
    slack: float


class PlanKeeper:
    """The inputs of the accepted plan, prolonged by the feedback κ of the terminal set, and what any plan costs.

    If x_N lies in the set, κ keeps the next state in it and inside the limits. So u_1, …, u_{N−1}, κ(x_N) is a plan of
    the next step that keeps all hard limits, where the plant is the model. Its cost is below that of the accepted plan
    by the stage cost or more, if the terminal cost V has V(F(x, κ(x))) ≤ V(x) − ℓ(x, κ(x)) in the set. A plan replaces
    it that keeps the limits on the model, too, and costs no more.

    Scokaert, Mayne & Rawlings, "Suboptimal model predictive control (feasibility implies stability)", IEEE Trans.
    Automat. Contr. 44, 1999.

    Parameters
    ----------
    problem, model
        The stages, and the map that they are made of.
    end
        The hard terminal set, which has a feedback.
    """

    _feedback: ca.Function
    _outputs: ca.Function
    _cost: ca.Function
    ahead: Float[np.ndarray, "n nu"] | None  # inputs of the accepted plan from the next step on

    def __init__(self, problem: StagedProblem, model: LearnedMap, end: TerminalSet) -> None:
        self._N, self._ends, nu = len(problem.free), problem.ends, model.nu
        self._feedback = terminal_feedback(end, tuple(model.model.states), nu)
        self._ny, self._outputs, self._cost = model.ny, problem.limited.map(self._N), plan_cost(problem)
        low, high = problem.stage_limits
        self._low, self._high, self._stage_limits = low[:, nu:], high[:, nu:], (low.T, high.T)
        self._moves, self._move_sizes = problem.inputs, 1e-9 * problem.input_sizes
        self._hard = np.isinf(problem.softness.linear)
        self._allowance = problem.softness.allowance.copy()
        self._allowance[len(self._allowance) - problem.ends :] = _END
        self.ahead = None

    def keep(self, U: Float[np.ndarray, "N nu"] | None) -> None:
        """Make these inputs the accepted plan; None where there is none."""
        self.ahead = None if U is None else U[1:].copy()

    def skip(self) -> None:
        """Move on by a step without a plan."""
        self.ahead = None if self.ahead is None else self.ahead[1:]

    def roll_out(
        self,
        model: LearnedMap,
        x: Float[np.ndarray, " nx"],
        U: Float[np.ndarray, "n nu"],
        u_prev: Float[np.ndarray, " nu"],
        box: Interval,
        e: Float[np.ndarray, "N nx"],
        W: Float[np.ndarray, "N nw"],
    ) -> tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]] | None:
        """Return the N states to which U leads, and U with κ behind it; None where they overflow."""
        states: list[np.ndarray] = [x]
        inputs: list[np.ndarray] = list(U)
        for k in range(self._N):
            if k == len(inputs):
                before = inputs[-1] if k else u_prev
                u: np.ndarray = np.array(self._feedback(states[-1][: self._ny], before), dtype=np.float64).ravel()
                inputs.append(np.clip(u, *box))
            states.append(model.step(states[-1], inputs[k], W[k]) + e[k])
            if not np.abs(states[-1]).max() < HUGE:
                return None
        return np.array(states), np.array(inputs)

    def judge(
        self,
        S: Float[np.ndarray, "N1 ns"],
        V: Float[np.ndarray, "N nu"],
        U: Float[np.ndarray, "N nu"],
        first: Interval,
        targets: StageTargets,
    ) -> JudgedPlan:
        """Return a plan with its cost and what it breaks; v_0 has to be inside `first`."""
        values = np.array(self._outputs(S[1:].T), dtype=np.float64).T
        past = np.maximum(np.maximum(self._low - values, values - self._high), 0.0)
        past[:-1, past.shape[1] - self._ends :] = 0.0  # a terminal set limits the last stage alone
        over = past / self._allowance
        low, high = (np.tile(end, (self._N, 1)) for end in self._moves)
        low[0], high[0] = first
        moved = np.maximum(low - V, V - high) / self._move_sizes
        soft = past[:, ~self._hard]
        excess = max(float(over[:, self._hard].max(initial=0.0)), float(moved.max()))
        slack = float(soft[over[:, ~self._hard] > 1].max(initial=0.0))
        parts = (S.T, V.T, targets.R.T, targets.U.T, targets.M, targets.L, targets.m, *self._stage_limits)
        return JudgedPlan(U, S, V, float(self._cost(*parts)), excess, slack)


def make_keeper(problem: StagedProblem, model: LearnedMap, limits: Limits) -> PlanKeeper | None:
    """Return what keeps the accepted plan; None where the set is soft or has no feedback, or moves are not free."""
    end = None if limits.terminal is None else read_terminal_set(limits.terminal)
    if end is None or end.feedback is None or limits.terminal_slack is not None:
        return None
    return PlanKeeper(problem, model, end) if problem.free.all() and not (problem.own or problem.timed) else None


def choose_plan(found: JudgedPlan | None, kept: JudgedPlan | None) -> JudgedPlan | None:
    """Return the plan to follow of the one found and the one kept; None where neither keeps the hard limits."""
    is_kept = kept is not None and kept.excess <= _MOVED
    if found is None or not found.excess <= _BROKEN:
        return kept if is_kept else None
    if is_kept and kept is not None and kept.cost * (1 + _COSTS_MORE) < found.cost:
        return kept
    return found
