"""The viewer is found or opened, never waited for in vain, and it draws what a log tells it to."""

import sys
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

import koopmpc as km
from koopmpc.apps.bench.problem_files import shipped
from koopmpc.views.recording import viewer
from koopmpc.views.recording.viewer import find_viewer, free_port, has_display, is_up, start_viewer
from tests.views.runs import about, make_run, steps_of
from tests.views.viewing import drawn


@pytest.fixture
def log(tmp_path: Path) -> Path:
    run = make_run(nx=2, T=40)
    A = np.array([[0.9, 0.3], [-0.3, 1.1]])
    model = km.LinearPredictor(A, np.ones((2, 1)), np.eye(2), km.State(), run.dt, run.states, run.inputs)
    km.record(
        run,
        tmp_path / "run.rrd",
        scene=lambda x, u: [
            km.scene.Line("rod", [(0.0, 0.0), (1.0, 1.0)]),
            km.scene.Box("cart", (float(np.sin(x[0])), 0.0), (1.0, 0.5), 0.3),
            km.scene.Disk("bob", (0.0, 1.0), 0.2),
        ],
        model=model,
    )
    return tmp_path / "run.rrd"


def test_several_logs_open_in_one_viewer(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "open_viewer", lambda logs, port: opened.append(logs) or True)
    km.recording.view([log, str(log)])
    km.recording.view(log)
    assert opened == [[str(log), str(log)], [str(log)]]


def test_without_a_display_the_command_for_another_machine_is_told(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    told = r"there is no display to open .*run\.rrd on; `koopmpc view --web .*`.*, or copy it to a machine with .* run `koopmpc view run\.rrd`"
    with pytest.raises(km.errors.LogError, match=told):
        km.recording.view(log)


def test_a_viewer_that_does_not_start_is_told(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "open_viewer", lambda logs, port: False)
    with pytest.raises(km.errors.LogError, match=r"the viewer did not start; run `/.*rerun.* .*run\.rrd` to see"):
        km.recording.view(log)


@pytest.mark.slow
def test_the_viewer_draws_every_view_of_the_blueprint(log: Path, tmp_path: Path) -> None:
    views = drawn(log, tmp_path / "run.png", at=0.5)
    assert {v.name for v in views} >= {
        "state 0 [m]",
        "Input: input 0",
        "Animation; fainter: the plan, grey: the reference",
    }
    assert [v for v in views if v.reports] == []
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "run.png").stat().st_size > 20_000


def test_a_viewer_is_found_once_it_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    assert not is_up(port)
    process = start_viewer("--serve-grpc", port=port)
    assert process is not None
    try:
        assert is_up(port)
        assert find_viewer(port) == f"rerun+http://127.0.0.1:{port}/proxy"
    finally:
        process.kill()
        process.wait()
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    assert find_viewer(port) is None


def test_what_a_loop_streams_is_served_to_a_browser_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    data, web, run = free_port(), free_port(), make_run(T=40)
    monkeypatch.setattr(viewer, "PORT", data)
    with viewer.serve((), web, live=True) as (address, port), urlopen(f"http://127.0.0.1:{web}") as page:
        assert port == data
        assert address == f"http://127.0.0.1:{web}?url=rerun%2Bhttp://127.0.0.1:{data}/proxy"
        assert b"<html" in page.read()
        with km.Recorder(live=True, **about(run, port=data)) as recorder:
            for step in steps_of(run):
                recorder(step)
    assert not is_up(data)


def test_a_viewer_is_opened_where_there_is_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    port, opened = free_port(), []
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "start_viewer", lambda *logs, port: opened.append(port))
    assert find_viewer(port) is None  # it was tried, and did not come up
    assert opened == [port]


def test_a_viewer_that_ends_at_once_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "_START", 600.0)
    start = time.monotonic()
    assert start_viewer("--no-such-option", port=free_port()) is None
    assert time.monotonic() - start < 300


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, False),
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("darwin", {}, True),
    ],
)
def test_a_display_is_known_by_the_platform_and_its_variables(
    monkeypatch: pytest.MonkeyPatch, platform: str, variables: dict[str, str], expected: bool
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert has_display() is expected


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in shipped()])
def test_the_log_of_every_problem_is_drawn_without_an_error_in_any_view(tmp_path: Path, name: str) -> None:
    problem = km.load_problem(name)
    case = next(iter(problem.cases))
    (row,) = km.sweep(
        [problem.select(case)], [problem.controllers[0] if problem.controllers else "lqr"], folder=tmp_path
    )
    views = drawn(row.log, tmp_path / "run.png", at=0.5 * problem.cases[case].steps * problem.dt)
    assert len(views) > 3
    assert [v for v in views if v.reports] == []
