"""A real-time loop on a clock of its own, on which every step lasts as long as the test says: no step is left to chance."""

import itertools
import math
import os
import signal
import time

import numpy as np
import pytest

import koopmpc as km
from tests.loop.test_realtime import Counting, Here

DT = 0.1
REAL_SLEEP = time.sleep


class Clock:
    """A clock that moves by a microsecond when it is read, and by what is slept or spent."""

    def __init__(self):
        self.now, self.slept, self.on_sleep = 5000.0, [], None

    def monotonic(self):
        self.now += 1e-6
        return self.now

    def sleep(self, seconds):
        assert seconds >= 0
        self.slept.append(seconds)
        self.now += seconds
        if self.on_sleep is not None:
            self.on_sleep()


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    monkeypatch.setattr(time, "sleep", clock.sleep)
    return clock


class Spending(Counting):
    """u = 1, 2, 3, …; call n takes `spent[n]` seconds of the clock, others a hundredth of a step."""

    def __init__(self, clock, spent):
        super().__init__(DT)
        self.clock, self.spent, self.began, self.applied = clock, spent, [], []

    def __call__(self, y, reference, applied=None, w=None):
        self.began.append(self.clock.now)
        self.applied.append(None if applied is None else float(applied[0]))
        self.clock.now += self.spent.get(self.calls, 0.01 * DT)
        return super().__call__(y, reference)


def expected(spent, steps, hold):
    """Return the steps that are done, with those of them that are late, and the inputs that the plant gets."""
    k, call, t, done, late, given = 0, 0, 0.0, [], [], []
    while k < steps:
        t = max(t, k * DT) + spent.get(call, 0.01 * DT)
        call += 1
        done.append(k)
        in_time = t <= (k + 1) * DT
        given.append(float(call) if in_time or not hold else (given[-1] if given else 0.0))
        if not in_time:
            late.append(k)
        k = k + 1 if in_time else min(math.ceil(t / DT), steps)
    return done, late, given


@pytest.mark.parametrize("late", ["skip", "hold"])
@pytest.mark.parametrize(
    "spent", [{}, {2: 1.3 * DT}, {0: 2.5 * DT, 3: 0.9 * DT, 4: 1.2 * DT}, {1: 4.5 * DT, 2: 1.5 * DT}, {5: 9.0 * DT}]
)
def test_each_step_begins_at_a_multiple_of_dt_and_those_whose_time_has_passed_are_left_out(clock, late, spent):
    plant, seen = Here(DT), []
    controller = Spending(clock, spent)
    begin = clock.now
    rows = [[1.0 * k] for k in range(6)]
    paced = km.realtime(
        controller, plant, dt=DT, reference=rows, steps=9, late=late, recorder=seen.append, watchdog=1e6, safe=-3.0
    )
    done, behind, given = expected(spent, 9, late == "hold")
    given = [-3.0 if value == 0.0 else value for value in given]
    assert [round((t - begin) / DT, 2) for t in controller.began] == done
    assert plant.got == [*given, -3.0]
    assert (paced.steps, paced.skipped) == (len(done), 9 - len(done))
    assert (paced.late, paced.held) == (len(behind), len(behind) if late == "hold" else 0)
    assert paced.ended == "done"
    assert len(paced.jitter) == len(done)
    assert max(paced.jitter) < 1e-4
    assert min(paced.jitter) >= 0
    assert max(clock.slept, default=0.0) <= 0.05
    assert controller.applied == [None, *given[:-1]]
    assert [step.k for step in seen] == list(range(9))
    inputs = dict(zip(done, given, strict=True))
    for step in seen:
        assert step.reference[0] == min(step.k, 5)
        if step.k in inputs:
            count = done.index(step.k)
            assert step.u[0] == inputs[step.k]
            assert step.y[0] == count
            assert step.y_next[0] == count + 1
            assert step.reference_next[0] == min(step.k + 1, 5)
            assert controller.ahead[count] == [min(step.k + i, 5) for i in range(4)]
        else:
            assert np.isnan(step.y).all()
            assert step.u[0] == inputs[max(k for k in done if k < step.k)]
            assert step.move.status is km.Status.TIME_LIMIT
            assert step.move.fallback is km.control.Fallback.HOLD


def test_a_signal_ends_the_loop_before_the_next_step(clock):
    plant, naps = Here(DT), itertools.count()
    clock.on_sleep = lambda: os.kill(os.getpid(), signal.SIGTERM) if next(naps) == 4 else None
    paced = km.realtime(Spending(clock, {}), plant, dt=DT, reference=[0.0], watchdog=1e6)
    assert paced.ended == "SIGTERM"
    assert plant.got == [*map(float, range(1, paced.steps + 1)), 0.0]
    assert 1 <= paced.steps <= 4
    assert len(clock.slept) == 5  # none after the signal


def test_a_measurement_that_step_gives_back_is_used_unless_the_plant_is_read(clock):
    class Both(Here):
        def read(self):
            return [50.0 + len(self.got)]

        def step(self, u):
            super().step(u)
            return None if len(self.got) % 2 else [70.0]

    seen = []
    km.realtime(Spending(clock, {}), Both(DT), dt=DT, reference=[0.0], steps=4, recorder=seen.append, watchdog=1e6)
    assert [step.y[0] for step in seen] == [50.0, 51.0, 52.0, 53.0]
    assert [None if step.y_next is None else step.y_next[0] for step in seen] == [None, 70.0, None, 70.0]


class Stuck(Counting):
    """A controller that lasts `spent` seconds of the clock, and on the machine until it is given up or `most` [s]."""

    def __init__(self, clock, dt, spent, most):
        super().__init__(dt)
        self.clock, self.spent, self.most = clock, spent, most

    def __call__(self, y, reference, applied=None, w=None):
        self.clock.now += self.spent
        for _ in range(round(self.most / 5e-3)):
            REAL_SLEEP(5e-3)
        return super().__call__(y, reference)


@pytest.mark.parametrize(("dt", "given", "patience"), [(DT, None, 1.0), (DT, 0.7, 0.7), (0.01, None, 0.2)])
def test_the_watchdog_waits_ten_steps_and_a_fifth_of_a_second_at_least_unless_it_is_told(clock, dt, given, patience):
    for spent, most, ended in (
        (0.99 * patience, 0.2 * patience, "done"),  # it looks up each eighth of its patience
        (1.01 * patience, 20.0, f"watchdog: the controller did not return within {patience:.3g} s"),
    ):
        controller = Stuck(clock, dt, spent, most)
        paced = km.realtime(controller, Here(dt), dt=dt, reference=[0.0], steps=1, watchdog=given)
        assert paced.ended == ended
        assert paced.steps == (ended == "done")


def test_a_simulated_loop_takes_as_long_as_its_plant_would(clock):
    """Step k ends k dt after step 0, also where one before it took longer."""
    plant = km.LinearPredictor(np.eye(1), np.eye(1), np.eye(1), km.State(), DT, ("x",), ("u",)).step_map()
    ends, pace = [], km.loop.in_real_time(DT)

    def step(at):
        clock.now += 2.5 * DT if at.k == 3 else 0.2 * DT
        pace(at)
        ends.append(clock.now)

    controller = km.LQR(km.LinearPredictor.local(plant, [0], [0]), km.Cost(1, 1))
    km.simulate(plant, controller, x0=[1], reference=[0], steps=8, observers=[step])
    assert [round((end - ends[0]) / DT, 2) for end in ends] == [0, 1, 2, 4.5, 4.7, 5, 6, 7]
