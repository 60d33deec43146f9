"""The command line: exit codes, messages on stderr, files where they are said to be."""

import importlib
import os
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import pytest

import koopmpc as km
from tests.apps.tiny import write
from tests.commands import koopmpc
from tests.views.runs import make_run

TWO = ["-c", "lqr", "-c", "koopman-mpc"]


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    return koopmpc


def folders(tmp_path):
    return sorted((tmp_path / "logs").iterdir())


def test_run_takes_a_path_and_leaves_a_log_a_run_and_the_table(call, tmp_path):
    result = call("run", write(tmp_path), *TWO)
    assert result.exit_code == 0, result.output
    (folder,) = folders(tmp_path)
    assert folder.name.endswith("-tiny")
    names = {path.name for path in folder.iterdir()}
    assert names == {"results.parquet", "sweep.sqlite", "models"} | {
        f"tiny-{case}-{name}.rrd" for case in ("near", "far") for name in ("lqr", "koopman-mpc")
    }
    assert "tiny:near" in result.stdout
    assert "does not reach" in result.stdout  # six steps are too few, and that is no failure
    assert f"logs{os.sep}{folder.name}" in result.stdout
    *program, view, log = shlex.split(result.stdout.split("look at a run: ")[1])
    assert (view, log) == ("view", f"logs{os.sep}{folder.name}{os.sep}tiny-near-koopman-mpc.rrd")
    shown = subprocess.run([*program, "inspect", log], capture_output=True, text=True, cwd=tmp_path)
    assert shown.stdout.startswith("tiny near koopman-mpc")  # what is printed can be called as it stands
    compared = call("compare", folder, folder)
    assert compared.exit_code == 0, compared.output
    assert "no regression beyond 2.0% in 4 comparisons" in compared.stdout


def test_calls_that_share_a_second_make_a_folder_each(call, tmp_path, monkeypatch):
    now = SimpleNamespace(now=lambda: datetime(2026, 11, 27, 1, 2, 3))
    monkeypatch.setattr("koopmpc.apps.cli.console.datetime", now)
    for _ in range(3):
        assert call("run", f"{write(tmp_path)}:far", "-c", "lqr").exit_code == 0
    stem = "2026-11-27T01-02-03-tiny"
    assert [folder.name for folder in folders(tmp_path)] == [stem, f"{stem}-1", f"{stem}-2"]


def test_a_plant_whose_time_is_in_hours_settles_in_hours(call, tmp_path):
    path = write(tmp_path, **{"More lines that nobody lists.": "Time in hours."})
    result = call("run", f"{path}:near", "-c", "lqr")
    assert result.exit_code == 0, result.output
    log = folders(tmp_path)[0] / "tiny-near-lqr.rrd"
    run = km.load_run(log)
    settles = km.metrics(run).settling_time
    assert f" {settles:.2f} h " in result.stdout
    assert f"settling time             {settles:.3g}" in call("inspect", log).stdout


def test_a_program_on_the_path_is_called_by_its_name(call, tmp_path, monkeypatch):
    def line():
        return shlex.split(call("new", f"plant{len(list(tmp_path.iterdir()))}").stdout.split("run it: ")[1])

    folder = Path(sys.executable).parent
    monkeypatch.setenv("PATH", str(folder))
    assert line()[:2] == ["koopmpc", "run"]
    monkeypatch.setenv("PATH", "/nowhere")
    assert Path(line()[0]).resolve() == folder.resolve() / "koopmpc"
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert line()[1:3] == ["-m", "koopmpc"]


def test_the_version_is_shown(call):
    result = call("--version")
    assert (result.exit_code, result.stdout.strip()) == (0, f"koopmpc {version('koopmpc')}")


@pytest.mark.parametrize("logs", ["note", "note/deeper", "/proc/logs"])
def test_logs_that_cannot_be_written_name_the_option(call, tmp_path, logs):
    (tmp_path / "note").write_text("a file")
    result = call("run", f"{write(tmp_path)}:far", "-c", "lqr", "--logs", logs)
    assert result.exit_code == 2
    assert f"LogError: --logs {logs}: no folder can be made there, " in result.stderr
    assert result.stdout == ""


def test_run_takes_a_name_in_problems_and_one_case(call, tmp_path):
    write(tmp_path / "problems")
    result = call("run", "tiny:far", "-c", "lqr", "--logs", tmp_path / "elsewhere")
    assert result.exit_code == 0, result.output
    (folder,) = (tmp_path / "elsewhere").iterdir()
    assert {path.name for path in folder.iterdir()} == {"results.parquet", "sweep.sqlite", "tiny-far-lqr.rrd"}


def test_bench_takes_several_problems_and_the_name_of_its_folder(call, tmp_path):
    first, second = write(tmp_path, "one"), write(tmp_path, "two")
    for name in ("bench", "monday"):
        result = call("bench", f"{first}:far", f"{second}:far", "-c", "lqr", *(["--name", name] * (name != "bench")))
        assert result.exit_code == 0, result.output
        (folder,) = (each for each in folders(tmp_path) if each.name.endswith(f"-{name}"))
        assert {path.stem for path in folder.glob("*.rrd")} == {"one-far-lqr", "two-far-lqr"}
    assert "--name is 'a/b'" in call("bench", f"{first}:far", "-c", "lqr", "--name", "a/b").stderr


def test_faults_add_a_table_and_a_log_each_and_exit_with_zero(call, tmp_path):
    for command in ("run", "bench"):
        result = call(command, f"{write(tmp_path)}:far", "-c", "lqr", "--faults")
        assert result.exit_code == 0, result.output
        assert "tiny:far under faults" in result.stdout
        assert all(word in result.stdout for fault in km.bench.FAULTS for word in fault.split("-"))
    for folder in folders(tmp_path):
        assert len(list(folder.glob("*.rrd"))) == 1 + len(km.bench.FAULTS)
        log = folder / "tiny-far-lqr-nan-sensor.rrd"
        assert "tiny far lqr nan-sensor" in call("inspect", log).stdout


def test_a_run_that_raises_exits_with_one_and_the_others_are_there(call, tmp_path, monkeypatch):
    def broken(parts, limits):
        raise RuntimeError("out of [gain]")

    monkeypatch.setitem(km.bench.CONTROLLERS, "lqr", replace(km.bench.CONTROLLERS["lqr"], build=broken))
    result = call("run", f"{write(tmp_path)}:far", *TWO)
    assert result.exit_code == 1
    assert "tiny:far lqr: RuntimeError: out of [gain]" in result.stdout
    (folder,) = folders(tmp_path)
    assert [path.name for path in folder.glob("*.rrd")] == ["tiny-far-koopman-mpc.rrd"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run", "pendulun"], "did you mean 'pendulum'?"),
        (["run", "pendulum:uprigth"], "did you mean 'upright'?"),
        (["run", "pendulum", "-c", "lqg"], "there is no controller 'lqg', did you mean 'lqr'?"),
        (["bench", "nowhere.py"], "there is no file nowhere.py"),
        (["inspect", "nowhere.rrd"], "nowhere.rrd"),
        (["inspect", "note.rrd"], "LogError"),
        (["check", "missing.npz"], "missing.npz does not exist"),
    ],
)
def test_mistakes_are_one_message_on_stderr_exit_two_and_leave_nothing(call, tmp_path, arguments, text):
    (tmp_path / "note.rrd").write_text("not a log")
    result = call(*arguments)
    assert result.exit_code == 2
    assert text in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert not (tmp_path / "logs").exists()


def test_a_problem_that_exits_is_shown_in_the_list_and_refused_by_run(call, tmp_path):
    write(tmp_path / "problems", "sound")
    (tmp_path / "problems" / "quitter.py").write_text('"""Quitter: exits."""\nraise SystemExit(3)\n')
    listed = call("list")
    assert listed.exit_code == 0
    assert "quitter.py, line 2: SystemExit: 3" in " ".join(listed.stdout.split())
    assert "near, far" in listed.stdout
    assert call("run", "quitter").exit_code == 2


def test_a_problem_that_raises_says_where(call, tmp_path):
    result = call("run", write(tmp_path, **{"horizon=5": "horizon=int('five')"}))
    assert result.exit_code == 2
    assert "tiny.py, line" in result.stderr
    assert "ValueError: invalid literal" in result.stderr


def test_inspect_recomputes_the_metrics_from_the_log_alone(call, tmp_path):
    path = write(tmp_path)
    assert call("run", f"{path}:near", "-c", "lqr").exit_code == 0
    path.unlink()
    log = folders(tmp_path)[0] / "tiny-near-lqr.rrd"
    result = call("inspect", log)
    assert result.exit_code == 0, result.output
    expected = km.metrics(km.load_run(log))
    assert "tiny near lqr" in result.stdout
    assert f"{expected.cost:.6g}" in result.stdout
    assert f"{expected.settling_time:.3g} s" in result.stdout
    both = call("inspect", log, log)
    assert both.exit_code == 0
    assert both.stdout.startswith("2 logs")
    assert both.stdout.endswith(2 * result.stdout)


def test_inspect_says_that_no_log_has_what_is_asked_for(call, tmp_path):
    assert call("run", f"{write(tmp_path)}:near", "-c", "lqr").exit_code == 0
    (folder,) = folders(tmp_path)
    result = call("inspect", folder, "--where", "violation > 3")
    assert (result.exit_code, result.stdout.strip()) == (0, "no log has violation > 3")


def test_list_shows_names_titles_cases_and_what_is_broken(call, tmp_path):
    write(tmp_path / "problems")
    (tmp_path / "problems" / "torn.py").write_text('"""Torn: half a file."""\nx = (\n')
    result = call("list")
    assert result.exit_code == 0
    for text in (
        "tiny  Tiny: a leaky tank",
        "near, far",
        "pendulum",
        "cart_pole",
        "shift, recover",
        "torn.py, line 2",
    ):
        assert text in result.stdout


def test_view_opens_all_logs_in_one_viewer(call, monkeypatch):
    opened = []
    monkeypatch.setattr("koopmpc.views.recording.viewer.view", opened.append)
    assert call("view", "a.rrd", "b.rrd").exit_code == 0
    assert [[path.name for path in paths] for paths in opened] == [["a.rrd", "b.rrd"]]


def test_without_a_display_view_names_the_line_that_serves_with_the_options_it_was_given(call, tmp_path, monkeypatch):
    for name in "ab":
        km.record(make_run(T=3), tmp_path / f"{name}.rrd")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("koopmpc.views.recording.comparison.record_comparison", lambda *_: None)
    for options in ([], ["--compare"]):
        result = call("view", *options, "a.rrd", "b.rrd")
        assert result.exit_code == 2
        assert f"`koopmpc view {''.join(f'{each} ' for each in options)}--web a.rrd b.rrd`" in " ".join(
            result.stderr.split()
        )


@pytest.mark.parametrize(("count", "whole"), [(1, True), (2, True), (3, True), (4, False)])
def test_inspect_tells_of_up_to_three_logs_in_full(call, tmp_path, count, whole):
    for k in range(count):
        km.record(make_run(T=3), tmp_path / f"{k}.rrd")
    result = call("inspect", *(f"{k}.rrd" for k in range(count)))
    assert result.exit_code == 0, result.output
    assert ("worst" in result.stdout.lower()) == whole


def test_fit_warnings_are_one_line(call, tmp_path):
    doubtful = write(tmp_path, **{"episodes=20, steps=5": "episodes=1, steps=2"})
    result = call("run", f"{doubtful}:far", "-c", "koopman-mpc")
    assert "FitWarning: " in result.stderr
    assert "warnings.warn" not in result.stderr


def test_python_m_is_the_sameprogram(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "koopmpc", "run", "pendulun"], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2
    assert "did you mean 'pendulum'?" in done.stderr


def test_new_writes_a_problem_that_runs_as_it_stands(call, tmp_path):
    made = call("new", "mine")
    assert made.exit_code == 0, made.output
    assert shlex.split(made.stdout.split("run it: ")[1])[-2:] == ["run", "mine.py"]
    ran = call("run", "mine.py:push", "-c", "koopman-mpc")
    assert ran.exit_code == 0, ran.output
    again = call("new", "mine")
    assert again.exit_code == 2
    assert "mine.py exists already and is kept as it is" in again.stderr


SAID = "cost ratio settles off over p50 p99 violation score stand-in"
SAID += " surrogate corners gain tail weighted known Q_N certificate lost ridge"


def test_every_word_is_explained_and_a_wrong_one_finds_its_neighbour(call):
    words = ["fresh loops", "worst run", "steps without a good status"]
    statuses = importlib.import_module("koopmpc.views.recording.description").STATUS_WORDS.values()
    for word in [*SAID.split(), *words, *statuses, *km.bench.CONTROLLERS]:
        assert call("explain", *word.split()).exit_code == 0, word
    said = {"free": "no optimisation was needed", "": "offset-free: ", "ridge": "coefficients", "lost": "left the data"}
    for word, part in said.items():
        assert part in " ".join(call("explain", *word.split()).stdout.split())
    for wrong, near in (("ratoi", True), ("nonsense", False)):
        missed = call("explain", wrong)
        assert missed.exit_code == 2
        assert ("did you mean 'ratio'" in missed.stderr) == near
        assert ("did you mean" in missed.stderr) == near


def test_check_takes_a_folder_of_logs_of_the_plant_and_says_if_it_holds_none(call, tmp_path):
    (tmp_path / "controller.npz").write_bytes(b"")
    (tmp_path / "plant").mkdir()
    refused = call("check", str(tmp_path / "controller.npz"), "--on-plant", str(tmp_path / "plant"))
    assert refused.exit_code == 2
    assert "it holds nothing" in " ".join(refused.stderr.split())


def test_a_case_is_explained_with_what_controllers_are_not_told(call, tmp_path):
    said = " ".join(call("explain", "pendulum:hold").stdout.split())
    assert "pendulum:hold is a case of pendulum: from the state (0.7854, 0) to the reference (0.8, 0), 10 s." in said
    assert "(m is 1.2, not 1.0)" in said
    assert "a ratio may be below 1" in said
    write(tmp_path / "problems")
    assert "tiny:near is a case of tiny" in call("explain", "tiny:near").stdout


def test_logs_are_served_to_this_machine_alone_until_the_server_is_stopped(call, tmp_path):
    viewer = importlib.import_module("koopmpc.views.recording.viewer")
    call("run", f"{write(tmp_path)}:far", "-c", "lqr", "--logs", "l")
    (log,) = (tmp_path / "l").glob("*/*.rrd")
    port = viewer.free_port()
    with viewer.serve(log, port) as (address, data):
        assert address.startswith(f"http://127.0.0.1:{port}?url=")
        assert viewer.is_up(data)
        assert b"<html" in urlopen(f"http://127.0.0.1:{port}", timeout=60).read().lower()
        listening = subprocess.run(["ss", "-ltn"], capture_output=True, text=True, check=False).stdout
        ours = [line.split()[3] for line in listening.splitlines() if f":{port} " in line or f":{data} " in line]
        assert all(place.startswith("127.0.0.1:") for place in ours)
    assert not viewer.is_up(port)


def test_without_a_command_the_four_ways_in_are_shown_each_with_a_command_that_exists(call):
    done = subprocess.run([sys.executable, "-m", "koopmpc"], capture_output=True, text=True)
    listed = call("--help").stdout
    assert done.returncode == 0, done.stderr
    assert "--help" in done.stdout
    for word in ("run", "new", "fit", "export", "doctor"):
        assert f"koopmpc {word}" in done.stdout
        assert f" {word} " in listed


def test_the_doctor_names_what_is_missing_and_how_it_is_had(call, monkeypatch):
    well = call("doctor")
    assert well.exit_code == 0
    assert version("casadi") in well.stdout
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("koopmpc.apps.cli.start.find_spec", lambda name: None if name == "mcap" else name)
    assert "[ros]'" in " ".join(call("doctor").stdout.split())  # half of an extra is none
    monkeypatch.setattr("koopmpc.apps.cli.start.find_spec", lambda name: None)
    ill = " ".join(call("doctor").stdout.split())
    assert "none of $CC, cc, gcc, clang" in ill
    for extra in tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]:
        assert extra in ("dev", "docs", "peers") or f"[{extra}]'" in ill, extra


@pytest.mark.parametrize(
    ("display", "program", "said"),
    [
        (":0", "there", "opens logs"),
        ("", "there", "no display: logs are written all the same"),
        (":0", "", "not found"),
    ],
)
def test_the_doctor_says_whether_a_log_can_be_opened(call, monkeypatch, tmp_path, display, program, said):
    (tmp_path / "there").touch()
    monkeypatch.setattr("koopmpc.views.recording.viewer.program", lambda: tmp_path / (program or "gone"))
    monkeypatch.setattr("koopmpc.apps.cli.start.sys.platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    told = " ".join(call("doctor").stdout.split())
    assert [words for words in ("opens logs", "no display: logs", "not found") if words in told] == [said[:16].strip()]


def test_the_doctor_tries_the_compiler_and_says_what_it_said(call, monkeypatch, tmp_path):
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'math.h: no such file' >&2\nexit 4\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    said = " ".join(call("doctor").stdout.split())
    assert "ended with 4: math.h: no such file" in said.replace(" -", "-")
    monkeypatch.setenv("CC", "cc" if shutil.which("cc") else "gcc")
    assert "plants at full speed" in " ".join(call("doctor").stdout.split())
