"""The search for a model: folds and ridges share sums, free runs decide on records, and feedback is taken out."""

from dataclasses import replace
from functools import partial, reduce

import numpy as np
import pytest

import koopmpc as km
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import second_moments
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.synthesis.search.candidates import Candidate, relift_model
from koopmpc.synthesis.search.cross_validation import Trial, cross_validate, fit_ridges, leave_one_out
from koopmpc.synthesis.search.folds import select_fold
from koopmpc.synthesis.search.free_runs import (
    FreeRun,
    choose_by_free_run,
    forecast_rows,
    judge_finalists,
    judge_free_run,
)
from koopmpc.synthesis.search.hidden_states import judge_hidden_states
from koopmpc.synthesis.search.leaderboard import choose_model
from koopmpc.synthesis.search.prepare import project_on_instruments, remove_feedback
from koopmpc.synthesis.search.records import is_late
from koopmpc.validate.closed_loop import is_fed_back
from tests.models.test_instruments import TRUTH, run_loop
from tests.searches import select
from tests.synthesis.test_records import oscillator
from tests.synthesis.test_select import PLAIN, SQUARES, episodes_of, linear
from tests.validate.logs.test_timing import record as timed_record

RIDGES = (1e-7, 1e-4, 1e-2)
FOLD, HORIZON, FIRST = (0, 1, 2, 0, 1, 2), 5, 2


def record(steps: int = 10, nw: int = 0) -> km.Episodes:
    """Return six noisy episodes of a quadratic plant whose input acts by its state, under measured disturbances."""
    rng = np.random.default_rng(3)
    parts: list[km.Episode] = []
    for _ in FOLD:
        U, W, X = 0.5 * rng.uniform(-1, 1, (steps, 2)), rng.uniform(-1, 1, (steps, nw)), [0.5 * rng.uniform(-1, 1, 2)]
        for u, w in zip(U, W, strict=True):
            a, b = X[-1]
            X.append(np.array([0.9 * a + 0.2 * b + 0.1 * w.sum(), 0.8 * b + 0.3 * a * a + 0.2 * u[0] + 0.1 * u[1] * a]))
        parts.append(km.Episode(X=np.array(X) + 0.002 * rng.standard_normal((steps + 1, 2)), U=U, W=W))
    return km.Episodes(parts, 0.1)


def forecast(model: km.BilinearPredictor | km.LinearPredictor, e: km.Episode, k: int, relift: bool) -> np.ndarray:
    """Return x̂ of one model from one start, a step and a product at a time."""
    past = 0 if model.embedding is None else model.embedding.steps
    history = e.cut(k - past, k) if past else None
    point = model.start(e.X[k], history)
    z, rows = model.lifting(point), []
    for u, w in zip(e.U[k : k + HORIZON], e.W[k : k + HORIZON], strict=True):
        z_next = model.A @ z + model.B @ u + model.E @ w
        if isinstance(model, km.BilinearPredictor):
            z_next += sum(v * (N @ z) for v, N in zip([*u, *w], [*model.N, *model.S], strict=True))
            z_next += sum(v * (M @ u) for v, M in zip(w, model.M, strict=True))
        rows.append(model.C @ z_next)
        if relift:
            point = rows[-1] if model.embedding is None else model.embedding.shift(point, u, rows[-1])
            z_next = model.lifting(point)
        z = z_next
    return np.array(rows)


@pytest.mark.parametrize(("nw", "delays"), [(1, 0), (0, 1)])
@pytest.mark.parametrize(("bilinear", "relift"), [(False, True), (True, False), (True, True)])
def test_a_score_is_that_of_a_fit_and_a_forecast_for_each_fold_ridge_and_start(nw, delays, bilinear, relift):
    data = record(nw=nw)
    lifting, embedding = km.State() + km.Constant(), km.Delay(delays) if delays else None
    given = km.synthesis.Candidate("", lifting if delays else lifting + km.Monomials(2), embedding, bilinear)
    candidate = given.bind(data.states, data.inputs)
    result = cross_validate(Trial(candidate, data, FOLD, HORIZON, FIRST, RIDGES, relift=relift))
    read = partial(
        second_moments, lifting=candidate.lifting, embedding=candidate.embedding, route="qr", bilinear=bilinear
    )
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    for f in range(3):
        rest = reduce(
            Moments.__add__,
            [read(select_fold(data.driven(products=bilinear), FOLD, other)) for other in {0, 1, 2} - {f}],
        )
        for i, ridge in enumerate(RIDGES):
            (model,) = fit_ridges(candidate, rest, data, (ridge,))
            gaps = [
                (e.X[k + 1 : k + HORIZON + 1] - forecast(model, e, k, bilinear and relift)) / spread
                for e, own in zip(data, FOLD, strict=True)
                if own == f
                for k in range(FIRST, len(e) - HORIZON + 1)
            ]
            expected = np.sqrt(np.mean(np.square(gaps), axis=(0, 2)))
            assert result.errors[i, f] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_shared_sums_are_those_of_the_other_parts(count):
    data = record(steps=20)
    parts = [second_moments(data[i : i + 1], km.State() + km.Constant(), route="qr") for i in range(count)]
    *rests, total = leave_one_out(parts)
    for i, rest in enumerate([*rests, total]):
        others = data.with_episodes([data[j] for j in range(count) if j != i])
        plain = second_moments(others, km.State() + km.Constant(), route="gram").sums
        assert rest.samples == sum(map(len, others))
        assert np.allclose(rest.sums.T @ rest.sums, plain, rtol=1e-12, atol=1e-12)


def test_hidden_states_learn_from_measured_rows_and_are_judged_beside_the_others():
    """Smoothed rows of the past hold the future: models that learned from them err more in 9 of 9 records."""
    data = record(steps=20)
    raw = data.with_episodes([km.Episode(X=e.X + 0.1 * np.sin(np.arange(len(e.X)))[:, None], U=e.U) for e in data])
    structure = HiddenStructure(1, 1, 4, 0, None, np.ones(8), True, 3)
    candidate = Candidate("hidden", km.State() + km.Constant(), km.Delay(4), False, structure)
    candidate = candidate.bind(data.states, data.inputs)
    fold = (0, 1) * (len(data) // 2)
    found = [cross_validate(Trial(candidate, d, fold, 2, 4, (0.0,), raw=r)) for d, r in ((data, raw), (raw, None))]
    assert np.array_equal(found[0].A, found[1].A)
    assert not np.array_equal(found[0].errors, found[1].errors)


MODEL = ("A", "B", "N", "C", "lifting", "dt", "states", "inputs", "embedding")


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
    assert not any(is_late(timed_record(seed, feedback=kind)) for seed in range(20))


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


def test_instruments_that_do_not_fit_are_refused():
    data, r = run_loop(np.random.default_rng(1), 200)
    with pytest.raises(km.errors.ShapeError, match="pass one an episode"):
        remove_feedback(data, [*r, *r])
    with pytest.raises(km.errors.ShapeError, match="pass one a step"):
        remove_feedback(data, [r[0][:-9]])
    with pytest.raises(km.errors.DataError, match="no episode is longer"):
        project_on_instruments(data, r, 500)


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
    monkeypatch.setattr("koopmpc.synthesis.search.prepare._bend", lambda _: km.State() + km.Constant())
    assert "as a filter sees them" in remove_feedback(data, None).sentence


def test_wild_readings_are_replaced_before_a_filter_spreads_them():
    data, _ = run_loop(np.random.default_rng(1), 800, sensor=0.2)
    X = data[0].X.copy()
    X[300, 0] = 99.0
    found = remove_feedback(km.Episodes([km.Episode(X=X, U=data[0].U)], 0.1), None)
    assert found.sentence.endswith("1 wild readings were replaced")
    assert np.linalg.norm(fit_plain(found.episodes) - TRUTH) < 0.03


def test_a_linear_model_that_grows_for_nothing_is_not_chosen():
    found = select(episodes_of(linear), horizon=8, candidates=[PLAIN, SQUARES], bilinear=False)
    plain, wild = (
        replace(found.leaderboard[0], worst=1.0, deviation=0.0, last=1.0, growth=2.0, size=2),
        replace(found.leaderboard[0], worst=0.1, deviation=0.0, last=0.9, growth=7.0, size=50),
    )
    assert choose_model((wild, plain)) == 1
    assert choose_model((replace(wild, growth=5.0), plain)) == 0  # less than three times
    assert choose_model((replace(wild, last=0.4), plain)) == 0  # the data bear it out
    assert choose_model((replace(wild, bilinear=True), plain)) == 0  # lifted anew at each step


def test_the_smallest_model_within_one_standard_error_is_chosen():
    found = select(episodes_of(linear), horizon=8, candidates=[PLAIN, SQUARES], bilinear=False)
    rows = [
        replace(found.leaderboard[0], worst=w, deviation=d, size=s)
        for w, d, s in [(1.0, 0.2, 50), (1.1, 0.0, 20), (1.19, 0.0, 30), (1.3, 0.0, 2)]
    ]
    assert choose_model(tuple(rows)) == 1
    assert choose_model((replace(rows[0], worst=np.inf, deviation=0.0), replace(rows[3], worst=np.inf))) == 1
