"""km.train: the gradient is that of differences, held-out data are predicted no worse, and units do not matter."""

import signal
import tracemalloc
import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import approx_fprime

import koopmpc as km
from koopmpc.data.source import source_of
from koopmpc.models.shared.variable_projection import TunableLifting, VariableProjection, Windows
from koopmpc.synthesis.train import _draw_pieces

PLANT = km.black_box(
    lambda x, u: [x[0] + 0.1 * x[1], 0.95 * x[1] - 0.1 * np.sin(2 * x[0]) + 0.1 * u[0]],
    dt=0.1,
    states=["a [m]", "b [m/s]"],
    inputs=["u"],
)
CENTERS = np.random.default_rng(5).uniform(-1.5, 1.5, (6, 2))


def collected(episodes: int = 30, rng: int = 3) -> km.Episodes:
    return km.collect(
        PLANT, km.Uniform([-1.5, -1.5], [1.5, 1.5]), km.Noise(-1, 1), episodes=episodes, steps=12, rng=rng
    )


@pytest.fixture(scope="module")
def data() -> km.Episodes:
    return collected()


@dataclass(frozen=True, eq=False)
class Bumps(km.Lifting):
    """A user's own family, which says what of it can be tuned."""

    tunable = {"place": "real"}  # noqa: RUF012
    place: float = 0.3

    def observables(self, states):
        return (f"bump({self.place!r})",)

    def formula(self, x):
        return ca.vertcat(1 / (1 + (x[0] - self.place) ** 2))


LIFTINGS = {
    "Gaussians of one width": km.State() + km.Gaussian(CENTERS, 0.8),
    "Gaussians, each with its width": km.State() + km.Constant() + km.Gaussian(CENTERS, np.linspace(0.4, 1.2, 6)),
    "thin plates": km.State() + km.ThinPlate(CENTERS),
    "cosines without the states": km.Constant() + km.RandomFourier(8, 1.0),
    "a product in other units": km.State()
    * km.lifting.Standardized(km.Gaussian(CENTERS[:2], 0.8), [0.1, 0.2], [2.0, 0.5]),
    "a family of the user's": km.State() + km.Gaussian(CENTERS[:1], 0.5) * Bumps(),
}


@pytest.mark.parametrize("lifting", LIFTINGS.values(), ids=LIFTINGS.keys())
def test_the_gradient_is_that_of_differences_and_the_error_is_the_score_of_the_fit(data, lifting):
    points = _draw_pieces(source_of(data), 5, 200, np.random.default_rng(0)).all
    tuning = TunableLifting(lifting.bind(data.states))
    objective = VariableProjection(tuning, Windows.of(points, 5, 2), 1e-6)
    p = 0.05 * np.random.default_rng(1).standard_normal(tuning.n)
    value, gradient = objective(p)
    near = approx_fprime(p, lambda q: objective(q)[0], 1e-6)
    np.testing.assert_allclose(gradient, near, atol=2e-5 * np.abs(near).max())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)  # cosines are nearly dependent
        model = km.edmd(points, tuning.at(p), ridge=1e-6)
    assert np.exp(value) == pytest.approx(km.score(model, points, 5, stride=5).total, rel=1e-5)


def test_a_state_counts_by_its_own_size_and_one_that_stays_zero_counts_nothing(data):
    points = _draw_pieces(source_of(data), 5, 200, np.random.default_rng(0)).all
    small = km.Episodes([km.Episode(X=e.X * [1e-6, 0.0], U=e.U) for e in points], points.dt)
    windows = Windows.of(small, 5, 2)
    size = np.sum(np.stack([e.X[1:] for e in small]) ** 2, axis=0)
    np.testing.assert_allclose(windows.weight[:, 0] * size[:, 0], 1 / (5 * 2), rtol=1e-12)
    np.testing.assert_array_equal(windows.weight[:, 1], 0.0)


@pytest.mark.parametrize("lifting", list(LIFTINGS.values())[:4], ids=list(LIFTINGS)[:4])
def test_on_held_out_data_it_is_never_worse_than_untrained_and_mostly_better(data, lifting):
    other = collected(20, rng=8)
    trained = km.train(lifting, data, horizon=6, held_out=other, iterations=25)
    plain = km.edmd(data, lifting, ridge=1e-8)
    before, after = (km.score(model, other, 6).total for model in (plain, trained))
    assert after < 0.9 * before
    assert f"fell from {before:.3g} to {after:.3g}" in trained.report.changes[-1]


def test_where_nothing_is_gained_the_lifting_stays_as_it_is():
    linear = km.collect(
        km.black_box(lambda x, u: [0.9 * x[0] + u[0]], dt=0.1, states=["a"], inputs=["u"]),
        km.Uniform([-1], [1]), km.Noise(-1, 1), episodes=10, steps=12, rng=0,
    )  # fmt: skip
    lifting = km.State() + km.Gaussian([[0.0], [0.5]], 0.5)
    trained = km.train(lifting, linear, horizon=5)
    assert trained.lifting == lifting.bind(linear.states)
    assert "did not fall, and the lifting is as it was" in trained.report.changes[-1]


def test_one_seed_is_one_result_and_it_can_be_saved_and_refitted(data, tmp_path):
    lifting = LIFTINGS["cosines without the states"]
    one, two = (km.train(lifting, data, horizon=4, iterations=8, rng=7) for _ in range(2))
    assert one == two
    assert not set(one.lifting.names) & set(lifting.bind(data.states).names) - {"1"}
    one.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == one
    bilinear = km.bilinear_edmd(data, one.lifting, ridge=1e-6)
    assert bilinear.lifting == one.lifting


def test_units_of_the_states_do_not_matter(data):
    large = data.with_episodes([km.Episode(X=1e3 * e.X, U=e.U) for e in data])
    one, other = (
        km.train(km.State() + km.Constant() + km.Gaussian(k * CENTERS, k * 0.8), d, horizon=5, iterations=6)
        for k, d in ((1.0, data), (1e3, large))
    )
    U = np.random.default_rng(0).uniform(-1, 1, (6, 1))
    np.testing.assert_allclose(1e3 * one.rollout([0.5, -0.2], U), other.rollout([500, -200], U), rtol=1e-3, atol=0.3)


def test_delays_and_few_episodes_are_trained_too():
    long = km.collect(PLANT, [[0.5, 0.0]], km.Noise(-1, 1), episodes=1, steps=300, rng=1)
    past = km.Delay(1)
    centers = np.random.default_rng(0).uniform(-1, 1, (4, 5))
    trained = km.train(km.State() + km.Gaussian(centers, 1.5), long, horizon=5, embedding=past, iterations=5)
    assert trained.embedding.steps == 1
    assert np.isfinite(km.score(trained, long, 5).total)


def test_memory_goes_with_the_windows_and_not_with_the_data(tmp_path, monkeypatch):
    lifting = km.State() + km.Gaussian(CENTERS, 0.8)
    one = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=4, steps=1000, rng=0)
    peaks = []
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 100_000)  # bytes that are read at once
    for count in (4, 24):
        folder = tmp_path / str(count)
        folder.mkdir()
        for i in range(count):
            km.Episodes([km.Episode(X=e.X[i:], U=e.U[i:]) for e in one], one.dt).save(folder / f"{i}.npz")
        tracemalloc.start()
        km.train(lifting, km.data.Files(folder), horizon=5, windows=100, iterations=2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 4 * sum(e.X.nbytes + e.U.nbytes for e in one)  # 20 more were read


def test_ctrl_c_stops_it(data, monkeypatch):
    calls = []
    own = TunableLifting.pullback

    def pressed(self, *arguments):
        calls.append(0)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return own(self, *arguments)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(TunableLifting, "pullback", pressed)
    try:
        with pytest.raises(KeyboardInterrupt):
            km.train(LIFTINGS["thin plates"], data, horizon=4)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(calls) == 3


def test_bad_input_is_refused_in_a_sentence(data):
    lifting = km.State() + km.Gaussian(CENTERS, 0.8)
    for options, message in (
        ({"horizon": 13}, "no episode has the 13 steps"),
        ({"ridge": 0}, "ridge"),
        ({"held_out": 1.0}, "held_out is 1; pass a share below 1"),
        ({"horizon": 0}, "horizon"),
    ):
        with pytest.raises(km.errors.KoopmpcError, match=message):
            km.train(lifting, data, **options)
    with pytest.raises(km.errors.DataError, match="no centres, widths or frequencies to train"):
        km.train(km.State() + km.Monomials(2), data)
    with pytest.raises(km.errors.DataError, match="every width must be above zero"):
        km.Gaussian(CENTERS, [1.0, -1.0, 1, 1, 1, 1])
    with pytest.raises(km.errors.DataError, match="a stream is read once"):
        km.train(lifting, km.data.Stream(iter([data])))
    with pytest.raises(km.errors.DataError, match="too short to hold a part of them out"):
        km.train(lifting, data[:1], horizon=12)


def test_small_states_count_relative_to_their_size_as_in_the_score(data):
    small = km.Episodes([km.Episode(X=1e-3 * e.X, U=e.U) for e in data], 0.1, data.states, data.inputs)
    points = _draw_pieces(source_of(small), 5, 200, np.random.default_rng(0)).all
    tuning = TunableLifting((km.State() + km.Gaussian(1e-3 * CENTERS, 0.8e-3)).bind(data.states))
    value, _ = VariableProjection(tuning, Windows.of(points, 5, 2), 1e-6)(np.zeros(tuning.n))
    model = km.edmd(points, tuning.at(np.zeros(tuning.n)), ridge=1e-6)
    assert np.exp(value) == pytest.approx(km.score(model, points, 5, stride=5).total, rel=1e-5)
