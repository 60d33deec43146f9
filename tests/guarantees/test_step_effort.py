"""The observed most of the solver's iterations: its probability is exact, and more samples never lower it."""

import numpy as np
import pytest
import scipy.signal

import koopmpc as km


def make_mpc():
    system = scipy.signal.dlti([[1.0, 0.3], [0.0, 1.0]], [[0.0], [0.3]], np.eye(2), np.zeros((2, 1)), dt=0.3)
    model = km.LinearPredictor.from_state_space(system)
    return km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=6)


def test_the_most_is_that_of_the_steps_and_is_exceeded_as_rarely_as_it_says():
    mpc = make_mpc()
    few, more = (km.guarantees.observe_iterations(mpc, (-2, 2), (-1, 1), samples=n) for n in (30, 150))
    assert 0 < few.most <= more.most  # the first steps of both are the same
    assert (1 - more.exceeded) ** 150 == pytest.approx(0.05)
    rng, over = np.random.default_rng(9), 0
    for _ in range(200):
        mpc.reset()
        over += mpc(rng.uniform(-2, 2, 2), rng.uniform(-1, 1, 2)).iterations > more.most
    assert over / 200 <= more.exceeded + 3 * np.sqrt(more.exceeded / 200)
    assert km.guarantees.observe_iterations(mpc, (0, 0), (0, 0), samples=3).most == 0
    assert "observed, not proved" in str(more)


def test_bad_boxes_are_errors():
    with pytest.raises(km.errors.DataError, match="low ≤ high"):
        km.guarantees.observe_iterations(make_mpc(), (1, -1), (0, 0))
    with pytest.raises(km.errors.DataError, match="confidence"):
        km.guarantees.observe_iterations(make_mpc(), (0, 1), (0, 0), confidence=2.0, samples=3)
