"""narx: the greedy choice, exact plants, units, and that its free runs are those of the model it returns."""

import numpy as np
import pytest

import koopmpc as km


def plant(seed=0, rows=500, noise=0.0, episodes=1):
    """y⁺ = 0.6 y − 0.2 y₁² + 0.5 u y + u₁ + 0.1, with two inputs of which the second does nothing."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(episodes):
        u, y = rng.uniform(-1, 1, (rows, 2)), np.zeros(rows + 1)
        for k in range(1, rows):
            y[k + 1] = 0.6 * y[k] - 0.2 * y[k - 1] ** 2 + 0.5 * u[k, 0] * y[k] + u[k - 1, 0] + 0.1
        parts.append(km.Episode(X=(y + noise * rng.standard_normal(len(y)))[:, None], U=u))
    return km.Episodes(parts, 0.1, ["y [mm]"], ["u", "idle"])


def forecast(model, data):
    episode = model.embed(data)[0]
    return model.step_map().rollout(episode.X[0], episode.U)[:, : model.nx]


def test_an_exact_polynomial_plant_is_recovered():
    data = plant()
    model = km.identify.narx(data, delays=[1, 2, 3], degrees=[1, 2])
    assert isinstance(model, km.BilinearPredictor)
    assert model.embedding.steps == 1
    fresh = plant(seed=1)
    assert np.abs(forecast(model, fresh) - fresh[0].X[1:]).max() < 1e-7
    x, y1, u, u1 = 0.3, -0.4, 0.7, 0.2
    zeta = np.array([x, u1, 0.9, y1])
    assert model.step_map()(zeta, [u, -0.5])[0] == pytest.approx(0.6 * x - 0.2 * y1**2 + 0.5 * u * x + u1 + 0.1)


def test_units_and_origins_change_nothing():
    data = plant(noise=0.02)
    size, shift = np.array([1e4]), np.array([300.0])
    moved = data.with_episodes([km.Episode(X=e.X * size + shift, U=e.U * [1e-3, 50] + [4.0, -7]) for e in data])
    one, other = (km.identify.narx(d, delays=[0, 1, 3], degrees=[1, 2, 3], terms=12) for d in (data, moved))
    assert one.nz == other.nz
    assert np.allclose(forecast(other, moved), forecast(one, data) * size + shift, rtol=1e-9, atol=1e-5)


def test_a_linear_plant_gives_an_arx_model_whose_two_uses_agree():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(600), np.zeros(601)
    for k in range(2, 600):
        y[k + 1] = 1.1 * y[k] - 0.5 * y[k - 1] + 0.1 * y[k - 2] + 0.4 * u[k] - 0.3 * u[k - 2] + 0.3
    data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    model = km.identify.narx(data)
    assert isinstance(model, km.LinearPredictor)
    assert model.embedding.steps == 2
    point = model.embed(data)[0]
    once = model.rollout(point.X[0], point.U)
    assert np.abs(once - y[2:, None]).max() < 1e-8
    assert np.abs(once - forecast(model, data)).max() < 1e-8


def test_a_model_is_saved_with_its_terms(tmp_path):
    data = plant(noise=0.05)
    model = km.identify.narx(data, delays=2, degrees=3, terms=10)
    model.save(tmp_path / "m.npz")
    loaded = km.load_model(tmp_path / "m.npz")
    assert loaded == model
    assert np.array_equal(forecast(loaded, data), forecast(model, data))


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        ({}, {"delays": []}, "pass at least one"),
        ({}, {"delays": 40}, "pass fewer delays, or a longer record"),
        ({}, {"delays": 12, "degrees": 4}, "pass fewer delays, or a lower degree"),
        ({"W": np.ones((500, 1))}, {"delays": 1}, "pass them as inputs"),
    ],
)
def test_bad_input_is_a_sentence(change, options, says):
    data = plant()
    if change:
        data = km.Episodes([km.Episode(X=data[0].X, U=data[0].U, **change)], 0.1, data.states, data.inputs, ["w"])
    with pytest.raises(km.errors.DataError, match=says):
        km.identify.narx(data, **options)


def test_a_stream_is_refused():
    with pytest.raises(km.errors.DataError, match="read once"):
        km.identify.narx(km.data.Stream(iter([plant()])))


def test_records_without_inputs_are_fitted():
    y = np.zeros(400)
    y[:2] = 0.3, 0.5
    for k in range(1, 399):
        y[k + 1] = 1.4 - y[k] ** 2 + 0.3 * y[k - 1]  # Hénon's map
    data = km.Episodes([km.Episode(X=y[:, None])], 1.0, ["y"])
    model = km.identify.narx(data, delays=[1, 2], degrees=2)
    assert np.abs(km.score(model, data, 5, relift=True).rmse).max() < 1e-6
    assert model.report.method == "narx"


def test_a_driven_plant_never_gets_a_model_without_its_input():
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.standard_normal(300)) * 0.1  # the input does nothing that a free run would show
    data = km.Episodes([km.Episode(X=y[:, None], U=rng.standard_normal((299, 1)))], 0.1, ["y"], ["u"])
    model = km.identify.narx(data, delays=[0, 1], degrees=[1, 2], terms=6)
    assert np.abs(model.B[0]).max() > 0 or np.abs(model.A[0, 1]) > 0
