"""How long it takes to know whether to trust a model, and what the bands of a score cost."""

import time

import numpy as np
import pytest

import koopmpc as km
from koopmpc.validate.scoring import forecast_errors

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


def test_the_bands_of_a_score_beside_its_forecasts(benchmark) -> None:
    model, held_out = model_and_data(200, 200)
    starts = [np.arange(len(e) - HORIZON + 1) for e in held_out]
    alone, whole = [], []
    for _ in range(5):
        begin = time.perf_counter()
        for _ in forecast_errors(model, held_out, starts, HORIZON):
            pass
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
