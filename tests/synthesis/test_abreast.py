"""Loops side by side: the same loops as one by one, whatever stands in for the plant, and starts nobody chose by."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import koopmpc as km
from koopmpc.codegen.compiled import Compiled
from koopmpc.synthesis.loops.abreast import Acting, speed_up
from koopmpc.synthesis.loops.fresh import run_fresh_loops
from koopmpc.synthesis.loops.neighbours import NeighbourMap
from koopmpc.synthesis.loops.pool import DrawnLoop, LoopPool
from koopmpc.synthesis.loops.surrogates import fit_surrogate
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.recipe import Recipe
from koopmpc.synthesis.task import check_task, goal_box
from tests.compiler import needs_compiler
from tests.synthesis.test_select import episodes_of

LIMITS = km.Limits(u_min=-1, u_max=1, x_max=[np.inf, 0.4])
LIFTING = km.State() + km.Constant()


def bent(x, u):
    return np.array([x[0] + 0.2 * x[1], 0.9 * x[1] + 0.3 * u[0] - 0.1 * np.sin(x[0])])


@cache
def make(*, bilinear=False, delays=0, moves=False, feedthrough=False):
    """Return a pool of loops and a controller of another model of the same logs."""
    data = episodes_of(bent, count=12, steps=40).with_inputs_advanced(int(feedthrough))
    embedding = km.Delay(delays) if delays else None
    candidate = Candidate("x, 1", LIFTING, embedding, bilinear).bind(data.states, data.inputs)
    rule = None if feedthrough else km.LiftedDisturbance()
    recipe = Recipe(candidate, 1e-6, estimator=rule, feedthrough=feedthrough)
    rows = np.column_stack([0.3 * np.sin(np.arange(150) / 5), np.zeros(150)]) if moves else [0.3, 0.0]
    task = check_task(data, km.Cost(Q=[1, 0.1], R=0.1), LIMITS, 8, rows, None, ())
    noise = np.array([0.01, 0.02])
    halves = [data.with_episodes(list(data)[i::2]) for i in (0, 1)]
    models = tuple(fit_surrogate(recipe, one, other, noise) for one, other in (halves, halves[::-1]))
    low, high = task.hull((), ())
    near = NeighbourMap.of(data, models[0].model.embedding, noise, feedthrough=feedthrough)
    pool = LoopPool(task, models, near, low, high)
    return pool, recipe.controller(recipe.fit(data), task.cost, LIMITS, 8)


@pytest.mark.parametrize("delays", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_loops_of_a_few_records_start_all_along_them_with_their_past(delays):
    """The first rows of two records are two states, and an interval from there holds nowhere else."""
    data = episodes_of(bent, count=2, steps=300)
    embedding = km.Delay(delays) if delays else None
    cost, rest = km.Cost(Q=[1, 0.1], R=0.1), [0.3, 0.0]
    task = check_task(data, cost, LIMITS, 8, rest, None, ())
    recipe = Recipe(Candidate("x, 1", LIFTING, embedding, False).bind(data.states, data.inputs), 1e-6)
    model = fit_surrogate(recipe, data, data, np.zeros(2))
    near = NeighbourMap.of(data, model.model.embedding, np.zeros(2))
    pool = LoopPool(task, (model,), near, *task.hull((), ()))
    loops = pool.draw(60, np.random.default_rng(0))
    starts = np.array([one.x0 for one in loops])
    low, high = goal_box(task)
    assert (np.ptp(starts, axis=0) > 0.7 * (high - low)).all()
    short = replace(pool, task=replace(task, steps=3))
    results = short.run(recipe.controller(recipe.fit(data), cost, LIMITS, 8), loops[:8])
    kept = [i for i, one in enumerate(results) if one.run is not None]
    assert len(kept) >= 4
    np.testing.assert_array_equal([results[i].run.X[0] for i in kept], starts[kept])
    for one in loops if delays else ():
        inputs = [u for e in data for u in e.U[:, 0]]
        assert np.isclose(inputs, one.past[2], rtol=0, atol=1e-12).any()  # u_{k-1} of a row, and no mean
    assert not check_task(data, cost, LIMITS, 8, rest, [0.1, 0.0], ()).along
    assert not make()[0].task.along


CASES = [
    {},
    pytest.param({"bilinear": True, "delays": 1, "moves": True}, marks=pytest.mark.slow),
    pytest.param({"delays": 2}, marks=pytest.mark.slow),
    pytest.param({"delays": 1, "feedthrough": True}, marks=pytest.mark.slow),
]


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_loops_side_by_side_are_the_loops_one_by_one(case):
    pool, controller = make(**case)
    fast, loops = speed_up(controller), pool.draw(24, np.random.default_rng(0))
    far = replace(pool, high=np.array([0.5, np.inf]))  # which some loops leave
    assert isinstance(fast, Compiled)
    for some in (pool, far):
        together, alone = some.run(fast, loops), some.run(controller, loops)
        machine = [some.run(fast, [loop])[0] for loop in loops]
        assert [one.run is None for one in together] == [one.run is None for one in alone]
        for one, single, slow in zip(together, machine, alone, strict=True):
            if one.run is not None:
                np.testing.assert_allclose(one.run.X, single.run.X, rtol=0, atol=1e-9)
                np.testing.assert_allclose(one.run.Y, slow.run.Y, rtol=0, atol=1e-6)
                np.testing.assert_allclose(one.run.U, slow.run.U, rtol=0, atol=1e-5)
                np.testing.assert_allclose(one.cost, slow.cost, rtol=1e-5)
                assert one.run.status == single.run.status
    lost = sum(one.run is None for one in far.run(fast, loops))
    assert 0 < lost < len(loops)


@needs_compiler
def test_controllers_abreast_are_controllers_alone_and_those_that_rest_do_not_move():
    controller = speed_up(make()[1])
    rng = np.random.default_rng(1)
    rows, x0 = rng.normal(size=(5, 30, 2)), rng.normal(size=(5, 2))
    fleet = controller.start_abreast(rows, x0)
    alone = [controller.__copy__() for _ in range(5)]
    for one, start in zip(alone, x0, strict=True):
        one.reset(start)
    for k in range(10):
        which = np.flatnonzero(rng.uniform(size=5) < 0.7) if k else np.arange(5)
        Y, before = rng.normal(size=(5, 2)), fleet.U.copy()
        U = fleet.step(k, Y, which)
        for e in range(5):
            if e in which:
                applied = before[e] if k else None
                np.testing.assert_array_equal(U[e], alone[e](Y[e], rows[e, k : k + 9], applied).u)
            else:
                np.testing.assert_array_equal(U[e], before[e])


def test_plants_of_nearest_rows_step_together_as_they_do_alone():
    near, rng = make()[0].neighbours, np.random.default_rng(0)
    many = near.draw_many([np.random.default_rng(seed) for seed in range(6)])
    Z, U, which = rng.uniform(-1, 1, (9, 2)), rng.uniform(-1, 1, (9, 1)), rng.integers(6, size=9)
    Z[4] = np.nan
    together = many.step(Z, U, which)
    for i, seed in enumerate(which):
        np.testing.assert_allclose(together[i], near.draw(np.random.default_rng(seed))(Z[i], U[i]), atol=1e-12)
    assert np.isnan(together[4]).all()
    assert np.isfinite(np.delete(together, 4, axis=0)).all()


def test_inputs_act_by_their_gain_and_as_late_as_drawn():
    acting, which = Acting(np.array([0.5]), np.array([1.0, 2.0]), np.array([0.0, 0.25])), np.arange(2)
    U, before = np.array([[1.0], [1.0]]), np.array([[0.0], [0.0]])
    np.testing.assert_allclose(acting.change(U, before, which), [[1.0], [0.5 + 2 * (0.75 - 0.5)]])
    np.testing.assert_allclose(acting.change(U, U, which), [[1.0], [1.5]])  # a constant input is not late
    np.testing.assert_array_equal(acting.take(1).change(U[1:], before[1:], np.zeros(1, int)), [[1.0]])


def test_a_late_input_and_a_gain_change_a_loop_and_its_seed_repeats_it():
    pool, controller = make()
    plain = DrawnLoop(np.array([0.2, 0.1]), -1, 1.0, 0, 7)
    one, again, late, weak = pool.run(controller, [plain, plain, plain._replace(late=0.5), plain._replace(gain=0.7)])
    assert one.cost == again.cost
    assert abs(late.cost / one.cost - 1) > 1e-4
    assert abs(weak.cost / one.cost - 1) > 1e-4


def test_a_stretch_of_a_reference_ends_with_the_rows_behind_it_in_view():
    """A loop of 20 steps is the first part of one of 30: no controller sees the reference rest where it goes on."""
    pool, controller = make(moves=True)
    assert pool.task.steps == 120  # and not three horizons of 8 steps
    loop = DrawnLoop(np.array([0.2, 0.1]), 0, 1.0, 5, 7)
    short, long = (
        replace(pool, task=replace(pool.task, steps=steps)).run(controller, [loop])[0].run for steps in (20, 30)
    )
    assert (short.steps, long.steps) == (20, 30)
    np.testing.assert_array_equal(short.U, long.U[:20])


def test_the_verdict_starts_where_no_choice_did_and_corners_stand_apart():
    pool, controller = make()
    fresh = run_fresh_loops(pool, controller, 12, np.random.default_rng(0))
    chosen = np.concatenate([pool.task.starts, pool.task.first_states])
    first, second = (np.array([one.x0 for one in pool.draw(12, np.random.default_rng(seed))]) for seed in (0, 1))
    for starts in (chosen, second):
        assert np.abs(first[:, None] - starts[None]).max(axis=2).min() > 1e-6
    assert (len(fresh.cost), len(fresh.corner_cost)) == (12, 4)
    alone = pool.run(controller, pool.draw(12, np.random.default_rng(0)))
    np.testing.assert_allclose(fresh.cost, [one.cost for one in alone])  # no corner among them
