"""A Smoother: its estimate is least squares over the whole episode, and what it finds is the noise that was added."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import Pendulum
from tests.searches import select


def noisy(clean: km.Episodes, share: float, seed: int = 0) -> km.Episodes:
    """Return the episodes with white noise of this share of each state's spread."""
    draw, size = np.random.default_rng(seed), share * spread(clean)
    return clean.with_episodes(
        [km.Episode(X=e.X + size * draw.standard_normal(e.X.shape), U=e.U, W=e.W) for e in clean]
    )


def spread(data: km.Episodes) -> np.ndarray:
    return np.concatenate([e.X for e in data]).std(axis=0)


def error(found: km.Episodes, clean: km.Episodes) -> np.ndarray:
    """Return the root-mean-square error of each state, relative to its spread."""
    gaps = np.concatenate([a.X - b.X for a, b in zip(found, clean, strict=True)])
    return np.sqrt(np.mean(gaps**2, axis=0)) / spread(clean)


def pendulum_data(episodes: int = 40, steps: int = 30) -> km.Episodes:
    plant = km.discretize(Pendulum(), dt=0.05)
    return km.collect(plant, km.Uniform([-2, -3], [2, 3]), km.Noise(-3, 3, hold=2), episodes=episodes, steps=steps)


def linear_data(rng: np.random.Generator, nx: int, process: float = 0.0) -> km.Episodes:
    """Return runs of a random oscillating linear plant with eigenvalues of size 0.8 to 1.02."""
    sizes = rng.uniform(0.8, 1.02, nx)
    axes = rng.standard_normal((nx, nx)) + 2 * np.eye(nx)
    A = axes @ np.diag(sizes) @ np.linalg.inv(axes)
    B = rng.standard_normal((nx, 1))
    episodes: list[km.Episode] = []
    for _ in range(40):
        X, U = np.zeros((41, nx)), rng.uniform(-1, 1, (40, 1))
        X[0] = rng.standard_normal(nx)
        for k in range(40):
            X[k + 1] = A @ X[k] + B @ U[k] + process * rng.standard_normal(nx)
        episodes.append(km.Episode(X=X, U=U))
    return km.Episodes(episodes, 0.1)


@pytest.mark.parametrize("delays", [0, 1, 2])
def test_the_estimate_is_the_least_squares_of_all_measurements(delays: int) -> None:
    """It minimises all squared errors of measurements, of steps and of the start, each over its variance."""
    rng, nx, nu, T = np.random.default_rng(delays), 2, 1, 9
    N, d = nx * (delays + 1), delays
    A = 0.4 * rng.standard_normal((d + 1, nx, nx))
    B, c = rng.standard_normal((d + 1, nx, nu)), rng.standard_normal(nx)
    root, start_root = rng.standard_normal((nx, nx)), rng.standard_normal((N, N))
    mean, scale = rng.standard_normal(nx + nu), np.exp(rng.standard_normal(nx + nu))
    noise = np.array([0.3, 0.7])
    smoother = km.data.Smoother(
        noise=noise * scale[:nx],
        missed=np.ones(nx),
        delays=d,
        products=False,
        gains=np.vstack([*(a.T for a in A), *(b.T for b in B), c]),
        spread=root @ root.T,
        start=np.zeros(N),
        start_spread=start_root @ start_root.T,
        mean=mean,
        scale=scale,
    )
    Y, U = rng.standard_normal((T + 1, nx)), rng.standard_normal((T, nu))
    rows: list[np.ndarray] = []
    right: list[np.ndarray] = []

    def add(weight: np.ndarray, blocks: dict[int, np.ndarray], value: np.ndarray) -> None:
        row = np.zeros((len(value), (T + 1) * nx))
        for k, block in blocks.items():
            row[:, k * nx : (k + 1) * nx] += block
        rows.append(weight @ row)
        right.append(weight @ value)

    for k in range(T + 1):
        add(np.diag(1 / noise), {k: np.eye(nx)}, Y[k])
    for k in range(d, T):
        push = sum((B[j] @ U[k - j] for j in range(d + 1)), c)
        add(np.linalg.inv(root), {k + 1: np.eye(nx)} | {k - j: -A[j] for j in range(d + 1)}, push)
    add(np.linalg.inv(start_root), {d - j: np.eye(N)[:, j * nx : (j + 1) * nx] for j in range(d + 1)}, np.zeros(N))
    best = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0].reshape(T + 1, nx)
    data = km.Episodes([km.Episode(X=Y * scale[:nx] + mean[:nx], U=U * scale[nx:] + mean[nx:])], 0.1)
    found = (smoother(data)[0].X - mean[:nx]) / scale[:nx]
    np.testing.assert_allclose(found, best, rtol=0, atol=1e-8)


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.sampled_from([0.02, 0.1]))
def test_on_random_linear_plants_the_noise_is_found_and_most_of_it_taken_out(seed: int, nx: int, share: float) -> None:
    clean = linear_data(np.random.default_rng(seed), nx)
    data = noisy(clean, share, seed)
    smoother = km.data.Smoother.of(data)
    np.testing.assert_allclose(smoother.noise / spread(clean), share, rtol=0.15)
    assert smoother.is_noisy.all()
    assert (error(smoother(data), clean) < 0.6 * share).all()


def test_disturbances_of_the_plant_are_kept() -> None:
    """White process noise is no measurement noise: smoothing must not take it out."""
    clean = linear_data(np.random.default_rng(1), 2, process=0.2)
    assert not km.data.Smoother.of(clean).is_noisy.any()
    data = noisy(clean, 0.1)
    assert (error(km.data.Smoother.of(data)(data), clean) < error(data, clean)).all()


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_on_a_nonlinear_plant_most_of_the_noise_is_taken_out(share: float) -> None:
    clean = pendulum_data()
    data = noisy(clean, share)
    assert (error(km.data.Smoother.of(data)(data), clean) < 0.7 * share).all()


def test_where_a_state_is_not_measured_the_past_stands_in() -> None:
    whole = pendulum_data()
    clean = km.Episodes([km.Episode(X=e.X[:, :1], U=e.U) for e in whole], whole.dt)
    data = noisy(clean, 0.03)
    smoother = km.data.Smoother.of(data)
    assert smoother.delays > 0
    assert error(smoother(data), clean) < 0.7 * 0.03


def test_units_and_origin_do_not_count() -> None:
    data = noisy(pendulum_data(), 0.03)
    scale, shift = np.array([1e3, 1e-4]), np.array([5e3, -2e-4])
    other = data.with_episodes([km.Episode(X=e.X * scale + shift, U=1e-2 * e.U + 7) for e in data])
    first, second = km.data.Smoother.of(data), km.data.Smoother.of(other)
    np.testing.assert_allclose(second.noise, scale * first.noise, rtol=1e-5)
    for a, b in zip(first(data), second(other), strict=True):
        np.testing.assert_allclose((b.X - shift) / scale, a.X, rtol=0, atol=1e-5)


def test_episodes_of_any_length_are_smoothed_alike() -> None:
    """Smoothed together or alone an episode is the same; one that is too short stays as it is."""
    data = noisy(pendulum_data(), 0.03)
    smoother = km.data.Smoother.of(data)
    lengths = [30, 17, 3, 29, 1]
    cut = [km.Episode(X=e.X[: n + 1], U=e.U[:n]) for e, n in zip(data, lengths, strict=False)]
    together = smoother(data.with_episodes(cut))
    for one, own in zip(together, cut, strict=True):
        alone = smoother(data.with_episodes([own]))[0]
        np.testing.assert_allclose(one.X, alone.X, rtol=0, atol=1e-9)
        assert np.array_equal(one.U, own.U)


def test_a_long_episode_is_smoothed_as_its_parts_are() -> None:
    """Where gains have settled, what is far away in time does not count."""
    long = noisy(pendulum_data(episodes=2, steps=900), 0.03)
    smoother = km.data.Smoother.of(long)
    part = km.Episode(X=long[0].X[300:601], U=long[0].U[300:600])
    inner = smoother(long.with_episodes([part]))[0].X[100:200]
    np.testing.assert_allclose(smoother(long)[0].X[400:500], inner, rtol=0, atol=1e-6)


def test_measured_disturbances_explain_what_they_do() -> None:
    rng, clean = np.random.default_rng(0), linear_data(np.random.default_rng(3), 2)
    pushed: list[km.Episode] = []
    for e in clean:
        W = rng.uniform(-1, 1, (len(e), 1))
        X = e.X.copy()
        X[1:] += 0.5 * np.cumsum(W, axis=0)
        pushed.append(km.Episode(X=X, U=e.U, W=W))
    data = noisy(km.Episodes(pushed, 0.1), 0.05)
    result = km.data.Smoother.of(data)(data)
    assert all(np.array_equal(a.W, b.W) for a, b in zip(result, data, strict=True))
    assert result.disturbances == data.disturbances


@pytest.mark.parametrize("clean", [pendulum_data(), linear_data(np.random.default_rng(0), 3)])
def test_exact_data_stay_as_they_are(clean: km.Episodes) -> None:
    """To the bit: select gives the model that it gives when it is told not to smooth."""
    assert not km.data.Smoother.of(clean).is_noisy.any()
    options: Any = {"candidates": [km.State() + km.Constant() + km.Monomials(2)], "delays": [0], "horizon": 5}
    assert select(clean, **options).predictor == select(clean, smooth=False, **options).predictor


def test_a_stream_is_smoothed_as_episodes_in_memory_are() -> None:
    data = noisy(pendulum_data(), 0.05)
    options: Any = {"candidates": [km.State() + km.Constant()], "delays": [0], "horizon": 5, "bilinear": False}
    held = select(data, **options)
    streamed = select(km.data.Stream([data[:25], data[25:]]), **options)
    assert any("noise" in note for note in held.notes)
    assert held.linear is not None
    assert streamed.linear is not None
    np.testing.assert_allclose(streamed.linear.A, held.linear.A, rtol=0, atol=1e-9)
    plain = select(data, smooth=False, **options)
    assert not any("noise" in note for note in plain.notes)


def test_what_cannot_be_smoothed_is_refused() -> None:
    data = pendulum_data()
    with pytest.raises(km.errors.DataError, match="steps or more"):
        km.data.Smoother.of(data.with_episodes([km.Episode(X=data[0].X[:5], U=data[0].U[:4])]))
    with pytest.raises(km.errors.DataError, match="30 states at most"):
        km.data.Smoother.of(km.Episodes([km.Episode(X=np.random.default_rng(0).normal(size=(900, 31)))], 0.1))
    with pytest.raises(km.errors.DataError, match="the smoother is of 2 states"):
        km.data.Smoother.of(noisy(data, 0.01))(km.Episodes([km.Episode(X=np.zeros((9, 3)))], 0.1))


def test_a_controller_of_noisy_logs_knows_that_the_plant_is_unstable() -> None:
    """Noise of a fifth of the spread: least squares has no unstable mode, and its controller loses the plant.

    The logs are of runs under a feedback that holds the pendulum upright.
    """
    plant, upright = km.discretize(Pendulum(), dt=0.05), np.array([np.pi, 0.0])
    hands = km.Feedback([[14.0, 5.0]], km.Noise(-1, 1, hold=2), x_ref=upright)
    starts = km.Uniform(upright - np.array([0.2, 0.3]), upright + np.array([0.2, 0.3]))
    clean = km.collect(plant, starts, hands, episodes=40, steps=40)
    data, box, cost = noisy(clean, 0.2), km.Limits(u_min=-6, u_max=6), km.Cost(Q=[10, 1], R=0.1)

    def price(model: Any) -> float:
        mpc = km.KoopmanMPC(model, cost, box, 20)
        run = km.simulate(plant, mpc, x0=[np.pi + 0.3, 0], reference=upright, steps=100, cost=cost, limits=box)
        return km.metrics(run).cost

    best = price(km.LinearPredictor.local(plant, upright, [0]))
    options: Any = {"horizon": 20, "bilinear": False, "delays": [0], "candidates": [km.State() + km.Constant()]}
    assert price(select(data, **options).linear) < 1.05 * best
    assert price(select(data, smooth=False, **options).linear) > 100 * best


def test_what_products_of_inputs_and_disturbances_do_is_no_noise():
    """x⁺ = 0.8 x + 0.3 u (1 + 0.5 w) with sensor noise of 0.01: the smoother finds that noise, and takes it out."""
    rng, clean = np.random.default_rng(2), []
    for _ in range(8):
        U, W, X = rng.uniform(-1, 1, (40, 1)), rng.normal(size=(40, 2)), [rng.normal(size=1)]
        for u, w in zip(U, W, strict=True):
            X.append(0.8 * X[-1] + 0.3 * u * (1 + 0.5 * w[0]))
        clean.append(km.Episode(X=np.array(X), U=U, W=W))
    data = km.Episodes(clean, 0.1)
    noisy = data.with_episodes([e.with_states(e.X + rng.normal(0, 0.01, e.X.shape)) for e in data])
    smoother = km.data.Smoother.of(noisy)
    assert smoother.noise[0] == pytest.approx(0.01, rel=0.3)
    errors = [
        np.std(np.concatenate([a.X - b.X for a, b in zip(each, data, strict=True)]))
        for each in (smoother(noisy), noisy)
    ]
    assert errors[0] < 0.9 * errors[1]
