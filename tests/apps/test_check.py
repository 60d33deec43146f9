"""koopmpc check: verdicts, how often a controller fails, logged runs on the plant, and whether the plant has changed."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import koopmpc as km
from koopmpc.apps.fitting.changed import compare_logs, read_new_logs
from koopmpc.apps.fitting.check import check_controller
from koopmpc.apps.fitting.checked import RunKind
from koopmpc.apps.fitting.verdict import judge_plant_runs, judge_rate, plan_verdict
from koopmpc.control.move import PlanMemory
from koopmpc.models.base import change_model, load_value, save_value
from koopmpc.synthesis.designed import SavedDesign, rebuild_controller
from koopmpc.synthesis.search.recipe import get_model
from tests.apps.mass import GOAL, NAMES, A, B, design, logs
from tests.commands import koopmpc
from tests.small_designs import small_designs
from tests.synthesis import test_design_feedthrough as direct


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Leave out the pages, which take a second each, where a test does not look at them."""
    if not {"page", "told"} & {*request.node.name.split("_")}:
        monkeypatch.setattr("koopmpc.apps.fitting.check.write_design_report", lambda *_, **__: None)
    with small_designs():
        yield


def test_a_design_that_keeps_its_goal_passes_the_check_and_its_page_says_so(made, tmp_path):
    done = check_controller(made.controller, tmp_path, runs=4, rate=0.5)
    assert done.kept, str(done)
    text = done.page.read_text()
    assert "<b>The goal is kept.</b>" in text
    assert "inputs 20 % weaker" in text
    assert {one.kind.name for one in done.figures} >= {"as in the data", "sensor NaN", "half of the solves fail"}
    assert 0 < done.hot < done.dt
    steps = sum(count for _, count in done.figures[0].statuses)
    assert (
        steps == 4 * 3 * 3 * 15
    )  # a reference that rests has three times the three horizons of the design for arriving


def test_where_starts_of_the_goals_range_have_no_data_around_them_nobody_can_say(made, tmp_path):
    saved = load_value(made.controller, SavedDesign)
    rows = saved.evidence.neighbours
    corner = rows.rows[:, 0] < np.quantile(rows.rows[:, 0], 0.1)  # as if no log had been faster than its slowest tenth
    kept = {name: getattr(rows, name)[corner] for name in ("rows", "steps", "points", "episode")}
    few = replace(rows, **kept)
    save_value(replace(saved, evidence=replace(saved.evidence, neighbours=few)), tmp_path / "design.npz")
    done = check_controller(tmp_path / "design.npz", tmp_path, runs=3, rate=0.5)
    assert (done.verdict, done.kept, done.reasons) == ("cannot say", False, ())
    assert any("of the steps have no data around them" in doubt for doubt in done.doubts)
    assert str(done).startswith("NOBODY CAN SAY")


def test_a_check_repeats_for_a_seed(made, tmp_path):
    first, second = (check_controller(made.controller, tmp_path, runs=2, rate=0.5).figures for _ in range(2))
    assert first == second


def test_a_controller_that_misses_its_goal_fails_the_check_with_the_reason(tmp_path):
    made = design(tmp_path, GOAL.replace("weight = 0.01", "weight = 1000.0"))  # so dear that nothing is reached
    done = check_controller(made.controller, tmp_path, runs=3, rate=0.5)
    assert not done.kept
    assert any("off its reference, 5 % are allowed" in reason for reason in done.reasons)
    assert str(done).startswith("THE GOAL IS NOT KEPT")


def test_a_reference_that_no_input_holds_is_not_kept_where_every_run_ends_far_from_it_and_the_page_says_so(
    made, tmp_path, monkeypatch
):
    monkeypatch.setattr("koopmpc.apps.fitting.check.kinds", lambda *_, **__: [RunKind("as in the data")])
    saved = load_value(made.controller, SavedDesign)
    asked = replace(saved.evidence.task, reference=saved.evidence.task.reference * [1, 0] + [0, 0.7])  # x and speed
    evidence = replace(saved.evidence, task=asked, goal_can_be_held=False)
    save_value(replace(saved, evidence=evidence), tmp_path / "design.npz")
    done = check_controller(tmp_path / "design.npz", tmp_path, runs=2, rate=0.5)
    assert done.verdict == "not kept"
    assert re.match("as in the data: every run ends .* or more off its reference, 5 % are allowed", done.reasons[0])
    assert done.reasons[1].startswith("no input holds position = 0.5 m, speed = 0.7 m/s")
    assert "No input inside the limits holds the reference" in done.page.read_text()


def test_runs_with_weaker_inputs_that_end_off_the_reference_are_named_beside_the_verdict(made, tmp_path, monkeypatch):
    both = [RunKind("as in the data"), RunKind("inputs gone", gain=0.0)]
    monkeypatch.setattr("koopmpc.apps.fitting.check.kinds", lambda *_, **__: both)
    done = check_controller(made.controller, tmp_path, runs=2, rate=0.5)
    (remark,) = done.remarks
    assert remark.startswith("inputs gone: a run ends ")
    assert not any("off its reference" in reason for reason in done.reasons)
    assert "- inputs gone: a run ends" in str(done)


def test_an_input_beyond_its_limits_under_a_fault_fails_the_check(made, tmp_path, monkeypatch):
    ours = PlanMemory.fall_back

    def careless(self, *arguments, **keywords):
        move = ours(self, *arguments, **keywords)
        move.u = move.u + 10.0
        return move

    monkeypatch.setattr(PlanMemory, "fall_back", careless)
    done = check_controller(made.controller, tmp_path, runs=2, rate=0.5)
    outside = {one.kind.name: one.outside for one in done.figures}
    assert outside["sensor NaN"] > 0
    assert outside["as in the data"] == 0
    assert not done.kept
    assert any("sensor NaN: " in one and "outside their limits" in one for one in done.reasons)


def test_runs_lost_under_a_fault_are_told_and_count_only_where_that_is_asked(made, tmp_path, monkeypatch):
    frozen = [RunKind("as in the data"), RunKind("sensor frozen", faults=(km.faults.FrozenSensor(begin=2),))]
    monkeypatch.setattr("koopmpc.apps.fitting.check.kinds", lambda *_, **__: frozen)
    done, strict = (
        check_controller(made.controller, tmp_path / str(how), runs=3, rate=0.5, faults=how) for how in (False, True)
    )
    assert (done.kept, strict.kept) == (True, False)
    assert done.broken == strict.broken == strict.reasons
    assert done.broken[0].startswith("sensor frozen: ")
    assert done.broken[0].endswith("5 % are allowed")
    assert done.broken[0] in str(done)
    assert f"<li>{done.broken[0]}</li>" in done.page.read_text()
    assert "koopmpc check --faults counts it" in done.page.read_text()
    assert "counts it" not in strict.page.read_text()


def test_a_controller_without_evidence_cannot_be_checked(tmp_path):
    model = km.edmd(logs(), km.State() + km.Constant())
    km.KoopmanMPC(model, km.Cost(Q=[1, 1], R=0.1), None, 5).save(tmp_path / "c.npz")
    with pytest.raises(km.KoopmpcError, match="without the evidence that a check needs"):
        check_controller(tmp_path / "c.npz", tmp_path)


def test_a_check_of_what_is_no_controller_exits_with_2_and_says_what_to_pass(tmp_path, monkeypatch, made):
    monkeypatch.chdir(tmp_path)
    cut, goal = tmp_path / "cut.npz", tmp_path / "goal.toml"
    cut.write_bytes(made.controller.read_bytes()[:-300])
    goal.write_text(GOAL)
    for file in (cut, goal, tmp_path):
        result = koopmpc("check", str(file))
        assert result.exit_code == 2
        said = " ".join(result.stderr.split())
        assert file.name in said
        assert "pass the .npz of a saved Controller or Design" in said


def test_the_check_exits_with_1_where_the_goal_is_not_kept(tmp_path, monkeypatch, made):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("koopmpc.apps.fitting.check.ALLOWED_OFF", -1.0)
    monkeypatch.setattr("koopmpc.apps.fitting.check.ARRIVED", -1.0)
    result = koopmpc("check", str(made.controller), "--runs", "1", "--rate", "0.5")
    assert result.exit_code == 1, result.output
    assert "THE GOAL IS NOT KEPT" in result.stdout


def test_a_check_judges_by_the_cost_of_the_design_with_its_target_inputs_and_input_changes(made, tmp_path):
    """Σ ‖u − c‖² over T steps has the second difference 2 T in c; Σ ‖u_k − u_{k−1}‖² is charged on top."""
    saved = load_value(made.controller, SavedDesign)

    def checked_cost(**weights):
        asked = replace(saved.evidence.task, cost=km.Cost(Q=[0, 0], R=1.0, **weights))
        save_value(replace(saved, evidence=replace(saved.evidence, task=asked)), tmp_path / "design.npz")
        return check_controller(tmp_path / "design.npz", tmp_path, runs=1, rate=0.5).figures[0].cost

    zero, one, two = (checked_cost(u_target=[c]) for c in (0.0, 1.0, 2.0))
    assert two - 2 * one + zero == pytest.approx(2 * saved.evidence.task.steps)
    changes = checked_cost(u_target=[0.0], R_delta=1.0) - zero
    assert changes > 0
    assert checked_cost(u_target=[0.0], R_delta=3.0) - zero == pytest.approx(3 * changes)


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


def test_logged_runs_on_the_plant_are_judged_told_and_those_of_another_controller_refused(made, tmp_path):
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
    monkeypatch.chdir(tmp_path)
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
        said = koopmpc("check", str(tmp_path / "design.npz"), "--on-plant", str(tmp_path / name))
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


def test_a_design_without_neighbours_is_judged_on_its_models(made):
    saved, controller = load(made)
    verdict = judge_rate(replace(saved.evidence, neighbours=None), controller, 0.5, np.random.default_rng(0))
    assert verdict.on_rows == 0


def record(gain=1.0, seed=5, sigma=1e-3):
    rng, X = np.random.default_rng(seed), [np.zeros(2)]
    U = np.repeat(rng.uniform(-1.5, 1.5, (75, 1)), 4, axis=0)
    for u in U:
        X.append(A @ X[-1] + gain * B @ u)
    return km.Episodes([km.Episode(X=np.array(X) + sigma * rng.standard_normal((301, 2)), U=U)], 0.1, *NAMES)


@pytest.fixture(scope="module")
def old():
    noisy = logs()
    rng = np.random.default_rng(0)
    return noisy.with_episodes([km.Episode(X=e.X + 1e-3 * rng.standard_normal(e.X.shape), U=e.U) for e in noisy])


def test_a_design_holds_on_the_same_plant_and_where_its_runs_bear_the_change(old):
    assert compare_logs(old, record(), ()).holds
    weak = record(gain=0.82)
    report = compare_logs(old, weak, ()).report
    assert ("the gain of force", "input") in {(one.name, one.kind) for one in report.changes}
    borne = compare_logs(old, weak, ("inputs 20 % weaker",))  # the kind of change decides, not its words
    assert borne.holds is all(one.kind == "input" for one in report.changes)
    assert compare_logs(old, weak, ()).holds is False
    assert "design again" in compare_logs(old, weak, ()).sentence


def test_a_design_that_bears_what_alone_changed_holds(old, monkeypatch):
    weak = record(gain=0.82)
    report = km.validate.find_drift(old, weak)
    gain = [one for one in report.changes if one.kind == "input"]
    monkeypatch.setattr("koopmpc.apps.fitting.changed.find_drift", lambda *logs: replace(report, changes=tuple(gain)))
    held = compare_logs(old, weak, ("inputs 20 % weaker",))
    assert held.holds
    assert "keeps its goal with such inputs" in held.sentence
    assert compare_logs(old, weak, ("inputs 20 % stronger",)).holds is False


@pytest.mark.slow
def test_the_command_compares_new_logs_with_those_of_the_design(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = load_value(made.controller, SavedDesign).evidence.logs
    assert (kept.states, kept.inputs) == NAMES
    record(gain=0.5, sigma=0.0).save(tmp_path / "new.npz")
    assert read_new_logs(made.controller, [tmp_path / "new.npz"]).nu == 1
    result = koopmpc("check", str(made.controller), "--runs", "1", "--new", "new.npz")
    assert result.exit_code == 1
    assert "the plant has changed" in " ".join(result.output.split())
    km.Episodes(list(record()), 0.1).save(tmp_path / "other.npz")
    refused = koopmpc("check", str(made.controller), "--new", "other.npz")
    assert refused.exit_code == 2
    assert "pass logs with these columns" in " ".join((refused.output + refused.stderr).split())


def test_a_design_without_its_logs_cannot_be_compared():
    with pytest.raises(km.errors.DataError, match="saved without its logs"):
        compare_logs(None, record(), ())


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
