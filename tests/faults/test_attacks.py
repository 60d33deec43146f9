"""What a sensor can do to an estimate: stuck readings, readings that are lost and return, wild ones into what learns online."""

from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import koopmpc as km
from tests.compiler import needs_compiler
from tests.estimate.plants import linear
from tests.estimate.test_readings import LIMITS, MORE, PERIODIC, burst, loop, plant_for
from tests.faults.test_glitches import PLANT, online, pairs, worst
from tests.tiers import slow

STEPS, BAD, LENGTH = 130, 45, 12


@cache
def build(kind):
    return MORE[kind]()


def attacked(kind, attack, seed=1):
    """A loop whose readings k = 45 to 56 are attack(y, the last good y); X, U."""
    controller, plant = build(kind), plant_for(kind)
    rng = np.random.default_rng(seed)
    x, reference, noise = rng.uniform(-0.6, 0.6, 2), [rng.uniform(-0.5, 0.5), 0], 1e-3 * rng.normal(size=(STEPS, 2))
    controller.reset(x)
    X, U, last = [x], [], x
    for k in range(STEPS):
        y = x + noise[k]
        if BAD <= k < BAD + LENGTH:
            y = attack(y, last)
        else:
            last = y
        move = controller(y, reference)
        x = plant(x, move.u)
        X.append(x)
        U.append(move.u)
    return np.array(X), np.array(U)


ATTACKS = {
    "stuck": lambda y, last: last,
    "one stuck": lambda y, last: np.array([last[0], y[1]]),
    "lost": lambda y, last: np.full(2, np.nan),
    "one lost": lambda y, last: np.array([np.nan, y[1]]),
}


@pytest.mark.parametrize("attack", ["stuck", "lost", *slow(["one stuck", "one lost"])])
@pytest.mark.parametrize("kind", MORE)
def test_a_loop_is_where_it_would_be_some_time_after_readings_that_were_stuck_or_lost(kind, attack):
    X, _ = attacked(kind, lambda y, last: y)
    X_a, U_a = attacked(kind, ATTACKS[attack])
    low, high = LIMITS.inputs(1)
    assert np.isfinite(U_a).all()
    assert ((low <= U_a) & (high >= U_a)).all()
    share = (
        (0.03 if kind == PERIODIC else 0.01) if "lost" in attack else 0.1
    )  # what is stuck is believed for as long as the plant could stand still
    assert (np.abs(X_a - X)[-20:] <= share * np.ptp(X, axis=0)).all()


@pytest.mark.parametrize("length", [1, 5])
@pytest.mark.parametrize("size", [50.0, 1e6, 1e29])
def test_what_learns_online_learns_no_wild_reading_and_counts_each(size, length):
    learner, twin = online(), online()
    for k, (x, u, x_next) in enumerate(pairs(PLANT, 400)):
        wild = 300 <= k < 300 + length
        learner.learn(x, u, x_next + size * wild)
        if not wild:
            twin.learn(x, u, x_next)
    assert (learner.outliers, twin.outliers) == (length, 0)
    assert worst(learner.predictor(), PLANT) == pytest.approx(worst(twin.predictor(), PLANT), rel=0.2)


@pytest.mark.parametrize("kind", MORE)
def test_smaller_wild_readings_from_the_first_step_on_are_left_behind(kind):
    """Off by hundreds of steps of the plant, not by the 1e4 that make a reading absurd; equal ones agree with each other."""
    controller, plant = build(kind), plant_for(kind)
    X = loop(controller, 1, plant=plant, steps=90)[0]
    filters = [(np.full((1, 2), 50.0), 1), (np.full((5, 2), 1000.0), 1), (burst(50.0, 5, 1), 0)]
    others = [(np.full((1, 2), 50.0), 0), (np.full((5, 2), 50.0), 0)]
    for wild, at in filters if "filter" in kind else others:
        away = np.abs(loop(controller, 1, wild, plant, 90, at)[0] - X) / np.ptp(X, axis=0)
        assert (away[-15:] <= (0.2 if kind == PERIODIC else 0.1)).all(), (wild[0], len(wild), at)


@needs_compiler
@pytest.mark.parametrize("at", [0, 1, 4])
def test_machine_code_leaves_the_first_wild_readings_behind_as_python_does(at):
    python, plant = build("KoopmanMPC, filter"), plant_for("KoopmanMPC, filter")
    c = km.compiled(python)
    for wild in (np.full((1, 2), 50.0), np.full((5, 2), 1000.0), np.array([[50.0, 50.0], [np.nan, 0.1]])):
        X, U, *_ = loop(python, 1, wild, plant, 60, at)
        X_c, U_c, *_ = loop(c, 1, wild, plant, 60, at)
        np.testing.assert_allclose(U_c, U, rtol=0, atol=1e-6)
        np.testing.assert_allclose(X_c, X, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", MORE)
def test_a_plant_that_truly_starts_far_away_is_followed_at_once(kind):
    """It moves far in its first steps, and the model errs: no reading is refused, and the estimate is beside it."""
    controller, plant = build(kind), plant_for(kind)
    observer = getattr(controller, "observer", None)
    for x in ([1.2, 3.0], [-1.2, 2.0]):
        controller.reset()
        for k in range(20):
            move = controller(x, [0.0, 0.0])
            assert not move.refused
            if observer is not None and k >= 4:
                np.testing.assert_allclose(observer.z[:2], x, atol=0.5)
            x = plant(x, move.u)


@pytest.mark.filterwarnings("ignore:.* gaps? .* cut ")
@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("order", ["two swapped", "one late", "some twice"])
def test_rows_out_of_order_are_told_and_no_pair_spans_them(tmp_path, kind, order):
    t, x, u = 0.1 * np.arange(60), np.zeros(60), np.random.default_rng(0).normal(size=60)
    for k in range(59):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k]
    rows = {
        "two swapped": [*range(30), 31, 30, *range(32, 60)],
        "one late": [*range(20), *range(21, 40), 20, *range(40, 60)],
        "some twice": [*range(40), *range(20, 60)],
    }[order]
    table, file = np.stack([t, x, u], axis=1)[rows], tmp_path / f"log.{kind}"
    if kind == "csv":
        np.savetxt(file, table, delimiter=",", header="t,x,u", comments="")
    else:
        pq.write_table(pa.table(dict(zip(("t", "x", "u"), table.T, strict=True))), file)
    with pytest.warns(km.FitWarning, match="the clock is set back 1 times, before row .*; an episode ends there"):
        read = km.load_episodes(file)
    learned = km.OnlineEDMD.start(read, km.State(), forgetting=0.99)
    assert learned.outliers == 0
    np.testing.assert_allclose(np.hstack([learned.predictor().A, learned.predictor().B]), [[0.9, 0.1]], atol=1e-9)


def test_a_period_is_kept_through_lost_readings_while_the_load_drifts():
    """A load of one harmonic on a ramp."""
    A, B, period = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]]), 20
    learns = km.LiftedDisturbance(period=period * 0.1)
    mpc = km.KoopmanMPC(linear(A, B, [0.0, 0.0]), km.Cost(Q=[1.0, 0.0], R=0.01), km.Limits(-5, 5), 20, estimator=learns)

    def errors(lost):
        mpc.reset()
        x, away = np.zeros(2), []
        for k in range(200):
            u = mpc(np.full(2, np.nan) if lost and 120 <= k < 124 else x, [0.5, 0.0]).u
            x = A @ x + B @ u + [0.0, 0.05 * np.sin(2 * np.pi * k / period) + 1e-4 * k]
            away.append(abs(x[0] - 0.5))
        return np.array(away)

    whole, holed = errors(False), errors(True)
    assert 0 < whole[-40:].max() < 0.02
    assert holed[-40:].max() <= 1.1 * whole[-40:].max()
