"""Identification under feedback in select and design: set points as instruments, where unseen rows gain."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.errors import DataError, ShapeError
from koopmpc.synthesis.feedback import project_on_instruments, use_instruments
from tests.identify.test_instruments import TRUTH, run_loop


def fit_plain(data):
    model = km.edmd(data, km.State())
    return np.hstack([model.A, model.B])


def test_noisy_sensors_under_feedback_lose_their_bias():
    ours, plain = [], []
    for seed in range(4):
        data, r = run_loop(np.random.default_rng(seed), 800, sensor=0.2)
        used, noise, said = use_instruments(data, r)
        assert said.startswith("models are of states and inputs")
        assert noise == pytest.approx([0.2, 0.2], rel=0.3)
        ours.append(fit_plain(used) - TRUTH)
        plain.append(fit_plain(data) - TRUTH)
    assert np.linalg.norm(np.mean(ours, axis=0)) <= np.linalg.norm(np.mean(plain, axis=0)) / 5


def test_process_noise_alone_keeps_least_squares_with_its_variance():
    for seed in range(4):
        data, r = run_loop(np.random.default_rng(seed), 800, process=0.05)
        used, noise, said = use_instruments(data, r)
        assert used is data
        assert not noise.any()
        assert said.startswith("instruments are not used")


def test_a_set_point_at_rest_identifies_nothing():
    data, r = run_loop(np.random.default_rng(0), 800, sensor=0.2, moves=False)
    assert "not identifiable" in use_instruments(data, r)[2]


def test_open_loops_need_no_instruments():
    plant = km.LinearPredictor(TRUTH[:, :2], TRUTH[:, 2:], np.eye(2), km.State(), 0.1, ["x", "v"], ["u"]).step_map()
    data = km.collect(plant, [0, 0], km.Noise(-1, 1), episodes=2, steps=300)
    said = use_instruments(data, [e.U for e in data])[2]
    assert "hold no feedback" in said


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
        error.append(np.sqrt(np.mean([np.sum((fit_plain(use_instruments(*one)[0]) - TRUTH) ** 2) for one in found])))
    assert error[1] <= error[0] / 2 * 1.3  # four times the rows


def test_select_and_design_say_whether_they_used_them():
    data, r = run_loop(np.random.default_rng(1), 1200, sensor=0.2)
    chosen = km.select(data, candidates=[km.State() + km.Constant()], delays=(0,), bilinear=False, instruments=r)
    assert any("rows of the set point explain" in note for note in chosen.notes)
    assert np.linalg.norm(chosen.predictor.A[:2, :2] - TRUTH[:, :2]) < 0.05


def test_instruments_that_do_not_fit_are_refused():
    data, r = run_loop(np.random.default_rng(1), 200)
    with pytest.raises(ShapeError, match="pass one an episode"):
        use_instruments(data, [*r, *r])
    with pytest.raises(ShapeError, match="pass one a step"):
        use_instruments(data, [r[0][:-9]])
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
            made = km.design(data, cost, limits, **goal, **more)
        run = km.simulate(plant, made.controller, x0=[0, 0], reference=[1, 0], steps=60, cost=cost, limits=limits)
        spent.append(km.metrics(run).cost)
    assert spent[0] <= 1.05 * spent[1]
