# pyright: basic
"""Rows of a run with their plans, as a log writes them: block by block."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.loop.rows import Plans, Step, StepRows
from koopmpc.loop.run import Run

_NO_PLANS = Plans(np.empty((0, 0, 0)), np.empty((0, 0, 0)))


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

    @property
    def horizon(self) -> int:
        """Length of the plans, 0 where there is none."""
        return self.plan_U.shape[1] if len(self.planned) else 0

    def cut(self, first: int, last: int) -> "LogBlock":
        """Return rows first … last − 1, counted from this block's own first row."""
        rows, p = self.part(first, last), slice(*np.searchsorted(self.planned, [self.k + first, self.k + last]))
        plans: dict[str, Any] = {"planned": self.planned[p], "plan_X": self.plan_X[p], "plan_U": self.plan_U[p]}
        return LogBlock(**rows.columns(), k=self.k + first, **plans)


def block_of_run(run: Run) -> LogBlock:
    """Return the whole of `run` as one block."""
    plans = run.plans or _NO_PLANS
    return LogBlock(**run.columns(), k=0, planned=np.arange(len(plans.X)), plan_X=plans.X, plan_U=plans.U)


def block_of_steps(steps: Sequence[Step], nx: int, *, end: bool) -> LogBlock:
    """Return consecutive steps as a block; with `end`, the state that the last one led to follows."""
    plans = [(step.k, plan) for step in steps if (plan := step.plan) is not None]
    planned = np.array([k for k, _ in plans], dtype=np.int64)
    rows, whole = StepRows.of(steps, nx, end=end), Plans.of([plan for _, plan in plans]) or _NO_PLANS
    return LogBlock(**rows.columns(), k=steps[0].k, planned=planned, plan_X=whole.X, plan_U=whole.U)


def blocks(rows: LogBlock, least: int = 100, most: int = 5) -> list[LogBlock]:
    """Return `rows` as consecutive blocks of at least `least` steps, at most `most` of them.

    The state that the last move led to belongs to the last block.
    """
    moves = len(rows.U)
    size = max(least, -(-moves // most))
    starts = range(0, moves - size + 1, size) if moves > size else range(1)
    ends = [*starts[1:], len(rows.X)]
    return [rows.cut(a, b) for a, b in zip(starts, ends, strict=True)]


def match_plans(
    rows: LogBlock, states: Sequence[str], known: Sequence[Sequence[str]]
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return the step, the states and the inputs of each plan; NaN for a state that the plan does not hold.

    A model may have other states than the plant: those of its outputs. The names of a plan are the first ones of
    `known` that are as many. States of one name are the same.
    """
    width = rows.plan_X.shape[-1]
    names = next((each for each in known if len(each) == width), ())
    X = np.full((*rows.plan_X.shape[:-1], len(states)), np.nan)
    both = [(i, names.index(name)) for i, name in enumerate(states) if name in names]
    X[..., [i for i, _ in both]] = rows.plan_X[..., [j for _, j in both]]
    return list(zip(rows.planned.tolist(), X, rows.plan_U, strict=True))


def take_where(held: np.ndarray, archetype: str, component: str, values: np.ndarray) -> Any:
    """Return the columns of a component that only some rows have: a value for each of those."""
    import rerun as rr

    return rr.DynamicArchetype.columns(archetype, components={component: values}).partition(held.astype(np.int64))


def find_differing(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Return the rows of Y that are not, to the bit, those of X."""
    if X.shape != Y.shape or not X.size:
        return np.arange(len(Y))
    return np.flatnonzero(
        (np.ascontiguousarray(X).view(np.int64) != np.ascontiguousarray(Y).view(np.int64)).any(axis=1)
    )
