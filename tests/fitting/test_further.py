"""koopmpc fit --goal --next: a refused design with a plan, new logs beside the old, and the stop rule."""

import numpy as np
import pytest
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.cli.app import app
from koopmpc.fitting import further
from koopmpc.fitting.goal import design_data
from koopmpc.fitting.repair import IN_MEMORY, read_logs
from koopmpc.fitting.set_points import take_set_points
from koopmpc.synthesis.feedback import remove_feedback
from tests.fitting.mass import GOAL, NAMES, A, B, logs


def few(seed=3):
    rng, x = np.random.default_rng(seed), np.array([0.0, 0.0])
    X, U = [x], 0.3 * np.repeat(rng.uniform(-1, 1, (6, 1)), 4, axis=0)
    for u in U:
        x = A @ x + B @ u
        X.append(x)
    return km.Episodes([km.Episode(X=np.array(X) + 1e-3 * rng.standard_normal((25, 2)), U=U)], 0.1, *NAMES)


def test_a_refused_design_comes_with_a_plan_that_stays_inside_the_limits(tmp_path):
    few().save(tmp_path / "few.npz")
    (tmp_path / "goal.toml").write_text(GOAL)
    with pytest.raises(km.KoopmpcError, match="the next experiment is planned in"):
        design_data(tmp_path / "few.npz", tmp_path / "goal.toml", tmp_path, plan=tmp_path / "plan.csv")
    assert (tmp_path / "plan.png").stat().st_size > 1000
    lines = [line for line in (tmp_path / "plan.csv").read_text().splitlines() if not line.startswith("#")]
    head, table = lines[0].split(","), np.array([line.split(",") for line in lines[1:]], dtype=float)
    assert table[:, head.index("high speed [m/s]")].max() <= 0.8
    assert np.abs(table[:, head.index("force [N/kg]")]).max() <= 2.0


def test_the_next_plan_knows_all_logs_also_those_that_are_held_out(tmp_path):
    (tmp_path / "goal.toml").write_text(GOAL)
    first, second = few(3)[0], few(4)[0]
    shares = []
    for name, episodes in {"few": [first], "more": [first, second, *logs(2, 60)]}.items():
        logs().with_episodes(episodes).save(tmp_path / f"{name}.npz")
        with pytest.raises(km.KoopmpcError, match="the next experiment is planned in"):
            design_data(tmp_path / f"{name}.npz", tmp_path / "goal.toml", tmp_path, plan=tmp_path / f"{name}.csv")
        words = (tmp_path / f"{name}.csv").read_text().split("errors by ")[1]
        shares.append(float(words.split(" %")[0]))
    assert shares[1] < 0.5 * shares[0]


def test_the_goal_says_which_columns_are_inputs_of_logs_that_are_too_few(tmp_path):
    for i, e in enumerate(few()):
        rows = [
            f"{0.1 * k:.1f},{x[0]:.6f},{x[1]:.6f},{u:.6f}" for k, (x, u) in enumerate(zip(e.X, e.U[:, 0], strict=False))
        ]
        (tmp_path / f"log{i}.csv").write_text("\n".join(["time [s],position [m],speed [m/s],F [N]", *rows]))
    (tmp_path / "goal.toml").write_text(GOAL.replace("force [N/kg]", "F [N]"))
    with pytest.raises(km.KoopmpcError, match="the next experiment is planned in"):
        design_data(tmp_path / "log0.csv", tmp_path / "goal.toml", tmp_path, plan=tmp_path / "plan.csv")
    lines = [line for line in (tmp_path / "plan.csv").read_text().splitlines() if not line.startswith("#")]
    assert "F [N]" in lines[0].split(",")


@pytest.mark.slow
def test_with_enough_logs_the_design_is_made_and_no_plan_is_written(tmp_path):
    logs().save(tmp_path / "logs.npz")
    (tmp_path / "goal.toml").write_text(GOAL)
    made = design_data(
        tmp_path / "logs.npz", tmp_path / "goal.toml", tmp_path, plan=tmp_path / "plan.csv", bilinear=False
    )
    assert made.further is not None
    assert "another experiment is not worth its length" in str(made.further)
    assert not (tmp_path / "plan.csv").exists()
    assert "not worth its length" in made.page.read_text()


def test_a_plan_needs_a_goal_and_a_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    logs().save("logs.npz")
    (tmp_path / "goal.toml").write_text(GOAL)
    alone = CliRunner().invoke(app, ["fit", "logs.npz", "--next", "plan.csv"])
    assert alone.exit_code == 2
    assert "--next needs --goal" in alone.output + alone.stderr
    sheet = CliRunner().invoke(app, ["fit", "logs.npz", "--goal", "goal.toml", "--next", "plan.xlsx"])
    assert sheet.exit_code == 2
    assert "does not end with .csv" in sheet.output + sheet.stderr


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


PLAIN = GOAL.replace(" [m]", "").replace(" [m/s]", "").replace(" [N/kg]", "")


def test_set_points_may_leave_out_their_unit(tmp_path):
    write_closed_loop(tmp_path / "loop.csv")
    text = (tmp_path / "loop.csv").read_text()
    (tmp_path / "loop.csv").write_text(text.replace("goal", "goal [m]", 1))
    reading = {"disturbances": ["goal"]}
    split = read_logs(tmp_path / "loop.csv", None, np.random.default_rng(0), IN_MEMORY, reading, "record more")
    left, signals = take_set_points(split, ["goal"])
    assert left.fitted.disturbances == left.held_out.disturbances == ()
    assert signals is not None
    assert {abs(one) for signal in signals for one in signal.ravel()} == {0.4}
    with pytest.raises(km.KoopmpcError, match="lack the column wish"):
        take_set_points(split, ["wish"])


def test_set_points_push_nothing_in_a_plan_from_few_logs(tmp_path, monkeypatch):
    write_closed_loop(tmp_path / "loop.csv", runs=1, steps=30)
    (tmp_path / "goal.toml").write_text(PLAIN)
    known = []

    def plan(data, *args, **more):
        known.append(data)
        return further.FurtherData(None, "no safe plan exists")

    monkeypatch.setattr("koopmpc.fitting.goal.plan_further", plan)
    with pytest.raises(km.KoopmpcError, match="too few"):
        design_data(
            tmp_path / "loop.csv", tmp_path / "goal.toml", tmp_path, plan=tmp_path / "plan.csv", set_points=["goal"]
        )
    assert (known[0].states, known[0].disturbances) == (("position", "speed"), ())


@pytest.mark.slow
def test_set_points_in_a_table_are_instruments_of_the_design(tmp_path):
    """The runs are too short for a filter: without the set points nothing would take the noise out."""
    write_closed_loop(tmp_path / "loop.csv", runs=20, steps=60)
    data = km.load_episodes(tmp_path / "loop.csv", states=["position", "speed"], inputs=["force"])
    assert remove_feedback(data, None).episodes is data
    (tmp_path / "goal.toml").write_text(PLAIN)
    made = design_data(tmp_path / "loop.csv", tmp_path / "goal.toml", tmp_path, set_points=["goal"], bilinear=False)
    assert any("rows of the set point explain" in note for note in made.design.notes), made.design.notes
    model = made.design.controller.predictor
    assert model.states == ("position", "speed")
    with pytest.raises(km.KoopmpcError, match="wish"):
        design_data(tmp_path / "loop.csv", tmp_path / "goal.toml", tmp_path, set_points=["wish"], bilinear=False)
