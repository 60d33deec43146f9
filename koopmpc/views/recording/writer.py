# pyright: basic
"""record and Writer: the rows of a run as a Rerun recording, the same for a finished run and for a running loop."""

import json
from collections.abc import Sequence
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
from koopmpc.loop.rows import MOVE_COLUMNS
from koopmpc.loop.run import About, Run
from koopmpc.models.base import Predictor
from koopmpc.views.recording.blocks import LogBlock, block_of_run, blocks, find_differing, match_plans, take_where
from koopmpc.views.recording.blueprint import (
    LOG_TIME,
    SEPARATE,
    VIEW,
    ahead,
    blueprint,
    limit_lines,
    panels,
    status_value,
    styles,
    write_page,
)
from koopmpc.views.recording.description import (
    NO_WORD,
    Entity,
    application_of,
    digest,
    drawable,
    metrics_to_markdown,
    status_words,
    sum_plans,
    title_of,
    to_json,
    to_markdown,
)
from koopmpc.views.recording.eigenvalues import draw_eigenvalues
from koopmpc.views.recording.rrd import CHECK, LogFile, new_recording, send_blueprint, times
from koopmpc.views.recording.scenes import Drawing, Scenes

_FLUSH = 3.0  # longest wait for a sink of a running loop [s]


class Writer:
    """One recording: the description first, then blocks of rows in order, then the metrics, which mark a complete log.

    The states are written last in each block, so a row whose state can be read is whole. A file that was cut is read
    up to its last whole block; long runs are written as several blocks.
    """

    def __init__(
        self,
        about: About,
        *,
        path: Path | None,
        viewer: str | None = None,
        scene: Scene | None = None,
        model: Predictor | None = None,
        steps: int | None = None,
        growing: bool = False,
    ) -> None:
        """Check that `about` can be saved and open `path`; `viewer` is the address of a viewer that is up.

        A `growing` log is there while it is written, any other takes its place at the end.
        """
        import rerun as rr

        self._about, self._model, self._scenes = about, model, Scenes(about, scene)
        self._page, self._json = to_markdown(about), to_json(about, steps)  # raises where the metadata cannot be saved
        self._steps = steps
        self._opened = False
        self._spans: dict[str, list[float]] = {}
        self._horizon, self._nr = 0, 0  # of the plans, 0 where there is none; of the reference
        self._shown = self._scenes.extent.ranges()
        # the last word of each column that is written where it changes
        self._last = {column.log: NO_WORD for column in MOVE_COLUMNS if column.log and column.dtype is None}
        self._looks: dict[str, Any] = {}  # styles of the curves, by entity
        self._looked = -1  # the horizon that they were made for, −1 before any
        self._styled: set[str] = set()
        self._plan_sums: dict[int, int] = {}  # a checksum of each plan, for the digest at the end
        self._plans: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # plans that look beyond what is written
        self._file: LogFile | None = None
        self._rec: Any = None
        try:
            with raise_swallowed():  # no interrupt between the file and its name leaves it behind
                self._file = None if path is None else LogFile(path, growing=growing)
            self._rec = new_recording(application_of(about))
            if self._file is not None:
                self._file.attach(self._rec)
            else:
                self._rec.set_sinks(rr.GrpcSink(viewer))
        except BaseException:  # a Ctrl-C
            self.discard()
            raise

    def write(self, rows: LogBlock) -> None:
        """Write the rows that follow, block by block."""
        self._nr = rows.reference.shape[1]
        if not self._opened:
            self._spans = self._found_spans(rows)
        self._horizon = max(self._horizon, rows.horizon)
        parts = blocks(rows)
        drawings = [  # all, because the layout is as wide as the widest
            self._scenes.draw_rows(part.k, part, self._plans_of(part)) for part in parts
        ]
        if not self._opened:
            self._open()
        if len(rows.U):
            self._statuses(rows)
        for part, drawn in zip(parts, drawings, strict=True):
            self._write(part, drawn)

    def _write(self, rows: LogBlock, drawings: dict[str, Drawing]) -> None:
        import rerun as rr

        k = rows.k + np.arange(len(rows.X))
        if self._looked != self._horizon:  # the first plan may come later than the first block
            if self._looked >= 0:
                self._lay_out()
            self._looked, self._looks = self._horizon, styles(self._about, self._nr, self._horizon)
            for entity, style in self._looks.items():
                if entity != Entity.MEASUREMENT:  # it may have no row
                    self._style(entity, style)
        if drawings and self._scenes.extent.in_space:
            self._style("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for entity, drawing in drawings.items():
            if drawing.style is not None:
                self._style(entity, drawing.style)
            self._send(entity, k, drawing.columns)
        if len(rows.planned):
            self._plan_sums |= sum_plans(rows.planned.tolist(), rows.plan_X, rows.plan_U)
            self._vectors(Entity.PLAN_STATES, rows.planned, rows.plan_X)
            self._vectors(Entity.PLAN_INPUTS, rows.planned, rows.plan_U)
        self._plots(rows, k)
        measured, shown = find_differing(rows.X, rows.Y), panels(self._about, self._nr)
        if len(measured):
            self._style(Entity.MEASUREMENT, self._looks[Entity.MEASUREMENT])
        self._vectors(Entity.MEASUREMENT, k[measured], rows.Y[measured], [i for p in shown for i in p.measured])
        self._vectors(Entity.REFERENCE, k, rows.reference, [i for p in shown for i in p.references])
        if len(rows.U):
            self._moves(rows, k[: len(rows.U)])
        self.flush()  # static archetypes reach the file before the states do
        self._vectors(Entity.STATE, k, rows.X, [i for panel in shown for i in panel.states])

    def _moves(self, rows: LogBlock, k: np.ndarray) -> None:
        """Write the inputs at steps k, their limits, and what the solver did for them."""
        import rerun as rr

        self._vectors(Entity.INPUT, k, rows.U)
        held = find_differing(np.zeros_like(rows.u_reference), rows.u_reference)
        self._vectors(Entity.INPUT_REFERENCE, k[held], rows.u_reference[held])
        for column in MOVE_COLUMNS:
            if column.log and column.dtype is not None:
                values = getattr(rows, column.name)
                kept = np.flatnonzero(values != column.absent)
                self._vectors(column.log, k[kept], values[kept, None].astype(np.float64))
        ends = self._ends(k)
        self._limits(Entity.INPUT_LIMITS, "inputs", self._about.inputs, k)
        if len(ends):
            powers = np.full(len(ends), np.log10(self._about.dt))
            line = rr.DynamicArchetype.columns(VIEW, components={LOG_TIME: powers})
            scalars = rr.Scalars.columns(scalars=np.full(len(ends), 1e3 * self._about.dt))
            self._send(Entity.DEADLINE, ends, [*scalars, *line])
        ms, timed = 1e3 * rows.solve_time, rows.solve_time > 0
        columns = [*rr.Scalars.columns(scalars=ms)]
        for name, column, held in (
            ("seconds", rows.solve_time, ms / 1e3 != rows.solve_time),
            ("iterations", rows.iterations, rows.iterations != 0),
        ):
            values = np.ascontiguousarray(column[held])
            if held.any():
                columns += take_where(held, "koopmpc.Solver", name, values)
        columns += take_where(timed, VIEW, LOG_TIME, np.log10(rows.solve_time[timed]).astype(np.float32))
        self._send(Entity.SOLVER, k, columns)

    def flush(self) -> None:
        """Hand on what was written, to a viewer within three seconds; raise where the disk refuses it."""
        self._rec.flush(timeout_sec=_FLUSH)
        if self._file is not None:
            self._file.save()

    def end(self, run: Run | None) -> None:
        """Write the metrics of the whole `run` and close; the log says from now on that it is complete."""
        import rerun as rr

        numbers: dict[str, Any] = {"steps": 0}
        text = "No step was recorded."
        if run is not None:
            numbers |= {"steps": run.steps, "digest": json.dumps(digest(run, self._json, self._plan_sums))}
            try:
                with np.errstate(all="ignore"):
                    found = metrics(run)
                text = metrics_to_markdown(found, self._about, run.reference.shape[1])
                numbers |= {"cost": found.cost, "effort": found.effort, "violation": found.violation}
            except (KoopmpcError, ValueError) as error:
                text = f"The metrics cannot be computed: {error}"
        if not self._opened:
            self._open()
        if self._scenes.extent.ranges() != self._shown:
            self._lay_out()
        write_page(self._rec, Entity.METRICS, text, rr.AnyValues(**numbers, check=CHECK))
        self._rec.flush(timeout_sec=_FLUSH)
        if self._file is not None:
            self._file.close()
        self._release()

    def discard(self) -> None:
        """Close without an end: of a growing log what was written stays, any other file is removed."""
        if self._file is not None:
            self._file.discard()
        self._release()

    def _release(self) -> None:
        """Close the recording and let go of it."""
        with raise_swallowed():
            if self._rec is not None:
                self._rec.disconnect()
            self._rec = None

    def _open(self) -> None:
        """Write what is static, once the first drawings say how large the animation is."""
        import rerun as rr

        self._opened = True
        self._rec.send_recording_name(drawable(title_of(self._about)))
        write_page(self._rec, Entity.DESCRIPTION, self._page, rr.AnyValues(json=self._json))
        write_page(self._rec, "title", f"**{title_of(self._about)}**")
        self.flush()  # a log that is cut says what it was
        self._lay_out()
        if self._model is not None:
            for entity, drawing in draw_eigenvalues(self._model).items():
                self._style(entity, drawing)

    def _lay_out(self) -> None:
        """Send the blueprint of what is known by now."""
        self._shown = self._scenes.extent.ranges()
        layout = blueprint(
            self._about,
            self._nr,
            extent=self._scenes.extent if self._scenes.scene is not None else None,
            model=self._model,
            horizon=self._horizon,
            spans=self._spans,
            length=None if self._steps is None else self._steps * self._about.dt,
        )
        send_blueprint(self._rec, application_of(self._about), layout)

    def _vectors(self, entity: str, k: np.ndarray, values: np.ndarray, alone: Sequence[int] = ()) -> None:
        """Write one vector a row; higher dimensions go flat, their last width kept beside them.

        Where a plot shows one element alone, its values stand beside the vector in single precision: a plot cannot
        pick one element of a vector, and further entities would repeat the times.
        """
        import rerun as rr

        if not values.size:
            return
        width = values[0].size
        columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition(np.full(len(k), width))
        if values.ndim > 2:
            self._style(entity, rr.AnyValues(last_width=values.shape[-1]))
        if alone and len(self._about.states) <= SEPARATE:
            with np.errstate(over="ignore"):
                parts = {str(i): values[:, i].astype(np.float32) for i in alone}
            columns = [*columns, *rr.DynamicArchetype.columns(VIEW, components=parts)]
        self._send(entity, k, columns)

    def _send(self, entity: str, k: np.ndarray, columns: Any) -> None:
        """Write the rows at steps k of an entity."""
        self._rec.send_columns(entity, times(k, self._about.dt), columns)

    def _ends(self, k: np.ndarray) -> np.ndarray:
        """Return the steps at which lines that do not change have points: two a run, two a block of a running loop."""
        last = k[-1] if self._steps is None else self._steps
        return np.unique([k[0], last]) if self._steps is None or k[0] == 0 else k[:0]

    def _limits(self, entity: str, kind: str, names: Sequence[str], k: np.ndarray) -> None:
        """Write the limits of these "states" or "inputs": in time at every step, else where their lines end."""
        limits = self._about.limits
        at = k if limits is not None and limits.in_time else self._ends(k)
        self._vectors(entity, at, limit_lines(self._about, kind, names, at))

    def _found_spans(self, rows: LogBlock) -> dict[str, list[float]]:
        """Return the least and the largest value of each plot of states; of a running loop nothing is known yet."""
        if self._steps is None:
            return {}
        found: dict[str, list[float]] = {}
        for panel in panels(self._about, self._nr):
            parts = [rows.X[:, panel.states], rows.Y[:, panel.measured], rows.reference[:, panel.references]]
            values = np.concatenate([*map(np.ravel, parts), [value for _, value in panel.limits]])
            values = values[np.isfinite(values)]
            found[panel.entity] = [float(values.min()), float(values.max())] if len(values) else []
        return found

    def _plots(self, rows: LogBlock, k: np.ndarray) -> None:
        """Write the limits of states, and what the plans of j steps before said of the steps in `rows`.

        The plots show the latter j dt after the cursor. Nothing is written beyond the last row, so that the timeline
        ends with the run.
        """
        self._plans |= {step: (X, U) for step, X, U in self._plans_of(rows) if np.isfinite(U).any()}
        N = len(next(iter(self._plans.values()))[1]) if self._plans else 0
        shown = panels(self._about, self._nr)
        for panel in shown:
            self._limits(f"{panel.entity}/limits", "states", [self._about.states[i] for i in panel.states], k)
        for j in ahead(N):
            of = [step for step in self._plans if k[0] <= step + j <= k[-1]]
            if not of:
                continue
            at = np.array(of, dtype=np.int64) + j
            X = np.array([self._plans[step][0][j] for step in of]).reshape(len(of), -1)
            U = [self._plans[step][1][min(j, N - 1)] for step in of]
            for panel in shown:
                if not np.isnan(predicted := X[:, panel.states]).all():
                    self._vectors(f"{panel.entity}/ahead/{j}", at, predicted)
            self._vectors(f"plots/u/ahead/{j}", at, np.array(U))
        self._plans = {step: plan for step, plan in self._plans.items() if step + N > k[-1]}

    def _plans_of(self, rows: LogBlock) -> list[tuple[int, np.ndarray, np.ndarray]]:
        model = () if self._model is None else self._model.states
        return match_plans(rows, self._about.states, (model, self._about.states, self._about.outputs))

    def _style(self, entity: str, style: Any) -> None:
        """Log a static archetype of the entity, once."""
        if entity not in self._styled:
            self._styled.add(entity)
            self._rec.log(entity, style, static=True)

    def _statuses(self, rows: LogBlock) -> None:
        """Write the status and the solver where they change, and a line of text for every fallback that sets in."""
        import rerun as rr

        pairs = list(zip(rows.status, rows.fallback, strict=True))
        changed = self._changes(Entity.STATUS, rows.k, [status_value(*pair) for pair in pairs])
        for column in MOVE_COLUMNS:
            if column.log and column.dtype is None:
                self._changes(column.log, rows.k, [str(word) or NO_WORD for word in getattr(rows, column.name)])
        fallen = [i for i in changed if pairs[i][1] is not Fallback.NONE]
        if fallen:
            texts = [f"step {rows.k + i}: {status_words(*pairs[i])}" for i in fallen]
            columns = rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
            self._send(Entity.FALLBACKS, rows.k + np.array(fallen), columns)

    def _changes(self, entity: str, first: int, words: Sequence[str]) -> list[int]:
        """Write the words of the rows first, first + 1, … where they change; return which of the rows these are."""
        import rerun as rr

        before = [self._last.get(entity), *words]
        changed = [i for i, word in enumerate(words) if word != before[i]]
        self._last[entity] = words[-1]
        if changed:
            told, k = [words[i] for i in changed], first + np.array(changed)
            self._send(entity, k, rr.StateChange.columns(state=told))
        return changed


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
    try:
        writer.write(block_of_run(run))
        writer.end(run)
    except BaseException:
        writer.discard()
        raise
