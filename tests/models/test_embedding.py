"""Predictors with an embedding: exact where the past determines the future, in every form that they have."""

from pathlib import Path

import numpy as np
import pytest

import koopmpc as km

# Two states, of which one is measured: y_{k+1} is a function of y_k, u_k, y_{k−1}, u_{k−1}, exactly.
A = np.array([[0.9, 0.3], [-0.2, 0.95]])
B = np.array([[0.1], [0.4]])


def hidden_state(seed: int, bilinear: bool = False) -> km.Episodes:
    rng = np.random.default_rng(seed)
    found: list[km.Episode] = []
    for _ in range(8):
        x, U = rng.standard_normal(2), rng.uniform(-1, 1, (25, 1))
        Y = [x[:1]]
        for u in U:
            x = A @ x + B @ u + (0.1 * u * x if bilinear else 0.0)
            Y.append(x[:1])
        found.append(km.Episode(X=Y, U=U))
    return km.Episodes(found, 0.1, ("y [m]",), ("u [N]",))


@pytest.fixture(scope="module")
def model() -> km.LinearPredictor:
    return km.edmd(hidden_state(0), km.State(), embedding=km.Delay(1))


def test_what_the_past_determines_is_predicted_exactly(model: km.LinearPredictor) -> None:
    for episode in hidden_state(1):
        history = km.Episode(X=episode.X[:4], U=episode.U[:3])
        X = model.rollout(episode.X[3], episode.U[3:], history=history)
        assert np.allclose(X, episode.X[3:], atol=1e-10)
    blind = km.edmd(hidden_state(0), km.State())
    assert np.abs(blind.rollout(episode.X[3], episode.U[3:]) - episode.X[3:]).max() > 1e-2
    assert model.states == ("y [m]",)
    assert model.C.shape == (1, 3)


def test_modes_and_eigenfunctions_are_those_of_points(model: km.LinearPredictor) -> None:
    data = hidden_state(2)
    assert km.spectrum.linearity_error(model, data).max() < 1e-6
    free = km.Episode(X=data[0].X[:2], U=data[0].U[:1])
    zeta = model.embed(km.Episodes([km.Episode(X=data[0].X, U=data[0].U)], 0.1, data.states, data.inputs))[0].X[0]
    times = 0.1 * np.arange(6)
    X = model.rollout(free.X[-1], np.zeros((5, 1)), history=free)
    assert np.allclose(km.spectrum.reconstruct(model, zeta, times), X, atol=1e-9)
    assert km.spectrum.amplitudes(model, zeta).shape == (model.nz,)
    with pytest.raises(km.errors.ShapeError, match=r"x has shape \(1,\), expected \(3,\)"):
        km.spectrum.reconstruct(model, free.X[-1], times)


def test_the_re_lifted_map_moves_the_whole_point(model: km.LinearPredictor) -> None:
    (episode,) = km.Delay(1)(hidden_state(1)[:1])
    step = model.step_map()
    assert step.states == ("y [m]", "u[k-1] [N]", "y[k-1] [m]")
    assert np.allclose(step.rollout(episode.X[0], episode.U), episode.X, atol=1e-10)


def test_a_bilinear_fit_takes_an_embedding(tmp_path: Path) -> None:
    data = km.Delay(1)(hidden_state(0, bilinear=True))
    by_hand = km.bilinear_edmd(data, km.State() + km.Constant())
    model = km.bilinear_edmd(hidden_state(0, bilinear=True), km.State() + km.Constant(), embedding=km.Delay(1))
    assert isinstance(model, km.BilinearPredictor)
    for mine, other in ((model.A, by_hand.A), (model.B, by_hand.B), (model.N, by_hand.N)):
        assert np.array_equal(mine, other)
    assert np.array_equal(model.C, by_hand.C[:1])
    episode = data[0]
    assert np.allclose(
        model.step_map().rollout(episode.X[0], episode.U), by_hand.step_map().rollout(episode.X[0], episode.U)
    )
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model


def test_a_file_holds_the_embedding(model: km.LinearPredictor, tmp_path: Path) -> None:
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model


def test_a_controller_keeps_the_history(model: km.LinearPredictor) -> None:
    """From y alone it does what the same model on measured ζ does, also where the plant got another input."""
    rng = np.random.default_rng(3)
    on_points = km.edmd(km.Delay(1)(hidden_state(0)), km.State())
    limits = km.Limits(u_min=-0.6, u_max=0.6)
    cost, whole = km.Cost(Q=[2.0], R=0.1, Q_N=[[3.0]]), km.Cost(Q=[2.0], R=0.1, Q_N=[[3.0]], of=km.State("y"))
    known = km.KoopmanMPC(
        on_points, km.Cost(Q=[2.0], R=0.1, Q_N=model.C.T @ model.C * 3.0, of=km.State("y")), limits, 15
    )
    kept = km.KoopmanMPC(model, cost, limits, 15)
    gains = km.LQR(model, cost, limits), km.LQR(on_points, whole, limits)
    for controller in (kept, known, *gains):
        controller.reset(u_prev=[0.2])
    x, y_before, got = np.array([1.0, -0.5]), None, np.array([0.2])
    for k in range(30):
        y = x[:1]
        zeta = np.concatenate([y, got, y if y_before is None else y_before])
        move = kept(y, [0.3], applied=got)
        assert np.allclose(move.u, known(zeta, [0.3], applied=got).u, atol=1e-5)
        assert np.allclose(gains[0](y, [0.3], applied=got).u, gains[1](zeta, [0.3], applied=got).u, atol=1e-9)
        got = move.u + (0.1 * rng.standard_normal(1) if k % 5 == 0 else 0.0)
        y_before, x = y, A @ x + B @ got
    assert abs(x[0] - 0.3) < 0.15


def test_a_missed_sample_costs_one_step_and_no_offset_is_left(model: km.LinearPredictor) -> None:
    mpc = km.KoopmanMPC(
        model, km.Cost(Q=[2.0], R=0.1), km.Limits(u_min=-1, u_max=1), 15, estimator=km.LiftedDisturbance(0.5)
    )
    x = np.array([1.0, -0.5])
    statuses = []
    for k in range(120):
        y = np.array([np.nan]) if k == 5 else x[:1]
        move = mpc(y, [0.3])
        statuses.append(move.status.name)
        x = A @ x + B @ (move.u + 0.2)  # a load that no data showed
    assert [k for k, status in enumerate(statuses) if status == "BAD_MEASUREMENT"] == [5]
    assert abs(x[0] - 0.3) < 1e-6


def test_refusals(model: km.LinearPredictor) -> None:
    past = km.Episode(X=np.ones((3, 1)), U=np.ones((2, 1)))
    with pytest.raises(km.errors.DataError, match="the predictor remembers 1 steps: pass history=Episode"):
        model.rollout([1.0], [[0.0]])
    with pytest.raises(km.errors.ShapeError, match="x has shape \\(3,\\), expected \\(1,\\) with a history"):
        model.lift([1.0, 1.0, 1.0], past)
    plain = km.edmd(hidden_state(0), km.State())
    with pytest.raises(km.errors.DataError, match="history was passed, but the predictor has no embedding"):
        plain.lift([1.0], past)
    assert np.array_equal(model.rest_point([2.0]), [2.0, 0.0, 2.0])
    assert np.array_equal(plain.rest_point([2.0]), [2.0])
