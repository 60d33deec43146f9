"""Several runs or curves in one set of plots, a page of words and pictures, the animation of a log as a video."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest

import koopmpc as km
from koopmpc.base.page import Curves, Page
from koopmpc.loop.metrics import running_cost, total_cost
from koopmpc.views.figures.reports import CurvePanel, draw_panels, draw_trajectories
from koopmpc.views.figures.style import save
from koopmpc.views.recording.comparison import record_comparison
from koopmpc.views.recording.plots import record_curves
from koopmpc.views.recording.video import export_video
from tests.views.logged import Logged
from tests.views.models import turning
from tests.views.runs import make_run


def pendulum_run(**named: str) -> km.Run:
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05)
    model = km.LinearPredictor.local(plant, [0, 0], [0])
    mpc = km.KoopmanMPC(model, problem.cost, problem.limits, 10)
    loop = {
        "reference": [0.2, 0],
        "steps": 20,
        "cost": problem.cost,
        "limits": problem.limits,
        "options": km.loop.LoopOptions(metadata=named, plans=True),
    }
    return km.simulate(plant, mpc, x0=[0.4, 0], **loop)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    for name in ("one", "two"):
        km.record(pendulum_run(problem="p", case="c", controller=name), folder / f"{name}.rrd")
    return [folder / "one.rrd", folder / "two.rrd"]


@pytest.mark.parametrize("R_delta", [None, 0.3])
def test_the_cost_so_far_grows_by_the_cost_of_each_step_and_ends_at_that_of_the_run(R_delta: float | None) -> None:
    made, rng = make_run(), np.random.default_rng(0)
    sized = {name: rng.standard_normal(getattr(made, name).shape) for name in ("X", "U", "reference", "u_reference")}
    for run in (pendulum_run(), replace(made, **sized)):
        weighed = replace(run, cost=km.Cost([2.0, 1.0], 0.5, R_delta=R_delta), angles=())
        so_far = running_cost(weighed)
        assert so_far[0] == 0
        assert so_far.shape == (run.steps + 1,)
        assert so_far[-1] == pytest.approx(km.metrics(weighed).cost)
        assert total_cost(weighed) == km.metrics(weighed).cost
        for k in (1, 5):
            error, moved = run.X[k] - run.reference[k], run.U[k - 1] - run.u_reference[k - 1]
            step = error @ np.diag([2.0, 1.0]) @ error + 0.5 * moved @ moved
            step += (R_delta or 0.0) * np.sum((run.U[k - 1] - run.U[k - 2]) ** 2) * (k > 1)
            assert so_far[k] - so_far[k - 1] == pytest.approx(step)
    none = running_cost(replace(make_run(), cost=None))
    assert none.shape == (21,)
    assert np.isnan(none).all()
    assert np.isnan(total_cost(replace(make_run(), cost=None)))
    with np.errstate(all="raise"):  # the cost of a loop that diverged overflows to inf in silence
        far = replace(run, X=np.full_like(run.X, 7e153), cost=km.Cost([2.0, 1.0], 0.5), angles=())
        assert np.isinf(running_cost(far)[-1])
        assert np.isinf(total_cost(far))


def test_each_run_is_a_curve_of_every_plot_and_a_column_of_the_table(logs: list[Path], tmp_path: Path) -> None:
    record_comparison(logs, tmp_path / "both.rrd")
    drawn = Logged(tmp_path / "both.rrd")
    runs = [km.load_run(log) for log in logs]
    for r, run in enumerate(runs, 1):
        assert drawn.matrix(f"state/0/{r}")[1][:, 0] == pytest.approx(run.X[:, 0])
        assert drawn.matrix(f"input/0/{r}")[1][:, 0] == pytest.approx(run.U[:, 0])
        assert drawn.matrix(f"cost/{r}")[1][-1, 0] == pytest.approx(km.metrics(run).cost)
        assert drawn.static(f"state/0/{r}", "names") == [("one", "two")[r - 1]]
    assert drawn.static("state/0/mark/0", "names") == ["reference"]
    assert "| metric | one | two |" in drawn.static("metrics", "text")[0]


def test_logs_that_cannot_be_compared_say_why(logs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(km.errors.LogError, match="a comparison needs two logs or more"):
        record_comparison(logs[:1], tmp_path / "both.rrd")
    km.record(replace(make_run(), states=("a", "b"), inputs=("c",), cost=None), tmp_path / "other.rrd")
    with pytest.raises(km.errors.LogError, match="no state and no input in common"):
        record_comparison([logs[0], tmp_path / "other.rrd"], tmp_path / "both.rrd")


def test_a_video_has_a_picture_a_moment_and_moves(logs: list[Path], tmp_path: Path) -> None:
    from PIL import Image

    export_video(logs[0], tmp_path / "out.gif", fps=10, width=200)
    with Image.open(tmp_path / "out.gif") as film:
        assert film.n_frames == 11  # 1 s at 10 pictures a second, and the first
        assert film.size[0] == 200
        first = np.asarray(film.convert("L"), dtype=float)
        film.seek(10)
        last = np.asarray(film.convert("L"), dtype=float)
    assert np.abs(first - last)[20:].max() > 50  # below the caption
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    export_video(logs[0], tmp_path / "out.mp4", fps=10, width=200, until=0.5)
    assert (tmp_path / "out.mp4").read_bytes()[4:8] == b"ftyp"


def test_what_no_video_can_be_made_of_says_why(logs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(km.KoopmpcError, match=r"ends in \.avi; a video is a \.gif or an \.mp4"):
        export_video(logs[0], tmp_path / "out.avi", until=0.1)
    km.record(make_run(), tmp_path / "plain.rrd")
    with pytest.raises(km.errors.LogError, match="has no scene to draw"):
        export_video(tmp_path / "plain.rrd", tmp_path / "out.gif")


def test_curves_come_back_and_gaps_stay_gaps(tmp_path):
    truth = np.arange(10.0).reshape(5, 2)
    holed = truth + 0.5
    holed[1, 0] = np.nan
    holed[:, 1] = np.nan  # no entity at all: a timeline without a row ends the viewer
    tab = Curves("one, two", 0.1, ("x [m]", "v [m/s]"), {"truth": truth, "model a": holed})
    record_curves([tab], tmp_path / "deep" / "c.rrd", application="koopmpc-test", page="# Uᵀ")
    log = Logged(tmp_path / "deep" / "c.rrd")
    np.testing.assert_array_equal(log.matrix("one_two/x_m/0_truth")[1], truth[:, :1])
    assert log.rows("one_two/x_m/1_model_a") == ([0, 2, 3, 4], [[0.5], [4.5], [6.5], [8.5]])
    np.testing.assert_array_equal(log.matrix("one_two/v_m_s/0_truth")[1], truth[:, 1:])
    assert "one_two/v_m_s/1_model_a" not in log.entities
    assert log.static("page", "text") == ["# U^T"]


TAB = Curves("one", 0.1, ("x",), {"truth": np.zeros((3, 1))})
WIDE = Curves("one", 0.1, ("x", "y"), {"truth": np.zeros((3, 1))})


@pytest.mark.parametrize(
    ("error", "text", "tabs"),
    [
        (km.errors.DataError, r"there is no curve to record", []),
        (km.errors.DataError, r"two tabs are called 'one'", [TAB, TAB]),
        (km.errors.ShapeError, r"truth has shape \(3, 1\), expected \(any, 2\)", [WIDE]),
    ],
)
def test_curves_that_cannot_be_drawn_are_named(tmp_path, error, text, tabs):
    with pytest.raises(error, match=text):
        record_curves(tabs, tmp_path / "c.rrd", application="koopmpc-test", page="")


def test_a_report_holds_its_parts_in_order_and_its_pictures_beside_it(tmp_path):
    page = Page(tmp_path, beside="mine")
    page.text("## Title", "two\nlines")
    page.table(("|u|", "b"), [(1, "x")])
    page.code("a  b")
    page.items(["one", "two"])
    page.picture("one", "A picture", partial(save, matplotlib.figure.Figure()))
    assert (tmp_path / "mine" / "one.png").read_bytes().startswith(b"\x89PNG")
    assert page.write().read_text(encoding="utf-8") == (
        "## Title\n\ntwo lines\n\n| \\|u\\| | b |\n| --- | --- |\n| 1 | x |\n\n```text\na  b\n```\n\n- one\n- two\n\n"
        "![A picture](mine/one.png)\n\n*A picture*\n"
    )
    assert "![" not in page.words
    assert "- two" in page.words


def test_a_picture_that_cannot_be_saved_leaves_the_report_as_it_was(tmp_path):
    (tmp_path / "one.png").mkdir()
    page = Page(tmp_path)
    with pytest.raises(km.errors.LogError, match="is a folder"):
        page.picture("one", "A picture", partial(save, matplotlib.figure.Figure()))
    assert page.parts == []


def test_every_curve_is_drawn_in_its_panel_with_one_look_a_name():
    t = np.linspace(1.0, 2.0, 5)
    one = CurvePanel("t [s]", "x", {"a": (t, t), "b": (t, -t)}, log="x", at=[0.5], ylim=(-3.0, 3.0))
    two = CurvePanel("t [s]", "y", {"b": (t[:3], t[:3])}, title="second", points=True, log="y")
    made = draw_panels([one, two, two])
    first, second, third, empty = made.axes
    assert [curve.get_label() for curve in first.get_lines()[1:]] == ["a", "b"]
    assert first.get_lines()[2].get_color() == second.get_lines()[0].get_color()
    assert first.get_xscale() == second.get_yscale() == "log"
    assert first.get_ylim() == (-3.0, 3.0)
    assert second.get_title() == third.get_title() == "second"
    np.testing.assert_array_equal(second.get_lines()[0].get_xdata(), t[:3])
    assert not empty.get_visible()


def test_no_panel_and_curves_of_two_lengths_are_refused():
    with pytest.raises(km.errors.DataError, match="there is no panel to draw"):
        draw_panels([])
    with pytest.raises(km.errors.ShapeError, match="'a' has 3 x and 2 y; pass one y for each x"):
        draw_panels([CurvePanel("x", "y", {"a": ([0, 1, 2], [0, 1])})])


def test_runs_of_a_report_show_the_limits_that_are_near() -> None:
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    limits = km.Limits(u_min=-5, u_max=5, x_max={"theta": 400, "omega": 0.3})
    mpc = km.LinearMPC(plant, [0, 0], [0], km.Cost(Q=[10, 1], R=0.01), limits, horizon=10)
    run = km.simulate(plant, mpc, x0=[0.3, 0], reference=[0, 0], steps=30, limits=limits)
    theta, omega, torque = draw_trajectories({"mpc": run}).axes
    lines = [
        [float(line.get_ydata()[0]) for line in panel.lines if line.get_label() == "limit"]
        for panel in (theta, omega, torque)
    ]
    assert lines == [[400], [0.3], [-5, 5]]
    assert theta.get_ylim()[1] < 1  # a limit far away does not flatten the curve
    assert omega.get_ylim()[1] > 0.3
    assert torque.get_ylim()[0] < -5


def test_runs_of_a_report_show_a_reference_of_their_states_alone() -> None:
    model, limits = turning(), km.Limits(-9, 9)
    for cost, columns, drawn in ((km.Cost(1, 1), 2, True), (km.Cost(1, 1, of=km.State([1])), 1, False)):
        mpc = km.KoopmanMPC(model, cost, limits, 4)
        run = km.simulate(model.step_map(), mpc, x0=[1, 0], reference=[0.5, 0.2][:columns], steps=5, cost=cost)
        shown = [
            [line.get_ydata().tolist() for line in panel.lines if line.get_label() == "reference"]
            for panel in draw_trajectories({"mpc": run}).axes
        ]
        assert shown == ([[[0.5] * 6], [[0.2] * 6], []] if drawn else [[], [], []])
    run = km.simulate(model.step_map(), lambda y, r: np.zeros(1), x0=[1, 0], reference=[0.5], steps=5)
    assert run.cost is None
    assert not any(
        line.get_label() == "reference" for panel in draw_trajectories({"law": run}).axes for line in panel.lines
    )
