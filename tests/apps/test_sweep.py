"""sweep: a row, a log and a verdict for every run; what one run raises stays with that run."""

import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import koopmpc as km
from tests.apps.test_table import printed
from tests.apps.tiny import write
from tests.commands import koopmpc

EIGHT = [
    "lqr",
    "koopman-lqr",
    "linear-mpc",
    "koopman-mpc",
    "offset-free",
    "bilinear-mpc",
    "bilinear-offset",
    "nonlinear-mpc",
]
KINDS = ["lqr", "koopman-mpc", "offset-free", "bilinear-offset", "nonlinear-mpc"]  # the others are of the same classes


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swept")
    problem = km.load_problem(write(folder))
    told = []
    rows = km.sweep([problem], folder=folder / "logs", progress=lambda *step: told.append(step))
    return problem, rows, folder / "logs", told


def test_every_controller_meets_every_case_once(swept):
    _, rows, _, told = swept
    assert [(r.problem, r.case, r.controller) for r in rows] == [
        ("tiny", case, name) for case in ("near", "far") for name in EIGHT
    ]
    assert [done for _, done, _ in told] == list(range(17))
    assert {total for *_, total in told} == {16}


def test_all_end_as_they_should_and_the_short_case_is_no_failure(swept):
    _, rows, _, _ = swept
    assert [row.failure for row in rows] == [None] * 16
    assert all(row.reached for row in rows if row.case == "near")
    assert not any(row.reached for row in rows if row.case == "far")  # 6 steps are too few: a result, not a failure


def test_figures_are_those_of_the_log_alone(swept):
    _, rows, _, _ = swept
    for row in rows:
        assert km.metrics(km.load_run(row.log)) == row.metrics


def test_the_same_cost_and_limits_judge_every_controller(swept):
    problem, rows, _, _ = swept
    for row in rows:
        run = km.load_run(row.log)
        assert run.cost == problem.cost
        assert run.limits == problem.limits_of(row.case)
        assert np.abs(run.U).max() <= (2.0 if row.case == "near" else 1.0)
        assert run.metadata["controller"] == row.controller
        assert run.plans is not None or row.controller.endswith("lqr")


def test_no_controller_beats_the_oracle_by_much(swept):
    _, rows, _, _ = swept
    cost = {(row.case, row.controller): row.metrics.cost for row in rows}
    for (case, name), value in cost.items():
        assert value >= 0.97 * cost[case, "nonlinear-mpc"], name


def test_the_table_on_disk_has_a_row_a_run(swept):
    _, rows, folder, _ = swept
    stored = pq.read_table(folder / "results.parquet").to_pylist()
    assert len(stored) == len(rows)
    for line, row in zip(stored, rows, strict=True):
        assert (line["case"], line["controller"], line["log"]) == (row.case, row.controller, row.log.name)
        assert line["cost"] == row.metrics.cost
        assert line["final_error"] == row.metrics.final_error.tolist()
        assert sum(line["status"].values()) == 40 if row.case == "near" else 6
        assert set(line["status"]) == {s.name for s in km.Status}


def test_a_run_is_the_same_when_it_is_repeated(swept, tmp_path):
    problem, rows, _, _ = swept
    again = km.sweep([problem.select("near")], ["koopman-mpc"], folder=tmp_path)
    first = next(row for row in rows if (row.case, row.controller) == ("near", "koopman-mpc"))
    assert np.array_equal(km.load_run(again[0].log).U, km.load_run(first.log).U)


def test_data_and_model_are_made_once(swept):
    parts = km.bench.Prepared(swept[0])
    assert parts.model is parts.model
    assert parts.truth is parts.step_map
    assert parts.training_time > 0


def test_the_runs_of_a_case_are_shown_when_its_last_one_is_finished(tmp_path):
    problem, shown, done = km.load_problem(write(tmp_path)), [], []

    def sweep(controllers):
        return km.sweep(
            [problem],
            controllers,
            folder=tmp_path / "logs",
            progress=lambda what, count, total: done.append(count),
            on_case=lambda runs: shown.append((done[-1], [(row.case, row.controller) for row in runs])),
        )

    names = ["lqr", "koopman-mpc"]
    sweep(names)
    cases = [[(case, name) for name in names] for case in ("near", "far")]
    assert shown == [(2, cases[0]), (4, cases[1])]
    sweep(names)  # all are finished already
    assert shown[2:] == [(4, cases[0]), (4, cases[1])]


def test_what_has_ended_at_ctrl_c_has_its_log_and_is_not_run_again(tmp_path):
    def interrupt(runs):
        raise KeyboardInterrupt

    problem, logs, told = km.load_problem(write(tmp_path)), tmp_path / "logs", []
    with pytest.raises(KeyboardInterrupt):
        km.sweep([problem], ["lqr", "koopman-lqr"], folder=logs, on_case=interrupt)
    kept = km.bench.load_rows(logs)
    assert [row.controller for row in kept] == ["lqr", "koopman-lqr"]
    assert all(km.load_run(row.log).steps == problem.cases[row.case].steps for row in kept)
    assert pq.read_table(logs / "results.parquet").num_rows == 2
    rows = km.sweep([problem], ["lqr", "koopman-lqr"], folder=logs, on_case=told.extend)
    assert [row.name for row in told] == [row.name for row in rows]
    assert rows[:2] == kept
    assert all(row.log.is_file() for row in rows)


def test_the_truth_may_be_another_plant(swept):
    problem, *_ = swept
    heavier = type(problem.dynamics)
    parts = km.bench.Prepared(replace(problem, plant=heavier()))
    assert parts.truth is not parts.step_map
    np.testing.assert_array_equal(parts.truth([0.3], [0.1]), parts.step_map([0.3], [0.1]))
    given = km.bench.Prepared(problem).step_map
    assert km.bench.Prepared(replace(problem, plant=given)).truth is given


def test_what_one_controller_raises_is_its_row_and_the_others_go_on(swept, tmp_path, monkeypatch):
    def broken(parts, limits):
        raise RuntimeError("no such gain")

    monkeypatch.setitem(km.bench.CONTROLLERS, "koopman-lqr", replace(km.bench.CONTROLLERS["koopman-lqr"], build=broken))
    rows = km.sweep([swept[0].select("far")], folder=tmp_path)
    assert [row.controller for row in rows if row.failure] == ["koopman-lqr"]
    (row,) = (row for row in rows if row.failure)
    assert row.failure.startswith("RuntimeError: no such gain (the whole traceback is in")
    assert row.metrics is None
    assert row.log is None
    assert "in broken" in (tmp_path / "tiny-far-koopman-lqr.txt").read_text()
    assert pq.read_table(tmp_path / "results.parquet")["cost"].null_count == 1


def test_a_model_that_cannot_be_learned_takes_only_its_own_controllers(tmp_path):
    broken = write(tmp_path, **{"km.Noise(-2.0, 2.0)": "lambda k, y, rng: [float('nan')]"})
    rows = km.sweep([km.load_problem(f"{broken}:far")], folder=tmp_path)
    assert [row.controller for row in rows if row.failure] == [
        "koopman-lqr",
        "koopman-mpc",
        "offset-free",
        "bilinear-mpc",
        "bilinear-offset",
    ]


class Cheat:
    """A controller that leaves its limits."""

    nu, horizon = 1, 0

    def __init__(self, dt, u):
        self.dt, self.u = dt, u

    def reset(self, x0=None, u_prev=None):
        """Nothing to forget."""

    def __call__(self, y, reference, applied=None):
        return km.Move(np.array([self.u]), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


@pytest.mark.parametrize(
    ("u", "why"), [(1.5, "u = [1.5] at step 0 is 0.5 beyond a hard limit"), (np.nan, "every input must be finite")]
)
def test_an_input_that_is_beyond_its_limit_or_not_finite_is_a_failure(swept, tmp_path, monkeypatch, u, why):
    lqr = replace(km.bench.CONTROLLERS["lqr"], build=lambda parts, limits: Cheat(0.1, u))
    monkeypatch.setitem(km.bench.CONTROLLERS, "lqr", lqr)
    (row,) = km.sweep([swept[0].select("far")], ["lqr"], folder=tmp_path)
    assert why in row.failure
    assert (row.metrics is None) == (u != u)


def test_a_log_that_differs_is_a_failure(swept, tmp_path, monkeypatch):
    monkeypatch.setattr("koopmpc.apps.bench.single.load_run", lambda path: None)
    (row,) = km.sweep([swept[0].select("far")], ["lqr"], folder=tmp_path)
    assert row.failure == "tiny-far-lqr.rrd does not read back equal to the run"


@pytest.mark.parametrize("scene", ["raises", "is no list", "renames"])
def test_a_scene_that_cannot_be_drawn_costs_the_drawing_and_nothing_else(swept, tmp_path, scene):
    def drawn(x, u):
        if scene == "raises" and x[0] < 0.9:
            raise ZeroDivisionError("division by [zero]")
        disk = km.scene.Disk("b" if scene == "renames" and x[0] < 0.9 else "a", (0.0, 0.0), 0.1)
        return 3 if scene == "is no list" else [disk]

    problem = replace(swept[0].select("far"), scene=drawn)
    rows = km.sweep([problem], ["lqr", "koopman-mpc"], folder=tmp_path)
    whole = {row.controller: row for row in swept[1] if row.case == "far"}
    for row in rows:
        assert row.failure.startswith("the log is without its scene: drawing scene(x, u) raised ")
        assert scene != "raises" or "ZeroDivisionError: division by [zero]" in row.failure
        assert row.metrics.cost == whole[row.controller].metrics.cost
        assert np.array_equal(km.load_run(row.log).U, km.load_run(whole[row.controller].log).U)
        assert "drawn" in row.log.with_suffix(".txt").read_text() or scene != "raises"


def test_a_log_that_cannot_be_written_takes_no_figures_and_is_not_offered(swept, tmp_path, monkeypatch):
    def full(run, path, **drawn):
        raise OSError("no space left")

    monkeypatch.setattr("koopmpc.apps.bench.single.record", full)
    (row,) = km.sweep([swept[0].select("far")], ["lqr"], folder=tmp_path)
    assert row.failure.startswith("OSError: no space left (the whole traceback is in ")
    assert row.metrics is not None
    assert row.log is None
    assert not list(tmp_path.glob("*.rrd"))
    assert km.bench.row_to_view([row]) is None


def test_the_run_to_look_at_is_the_hardest_that_koopman_mpc_manages(swept):
    def ran(case, controller, cost, reached=True, fault=None):
        figures = replace(swept[1][0].metrics, cost=cost)
        return km.bench.RunRow("p", case, controller, figures, reached, log=Path(f"{case}.rrd"), fault=fault)

    rows = [
        ran("easy", "lqr", 1.0),
        ran("easy", "koopman-mpc", 1.01),
        ran("easy", "nonlinear-mpc", 1.0),
        ran("hard", "koopman-mpc", 220.0),
        ran("hard", "nonlinear-mpc", 200.0),
        ran("lost", "koopman-mpc", 9.0, reached=False),
        ran("lost", "nonlinear-mpc", 1.0),
        ran("easy", "koopman-mpc", 5.0, fault="nan-sensor"),
    ]
    assert km.bench.row_to_view(rows) is rows[3]
    assert km.bench.row_to_view(rows[:1]) is rows[0]
    assert km.bench.row_to_view([rows[1], rows[3]]) is rows[1]
    assert km.bench.row_to_view([rows[5]]) is rows[5]
    assert km.bench.row_to_view([]) is None


class Unseen(km.Recorder):
    """A Recorder that streams nowhere."""

    def __init__(self, *, live, **about):
        assert live
        super().__init__(None, live=True, **about)

    def __enter__(self):
        self._open = True
        return self


def test_a_live_run_leaves_the_same_log(swept, tmp_path, monkeypatch):
    problem, rows, _, _ = swept
    monkeypatch.setattr("koopmpc.apps.bench.sweep.find_viewer", lambda: "somewhere")
    monkeypatch.setattr("koopmpc.apps.bench.single.Recorder", Unseen)
    (row,) = km.sweep(
        [problem.select("far")], ["koopman-mpc"], folder=tmp_path, options=km.bench.SweepOptions(live=True)
    )
    assert row.failure is None
    live = km.load_run(row.log)
    kept = km.load_run(next(r.log for r in rows if (r.case, r.controller) == ("far", "koopman-mpc")))
    assert np.array_equal(live.U, kept.U)
    assert live.plans == kept.plans
    assert live.metadata == kept.metadata


def test_a_paced_run_takes_as_long_as_its_plant_and_is_the_same(swept, tmp_path):
    problem, rows, _, _ = swept
    begin = time.monotonic()
    (row,) = km.sweep([problem.select("far")], ["lqr"], folder=tmp_path, options=km.bench.SweepOptions(paced=True))
    assert time.monotonic() - begin > 5 * problem.dt
    assert row.metrics.cost == next(r.metrics.cost for r in rows if (r.case, r.controller) == ("far", "lqr"))


@pytest.mark.filterwarnings("default:--live")
@pytest.mark.parametrize("fails", [False, True])
def test_live_without_a_viewer_or_a_display_serves_a_page_while_runs_go_on(tmp_path, monkeypatch, fails):
    pages = []

    @contextmanager
    def served(logs, *, live):
        if fails:
            raise km.errors.LogError("the port is taken")
        pages.append(live)
        yield "http://here", 1
        pages.append("closed")

    monkeypatch.setattr("koopmpc.views.recording.viewer.is_up", lambda port: False)
    monkeypatch.setattr("koopmpc.views.recording.viewer.has_display", lambda: False)
    monkeypatch.setattr("koopmpc.views.recording.viewer.serve", served)
    monkeypatch.setattr("koopmpc.apps.bench.sweep.find_viewer", lambda: "somewhere")
    monkeypatch.setattr("koopmpc.apps.bench.single.Recorder", Unseen)
    tiny = str(write(tmp_path))
    shown = koopmpc("run", f"{tiny}:far", "-c", "lqr", "--live", "--logs", tmp_path / "logs")
    assert shown.exit_code == 0
    assert pages == ([] if fails else [True, "closed"])
    assert ("no page to show the runs on: the port is taken" if fails else "open http://here") in shown.output


def test_no_viewer_costs_one_warning_and_no_run(swept, tmp_path, monkeypatch):
    monkeypatch.setattr("koopmpc.apps.bench.sweep.find_viewer", lambda: None)
    with pytest.warns(UserWarning, match="no Rerun viewer listens at") as caught:
        rows = km.sweep(
            [swept[0].select("far")], ["lqr", "koopman-mpc"], folder=tmp_path, options=km.bench.SweepOptions(live=True)
        )
    assert len(caught) == 1
    assert [row.failure for row in rows] == [None, None]


def test_missing_steps_and_statuses_are_failures(swept):
    run = km.load_run(next(row.log for row in swept[1] if row.case == "far"))
    assert km.bench.failures(run, 6) == []
    assert km.bench.failures(run, 7) == ["it took 6 of 7 steps"]
    assert km.bench.failures(replace(run, status=run.status[:-1]), 6) == ["5 of 6 steps have a status"]
    assert km.bench.failures(replace(run, U=np.full_like(run.U, np.inf)), 6) == ["u is [inf] at step 0"]


def test_reached_is_a_band_of_five_percent_over_the_last_tenth(swept):
    run = km.load_run(next(row.log for row in swept[1] if row.case == "near"))
    X = np.full_like(run.X, 1.0)
    X[1:] = 0.049
    assert km.bench.reached(replace(run, X=X))
    X[-2] = 0.051
    assert not km.bench.reached(replace(run, X=X))
    X[-2], X[20] = 0.0, 3.0
    assert km.bench.reached(replace(run, X=X))


def test_an_unknown_controller_suggests_the_nearest(swept, tmp_path):
    with pytest.raises(km.errors.ProblemError, match=r"no controller 'koopman-mcp', did you mean 'koopman-mpc'\?"):
        km.sweep([swept[0]], ["koopman-mcp"], folder=tmp_path)
    assert list(km.bench.CONTROLLERS) == [*EIGHT, "pid", "adaptive", "designed"]


def test_a_case_that_comes_twice_is_refused_before_anything_runs(swept, tmp_path):
    both = [swept[0], swept[0].select("far")]
    with pytest.raises(km.errors.ProblemError, match=r"tiny:far comes twice, and its logs would have one name"):
        km.sweep(both, folder=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    rows = km.sweep([swept[0].select("near"), swept[0].select("far")], ["lqr"], folder=tmp_path)
    assert [row.failure for row in rows] == [None, None]


@pytest.fixture(scope="module")
def faulty(swept, tmp_path_factory):
    folder = tmp_path_factory.mktemp("faulty")
    rows = km.sweep([swept[0].select("near")], KINDS, folder=folder, options=km.bench.SweepOptions(faults=True))
    short = km.sweep(
        [swept[0].select("far")],
        ["lqr", "koopman-mpc"],
        folder=folder / "far",
        options=km.bench.SweepOptions(faults=True),
    )
    return [*rows, *short], folder


def test_every_kind_of_controller_meets_every_fault_and_ends_as_it_should(faulty):
    rows, folder = faulty
    faults = (None, *km.bench.FAULTS)
    assert [(r.case, r.fault, r.controller) for r in rows] == [
        *(("near", fault, name) for fault in faults for name in KINDS),
        *(("far", fault, name) for fault in faults for name in ("lqr", "koopman-mpc")),
    ]
    assert [row.failure for row in rows] == [None] * len(rows)
    rows = rows[: -2 * len(faults)]
    assert len({row.log for row in rows}) == len(rows)
    stored = pq.read_table(folder / "results.parquet").to_pylist()
    assert [(line["fault"], line["failure"]) for line in stored] == [(row.fault, None) for row in rows]


def test_a_fault_is_named_in_its_log_and_in_no_other(faulty):
    for row in faulty[0]:
        metadata = km.load_run(row.log).metadata
        if row.fault is None:
            assert not metadata.keys() & {"fault", "faults"}
        else:
            assert metadata["fault"] == row.fault
            assert metadata["faults"] == (str(km.bench.FAULTS[row.fault]),)
            assert row.log.name == f"tiny-{row.case}-{row.controller}-{row.fault}.rrd"


def test_rows_without_a_fault_are_those_of_a_sweep_without_faults(swept, faulty):
    bare = [row for row in faulty[0] if row.fault is None]
    without = {(row.case, row.controller): row for row in swept[1]}
    for row in bare:
        other = without[row.case, row.controller]
        assert np.array_equal(km.load_run(row.log).U, km.load_run(other.log).U)


def test_all_controllers_meet_the_same_faults(faulty):
    hidden, lost = [], []
    for row in faulty[0]:
        run = km.load_run(row.log)
        if row.fault == "nan-sensor" and row.case == "near":
            hidden.append(np.isnan(run.Y))
        if row.fault == "actuator-loss":
            lost.append(np.abs(run.U).max() / (2.0 if row.case == "near" else 1.0))
    assert hidden[0].any()
    assert all(np.array_equal(hidden[0], mask) for mask in hidden)
    assert max(lost) <= 0.5


@pytest.mark.parametrize(
    ("limits", "loses"), [({"x_max": 5.0}, False), ({"u_min": -np.inf}, False), ({"u_max": 1.0}, True)]
)
def test_an_actuator_without_a_range_has_none_to_lose(swept, tmp_path, limits, loses):
    problem = replace(swept[0].select("near"), limits=km.Limits(**limits))
    rows = km.sweep([problem], ["lqr"], folder=tmp_path, options=km.bench.SweepOptions(faults=True))
    assert [row.fault for row in rows] == [
        None,
        *(name for name in km.bench.FAULTS if loses or name != "actuator-loss"),
    ]
    assert not any(row.failure for row in rows)


def test_a_run_that_diverged_reaches_nothing_and_warns_of_nothing(swept):
    run = km.load_run(next(row.log for row in swept[1] if row.case == "far"))
    for value in (np.inf, np.nan, 1e200):
        assert not km.bench.reached(replace(run, X=np.full_like(run.X, value)))


def test_a_monitor_counts_unknown_steps_of_learned_mpc_in_rows_logs_and_table(tmp_path):
    problem = km.load_problem(write(tmp_path))
    problem = replace(problem, cases={"near": problem.cases["near"]})
    names = ["lqr", "koopman-mpc", "offset-free", "bilinear-mpc", "bilinear-offset", "adaptive"]
    rows = km.sweep([problem], names, folder=tmp_path / "logs", options=km.bench.SweepOptions(monitor=True))
    assert [row.failure for row in rows] == [None] * 6
    assert [row.metrics.unknown is None for row in rows] == [name == "lqr" for name in names]
    assert (km.load_run(rows[1].log).known >= 0).all()
    assert "unknown" in printed(km.bench.results_table(rows[1:2]))
    assert "unknown" not in printed(km.bench.results_table(rows[:1]))
