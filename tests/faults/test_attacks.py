"""What a sensor can do to an estimate: stuck readings, readings that are lost and return, wild ones into what learns online."""

from functools import cache

import numpy as np
import pytest

import koopmpc as km
from tests.estimate.test_readings import KINDS, LIMITS, PROBLEM, TRUE, WHOLE, model
from tests.faults.test_glitches import PLANT, online, pairs, worst
from tests.tiers import slow

EXTENDED = "BilinearMPC, extended filter"
BUILDS = KINDS | {
    EXTENDED: lambda: km.BilinearMPC(model("bilinear"), WHOLE, LIMITS, 20, estimator=km.ExtendedKalman()),
}
STEPS, BAD, LENGTH = 130, 45, 12


@cache
def build(kind):
    return BUILDS[kind]()


def attacked(kind, attack, seed=1):
    """A loop whose readings k = 45 to 56 are attack(y, the last good y); X, U."""
    controller = build(kind)
    plant = km.discretize(PROBLEM.dynamics, PROBLEM.dt) if kind in ("LQR, delays", EXTENDED) else TRUE
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
@pytest.mark.parametrize("kind", BUILDS)
def test_a_loop_is_where_it_would_be_some_time_after_readings_that_were_stuck_or_lost(kind, attack):
    X, _ = attacked(kind, lambda y, last: y)
    X_a, U_a = attacked(kind, ATTACKS[attack])
    low, high = LIMITS.inputs(1)
    assert np.isfinite(U_a).all()
    assert ((low <= U_a) & (high >= U_a)).all()
    share = 0.01 if "lost" in attack else 0.1  # what is stuck is believed for as long as the plant could stand still
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
