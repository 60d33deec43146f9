"""`km.compiled` behind the Controller protocol: copies, pickles, threads, mistakes, machines without a compiler."""

import copy
import pickle
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import koopmpc as km
from tests.codegen import plants

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


def test_a_pickle_goes_on_with_the_targets_that_it_knew():
    fast = km.compiled(km.BilinearMPC(plants.make_swung()[1], COST, km.Limits(-8.0, 8.0), 10))
    fast([0.5, 0.0], [0.1, 0.0])
    twin, other = pickle.loads(pickle.dumps(fast)), copy.copy(fast)
    for x in ([0.45, -0.1], [0.4, -0.2]):
        moves = [one(x, [0.1, 0.0]) for one in (fast, twin, other)]
        assert moves[0].u == moves[1].u == moves[2].u
    assert other([0.4, 0.0], [0.2, 0.0]).status is km.Status.UNCONSTRAINED


# limits that move in time, or come with a call

ROWS = np.random.default_rng(0).uniform(0.3, 1.2, (40, 2))


def compile_pair(limits):
    own = km.KoopmanMPC(plants.make_pair()[0], km.Cost(Q=[1, 0.5], R=0.05), limits, 6)
    return own, km.compiled(own)


def twins_of(fast):
    return copy.copy(fast), pickle.loads(pickle.dumps(fast))


def test_copies_go_on_at_the_same_row_of_limits():
    fast = compile_pair(km.Limits(u_min=-1, u_max=ROWS))[1]
    for _ in range(5):
        fast([1.0, -0.5], [1, 0])
    twins, u = twins_of(fast), fast([0.8, -0.5], [1, 0]).u
    for twin in twins:
        np.testing.assert_array_equal(twin([0.8, -0.5], [1, 0]).u, u)


def test_copies_forget_the_limits_of_a_call_as_the_original_does():
    fast = compile_pair(km.Limits(u_min=-1, u_max=1, rows=("x_max",)))[1]
    at_call = fast.limits.with_bounds(u_max=0.2)
    held = fast([1.0, -0.5], [0, 0], limits=at_call).u
    twin, same = pickle.loads(pickle.dumps((fast, at_call)))
    np.testing.assert_allclose(twin([1.0, -0.5], [0, 0], limits=same).u, held, atol=1e-9)
    fast.rehearse()
    twins, u = twins_of(fast), fast([1.0, -0.5], [1, 0]).u
    assert u.max() > 0.2
    for twin in twins:
        np.testing.assert_array_equal(twin([1.0, -0.5], [1, 0]).u, u)


def test_pages_of_limits_are_turned_where_one_ends_and_where_a_run_begins_again(monkeypatch):
    monkeypatch.setattr("koopmpc.codegen.compiled._PAGE", 7)
    own, fast = compile_pair(km.Limits(-ROWS, ROWS[::-1], x_max=[1.4, np.inf]))
    for _ in range(2):
        own.reset()
        fast.reset()
        for k in range(50):
            x = [np.cos(k), np.sin(k)]
            np.testing.assert_allclose(fast(x, [0.1, 0.0]).u, own(x, [0.1, 0.0]).u, atol=1e-6)
    one, other = own([0.1, 0.0], [0.0, 0.0]), pickle.loads(pickle.dumps(fast))([0.1, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(other.u, one.u, atol=1e-6)


def test_limits_of_a_call_that_are_refused_leave_nothing_behind():
    y, r, fast = [1.0, 0.0], [0.0, 0.0], compile_pair(km.Limits(-1, 1, rows=("u_max",)))[1]
    narrow, short = fast.limits.with_bounds(u_max=0.2), fast.limits.with_bounds(u_max=np.ones((2, 2)))
    used = fast(y, r, limits=narrow).u
    with pytest.raises(km.errors.ShapeError):
        fast(y, r, limits=short)
    with pytest.raises(km.errors.DataError, match="without a limit there"):
        fast(y, r, limits=fast.limits.with_bounds(du_max=0.1))
    with pytest.raises(km.errors.DataError, match="keeps its own"):
        compile_pair(km.Limits(-1, 1))[1](y, r, limits=narrow)
    np.testing.assert_allclose(copy.copy(fast)(y, r, limits=narrow).u, used, atol=1e-9)
