"""Kernel EDMD: eigenvalues of the polynomial kernel are those of all monomials; landmarks bound the size."""

from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown

PLANT = km.black_box(
    lambda x, u: [x[0] + 0.1 * x[1], 0.95 * x[1] - 0.1 * np.sin(x[0]) + 0.1 * u[0]],
    dt=0.1,
    states=["a [m]", "b [m/s]"],
    inputs=["u"],
)


@pytest.fixture(scope="module")
def data() -> km.Episodes:
    return km.collect(PLANT, km.Uniform([-1.5, -1.5], [1.5, 1.5]), km.Noise(-1, 1), episodes=40, steps=15, rng=3)


def _matched(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest distance of an eigenvalue to the nearest expected one, and the other way round."""
    apart = np.abs(found[:, None] - expected)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_the_polynomial_kernel_has_the_eigenvalues_of_edmd_on_all_monomials(data, degree):
    monomials = km.State() + km.Monomials(degree) + km.Constant()
    full = km.edmd(data, monomials)
    for landmarks in (full.nz + 5, 10_000):
        kernel = km.identify.kernel_edmd(data, "polynomial", degree=degree, landmarks=landmarks)
        assert kernel.nz == full.nz
        assert _matched(kernel.eigenvalues, full.eigenvalues) < 1e-8
        U = np.random.default_rng(0).uniform(-1, 1, (10, 1))
        np.testing.assert_allclose(kernel.rollout([0.5, -0.2], U), full.rollout([0.5, -0.2], U), atol=1e-7)


def test_units_of_the_states_do_not_matter(data):
    large = km.Episodes([km.Episode(X=e.X * [1e3, 1e-3], U=e.U) for e in data], data.dt, data.states, data.inputs)
    one, other = (km.identify.kernel_edmd(d, "gaussian", landmarks=60, rank=20) for d in (data, large))
    assert _matched(one.eigenvalues, other.eigenvalues) < 1e-6


def test_without_inputs_it_is_the_matrix_of_williams_et_al():
    episodes = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(0, 0), episodes=30, steps=1, rng=1)
    free = km.Episodes([km.Episode(X=e.X) for e in episodes], episodes.dt, episodes.states)
    X, Y = (np.concatenate([e.X[k : len(e.X) - 1 + k] for e in free]) for k in (0, 1))
    mean, scale, width = X.mean(axis=0), X.std(axis=0), 1.5
    X, Y = (X - mean) / scale, (Y - mean) / scale

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-((a[:, None] - b) ** 2).sum(axis=2) / (2 * width**2))

    values, Q = np.linalg.eigh(k(X, X))
    Q, sigma = Q[:, -8:], np.sqrt(values[-8:])
    K = (Q / sigma).T @ k(Y, X) @ (Q / sigma)  # eq. 19 of their paper
    found = km.identify.kernel_edmd(free, "gaussian", width=width, rank=8)
    assert _matched(found.eigenvalues, np.linalg.eigvals(K)) < 1e-8


def test_more_landmarks_predict_better_and_a_controller_takes_the_model(data):
    held = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=10, steps=20, rng=9)

    def error(model: km.LinearPredictor) -> float:
        return float(np.mean([(model.rollout(e.X[0], e.U) - e.X) ** 2 for e in held]))

    models = [km.identify.kernel_edmd(data, landmarks=count, ridge=1e-10) for count in (6, 60)]
    assert models[0].nz == 6
    assert error(models[1]) < 0.1 * error(models[0])
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-1, u_max=1)
    run = km.simulate(
        PLANT,
        km.KoopmanMPC(models[1], cost, limits, horizon=20),
        x0=[1, 0],
        reference=[0, 0],
        steps=80,
        cost=cost,
        limits=limits,
    )
    assert np.abs(run.X[-1]).max() < 0.02


def test_files_and_data_in_memory_give_the_same_model_and_it_is_saved(data, tmp_path: Path):
    data.save(tmp_path / "data.npz")
    held, read = (
        km.identify.kernel_edmd(d, landmarks=40, rank=10) for d in (data, km.data.Files(tmp_path / "data.npz"))
    )
    np.testing.assert_allclose(held.A, read.A, atol=1e-9)
    held.save(tmp_path / "model.npz")
    again = km.load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(again.lift([0.3, 0.1]), held.lift([0.3, 0.1]))


def test_what_it_cannot_take_is_told():
    told = shown('show(lambda: km.identify.kernel_edmd(km.Episodes([km.Episode(X=np.ones((5, 2)))], 0.1), "cubic"))')
    assert told == ['DataError kernel is \'cubic\'; pass "polynomial" or "gaussian"']
    still = km.Episodes([km.Episode(X=np.ones((5, 2)))], 0.1)
    with pytest.raises(km.errors.DataError, match="all landmarks are the same state"):
        km.identify.kernel_edmd(still)


def test_a_stream_is_refused_because_it_is_read_twice(data: km.Episodes) -> None:
    with pytest.raises(km.errors.DataError, match="a stream is read once, and kernel_edmd needs it for its landmarks"):
        km.identify.kernel_edmd(km.data.Stream(iter([data])), landmarks=5)
