"""One-step fits with sensors that saturate: railed targets are no data, railed pasts are kept or left out, forecasts end."""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.fits.refinement import MultiStepError, coefficients_of_states, cut_into_segments, rows_of_states
from koopmpc.identify.records.narx import search_structures
from koopmpc.identify.records.structure import find_told_rows, fit_structure
from koopmpc.synthesis.search.records import propose_structures

RAILS = np.array([[-np.inf], [0.8]])


def record(rng, steps=500, noise=0.0, rail=0.8):
    """Return a record of y⁺ = 0.7 y − 0.2 y₋₁ + 0.4 u + 0.1 u y, of which a sensor shows no more than the rail."""
    y, U = np.zeros(steps + 1), np.repeat(rng.uniform(-1, 1.6, steps // 5), 5)
    for k in range(1, steps):
        y[k + 1] = 0.7 * y[k] - 0.2 * y[k - 1] + 0.4 * U[k] + 0.1 * U[k] * y[k]
    shown = np.minimum(y + noise * rng.standard_normal(steps + 1), rail)
    return km.Episodes([km.Episode(X=shown[:, None], U=U[:, None])], 0.1, ["y"], ["u"])


def test_rows_are_left_out_where_a_rail_hides_the_target_or_the_past():
    X = np.array([0.0, 0.8, 0.1, 0.2, 0.8, 0.8, 0.3, 0.1, 0.0, 0.1])[:, None]
    kept = find_told_rows(X, RAILS, 1, masked=False)
    assert kept.tolist() == [False, True, True, False, False, True, True, True, True]
    masked = find_told_rows(X, RAILS, 1, masked=True)
    assert masked.tolist() == [False, False, False, False, False, False, False, True, True]


@pytest.mark.parametrize("masked", [False, True])
def test_the_coefficients_are_those_of_the_rows_that_are_left(masked):
    data = record(np.random.default_rng(0), noise=0.02)
    found = search_structures(data, [1], [1], 3, rails=RAILS)
    structure = next(one for one in found if one.rails is not None and one.masked is masked)
    model, (e,) = fit_structure(structure, data), data
    Z = model.lifting(model.embed(data)[0].X[:-1])
    told = find_told_rows(e.X, RAILS, 1, masked)[1:]
    P = np.hstack([Z, e.U[1:]])
    rest = (e.X[2:, 0] - P @ np.hstack([model.A[0], model.B[0]]))[told]
    used = np.abs(np.hstack([model.A[0], model.B[0]])) > 1e-12
    assert 50 < told.sum() < len(told)
    assert np.abs(P[told][:, used].T @ rest).max() < 1e-6 * len(rest)  # least squares on these rows alone


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


def test_in_segments_a_railed_reading_counts_on_one_side_and_derivatives_are_exact():
    rng = np.random.default_rng(2)
    data = record(rng, noise=0.05)
    delay = km.Delay(1, rails=RAILS).bind(("y",), ("u",))
    lifting = km.State() + km.Constant() + km.State([0]) * km.State([2])
    model = km.bilinear_edmd(data, lifting, embedding=delay, ridge=1e-3)
    segments = cut_into_segments(model, data, 6, "here")
    error = MultiStepError(model, np.array([0.5]))
    theta = coefficients_of_states(model, rows_of_states(model))
    gradient, _ = error.derivatives(theta, segments)
    for j in range(theta.size):
        up, down = theta.ravel().copy(), theta.ravel().copy()
        up[j] += 1e-6
        down[j] -= 1e-6
        slope = error.evaluate(up.reshape(theta.shape), segments) - error.evaluate(down.reshape(theta.shape), segments)
        assert gradient[j] == pytest.approx(slope / 4e-6, rel=2e-3, abs=1e-5)
    one = replace(segments, states=np.full_like(segments.states, 0.8))
    high = np.zeros_like(theta)
    high[0, 3] = 2.0  # x̂ = 2 always, beyond the rail that every reading shows
    assert error.evaluate(high, one) == 0.0
    high[0, 3] = 0.5
    assert error.evaluate(high, one) == pytest.approx(((0.5 - 0.8) / 0.5) ** 2)


def test_wrong_rails_are_refused_in_a_sentence():
    data = record(np.random.default_rng(0), steps=200)
    with pytest.raises(DataError, match="low below high"):
        km.identify.narx(data, delays=1, degrees=1, rails=(0.8, 0.0))
    with pytest.raises(DataError, match="weights must be a function of an episode"):
        km.identify.narx(data, delays=1, degrees=1, rails=(-np.inf, 0.8), weights=[np.ones(200)])
    with pytest.raises(ShapeError, match="the weight of episode 0 has shape"):
        km.identify.narx(data, delays=1, degrees=1, rails=(-np.inf, 0.8), weights=lambda e: np.ones(3))


def test_an_extended_filter_of_a_bilinear_model_corrects_nothing_where_the_prediction_lies_beyond():
    data = record(np.random.default_rng(3), noise=0.01)
    found = search_structures(data, [1], [2], 5, rails=RAILS)
    structure = next(one for one in found if one.rails is not None and one.size == 4)
    model = fit_structure(structure, data)
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
    with pytest.raises(DataError, match="sensors that saturate, which C code does not know"):
        km.export(mpc, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_a_choice_of_models_tries_the_rails_of_a_sensor_that_rests_at_its_end():
    found = propose_structures(record(np.random.default_rng(1), noise=0.01), [1], bilinear=True)
    rails = [one.embedding.rails for one in found if one.embedding is not None and one.embedding.rails is not None]
    assert rails
    assert rails[0].tolist() == [[-np.inf], [0.8]]
