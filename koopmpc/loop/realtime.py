"""realtime: one controller on hardware, paced by a monotonic clock; late steps, a watchdog, SIGTERM.

`in_real_time` paces a simulated loop, to be watched.
"""

import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.control.function import ExcitationController, as_controller
from koopmpc.control.move import Controller, Move, Status
from koopmpc.data.excitation import Excitation
from koopmpc.loop.controllers import CONTROLLER, HOW, checked_input, start_for
from koopmpc.loop.rows import Step
from koopmpc.loop.signals import rows_ahead
from koopmpc.plants.plant import Plant, read_measurement, require_plant

Late = Literal["skip", "hold"]
_SPIN = 3e-4  # the last part of a wait keeps the processor busy, because a sleep ends up to 0.2 ms late [s]


@dataclass(eq=False)
class Paced:
    """What a real-time loop did.

    Attributes
    ----------
    steps
        Steps at which the plant got an input.
    late
        Steps that were not done when the next one was due.
    skipped
        Steps whose time passed while one before them was late: nothing was measured, and the plant kept its input.
    held
        Late steps whose input was not applied, with ``late="hold"``.
    ended
        Why the loop ended: "done", "SIGTERM", "SIGINT", "watchdog: …" or "plant: …".
    jitter
        By how much each of the last 100,000 steps began after its time [s].
    """

    steps: int = 0
    late: int = 0
    skipped: int = 0
    held: int = 0
    ended: str = "done"
    jitter: deque[float] = field(default_factory=lambda: deque(maxlen=100_000))

    def __str__(self) -> str:
        """Return all of it in two lines."""
        p50, p99 = np.quantile(self.jitter, [0.5, 0.99]) * 1e3 if self.jitter else (np.nan, np.nan)
        return (
            f"{self.steps} steps, {self.late} late, {self.skipped} skipped, {self.held} held; ended: {self.ended}\n"
            f"steps began {p50:.3f} ms after their time at the median, {p99:.3f} ms at the 99 % quantile"
        )


class _Stuck(BaseException):
    """Raised by the watchdog inside a call that does not return; no `except Exception` of a plant may catch it."""


class _Watchdog:
    """Sends the safe input if the loop does not report in time, from a thread of its own."""

    def __init__(self, plant: Plant, safe: Float[np.ndarray, " nu"], patience: float, *, main: bool) -> None:
        self.reason = ""
        self._plant, self._safe, self._patience, self._main = plant, safe, patience, main
        self.busy, self.seen = "", time.monotonic()  # what is called now, or ""; when the loop last waited
        self._delivered = False
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._watch, name="koopmpc-watchdog", daemon=True)
        self._thread.start()

    def may_act(self) -> bool:
        """Return whether the loop may call the plant's step: False once the watchdog has acted."""
        with self._lock:
            self.busy = "the plant"
            return not self.reason

    def interrupts(self) -> bool:
        """Return True while a call is under way that the watchdog has given up."""
        return bool(self.reason and self.busy)

    def close(self) -> str:
        """End the thread, give the plant its safe input unless it has it, and return why it could not get it."""
        self._end.set()
        self._thread.join(1.0)  # longest wait for the watchdog's thread at the end [s]
        return self._make_safe()

    def _watch(self) -> None:
        while not self._end.wait(self._patience / 8):
            with self._lock:
                if time.monotonic() - self.seen > self._patience:
                    self.reason = f"watchdog: {self.busy or 'the loop'} did not return within {self._patience:.3g} s"
                    self._make_safe()
            if self.reason:
                if self._main and hasattr(signal, "pthread_kill"):  # else the call has to return by itself
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                return

    def _make_safe(self) -> str:
        """Send the safe input by `stop(u)` where the plant has one, else by `step(u)` unless that is under way."""
        stop: Callable[[Any], object] | None = getattr(self._plant, "stop", None)
        if self._delivered or (stop is None and self.busy == "the plant"):
            return ""
        try:
            (stop or self._plant.step)(self._safe.copy())
        except Exception as error:  # a plant that is gone cannot be made safe; `ended` says so
            return f"; the safe input did not reach it: {type(error).__name__}: {error}"
        self._delivered = True
        return ""


def realtime(
    controller: Controller | Excitation | Callable[..., ArrayLike],
    plant: Plant,
    *,
    dt: float,
    reference: ArrayLike,
    steps: int | None = None,
    x0: ArrayLike | None = None,
    recorder: Callable[[Step], None] | None = None,
    late: Late = "skip",
    watchdog: float | None = None,
    safe: ArrayLike | None = None,
) -> Paced:
    """Give u_k = controller(y_k, r_k … r_{k+N}) to the plant every dt seconds of a monotonic clock.

    The loop ends after `steps`, on SIGTERM or Ctrl-C, when the plant raises, or when the watchdog has acted. The last
    thing that the plant gets is the safe input.

    Parameters
    ----------
    controller, plant
        As for `simulate`, excitations included, but plant.step(u) applies u and returns at once, with the newest
        measurement. Where the plant has read() → y, it is called when a step begins, so that no y is older than that,
        and step may return None.
        Where it has stop(u), that sends the safe input; it may be called from another thread while `step` waits.
    dt
        Time from step to step [s].
    reference
        (nr,) held throughout, or rows, of which row k belongs to the time k dt and the last is held.
    steps
        Time at which the loop ends, in steps; None: when a signal comes.
    x0
        Passed to plant.reset and controller.reset; None: the plant begins where it is.
    recorder
        An open `Recorder`, or any other observer, called once a step. The log of a Recorder is whole up to its last
        flush, 0.2 s ago, whatever kills this process. Steps that were skipped are in it, with y = NaN, the input that
        the plant kept, TIME_LIMIT and HOLD.
    late
        What becomes of a step that is not done when the next one is due. "skip": its input is applied all the same.
        "hold": its input is too old and is not applied; the plant keeps the one that it has. Either way, steps whose
        time has passed are left out, and the loop goes on at the next multiple of dt.
    watchdog
        Longest time for which controller, plant and recorder may not return [s]. Then the plant gets the safe input
        from another thread, and the call that does not return is interrupted. By default ten dt, and at least 0.2 s.
    safe
        (nu,) the safe input; zero by default.

    Returns
    -------
    paced
        Counts of steps, why the loop ended, and by how much steps began late.

    Raises
    ------
    DataError, ShapeError
        Sizes do not fit, or an argument is none of those above; the controller returned a u that is not finite. What
        the controller or the recorder raises is raised again, once the plant has got the safe input.
    """
    dt = checks.positive(dt, "dt", "s")
    require_plant(plant)
    controller = as_controller(controller, dt, len(plant.inputs))
    checks.members(controller, "the controller", CONTROLLER, HOW)
    if abs(dt - controller.dt) > 1e-12 * dt:
        raise DataError(f"the controller has dt = {controller.dt:g} s, the loop {dt:g} s; use one dt for both")
    if late not in get_args(Late):
        raise DataError(f'late is {late!r}; pass "skip" or "hold"')
    end = math.inf if steps is None else checks.count(steps, "steps")
    at_rest = checks.vector(0.0 if safe is None else safe, "safe", controller.nu)
    patience = max(10.0 * dt, 0.2) if watchdog is None else checks.positive(watchdog, "watchdog", "s")
    given = len(reference) if (reference := checks.array(reference, "reference")).ndim > 1 else 1
    rows = rows_ahead(reference, "reference", "nr", given, controller.horizon + 1, "n")
    rows.setflags(write=False)
    x0 = None if x0 is None else checks.array(x0, "x0", (None,))

    y = read_measurement(plant.reset(x0, np.random.default_rng(0)), None, 0)
    controller.reset(start_for(controller, x0))
    main = threading.current_thread() is threading.main_thread()
    dog = _Watchdog(plant, at_rest, patience, main=main)
    read, ahead = getattr(plant, "read", None), controller.horizon + 1
    loop = _Loop(controller, read, plant.step, recorder, rows, given - 1, ahead, dt, late == "hold", at_rest, dog, y)
    try:
        with _signals(dog, loop.told, main=main), _quick_switches():
            loop.run(end)
    finally:
        failure = dog.close()
    loop.paced.ended = (dog.reason or loop.failed or next(iter(loop.told), "done")) + failure
    return loop.paced


@dataclass(eq=False)
class _Loop:
    """The loop itself: what it drives, and where it is."""

    controller: Controller
    read: Callable[[], ArrayLike] | None
    give: Callable[[ArrayLike], ArrayLike | None]
    recorder: Callable[[Step], None] | None
    rows: Float[np.ndarray, "n nr"]
    last: int  # the row that is held at the end
    ahead: int  # rows that the controller reads
    dt: float
    hold: bool
    kept: Float[np.ndarray, " nu"]  # the input that the plant has, before the first step the safe one
    dog: _Watchdog
    y: Float[np.ndarray, " ny"]
    applied: Float[np.ndarray, " nu"] | None = None
    failed: str = ""
    told: list[str] = field(default_factory=list[str])  # signals that came
    paced: Paced = field(default_factory=Paced)

    def run(self, end: float) -> None:
        """Step until the end, a signal, the watchdog, or a failure of the plant."""
        k, begin = 0, time.monotonic()
        while k < end and self._wait(begin + k * self.dt) and self._step(k, begin + (k + 1) * self.dt):
            k += 1
            behind = time.monotonic() - begin - k * self.dt
            if behind > 0:
                self.paced.late += 1
                due = int(min(k + math.ceil(behind / self.dt), end))
                for passed in range(k, due):
                    self._skip(passed)
                k = due

    def _wait(self, due: float) -> bool:
        """Wait for a time; return False where a signal or the watchdog ends the loop before."""
        now, dog = time.monotonic, self.dog
        while not (self.told or dog.reason):
            dog.seen = moment = now()
            left = due - moment
            if left <= 0:
                self.paced.jitter.append(-left)
                return True
            if left > _SPIN:
                # longest sleep, after which signals and the watchdog are looked at [s]
                time.sleep(min(left - _SPIN, 0.05))
        return False

    def _step(self, k: int, deadline: float) -> bool:
        """Measure, ask the controller, give its input to the plant, and record; return False where the loop ends."""
        dog, row, y, read = self.dog, min(k, self.last), self.y, self.read
        try:
            if read is not None:
                dog.busy = "the plant"
                y = read_measurement(read(), len(y), k)
            dog.busy = "the controller"
            move = self.controller(y.copy(), self.rows[row : row + self.ahead], self.applied)
            u = checked_input(move, len(self.kept), k)
            if self.hold and time.monotonic() > deadline:
                u, self.paced.held = self.kept, self.paced.held + 1
            if not dog.may_act():
                return False
            answer = self.give(u.copy())
            y_next = None if read is not None and answer is None else read_measurement(answer, len(y), k + 1)
            dog.busy = "the recorder"
            if self.recorder is not None:
                self.recorder(Step(k, y, u, self.rows[row], move, None, None, y_next, self.rows[row + 1], own=True))
            dog.busy = ""
        except _Stuck:
            return False
        except KoopmpcError:
            raise
        except Exception as error:
            if dog.busy != "the plant":
                raise
            dog.busy = ""
            self.failed = f"plant: {type(error).__name__}: {error}"  # hardware that is gone, a closed connection
            return False
        self.y = y if y_next is None else y_next
        self.kept = self.applied = u
        self.paced.steps += 1
        return True

    def _skip(self, k: int) -> None:
        """Count and record a step whose time has passed: nothing was measured, and the plant kept its input."""
        self.paced.skipped += 1
        if isinstance(self.controller, ExcitationController):
            self.controller.skip()
        if self.recorder is not None:
            move = Move.hold(self.kept, Status.TIME_LIMIT)
            self.recorder(
                Step(k, np.full(len(self.y), np.nan), self.kept, self.rows[min(k, self.last)], move, own=True)
            )


def in_real_time(dt: float) -> Callable[[Step], None]:
    """Return an observer that lets `simulate` take as long as its plant would: step k ends k dt after step 0."""
    dt, begin = checks.positive(dt, "dt", "s"), math.nan

    def wait(step: Step) -> None:
        nonlocal begin
        if step.k == 0:
            begin = time.monotonic()
        time.sleep(max(0.0, begin + step.k * dt - time.monotonic()))

    return wait


@contextmanager
def _quick_switches() -> Generator[None]:
    """Let other threads give way to the loop soon."""
    before = sys.getswitchinterval()
    # a thread that writes a log gives way to the loop after so long; Python's own 5 ms delay steps [s]
    sys.setswitchinterval(min(before, 1e-4))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def _signals(dog: _Watchdog, told: list[str], *, main: bool) -> Generator[None]:
    """Note the names of SIGTERM and SIGINT, and interrupt a call that the watchdog has given up: in the main thread."""

    def end(number: int, frame: FrameType | None) -> None:
        if dog.interrupts():
            raise _Stuck
        if not dog.reason:
            told.append(signal.Signals(number).name)

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)} if main else {}
    try:
        for number in before:
            signal.signal(number, end)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
