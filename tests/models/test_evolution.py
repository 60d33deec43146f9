"""φ(x_k) = λᵏ φ(x₀) over whole episodes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km


def rolled(F, x0, steps, dt=0.1):
    X = [np.asarray(x0, float)]
    for _ in range(steps):
        X.append(F(X[-1]))
    return km.Episodes([km.Episode(X=np.array(X))], dt)


@given(st.floats(0.2, 1.0), st.floats(0.1, 3.0), st.integers(2, 40))
def test_it_is_zero_on_an_invariant_subspace(rho, turn, steps):
    A = rho * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    data = rolled(lambda x: A @ x, [1.0, 0.3], steps)
    model = km.LinearPredictor(A, np.zeros((2, 0)), np.eye(2), km.State(), 0.1, data.states, ())
    assert km.spectrum.evolution_error(model, data).max() < 1e-9


def test_it_is_zero_on_the_slow_manifold():
    data = rolled(lambda x: np.array([0.9 * x[0], 0.5 * x[1] + 0.31 * x[0] ** 2]), [1.0, -0.7], 30)
    model = km.edmd(data, km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0²"]))
    assert km.spectrum.evolution_error(model, data).max() < 1e-9


def test_one_step_is_the_linearity_check_and_more_steps_add_up():
    def pendulum(x):
        return np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0])])

    data = rolled(pendulum, [1.0, 0.0], 60)
    model = km.dmd(data)
    by_hand = model.eigenfunctions(data[0].X)
    promised = model.eigenvalues ** np.arange(61)[:, None] * by_hand[0]
    expected = np.linalg.norm(by_hand - promised, axis=0) / np.linalg.norm(by_hand, axis=0)
    np.testing.assert_allclose(km.spectrum.evolution_error(model, data), expected, rtol=1e-12)
    assert (km.spectrum.evolution_error(model, data) > km.spectrum.linearity_error(model, data)).all()


def test_refusals():
    data = rolled(lambda x: 0.5 * x, [1.0, 1.0], 5)
    driven = km.LinearPredictor(0.5 * np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), 0.1, data.states, ("u0",))
    with pytest.raises(km.errors.DataError, match=r"the predictor has inputs, .* pass an autonomous fit"):
        km.spectrum.evolution_error(driven, data)
    free = km.LinearPredictor(np.diag([0.5, 0.4]), np.zeros((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    with pytest.raises(km.errors.ShapeError, match="the episodes have states"):
        km.spectrum.evolution_error(free, data)
    still = km.Episodes([km.Episode(X=[[1.0, 0.0], [0.5, 0.0]])], 0.1, ("a", "b"))
    with pytest.raises(km.errors.DataError, match=r"eigenfunction 1 is 0 in all snapshots"):
        km.spectrum.evolution_error(free, still)
