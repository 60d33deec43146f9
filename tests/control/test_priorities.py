"""Priorities of soft limits: a limit gives way no further than it would without those below it."""

from itertools import product

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import avoid_compiling

STATES, INPUTS = ("a", "b", "c"), ("u [V]",)


def draw(seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3))
    A *= rng.uniform(0.7, 1.05) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.standard_normal((3, 1))
    model = km.LinearPredictor(A, B, np.eye(3), km.State().bind(STATES), 0.1, STATES, INPUTS)
    high = rng.uniform(0.1, 0.8, 3)
    return model, km.Cost(Q=rng.uniform(0.1, 1, 3), R=0.1), high, 2 * rng.standard_normal(3)


def violations(mpc, model, x, high):
    """By how much the plan breaks the limit of each state, added over its steps."""
    X = [x]
    for u in mpc.plan().U:
        X.append(model.A @ X[-1] + model.B @ u)
    return np.maximum(np.array(X[1:]) - high, 0).sum(axis=0)


def solve(model, cost, x, high, names, **more):
    limits = km.Limits(
        u_min=-1, u_max=1, x_max={name: high[STATES.index(name)] for name in names}, **{"slack": (1e3, 0), **more}
    )
    mpc = km.KoopmanMPC(model, cost, limits, 8)
    move = mpc(x, np.zeros(3))
    return violations(mpc, model, x, high), move, mpc


@pytest.mark.parametrize("seed", range(12))
def test_a_limit_gives_way_as_far_as_if_those_below_it_were_not_there(seed):
    model, cost, high, x = draw(seed)
    order = {"b": 2, "a": 1}
    both = solve(model, cost, x, high, ("b", "a", "c"), priority=order)[0]
    for kept, alone in ((("b",), [1]), (("b", "a"), [1, 0])):
        fewer = solve(model, cost, x, high, kept, **({"priority": {"b": 2, "a": 1}} if len(kept) > 1 else {}))[0]
        np.testing.assert_allclose(both[alone], fewer[alone], atol=1e-4)


def test_the_more_important_limit_wins_whatever_the_weights_are():
    model, cost, high, x = next(
        case for case in map(draw, range(100)) if min(solve(*case[:2], case[3], case[2], ("a", "b"))[0][:2]) > 0.1
    )
    weights = ([1e5, 1e3, 1e4], [0, 0, 0])
    by_a = solve(model, cost, x, high, ("a", "b"), slack=weights, priority={"a": 1})[0]
    by_b, move, mpc = solve(model, cost, x, high, ("a", "b"), slack=weights, priority={"b": 1})
    weighed = solve(model, cost, x, high, ("a", "b"), slack=weights)[0]
    assert by_b[1] < weighed[1] - 1e-3
    assert by_a[0] <= weighed[0] + 1e-6
    assert move.status is km.Status.SOFTENED
    assert move.slack > 0
    mpc.reset()
    np.testing.assert_array_equal(mpc(x, np.zeros(3)).u, move.u)


def test_priorities_change_nothing_where_no_limit_gives_way():
    model, cost, _, x = draw(0)
    high = np.full(3, 50.0)
    plain = solve(model, cost, x, high, STATES)[1]
    ranked = solve(model, cost, x, high, STATES, priority=[3, 1, 2])[1]
    np.testing.assert_array_equal(plain.u, ranked.u)
    assert ranked.status is plain.status


def test_random_loops_with_priorities_keep_their_inputs():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        model, cost, high, x = draw(seed)
        limits = km.Limits(u_min=-1, u_max=1, du_max=0.6, x_max=high, priority=rng.integers(0, 3, 3))
        mpc = km.KoopmanMPC(model, cost, limits, int(rng.integers(1, 10)), time_limit=0.1 if seed % 3 else 1e-4)
        last = np.zeros(1)
        for _ in range(12):
            move = mpc(x, np.zeros(3))
            assert np.abs(move.u).max() <= 1
            assert np.abs(move.u - last).max() <= 0.6 + 1e-9
            last, x = move.u, np.clip(model.A @ x + model.B @ move.u + 0.1 * rng.standard_normal(3), -1e3, 1e3)


def test_saved_controllers_keep_their_priorities(tmp_path):
    model, cost, high, x = draw(1)
    mpc = solve(model, cost, x, high, STATES, priority={"b": 2})[2]
    mpc.save(tmp_path / "mpc.npz")
    twin = km.load_controller(tmp_path / "mpc.npz")
    mpc.reset()
    np.testing.assert_array_equal(twin(x, np.zeros(3)).u, mpc(x, np.zeros(3)).u)


REFUSED = {
    "priority names 'd'": {"priority": {"d": 1}},
    "one number for each of a, b, c": {"priority": [1, 2]},
    "c has priority 2 and no limit": {"priority": {"c": 2}, "x_max": [1.0, 1.0, np.inf]},
    "c has priority 1 and no limit": {"priority": [0, 2, 1], "x_max": [1.0, 1.0, np.inf]},
    "pass whole numbers": {"priority": [0.5, 0, 0]},
    "the limit of b is hard and has priority 2": {"priority": {"b": 2}, "slack": None},
}


@pytest.mark.parametrize("said", REFUSED)
def test_priorities_that_cannot_be_are_refused(said):
    model, cost, *_ = draw(0)
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
        km.KoopmanMPC(model, cost, km.Limits(u_min=-1, u_max=1, **({"x_max": 1.0} | REFUSED[said])), 5)


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_where_weights_stand_for_priorities_plans_are_those_of_a_qp_for_each(kind, monkeypatch):
    """On linear models, of which KoopmanMPC solves the priorities one after the other."""
    avoid_compiling(monkeypatch)
    gave_way = 0
    for seed in range(6):
        model, cost, high, x = draw(seed)
        limits = km.Limits(u_min=-1, u_max=1, x_max=high, priority={"b": 2, "a": 1})
        exact, weighed = km.KoopmanMPC(model, cost, limits, 8), kind(model, cost, limits, 8)
        moves = [mpc(x, np.zeros(3)) for mpc in (exact, weighed)]
        np.testing.assert_allclose(moves[1].u, moves[0].u, atol=1e-4)
        assert (
            violations(weighed, model, x, high)[:2] <= violations(exact, model, x, high)[:2] + np.array([1e-4, 1e-5])
        ).all()
        gave_way += moves[0].slack > 0
    assert gave_way > 3


def test_beside_levels_the_more_important_limit_wins_as_in_an_enumeration():
    levels = [-1.0, 0.0, 1.0]
    for seed in range(6):
        model, cost, high, x = draw(seed)
        limits = km.Limits(u_min=-1, u_max=1, x_max=high, priority={"b": 2}, levels=[levels])
        mpc = km.KoopmanMPC(model, cost, limits, 4)
        mpc(x, np.zeros(3))
        least = np.inf
        for U in product(levels, repeat=4):
            X = [x]
            for u in U:
                X.append(model.A @ X[-1] + model.B[:, 0] * u)
            least = min(least, np.maximum(np.array(X[1:])[:, 1] - high[1], 0).sum())
        assert violations(mpc, model, x, high)[1] <= least + 1e-6


def test_others_say_that_they_know_no_priority():
    model, cost, *_ = draw(0)
    limits = km.Limits(x_max=1.0, priority={"b": 2})
    four = km.Limits(x_max=1.0, of=km.State("a"), y_max=1.0, priority=[0, 1, 2, 3])
    for act, said in (
        (lambda: km.KoopmanMPC(model, cost, limits, 5, solver="osqp"), 'need "daqp"'),
        (lambda: km.BilinearMPC(model, cost, four, 5), "4 priorities, 0, 1, 2, 3, and a BilinearMPC can tell 3 apart"),
    ):
        with pytest.raises(km.errors.DataError, match=said):
            act()
