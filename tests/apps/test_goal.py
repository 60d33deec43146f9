"""From logs and a goal to a controller and its check: the files, the verdicts, and what a goal file must not say."""

import html
import re
import shlex
import tomllib
from dataclasses import replace
from inspect import Parameter, signature
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.apps.cli.app import app
from koopmpc.apps.fitting.check import check_controller
from koopmpc.apps.fitting.checked import RunKind
from koopmpc.apps.fitting.designing import design_data
from koopmpc.apps.fitting.goal import format_template, load_reading, read_goal, write_template
from koopmpc.apps.fitting.logs import read_logs, round_step
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.base.text import format_duration
from koopmpc.control.move import PlanMemory
from koopmpc.models.base import load_value, save_value
from koopmpc.synthesis.designed import SavedDesign, read_controller
from koopmpc.synthesis.doubts import describe_rest
from tests.apps.mass import GOAL, NAMES, A, B, logs
from tests.small_designs import small_designs


def test_inputs_that_only_the_goal_file_names_are_inputs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for i, episode in enumerate(logs()):
        rows = np.column_stack([0.1 * np.arange(40), episode.X[:-1], episode.U])
        head = "time [s],position [m],speed [m/s],push [V]"
        np.savetxt(f"{i}.csv", rows, delimiter=",", header=head, comments="")
    refused = CliRunner().invoke(app, ["fit", ".", "--goal-template"])
    assert refused.exit_code == 2
    assert "no column is named as an input; its columns are" in refused.stderr
    assert "push [V] holds its value" in " ".join(refused.stderr.split())
    written = CliRunner().invoke(app, ["fit", ".", "--inputs", "push", "--horizon", "5", "--goal-template"])
    assert written.exit_code == 0
    lines = Path("goal.toml").read_text().splitlines()
    Path("goal.toml").write_text("\n".join(line for line in lines if not line.startswith("inputs =")))
    told = []

    def stop(data, *_, **how):
        told.append((data.states, data.inputs, how["options"].feedthrough))
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    with pytest.raises(km.KoopmpcError, match="read"):
        design_data(".", "goal.toml", "out", FitOptions(linear=True))
    assert CliRunner().invoke(app, ["fit", ".", "--goal", "goal.toml", "--feedthrough"]).exit_code
    assert told == [(NAMES[0], ("push [V]",), flag) for flag in (False, True)]


def tank_logs(folder, files=4, rows=300, glitch=None):
    """Write logs of a tank: level and temperature by inflow and heater, beside the set-point of an old controller.

    Of the second file the row number `glitch` has a level of 999.99.
    """
    rng = np.random.default_rng(0)
    folder.mkdir()
    for number in range(files):
        level, warmth, lines = rng.uniform(60, 120), rng.uniform(20, 30), []
        for k in range(rows):
            if k % 15 == 0:
                inflow, heater, target = rng.uniform([0, 0, 60], [10, 5, 150])
            seen = level + rng.normal(0, 0.02), warmth + rng.normal(0, 0.005)
            if (number, k) == (1, glitch):
                seen = 999.99, seen[1]
            lines.append([1.001 * k, *seen, inflow, heater, target])
            level += 1.001 * (0.4 * inflow - 0.2 * np.sqrt(level))
            warmth += 1.001 * (0.05 * heater - 0.01 * (warmth - 15))
        head = "time [s],level [cm],temperature [degC],inflow [l/s],heater [kW],setpoint [cm]"
        np.savetxt(folder / f"{number}.csv", lines, delimiter=",", header=head, comments="", fmt="%.4f")


def test_the_line_that_a_template_prints_reads_logs_and_goal_as_the_template_was_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tank_logs(tmp_path / "csv", files=3, rows=60)
    told, asked = "--states level,temperature --inputs inflow,heater --resample 1 --horizon 8 --linear", []
    result = CliRunner().invoke(app, ["fit", "csv", *told.split(), "--goal-template"])
    assert result.exit_code == 0, result.output

    def stop(data, *_, **options):
        asked.append((data.states, data.inputs, data.dt, options["horizon"], options["options"].bilinear))
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    line = shlex.split(result.stdout.partition("then: ")[2])
    assert "read" in CliRunner().invoke(app, line[line.index("fit") :]).stderr
    assert asked == [(("level [cm]", "temperature [degC]"), ("inflow [l/s]", "heater [kW]"), 1.0, 8, False)]


@pytest.mark.slow
def test_the_line_that_a_template_prints_designs_with_all_that_the_template_was_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tank_logs(tmp_path / "csv", files=3, rows=150)
    told = "--states level,temperature --inputs inflow,heater --resample 1 --horizon 8 --linear --name tank"
    result = CliRunner().invoke(app, ["fit", "csv", *told.split(), "--goal-template"])
    assert result.exit_code == 0, result.output
    line = shlex.split(result.stdout.partition("then: ")[2])
    result = CliRunner().invoke(app, line[line.index("fit") :])
    assert result.exit_code == 0, result.output
    (file,) = (tmp_path / "logs").glob("*-tank/controller.npz")
    controller = km.load_controller(file)
    assert controller.predictor.states == ("level [cm]", "temperature [degC]")
    assert controller.predictor.inputs == ("inflow [l/s]", "heater [kW]")
    assert (controller.dt, tomllib.loads(Path("goal.toml").read_text())["horizon"]) == (1.0, 8)
    assert isinstance(controller.predictor, km.LinearPredictor)


@pytest.mark.parametrize("how", ["", "--resample 1"])
def test_an_outlier_is_named_by_file_line_and_value_and_is_in_no_range(tmp_path, monkeypatch, how):
    monkeypatch.chdir(tmp_path)
    tank_logs(tmp_path / "csv", glitch=150)
    file = Path("csv/1.csv")
    lines = file.read_text().splitlines()
    file.write_text("\n".join(["# plant A", *lines[:20], "", *lines[20:]]))
    number = 1 + next(i for i, line in enumerate(file.read_text().splitlines()) if "999.99" in line)
    reading = {"states": ["level", "temperature"], "inputs": ["inflow", "heater"]}
    if how:
        reading["resample"] = 1.0
    split = read_logs("csv", 10, np.random.default_rng(0), 10**9, reading)
    named = [note for note in split.notes if f"csv/1.csv, line {number}" in note]
    assert named
    assert all("level = 999.99 cm" in note for note in named)
    assert not any("row " in note for note in named)
    for data in (split.seen, split.held_out):
        assert max(episode.X[:, 0].max() for episode in data) < 260
        assert all(episode.origin is None for episode in data)
    told = f"--states level,temperature --inputs inflow,heater {how}"
    assert CliRunner().invoke(app, ["fit", "csv", *told.split(), "--goal-template"]).exit_code == 0
    (line,) = re.findall("level.*in the data from .* to (.*)", Path("goal.toml").read_text())
    assert float(line) < 260


def test_a_goal_file_keeps_every_keyword_that_reads_the_logs_and_a_call_replaces_one(tmp_path, monkeypatch):
    given = {
        "dt": 0.5,
        "states": ["level [cm]", 'a "quoted" \\ name'],
        "inputs": [],
        "disturbances": ["rain"],
        "resample": 2,
        "columns": ["time [s]", "y"],
    }
    keywords = {p.name for p in signature(km.load_episodes).parameters.values() if p.kind is Parameter.KEYWORD_ONLY}
    assert given.keys() == keywords
    path = tmp_path / "goal.toml"
    path.write_text(format_template(logs(4), horizon=7, reading=given))
    assert load_reading(path) == given
    assert read_goal(path, logs(4)).horizon == 7
    asked = {}

    def stop(*arguments, ask):
        asked.update(arguments[4])
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.read_logs", stop)
    with pytest.raises(km.KoopmpcError, match="read"):
        design_data("logs", path, tmp_path, FitOptions(dt=0.25, inputs=None))
    assert asked == given | {"dt": 0.25}
    for wrong, words in (
        ("logs = 3", "logs is 3; write a section"),
        ("[logs]\nresampel = 1", "has 'resampel'.*resample"),
    ):
        path.write_text(wrong)
        with pytest.raises(km.KoopmpcError, match=words):
            load_reading(path)


@pytest.mark.parametrize(("horizon", "ahead"), [(30, 30), (80, 20)])
def test_a_model_is_judged_over_the_horizon_of_the_goal_where_the_logs_are_long_enough(
    horizon, ahead, tmp_path, monkeypatch
):
    def stop(*_, **__):
        raise km.KoopmpcError("read")

    logs().save(tmp_path / "logs.npz")
    (tmp_path / "goal.toml").write_text(GOAL.replace("horizon = 15", f"horizon = {horizon}"))
    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    told = []
    with pytest.raises(km.KoopmpcError, match="read"):
        design_data(tmp_path / "logs.npz", tmp_path / "goal.toml", tmp_path, say=told.append)
    assert f"horizon {ahead} steps" in told[0]
    assert ("too short to judge a model over the 80 steps of the goal" in told[0]) == (horizon == 80)


@pytest.mark.parametrize(
    ("median", "step"), [(2.002, 2.0), (0.0501, 0.05), (0.33333, 0.33333), (1.0, 1.0), (7.3e-4, 7.3e-4)]
)
def test_an_uneven_clock_has_the_step_that_its_recorder_was_set_to(median, step):
    assert round_step(median) == step


def test_a_template_says_which_columns_are_inputs_and_that_this_was_guessed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tank_logs(tmp_path / "csv")
    said = " ".join(CliRunner().invoke(app, ["fit", "csv", "--goal-template"]).stdout.split())
    assert "which columns are inputs was guessed from their names; --inputs" in said
    assert re.search(r"inputs .*heater \[kW\]", said)


def test_a_goal_file_keeps_the_step_that_an_uneven_clock_was_brought_to(tmp_path):
    data, rng = logs(), np.random.default_rng(0)
    for i, episode in enumerate(data):
        times = 0.1 * (np.arange(40) + rng.uniform(-0.1, 0.1, 40))
        rows = np.column_stack([times, episode.X[:-1], episode.U])
        np.savetxt(tmp_path / f"{i}.csv", rows, delimiter=",", header="time [s],x,v,force", comments="")
    told: list[list[str]] = []
    for reading in ({}, {"resample": 0.1}):
        said: list[str] = []
        text = write_template(tmp_path, FitOptions(**reading), say=said.append)
        (tmp_path / "goal.toml").write_text(text)
        step = load_reading(tmp_path / "goal.toml")["resample"]
        assert step == pytest.approx(0.1, rel=0.05)
        assert f"steps of {step:g} s" in text
        assert ("# nobody asked for it: steps of the logs are unequal" in text) == (not reading)
        told.append([line for line in said[0].splitlines() if "sampling is unequal in" in line])
    assert len(told[0]) == len(told[1]) == 1  # the rows are named again where the goal file says how they are read
    assert re.search(r"0\.csv \(\d+ of 39, from line \d+\)", told[1][0])


def goal_of(text, tmp_path):
    (tmp_path / "goal.toml").write_text(text)
    return read_goal(tmp_path / "goal.toml", logs(4))


def test_logs_and_a_goal_end_in_a_controller_file_that_keeps_the_goal_on_the_plant(made):
    assert sorted(path.name for path in made.controller.parent.iterdir()) == ["controller.npz", "report.html"]
    controller = km.load_controller(made.controller)
    x = np.array([-0.8, 0.0])
    controller.reset(x)
    speeds = []
    for _ in range(150):
        u = controller(x, [0.5, 0.0]).u
        assert abs(u[0]) <= 2.0
        x = A @ x + B @ u
        speeds.append(x[1])
    np.testing.assert_allclose(x, [0.5, 0.0], atol=0.01)
    assert max(speeds) <= 0.8 + 1e-3 * 1.6


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Keep designs small, and leave out the pages, which take a second each, where a test does not look at them."""
    if not {"page", "told"} & {*request.node.name.split("_")}:
        monkeypatch.setattr("koopmpc.apps.fitting.check.write_design_report", lambda *_, **__: None)
    if "made" not in request.fixturenames:
        monkeypatch.setattr("koopmpc.apps.fitting.designing.write_design_report", lambda *arguments: arguments[2])
    with small_designs():
        yield


def test_the_page_shows_what_to_expect_and_the_goal(made):
    text = html.unescape(made.page.read_text())
    for part in ("Controller report: position, speed", "no guarantee", 'states."position [m]"', "load_controller"):
        assert part in text


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (-2.0, 2.0, "force = 0 N/kg of -2 … 2"),
        (-2.0, 0.1, "force = 0 N/kg of -2 … 0.1; less than a tenth of the range is left above for force: no headroom"),
        (-0.1, 2.0, "force = 0 N/kg of -0.1 … 2; less than a tenth of the range is left below for force: no headroom"),
        (-np.inf, 2.0, "force = "),
    ],
)
def test_a_design_says_at_which_inputs_its_reference_rests_and_how_far_from_their_limits(made, low, high, said):
    evidence = made.design.evidence
    asked = replace(evidence.task, limits=replace(evidence.task.limits, u_min=low, u_max=high))
    rest = describe_rest(evidence.surrogates[:1], asked)
    assert rest.startswith(f"the reference rests at {said}")
    assert rest.endswith(said) or low == -np.inf
    page = html.unescape(made.page.read_text())
    assert "The reference rests at force = 0 N/kg of -2 … 2." in page


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
    logs().save(tmp_path / "logs.npz")
    text = GOAL.replace("weight = 0.01", "weight = 1000.0")  # an input so dear that nothing is reached
    (tmp_path / "goal.toml").write_text(text)
    made = design_data(tmp_path / "logs.npz", tmp_path / "goal.toml", tmp_path / "out", FitOptions(linear=True))
    done = check_controller(made.controller, tmp_path, runs=3, rate=0.5)
    assert not done.kept
    assert any("off its reference, 5 % are allowed" in reason for reason in done.reasons)
    assert str(done).startswith("THE GOAL IS NOT KEPT")


def test_a_reference_that_no_input_holds_is_not_kept_where_every_run_ends_far_from_it(made, tmp_path, monkeypatch):
    monkeypatch.setattr("koopmpc.apps.fitting.check.kinds", lambda *_, **__: [RunKind("as in the data")])
    saved = load_value(made.controller, SavedDesign)
    asked = replace(saved.evidence.task, reference=saved.evidence.task.reference * [1, 0] + [0, 0.7])  # x and speed
    evidence = replace(saved.evidence, task=asked, goal_can_be_held=False)
    save_value(replace(saved, evidence=evidence), tmp_path / "design.npz")
    done = check_controller(tmp_path / "design.npz", tmp_path, runs=2, rate=0.5)
    assert done.verdict == "not kept"
    assert re.match("as in the data: every run ends .* or more off its reference, 5 % are allowed", done.reasons[0])
    assert done.reasons[1].startswith("no input holds position = 0.5 m, speed = 0.7 m/s")


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


def test_the_template_is_a_goal_file_with_the_ranges_of_the_logs(tmp_path):
    data = logs()
    text = format_template(data)
    goal = goal_of(text, tmp_path)
    U = np.concatenate([episode.U for episode in data])
    np.testing.assert_allclose(goal.limits.inputs(1), [[U.min()], [U.max()]], rtol=1e-2)
    X = np.concatenate([episode.X for episode in data])
    np.testing.assert_allclose(np.diag(goal.cost.matrices(2, 1)[0]), 4 / np.ptp(X, axis=0) ** 2, rtol=1e-2)
    assert f"in the data from {X[:, 0].min():.4g} to {X[:, 0].max():.4g}" in text
    assert "steps of 0.1 s" in text
    (line,) = (line for line in text.splitlines() if line.startswith("horizon = "))
    assert line.count(" s ") == 1  # the sample time alone: a product would stay behind when the number is changed
    assert "half of the time in which the closed loop is to settle" in text
    assert "A weight says what an error costs" in text


def test_states_without_weight_are_not_tracked_and_a_list_is_a_reference_for_each_step(tmp_path):
    text = GOAL.replace("reference = 0.5", "reference = [0.0, 0.1, 0.2]").replace("weight = 0.1", "weight = 0")
    goal = goal_of(text, tmp_path)
    assert goal.cost.of == km.State(["position [m]"])
    np.testing.assert_array_equal(goal.reference, [[0.0], [0.1], [0.2]])
    assert goal.limits.states(2).high[1] == 0.8


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("position [m]", "position [cm]", r"is in another unit than the logs, which have 'position \[m\]'"),
        ("position [m]", "position", r"is not written as in the logs, which have 'position \[m\]'; write that"),
        ("position [m]", "postion [m]", r"names nothing in the logs"),
        ("reference = 0.5", "refrence = 0.5", "has 'refrence'.*reference"),
        ("reference = 0.5", "reference = nan", "reference is nan; write a number"),
        ("reference = 0.5", 'reference = "up"', "write a number, or a list"),
        ("reference = 0.5", "", "has a weight and no reference"),
        ("weight = 1.0", "weight = -1.0", "weight is -1.0; write a number of 0 or above"),
        ("weight = 1.0", "weight = nan", "weight is nan"),
        ("[-0.8, 0.8]", "[nan, 0.8]", r"limits is \[nan, 0.8\]; write a number"),
        ("[-0.8, 0.8]", "[0.8, -0.8]", "cross; write the lower one first"),
        ("[-0.8, 0.8]", "[0.8]", r"write \[low, high\]"),
        ("horizon = 15", "horizon = 0", "a horizon of 0; write a whole number"),
        ("horizon = 15", "horizont = 15", "has 'horizont'"),
        ("horizon = 15", "horizon = ", "is not valid TOML"),
        ("reference = 0.0", "reference = [0.0, 1.0]\nangle = 3", "angle is 3; write true or false"),
    ],
)
def test_a_goal_file_that_makes_no_sense_is_refused_in_a_sentence(old, new, sentence, tmp_path):
    assert old in GOAL
    with pytest.raises(km.KoopmpcError, match=sentence):
        goal_of(GOAL.replace(old, new, 1), tmp_path)


def test_references_of_unequal_lengths_and_goals_that_ask_nothing_are_refused(tmp_path):
    two = GOAL.replace("reference = 0.5", "reference = [0, 1]").replace("reference = 0.0", "reference = [0, 1, 2]")
    with pytest.raises(km.KoopmpcError, match=r"references of \[2, 3\] values"):
        goal_of(two, tmp_path)
    none = GOAL.replace("weight = 1.0", "weight = 0").replace("weight = 0.1", "weight = 0")
    with pytest.raises(km.KoopmpcError, match="nothing is asked"):
        goal_of(none, tmp_path)


def test_the_commands_write_a_template_design_and_check(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    logs().save("logs.npz")
    call = CliRunner().invoke
    result = call(app, ["fit", "logs.npz", "--goal-template"])
    assert result.exit_code == 0, result.output
    assert "fit logs.npz --goal goal.toml" in result.stdout
    again = call(app, ["fit", "logs.npz", "--goal-template"])
    assert (again.exit_code, "goal.toml is there already" in again.stderr) == (2, True)
    Path("goal.toml").write_text(GOAL.replace("horizon = 15", "horizon = 10"))
    result = call(app, ["fit", "logs.npz", "--goal", "goal.toml", "--linear"])
    assert result.exit_code == 0, result.output
    assert "the reference rests at force = 0 N/kg of -2 … 2" in result.stdout
    file = result.stdout.split("controller: ")[1].split(", report")[0]
    checked = call(app, ["check", file, "--runs", "2", "--rate", "0.5"])
    assert checked.exit_code == 0, checked.output
    assert "the goal is kept" in checked.stdout
    saved = read_controller(file)
    assert isinstance(saved, SavedDesign)
    steps = saved.evidence.expected.steps
    told = [" ".join(text.split()) for text in (result.stdout, checked.stdout)]
    assert f"expected over {steps} steps ({format_duration(0.1 * steps)})" in told[0]
    for text in told:  # the run length stands beside each cost, and how to compare one's own run
        assert f"compare the first {steps} steps: km.metrics(run.take_first({steps})).cost" in text
    assert f"A cost is the sum over the first {steps} steps ({format_duration(0.1 * steps)}) of a run." in told[1]
    both = call(app, ["fit", "logs.npz", "--goal", "goal.toml", "--horizon", "9"])
    assert both.exit_code == 2
    assert "--horizon 9 is of no use with --goal; write horizon = 9 into goal.toml" in " ".join(both.stderr.split())
    missing = call(app, ["check", "none.npz"])
    assert missing.exit_code == 2
    assert "none.npz" in missing.stderr


def test_too_few_short_logs_for_a_goal_are_refused_with_what_to_record(tmp_path):
    short = km.Episodes([km.Episode(X=e.X[:9], U=e.U[:8]) for e in logs()][:2], logs().dt, logs().states, logs().inputs)
    short.save(tmp_path / "short.npz")
    (tmp_path / "goal.toml").write_text(GOAL)
    with pytest.raises(km.KoopmpcError, match="record more episodes, or longer ones") as caught:
        design_data(tmp_path / "short.npz", tmp_path / "goal.toml", tmp_path)
    assert "--horizon" not in str(caught.value)


def test_a_check_of_what_is_no_controller_exits_with_2_and_says_what_to_pass(tmp_path, made):
    cut, goal = tmp_path / "cut.npz", tmp_path / "goal.toml"
    cut.write_bytes(made.controller.read_bytes()[:-300])
    goal.write_text(GOAL)
    for file in (cut, goal, tmp_path):
        result = CliRunner().invoke(app, ["check", str(file)])
        assert result.exit_code == 2
        said = " ".join(result.stderr.split())
        assert file.name in said
        assert "pass the .npz of a saved Controller or Design" in said


def test_the_check_exits_with_1_where_the_goal_is_not_kept(tmp_path, monkeypatch, made):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("koopmpc.apps.fitting.check.ALLOWED_OFF", -1.0)
    monkeypatch.setattr("koopmpc.apps.fitting.check.ARRIVED", -1.0)
    result = CliRunner().invoke(app, ["check", str(made.controller), "--runs", "1", "--rate", "0.5"])
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
