"""The recursion by roots of P: the same law, in coordinates in which the plain one loses all digits."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.riccati import Stage, one_step, recursion, rooted


def stage_of(rng, nx, nu, rate=False):
    """Return a random stage with known signals; its plant is unstable."""
    A = rng.standard_normal((nx, nx))
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    weights = np.eye(nx), np.eye(nu), 0.3 * np.eye(nu) if rate else None
    plain = one_step(A, rng.standard_normal((nx, nu)), *weights)
    n = len(plain.Q)
    signals = {"e": (n, 3), "q": (n, 3), "r": (nu, 3)}
    return plain._replace(**{name: rng.standard_normal(shape) for name, shape in signals.items()})


def moved(stage, T):
    """Return the stage in coordinates T x."""
    back = np.linalg.inv(T)
    M = None if stage.M is None else back.T @ stage.M
    A, B, Q = T @ stage.A @ back, T @ stage.B, back.T @ stage.Q @ back
    return Stage(A, B, 0.5 * (Q + Q.T), M, stage.R, T @ stage.e, back.T @ stage.q, stage.r)


@pytest.mark.parametrize(("nx", "nu", "rate"), [(1, 1, False), (4, 2, False), (4, 2, True), (12, 3, True)])
def test_roots_find_the_law_of_the_plain_recursion(nx, nu, rate):
    stage = stage_of(np.random.default_rng(nx), nx, nu, rate)
    for one, other in zip(
        recursion([stage] * 15, stage.Q, stage.q), rooted([stage] * 15, stage.Q, stage.q), strict=True
    ):
        assert other == pytest.approx(one, rel=1e-9, abs=1e-9 * np.abs(one).max())


@pytest.mark.parametrize(("condition", "accuracy"), [(1e3, 1e-7), (1e5, 1e-6), (1e7, 1e-2)])
def test_a_change_of_coordinates_that_makes_a_large_changes_no_input(condition, accuracy):
    rng = np.random.default_rng(1)
    stage = stage_of(rng, 8, 2, rate=True)
    n = len(stage.Q)
    T = np.linalg.qr(rng.standard_normal((n, n)))[0] * np.logspace(0, -np.log10(condition), n)
    T = T @ np.linalg.qr(rng.standard_normal((n, n)))[0]
    other = moved(stage, T)
    one, found = recursion([stage] * 20, stage.Q, stage.q), recursion([other] * 20, other.Q, other.q)
    assert np.abs(found.K @ T - one.K).max() < accuracy * np.abs(one.K).max()
    assert np.abs(found.v - one.v).max() < accuracy * np.abs(one.v).max()


@pytest.mark.parametrize("seed", range(5))
def test_a_valid_cost_is_never_refused_because_of_the_model(seed):
    """‖A‖ = 1e8 on observables that are almost dependent: P of the plain recursion is indefinite."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((10, 10))
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    T = np.linalg.qr(rng.standard_normal((10, 10)))[0] * np.logspace(0, -9.7, 10)
    T = T @ np.linalg.qr(rng.standard_normal((10, 10)))[0]
    back = np.linalg.inv(T)
    lifting, scale = km.State() + km.Monomials(10), np.linalg.qr(T.T, mode="r")
    model = km.LinearPredictor(
        T @ A @ back,
        T @ rng.standard_normal((10, 1)),
        np.eye(1, 10),
        lifting,
        0.1,
        ("x",),
        ("u",),
        scale=scale,
    )
    assert np.linalg.norm(model.A) > 1e7
    cost = km.Cost(Q=1.0, R=1.0, u_target="zero")
    for controller in (
        km.KoopmanMPC(model, cost, km.Limits(u_min=-1, u_max=1), horizon=20),
        km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0, u_target="zero", tail=20), None, horizon=20),
    ):
        assert np.isfinite(controller([0.3], [0.0]).u).all()


def test_an_input_that_costs_nothing_is_refused_in_any_units():
    for unit in (1e-9, 1.0, 1e9):
        stage = Stage(np.eye(2), unit * np.array([[1.0, 1.0], [0.0, 0.0]]), np.eye(2), None, np.zeros((2, 2)))
        with pytest.raises(km.errors.DefinitenessError, match="raise R"):
            rooted([stage] * 3, stage.Q, np.zeros((2, 1)))
