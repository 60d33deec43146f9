"""The pace of outputs: the time constant of a lag, in rows, whatever units, origin and order of the outputs."""

import numpy as np
import pytest
from scipy.signal import lfilter

import koopmpc as km
from koopmpc.data.pace import find_pace


def lag(tau, seed=0, rows=20_000):
    """Return a first-order lag of time constant τ rows that white noise drives."""
    return lfilter([1], [1, -np.exp(-1 / tau)], np.random.default_rng(seed).standard_normal(rows))


def records(*outputs, dt=0.1):
    X = np.column_stack(outputs)
    return km.Episodes([km.Episode(X=X, U=np.zeros((len(X) - 1, 1)))], dt)


@pytest.mark.parametrize("tau", [5, 20, 80])
def test_the_pace_of_a_lag_is_its_time_constant(tau):
    y = lag(tau)
    pace = find_pace(records(y))
    assert pace == pytest.approx(tau, rel=0.25)
    assert find_pace(records(y[::2])) == pytest.approx(tau / 2, rel=0.3)  # half of the rows, the same time
    assert find_pace(records(1e6 * y + 5)) == pace
    assert find_pace(records(lag(4 * tau, 1), y)) == pace  # the faster output says it
    assert find_pace(records(y, np.ones(len(y)))) == pace  # one that does not move says nothing


def test_outputs_that_forget_nothing_have_a_quarter_of_the_record():
    assert find_pace(records(np.linspace(0, 1, 401))) == 100
    assert find_pace(records(np.zeros(401))) == 100
