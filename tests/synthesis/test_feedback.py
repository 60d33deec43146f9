"""Identification under feedback in select and design: set points as instruments, where unseen rows gain."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.synthesis.search.feedback import project_on_instruments, remove_feedback
from tests.models.test_instruments import TRUTH, run_loop
from tests.searches import design


def fit_plain(data):
    model = km.edmd(data, km.State())
    return np.hstack([model.A, model.B])


def test_noisy_sensors_under_feedback_lose_their_bias():
    ours, plain = [], []
    for seed in range(2):
        data, r = run_loop(np.random.default_rng(seed), 800, sensor=0.2)
        found = remove_feedback(data, r)
        assert found.sentence.startswith("models are of the states as a filter sees them")
        assert found.noise == pytest.approx([0.2, 0.2], rel=0.1)
        ours.append(fit_plain(found.episodes) - TRUTH)
        plain.append(fit_plain(data) - TRUTH)
    assert np.linalg.norm(np.mean(ours, axis=0)) <= np.linalg.norm(np.mean(plain, axis=0)) / 5


def test_process_noise_alone_keeps_least_squares_with_its_variance():
    for seed in range(2):
        data, r = run_loop(np.random.default_rng(seed), 800, process=0.05)
        found = remove_feedback(data, r)
        assert found.episodes is data
        assert not found.noise.any()
        assert found.sentence.startswith("the set points are not used, and models are fitted by plain least")


def test_a_set_point_at_rest_identifies_nothing():
    data, r = run_loop(np.random.default_rng(0), 800, sensor=0.2, moves=False)
    assert "not identifiable" in remove_feedback(data, r).sentence
    assert "the set point rests" in remove_feedback(data, None).sentence


def test_open_loops_need_no_instruments():
    plant = km.LinearPredictor(TRUTH[:, :2], TRUTH[:, 2:], np.eye(2), km.State(), 0.1, ["x", "v"], ["u"]).step_map()
    data = km.collect(plant, [0, 0], km.Noise(-1, 1), episodes=2, steps=300)
    said = remove_feedback(data, [e.U for e in data]).sentence
    assert "hold no feedback" in said
    assert remove_feedback(data, None).episodes is data


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_inputs_that_are_held_in_an_open_loop_are_no_feedback(noise):
    """States explain them, for they followed them; noisy logs of them stay, and nobody is told to move a set point."""
    slow = km.LinearPredictor(np.diag([0.8, 0.6]), np.full((2, 1), 0.2), np.eye(2), km.State(), 0.1, ["x", "v"], ["u"])
    clean = km.collect(slow.step_map(), [0, 0], km.Noise(-1, 1, hold=6), episodes=4, steps=320)
    rng = np.random.default_rng(0)
    data = clean.with_episodes([km.Episode(X=e.X + noise * rng.standard_normal(e.X.shape), U=e.U) for e in clean])
    assert km.validate.feedback_share(data, km.State() + km.Constant())[0] > 0.1
    found = remove_feedback(data, None)
    assert found.episodes is data
    assert not found.sentence


def test_without_noise_the_projection_changes_nothing_that_matters():
    data, r = run_loop(np.random.default_rng(3), 2000)
    projected, noise = project_on_instruments(data, r, 60)
    np.testing.assert_allclose(projected[0].X, data[0].X[59:], atol=0.02)
    assert (noise < 5e-3).all()
    np.testing.assert_allclose(fit_plain(projected), TRUTH, atol=0.01)


@pytest.mark.slow
def test_the_error_falls_with_the_root_of_the_length():
    error = []
    for steps in (600, 2400):
        found = [run_loop(np.random.default_rng(seed), steps, sensor=0.1) for seed in range(12)]
        error.append(
            np.sqrt(np.mean([np.sum((fit_plain(remove_feedback(*one).episodes) - TRUTH) ** 2) for one in found]))
        )
    assert error[1] <= error[0] / 2 * 1.3  # four times the rows


def test_select_says_whether_it_removed_noise_that_feedback_carries():
    data, _ = run_loop(np.random.default_rng(1), 1200, sensor=0.2)
    chosen = km.select(
        data, options=km.SearchOptions(candidates=[km.State() + km.Constant()], delays=(0,), bilinear=False)
    )
    assert any("as a filter sees them" in note for note in chosen.notes)
    assert np.linalg.norm(chosen.predictor.A[:2, :2] - TRUTH[:, :2]) < 0.05


def test_instruments_that_do_not_fit_are_refused():
    data, r = run_loop(np.random.default_rng(1), 200)
    with pytest.raises(ShapeError, match="pass one an episode"):
        remove_feedback(data, [*r, *r])
    with pytest.raises(ShapeError, match="pass one a step"):
        remove_feedback(data, [r[0][:-9]])
    with pytest.raises(DataError, match="no episode is longer"):
        project_on_instruments(data, r, 500)


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


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.02, marks=pytest.mark.slow)])
def test_logs_of_a_nonlinear_loop_stay_where_its_curvature_could_be_taken_for_noise(noise):
    plant, rng, logs = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05), np.random.default_rng(0), []
    for _ in range(4):
        x, X, U = np.array([rng.uniform(-1, 1), 0.0]), [], []
        for k in range(400):  # a quarter of a fold must hold the steps of a filter
            goal = rng.uniform(-2, 2) if k % 25 == 0 else goal
            X.append(x + noise * rng.standard_normal(2))
            U.append([8 * (goal - X[-1][0]) - 3 * X[-1][1]])
            x = plant(x, U[-1])
        logs.append(km.Episode(X=np.array([*X, x]), U=np.array(U)))
    data = km.Episodes(logs, 0.05, plant.states, plant.inputs)
    assert remove_feedback(data, None).episodes is data


def test_logs_of_a_bent_plant_stay_though_a_linear_model_would_gain_by_a_filter(monkeypatch):
    """x₁ moves by |x₂|: a filter of a linear model takes this for noise, and a model that could have learned it loses."""
    rng, logs = np.random.default_rng(0), []
    for _ in range(4):
        x, X, U = np.array([rng.uniform(-1, 1), 0.0]), [], []
        for k in range(400):
            goal = rng.uniform(-1, 1) if k % 25 == 0 else goal
            X.append(x + 0.05 * rng.standard_normal(2))
            U.append([0.1 * (goal - X[-1][0]) - 0.8 * X[-1][1]])
            x = np.array([0.9 * x[0] + 0.2 * abs(x[1]), 0.7 * x[1] + 0.3 * U[-1][0]])
        logs.append(km.Episode(X=np.array([*X, x]), U=np.array(U)))
    data = km.Episodes(logs, 0.05)
    assert remove_feedback(data, None).episodes is data
    monkeypatch.setattr("koopmpc.synthesis.search.feedback._bend", lambda _: km.State() + km.Constant())
    assert "as a filter sees them" in remove_feedback(data, None).sentence


def test_wild_readings_are_replaced_before_a_filter_spreads_them():
    data, _ = run_loop(np.random.default_rng(1), 800, sensor=0.2)
    X = data[0].X.copy()
    X[300, 0] = 99.0
    found = remove_feedback(km.Episodes([km.Episode(X=X, U=data[0].U)], 0.1), None)
    assert found.sentence.endswith("1 wild readings were replaced")
    assert np.linalg.norm(fit_plain(found.episodes) - TRUTH) < 0.03
