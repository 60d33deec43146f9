"""select on long records: sparse polynomials of the past, late input columns, free runs that decide."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import koopmpc as km
from koopmpc.base.errors import DataError
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.models.records.structure import Structure
from koopmpc.synthesis.search import hidden_states, records
from koopmpc.synthesis.search.candidates import relift_model
from koopmpc.synthesis.search.data import is_record
from koopmpc.synthesis.search.free_runs import (
    FreeRun,
    choose_by_free_run,
    forecast_rows,
    judge_finalists,
    judge_free_run,
)
from koopmpc.synthesis.search.hidden_states import NEAR, PAYS, judge_hidden_states
from koopmpc.synthesis.search.records import is_late
from koopmpc.validate.closed_loop import is_fed_back
from tests.models.test_hidden_state import friction_record, saturating_record
from tests.searches import select
from tests.validate.logs.test_timing import record


def oscillator(rows=420, noise=0.01, late=False, gain=None, seed=0):
    """Return one record of a hardening spring, of which the position alone is measured; P feedback with a gain."""
    rng = np.random.default_rng(seed)
    y, u, setpoint = np.zeros(rows + 2), np.zeros(rows + 2), np.repeat(rng.uniform(-1, 1, rows // 10 + 2), 10)
    measured = np.zeros(rows + 2)
    for k in range(1, rows + 1):
        measured[k] = y[k] + noise * rng.standard_normal()
        u[k] = rng.uniform(-1, 1) if gain is None else gain * (setpoint[k] - measured[k])
        y[k + 1] = 1.5 * y[k] - 0.8 * y[k - 1] - 0.1 * y[k] ** 3 + 0.4 * u[k]
    X, U = measured[1 : rows + 1, None], u[1:rows, None]
    if late:
        U = np.vstack([U[:1], U[:-1]])  # the row of u_k holds y_{k+1}
    return km.Episodes([km.Episode(X=X, U=U)], 0.1, ["y [mm]"], ["u"])


MODEL = ("A", "B", "N", "C", "lifting", "dt", "states", "inputs", "embedding")


@cache
def selection(late):
    with pytest.MonkeyPatch.context() as patch:
        if late:  # without hidden states and neurons, which take most of the time; others look at them
            patch.setattr("koopmpc.synthesis.select.judge_hidden_states", lambda *_, **__: [])
        return km.select(
            oscillator(rows=240 if late else 420, late=late),
            ridges=[1e-6],
            horizon=10,
            folds=2,
            options=km.SearchOptions(delays=[0, 2]),
        )


def free_error(model, data):
    """Return the error of a free run from the first rows of a record, as the model's controllers use it."""
    points = model.embed(model.align(data))[0]
    if isinstance(model, km.BilinearPredictor):
        X = model.step_map().rollout(points.X[0], points.U)[:, :1]
    else:
        X = model.rollout(points.X[0], points.U)
    return float(np.sqrt(np.mean((X - points.X[:, :1]) ** 2)))


@pytest.mark.parametrize("late", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_free_run_of_the_chosen_model_is_that_of_the_plant(late):
    found, fresh = selection(late), oscillator(late=late, seed=9, noise=0.0)
    assert found.predictor.embedding is not None
    assert found.predictor.input_lead == int(late)
    assert free_error(found.predictor, fresh) < 0.05 * fresh[0].X.std()
    assert found.best.free == min(row.free for row in found.leaderboard if np.isfinite(row.free))


@pytest.mark.slow
def test_the_best_of_each_kind_is_near_the_best_that_ran():
    found = selection(False)
    for kind, row in (("linear", found.best_linear), (found.best.kind, found.best)):
        ran = [r.free for r in found.leaderboard if r.kind == kind and np.isfinite(r.free)]
        assert row.free < 1.3 * min(ran)
    assert isinstance(found.linear, km.LinearPredictor)
    assert isinstance(found.bilinear, km.BilinearPredictor)


def test_a_late_input_column_is_moved_up_and_the_model_says_so(tmp_path):
    found = selection(True)
    assert found.predictor.input_lead == found.linear.input_lead == 1
    assert any("moved up by one row" in note for note in found.notes)
    found.predictor.save(tmp_path / "m.npz")
    loaded = km.load_model(tmp_path / "m.npz")
    assert loaded.input_lead == 1
    data = oscillator(late=True)
    assert np.array_equal(loaded.align(data)[0].U, data[0].U[1:])
    assert np.array_equal(loaded.align(data)[0].X, data[0].X[:-1])


def test_a_table_of_a_record_shows_the_free_run():
    assert "free" in str(selection(True))


def test_inputs_move_up_only_where_the_log_is_late_and_open():
    assert is_late(oscillator(late=True))
    assert not is_late(oscillator())
    fed_back = oscillator(gain=0.6)
    assert is_fed_back(fed_back)
    assert not is_late(fed_back)
    assert not is_fed_back(oscillator(late=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["P", "PI"])
def test_inputs_of_noisy_records_under_feedback_are_never_moved_up(kind):
    """Of 20 dB, in time; most have a set point that hides the feedback from `is_fed_back`."""
    assert not any(is_late(record(seed, feedback=kind)) for seed in range(20))


def test_inputs_that_are_advanced_twice_are_those_advanced_by_two():
    data = oscillator(rows=40)
    twice, two = data.with_inputs_advanced().with_inputs_advanced(), data.with_inputs_advanced(2)
    assert twice == two
    assert data.with_inputs_advanced(0) is data
    with pytest.raises(DataError, match="smaller number of rows"):
        data.with_inputs_advanced(39)


def test_a_record_is_one_long_series_of_few_signals():
    data = oscillator()
    assert is_record(data)
    blocks = data.with_episodes([data[0].cut(10 * i, 10 * i + 10) for i in range(20)])
    assert not is_record(blocks)
    wide = km.Episodes([km.Episode(X=np.ones((400, 6)))], 0.1)
    assert not is_record(wide)


def test_a_linear_model_lifted_at_each_step_is_a_bilinear_one_without_products():
    data = oscillator()
    model = km.edmd(data, km.State() + km.Monomials(3), embedding=km.Delay(1), ridge=1e-6)
    lifted = relift_model(model)
    assert not lifted.N.any()
    point = model.embed(data)[0].X[5]
    assert np.allclose(model.step_map()(point, [0.3]), lifted.step_map()(point, [0.3]), rtol=0, atol=1e-14)
    assert "lifted at each step" in lifted.report.changes[-1]


def test_smoothed_rows_are_learned_from_only_where_unseen_rows_gain():
    measured, clean = oscillator(noise=0.3), oscillator(noise=0.0)
    options = {"horizon": 10, "delays": [2], "smooth": False, "bilinear": False}
    rows = select(measured, candidates=[km.State() + km.Constant()], **options).leaderboard
    (kept, *_), _, _ = judge_finalists(rows, clean, measured, 2, 10, {})
    assert not kept.rough  # the best smoother that there can be
    blurred = clean[0].X.copy()
    for _ in range(60):  # a smoother that takes the motion for noise
        blurred[1:-1] = (blurred[:-2] + 2 * blurred[1:-1] + blurred[2:]) / 4
    wrong = clean.with_episodes([km.Episode(X=blurred, U=clean[0].U)])
    (raw, *_), _, _ = judge_finalists(rows, wrong, clean, 2, 10, {})
    assert raw.rough
    (same, *_), _, _ = judge_finalists(rows, clean, clean, 2, 10, {})
    assert not same.rough
    assert raw.free == same.free


def test_a_model_that_leaves_the_range_is_taken_only_where_all_do():
    wild, calm = FreeRun(np.array([0.1, 0.1]), False), FreeRun(np.array([0.5, 0.6]), True)
    assert choose_by_free_run([wild, calm], [1, 9]) == 1
    assert choose_by_free_run([wild, wild], [3, 2]) == 1
    near = FreeRun(np.array([0.52, 0.57]), True)
    assert choose_by_free_run([calm, near], [9, 1]) == 1


def test_a_model_far_behind_a_rival_is_not_fitted_without_each_quarter():
    data, fits = oscillator(rows=240), list[km.Episodes]()

    def fit(episodes, past):
        fits.append(episodes)
        return km.edmd(episodes, km.State() + km.Constant(), embedding=past, ridge=1e-9)

    rival = judge_free_run(lambda e: fit(e, km.Delay(2)), data, data, 2, 10, relift=False)
    assert (len(fits), rival.calm) == (5, True)
    lost = judge_free_run(lambda e: fit(e, None), data, data, 2, 10, relift=False, rival=rival)
    assert len(fits) == 7  # two quarters
    assert not lost.calm
    assert lost.errors.shape == rival.errors.shape
    fits.clear()
    once = judge_free_run(
        lambda e: fit(e, km.Delay(2) if fits else None), data, data, 2, 10, relift=False, rival=rival
    )  # one quarter does not decide
    assert (len(fits), once.calm) == (5, True)
    assert once.errors[0] > rival.errors[0]
    np.testing.assert_allclose(once.errors[2:], rival.errors[2:])


def test_a_quarter_before_the_first_row_of_a_free_run_judges_no_model():
    data = oscillator()

    def fit(e):
        return km.edmd(e, km.State() + km.Constant())

    alone = judge_free_run(fit, data, data, 110, 10, relift=False)  # a quarter has 104 rows
    beside = judge_free_run(fit, data, data, 110, 10, relift=False, rival=alone)
    np.testing.assert_array_equal(beside.errors, alone.errors)


@pytest.mark.parametrize(("rails", "factor"), [(np.array([[-0.5], [0.5]]), 1.0), (None, 3.0)])
def test_one_long_forecast_in_the_compiled_map_is_that_of_the_numpy_loop(rails, factor):
    data = oscillator(rows=800)
    model = km.bilinear_edmd(data, km.State() + km.Monomials(3), embedding=km.Delay(2, rails=rails))
    model = km.BilinearPredictor(**{**{name: getattr(model, name) for name in MODEL}, "A": factor * model.A})
    one, many = (forecast_rows(model, data, starts, 700, True) for starts in ([5], [5, 5]))
    assert np.isfinite(one).all() == (factor == 1.0)
    np.testing.assert_allclose(one[:, 0], many[:, 1], rtol=1e-9, atol=1e-12)


def test_hidden_states_far_behind_the_best_calm_polynomial_are_left_out():
    data = oscillator(rows=240)

    def names(errors, calm):
        ran = FreeRun(np.full(8, errors), calm)
        return [row.name for row, _ in judge_hidden_states(data, 2, 10, False, ran={"linear": ran})]

    both = ["hidden state of order 2, subspace", "hidden state of order 2, simulation error"]
    assert names(2.0, calm=True) == both
    assert names(1e-4, calm=False) == both
    assert names(1e-4, calm=True) == []


@pytest.mark.parametrize(
    ("error", "near", "judged"), [(0.03, PAYS, True), (0.055, PAYS, False), (0.055, NEAR, True), (0.07, NEAR, False)]
)
def test_neurons_that_err_little_more_on_one_quarter_are_judged_on_all(monkeypatch, error, near, judged):
    def make(error, neurons):
        return HiddenStructure(2, 2 - (neurons > 0), 8, 50, None, np.full(4, error), True, 20, neurons=neurons)

    monkeypatch.setattr(hidden_states, "search_hidden", lambda *_, **__: [make(0.04, 0)])
    monkeypatch.setattr(hidden_states, "search_neural", lambda *_, **__: [make(error, 3), make(9.0, 6)])
    found = hidden_states.search_hidden_states(oscillator(rows=240), True, near=near)
    assert any(one.neurons for one in found) == judged


@pytest.mark.slow
def test_a_hidden_state_is_taken_where_it_pays_on_unseen_rows():
    """Two tanks of which the second one's sensor saturates; polynomials of past rows cannot hold that."""
    data = saturating_record(np.random.default_rng(0), noise=0.005)
    found, fresh = (
        km.select(data, horizon=10, folds=2, options=km.SearchOptions(delays=[0, 2, 4])),
        saturating_record(np.random.default_rng(1)),
    )
    hidden = [row for row in found.leaderboard if "hidden state" in row.title]
    others = [row.free for row in found.leaderboard if row not in hidden and np.isfinite(row.free)]
    assert "saturating sensor" in found.best.title
    assert found.best.free < 0.9 * min(others)
    assert free_error(found.predictor, fresh) < 0.05 * fresh[0].X.std()


@pytest.mark.slow
def test_neurons_are_taken_where_they_pay_and_a_controller_plans_with_them():
    """Dry friction, whose corner no polynomial of a hidden state holds."""
    found, fresh = km.select(friction_record(0), horizon=10), friction_record(1)
    assert "neuron" in found.best.title
    others = [row.free for row in found.leaderboard if "neuron" not in row.title and np.isfinite(row.free)]
    assert found.best.free < 0.9 * min(others)
    assert free_error(found.predictor, fresh) < 0.03 * fresh[0].X.std()
    mpc = km.BilinearMPC(
        found.predictor, km.Cost(Q=1, R=1e-3), km.Limits(u_min=-1, u_max=1), horizon=10, estimator=km.ExtendedKalman()
    )
    v = 0.0
    for _ in range(60):
        u = float(mpc([v], [0.4]).u[0])
        v = 0.95 * v + 0.2 * u - 0.08 * np.tanh(20 * v)
    assert v == pytest.approx(0.4, abs=0.02)


@pytest.mark.slow
def test_of_models_alike_one_without_a_hidden_state_is_taken():
    found = selection(False)
    hidden = [row for row in found.leaderboard if "hidden state" in row.title]
    assert hidden
    assert all(np.isfinite(row.free) and row.worst < 1 for row in hidden)
    assert "hidden" not in found.best.title


@pytest.mark.parametrize(
    ("error", "calm", "other_calm", "taken"),
    [(0.89, True, True, 2), (0.91, True, True, 1), (2.0, False, True, 2), (0.1, True, False, 1)],
)
def test_the_best_linear_structure_is_taken_where_it_wins_on_long_stretches(
    monkeypatch, error, calm, other_calm, taken
):
    data = km.Episodes([km.Episode(X=np.zeros((1602, 1)), U=np.zeros((1601, 1)))], 0.1, ["y"], ["u"])
    one = Structure(1, 1, (np.array([[1]]),), np.zeros(2), np.ones(2), np.array([1.0, 2.0]), True)
    other = replace(one, terms=(np.array([[1], [2]]),), errors=np.array([0.9, 1.9]))
    runs = {1: FreeRun(np.array([1.0, 1.0]), calm), 2: FreeRun(np.array([error, error]), other_calm)}
    monkeypatch.setattr(records, "search_structures", lambda *_, **__: [one, other])
    monkeypatch.setattr(records, "choose_structure", lambda _: one)
    monkeypatch.setattr(records, "run_structure", lambda structure, *_: runs[structure.size])
    (found,) = records.propose_structures(data, [1], bilinear=False)
    assert isinstance(found.structure, Structure)
    assert found.structure.size == taken
