"""How often a controller fails: an exact bound from fresh loops on stand-ins, and from logged runs on the plant."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.apps.cli.app import app
from koopmpc.apps.fitting.certified import _explain_unfit
from koopmpc.apps.fitting.check import check_controller
from koopmpc.apps.fitting.designing import design_data
from koopmpc.apps.fitting.goal import read_goal
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.apps.fitting.verdict import judge_plant_runs, judge_rate, plan_verdict
from koopmpc.models.base import change_model, load_value, save_value
from koopmpc.synthesis.designed import SavedDesign, rebuild_controller
from koopmpc.synthesis.search.recipe import get_model
from tests.apps.mass import GOAL, NAMES, A, B, logs
from tests.small_designs import small_designs, undrawn_pages
from tests.synthesis import test_design_feedthrough as direct


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designed")
    logs().save(folder / "logs.npz")
    goal = GOAL.replace("horizon = 15", "horizon = 8\nmargin = 0.9\ncertify = true")
    (folder / "goal.toml").write_text(goal)
    with small_designs(), undrawn_pages():
        return design_data(folder / "logs.npz", folder / "goal.toml", folder / "out", FitOptions(linear=True))


def load(made):
    saved = load_value(made.controller, SavedDesign)
    return saved, rebuild_controller(saved, made.controller)


def run_plant(made, count, gain=1.0):
    """Return logged runs of the design's controller on the true plant, its inputs times `gain`."""
    _, controller = load(made)
    rng, found = np.random.default_rng(5), []
    for _ in range(count):
        controller.reset()
        X, U = [rng.uniform(-0.5, 0.5, 2)], []
        for _ in range(25):
            U.append(gain * controller(X[-1], [0.5, 0.0]).u)
            X.append(A @ X[-1] + B @ U[-1])
        found.append(km.Episode(X=np.array(X), U=np.array(U)))
    return km.Episodes(found, 0.1, *NAMES)


def test_the_bound_of_a_verdict_is_the_exact_binomial_one_and_its_number_of_loops_is_said_before(made):
    saved, controller = load(made)
    verdict = judge_rate(saved.evidence, controller, 0.2, np.random.default_rng(0))
    assert verdict.runs == km.validate.count_runs_needed(0.2)
    assert 0 < verdict.on_rows < verdict.runs
    assert scipy.stats.binom.cdf(verdict.failures, verdict.runs, verdict.failure_bound) == pytest.approx(0.05)
    assert "59 loops without a failure, or 93 with one; 59 are run" in plan_verdict(0.05)
    again = judge_rate(saved.evidence, controller, 0.2, np.random.default_rng(0))
    assert again == verdict


def test_loops_that_break_a_narrower_limit_are_counted(made):
    """The controller keeps the limit of its goal; judged by one half as wide it cannot."""
    saved, controller = load(made)
    asked = saved.evidence.task
    narrow = replace(saved.evidence, task=replace(asked, limits=km.Limits(u_min=-2, u_max=2, x_max=[np.inf, 0.1])))
    loops = [judge_rate(one, controller, 0.2, np.random.default_rng(0)) for one in (saved.evidence, narrow)]
    assert loops[0].failures < loops[1].failures
    assert loops[0].failure_bound < loops[1].failure_bound


def test_logged_runs_on_the_plant_are_judged_and_those_of_another_controller_refused(made, tmp_path):
    saved, controller = load(made)
    verdict = judge_plant_runs(saved.evidence, controller, run_plant(made, 20))
    assert (verdict.runs, verdict.failures) == (20, 0)
    assert verdict.own > 0.99
    assert verdict.failure_bound == pytest.approx(1 - 0.05 ** (1 / 20))
    assert verdict.next_fails == pytest.approx(1 / 21)
    with pytest.raises(km.errors.DataError, match="the logs hold other runs"):
        judge_plant_runs(saved.evidence, controller, run_plant(made, 3, gain=0.5))
    with pytest.raises(km.errors.DataError, match="3 states"):
        judge_plant_runs(
            saved.evidence, controller, km.Episodes([km.Episode(X=np.zeros((4, 3)), U=np.zeros((3, 1)))], 0.1)
        )
    done = check_controller(made.controller, tmp_path, runs=1, rate=0.4, on_plant=run_plant(made, 20))
    assert done.rate.runs == km.validate.count_runs_needed(0.4)
    assert "on the plant 0 of 20 logged runs" in " ".join(str(done).split())
    assert "How often it fails" in done.page.read_text()


def test_runs_in_a_table_are_read_with_the_names_and_the_step_of_the_design(made, tmp_path, monkeypatch):
    """No name says which column is the input, and there is none of time: the design knows both."""
    saved, _ = load(made)
    named = km.Episodes(list(saved.evidence.logs), 0.1, ["p", "q"], ["s"])
    save_value(replace(saved, evidence=replace(saved.evidence, logs=named)), tmp_path / "design.npz")
    runs, seen = run_plant(made, 2), []
    runs.save(tmp_path / "runs.npz")  # holds its own names
    (tmp_path / "runs").mkdir()
    for i, run in enumerate(runs):
        table = np.column_stack([run.X, np.concatenate([run.U, run.U[-1:]])])
        np.savetxt(tmp_path / "runs" / f"{i}.csv", table, delimiter=",", header="p,q,s", comments="")
    (tmp_path / "other.csv").write_text("p,s\n0,0\n0,0\n0,0\n")
    monkeypatch.setattr("koopmpc.apps.fitting.check.check_controller", lambda *_, on_plant, **__: seen.append(on_plant))
    for name in ("runs", "runs.npz", "other.csv"):
        said = CliRunner().invoke(app, ["check", str(tmp_path / "design.npz"), "--on-plant", str(tmp_path / name)])
    assert "'q'" in said.stderr
    tables, whole = seen
    assert (tables.dt, tables.states, tables.inputs, whole.states) == (0.1, ("p", "q"), ("s",), NAMES[0])
    for one, other, run in zip(tables, whole, runs, strict=True):
        np.testing.assert_allclose(np.hstack([one.X[:-1], one.U]), np.hstack([run.X[:-1], run.U]), atol=1e-15)
        np.testing.assert_array_equal(other.X, run.X)


def test_runs_in_a_late_log_are_judged_by_the_input_that_answered_each_row(made):
    saved, controller = load(made)
    runs, model = run_plant(made, 3), get_model(controller)
    late = km.Episodes([km.Episode(X=e.X, U=np.concatenate([np.zeros((1, 1)), e.U[:-1]])) for e in runs], 0.1, *NAMES)
    with pytest.raises(km.errors.DataError, match="the logs hold other runs"):
        judge_plant_runs(saved.evidence, controller, late)
    controller.predictor = change_model(model, report=replace(model.report, input_lead=1))
    assert judge_plant_runs(saved.evidence, controller, late).own > 0.99


def test_the_goal_file_asks_for_coverage_and_a_certificate_and_the_report_answers(made, tmp_path):
    promise = made.design.promise
    assert promise.coverage == 0.9
    assert promise.verified_on == 60
    text = " ".join(made.page.read_text().split())
    assert "90 % of" in text
    assert "No certificate: the data have too few independent episodes" in text
    saved, _ = load(made)
    assert saved.evidence.promise == promise
    for wrong in ("margin = 1.5", "certify = 3"):
        (tmp_path / "goal.toml").write_text(GOAL.replace("horizon = 15", wrong))
        with pytest.raises(km.errors.DataError, match=wrong.partition(" ")[0]):
            read_goal(tmp_path / "goal.toml", logs())


@pytest.mark.slow
def test_fit_with_a_goal_writes_a_certificate_and_its_page_where_logs_suffice(tmp_path, monkeypatch):
    """A fifth of 200 episodes is held out; from the edge of the region V falls on the plant, and limits are kept."""
    monkeypatch.chdir(tmp_path)
    logs(200, 8).save(tmp_path / "logs.npz")
    (tmp_path / "goal.toml").write_text(GOAL.replace("horizon = 15", "horizon = 4\ncertify = true"))
    with small_designs():
        result = CliRunner().invoke(app, ["fit", "logs.npz", "--goal", "goal.toml", "--linear"])
    assert result.exit_code == 0
    assert "certificate.md states it" in " ".join(result.stdout.split())
    (page,) = tmp_path.rglob("certificate.md")
    certificate = km.guarantees.load_certificate(page.with_name("certificate.npz"))
    assert page.read_text() == certificate.page()
    assert certificate.estimated
    assert not certificate.is_proof
    assert "certificate.md states it" in " ".join(page.with_name("report.html").read_text().split())
    X = certificate.sample(50)
    value = certificate.value(X)
    for x, v in zip(X, value, strict=True):
        u = certificate.feedback(x)
        ahead = A @ x + B @ u
        assert np.abs(u).max() <= 2
        assert abs(ahead[1]) <= 0.8
        assert certificate.value(ahead) <= max(certificate.decay * v, certificate.ball) * (1 + 1e-9)


def test_a_promise_of_nearly_all_loops_is_not_said_to_be_one_of_all(made):
    promise = replace(made.design.promise, coverage=0.996, found=True, failures=0)
    assert "at least 99.6 % of runs" in str(promise)


def test_options_of_a_goal_need_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    logs().save(tmp_path / "logs.npz")
    result = CliRunner().invoke(app, ["fit", "logs.npz", "--margin", "0.95"])
    assert result.exit_code == 2
    assert "pass --goal, too" in " ".join(result.stderr.split())


def test_a_design_without_neighbours_is_judged_on_its_models(made, tmp_path):
    saved, controller = load(made)
    verdict = judge_rate(replace(saved.evidence, neighbours=None), controller, 0.5, np.random.default_rng(0))
    assert verdict.on_rows == 0
    assert verdict.on_rows == 0
    save_value(saved, tmp_path / "again.npz")
    assert load_value(tmp_path / "again.npz", SavedDesign).evidence.promise == saved.evidence.promise


def test_a_certificate_is_not_sought_around_a_reference_that_moves(made):
    assert _explain_unfit(made.design, np.zeros(2)) == ""
    assert _explain_unfit(made.design, np.zeros((5, 2))).startswith("the reference moves")


def test_runs_on_the_plant_are_judged_by_what_the_controller_read_and_others_are_told_so():
    found = direct.usual()
    A, B, C, D = direct.A, direct.B, direct.C, direct.D
    x, u, readings, inputs = np.zeros(2), np.zeros(1), [], []
    found.controller.reset()
    for _ in range(12):
        readings.append(C @ x + D @ u)
        u = found.controller(readings[-1], [direct.GOAL]).u
        inputs.append(u)
        x = A @ x + B @ u
    for rows, own in (
        (np.array(readings), True),
        (direct.steer(found.controller, np.zeros(2), 0.0, 12)[1][:, None], False),
    ):
        runs = km.Episodes([km.Episode(X=rows, U=np.array(inputs)[:-1])], 0.1, ["y"], ["u"])
        if own:
            assert judge_plant_runs(found.evidence, found.controller, runs).own == 1
        else:
            with pytest.raises(km.errors.DataError, match="of the input before, which the controller had"):
                judge_plant_runs(found.evidence, found.controller, runs)
