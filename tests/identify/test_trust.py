"""The trust report: a good model is trusted, bad ones are not, and it says why."""

import json
import warnings

import numpy as np
import pytest

from koopmpc.data.collect import Uniform, collect
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.excitation import Noise
from koopmpc.errors import DataError, FitWarning, ShapeError
from koopmpc.identify.bilinear import bilinear_edmd
from koopmpc.identify.edmd import edmd
from koopmpc.identify.trust import TrustReport, trust
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.expressions import Expressions
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.gaussian import Gaussian
from koopmpc.lifting.state import State
from koopmpc.plant.step_map import discretize
from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.score import score
from koopmpc.predict.spectrum import linearity_error
from koopmpc.values import from_data, to_data
from tests.plant.models import Pendulum

HORIZON = 10
LIFTING = State() + Fourier(2, states=[0])


def swings(episodes: int, seed: int, theta: float = 1.5, torque: float = 5.0) -> Episodes:
    plant = discretize(Pendulum(), 0.05)
    starts = Uniform([-theta, -theta], [theta, theta])
    return collect(plant, starts, Noise(-torque, torque), episodes=episodes, steps=40, rng=seed)


@pytest.fixture(scope="module")
def data() -> tuple[Episodes, Episodes]:
    return swings(120, 0).split(0.5)


def test_a_good_model_is_trusted(data) -> None:
    train, held_out = data
    report = trust(edmd(train, LIFTING), held_out, HORIZON, train=train)
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
        runs.append(Episode(X=X, U=U))
    train, held_out = Episodes(runs, 0.1).split(0.5)
    closed = State() + Expressions(lambda x: [x[0] ** 2], ("square",))
    report = trust(edmd(train, closed), held_out, 15, train=train)
    assert report.findings == ()
    assert str(report).startswith("TRUST over 15 steps (1.5 s)\n")
    assert report.band.width.max() < 1e-9


def test_narrow_data_are_found_out(data) -> None:
    narrow = swings(20, 1, theta=0.2, torque=1.0)
    report = trust(edmd(narrow, LIFTING), data[1], HORIZON, train=narrow)
    assert not report.trusted
    text = str(report)
    assert text.startswith(f"DO NOT TRUST beyond {report.steps} of 10 steps")
    assert "collect data where the model will be used" in text
    assert "of the held-out samples lie where the training data never were" in text
    assert "was never visited" in text
    assert report.unseen is not None
    assert report.unseen > 0.5


def test_too_few_data_for_too_many_observables_are_found_out(data) -> None:
    train, held_out = data
    centers = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        model = edmd(train[:2], State() + Gaussian(centers, 0.5))
    report = trust(model, held_out, HORIZON, train=train[:2])
    assert not report.trusted
    assert any("times those on the training episodes" in finding.says for finding in report.findings)
    assert report.residuals.spurious.any()


def test_its_parts_are_those_of_their_own_functions(data) -> None:
    train, held_out = data
    model = edmd(train, LIFTING)
    report = trust(model, held_out, HORIZON)
    assert report.score == score(model, held_out, HORIZON)
    assert report.train_score is None
    assert report.unseen is None
    assert np.allclose(
        np.sort(report.residuals.residuals), np.sort(linearity_error(model, held_out)), rtol=1e-7
    )
    held = [np.abs(e.X[k + 3] - e.X[k]) ** 2 for e in held_out for k in range(len(e) - HORIZON + 1)]
    assert np.allclose(report.holding.rmse[2], np.sqrt(np.mean(held, axis=0)), rtol=1e-10)
    spread = np.ptp(np.concatenate([e.X for e in held_out]), axis=0)
    assert np.array_equal(report.spread, spread)
    assert trust(model, held_out, HORIZON) == report  # the same seed, the same report


def test_steps_end_where_a_band_leaves_its_share_of_the_range(data) -> None:
    report = trust(edmd(data[0], State()), swings(60, 5, theta=2.0), 40)
    assert 0 < report.steps < 40
    assert (report.error[: report.steps] <= 0.2).all()
    worst = report.error[report.steps]
    beaten = report.score.rmse[report.steps] < report.holding.rmse[report.steps]
    assert ((worst > 0.2) | ((worst > 0.05) & ~beaten)).any()


def test_bilinear_and_autonomous_models(data) -> None:
    train, held_out = data
    report = trust(bilinear_edmd(train, LIFTING + Constant()), held_out, HORIZON, train=train)
    assert report.trusted
    free = Episodes([Episode(X=e.X) for e in swings(30, 2, torque=1e-9)], 0.05)
    report = trust(edmd(free, State() + Fourier(1, states=[0])), free, HORIZON)
    assert report.persistency is None
    assert report.feedback is None
    assert "exciting" not in str(report)


def test_a_model_that_remembers_sees_what_is_not_measured() -> None:
    whole = swings(120, 6)
    angles = Episodes(
        [Episode(X=e.X[:, :1], U=e.U) for e in whole], 0.05, ("theta [rad]",), ("torque [N m]",)
    )
    train, held_out = angles.split(0.5)
    blind = trust(edmd(train, State()), held_out, HORIZON, train=train)
    past = trust(edmd(train, State() + Constant(), embedding=Delay(2)), held_out, HORIZON, train=train)
    assert not blind.trusted
    assert past.trusted
    assert past.invariance.names == (
        "theta [rad]",
        "torque[k-1] [N m]",
        "theta[k-1] [rad]",
        *past.invariance.names[3:],
    )
    assert str(past).startswith("TRUST")
    bilinear = bilinear_edmd(train, State() + Constant(), embedding=Delay(2))
    assert trust(bilinear, held_out, HORIZON).trusted


def test_feedback_and_weak_inputs_ask_for_care(data) -> None:
    rng = np.random.default_rng(3)
    for gain, noise, expected in (
        (1.0, 1e-2, "feedback: ψ(x) explains most of the inputs"),
        (0, 0, "excite to order"),
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
            runs.append(Episode(X=X, U=U))
        loop = Episodes(runs, 0.1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            model = edmd(loop, State())
        findings = trust(model, loop, 5).findings
        assert any(expected in finding.says for finding in findings)


def test_closed_loop_coverage_is_shown_beside_the_promise(data) -> None:
    train, held_out = data
    model = edmd(train, State())
    steep = swings(60, 4, theta=3.0)
    loop = Episodes([Episode(X=e.X, U=e.U) for e in steep], 0.05, steep.states, steep.inputs)
    report = trust(model, held_out, HORIZON, closed_loop=loop)
    assert report.closed_loop is not None
    assert report.recalibrated is not None
    assert report.closed_loop.share < 0.8
    assert report.recalibrated.quantile > report.band.quantile
    assert any("in closed loop" in finding.says for finding in report.findings)
    assert "\nclosed loop  " in str(report)


def test_few_episodes_give_no_band_and_it_says_so(data) -> None:
    train, held_out = data
    report = trust(edmd(train, LIFTING), held_out[:4], HORIZON)
    assert np.isinf(report.band.quantile)
    assert any("3 calibration episodes, at least 9 are needed" in f.says for f in report.findings)
    assert report.trusted


def test_a_model_that_diverges_gets_a_report_too(data) -> None:
    train, held_out = data
    good = edmd(train, State())
    wild = LinearPredictor(np.diag([1e200, 1e3]), good.B, good.C, State(), good.dt, good.states, good.inputs)
    report = trust(wild, held_out, HORIZON, train=train)
    assert report.steps == 0
    assert str(report).startswith("DO NOT TRUST, not even for one step (0.05 s)")
    assert any("leave the finite numbers" in finding.says for finding in report.findings)
    assert any("2 of them grow" in finding.says for finding in report.findings)


def test_it_is_a_value_of_plain_data(data) -> None:
    train, held_out = data
    report = trust(edmd(train, LIFTING), held_out, HORIZON, train=train, closed_loop=train)
    again = from_data(json.loads(json.dumps(to_data(report))))
    assert isinstance(again, TrustReport)
    assert again == report
    assert str(again) == str(report)


def test_bad_input_is_refused(data) -> None:
    train, held_out = data
    model = edmd(train, LIFTING)
    with pytest.raises(DataError, match="has 40 steps, the horizon is 41"):
        trust(model, held_out, 41)
    with pytest.raises(DataError, match="there is 1 held-out episode"):
        trust(model, held_out[:1], 5)
    with pytest.raises(ShapeError, match="the episodes have states"):
        trust(model, Episodes([Episode(X=e.X, U=e.U) for e in held_out], 0.05), 5)
