"""Rows of a log: consecutive steps of a closed loop and their plans, from a whole Run or from an observer's steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc.loop.run import Plans, Run, Step, StepRows


@dataclass(frozen=True, eq=False, kw_only=True)
class LogBlock(StepRows):
    """Rows k, k+1, … of a run, and the plans of those steps that have one.

    Attributes
    ----------
    k
        The step of the first row.
    planned
        (p,) steps that have a plan.
    plan_X, plan_U
        (p, N+1, nx) and (p, N, nu) their plans.
    """

    k: int
    planned: Int[np.ndarray, " p"]
    plan_X: Float[np.ndarray, "p N1 nx_plan"]
    plan_U: Float[np.ndarray, "p N nu_plan"]

    def cut(self, first: int, last: int) -> "LogBlock":
        """Return rows first … last − 1, counted from this block's own first row."""
        p = slice(*np.searchsorted(self.planned, [self.k + first, self.k + last]))
        plans = (self.planned[p], self.plan_X[p], self.plan_U[p])
        return _block(self.k + first, self.part(first, last), *plans)


def _block(
    k: int,
    rows: StepRows,
    planned: Int[np.ndarray, " p"],
    plan_X: Float[np.ndarray, "p N1 nx_plan"],
    plan_U: Float[np.ndarray, "p N nu_plan"],
) -> LogBlock:
    return LogBlock(**rows.columns(), k=k, planned=planned, plan_X=plan_X, plan_U=plan_U)


def block_of_run(run: Run) -> LogBlock:
    """Return the whole of `run` as one block."""
    plans = Plans(np.empty((0, 0, 0)), np.empty((0, 0, 0))) if run.plans is None else run.plans
    return _block(0, run, np.arange(len(plans.X)), plans.X, plans.U)


def block_of_steps(steps: Sequence[Step], nx: int, *, end: bool) -> LogBlock:
    """Return consecutive steps as a block; with `end`, the state that the last one led to follows."""
    plans = [step.plan for step in steps if step.plan is not None]
    whole = Plans.of(plans) or Plans(np.empty((0, 0, 0)), np.empty((0, 0, 0)))
    planned = np.array([step.k for step in steps if step.plan is not None], dtype=np.int64)
    return _block(steps[0].k, StepRows.of(steps, nx, end=end), planned, whole.X, whole.U)


def blocks(rows: LogBlock, least: int = 100, most: int = 10) -> list[LogBlock]:
    """Return `rows` as consecutive blocks of at least `least` steps, at most `most` of them.

    The state that the last move led to belongs to the last block.
    """
    moves = len(rows.U)
    size = max(least, -(-moves // most))
    starts = range(0, moves - size + 1, size) if moves > size else range(1)
    ends = [*starts[1:], len(rows.X)]
    return [rows.cut(a, b) for a, b in zip(starts, ends, strict=True)]
