"""How long it takes to know whether to trust a model, and what the bands of a score cost."""

import time

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed

NX, HORIZON = 4, 40


def model_and_data(episodes: int, steps: int) -> tuple[km.LinearPredictor, km.Episodes]:
    """Return a predictor on 30 observables, and data of about its own motion."""
    rng = np.random.default_rng(0)
    lifting = km.State() + km.Gaussian(rng.uniform(-1, 1, (26, NX)), 1.0)
    states, inputs = tuple(f"x{i}" for i in range(NX)), ("u",)
    nz = lifting.bind(states).nz
    assert nz == 30
    A = 0.02 * rng.standard_normal((nz, nz))
    A[:NX, :NX] += 0.9 * np.linalg.qr(rng.standard_normal((NX, NX)))[0]
    C = np.eye(NX, nz)
    model = km.LinearPredictor(A, rng.standard_normal((nz, 1)), C, lifting, 0.05, states, inputs)
    runs = []
    for _ in range(episodes):
        U = 0.1 * rng.standard_normal((steps, 1))
        X = model.rollout(rng.uniform(-1, 1, NX), U)
        runs.append(km.Episode(X=X + 0.01 * rng.standard_normal(X.shape), U=U))
    return model, km.Episodes(runs, 0.05, states, inputs)


def test_trust_of_200_episodes_of_200_steps(benchmark) -> None:
    model, held_out = model_and_data(200, 200)
    report = benchmark.pedantic(km.trust, (model, held_out, HORIZON), rounds=3, warmup_rounds=1)
    benchmark.extra_info["observables"] = len(report.residuals.residuals)
    benchmark.extra_info["forecasts"] = report.score.starts


def test_trust_with_the_training_episodes(benchmark) -> None:
    model, held_out = model_and_data(200, 200)
    arguments = {"train": held_out}
    benchmark.pedantic(km.trust, (model, held_out, HORIZON), arguments, rounds=3, warmup_rounds=1)


def forecast(model: km.LinearPredictor, episode: km.Episode) -> np.ndarray:
    """Return x_{k+h} − C z_{k+h}, (horizon, starts, nx), from every start of an episode, in plain numpy."""
    starts = len(episode) - HORIZON + 1
    z, gap = model.lift(episode.X[:starts]), np.empty((HORIZON, starts, NX))
    for h in range(HORIZON):
        z = z @ model.A.T + episode.U[h : h + starts] @ model.B.T
        gap[h] = episode.X[h + 1 : h + 1 + starts] - z @ model.C.T
    return gap


def test_the_bands_of_a_score_beside_its_forecasts(benchmark) -> None:
    model, held_out = model_and_data(200, 200)
    sums = sum(np.sum(forecast(model, e) ** 2, axis=1) for e in held_out)
    starts = len(held_out) * (200 - HORIZON + 1)
    np.testing.assert_allclose(km.score(model, held_out, HORIZON).rmse, np.sqrt(sums / starts), rtol=1e-9)
    alone, whole = [], []
    for _ in range(5):
        begin = time.perf_counter()
        for episode in held_out:
            forecast(model, episode)
        alone.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        km.score(model, held_out, HORIZON)
        whole.append(time.perf_counter() - begin)
    benchmark.extra_info["score / forecasts"] = round(min(whole) / min(alone), 2)
    benchmark.pedantic(km.score, (model, held_out, HORIZON), rounds=3)


def test_asking_whether_a_state_was_seen(benchmark) -> None:
    model, held_out = model_and_data(20, 200)
    seen, x, u = km.validate.coverage(held_out).seen, held_out[0].X[0], held_out[0].U[0]
    assert benchmark(seen, x, u)
    assert model.nx == len(x)
