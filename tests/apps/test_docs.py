"""The examples in README, docs/problems.md and docs/faults.md run as they stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km

README = Path(__file__).parents[2] / "README.md"
ROW = re.compile(r"^  ([\w-]+) +([\d.e+]+) +([\d.e+]+)  +(does not reach|within 5 %|[\d.]+ s) ", re.MULTILINE)


def read_table(text):
    """Return (cost, ratio, settles) by controller of a table of `koopmpc run`."""
    return {name: (float(cost), float(ratio), settles) for name, cost, ratio, settles in ROW.findall(text)}


def test_the_table_of_the_readme_has_all_controllers_of_its_command():
    text = README.read_text(encoding="utf-8")
    (task,) = re.findall(r"^koopmpc run (\S+)", text, re.MULTILINE)
    table = text.partition("```text\n")[2].partition("```")[0]
    assert table.splitlines()[0] == task
    name, _, case = task.partition(":")
    problem = km.load_problem(name)
    assert case in problem.cases
    assert list(read_table(table)) == list(problem.controllers or km.bench.CONTROLLERS)[: len(read_table(table))]
    assert len(read_table(table)) == 8


@pytest.mark.slow
def test_the_table_of_the_readme_is_what_its_command_prints(tmp_path):
    text = README.read_text(encoding="utf-8")
    (task,) = re.findall(r"^koopmpc run (\S+)", text, re.MULTILINE)
    command = [sys.executable, "-m", "koopmpc", "run", task]
    environment = os.environ | {"COLUMNS": "120", "PYTHONPATH": str(README.parent)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    shown, printed = read_table(text), read_table(done.stdout)
    assert list(shown) == list(printed)
    for name, (cost, ratio, settles) in printed.items():
        assert shown[name][:2] == pytest.approx((cost, ratio), rel=0.02), name
        assert shown[name][2] == settles, name


def test_the_twelve_lines_of_the_readme_run_and_print_and_record(tmp_path, monkeypatch, capsys):
    text = README.read_text(encoding="utf-8")
    (source,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    found = {}
    exec(source, found)
    run = found["run"]
    assert km.load_run("pendulum.rrd") == run
    assert capsys.readouterr().out == f"{km.metrics(run)}\n"
    assert km.bench.reached(run)
    assert np.abs(run.U).max() <= 25
    assert {status.name for status in run.status} <= {"UNCONSTRAINED", "OPTIMAL"}


def test_the_example_of_the_documentation_runs_and_reaches(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "problems.md").read_text()
    (source,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "spring.py"
    path.write_text(source)
    names = ["lqr", "linear-mpc", "koopman-mpc", "nonlinear-mpc"]
    rows = km.sweep([km.load_problem(path)], names, folder=tmp_path / "logs")
    assert [row.failure for row in rows] == [None] * len(rows)
    push = {row.controller: row for row in rows if row.case == "push"}
    for row in rows:
        if row.controller in ("koopman-mpc", "nonlinear-mpc"):
            assert np.isfinite(row.metrics.settling_time)
    oracle, koopman = push["nonlinear-mpc"].metrics, push["koopman-mpc"].metrics  # what the page says of them
    assert oracle.cost <= koopman.cost < 1.01 * oracle.cost
    assert abs(koopman.final_error[0]) < 1e-3
    assert not push["lqr"].reached
    assert not push["linear-mpc"].reached
    assert push["lqr"].metrics.cost > 1.02 * oracle.cost


def test_the_examples_of_faults_run(capsys):
    text = (Path(__file__).parents[2] / "docs" / "faults.md").read_text()
    source = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    found = {}
    exec(source, found)
    run = found["run"]
    assert np.isnan(run.Y).any()
    assert np.abs(run.U[20:]).max() <= 12.5
    assert len(run.metadata["faults"]) == 3
    assert found["Bias"](0.5).start(None, None).measured(0, 1.0) == 1.5
    assert "BAD_MEASUREMENT" in capsys.readouterr().out


def test_every_fault_is_in_the_documentation():
    text = (Path(__file__).parents[2] / "docs" / "faults.md").read_text()
    for fault in km.bench.FAULTS.values():
        assert f"| `{type(fault).__name__}(" in text


def test_the_line_of_the_page_on_sweeps_runs(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text()
    (source,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    found = {"km": km}
    exec(source, found)
    assert len(found["rows"]) == 6
    assert (tmp_path / "logs" / "sweep" / "results.parquet").exists()
