import numpy as np
import pytest

import koopmpc as km


def unstable_model():
    A, B = np.array([[1.1, 0.1], [0.0, 1.05]]), np.array([[0.0], [0.1]])
    return km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("x", "v"), ("u",))


def unstable(N=25, **options):
    """Return a controller of an unstable plant whose limits are active, and a state from where it works hard."""
    return km.KoopmanMPC(unstable_model(), km.Cost(Q=[1, 1], R=1e-3), km.Limits(-1, 1), N, **options), [0.2, 0.1]


def test_a_deadline_that_is_over_is_reported_and_the_input_stays_inside():
    mpc, x = unstable(time_limit=1e-9)
    for _ in range(5):
        move = mpc(x, [0, 0])
        assert move.status is km.Status.TIME_LIMIT
        assert np.abs(move.u).max() <= 1
        assert move.solve_time > 1e-9


def test_an_answer_that_is_late_is_used_and_says_so():
    mpc, _ = unstable(time_limit=1e-9)
    free, _ = unstable()
    x = [1e-3, 0.0]
    late, timely = mpc(x, [0, 0]), free(x, [0, 0])
    assert timely.status is km.Status.UNCONSTRAINED
    assert late.status is km.Status.TIME_LIMIT
    assert late.fallback is km.control.Fallback.NONE
    np.testing.assert_array_equal(late.u, timely.u)


def test_a_long_deadline_changes_nothing():
    mpc, x = unstable(time_limit=60)
    free, _ = unstable()
    np.testing.assert_array_equal(mpc(x, [0, 0]).u, free(x, [0, 0]).u)


def test_every_step_of_a_short_deadline_is_in_time_or_reported():
    mpc, x = unstable(N=100, time_limit=1e-3)
    rng = np.random.default_rng(0)
    for _ in range(50):
        move = mpc(x + 0.05 * rng.normal(size=2), [0, 0])
        assert move.solve_time <= 1e-3 or move.status is km.Status.TIME_LIMIT


@pytest.mark.parametrize("limit", [0, -1.0])
def test_a_deadline_must_be_above_zero(limit):
    with pytest.raises(km.errors.DataError, match="time_limit is"):
        unstable(time_limit=limit)


@pytest.mark.parametrize("solver", ["ipopt", "sqpmethod"])
def test_a_nonlinear_step_ends_after_the_iteration_in_which_its_time_is_over_and_takes_no_other_start(solver):
    asked = unstable_model().step_map(), km.Cost(Q=[1, 1], R=1e-3), km.Limits(-1, 1), 25
    free = km.NonlinearMPC(*asked, solver=km.control.NLP(solver, starts=3))([0.2, 0.1], [0, 0])
    late = km.NonlinearMPC(*asked, solver=km.control.NLP(solver, starts=3), time_limit=1e-9)([0.2, 0.1], [0, 0])
    assert late.status is km.Status.TIME_LIMIT
    assert late.iterations <= 1 < free.iterations
    assert np.abs(late.u).max() <= 1


def test_a_nonlinear_controller_with_much_time_gives_the_same_input():
    x = [0.2, 0.1]
    asked = unstable_model().step_map(), km.Cost(Q=[1, 1], R=1e-3), km.Limits(-1, 1), 25
    for solver in ("ipopt", "sqpmethod"):
        timed = km.NonlinearMPC(*asked, solver=solver, time_limit=60.0)
        np.testing.assert_array_equal(timed(x, [0, 0]).u, km.NonlinearMPC(*asked, solver=solver)(x, [0, 0]).u)
        assert timed(x, [0, 0]).status is km.Status.OPTIMAL
