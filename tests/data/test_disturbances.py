"""Measured disturbances in the data, in files, in the fit, and in the predictor."""

import numpy as np
import pytest

import koopmpc as km

A, B, E = np.array([[0.9, 0.1], [-0.2, 0.8]]), np.array([[0.0], [0.1]]), np.array([[0.3, 0.0], [0.1, -0.2]])


def data(episodes=6, steps=15, seed=0):
    rng = np.random.default_rng(seed)
    runs = []
    for _ in range(episodes):
        X, U, W = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 1)), rng.normal(size=(steps, 2))
        for k in range(steps):
            X[k + 1] = A @ X[k] + B @ U[k] + E @ W[k]
        runs.append(km.Episode(X=X, U=U, W=W))
    return km.Episodes(runs, 0.1, ("a", "b"), ("u",), ("load [N]", "wind [m/s]"))


def test_edmd_identifies_the_effect_of_measured_disturbances():
    episodes = data()
    model = km.edmd(episodes, km.State() + km.Constant())
    np.testing.assert_allclose(model.A[:2, :2], A, atol=1e-12)
    np.testing.assert_allclose(model.B[:2], B, atol=1e-12)
    np.testing.assert_allclose(model.E[:2], E, atol=1e-12)
    assert (model.nu, model.nw) == (1, 2)
    assert (model.inputs, model.disturbances) == (("u",), ("load [N]", "wind [m/s]"))
    held_out = data(seed=1)
    for episode in held_out:
        np.testing.assert_allclose(model.rollout(episode.X[0], episode.U, episode.W), episode.X, atol=1e-10)
    assert km.score(model, held_out, 10).total < 1e-10
    np.testing.assert_allclose(km.spectrum.linearity_error(model, held_out), 0.0, atol=1e-10)
    blind = km.LinearPredictor(model.A, model.B, model.C, model.lifting, 0.1, model.states, model.inputs)
    assert blind.nw == 0
    assert km.score(blind, held_out, 10).total > 0.1
    zero = np.zeros((15, 2))
    np.testing.assert_array_equal(model.rollout([1, 0], episode.U, zero), model.rollout([1, 0], episode.U))


def test_a_reduced_fit_keeps_the_disturbances():
    model = km.edmd(data(), km.State() + km.Monomials(2), rank=4)
    assert model.E.shape == (4, 2)


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_files_keep_the_disturbances_and_their_names(tmp_path, suffix):
    episodes, path = data(), tmp_path / f"data{suffix}"
    episodes.save(path)
    assert km.load_episodes(path) == episodes
    half = episodes[:3]
    assert half.disturbances == episodes.disturbances
    assert half + episodes[3:] == episodes
    assert all(part.nw == 2 for part in episodes.split(0.5))
    model = km.edmd(episodes, km.State())
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model


def test_an_episode_without_disturbances_has_none():
    assert km.Episode(X=np.zeros((4, 2)), U=np.zeros((3, 1))).W.shape == (3, 0)
