"""select on long records: sparse polynomials of the past, late input columns, free runs that decide."""

from functools import cache

import numpy as np
import pytest

import koopmpc as km
from tests.models.test_hidden_state import friction_record, saturating_record
from tests.models.test_instruments import TRUTH, run_loop
from tests.searches import design, select


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


@cache
def selection(late):
    with pytest.MonkeyPatch.context() as patch:
        if late:  # without hidden states and neurons, which take most of the time; others look at them
            patch.setattr("koopmpc.synthesis.select.judge_hidden_states", lambda *_, **__: [])
        return select(
            oscillator(rows=240 if late else 420, late=late), ridges=[1e-06], horizon=10, folds=2, delays=[0, 2]
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


@pytest.mark.slow
def test_a_hidden_state_is_taken_where_it_pays_on_unseen_rows():
    """Two tanks of which the second one's sensor saturates; polynomials of past rows cannot hold that."""
    data = saturating_record(np.random.default_rng(0), noise=0.005)
    found, fresh = (
        select(data, horizon=10, folds=2, delays=[0, 2, 4]),
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


def test_select_says_whether_it_removed_noise_that_feedback_carries():
    data, _ = run_loop(np.random.default_rng(1), 1200, sensor=0.2)
    chosen = select(data, candidates=[km.State() + km.Constant()], delays=(0,), bilinear=False)
    assert any("as a filter sees them" in note for note in chosen.notes)
    assert np.linalg.norm(chosen.predictor.A[:2, :2] - TRUTH[:, :2]) < 0.05


@pytest.mark.slow
def test_a_design_from_closed_loop_logs_is_as_good_as_one_from_open_loop_logs():
    plant = km.LinearPredictor(TRUTH[:, :2], TRUTH[:, 2:], np.eye(2), km.State(), 0.1, ["x", "v"], ["u"]).step_map()
    runs = [run_loop(np.random.default_rng(seed), 200, sensor=0.05) for seed in range(8)]
    closed = km.Episodes([data[0] for data, _ in runs], 0.1, ["x", "v"], ["u"])
    signals = [r[0] for _, r in runs]
    spread = float(np.concatenate([e.U for e in closed]).std())
    clean = km.collect(plant, [0, 0], km.Noise(-1.7 * spread, 1.7 * spread, hold=6), episodes=8, steps=200)
    rng = np.random.default_rng(9)
    opened = clean.with_episodes([km.Episode(X=e.X + 0.05 * rng.standard_normal(e.X.shape), U=e.U) for e in clean])
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-5, u_max=5)
    goal = {"reference": [1, 0], "horizon": 15, "bilinear": False, "delays": (0,), "loops": 0}
    goal |= {"candidates": [km.State() + km.Constant()], "starts": [0, 0]}
    spent = []
    for data, more in ((closed, {"instruments": signals}), (opened, {})):
        with km.errors.hide_fit_warnings():
            made = design(data, cost, limits, **goal, **more)
        run = km.simulate(plant, made.controller, x0=[0, 0], reference=[1, 0], steps=60, cost=cost, limits=limits)
        spent.append(km.metrics(run).cost)
    assert spent[0] <= 1.05 * spent[1]
