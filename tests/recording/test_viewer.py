"""view and screenshot: what the viewer is told, and that it can draw what it is told to."""

from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from koopmpc.recording import viewer
from koopmpc.recording.viewer import free_port, screenshot, start_viewer
from tests.recording.runs import make_run


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


def test_logs_open_in_one_viewer(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "open_viewer", lambda logs, port: opened.append(logs) or True)
    km.view([log, str(log)])
    km.view(log)
    assert opened == [[str(log), str(log)], [str(log)]]


def test_messages(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    with pytest.raises(
        km.errors.LogError,
        match=r"there is no display to open .*run\.rrd on; copy it to a machine with .* run `koopmpc view run\.rrd`",
    ):
        km.view(log)
    with pytest.raises(km.errors.LogError, match=r"nowhere\.rrd does not exist; pass the \.rrd of a run"):
        km.view([log, "nowhere.rrd"])
    notes = log.with_name("notes.rrd")
    notes.write_text("these are notes")
    with pytest.raises(km.errors.LogError, match=r"notes\.rrd is no log of koopmpc: it does not start as"):
        km.view([log, notes])
    with pytest.raises(km.errors.LogError, match=r"is a folder; pass the \.rrd of a run"):
        screenshot(log.parent, "picture.png", time=0.0)
    with pytest.raises(km.errors.LogError, match=r"no log to open; pass the \.rrd of a run"):
        km.view([])
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "open_viewer", lambda logs, port: False)
    with pytest.raises(km.errors.LogError, match=r"the viewer did not start; run `/.*rerun.* .*run\.rrd` to see"):
        km.view(log)
    monkeypatch.setattr(viewer, "start_viewer", lambda *arguments, port: None)
    with pytest.raises(
        km.errors.LogError, match=r"no picture of .*: the viewer did not start; is a Vulkan driver installed\?"
    ):
        screenshot(log, "picture.png", time=0.0)


@pytest.mark.slow
def test_the_viewer_draws_every_view_of_the_blueprint(log: Path, tmp_path: Path) -> None:
    from rerun.experimental import ViewerClient

    port = free_port()
    process = start_viewer("--headless", "--hide-welcome-screen", port=port)
    if process is None:
        pytest.skip("the viewer does not start here: no Vulkan driver (Debian's is mesa-vulkan-drivers)")
    try:
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.open(str(log))
        client.save_screenshot(str(tmp_path / "first.png"))
        views = client.get_state().views
    finally:
        process.kill()
        process.wait()
    assert {v.name for v in views} >= {
        "state 0 [m]",
        "Input: input 0",
        "Animation, with the predicted horizon",
    }
    assert [v for v in views if v.reports] == []
    screenshot(log, tmp_path / "run.png", time=0.5)
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "run.png").stat().st_size > 20_000
