"""view: logs in one Rerun viewer; screenshot: a picture of a log without a screen."""
# pyright: basic

import socket
from collections.abc import Sequence
from pathlib import Path
from time import sleep

from koopmpc.errors import LogError
from koopmpc.recording.columns import check_log
from koopmpc.recording.connect import has_display, open_viewer, program, start_viewer

_SETTLE = 2.5  # until plots have found their ranges [s]


def view(logs: str | Path | Sequence[str | Path]) -> None:
    """Open one log, or several, in one viewer; it stays open by itself.

    Raises
    ------
    LogError
        A log does not exist, or is none; there is no display; the viewer does not start.
    """
    paths = _existing(logs)
    if not has_display():
        raise LogError(
            f"there is no display to open {paths[0]} on; copy it to a machine with a screen and run "
            f"`koopmpc view {Path(paths[0]).name}` there"
        )
    if not open_viewer(paths, free_port()):
        raise LogError(f"the viewer did not start; run `{program()} {paths[0]}` to see what it says")


def screenshot(
    log: str | Path, picture: str | Path, *, time: float, size: tuple[int, int] = (1600, 1000)
) -> None:
    """Write `picture` (.png) of `log` at `time` [s], as its blueprint lays it out; needs no screen, but Vulkan.

    Raises
    ------
    LogError
        The log does not exist or is none, or there is no Vulkan driver (Debian's is mesa-vulkan-drivers).
    """
    from rerun.experimental import ViewerClient

    (path,) = _existing(log)
    port = free_port()
    viewer = start_viewer(
        "--headless", "--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}", port=port
    )
    if viewer is None:
        raise LogError(f"no picture of {path}: the viewer did not start; is a Vulkan driver installed?")
    try:
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.open(path)
        client.set_time("sim_time", duration=time, play_state="paused")
        client.save_screenshot(str(picture))  # lays the plots out
        sleep(_SETTLE)
        client.save_screenshot(str(picture))
    finally:
        viewer.terminate()
        viewer.wait(5.0)


def _existing(logs: str | Path | Sequence[str | Path]) -> list[str]:
    paths = [Path(p) for p in ([logs] if isinstance(logs, str | Path) else logs)]
    if not paths:
        raise LogError("no log to open; pass the .rrd of a run")
    for path in paths:
        check_log(path)
    return [str(p) for p in paths]


def free_port() -> int:
    """Return a port of this machine that nobody listens to now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
