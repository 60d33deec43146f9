# pyright: basic
"""record and Writer: the rows of a run as a Rerun recording, the same for a finished run and for a running loop."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.disk import path_of
from koopmpc.base.errors import KoopmpcError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.scene import Scene
from koopmpc.control.move import Fallback
from koopmpc.loop.metrics import metrics
from koopmpc.loop.rows import Plans, Step, StepRows
from koopmpc.loop.run import About, Run
from koopmpc.models.base import Predictor
from koopmpc.views.recording.blueprint import (
    LOG_TIME,
    SEPARATE,
    VIEW,
    LimitLine,
    ahead,
    blueprint,
    draw_eigenvalues,
    find_limits,
    limit_rows,
    panels,
    styles,
)
from koopmpc.views.recording.description import (
    NO_WORD,
    Entity,
    application_of,
    drawable,
    metrics_to_markdown,
    sparse_columns,
    status_words,
    title_of,
    to_json,
    to_markdown,
    word_columns,
)
from koopmpc.views.recording.rrd import RerunLog
from koopmpc.views.recording.scenes import Drawing, Scenes


@dataclass(frozen=True, eq=False, kw_only=True)
class LogBlock(StepRows):
    """Rows k, k+1, … of a run, and the plans of their steps; None where no step has one."""

    k: int = 0
    plans: Plans | None = None

    @staticmethod
    def of_steps(steps: Sequence[Step], nx: int, *, end: bool) -> "LogBlock":
        """Return consecutive steps as a block; with `end`, the state that the last one led to follows."""
        rows = StepRows.of(steps, nx, end=end).columns()
        return LogBlock(**rows, k=steps[0].k, plans=Plans.of([step.plan for step in steps]))

    def cut(self, first: int, last: int) -> "LogBlock":
        """Return rows first … last − 1, counted from this block's own first row."""
        plans = None if self.plans is None else Plans(self.plans.X[first:last], self.plans.U[first:last])
        return LogBlock(**self.part(first, last).columns(), k=self.k + first, plans=plans)

    def split(self, least: int = 100, most: int = 5) -> list["LogBlock"]:
        """Return consecutive blocks of at least `least` steps, at most `most` of them.

        The state that the last move led to belongs to the last block.
        """
        moves = len(self.U)
        size = max(least, -(-moves // most))
        starts = range(0, moves - size + 1, size) if moves > size else range(1)
        ends = [*starts[1:], len(self.X)]
        return [self.cut(a, b) for a, b in zip(starts, ends, strict=True)]

    def match_plans(
        self, states: Sequence[str], known: Sequence[Sequence[str]]
    ) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return the step, the states and the inputs of each plan; NaN for a state that the plan does not hold.

        A model may have other states than the plant: those of its outputs. The names of a plan are the first ones of
        `known` that are as many. States of one name are the same.
        """
        if self.plans is None:
            return []
        names = next((names for names in known if len(names) == self.plans.X.shape[-1]), ())
        X = np.full((*self.plans.X.shape[:-1], len(states)), np.nan)
        both = [(i, names.index(name)) for i, name in enumerate(states) if name in names]
        X[..., [i for i, _ in both]] = self.plans.X[..., [j for _, j in both]]
        return [(self.k + i, *plan) for i, plan in enumerate(zip(X, self.plans.U, strict=True))]


def find_differing(values: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Return the rows that are not, to the bit, the absent ones."""
    if not values.size:
        return np.empty(0, dtype=np.int64)
    bits = [np.ascontiguousarray(rows).reshape(len(values), -1).view(np.int64) for rows in (values, absent)]
    return np.flatnonzero((bits[0] != bits[1]).any(axis=1))


class Writer(RerunLog):
    """The log of a run: the description first, then blocks of rows in order, then the metrics.

    The states are written last in each block, so a row whose state can be read is whole. A file that was cut is read
    up to its last whole block; long runs are written as several blocks.
    """

    def __init__(
        self,
        about: About,
        *,
        path: str | Path | None,
        viewer: str | None = None,
        scene: Scene | None = None,
        model: Predictor | None = None,
        steps: int | None = None,
        growing: bool = False,
    ) -> None:
        """Check that `about` can be saved and open `path`; `steps` where the length is known beforehand."""
        self._about, self._model, self._scenes = about, model, Scenes(about, scene)
        self._page, self._json = to_markdown(about), to_json(about, steps)  # raises where the metadata cannot be saved
        self._steps = steps
        self._spans: dict[str, list[float]] = {}
        self._horizon, self._nr = 0, 0  # of the plans, 0 where there is none; of the reference
        self._laid_out: tuple[int, Any] | None = None  # horizon and ranges of the layout that was sent
        self._last: dict[str, str] = {}  # the last word of each column that is written where it changes
        self._styled: set[str] = set()
        self._plans: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # plans that look beyond what is written
        super().__init__(application_of(about), path=path, viewer=viewer, growing=growing)

    def write(self, rows: LogBlock) -> None:
        """Write the rows that follow, block by block."""
        self._nr = rows.reference.shape[1]
        if self._laid_out is None:
            self._spans = self._find_spans(rows)
        self._horizon = max(self._horizon, 0 if rows.plans is None else rows.plans.U.shape[1])
        parts = [(part, self._plans_of(part)) for part in rows.split()]
        # all, because the layout is as wide as the widest
        drawings = [self._scenes.draw_rows(part.k, part, plans) for part, plans in parts]
        self._arrange()
        if len(rows.U):
            self._words(rows)
        for (part, plans), drawn in zip(parts, drawings, strict=True):
            self._write(part, plans, drawn)

    def _write(
        self, rows: LogBlock, plans: list[tuple[int, np.ndarray, np.ndarray]], drawings: dict[str, Drawing]
    ) -> None:
        k = rows.k + np.arange(len(rows.X))
        looks = styles(self._about, self._nr, self._horizon)
        for entity, look in looks.items():
            if entity != Entity.MEASUREMENT:  # it may have no row
                self._style(entity, look)
        self._draw(drawings, k)
        if rows.plans is not None:
            self._vectors(Entity.PLAN_STATES, k[: len(rows.U)], rows.plans.X)
            self._vectors(Entity.PLAN_INPUTS, k[: len(rows.U)], rows.plans.U)
        self._plots(k, plans)
        shown, ms = panels(self._about, self._nr), 1e3 * rows.solve_time
        alone = {"Y": [i for panel in shown for i in panel.measured]}
        for name, (entity, component, absent) in sparse_columns(rows.X, ms, rows.Y.shape[1], rows.U.shape[1]).items():
            values = getattr(rows, name)
            at = find_differing(values, absent)
            if len(at) and entity in looks:
                self._style(entity, looks[entity])
            self._vectors(entity, k[at], values[at], alone.get(name, ()), component)
        self._vectors(Entity.REFERENCE, k, rows.reference, [i for panel in shown for i in panel.references])
        if len(rows.U):
            self._vectors(Entity.INPUT, k[: len(rows.U)], rows.U)
            self._limits(Entity.INPUT_LIMITS, "inputs", find_limits(self._about, "inputs"), k[: len(rows.U)])
            self._times(k[: len(rows.U)], rows.solve_time)
        self.flush()  # static archetypes reach the file before the states do
        self._vectors(Entity.STATE, k, rows.X, [i for panel in shown for i in panel.states])

    def _draw(self, drawings: dict[str, Drawing], k: np.ndarray) -> None:
        """Write the animation of the rows at steps k."""
        import rerun as rr

        if drawings and self._scenes.extent.in_space:
            self._style("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for entity, drawing in drawings.items():
            if drawing.style is not None:
                self._style(entity, drawing.style)
            self._send(entity, k, drawing.columns)

    def _times(self, k: np.ndarray, seconds: np.ndarray) -> None:
        """Write how long the steps k took, and their deadline, for the plots as powers of ten too."""
        ends = self._ends(k)
        for entity, at, times in (
            (Entity.SOLVER, k, seconds),
            (Entity.DEADLINE, ends, np.full(len(ends), self._about.dt)),
        ):
            self._vectors(entity, at, 1e3 * times)
            powers = np.log10(times[times > 0]).astype(np.float32)
            self._vectors(entity, at[times > 0], powers, component=LOG_TIME)

    def end(self, run: Run | None) -> None:
        """Write the metrics of the whole `run`."""
        import rerun as rr

        numbers: dict[str, Any] = {"steps": 0}
        text = "No step was recorded."
        if run is not None:
            numbers["steps"] = run.steps
            try:
                with np.errstate(all="ignore"):
                    found = metrics(run)
                text = metrics_to_markdown(found, self._about, run.reference.shape[1])
                numbers |= {"cost": found.cost, "effort": found.effort, "violation": found.violation}
            except (KoopmpcError, ValueError) as error:
                text = f"The metrics cannot be computed: {error}"
        self._arrange(end=True)
        self.page(Entity.METRICS, text, rr.AnyValues(**numbers))

    def _arrange(self, *, end: bool = False) -> None:
        """Write what is static, once the first drawings say how large the animation is, and the layout.

        It is sent again where the first plan comes late, and at the end where the animation has grown.
        """
        import rerun as rr

        if self._laid_out is None:
            self.rec.send_recording_name(drawable(title_of(self._about)))
            self.page(Entity.DESCRIPTION, self._page, rr.AnyValues(json=self._json))
            self.page("title", f"**{title_of(self._about)}**")
            self.flush()  # a log that is cut says what it was
            for entity, drawing in (draw_eigenvalues(self._model) if self._model is not None else {}).items():
                self._style(entity, drawing)
        sent, known = self._laid_out, (self._horizon, self._scenes.extent.ranges())
        if sent is not None and (sent[0] == known[0] if not end else sent == known):
            return
        self._laid_out = known
        layout = blueprint(
            self._about,
            self._nr,
            extent=self._scenes.extent if self._scenes.scene is not None else None,
            model=self._model,
            horizon=self._horizon,
            spans=self._spans,
            length=None if self._steps is None else self._steps * self._about.dt,
        )
        self.lay_out(layout)

    def _vectors(
        self, entity: str, k: np.ndarray, values: np.ndarray, alone: Sequence[int] = (), component: str = "scalars"
    ) -> None:
        """Write one vector a row; higher dimensions go flat, their last width kept beside them.

        Where a plot shows one element alone, its values stand beside the vector in single precision: a plot cannot
        pick one element of a vector, and further entities would repeat the times.
        """
        import rerun as rr

        if not values.size:
            return
        if component == "scalars":
            flat = values.reshape(-1).astype(np.float64)
            columns = [*rr.Scalars.columns(scalars=flat).partition(np.full(len(k), values[0].size))]
        else:
            archetype = VIEW if component == LOG_TIME else "koopmpc.Solver"
            columns = [*rr.DynamicArchetype.columns(archetype, components={component: values})]
        if values.ndim > 2:
            self._style(entity, rr.AnyValues(last_width=values.shape[-1]))
        if alone and len(self._about.states) <= SEPARATE:
            with np.errstate(over="ignore"):
                parts = {str(i): values[:, i].astype(np.float32) for i in alone}
            columns += rr.DynamicArchetype.columns(VIEW, components=parts)
        self._send(entity, k, columns)

    def _send(self, entity: str, k: np.ndarray, columns: Any) -> None:
        self.rows(entity, k, self._about.dt, columns)

    def _ends(self, k: np.ndarray) -> np.ndarray:
        """Return the steps at which lines that do not change have points: two a run, two a block of a running loop."""
        last = k[-1] if self._steps is None else self._steps
        return np.unique([k[0], last]) if self._steps is None or k[0] == 0 else k[:0]

    def _limits(self, entity: str, kind: str, lines: Sequence[LimitLine], k: np.ndarray) -> None:
        """Write the limits of these "states" or "inputs": in time at every step, else where their lines end."""
        limits = self._about.limits
        at = k if limits is not None and limits.in_time else self._ends(k)
        self._vectors(entity, at, limit_rows(self._about, kind, lines, at))

    def _find_spans(self, rows: LogBlock) -> dict[str, list[float]]:
        """Return the least and the largest value of each plot of states; of a running loop nothing is known yet."""
        if self._steps is None:
            return {}
        found: dict[str, list[float]] = {}
        for panel in panels(self._about, self._nr):
            parts = [rows.X[:, panel.states], rows.Y[:, panel.measured], rows.reference[:, panel.references]]
            values = np.concatenate([*map(np.ravel, parts), [limit.value for limit in panel.limits]])
            values = values[np.isfinite(values)]
            found[panel.entity] = [float(values.min()), float(values.max())] if len(values) else []
        return found

    def _plots(self, k: np.ndarray, plans: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
        """Write the limits of states, and what the plans of j steps before said of the rows at steps k.

        The plots show the latter j dt after the cursor. Nothing is written beyond the last row, so that the timeline
        ends with the run.
        """
        self._plans |= {step: (X, U) for step, X, U in plans if np.isfinite(U).any()}
        N = len(next(iter(self._plans.values()))[1]) if self._plans else 0
        shown = panels(self._about, self._nr)
        for panel in shown:
            self._limits(f"{panel.entity}/limits", "states", panel.limits, k)
        for j in ahead(N):
            steps = [step for step in self._plans if k[0] <= step + j <= k[-1]]
            if not steps:
                continue
            at = np.array(steps, dtype=np.int64) + j
            X = np.array([self._plans[step][0][j] for step in steps]).reshape(len(steps), -1)
            U = [self._plans[step][1][min(j, N - 1)] for step in steps]
            for panel in shown:
                if not np.isnan(predicted := X[:, panel.states]).all():
                    self._vectors(f"{panel.entity}/ahead/{j}", at, predicted)
            self._vectors(f"plots/u/ahead/{j}", at, np.array(U))
        self._plans = {step: plan for step, plan in self._plans.items() if step + N > k[-1]}

    def _plans_of(self, rows: LogBlock) -> list[tuple[int, np.ndarray, np.ndarray]]:
        model = () if self._model is None else self._model.states
        return rows.match_plans(self._about.states, (model, self._about.states, self._about.outputs))

    def _style(self, entity: str, look: Any) -> None:
        """Log a static archetype of the entity, once."""
        if entity not in self._styled:
            self._styled.add(entity)
            self.style(entity, look)

    def _words(self, rows: LogBlock) -> None:
        """Write status and solver where they change, and a line of text for every fallback that sets in."""
        import rerun as rr

        for entity, words in word_columns(rows).items():
            before = [self._last.get(entity, "" if entity == Entity.STATUS else NO_WORD), *words]
            changed = [i for i, word in enumerate(words) if word != before[i]]
            self._last[entity] = words[-1]
            if changed:
                states = rr.StateChange.columns(state=[words[i] for i in changed])
                self._send(entity, rows.k + np.array(changed), states)
            fallen = [i for i in changed if entity == Entity.STATUS and rows.fallback[i] is not Fallback.NONE]
            if fallen:
                texts = [f"step {rows.k + i}: {status_words(rows.status[i], rows.fallback[i])}" for i in fallen]
                lines = rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
                self._send(Entity.FALLBACKS, rows.k + np.array(fallen), lines)


@raise_swallowed()  # Rerun's own code may swallow a Ctrl-C
def record(run: Run, path: str | Path, *, scene: Scene | None = None, model: Predictor | None = None) -> None:
    """Write `run` as a complete Rerun log; `load_run(path)` equals `run` to the bit.

    Parameters
    ----------
    path
        The .rrd to write; its folders are made.
    scene
        scene(x, u) → shapes, drawn for every state and for a few stages of every plan; by default the run's own.
    model
        The predictor whose eigenvalues are shown; by default the run's own.

    Raises
    ------
    DataError
        The metadata hold something other than numbers, names, lists and arrays; the scene's shapes come and go.
    LogError
        The path is no .rrd, or cannot be written.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> gain = km.LQR(km.LinearPredictor.local(plant, [0, 0], [0]), cost, limits)
    >>> run = km.simulate(plant, gain, x0=[0.5, 0], reference=[0, 0], steps=100, cost=cost, limits=limits)
    >>> km.record(run, "pendulum.rrd")  # then: koopmpc view pendulum.rrd
    >>> km.load_run("pendulum.rrd") == run
    True
    """
    checks.kind(run, "run", Run, "pass what simulate returned; a model is written by km.recording.record_model")
    scene, model = scene or run.scene, run.model if model is None else model
    writer = Writer(About(**run.about()), path=path_of(path), scene=scene, model=model, steps=run.steps)
    with writer:
        writer.write(LogBlock(**run.columns(), plans=run.plans))
        writer.end(run)
