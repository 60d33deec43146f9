"""One-step fits with sensors that saturate: railed targets are no data, railed pasts are kept or left out, forecasts end."""

import numpy as np
import pytest

import koopmpc as km

RAILS = np.array([[-np.inf], [0.8]])


def record(rng, steps=500, noise=0.0, rail=0.8):
    """Return a record of y⁺ = 0.7 y − 0.2 y₋₁ + 0.4 u + 0.1 u y, of which a sensor shows no more than the rail."""
    y, U = np.zeros(steps + 1), np.repeat(rng.uniform(-1, 1.6, steps // 5), 5)
    for k in range(1, steps):
        y[k + 1] = 0.7 * y[k] - 0.2 * y[k - 1] + 0.4 * U[k] + 0.1 * U[k] * y[k]
    shown = np.minimum(y + noise * rng.standard_normal(steps + 1), rail)
    return km.Episodes([km.Episode(X=shown[:, None], U=U[:, None])], 0.1, ["y"], ["u"])


def test_unseen_rows_choose_the_rails_and_free_runs_gain():
    rng = np.random.default_rng(1)
    data, fresh = record(rng, noise=0.01), record(rng)
    (e,), errors = fresh, list[float]()
    for rails in (None, (-np.inf, 0.8)):
        model = km.identify.narx(data, delays=[1, 2], degrees=[1, 2], rails=rails)
        past = model.embedding.steps
        free = model.step_map().rollout(model.embed(fresh)[0].X[0], e.U[past:])[:, 0]
        errors.append(float(np.sqrt(np.mean((free - e.X[past:, 0]) ** 2))))
    assert free.max() <= 0.8
    assert "with the sensors' rails" in " ".join(model.report.changes)
    assert errors[1] < 0.5 * errors[0]


def test_wrong_rails_are_refused_in_a_sentence():
    data = record(np.random.default_rng(0), steps=200)
    with pytest.raises(km.errors.DataError, match="low below high"):
        km.identify.narx(data, delays=1, degrees=1, rails=(0.8, 0.0))
    with pytest.raises(km.errors.DataError, match="weights must be a function of an episode"):
        km.identify.narx(data, delays=1, degrees=1, rails=(-np.inf, 0.8), weights=[np.ones(200)])
    with pytest.raises(km.errors.ShapeError, match="the weight of episode 0 has shape"):
        km.identify.narx(data, delays=1, degrees=1, rails=(-np.inf, 0.8), weights=lambda e: np.ones(3))


def test_an_extended_filter_of_a_bilinear_model_corrects_nothing_where_the_prediction_lies_beyond():
    data = record(np.random.default_rng(3), noise=0.01)
    model = km.identify.narx(data, delays=1, degrees=2, terms=4, rails=RAILS)
    assert isinstance(model, km.BilinearPredictor)
    mpc = km.BilinearMPC(model, km.Cost(Q=1.0, R=1.0), None, 5, estimator=km.ExtendedKalman(noise=0.01))
    observer = mpc.observer
    observer.observe(np.array([0.7]), np.zeros(1), np.zeros(0))
    for reading, beyond in ((0.8, True), (0.5, False)):
        observer.z[:] = [1.1, 1.5, 1.0]
        free = observer._model.advance(observer.z, np.array([1.5]), np.zeros(0), observer.d)
        assert free[0] > 0.8
        observer.observe(np.array([reading]), np.array([1.5]), np.zeros(0))
        assert np.allclose(observer.z, free) is beyond


def test_machine_code_of_a_sensor_that_saturates_is_refused_in_a_sentence(tmp_path):
    delay = km.Delay(1, rails=RAILS).bind(("y",), ("u",))
    model = km.edmd(record(np.random.default_rng(3)), km.State(), embedding=delay)
    mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0), None, 5)
    with pytest.raises(km.errors.DataError, match="sensors that saturate, which C code does not know"):
        km.export(mpc, tmp_path / "c")
    assert not (tmp_path / "c").exists()
