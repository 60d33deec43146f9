"""record a Run at once, or step by step with a Recorder while it happens: the same log either way."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

import numpy as np

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.move import Plan
from koopmpc.errors import DataError
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import Step
from koopmpc.predict.linear import LinearPredictor
from koopmpc.recording.connect import PORT, find_viewer
from koopmpc.recording.description import About
from koopmpc.recording.rows import Rows, rows_of_run, rows_of_steps, run_of_rows
from koopmpc.recording.scenes import Scene
from koopmpc.recording.writer import Writer

_BATCH = 0.2  # time between two batches [s]
_PATIENCE = 20.0  # longest wait for the thread at the end [s]
_NOTHING = np.empty((0, 0, 0))


def record(
    run: Run, path: str | Path, *, scene: Scene | None = None, model: LinearPredictor | None = None
) -> None:
    """Write `run` as a complete Rerun log; `load_run(path)` equals `run` to the bit.

    Parameters
    ----------
    path
        The .rrd to write; its folders are made.
    scene
        scene(x, u) → shapes, drawn for every state and for a few stages of every plan.
    model
        The predictor whose eigenvalues are shown.

    Raises
    ------
    DataError
        The metadata hold something other than numbers, names, lists and arrays.
    """
    writer = Writer(About.of(run), path=Path(path), scene=scene, model=model, steps=run.steps)
    writer.write(rows_of_run(run))
    writer.end(run)


class Recorder:
    """A context manager that writes a log while a loop runs; call it once a step, with a `Step`.

    A call puts copies of small arrays into a queue and returns within microseconds. A thread writes them to `path`
    and, with `live`, to the viewer that is up at this machine's port 9876, or to one that is opened. A viewer that
    is missing or dies costs one UserWarning, and no step.

    It is an observer: ``with km.Recorder("run.rrd", dt=…) as recorder: km.simulate(…, observers=[recorder])``. In a
    loop of one's own, k, y, u and reference of a Step are enough; give the last Step its y_next too, for a Run ends
    with the state that its last input led to.

    Parameters
    ----------
    path
        The .rrd to write; None for a viewer alone.
    live
        Stream to a viewer.
    dt, states, inputs, outputs, cost, limits, angles, metadata
        As in a Run; outputs are the states by default.
    scene, model
        As in `record`.
    port
        Where the viewer listens.

    Raises
    ------
    DataError
        Neither a path nor live; dt is not positive; called outside of its `with` block.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        dt: float,
        states: Sequence[str],
        inputs: Sequence[str],
        outputs: Sequence[str] | None = None,
        cost: Cost | None = None,
        limits: Limits | None = None,
        angles: Sequence[int] = (),
        metadata: Mapping[str, Any] | None = None,
        scene: Scene | None = None,
        model: LinearPredictor | None = None,
        live: bool = False,
        port: int = PORT,
    ) -> None:
        if path is None and not live:
            raise DataError("a Recorder needs somewhere to write: pass a path, live=True, or both")
        self._about = About(
            cost=cost,
            limits=limits,
            dt=checks.positive(dt, "dt", "s"),
            states=tuple(states),
            inputs=tuple(inputs),
            outputs=tuple(states if outputs is None else outputs),
            angles=tuple(angles),
            metadata=dict(metadata or {}),
        )
        self._path, self._live, self._port = None if path is None else Path(path), live, port
        self._scene, self._model = scene, model
        self._queue: SimpleQueue[Step] = SimpleQueue()
        self._closing = Event()
        self._thread: Thread | None = None
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        """Find the viewer, open the log and start the thread."""
        viewer = find_viewer(self._port) if self._live else None
        if self._live and viewer is None:
            kept = "the run is recorded all the same" if self._path else "nothing is recorded"
            warnings.warn(
                f"no Rerun viewer is up at 127.0.0.1:{self._port}, and there is no display to open one on; {kept}",
                UserWarning,
                stacklevel=2,
            )
        writer = None
        if self._path is not None or viewer is not None:
            writer = Writer(self._about, path=self._path, viewer=viewer, scene=self._scene, model=self._model)
        self._thread = Thread(target=self._work, args=(writer,), name="koopmpc-recorder", daemon=True)
        self._thread.start()
        return self

    def __call__(self, step: Step) -> None:
        """Queue one step."""
        if self._thread is None:
            raise DataError("the Recorder is not open; call it inside `with Recorder(...) as recorder:`")
        self._queue.put(_copied(step))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what is queued, the metrics and the end, and close."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing.set()
        thread.join(_PATIENCE)
        if thread.is_alive():
            self._failure = TimeoutError(f"not written after {_PATIENCE:g} s")
        if self._failure is not None:
            where = "the live viewer" if self._path is None else self._path
            warnings.warn(
                f"the recording to {where} is not complete: {self._failure}", UserWarning, stacklevel=2
            )

    def _work(self, writer: Writer | None) -> None:
        """Write batches until the end; a failure is kept for `__exit__`, and what follows it is dropped."""
        blocks: list[Rows] = []
        last: list[Step] = []  # held back, for the state that it led to may come with the end
        closing = False
        while not closing:
            closing = self._closing.wait(_BATCH)  # the thread wakes at its own pace, never at a step's
            steps = last + _drained(self._queue)
            if writer is None or self._failure is not None:
                continue
            try:
                ready, last = (steps, []) if closing else (steps[:-1], steps[-1:])
                if ready:
                    rows = rows_of_steps(ready, len(self._about.states), end=closing)
                    blocks.append(replace(rows, planned=rows.planned[:0], plan_X=_NOTHING, plan_U=_NOTHING))
                    writer.write(rows)
                    writer.flush()
                if closing:
                    writer.end(run_of_rows(blocks, self._about))
            except Exception as error:  # whatever a scene, a disk or a viewer raises must not reach the loop
                self._failure = error


def _drained(queue: SimpleQueue[Step]) -> list[Step]:
    """Return all that is in the queue now."""
    steps: list[Step] = []
    while True:
        try:
            steps.append(queue.get_nowait())
        except Empty:
            return steps


def _copied(step: Step) -> Step:
    """Return `step` with arrays of its own: a loop may write into its arrays again."""
    return Step(
        k=step.k,
        y=_floats(step.y),
        u=_floats(step.u),
        reference=_floats(step.reference),
        move=step.move,
        x=_floats(step.x),
        plan=None if step.plan is None else Plan(_floats(step.plan.X), _floats(step.plan.U)),
        x_next=_floats(step.x_next),
        y_next=_floats(step.y_next),
        reference_next=_floats(step.reference_next),
    )


def _floats(values: Any) -> Any:
    return None if values is None else np.array(values, dtype=np.float64)
