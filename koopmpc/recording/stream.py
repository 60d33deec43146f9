"""Stream: one Writer behind a queue and a thread, so that what it waits for, nobody else waits for."""

from dataclasses import replace
from queue import Empty, SimpleQueue
from threading import Event, Thread

import numpy as np

from koopmpc.loop.simulate import Step
from koopmpc.recording.description import About
from koopmpc.recording.rows import Rows, rows_of_steps, run_of_rows
from koopmpc.recording.writer import Writer

_BATCH = 0.2  # time between two batches [s]
_NO_PLANS = np.empty((0, 0, 0))


class Stream:
    """Steps go into `put`, which returns at once; a thread writes them in batches until `close`."""

    def __init__(self, about: About, writer: Writer) -> None:
        self.queue: SimpleQueue[Step] = SimpleQueue()
        self.put = self.queue.put
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
        """Write batches until the end; after a failure nothing more is written, and `close` tells."""
        blocks: list[Rows] = []
        last: list[Step] = []  # held back, for the state that it led to may come with the end
        closing = False
        while not closing:
            closing = self._closing.wait(_BATCH)  # the thread wakes at its own pace, never at a step's
            steps = last + self._drained()
            if self._failure is not None:
                continue
            try:
                ready, last = (steps, []) if closing else (steps[:-1], steps[-1:])
                if ready:
                    rows = rows_of_steps(ready, len(self._about.states), end=closing)
                    blocks.append(replace(rows, planned=rows.planned[:0], plan_X=_NO_PLANS, plan_U=_NO_PLANS))
                    writer.write(rows)
                    writer.flush()
                if closing:
                    writer.end(run_of_rows(blocks, self._about))
            except Exception as error:  # whatever a scene, a disk or a viewer raises must not reach the loop
                self._failure = error

    def _drained(self) -> list[Step]:
        """Return all that is in the queue now."""
        steps: list[Step] = []
        while True:
            try:
                steps.append(self.queue.get_nowait())
            except Empty:
                return steps
