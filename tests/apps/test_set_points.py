"""Set points in logs of closed loops: columns apart from what acts on the plant, and instruments of the design."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.apps.fitting.designing import design_data
from koopmpc.apps.fitting.logs import IN_MEMORY, read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.apps.fitting.set_points import take_set_points
from koopmpc.synthesis.search.feedback import remove_feedback
from tests.apps.mass import GOAL, A, B


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


@pytest.mark.slow
def test_set_points_in_a_table_are_instruments_of_the_design(tmp_path):
    """The runs are too short for a filter: without the set points nothing would take the noise out."""
    write_closed_loop(tmp_path / "loop.csv", runs=20, steps=60)
    data = km.load_episodes(tmp_path / "loop.csv", states=["position", "speed"], inputs=["force"])
    assert remove_feedback(data, None).episodes is data
    (tmp_path / "goal.toml").write_text(PLAIN)
    made = design_data(
        tmp_path / "loop.csv", tmp_path / "goal.toml", tmp_path, FitOptions(set_point=["goal"], linear=True)
    )
    assert any("rows of the set point explain" in note for note in made.design.notes), made.design.notes
    model = made.design.controller.predictor
    assert model.states == ("position", "speed")
    with pytest.raises(km.KoopmpcError, match="wish"):
        design_data(
            tmp_path / "loop.csv", tmp_path / "goal.toml", tmp_path, FitOptions(set_point=["wish"], linear=True)
        )
