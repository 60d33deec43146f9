"""The viewer is found where it is up, opened where there is a display, and never waited for in vain."""

import sys
import time

import pytest

from koopmpc.recording import viewer as connect
from koopmpc.recording.viewer import find_viewer, free_port, has_display, is_up, start_viewer


def test_a_viewer_is_found_once_it_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    assert not is_up(port)
    viewer = start_viewer("--serve-grpc", port=port)
    assert viewer is not None
    try:
        assert is_up(port)
        assert find_viewer(port) == f"rerun+http://127.0.0.1:{port}/proxy"
    finally:
        viewer.kill()
        viewer.wait()
    monkeypatch.setattr(connect, "has_display", lambda: False)
    assert find_viewer(port) is None


def test_one_is_opened_where_there_is_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    port, opened = free_port(), []
    monkeypatch.setattr(connect, "has_display", lambda: True)
    monkeypatch.setattr(connect, "start_viewer", lambda *logs, port: opened.append(port))
    assert find_viewer(port) is None  # it was tried, and did not come up
    assert opened == [port]


def test_a_viewer_that_ends_at_once_is_not_waited_for() -> None:
    start = time.monotonic()
    assert start_viewer("--no-such-option", port=free_port()) is None
    assert time.monotonic() - start < 10


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, False),
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("darwin", {}, True),
    ],
)
def test_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch, platform: str, variables: dict[str, str], expected: bool
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert has_display() is expected
