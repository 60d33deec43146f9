"""Rows: consecutive steps of a closed loop as arrays, from a whole Run or from the steps that an observer saw."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.move import Fallback, Plan, Status
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import Step
from koopmpc.recording.description import About


@dataclass(frozen=True)
class Rows:
    """The rows k, k+1, … of a run: n states, and m = n moves, or m = n − 1 where the last state has no move yet.

    `planned` are the k of the steps that have a plan, `plan_X` and `plan_U` their plans.
    """

    k: int
    X: Float[np.ndarray, "n nx"]
    Y: Float[np.ndarray, "n ny"]
    reference: Float[np.ndarray, "n nr"]
    U: Float[np.ndarray, "m nu"]
    status: tuple[Status, ...]
    fallback: tuple[Fallback, ...]
    solve_time: Float[np.ndarray, " m"]
    iterations: Int[np.ndarray, " m"]
    planned: Int[np.ndarray, " p"]
    plan_X: Float[np.ndarray, "p N1 nx_plan"]
    plan_U: Float[np.ndarray, "p N nu_plan"]
    u_reference: Float[np.ndarray, "m nu"]
    slack: Float[np.ndarray, " m"]


def rows_of_run(run: Run) -> Rows:
    """Return the whole of `run` as rows."""
    no_plans = np.empty((0, 0, 0))
    return Rows(
        k=0,
        X=run.X,
        Y=run.Y,
        reference=run.reference,
        U=run.U,
        status=run.status,
        fallback=run.fallback,
        solve_time=run.solve_time,
        iterations=run.iterations,
        planned=np.arange(0 if run.plans is None else run.steps),
        plan_X=no_plans if run.plans is None else run.plans.X,
        plan_U=no_plans if run.plans is None else run.plans.U,
        u_reference=run.u_reference,
        slack=run.slack,
    )


def blocks(rows: Rows, least: int = 100, most: int = 10) -> list[Rows]:
    """Return `rows` as consecutive blocks of at least `least` steps, at most `most` of them.

    The state that the last move led to belongs to the last block.
    """
    moves = len(rows.U)
    size = max(least, -(-moves // most))
    starts = range(0, moves - size + 1, size) if moves > size else range(1)
    ends = [*starts[1:], len(rows.X)]
    return [_part(rows, a, b) for a, b in zip(starts, ends, strict=True)]


def _part(rows: Rows, a: int, b: int) -> Rows:
    """Return the rows from the a-th up to the b-th."""
    p = slice(*np.searchsorted(rows.planned, [rows.k + a, rows.k + b]))
    return Rows(
        k=rows.k + a,
        X=rows.X[a:b],
        Y=rows.Y[a:b],
        reference=rows.reference[a:b],
        U=rows.U[a:b],
        status=rows.status[a:b],
        fallback=rows.fallback[a:b],
        solve_time=rows.solve_time[a:b],
        iterations=rows.iterations[a:b],
        planned=rows.planned[p],
        plan_X=rows.plan_X[p],
        plan_U=rows.plan_U[p],
        u_reference=rows.u_reference[a:b],
        slack=rows.slack[a:b],
    )


def rows_of_steps(steps: Sequence[Step], nx: int, *, end: bool = False) -> Rows:
    """Return consecutive steps as rows; with `end`, the state that the last one led to follows.

    A state that the plant hides is NaN. A step without a Move counts as solved, in no time.
    """
    hidden = np.full(nx, np.nan)
    X = [hidden if s.x is None else s.x for s in steps]
    Y, reference = [s.y for s in steps], [s.reference for s in steps]
    last = steps[-1]
    if end and last.y_next is not None:
        X.append(hidden if last.x_next is None else last.x_next)
        Y.append(last.y_next)
        reference.append(last.reference if last.reference_next is None else last.reference_next)
    moves = [s.move for s in steps]
    plans: list[tuple[int, Plan]] = [(s.k, s.plan) for s in steps if s.plan is not None]
    return Rows(
        k=steps[0].k,
        X=np.stack(X),
        Y=np.stack(Y),
        reference=np.stack(reference),
        U=np.stack([s.u for s in steps]),
        status=tuple(Status.OPTIMAL if m is None else m.status for m in moves),
        fallback=tuple(Fallback.NONE if m is None else m.fallback for m in moves),
        solve_time=np.array([0.0 if m is None else m.solve_time for m in moves]),
        iterations=np.array([0 if m is None else m.iterations for m in moves], dtype=np.int64),
        planned=np.array([k for k, _ in plans], dtype=np.int64),
        plan_X=np.stack([p.X for _, p in plans]) if plans else np.empty((0, 0, 0)),
        plan_U=np.stack([p.U for _, p in plans]) if plans else np.empty((0, 0, 0)),
        u_reference=np.stack([np.zeros(len(s.u)) if s.u_reference is None else s.u_reference for s in steps]),
        slack=np.array([0.0 if m is None else m.slack for m in moves]),
    )


def run_of_rows(blocks: Sequence[Rows], about: About) -> Run | None:
    """Return the Run, without plans, that consecutive blocks amount to; None if not one step is whole."""
    X = np.concatenate([b.X for b in blocks]) if blocks else np.empty((0, 0))
    steps = len(X) - 1
    if steps < 1:
        return None
    return Run(
        X=X,
        Y=np.concatenate([b.Y for b in blocks]),
        reference=np.concatenate([b.reference for b in blocks]),
        U=np.concatenate([b.U for b in blocks])[:steps],
        status=tuple(s for b in blocks for s in b.status)[:steps],
        fallback=tuple(f for b in blocks for f in b.fallback)[:steps],
        solve_time=np.concatenate([b.solve_time for b in blocks])[:steps],
        iterations=np.concatenate([b.iterations for b in blocks])[:steps],
        u_reference=np.concatenate([b.u_reference for b in blocks])[:steps],
        slack=np.concatenate([b.slack for b in blocks])[:steps],
        **about.fields(),
    )
