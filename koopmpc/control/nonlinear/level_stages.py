"""Inputs on levels in the program of all stages along a plan: DAQP searches its condensed form."""

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.condensed_stages import Deviation, Stages, condense_stages
from koopmpc.control.nonlinear.iteration import RealTimeIteration
from koopmpc.control.nonlinear.problem import StagedProblem, StageTargets
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import SolverTurn, StepQP
from koopmpc.control.solvers.levels import LevelSearch, LevelSolver

PASSES = 4  # linearisations of one step, at most: the levels of a plan move the point of the next one
FOLLOWED = 1e-6  # a plan on levels follows the model if it misses each state by less than this share of its size


class StageLevels:
    """The search over levels in the quadratic programs of a BilinearMPC.

    Parameters
    ----------
    search
        The levels, and those of the last plan.
    problem
        The stages.
    """

    def __init__(self, search: LevelSearch, problem: StagedProblem) -> None:
        self.search = search
        self._starts: Int[np.ndarray, " moves"] = np.flatnonzero(problem.free)
        self._free, self._rated, self._nu = problem.free, problem.with_rates, len(problem.R)
        self._solver: LevelSolver | None = None

    def improve(
        self, iteration: RealTimeIteration, s: Float[np.ndarray, " ns"], targets: StageTargets, deadline: float
    ) -> tuple[Status, int]:
        """Put the plan on levels; return how that ended, and the solver's iterations.

        Each pass linearises at the plan of the last one, and they end where the levels stay.
        """
        search, total, kept, broken = self.search, 0, None, 0.0
        for _ in range(PASSES):
            found = iteration.step(s, targets, deadline, self)
            total += found.iterations
            if found.status is not Status.OPTIMAL:
                search.repeats = False
                if kept is None:
                    return found.status, total
                search.index, search.gap = kept
                break
            same = kept is not None and bool((kept[0] == search.index).all())
            kept = search.index, search.gap
            iteration.X[0] = s
            iteration.X[1:] += found.X
            iteration.U += found.U
            broken = iteration.note_slack(found)
            if same or iteration.find_defect() < FOLLOWED:
                break
            search.repeats = True
        search.repeats = False
        return Status.SOFTENED if broken else Status.OPTIMAL, total

    def solve(
        self,
        stages: Stages,
        free: Float[np.ndarray, "N nq"],
        limits: Interval,
        softness: Softness,
        deadline: float,
    ) -> Deviation | None:
        """Return the least deviation from the solution without limits; None where the recursion has no digits left.

        `free` are the values [U_k; g(X_{k+1})] of that solution, `limits` those of the same values.
        """
        condensed = condense_stages(stages)
        if condensed is None:
            return None
        X, U, rows = condensed
        nu, n = self._nu, len(X[0, 0])
        first = nu if self._rated else 0
        mine = slice(first, first + nu)  # where u_k stands among the values of a stage
        kept = np.isfinite(limits.low) | np.isfinite(limits.high)
        kept[~self._free, :nu] = False
        kept[:, mine] = False
        low = np.maximum.reduceat(limits.low[:, mine], self._starts, axis=0).ravel()
        high = np.minimum.reduceat(limits.high[:, mine], self._starts, axis=0).ravel()
        moves = np.isfinite(low) | np.isfinite(high)
        A = np.concatenate([rows[self._starts, mine].reshape(-1, n)[moves], rows[kept]])
        if not np.isfinite(A).all():
            return None
        none = np.zeros(nu * len(self._starts)), np.full(nu * len(self._starts), np.inf)
        prices = [
            np.concatenate([none[hard][moves], np.tile(part, (len(rows), 1))[kept]])
            for part, hard in zip(softness, (1, 0, 0), strict=True)
        ]
        source = np.concatenate([np.flatnonzero(moves), len(low) + np.arange(int(kept.sum()))])
        qp = StepQP(
            P=np.eye(n),
            q=np.zeros(n),
            A=A,
            low=np.concatenate([low[moves], limits.low[kept]]),
            high=np.concatenate([high[moves], limits.high[kept]]),
            softness=Softness(*prices),
            source=source,
            scale=np.ones(len(source)),
            shift_primal=np.arange(n),
            shift_dual=np.arange(len(source)),
            rate_rows=np.zeros(0, np.intp),
            rate_inputs=np.zeros(0, np.intp),
        )
        if self._solver is None or self._solver.qp.source.tolist() != source.tolist():
            self._solver = LevelSolver(qp, SolverTurn(FINISHER, {}), self.search)
        else:
            self._solver.update(qp)
        plan = np.concatenate([free[self._starts, mine].ravel(), free[kept]])
        end = None if np.isinf(deadline) else deadline
        found, _ = self._solver.solve(plan, None, end, Interval(qp.low, qp.high))
        return Deviation(X[1:] @ found.v, U @ found.v, found.y, found.status, found.iterations)
