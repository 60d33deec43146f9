"""The table fits 100 columns, says what did not reach, and shows what was raised."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import koopmpc as km

GOOD = km.loop.Metrics(
    cost=120.5,
    tracking_rmse=np.array([0.1, 0.2]),
    final_error=np.array([0.001, -0.02]),
    violation=0.0,
    input_violation=0.0,
    effort=3.0,
    settling_time=2.35,
    solve_time_p50=13e-6,
    solve_time_p99=4.2e-3,
    solve_time_max=1.5,
    late=1,
    status={"UNCONSTRAINED": 150, "OPTIMAL": 48, "MAX_ITERATIONS": 2},
    fallback={"NONE": 198, "SHIFTED_PLAN": 2},
)


def printed(renderable, width=100):
    out = Console(file=io.StringIO(), width=width)
    out.print(renderable)
    return out.file.getvalue()


def rows():
    return [
        km.bench.RunRow("plant", "case", "lqr", replace(GOOD, cost=2.41e6, settling_time=np.inf), reached=False),
        km.bench.RunRow("plant", "case", "linear-mpc", replace(GOOD, settling_time=np.inf), reached=True),
        km.bench.RunRow(
            "plant", "case", "koopman-mpc", replace(GOOD, violation=0.25), reached=True, training_time=0.31
        ),
        km.bench.RunRow("plant", "case", "nonlinear-mpc", GOOD, reached=True),
        km.bench.RunRow("plant", "case", "pid", replace(GOOD, settling_time=np.nan), reached=False),
        km.bench.RunRow("plant", "other", "lqr", failure="RuntimeError: the [gain] is lost"),
    ]


def test_nothing_is_cut_in_a_terminal_of_80_columns():
    text = printed(km.bench.results_table(rows()), 80)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
    assert " 2.4e+06 " in text
    starts = [replace(rows()[3], start=k, metrics=replace(GOOD, cost=100.1 + k), x0=(0.1, k)) for k in range(9)]
    text = printed(km.bench.build_summary_table([*starts, *(replace(row, noise=0.01) for row in starts)]), 80)
    assert "…" not in text
    assert all(f" {word} " in text for word in ("nonlinear-mpc", "104.1", "13 µs", "4.2 ms", "100 %"))
    assert "over" not in text  # a column of zeros


def test_a_ratio_below_one_is_explained_by_the_case_that_has_it():
    better = km.bench.RunRow("pendulum", "hold", "lqr", replace(GOOD, cost=0.1 * GOOD.cost), reached=True)
    oracle = km.bench.RunRow("pendulum", "hold", "nonlinear-mpc", GOOD, reached=True)
    text = " ".join(printed(km.bench.results_table([better, oracle])).split())
    assert "A ratio below 1: nonlinear-mpc is not optimal there. See `koopmpc explain pendulum:hold`." in text
    assert "below 1" not in printed(km.bench.results_table(rows()))


def test_each_row_says_how_it_went():
    lines = printed(km.bench.results_table(rows())).split("\n")
    line = {
        name: next(text for text in lines if text.strip().startswith(name))
        for name in ("koopman-mpc", "linear-mpc", "nonlinear-mpc", "lqr", "pid")
    }
    assert "starts there" in line["pid"]
    assert "does not reach" in line["lqr"]
    assert "2e+04" in line["lqr"]  # the ratio to nonlinear-mpc
    assert "within 5 %" in line["linear-mpc"]
    below = printed(km.bench.results_table(rows())).rstrip().split("\n")[-3:]
    assert below[1].startswith("cost: of the run; ratio: ")  # two lines, and the rest behind a command
    assert "`koopmpc explain WORD`" in below[2]
    assert "2.35 s" in line["koopman-mpc"]
    assert "0.25" in line["koopman-mpc"]
    assert "13 µs" in line["nonlinear-mpc"]
    assert "4.2 ms" in line["nonlinear-mpc"]


def test_each_case_has_a_table_with_training_time_and_failures_in_full():
    text = printed(km.bench.results_table(rows()))
    assert text.index("plant:case") < text.index("plant:other")
    assert "learned from data in 310 ms" in text
    assert "plant:other lqr: RuntimeError: the [gain] is lost" in text
    assert "raised" in text


def test_a_failure_that_several_runs_share_is_told_once():
    lost = "RuntimeError: the [gain] is lost"
    text = printed(km.bench.results_table([*rows(), km.bench.RunRow("plant", "other", "koopman-mpc", failure=lost)]))
    assert " ".join(text.split()).count(lost) == 1
    assert f"plant:other lqr, plant:other koopman-mpc: {lost}" in " ".join(text.split())


def test_a_column_of_violations_is_shown_only_where_there_are_some():
    assert "over " not in printed(km.bench.results_table([rows()[3]])).split("cost:")[0]
    assert "over " in printed(km.bench.results_table(rows())).split("cost:")[0]


def test_the_table_fits_a_hundred_columns():
    text = printed(km.bench.results_table(rows()))
    assert "…" not in text
    assert max(len(line) for line in text.split("\n")) <= 100


def faulty_rows():
    lost = replace(GOOD, cost=5e6, fallback={"NONE": 150, "HOLD": 50})
    return [
        *rows()[1:4],
        km.bench.RunRow("plant", "case", "linear-mpc", lost, fault="nan-sensor"),
        km.bench.RunRow("plant", "case", "koopman-mpc", replace(GOOD, cost=121.705), reached=True, fault="nan-sensor"),
        km.bench.RunRow("plant", "case", "nonlinear-mpc", fault="nan-sensor", failure="RuntimeError: no [luck]"),
        km.bench.RunRow("plant", "case", "linear-mpc", replace(GOOD, cost=60250.0), reached=True, fault="delay"),
        km.bench.RunRow("plant", "case", "koopman-mpc", GOOD, reached=True, fault="delay"),
        km.bench.RunRow("plant", "case", "nonlinear-mpc", GOOD, reached=True, fault="delay"),
    ]


def test_under_faults_each_controller_has_a_line_below_the_table_of_their_case():
    text = printed(km.bench.results_table(faulty_rows()))
    assert text.index("plant:case ") < text.index("plant:case under faults")
    lines = {t.split()[0]: t.split()[1:] for t in text[text.index("under faults") :].split("\n") if t.strip()}
    assert lines["linear-mpc"] == ["lost", "(50)", "5e+02", "(2)"]
    assert lines["koopman-mpc"] == ["1.010", "(2)", "1.000", "(2)"]
    assert lines["nonlinear-mpc"] == ["raised", "1.000", "(2)"]
    assert "plant:case nonlinear-mpc nan-sensor: RuntimeError: no [luck]" in text
    assert "under faults: cost over that without the fault" in text
    assert max(len(t) for t in text.split("\n")) <= 100
    assert "…" not in text


@pytest.mark.parametrize(("ratio", "word"), [(99.5, "99.500"), (100.25, "1e+02")])
def test_the_cost_under_a_fault_has_at_most_six_letters(ratio, word):
    whole = km.bench.RunRow("plant", "case", "lqr", GOOD, reached=True)
    under = replace(whole, metrics=replace(GOOD, cost=ratio * GOOD.cost), fault="delay")
    assert f" {word} " in printed(km.bench.results_table([whole, under]))


def test_who_does_not_reach_without_a_fault_is_not_lost_to_it():
    own = [row for row in faulty_rows() if row.controller == "linear-mpc"]
    text = printed(km.bench.results_table([replace(own[0], reached=False), *own[1:]]))
    assert "lost" not in text.split("cost:")[0]
    assert "– (50)" in text


def test_without_faults_there_is_no_table_of_faults():
    assert "faults" not in printed(km.bench.results_table(rows()))


def test_the_eight_controllers_under_every_fault_fit_a_hundred_columns():
    worst = replace(GOOD, cost=1e9, fallback={"HOLD": 300})
    ran = [
        km.bench.RunRow("plant", "case", name, metrics, reached=True, fault=fault)
        for fault, metrics in [(None, GOOD), *((fault, worst) for fault in km.bench.FAULTS)]
        for name in km.bench.CONTROLLERS
    ]
    text = printed(km.bench.results_table(ran))
    assert "…" not in text
    assert max(len(line) for line in text.split("\n")) <= 100
    assert text.count("8e+06 (300)") == len(km.bench.FAULTS) * len(km.bench.CONTROLLERS)
