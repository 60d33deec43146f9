"""A sweep's store: many starts, seeds and noises, workers, kill -9, and two sweeps that do not mix."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import binom

import koopmpc as km
from tests.apps.tiny import write

TWO = ["lqr", "koopman-mpc"]
GRID = {"starts": 6, "seeds": 2, "noise": [0.0, 0.05]}


def figures(rows):
    """What is the same in each run of the same: all but times and paths."""
    times = {"solve_time_p50": 0.0, "solve_time_p99": 0.0, "solve_time_max": 0.0, "late": 0}
    return {row.key: (replace(row.metrics, **times), row.reached, row.x0, row.failure) for row in rows}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return km.load_problem(write(tmp_path_factory.mktemp("problem")))


@pytest.fixture(scope="module")
def whole(problem, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**GRID)), folder


def test_every_combination_runs_once_and_what_learns_nothing_has_one_seed(whole):
    rows, folder = whole
    assert len(rows) == len({row.key for row in rows}) == 2 * 2 * 6 * (1 + 2)
    assert all(row.failure is None for row in rows)
    stored = pq.read_table(folder / "results.parquet").to_pylist()
    assert [(line["controller"], line["start"], line["noise"], line["cost"]) for line in stored] == [
        (row.controller, row.start, row.noise, row.metrics.cost) for row in rows
    ]
    assert figures(km.bench.load_rows(folder)) == figures(rows)


def test_all_controllers_meet_the_same_starts_and_the_same_noise(whole):
    rows, _ = whole
    starts = {}
    for row in rows:
        starts.setdefault((row.case, row.start), set()).add(row.x0)
    assert all(len(found) == 1 for found in starts.values())
    assert len({x0 for found in starts.values() for x0 in found}) == 5 + 2
    loud = {row.key: row.metrics.cost for row in rows}
    differ = [loud[key] != loud[(*key[:4], 0.05, *key[5:])] for key in loud if key[4] == 0.0]
    assert np.mean(differ) > 0.7  # an input that stays at its limit is the same with noise


def test_runs_of_a_seed_share_a_model_of_their_own_data(whole):
    rows, folder = whole
    runs = {row.key: row.metrics for row in rows if row.controller == "koopman-mpc"}
    pairs = [(one, runs[(*key[:6], 1, key[7])]) for key, one in runs.items() if key[6] == 0]
    at_limit = [all(set(run.status) == {"OPTIMAL"} for run in pair) for pair in pairs]  # in every step
    apart = [abs(one.cost / other.cost - 1) for one, other in pairs]
    assert max(np.array(apart)[at_limit]) < 1e-12  # an input at its limit is the same of each model
    assert min(np.array(apart)[np.logical_not(at_limit)]) > 1e-6  # and any other input is not
    files = sorted((folder / "models").glob("*.npz"))
    assert [path.name for path in files] == ["tiny-0-linear.npz", "tiny-1-linear.npz"]
    first, second = map(km.load_model, files)
    assert not np.array_equal(first.A, second.A)


def test_workers_give_what_one_process_gives_and_learn_once(problem, whole, tmp_path):
    rows = km.sweep([problem], TWO, folder=tmp_path, options=km.bench.SweepOptions(workers=2, **GRID))
    assert figures(rows) == figures(whole[0])
    assert [row.key for row in rows] == [row.key for row in whole[0]]
    assert len({row.training_time for row in rows if row.controller == "koopman-mpc" and row.seed == 0}) == 1


def test_what_is_finished_is_not_run_again(problem, whole, tmp_path):
    ran = []

    def stop(what, done, total):
        ran.append(what)
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        km.sweep([problem], TWO, folder=tmp_path, options=km.bench.SweepOptions(**GRID), progress=stop)
    assert pq.read_table(tmp_path / "results.parquet").num_rows == 20 == len(km.bench.load_rows(tmp_path))
    options = km.bench.SweepOptions(**GRID)
    rows = km.sweep([problem], TWO, folder=tmp_path, options=options, progress=lambda what, *_: ran.append(what))
    assert figures(rows) == figures(whole[0])
    assert len(ran) == 1 + 20 + 1 + len(rows) - 20  # each begins by naming what comes first, and none ran twice


def test_a_damaged_row_is_told_and_run_again_and_nothing_else(problem, whole, tmp_path):
    folder = shutil.copytree(whole[1], tmp_path / "damaged")
    with closing(sqlite3.connect(folder / "sweep.sqlite")) as file, file:
        (name,) = file.execute("SELECT name FROM texts WHERE name LIKE '%lqr%x3'").fetchone()
        file.execute("UPDATE texts SET text = replace(text, 'tiny', 'tony') WHERE name = ?", (name,))
    with pytest.warns(UserWarning, match=r"sweep.sqlite: 1 rows are damaged and were left out; the same sweep in this"):
        assert len(km.bench.load_rows(folder)) == len(whole[0]) - 1
    with pytest.warns(UserWarning, match="1 rows are damaged"):
        again = km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**GRID))
    assert figures(again) == figures(whole[0])
    assert len(km.bench.load_rows(folder)) == len(whole[0])


def test_a_sweep_of_an_older_edition_is_refused_with_advice(problem, tmp_path):
    (tmp_path / "sweep.json").write_text("{}")
    for use in (km.bench.load_rows, lambda folder: km.sweep([problem], TWO, folder=folder)):
        with pytest.raises(km.KoopmpcError, match=r"holds a sweep of an edition before 0.1.0.*run it again in another"):
            use(tmp_path)


def test_an_old_keyword_says_where_it_went(problem, tmp_path):
    with pytest.raises(TypeError, match=r"starts= is a field of the options now: pass options=km.bench.SweepOptions\("):
        km.sweep([problem], TWO, folder=tmp_path, starts=3)


def test_another_sweep_is_refused_in_the_same_folder(problem, whole, tmp_path):
    with pytest.raises(km.errors.ProblemError, match="holds another sweep, of other controllers, starts; pass another"):
        km.sweep([problem], ["lqr"], folder=whole[1], options=km.bench.SweepOptions(**{**GRID, "starts": 3}))
    changed = km.load_problem(write(tmp_path, "tiny", **{"Q=1.0": "Q=2.0"}))
    with pytest.raises(km.errors.ProblemError, match=r"holds another sweep, of other problems; pass another folder"):
        km.sweep([changed], TWO, folder=whole[1], options=km.bench.SweepOptions(**GRID))


@pytest.mark.parametrize(
    "part",
    [
        {"horizon": 3},
        {"ridge": 0.5},
        {"cost": km.Cost(Q=2.0, R=1.0)},
        {"cases": {"near": km.Case(x0=[0.2], reference=[0.0], steps=4)}},
    ],
)
def test_a_problem_that_was_changed_in_memory_is_another_one(part, problem, tmp_path):
    near = {"cases": {"near": km.Case(x0=[0.1], reference=[0.0], steps=4)}}
    first = replace(problem, **near)
    km.sweep([first], ["lqr"], folder=tmp_path)
    km.sweep([replace(problem, **near)], ["lqr"], folder=tmp_path)
    with pytest.raises(km.errors.ProblemError, match="holds another sweep, of other problems"):
        km.sweep([replace(first, **part)], ["lqr"], folder=tmp_path)


def test_wrong_parameters_move_the_plant_and_no_controller(tmp_path):
    problem = km.load_problem("pendulum:upright")
    rows = km.sweep([problem], TWO, folder=tmp_path, options=km.bench.SweepOptions(wrong=[0.0, 0.1], starts=2))
    costs = {row.key: row.metrics.cost for row in rows}
    assert all(cost != costs[(*key[:5], 0.1, *key[6:])] for key, cost in costs.items() if key[5] == 0.0)
    with pytest.raises(km.errors.ProblemError, match="its plant has no numbers as fields"):
        km.sweep(
            [km.load_problem(write(tmp_path))],
            ["lqr"],
            folder=tmp_path / "none",
            options=km.bench.SweepOptions(wrong=[0.1]),
        )


def test_a_problem_that_cannot_be_sent_says_so(problem, tmp_path):
    local = replace(problem, scene=lambda x, u: [])
    with pytest.raises(km.errors.ProblemError, match=r"cannot be sent to worker processes .* save it in a file"):
        km.sweep([local], ["lqr"], folder=tmp_path, options=km.bench.SweepOptions(workers=2))


def test_the_interval_of_a_median_holds_it_as_often_as_it_says():
    rng = np.random.default_rng(3)
    for n in (15, 2001, 40000):
        inside = 0
        for _ in range(100):
            middle, low, high = km.bench.median_interval(rng.exponential(size=n))
            assert low <= middle <= high
            inside += low <= np.log(2.0) <= high
        assert 85 <= inside <= 100


@pytest.mark.parametrize("n", [1, 2, 3, 8, 15, 40])
def test_the_interval_of_a_median_is_what_resamples_tend_to(n):
    """The oracle counts, by the binomial distribution, the resamples whose lower and upper median is at most x_(k)."""
    values = np.random.default_rng(n).permutation(np.arange(1.0, n + 1))
    k = np.arange(1, n + 1)
    up_to = [binom.sf((n + 1) // 2 - 1, n, k / n), binom.sf(n // 2, n, k / n)]
    ends = [float(k[np.argmax(share >= least)]) for share, least in zip(up_to, (0.025, 0.975), strict=True)]
    assert km.bench.median_interval(np.append(values, [np.nan, np.inf]))[1:] == tuple(ends)


def test_a_report_is_one_file_with_every_case_and_controller(whole):
    page = km.bench.write_report(whole[1]).read_text()
    for word in ("tiny:near", "tiny:far", *TWO, "noise 0.05", "<svg", "tiny-near-lqr.rrd"):
        assert word in page
    assert "http://" not in page.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )
    assert "https://" not in page.replace("https://matplotlib.org", "")
    assert "<script" not in page
    text = (whole[1] / "report.md").read_text()
    assert "## tiny:near" in text
    lines = (whole[1] / "summary.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 2 * 2
    costs = [row.metrics.cost for row in whole[0] if row.key[:5] == ("tiny", "near", "lqr", None, 0.0)]
    (line,) = (line for line in lines if line.startswith("tiny:near,–,lqr"))
    assert float(line.split(",")[6]) == np.median(costs)


def test_a_profile_divides_each_cost_by_the_least_of_those_that_reached_from_the_same_start(whole, monkeypatch):
    drawn = []
    monkeypatch.setattr("koopmpc.apps.bench.report.draw_profiles", drawn.append)
    monkeypatch.setattr("koopmpc.apps.bench.report.render_svg", lambda _: "<svg></svg>")
    km.bench.write_report(whole[1])
    rows = [row for row in whole[0] if row.case == "near"]
    for name in TWO:
        ratios = []
        for row in (row for row in rows if row.controller == name):
            same = [other for other in rows if (other.noise, other.start) == (row.noise, row.start) and other.reached]
            least = min((other.metrics.cost for other in same), default=np.nan)
            ratios.append(row.metrics.cost / least if row.reached else np.inf)
        assert drawn[0][name].tolist() == ratios


def test_a_sweep_is_no_regression_of_itself_and_a_worse_one_is(problem, whole, tmp_path):
    same = km.bench.compare_runs(whole[1], whole[1])
    assert not same.regressions
    assert {pair.ratio for pair in same.pairs} == {1.0}
    worse = replace(problem, limits=km.Limits(u_min=-0.3, u_max=0.3)).of_file(problem.file)
    km.sweep([worse], TWO, folder=tmp_path, options=km.bench.SweepOptions(**GRID))
    found = km.bench.compare_runs(whole[1], tmp_path)
    assert {pair.what.split()[1] for pair in found.regressions} >= {"near"}
    assert all(pair.p < 0.05 or pair.lost for pair in found.regressions)
    assert not km.bench.compare_runs(tmp_path, whole[1]).regressions
    assert not km.bench.compare_runs(whole[1], tmp_path, threshold=1e6).regressions or any(
        p.lost for p in found.regressions
    )


def test_two_logs_are_compared_and_strangers_are_refused(whole):
    log = whole[1] / "tiny-near-lqr.rrd"
    assert str(km.bench.compare_runs(log, log)) == "no regression beyond 2.0% in 1 comparison"
    other = whole[1] / next(row.log.name for row in whole[0] if row.log and row.key[:3] == ("tiny", "near", TWO[1]))
    (pair,) = km.bench.compare_runs(log, other, threshold=1e6).pairs
    assert pair.what == f"tiny near {TWO[1]} / lqr"
    assert pair.ratio == pytest.approx(km.metrics(km.load_run(other)).cost / km.metrics(km.load_run(log)).cost)
    with pytest.raises(km.errors.LogError, match="have no run in common"):
        km.bench.compare_runs(log, whole[1] / "tiny-far-lqr.rrd")
