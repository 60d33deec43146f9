"""From logs and a goal to a controller and its check: the files, the verdicts, and what a goal file must not say."""

import html
import re
import shlex
from dataclasses import replace
from inspect import Parameter, signature
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from koopmpc.apps.fitting.goal import format_template, load_reading, read_goal
from koopmpc.apps.fitting.logs import read_logs
from koopmpc.synthesis.designed import SavedDesign, read_controller
from koopmpc.synthesis.doubts import describe_rest
from tests.apps.mass import GOAL, NAMES, A, B, design, logs
from tests.commands import koopmpc
from tests.small_designs import small_designs, undrawn_pages


def test_inputs_that_only_the_goal_file_names_are_inputs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for i, episode in enumerate(logs()):
        rows = np.column_stack([0.1 * np.arange(40), episode.X[:-1], episode.U])
        head = "time [s],position [m],speed [m/s],push [V]"
        np.savetxt(f"{i}.csv", rows, delimiter=",", header=head, comments="")
    refused = koopmpc("fit", ".", "--goal-template")
    assert refused.exit_code == 2
    assert "no column is named as an input; its columns are" in refused.stderr
    assert "push [V] holds its value" in " ".join(refused.stderr.split())
    written = koopmpc("fit", ".", "--inputs", "push", "--horizon", "5", "--goal-template")
    assert written.exit_code == 0
    lines = Path("goal.toml").read_text().splitlines()
    Path("goal.toml").write_text("\n".join(line for line in lines if not line.startswith("inputs =")))
    told = []

    def stop(data, *_, **how):
        told.append((data.states, data.inputs, how["options"].feedthrough))
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    with pytest.raises(km.KoopmpcError, match="read"):
        design(tmp_path, Path("goal.toml").read_text(), ".")
    assert koopmpc("fit", ".", "--goal", "goal.toml", "--feedthrough").exit_code
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
    result = koopmpc("fit", "csv", *told.split(), "--goal-template")
    assert result.exit_code == 0, result.output

    def stop(data, *_, **options):
        asked.append((data.states, data.inputs, data.dt, options["horizon"], options["options"].bilinear))
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    line = shlex.split(result.stdout.partition("then: ")[2])
    assert "read" in koopmpc(*line[line.index("fit") :]).stderr
    assert asked == [(("level [cm]", "temperature [degC]"), ("inflow [l/s]", "heater [kW]"), 1.0, 8, False)]


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
    split = read_logs("csv", 10, np.random.default_rng(0), reading)
    named = [note for note in split.notes if f"csv/1.csv, line {number}" in note]
    assert named
    assert all("level = 999.99 cm" in note for note in named)
    assert not any("row " in note for note in named)
    for data in (split.seen, split.held_out):
        assert max(episode.X[:, 0].max() for episode in data) < 260
        assert all(episode.origin is None for episode in data)
    told = f"--states level,temperature --inputs inflow,heater {how}"
    assert koopmpc("fit", "csv", *told.split(), "--goal-template").exit_code == 0
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
        asked.update(arguments[3])
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.read_logs", stop)
    with pytest.raises(km.KoopmpcError, match="read"):
        design(tmp_path, path.read_text(), "logs", dt=0.25, inputs=None)
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
    horizon, ahead, tmp_path, monkeypatch, capsys
):
    def stop(*_, **__):
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    with pytest.raises(km.KoopmpcError, match="read"):
        design(tmp_path, GOAL.replace("horizon = 15", f"horizon = {horizon}"))
    said = capsys.readouterr().out
    assert f"horizon {ahead} steps" in said
    assert ("too short to judge a model over the 80 steps of the goal" in said) == (horizon == 80)


def test_a_template_says_which_columns_are_inputs_and_that_this_was_guessed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tank_logs(tmp_path / "csv")
    said = " ".join(koopmpc("fit", "csv", "--goal-template").stdout.split())
    assert "which columns are inputs was guessed from their names; --inputs" in said
    assert re.search(r"inputs .*heater \[kW\]", said)


def test_a_goal_file_keeps_the_step_that_an_uneven_clock_was_brought_to(tmp_path, monkeypatch):
    data, rng = logs(), np.random.default_rng(0)
    for i, episode in enumerate(data):
        times = 0.1 * (np.arange(40) + rng.uniform(-0.1, 0.1, 40))
        rows = np.column_stack([times, episode.X[:-1], episode.U])
        np.savetxt(tmp_path / f"{i}.csv", rows, delimiter=",", header="time [s],x,v,force", comments="")
    monkeypatch.chdir(tmp_path)
    named: list[list[str]] = []
    for asked in ((), ("--resample", "0.1")):
        said = koopmpc("fit", ".", "--goal-template", *asked).stdout
        text = Path("goal.toml").read_text()
        step = load_reading("goal.toml")["resample"]
        assert step == pytest.approx(0.1, rel=0.05)
        assert f"steps of {step:g} s" in text
        assert ("# nobody asked for it: steps of the logs are unequal" in text) == (not asked)
        named.append([line for line in said.splitlines() if "sampling is unequal in" in line])
        Path("goal.toml").unlink()
    assert len(named[0]) == len(named[1]) == 1  # the rows are named again where the goal file says how they are read
    assert re.search(r"0\.csv \(\d+ of 39, from line \d+\)", named[1][0])


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
    if not {"made", "promised"} & {*request.fixturenames}:
        monkeypatch.setattr("koopmpc.apps.fitting.designing.write_design_report", lambda *arguments: arguments[2])
        monkeypatch.setattr("koopmpc.apps.fitting.check.write_design_report", lambda *_, **__: None)
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
    result = koopmpc("fit", "logs.npz", "--goal-template")
    assert result.exit_code == 0, result.output
    assert "fit logs.npz --goal goal.toml" in result.stdout
    again = koopmpc("fit", "logs.npz", "--goal-template")
    assert (again.exit_code, "goal.toml is there already" in again.stderr) == (2, True)
    Path("goal.toml").write_text(GOAL.replace("horizon = 15", "horizon = 10"))
    result = koopmpc("fit", "logs.npz", "--goal", "goal.toml", "--linear")
    assert result.exit_code == 0, result.output
    assert "the reference rests at force = 0 N/kg of -2 … 2" in result.stdout
    file = result.stdout.split("controller: ")[1].split(", report")[0]
    checked = koopmpc("check", file, "--runs", "2", "--rate", "0.5")
    assert checked.exit_code == 0, checked.output
    assert "the goal is kept" in checked.stdout
    saved = read_controller(file)
    assert isinstance(saved, SavedDesign)
    steps = saved.evidence.expected.steps
    told = [" ".join(text.split()) for text in (result.stdout, checked.stdout)]
    assert f"expected over {steps} steps ({0.1 * steps:.3g} s)" in told[0]
    for text in told:  # the run length stands beside each cost, and how to compare one's own run
        assert f"compare the first {steps} steps: km.metrics(run.take_first({steps})).cost" in text
    assert f"A cost is the sum over the first {steps} steps ({0.1 * steps:.3g} s) of a run." in told[1]
    both = koopmpc("fit", "logs.npz", "--goal", "goal.toml", "--horizon", "9")
    assert both.exit_code == 2
    assert "--horizon 9 is of no use with --goal; write horizon = 9 into goal.toml" in " ".join(both.stderr.split())
    missing = koopmpc("check", "none.npz")
    assert missing.exit_code == 2
    assert "none.npz" in missing.stderr


def test_too_few_short_logs_for_a_goal_are_refused_with_what_to_record(tmp_path):
    short = km.Episodes([km.Episode(X=e.X[:9], U=e.U[:8]) for e in logs()][:2], logs().dt, logs().states, logs().inputs)
    short.save(tmp_path / "short.npz")
    with pytest.raises(km.KoopmpcError, match="record more episodes, or longer ones") as caught:
        design(tmp_path, GOAL, tmp_path / "short.npz")
    assert "--horizon" not in str(caught.value)


@pytest.fixture(scope="module")
def promised(tmp_path_factory):
    with small_designs(), undrawn_pages():
        goal = GOAL.replace("horizon = 15", "horizon = 8\nmargin = 0.9\ncertify = true")
        return design(tmp_path_factory.mktemp("promised"), goal)


def test_the_goal_file_asks_for_coverage_and_a_certificate_and_the_report_answers(promised, tmp_path):
    promise = promised.design.promise
    assert promise.coverage == 0.9
    assert promise.verified_on == 60
    text = " ".join(promised.page.read_text().split())
    assert "90 % of" in text
    assert "No certificate: the data have too few independent episodes" in text
    assert read_controller(promised.controller).evidence.promise == promise
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
        result = koopmpc("fit", "logs.npz", "--goal", "goal.toml", "--linear")
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


def test_a_promise_of_nearly_all_loops_is_not_said_to_be_one_of_all(promised):
    promise = replace(promised.design.promise, coverage=0.996, found=True, failures=0)
    assert "at least 99.6 % of runs" in str(promise)


def test_options_of_a_goal_need_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    logs().save(tmp_path / "logs.npz")
    result = koopmpc("fit", "logs.npz", "--margin", "0.95")
    assert result.exit_code == 2
    assert "pass --goal, too" in " ".join(result.stderr.split())


PLAIN = GOAL.replace(" [m]", "").replace(" [m/s]", "").replace(" [N/kg]", "")


def write_closed_loop(path, runs=6, steps=150):
    rng, lines = np.random.default_rng(0), ["run,t,position,speed,force,goal"]
    for run in range(runs):
        x, goals = np.zeros(2), np.repeat(rng.choice([-0.4, 0.4], steps // 6), 6)
        for k, goal in enumerate(goals):
            y = x + [0.03, 0.05] * rng.standard_normal(2)
            u = 3.0 * (goal - y[0]) - 2.0 * y[1]
            lines.append(f"{run},{0.1 * k:.1f},{y[0]:.6f},{y[1]:.6f},{u:.6f},{goal}")
            x = A @ x + B[:, 0] * u
    path.write_text("\n".join(lines))


def test_set_points_may_leave_out_their_unit_and_are_no_disturbances(tmp_path, monkeypatch):
    write_closed_loop(tmp_path / "loop.csv")
    text, told = (tmp_path / "loop.csv").read_text(), []
    (tmp_path / "loop.csv").write_text(text.replace("goal", "goal [m]", 1))

    def stop(data, *_, **how):
        told.append((data.disturbances, how["options"].instruments))
        raise km.KoopmpcError("read")

    monkeypatch.setattr("koopmpc.apps.fitting.designing.design", stop)
    for name, said in (("goal", "read"), ("wish", "wish")):
        with pytest.raises(km.KoopmpcError, match=said):
            design(tmp_path, PLAIN, tmp_path / "loop.csv", set_point=[name])
    ((disturbances, signals),) = told
    assert disturbances == ()
    assert {abs(one) for signal in signals for one in signal.ravel()} == {0.4}


@pytest.mark.slow
def test_set_points_in_a_table_are_instruments_of_the_design(tmp_path):
    """The runs are too short for a filter: without the set points nothing would take the noise out."""
    write_closed_loop(tmp_path / "loop.csv", runs=20, steps=60)
    made = design(tmp_path, PLAIN, tmp_path / "loop.csv", set_point=["goal"])
    assert any("rows of the set point explain" in note for note in made.design.notes), made.design.notes
    assert made.design.controller.predictor.states == ("position", "speed")


def test_rows_of_a_leaderboard_that_differ_in_the_tail_alone_are_one(made):
    design, row = made.design, made.design.best
    twin = replace(row, recipe=replace(row.recipe, tail=3))
    other = replace(twin, score=9.876)
    for place in (0, len(design.leaderboard)):
        board = [*design.leaderboard]
        board[place:place] = [twin]
        chosen = design.chosen + (place == 0)
        text = str(replace(design, leaderboard=(*board, other), chosen=chosen))
        rows = re.findall(r"%  +\d+ of \d+$", text, re.MULTILINE)
        assert len(rows) <= len(design.leaderboard) + 1
        assert any("more alike" in line for line in text.splitlines())
        assert sum(line.startswith("→") for line in text.splitlines()) == 1
        assert any("9.876" in line for line in text.splitlines()) or len(design.leaderboard) > 14
