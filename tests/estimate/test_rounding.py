"""Rounding decides nothing: readings that differ in their last bit are judged and learned from alike."""

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import needs_compiler
from tests.estimate.plants import linear

BIT = 2.0**-52


def test_what_is_learned_of_a_state_does_not_depend_on_the_rounding_of_one_that_rests():
    A, B = np.array([[0.9, 0.0], [0.0, 1.0]]), np.array([[0.3], [0.0]])
    model = linear(A, B)
    learned = []
    for size in (0.0, BIT):
        noise, bits = np.random.default_rng(1), np.random.default_rng(2)
        observer, x, u, d = km.LiftedDisturbance().start(model, 20), np.array([0.3, 5.0]), np.zeros(1), []
        for k in range(60):
            y = x * (1 + size * bits.integers(-1, 2, 2)) + [0.01 * noise.normal(), 0.0]
            observer.observe(y, u, np.zeros(0))
            d.append(observer.d.copy())
            u = np.array([np.sin(0.3 * k)])
            x = A @ x + B @ u + [0.05 * np.cos(0.2 * k), 0.0]
        learned.append(np.array(d))
    assert np.abs(learned[0]).max() > 0.01
    np.testing.assert_allclose(learned[1], learned[0], rtol=0, atol=1e-10)


@needs_compiler
@pytest.mark.parametrize("seed", range(4))
def test_c_refuses_and_learns_what_python_does_where_a_model_is_exact(seed):
    """No noise at all, and wild readings: every misfit is rounding, and differs between the two."""
    rng = np.random.default_rng(seed)
    A = np.array([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.0, 1.0]])
    B = np.array([[0.0], [0.1], [0.0]])
    model = linear(A, B)
    cost = km.Cost([1.0, 0.1, 0.0], 0.1)
    mpc = km.KoopmanMPC(model, cost, km.Limits(-1, 1), 15, solver="daqp", estimator=km.LiftedDisturbance())
    twin, refused = km.compiled(mpc), 0
    for _ in range(3):
        mpc.reset()
        twin.reset()
        x, u = np.append(rng.uniform(-1, 1, 2), 7.0), None
        for k in range(60):
            wild = rng.normal(size=3) * rng.choice([0.0, 3.0, 1e6], p=[0.86, 0.12, 0.02])
            goal = [np.sin(0.4 * (k // 20)), 0.0, 0.0]
            a, b = mpc(x + wild, goal, u), twin(x + wild, goal, u)
            assert (a.status, bool(a.refused)) == (b.status, bool(b.refused)), k
            np.testing.assert_allclose(b.u, a.u, rtol=0, atol=2e-6)
            refused += bool(a.refused)
            u = a.u
            x = A @ x + B @ u
    assert refused


def test_a_reading_is_believed_to_a_ten_thousandth_of_its_size_where_a_fit_left_no_residual():
    rng, A, B = np.random.default_rng(0), np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.5]])
    episodes = []
    for _ in range(5):
        X, U = [rng.normal(size=2) * [1.0, 100.0]], rng.normal(size=(30, 1))
        for u in U:
            X.append(A @ X[-1] + B @ u)
        episodes.append(km.Episode(X=np.array(X), U=U))
    model = km.edmd(km.Episodes(episodes, 0.1), km.State())
    assert model.report.residual.max() < 1e-6
    filtered = km.KoopmanMPC(model, km.Cost(Q=1, R=1), None, 5, estimator=km.LiftedKalman(list(model.states)))
    size = np.sqrt(np.mean(np.vstack([e.X[:-1] for e in episodes]) ** 2, axis=0))
    assert np.sqrt(np.diag(filtered.observer.program().R)) == pytest.approx(1e-4 * size)
