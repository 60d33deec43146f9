"""The trust report: a good model is trusted, bad ones are not, and it says why."""

import warnings

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import Pendulum
from tests.roundtrip import returned

HORIZON = 10
LIFTING = km.State() + km.Fourier(2, states=[0])


def swings(episodes: int, seed: int, theta: float = 1.5, torque: float = 5.0) -> km.Episodes:
    plant = km.discretize(Pendulum(), 0.05)
    starts = km.Uniform([-theta, -theta], [theta, theta])
    return km.collect(plant, starts, km.Noise(-torque, torque), episodes=episodes, steps=40, rng=seed)


@pytest.fixture(scope="module")
def data() -> tuple[km.Episodes, km.Episodes]:
    return swings(120, 0).split(0.5)


def test_a_good_model_is_trusted(data) -> None:
    train, held_out = data
    report = km.trust(km.edmd(train, LIFTING), held_out, HORIZON, train=train)
    assert report.trusted
    assert report.steps == HORIZON
    assert str(report).startswith("TRUST")
    assert not any(finding.grave for finding in report.findings)
    assert report.error.max() < 0.2
    assert report.unseen is not None
    assert report.unseen < 0.05
    assert (report.score.rmse[-1] < report.holding.rmse[-1]).all()


def test_a_model_of_an_exact_subspace_is_trusted_without_care() -> None:
    rng = np.random.default_rng(0)
    runs = []
    for _ in range(60):
        U, X = rng.uniform(-1, 1, (20, 1)), [rng.uniform(-1, 1, 2)]
        for u in U:
            x = X[-1]
            X.append(np.array([0.9 * x[0], 0.5 * x[1] + 0.31 * x[0] ** 2 + u[0]]))
        runs.append(km.Episode(X=X, U=U))
    train, held_out = km.Episodes(runs, 0.1).split(0.5)
    closed = km.State() + km.Expressions(lambda x: [x[0] ** 2], ("square",))
    report = km.trust(km.edmd(train, closed), held_out, 15, train=train)
    assert report.findings == ()
    assert str(report).startswith("TRUST over 15 steps (1.5 s)\n")
    assert report.band.width.max() < 1e-9


def test_narrow_data_are_found_out(data) -> None:
    narrow = swings(20, 1, theta=0.2, torque=1.0)
    report = km.trust(km.edmd(narrow, LIFTING), data[1], HORIZON, train=narrow)
    assert not report.trusted
    text = str(report)
    assert text.startswith(f"DO NOT TRUST beyond {report.steps} of 10 steps")
    assert "collect data where the model will be used" in text
    assert "of the held-out samples lie where there are no training data" in text
    assert "was never visited" in text
    assert any("no training data, such as" in one.says and "visited" not in one.says for one in report.findings)
    assert report.unseen is not None
    assert report.unseen > 0.5


def test_too_few_data_for_too_many_observables_are_found_out(data) -> None:
    train, held_out = data
    centers = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        model = km.edmd(train[:2], km.State() + km.Gaussian(centers, 0.5))
    report = km.trust(model, held_out, HORIZON, train=train[:2])
    assert not report.trusted
    assert any("times those on the training episodes" in finding.says for finding in report.findings)
    assert report.residuals.spurious.any()


def test_its_parts_are_those_of_their_own_functions(data) -> None:
    train, held_out = data
    model = km.edmd(train, LIFTING)
    report = km.trust(model, held_out, HORIZON)
    assert report.score == km.score(model, held_out, HORIZON)
    assert report.train_score is None
    assert report.unseen is None
    assert np.allclose(
        np.sort(report.residuals.residuals), np.sort(km.spectrum.linearity_error(model, held_out)), rtol=1e-7
    )
    held = [np.abs(e.X[k + 3] - e.X[k]) ** 2 for e in held_out for k in range(len(e) - HORIZON + 1)]
    assert np.allclose(report.holding.rmse[2], np.sqrt(np.mean(held, axis=0)), rtol=1e-10)
    spread = np.ptp(np.concatenate([e.X for e in held_out]), axis=0)
    assert np.array_equal(report.spread, spread)
    assert km.trust(model, held_out, HORIZON) == report  # the same seed, the same report


def test_a_bilinear_model_is_judged_by_the_forecast_that_its_controller_makes(data) -> None:
    """Lifted afresh at each step, as BilinearMPC plans and as design compares; a linear model is lifted once."""
    train, held_out = data
    for model, afresh in ((km.bilinear_edmd(train, LIFTING), True), (km.edmd(train, LIFTING), False)):
        report = km.trust(model, held_out, HORIZON)
        assert report.score == km.score(model, held_out, HORIZON, relift=afresh)
        assert report.score != km.score(model, held_out, HORIZON, relift=not afresh)
        assert report.band.relift is afresh


@pytest.mark.parametrize("bilinear", [True, False])
def test_what_a_model_forgets_at_once_asks_for_care_where_it_is_lifted_once_only(bilinear) -> None:
    """x⁺ = 0.5 x − 0.01 tanh(x) + u, whose model does not forecast tanh(x): its eigenvalue is zero."""
    rng, runs = np.random.default_rng(0), []
    for _ in range(20):
        X, U = [rng.uniform(-0.2, 0.2, 1)], rng.uniform(-0.2, 0.2, (30, 1))
        for u in U:
            X.append(0.5 * X[-1] - 0.01 * np.tanh(X[-1]) + u)
        runs.append(km.Episode(X=np.array(X), U=U))
    data = km.Episodes(runs, 0.1, ["x"], ["u"])
    lifting = (km.State() + km.Expressions(lambda x: [ca.tanh(x[0])], ["bend"])).bind(("x",))
    parts = [[0.5, -0.01], [0.0, 0.0]], [[1.0], [0.0]], [[1.0, 0.0]], lifting, 0.1, ("x",), ("u",)
    if bilinear:
        model = km.BilinearPredictor(parts[0], parts[1], np.zeros((1, 2, 2)), *parts[2:])
    else:
        model = km.LinearPredictor(*parts)
    report = km.trust(model, data, 5)
    spurious = [one for one in report.findings if "spurious" in one.says]
    assert bool(spurious) is not bilinear
    assert report.score.rmse.max() < 1e-12 or not bilinear


def test_steps_end_where_a_band_leaves_its_share_of_the_range(data) -> None:
    report = km.trust(km.edmd(data[0], km.State()), swings(60, 5, theta=2.0), 40)
    assert 0 < report.steps < 40
    assert (report.error[: report.steps] <= 0.2).all()
    worst = report.error[report.steps]
    beaten = report.score.rmse[report.steps] < report.holding.rmse[report.steps]
    assert ((worst > 0.2) | ((worst > 0.05) & ~beaten)).any()


def test_bilinear_and_autonomous_models(data) -> None:
    train, held_out = data
    report = km.trust(km.bilinear_edmd(train, LIFTING + km.Constant()), held_out, HORIZON, train=train)
    assert report.trusted
    free = km.Episodes([km.Episode(X=e.X) for e in swings(30, 2, torque=1e-9)], 0.05)
    report = km.trust(km.edmd(free, km.State() + km.Fourier(1, states=[0])), free, HORIZON)
    assert report.persistency is None
    assert report.feedback is None
    assert "exciting" not in str(report)


def test_a_model_that_remembers_sees_what_is_not_measured() -> None:
    whole = swings(120, 6)
    angles = km.Episodes([km.Episode(X=e.X[:, :1], U=e.U) for e in whole], 0.05, ("theta [rad]",), ("torque [N m]",))
    train, held_out = angles.split(0.5)
    blind = km.trust(km.edmd(train, km.State()), held_out, HORIZON, train=train)
    past = km.trust(km.edmd(train, km.State() + km.Constant(), embedding=km.Delay(2)), held_out, HORIZON, train=train)
    assert not blind.trusted
    assert past.trusted
    assert past.invariance.names == (
        "theta [rad]",
        "torque[k-1] [N m]",
        "theta[k-1] [rad]",
        *past.invariance.names[3:],
    )
    assert str(past).startswith("TRUST")
    bilinear = km.bilinear_edmd(train, km.State() + km.Constant(), embedding=km.Delay(2))
    assert km.trust(bilinear, held_out, HORIZON).trusted


def test_feedback_and_weak_inputs_ask_for_care(data) -> None:
    rng = np.random.default_rng(3)
    for gain, noise, expected in (
        (1.0, 1e-2, "feedback: the observables explain most of the inputs"),
        (0, 0, "are exciting to order"),
    ):
        runs = []
        for _ in range(30):
            x, X, U = rng.uniform(-1, 1), [], []
            X.append([x])
            for _ in range(20):
                u = -gain * x + noise * rng.standard_normal() + (1 - gain)
                x = 0.95 * x + 0.1 * u
                X.append([x])
                U.append([u])
            runs.append(km.Episode(X=X, U=U))
        loop = km.Episodes(runs, 0.1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", km.FitWarning)
            model = km.edmd(loop, km.State())
        findings = km.trust(model, loop, 5).findings
        assert any(expected in finding.says for finding in findings)


def test_a_slow_input_that_outputs_follow_is_no_feedback() -> None:
    """Steps of an open loop last until the outputs have settled, so that outputs tell the input as well as its past."""
    rng = np.random.default_rng(5)
    for gain in (0.0, 1.0):
        steps, X = np.repeat(rng.uniform(-1, 1, 24), 50)[:, None], np.zeros((1201, 1))
        U = steps.copy()
        for k in range(1200):
            U[k] = steps[k] if not gain else 0.1 * steps[k] - X[k]
            X[k + 1] = 0.5 * X[k] + 0.5 * U[k] + 0.5 * gain * rng.standard_normal()
        record = km.Episodes([km.Episode(X=X, U=U)], 0.1)
        report = km.trust(km.edmd(record, km.State() + km.Constant()), record, 5)
        assert km.validate.feedback_share(record, km.State() + km.Constant())[0] > 0.9
        assert any("feedback" in finding.says for finding in report.findings) == bool(gain)


def test_closed_loop_coverage_is_shown_beside_the_promise(data) -> None:
    train, held_out = data
    model = km.edmd(train, km.State())
    steep = swings(60, 4, theta=3.0)
    loop = km.Episodes([km.Episode(X=e.X, U=e.U) for e in steep], 0.05, steep.states, steep.inputs)
    report = km.trust(model, held_out, HORIZON, closed_loop=loop)
    assert report.closed_loop is not None
    assert report.recalibrated is not None
    assert report.closed_loop.share < 0.8
    assert report.recalibrated.quantile > report.band.quantile
    assert any("in closed loop" in finding.says for finding in report.findings)
    assert "\nclosed loop  " in str(report)


def test_few_episodes_give_no_band_and_it_says_so(data) -> None:
    train, held_out = data
    report = km.trust(km.edmd(train, LIFTING), held_out[:4], HORIZON)
    assert np.isinf(report.band.quantile)
    (found,) = [f for f in report.findings if "3 calibration episodes, at least 9 are needed" in f.says]
    assert "cut long files into several: `koopmpc fit` holds out enough of 36 in all for a level of 90 %" in found.do
    assert report.trusted
    higher = km.trust(km.edmd(train, LIFTING), held_out[:4], HORIZON, level=0.95)  # of 76 in all fit holds out 15
    (found,) = [f for f in higher.findings if "3 calibration episodes, at least 19 are needed" in f.says]
    assert "36 in all for a level of 90 %" in found.do
    record = held_out.with_episodes([held_out[0]])
    blocks = km.trust(km.edmd(train, LIFTING), record, len(held_out[0]) // 3)  # too short to be cut once more
    (found,) = [f for f in blocks.findings if "calibration episodes" in f.says]
    assert found.do.startswith(f"record more rows, or judge fewer than {len(held_out[0]) // 3} steps ahead; in Python")


def test_a_model_that_diverges_gets_a_report_too(data) -> None:
    train, held_out = data
    good = km.edmd(train, km.State())
    wild = km.LinearPredictor(np.diag([1e200, 1e3]), good.B, good.C, km.State(), good.dt, good.states, good.inputs)
    report = km.trust(wild, held_out, HORIZON, train=train)
    assert report.steps == 0
    assert str(report).startswith("DO NOT TRUST, not even for one step (0.05 s)")
    assert any("forecasts overflow" in finding.says for finding in report.findings)
    assert any("2 of them grow" in finding.says for finding in report.findings)


def test_it_is_a_value_of_plain_data(data) -> None:
    train, held_out = data
    report = km.trust(km.edmd(train, LIFTING), held_out, HORIZON, train=train, closed_loop=train)
    again = returned(report)
    assert isinstance(again, km.validate.TrustReport)
    assert again == report
    assert str(again) == str(report)


def test_bad_input_is_refused(data) -> None:
    train, held_out = data
    model = km.edmd(train, LIFTING)
    with pytest.raises(km.errors.DataError, match="has 40 steps, the horizon is 41"):
        km.trust(model, held_out, 41)
    with pytest.raises(km.errors.DataError, match="there is 1 held-out episode"):
        km.trust(model, held_out[:1], 25)
    with pytest.raises(km.errors.ShapeError, match="the episodes have states"):
        km.trust(model, km.Episodes([km.Episode(X=e.X, U=e.U) for e in held_out], 0.05), 5)
