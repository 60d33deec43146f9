"""Two threads in one controller: a sentence, never corrupted memory."""

import copy
import sys
import threading
import time

import numpy as np
import pytest

import koopmpc as km
from tests.faults.test_controllers import BUILD, controllers, models  # noqa: F401  # fixtures


@pytest.fixture(autouse=True)
def _often():
    """Let threads take turns after a microsecond instead of 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


class Slow:
    """A measurement whose reading, inside the controller, lasts until another thread was told, at most a second."""

    def __init__(self, y, told, least):
        self._y, self._told, self._least = y, told, least

    def __array__(self, dtype=None, copy=None):
        before, end = len(self._told), time.monotonic() + 1.0
        while len(self._told) == before < self._least and time.monotonic() < end:
            time.sleep(1e-4)
        return self._y


@pytest.mark.parametrize("name", BUILD)
@pytest.mark.parametrize("least", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_threads_that_meet_in_a_controller_are_told_and_nothing_breaks(controllers, name, least):  # noqa: F811
    controller, _ = controllers[name]
    told, steps, failures = [], [], []  # lists, for two threads that count with += lose what one of them counted

    def work(seed):
        rng = np.random.default_rng(seed)
        while len(told) < least and len(steps) < 100 * least and not failures:
            try:
                y = rng.normal(size=2)
                move = controller(
                    Slow(y, told, least) if rng.random() < 0.05 else y, [0.0, 0.0]
                )  # most turns end anywhere
                steps.append(seed)
                if not np.isfinite(move.u).all():
                    failures.append(move)
                if rng.random() < 0.02:
                    controller.reset()
            except km.errors.ThreadError as error:
                told.append(seed)
                if "at once; give each thread a copy" not in str(error):
                    failures.append(error)
            except BaseException as error:
                failures.append(error)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert len(told) >= least
    controller.reset()
    assert np.isfinite(controller([0.1, 0.0], [0.0, 0.0]).u).all()  # it goes on as before


@pytest.mark.parametrize("name", ["lqr", "koopman-mpc", "bilinear-mpc"])
def test_each_thread_with_a_copy_of_its_own_gets_the_moves_of_one(controllers, name):  # noqa: F811
    controller, _ = controllers[name]
    points = np.random.default_rng(0).normal(size=(20, 2))

    def moves(each):
        each.reset()
        return [each(y, [0.0, 0.0]).u.copy() for y in points]

    alone = moves(copy.copy(controller))
    found, copies = {}, [copy.copy(controller) for _ in range(3)]
    threads = [
        threading.Thread(target=lambda i=i, each=each: found.update({i: moves(each)})) for i, each in enumerate(copies)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[i], alone) for i in range(3))


def test_a_controller_that_raised_lets_the_next_call_in(controllers):  # noqa: F811
    for controller, _ in controllers.values():
        controller.reset()
        with pytest.raises(km.errors.KoopmpcError):
            controller([0.0, 0.0, 0.0], [0.0, 0.0])
        assert np.isfinite(controller([0.1, 0.0], [0.0, 0.0]).u).all()
