"""A Recorder writes a log step by step while the loop runs: the log that `record` writes of the whole run."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from types import TracebackType
from typing import Any, cast

import numpy as np

from koopmpc.base import checks
from koopmpc.base.disk import path_of
from koopmpc.base.errors import DataError, refuse_moved
from koopmpc.base.scene import Scene
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.move import Plan
from koopmpc.loop.rows import Step, StepRows
from koopmpc.loop.run import About, Run
from koopmpc.models.base import Predictor
from koopmpc.views.recording.viewer import PORT, find_viewer, is_up, quiet, why_none
from koopmpc.views.recording.writer import LogBlock, Writer


class BackgroundWriter:
    """Write steps in a thread: `put` queues a step and returns at once, and `close` waits for the rest."""

    def __init__(self, about: About, writer: Writer) -> None:
        self.queue: SimpleQueue[Step] = SimpleQueue()
        self.put: Callable[[Step], None] = self.queue.put
        self._about = about
        self._closing = Event()
        self._failure: Exception | None = None
        self._thread = Thread(target=self._work, args=(writer,), name="koopmpc-recording", daemon=True)
        self._thread.start()

    def close(self, patience: float) -> Exception | None:
        """Write what is queued, the metrics and the end; return what went wrong since the start, if anything."""
        self._closing.set()
        self._thread.join(patience)
        if self._thread.is_alive():
            return TimeoutError(f"it took in no more for {patience:g} s")
        return self._failure

    def _work(self, writer: Writer) -> None:
        """Write batches until the end; after a failure nothing more is written, and `close` returns the failure."""
        written: list[StepRows] = []  # for the metrics at the end
        last: list[Step] = []  # held back, because the state after the last step is written with that step
        closing = False
        try:
            with writer:
                while not closing:
                    # time between two batches [s]
                    closing = self._closing.wait(0.2)  # the thread looks at the queue five times a second
                    steps = last + self._drain()
                    ready, last = (steps, []) if closing else (steps[:-1], steps[-1:])
                    if ready:
                        rows = LogBlock.of_steps(ready, len(self._about.states), end=closing)
                        written.append(StepRows(**rows.columns()))
                        writer.write(rows)
                        writer.flush()
                whole = sum(len(part.X) for part in written) > 1
                columns = StepRows.join(written).columns() if whole else {}
                writer.end(Run(**columns, **self._about.about()) if whole else None)
        except Exception as error:  # whatever a scene, a disk or a viewer raises must not reach the loop
            self._failure = error
            self.put = lambda step: None

    def _drain(self) -> list[Step]:
        """Return the steps that are in the queue now."""
        return [self.queue.get_nowait() for _ in range(self.queue.qsize())]  # nobody else takes any


_PATIENCE_FILE = 60.0  # longest wait at the end for a file [s]
_PATIENCE_VIEWER = 5.0  # longest wait at the end for a viewer [s]


@dataclass(frozen=True, eq=False)
class RecorderOptions:
    """What is seldom asked of a Recorder: `km.Recorder(…, options=km.recording.RecorderOptions(scene=draw))`.

    Attributes
    ----------
    outputs
        Names of what is measured; by default the states.
    angles
        Indices of states whose errors wrap at ±π in the metrics.
    metadata
        Names, numbers and texts that the log keeps.
    scene, model
        What is drawn of each state, and the predictor whose eigenvalues are shown, as in `record`.
    port
        Where the viewer listens.
    """

    outputs: Sequence[str] | None = None
    angles: Sequence[int] = ()
    metadata: Mapping[str, Any] | None = None
    scene: Scene | None = None
    model: Predictor | None = None
    port: int = PORT


class Recorder:
    """A context manager that writes a log while a loop runs; call it once a step, with a `Step`.

    A call puts copies of small arrays into a queue and returns within microseconds. A thread writes them to `path`,
    and with `live` another one to the viewer that is up at this machine's port 9876, or that is opened. A viewer that
    is missing, slow or dies costs one UserWarning, and no step.

    It is an observer: ``with km.Recorder("run.rrd", dt=…) as recorder: km.simulate(…, observers=[recorder])``. In a
    loop of your own, k, y, u and reference of a Step are enough. Give the last Step its y_next too: a Run ends with
    the state that its last input led to.

    Parameters
    ----------
    path
        The .rrd to write; None for a viewer alone.
    dt, states, inputs, cost, limits
        As in a Run.
    live
        Write to a viewer too.
    options
        Names of outputs, the scene and what else is seldom asked: see `km.recording.RecorderOptions`.

    Raises
    ------
    DataError
        Neither a path nor live; dt is not positive; called outside of its `with` block.
    LogError
        The path is no .rrd, or cannot be written.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        dt: float,
        states: Sequence[str],
        inputs: Sequence[str],
        cost: Cost | None = None,
        limits: Limits | None = None,
        live: bool = False,
        options: RecorderOptions | None = None,
        **moved: Any,
    ) -> None:
        refuse_moved(moved, RecorderOptions, "km.recording.RecorderOptions")
        checks.kind(live, "live", (bool, np.bool_), "pass True or False")
        if path is None and not live:
            raise DataError("a Recorder needs somewhere to write: pass a path, live=True, or both")
        asked = RecorderOptions() if options is None else options
        checks.kind(asked, "options", RecorderOptions, "pass km.recording.RecorderOptions(…)")
        if not isinstance(cast(object, asked.metadata), Mapping | None):
            raise DataError(f"metadata is {checks.article(asked.metadata)}; pass names with numbers and texts")
        self._about = About(
            cost=cost,
            limits=limits,
            dt=checks.positive(dt, "dt", "s"),
            states=checks.texts(states, "states"),
            inputs=checks.texts(inputs, "inputs"),
            outputs=checks.texts(states if asked.outputs is None else asked.outputs, "outputs"),
            angles=tuple(asked.angles),
            metadata=dict(asked.metadata or {}),
        )
        self._path, self._live, self._port = None if path is None else path_of(path), live, asked.port
        self._scene, self._model = asked.scene, asked.model
        self._writers: dict[str, BackgroundWriter] = {}
        self._open = False

    def __enter__(self) -> "Recorder":
        """Open the log, and find the viewer."""
        if self._live:
            quiet()
        if self._path is not None:
            self._writers[str(self._path)] = self._start_writer(self._path, None)
        if self._live:
            viewer = find_viewer(self._port)
            if viewer is not None:
                self._writers[viewer] = self._start_writer(None, viewer)
            else:
                kept = "the log is written all the same" if self._path else "nothing is recorded"
                warnings.warn(f"{why_none(self._port)}; {kept}", UserWarning, stacklevel=2)
        self._open = True
        return self

    def __call__(self, step: Step) -> None:
        """Queue a copy of one step for each writer; this returns within microseconds."""
        if not self._open:
            raise DataError("the Recorder is not open; call it inside `with Recorder(...) as recorder:`")
        own = step if step.own else _copy(step)
        for writer in self._writers.values():
            writer.put(own)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what is queued, the metrics and the end, and close."""
        self._open = False
        kept = "the run went on"
        for name, writer in self._writers.items():  # the file comes first
            of_file = name == str(self._path)
            failure = writer.close(_PATIENCE_FILE if of_file else _PATIENCE_VIEWER)
            if failure is None:
                kept = f"the log {name} is complete" if of_file else kept
            elif of_file:
                warnings.warn(f"the recording to {name} is not complete: {failure}", UserWarning, stacklevel=2)
            else:
                closed = "was closed" if not is_up(self._port) else f"takes in nothing more ({failure})"
                warnings.warn(f"the viewer {closed} before the end; {kept}", UserWarning, stacklevel=2)
        self._writers = {}

    def _start_writer(self, path: Path | None, viewer: str | None) -> BackgroundWriter:
        writer = Writer(self._about, path=path, viewer=viewer, scene=self._scene, model=self._model, growing=True)
        return BackgroundWriter(self._about, writer)


_ARRAYS = ("y", "u", "reference", "x", "x_next", "y_next", "reference_next", "u_reference")


def _copy(step: Step) -> Step:
    """Return `step` with arrays of its own: a loop may write into its arrays again."""
    plan = step.plan
    kept = None if plan is None else Plan(_floats(plan.X), _floats(plan.U))
    own = {name: _floats(getattr(step, name)) for name in _ARRAYS}
    return Step(k=step.k, move=step.move, **own, look_ahead=None if kept is None else lambda: kept)


def _floats(values: Any) -> Any:
    return None if values is None else np.array(values, dtype=np.float64)
