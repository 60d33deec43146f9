"""Measured disturbances that multiply inputs: bilinear_edmd(scheduled_inputs=True) recovers M, and all readers use it."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

M = np.array([[[0.0, 0.3], [0.0, 0.0]], [[0.0, 0.0], [-0.02, 0.0]]])


@pytest.fixture(scope="module")
def plant():
    x, u, w = (ca.SX.sym(name, 2) for name in "xuw")
    first = 0.9 * x[0] + 0.1 * x[1] + 0.1 * w[0] * x[0] + 0.3 * u[1] * w[0]
    second = 0.9 * x[1] + 0.2 * u[0] * (1 - 0.1 * w[1]) + 0.05 * w[0] + 0.1 * u[1] * x[0]
    return km.StepMap(ca.Function("F", [x, u, w], [ca.vertcat(first, second)]), 0.1)


@pytest.fixture(scope="module")
def logs(plant):
    windy = km.Noise([-1, 4], [1, 6], hold=5)  # the second is far from zero
    return km.collect(
        plant, km.Uniform([-1, -1], [1, 1]), km.Noise([-1, -1], [1, 1]), episodes=30, steps=40, measured=windy
    )


@pytest.mark.parametrize("options", [{}, {"ridge": 1e-12}, {"products": ["x0"], "difference": True}, {"ridge": "gcv"}])
@pytest.mark.parametrize("lifting", [km.State(), km.State() + km.Constant()], ids=["linear", "affine"])
def test_an_exact_plant_is_recovered(logs, lifting, options):
    model = km.bilinear_edmd(logs, lifting, scheduled_inputs=True, **options)
    np.testing.assert_allclose(model.M[:, :2], M, atol=1e-9)
    episode = logs[3]
    np.testing.assert_allclose(model.rollout(episode.X[0], episode.U, episode.W), episode.X, atol=1e-9)
    assert model.is_scheduled


def test_scores_files_and_models_of_constant_w_know_the_products(logs, plant, tmp_path):
    model = km.bilinear_edmd(logs, km.State() + km.Constant(), scheduled_inputs=True)
    assert km.score(model, logs, 5).rmse.max() < 1e-10
    assert km.validate.residual_dmd(model, logs).residuals.max() < 1e-10
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model
    w, U = np.array([0.7, -1.3]), np.random.default_rng(0).normal(size=(10, 2))
    X = plant.at(w).rollout([0.2, 0.1], U)
    np.testing.assert_allclose(model.at(w).rollout([0.2, 0.1], U), X, atol=1e-9)
    np.testing.assert_allclose(model.step_map().rollout([0.2, 0.1], U, np.tile(w, (10, 1))), X, atol=1e-9)
    plain = km.bilinear_edmd(logs, km.State() + km.Constant())
    assert not plain.M.any()
    assert km.score(plain, logs, 5).rmse.max() > 0.02


def test_a_loop_of_the_learned_model_is_that_of_the_equations(logs, plant):
    """Both states are tracked, so that the equilibrium is one and the same for both."""
    cost, limits = km.Cost(Q=[1.0, 0.3], R=[0.01, 0.01], u_target="zero", tail=0), km.Limits(u_min=-2, u_max=2)
    model = km.bilinear_edmd(logs, km.State() + km.Constant(), scheduled_inputs=True)
    W = np.stack([np.sin(np.arange(40) / 5), 5 + np.cos(np.arange(40) / 3)], axis=1)
    runs = [
        km.simulate(plant, kind(each, cost, limits, 8), x0=[0.5, 0], reference=[0.3, 0.1], steps=40, measured=W)
        for kind in (km.BilinearMPC, km.NonlinearMPC)
        for each in (plant, model)
    ]
    np.testing.assert_allclose(runs[1].X, runs[0].X, atol=1e-3)
    np.testing.assert_allclose(runs[3].X, runs[2].X, atol=1e-4)


def test_what_cannot_be_multiplied_is_refused(logs):
    without = km.Episodes([km.Episode(X=e.X, U=e.U) for e in logs], logs.dt)
    for data, options in ((without, {}), (logs, {"rank": 2})):
        with pytest.raises(km.errors.DataError, match="scheduled_inputs multiply inputs by measured disturbances"):
            km.bilinear_edmd(data, km.State(), scheduled_inputs=True, **options)
    model = km.bilinear_edmd(logs, km.State())
    with pytest.raises(km.errors.ShapeError, match="M has shape"):
        km.BilinearPredictor(
            model.A, model.B, model.N, model.C, km.State(), 0.1, ["a", "b"], ["u", "v"], E=model.E, M=np.eye(2)
        )
