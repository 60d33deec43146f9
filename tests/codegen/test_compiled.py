"""`km.compiled` behind the Controller protocol: copies, pickles, threads, mistakes, machines without a compiler."""

import copy
import pickle
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import Told

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
LIMITS = km.Limits(u_min=-25.0, u_max=25.0)


@pytest.fixture(scope="module")
def controller(pendulum):
    return km.KoopmanMPC(pendulum[1], COST, LIMITS, 15, solver="daqp", latency=1)


@pytest.fixture(scope="module")
def fast(controller):
    return km.compiled(controller)


def answers(controller, states):
    return np.array([controller(x, [0.0, 0.0]).u for x in states])


def states(count=40):
    return np.random.default_rng(5).uniform(-1.5, 1.5, (count, 2))


def test_it_is_a_controller(fast, controller):
    assert isinstance(fast, km.control.Controller)
    assert (fast.dt, fast.nu, fast.horizon) == (controller.dt, controller.nu, controller.horizon)
    assert km.compiled(fast) is fast


def test_a_copy_and_a_pickle_go_on_from_the_same_state_and_share_nothing(fast):
    fast.reset()
    answers(fast, states(7))
    twins = [copy.copy(fast), copy.deepcopy(fast), pickle.loads(pickle.dumps(fast))]
    expected = answers(fast, states())
    for twin in twins:
        assert np.array_equal(answers(twin, states()), expected)


def test_reset_makes_a_run_repeat_to_the_bit(fast):
    fast.reset(u_prev=[3.0])
    first = answers(fast, states())
    fast.reset(u_prev=[3.0])
    assert np.array_equal(answers(fast, states()), first)


def test_every_thread_with_a_copy_of_its_own_gets_its_own_answers(fast):
    fast.reset()
    rows = [states() + 0.01 * i for i in range(4)]
    alone = [answers(copy.copy(fast), each) for each in rows]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda each: answers(copy.copy(fast), each), rows))
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one, other)


def test_one_that_is_entered_twice_says_so(fast):
    held = fast._token.pop()
    try:
        with pytest.raises(km.errors.ThreadError, match="give each thread a copy"):
            fast([0.0, 0.0], [0.0, 0.0])
    finally:
        fast._token.append(held)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (([0.0], [0.0, 0.0]), r"y has shape \(1,\), expected \(2,\)"),
        (([0.0, 0.0], [0.0]), r"reference has shape \(1,\), expected \(2,\)"),
        (([0.0, 0.0], [0.0, 0.0], [1.0, 2.0]), r"applied has shape \(2,\), expected \(1,\)"),
        (([0.0, 0.0], [0.0, 0.0], None, [1.0]), "the predictor has no E"),
    ],
)
def test_wrong_arguments_are_told_as_the_original_tells_them(fast, controller, arguments, match):
    for one in (fast, controller):
        with pytest.raises((km.errors.ShapeError, km.errors.DataError), match=match.replace("y has", ".*y has")):
            one(*arguments)
    fast.reset()
    assert fast([0.0, 0.0], [0.0, 0.0]).status is km.Status.UNCONSTRAINED


def test_without_a_compiler_it_stays_in_python_and_says_so_once(controller, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CC", "")
    with pytest.warns(UserWarning, match="no C compiler was found") as said:
        assert km.compiled(controller) is controller
    assert len(said) == 1


def test_a_compiler_that_hangs_is_not_waited_for_twice(controller, monkeypatch):
    asked = []

    def hang(_, command, *__, **___):
        asked.append(command)
        raise subprocess.TimeoutExpired(command, 900)

    monkeypatch.setattr("koopmpc.codegen.compiled.load_library", hang)
    with pytest.warns(UserWarning, match="timed out after 900 seconds"):
        assert km.compiled(controller) is controller
    assert len(asked) == 1


def test_a_compiler_that_fails_shows_its_first_error(controller, monkeypatch, tmp_path):
    script = tmp_path / "cc"
    script.write_text("#!/bin/sh\necho 'step.c:1:2: error: no such thing' >&2\necho 'error: second' >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.warns(UserWarning, match=r"step.c:1:2: error: no such thing$"):
        assert km.compiled(controller) is controller


def test_what_cannot_be_written_in_c_says_which_part_and_what_would_do(pendulum):
    plant, model = pendulum
    nonlinear = km.NonlinearMPC(plant, COST, LIMITS, 5)
    with pytest.raises(km.errors.DataError, match=r"a NonlinearMPC cannot be exported: .*; export a KoopmanMPC"):
        km.compiled(nonlinear)
    late = km.KoopmanMPC(model, COST, LIMITS, 5, time_limit=0.01)
    with pytest.raises(km.errors.DataError, match=r"time_limit, and C has no clock.*iter_limit"):
        km.compiled(late)


def test_an_estimator_of_ones_own_is_refused_by_name(pendulum):
    mine = km.KoopmanMPC(pendulum[1], COST, LIMITS, 5, estimator=Told([0.0] * pendulum[1].nz))
    with pytest.raises(km.errors.DataError, match="the estimator Told cannot be written in C; use"):
        km.compiled(mine)


@pytest.mark.parametrize("kind", ["linear", "staged"])
def test_a_rehearsal_changes_nothing(fast, pendulum, kind):
    one = fast if kind == "linear" else km.compiled(km.BilinearMPC(pendulum[0], COST, LIMITS, 6))
    one.reset()
    one.rehearse()
    first, twin = answers(one, states(5)), copy.copy(one)
    for _ in range(2):
        one.rehearse()
    assert np.array_equal(one.plan().U, twin.plan().U)
    assert np.array_equal(answers(one, states()), answers(twin, states()))
    assert len(first) == 5


def test_copies_that_meet_other_rows_keep_the_targets_of_their_own(pendulum):
    """Copies share a table of targets, which grows while they step."""
    first, reference = km.BilinearMPC(pendulum[0], COST, LIMITS, 8), np.zeros((9, 2))
    loops = [(km.compiled(first), first)]
    loops.append((copy.copy(loops[0][0]), copy.copy(first)))
    for k in range(12):
        for sign, (fast, slow) in zip((1.0, -1.0), loops, strict=True):
            reference[:, 0] = 0.02 * sign * (k + np.arange(9))
            np.testing.assert_allclose(fast([0.1, 0.0], reference).u, slow([0.1, 0.0], reference).u, atol=1e-4)
