"""Learning online: batch, weighted and windowed fits, millions of updates, a plant at rest, a loop that learns."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import brute_force, random_episodes

LIFTING = km.State() + km.Constant() + km.Monomials(2)


def weighted(data: km.Episodes, lifting, weights: np.ndarray) -> np.ndarray:
    """Return [A B] of the least squares over all rows with these weights."""
    bound = lifting.bind(data.states)
    D = brute_force(data, bound)[-len(weights) :] * np.sqrt(weights)[:, None]
    return np.linalg.lstsq(D[:, : -bound.nz], D[:, -bound.nz :], rcond=None)[0].T


def found(online: km.OnlineEDMD) -> np.ndarray:
    model = online.predictor()
    return np.hstack([model.A, model.B])


@given(st.integers(0, 999), st.integers(0, 2), st.lists(st.integers(1, 70), min_size=1, max_size=5))
@settings(max_examples=8)
def test_without_forgetting_it_is_the_batch_fit(seed: int, nu: int, lengths: list[int]) -> None:
    data = random_episodes(seed, [*lengths, 40], 2, nu)
    online = km.OnlineEDMD.start(data[:-1], LIFTING)
    last = data[-1]
    for x, u, x_next in zip(last.X[:-1], last.U, last.X[1:], strict=True):
        online.learn(x, u, x_next)
    batch, model = km.edmd(data, LIFTING), online.predictor()
    assert online.pairs == sum(lengths) + 40
    assert np.allclose(model.A, batch.A, rtol=0, atol=1e-10)
    assert np.allclose(model.B, batch.B, rtol=0, atol=1e-10)
    assert np.allclose(model.C, batch.C, rtol=0, atol=1e-12)
    assert np.allclose(model.report.residual, batch.report.residual, rtol=1e-9)
    assert (model.lifting, model.states, model.inputs, model.dt) == (
        batch.lifting,
        batch.states,
        batch.inputs,
        batch.dt,
    )


@given(st.integers(0, 999), st.floats(0.8, 0.999))
@settings(max_examples=6)
def test_forgetting_is_the_weighted_fit(seed: int, forgetting: float) -> None:
    data = random_episodes(seed, [33, 64, 50], 2, 1)
    online = km.OnlineEDMD.start(data, LIFTING, forgetting=forgetting)
    M = 147
    expected = weighted(data, LIFTING, forgetting ** np.arange(M - 1.0, -1.0, -1.0))
    assert np.allclose(found(online), expected, rtol=0, atol=1e-7)


@given(st.integers(0, 999), st.integers(12, 150), st.integers(1, 60))
@settings(max_examples=8)
def test_a_window_is_the_fit_of_its_pairs(seed: int, window: int, extra: int) -> None:
    data = random_episodes(seed, [window + extra, 37], 2, 1)
    online = km.OnlineEDMD.start(data[:1], LIFTING, window=window)
    for x, u, x_next in zip(data[1].X[:-1], data[1].U, data[1].X[1:], strict=True):
        online.learn(x, u, x_next)
    expected = weighted(data, LIFTING, np.ones(window))
    assert np.allclose(found(online), expected, rtol=0, atol=1e-8 * max(1, np.abs(expected).max()))
    assert online.predictor().report.samples == window


def test_states_that_the_lifting_lacks_and_measured_disturbances() -> None:
    rng = np.random.default_rng(0)
    X, U, W = rng.uniform(-1, 1, (91, 2)), rng.uniform(-1, 1, (90, 1)), rng.uniform(-1, 1, (90, 2))
    data = km.Episodes([km.Episode(X=X, U=U, W=W)], 0.1)
    for lifting in (km.Fourier(1), LIFTING):
        model, batch = km.OnlineEDMD.start(data, lifting).predictor(), km.edmd(data, lifting)
        for name in ("A", "B", "C", "E"):
            assert np.allclose(getattr(model, name), getattr(batch, name), rtol=0, atol=1e-10), name
        assert model.disturbances == batch.disturbances
        assert np.allclose(model.report.state_residual, batch.report.state_residual, rtol=1e-6, atol=1e-9)


def test_a_ridge_is_that_of_the_batch() -> None:
    data = random_episodes(0, [80], 2, 1)
    assert np.allclose(
        km.OnlineEDMD.start(data, LIFTING, ridge=0.1).predictor().A,
        km.edmd(data, LIFTING, ridge=0.1).A,
        rtol=0,
        atol=1e-10,
    )
    chosen = km.OnlineEDMD.start(data, LIFTING, ridge="gcv").predictor()
    batch = km.edmd(data, LIFTING, ridge="gcv")
    assert np.allclose(chosen.A, batch.A, atol=1e-6)
    assert np.isclose(chosen.report.ridge, batch.report.ridge, rtol=1e-3)


def test_points_of_a_delay_are_its_states() -> None:
    data = random_episodes(0, [40, 30], 2, 1)
    online = km.OnlineEDMD.start(km.Delay(1)(data), km.State()).predictor()
    assert np.allclose(online.A, km.edmd(data, km.State(), embedding=km.Delay(1)).A, atol=1e-9)


def moving(A: np.ndarray, B: np.ndarray, x: np.ndarray, U: np.ndarray) -> np.ndarray:
    X = np.empty((len(U) + 1, len(x)))
    X[0] = x
    for k, u in enumerate(U):
        X[k + 1] = A @ X[k] + B @ u
    return X


A_ONE, A_TWO = np.array([[0.9, 0.2], [-0.2, 0.8]]), np.array([[0.7, 0.1], [0.3, 0.6]])
B_ONE = np.array([[0.5], [1.0]])


def rest_of(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((count, 2)), np.zeros((count, 1)), np.zeros((count, 2))


@pytest.mark.parametrize("forgetting", [0.9, 0.97])
def test_a_plant_at_rest_unlearns_nothing_and_learns_again(forgetting: float) -> None:
    rng = np.random.default_rng(0)
    U = rng.uniform(-1, 1, (300, 1))
    X = moving(A_ONE, B_ONE, np.zeros(2), U)
    online = km.OnlineEDMD(km.State() + km.Constant(), dt=0.1, states=("a", "b"), inputs=("u",), forgetting=forgetting)
    online.learn(X[:-1], U, X[1:])
    before = found(online)
    for _ in range(3):
        online.learn(*rest_of(10_000))  # 0.9^30000 is below the smallest number by far
    assert np.allclose(found(online), before, rtol=0, atol=1e-9)
    noise = 1e-5 * rng.standard_normal((5000, 2))
    online.learn(noise[:-1], np.zeros((4999, 1)), noise[1:])  # a sensor's noise about rest
    assert np.abs(found(online) - before).max() < 0.3
    X = moving(A_TWO, B_ONE, np.zeros(2), U)
    online.learn(X[:-1], U, X[1:])
    assert np.allclose(found(online)[:2, :2], A_TWO, rtol=0, atol=1e-3)


def test_one_silent_input_does_not_keep_the_others_from_adapting() -> None:
    rng = np.random.default_rng(1)
    B = np.array([[0.5, 0.2], [1.0, -0.3]])
    U = rng.uniform(-1, 1, (400, 2))
    X = moving(A_ONE, B, np.zeros(2), U)
    online = km.OnlineEDMD(km.State(), dt=0.1, states=("a", "b"), inputs=("u", "v"), forgetting=0.97)
    online.learn(X[:-1], U, X[1:])
    for _ in range(10):
        U = rng.uniform(-1, 1, (500, 2))
        U[:, 1] = 0
        X = moving(A_TWO, 2 * B, X[-1], U)
        online.learn(X[:-1], U, X[1:])
    model = online.predictor()
    assert np.allclose(model.A, A_TWO, rtol=0, atol=1e-6)
    assert np.allclose(model.B[:, 0], 2 * B[:, 0], rtol=0, atol=1e-6)
    assert np.allclose(model.B[:, 1], B[:, 1], rtol=0, atol=0.5)  # as it was last seen, not blown up


def long_run(updates: int, block: int, forgetting: float, rest: int) -> float:
    """Feed a long noisy record with a long rest in its middle; return the largest error against the exact answer."""
    rng = np.random.default_rng(0)
    online = km.OnlineEDMD(km.State() + km.Constant(), dt=0.1, states=("a", "b"), inputs=("u",), forgetting=forgetting)
    tail = round(40 / (1 - forgetting)) if forgetting < 1 else updates + rest
    kept: list[np.ndarray] = []
    D = np.zeros((7, 7), dtype=np.longdouble)
    x, done = np.zeros(2), 0
    while done < updates:
        if rest and done >= updates // 2:
            for _ in range(rest // block):
                online.learn(*rest_of(block))
            D[2, 2] += rest  # of the Constant
            D[2, 6] += rest
            rest = 0
        U = rng.uniform(-1, 1, (block, 1))
        X = moving(A_ONE, B_ONE, x, U)
        X[1:] += 0.01 * rng.standard_normal((block, 2))
        online.learn(X[:-1], U, X[1:]) if block > 1 else online.learn(X[0], U[0], X[1])
        rows = np.hstack([X[:-1], np.ones((block, 1)), U, X[1:], np.ones((block, 1))]).astype(np.longdouble)
        if forgetting == 1:
            D += rows.T @ rows
        else:
            kept.append(rows)
            kept = kept[-(tail // block + 1) :]
        x, done = X[-1], done + block
    if forgetting < 1:
        rows = np.vstack(kept)
        rows *= np.longdouble(forgetting) ** ((len(rows) - 1 - np.arange(len(rows))[:, None]) / np.longdouble(2))
        D = rows.T @ rows
    G, H = D[:4, :4].astype(float), D[:4, 4:].astype(float)
    return float(np.abs(found(online) - np.linalg.solve(G, H).T).max())


def test_long_runs_stay_exact() -> None:
    for forgetting in (1.0, 0.995):
        assert long_run(10_000, 100, forgetting, 10_000) < 1e-9
    assert long_run(1_000, 1, 0.9, 0) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("forgetting", [1.0, 0.9995])
def test_ten_million_updates_in_blocks_stay_exact(forgetting: float) -> None:
    error = long_run(7_000_000, 1000, forgetting, 3_000_000)
    print(f"10⁷ updates in blocks, forgetting {forgetting}: largest error of A, B {error:.1e}")  # noqa: T201
    assert error < 1e-9


def run(mpc: km.KoopmanMPC, online: km.OnlineEDMD | None) -> float:
    """Follow steps with a plant that stiffens and loses gain at step 60; return the settled squared error after."""
    x, loss = np.zeros(2), 0.0
    mpc.reset()
    for k in range(200):
        gain, stiffness = (1.0, 1.0) if k < 60 else (0.6, 2.0)
        target = [1.0 if (k // 40) % 2 else -1.0, 0.0]
        u = mpc(x, target).u
        x_next = x + 0.1 * np.array([x[1], -stiffness * x[0] - 0.5 * x[1] + 4 * gain * u[0]])
        if online is not None:
            online.learn(x, u, x_next)
            if k % 10 == 0:
                mpc.update(online.predictor())
        x = x_next
        if k >= 80 and k % 40 >= 20:
            loss += (x[0] - target[0]) ** 2
    return float(loss)


def test_a_controller_that_learns_tracks_a_changed_plant_better() -> None:
    rng = np.random.default_rng(0)
    A, B = np.array([[1, 0.1], [-0.1, 0.95]]), np.array([[0.0], [0.4]])
    U = rng.uniform(-2, 2, (200, 1))
    X = moving(A, B, np.zeros(2), U) + 1e-4 * rng.standard_normal((201, 2))
    data = km.Episodes([km.Episode(X=X, U=U)], 0.1)
    lifting = km.State() + km.Constant()
    model = km.edmd(data, lifting)
    cost, limits = km.Cost(Q=[10, 0.1], R=1e-3), km.Limits(u_min=-2, u_max=2)
    frozen = run(km.KoopmanMPC(model, cost, limits, horizon=20), None)
    online = km.OnlineEDMD.start(data, lifting, forgetting=0.97)
    learning = run(km.KoopmanMPC(online.predictor(), cost, limits, horizon=20), online)
    assert learning < 0.1 * frozen


def test_few_pairs_are_told_in_the_report_and_do_not_warn() -> None:
    online = km.OnlineEDMD(LIFTING, dt=0.1, states=("a", "b"), inputs=("u",))
    with pytest.raises(km.errors.DataError, match="no pair was learned yet"):
        online.predictor()
    online.learn([1, 2], [3], [4, 5])
    model = online.predictor()
    assert "rank-deficient: 1 snapshot pairs" in model.report.warnings[0]
    assert np.allclose(model.rollout([1, 2], [[3]])[1], [4, 5])


def test_wrong_forgetting_windows_and_shapes_are_refused() -> None:
    def make(**options: float) -> km.OnlineEDMD:
        return km.OnlineEDMD(km.State(), dt=0.1, states=("a", "b"), inputs=("u",), **options)

    for value in (0.0, -0.5):
        with pytest.raises(km.errors.DataError, match="forgetting is"):
            make(forgetting=value)
    with pytest.raises(km.errors.DataError, match=r"forgetting is 1.1; it must lie in \(0, 1\]"):
        make(forgetting=1.1)
    with pytest.raises(km.errors.DataError, match=r"window is 50 and forgetting 0\.9; choose one"):
        make(forgetting=0.9, window=50)
    with pytest.raises(km.errors.DataError, match="window is 0"):
        make(window=0)
    with pytest.raises(km.errors.DataError, match="keep is 1"):
        make(keep=1.0)
    with pytest.raises(km.errors.DataError, match="keep is 0; it must lie between 0 and 1"):
        make(keep=0.0)
    with pytest.raises(km.errors.DataError, match="ridge is -1"):
        make(ridge=-1.0)
    online = make()
    with pytest.raises(km.errors.ShapeError, match=r"x has shape \(3,\), expected \(2,\)"):
        online.learn([1, 2, 3], [1], [1, 2])
    with pytest.raises(km.errors.ShapeError, match="u has shape"):
        online.learn([1, 2], [1, 2], [1, 2])
    with pytest.raises(km.errors.ShapeError, match="x_next has shape"):
        online.learn([[1, 2]], [[1]], [1, 2])
    with pytest.raises(km.errors.DataError, match="x_next holds 1 NaN"):
        online.learn([1, 2], [1], [1, np.nan])
    with pytest.raises(km.errors.DataError, match=r"observable 'a\^2' is not finite"):
        km.OnlineEDMD(km.State() + km.Monomials(2), dt=0.1, states=("a",)).learn([1e200], [], [1])
    pushed = km.OnlineEDMD(km.State(), dt=0.1, states=("a",), disturbances=("w",))
    with pytest.raises(km.errors.DataError, match="1 measured disturbances; pass w"):
        pushed.learn([1], [], [1])


@pytest.mark.parametrize(("states", "outliers"), [(1, 1), (2, 0)])
def test_outliers_are_not_looked_for_with_a_memory_of_less_than_four_pairs_a_regressor(states, outliers):
    """A memory of ten pairs is more than that for a state and an input, and less for two states and an input."""
    rng = np.random.default_rng(0)
    A, B = np.diag([0.5, 0.7])[:states, :states], np.ones((states, 1))
    U = rng.uniform(-1, 1, (300, 1))
    X = moving(A, B, np.zeros(states), U)
    online = km.OnlineEDMD(km.State(), dt=0.1, states=("a", "b")[:states], inputs=("u",), forgetting=0.9)
    online.learn(X[:-1], U, X[1:])
    online.learn(X[-1], [0.0], 1e6 * np.ones(states))
    assert online.outliers == outliers
    assert online.pairs == 301 - outliers


@pytest.mark.parametrize(("forgetting", "outliers"), [(0.75, 1), (0.74, 0)])
def test_a_memory_of_four_pairs_is_enough_for_one_regressor(forgetting, outliers):
    x = np.random.default_rng(0).uniform(-1, 1, (300, 1))
    online = km.OnlineEDMD(km.State(), dt=0.1, states=("a",), forgetting=forgetting)
    online.learn(x, np.zeros((300, 0)), 0.5 * x)
    online.learn([1.0], [], [1e6])
    assert online.outliers == outliers
