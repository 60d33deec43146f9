# pyright: basic
"""view opens logs in one Rerun viewer; a running loop finds the viewer that is up, or opens one."""

import os
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from koopmpc.base.errors import LogError
from koopmpc.views.recording.rrd import check_log

PORT = 9876  # data of a viewer: Rerun's default
WEB_PORT = 9090  # page of a viewer in the browser: Rerun's default
_START = 15.0  # longest wait for a viewer that was opened [s]


def find_viewer(port: int = PORT) -> str | None:
    """Return the address of the viewer at `port`, opened if there is none yet; None where there is no display."""
    if not is_up(port) and not (has_display() and open_viewer([], port)):
        return None
    return f"rerun+http://127.0.0.1:{port}/proxy"


def quiet() -> None:
    """Keep lines of Rerun's own off stderr when a viewer is closed; the Recorder says it in words.

    Rerun reads its setting when it is first imported: once that is done nothing changes.
    """
    if "rerun" not in sys.modules and "RUST_LOG" not in os.environ:
        os.environ["RUST_LOG"] = "warn,re_grpc_client=off,re_sdk=off"
        import_module("rerun")
        del os.environ["RUST_LOG"]


def why_none(port: int = PORT) -> str:
    """Return the reason in words why `find_viewer` found no viewer."""
    listens = f"no Rerun viewer listens at 127.0.0.1:{port}, and"
    if not has_display():
        return f"{listens} there is no display to open one on"
    return f"{listens} the one that was opened did not start; run `{program()}` to see what it says"


def is_up(port: int) -> bool:
    """Return True where a program listens at `port` of this machine."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=0.2):
            return True
    except OSError:
        return False


def has_display() -> bool:
    """Return True where a window can be opened."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_viewer(logs: Sequence[str], port: int = PORT) -> bool:
    """Start a viewer that lives on by itself and listens to this machine alone; return whether it came up."""
    viewer = start_viewer(*logs, port=port)
    if viewer is not None:
        viewer.returncode = 0  # nobody waits for it
    return viewer is not None


def start_viewer(*arguments: str, port: int) -> "subprocess.Popen[bytes] | None":
    """Start the viewer's process and return it as soon as it listens; None where it ends before, or never does."""
    command = [str(program()), "--bind", "127.0.0.1", "--port", str(port), *arguments]
    quiet = subprocess.DEVNULL
    viewer = subprocess.Popen(
        command,
        stdin=quiet,
        stdout=quiet,
        stderr=quiet,
        start_new_session=True,
        env=os.environ | {"RUST_LOG": "error"},  # its notes would cover the picture
    )
    if not _comes_up(viewer, port):
        viewer.kill()
        viewer.wait()
        return None
    return viewer


def _comes_up(viewer: "subprocess.Popen[bytes]", port: int) -> bool:
    """Wait until the process listens at `port`; return False where it ends before, or never does."""
    deadline = time.monotonic() + _START
    while time.monotonic() < deadline and viewer.poll() is None:
        if is_up(port):
            return True
        time.sleep(0.05)
    return False


def program() -> Path:
    """Return the viewer's own program; the script that starts it would leave the viewer running when it ends."""
    import rerun_cli

    folder = Path(rerun_cli.__file__).parent
    if sys.platform == "darwin" and (app := folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun").exists():
        return app
    return folder / ("rerun.exe" if sys.platform.startswith("win") else "rerun")


def view(logs: str | Path | Sequence[str | Path]) -> None:
    """Open one log, or several, in one viewer; it stays open by itself.

    Raises
    ------
    LogError
        A log does not exist or is no .rrd file, there is no display, or the viewer does not start.
    """
    paths = _existing(logs)
    need_display(paths)
    if not open_viewer(paths, free_port()):
        raise LogError(f"the viewer did not start; run `{program()} {paths[0]}` to see what it says")


def need_display(logs: Sequence[str | Path], *, options: str = "") -> None:
    """Raise a LogError that names other ways to see the logs, where there is no display; `options` end in a space."""
    if has_display():
        return
    names = shlex.join(Path(log).name for log in logs)
    them = "it" if len(logs) == 1 else "them"
    raise LogError(
        f"there is no display to open {names} on; `koopmpc view {options}--web {shlex.join(map(str, logs))}` serves "
        f"{them} to a browser, or copy {them} to a machine with a screen and run `koopmpc view {options}{names}` there"
    )


@contextmanager
def serve(
    logs: str | Path | Sequence[str | Path], port: int = WEB_PORT, *, live: bool = False
) -> Generator[tuple[str, int]]:
    """Serve logs to a browser on this machine; yield the address, and the port of the data beside that of the page.

    With `live` it serves what is streamed to this machine's port 9876, where a `Recorder` looks for a viewer.

    Both listen at 127.0.0.1 alone: from another machine they are reached through ssh.

    Raises
    ------
    LogError
        A log does not exist or is no .rrd file; the port is taken, or the server does not start.
    """
    paths = [] if live else _existing(logs)
    if is_up(port):
        raise LogError(f"a program listens at 127.0.0.1:{port} already; end it, or choose another with --port")
    data = PORT if live else free_port()
    server = start_viewer("--serve-web", "--web-viewer-port", str(port), *paths, port=data)
    if server is None:
        command = shlex.join([str(program()), "--serve-web", *paths])
        raise LogError(f"the server did not start; run `{command}` to see what it says")
    _comes_up(server, port)  # the page comes up after the data
    try:
        yield f"http://127.0.0.1:{port}?url=rerun%2Bhttp://127.0.0.1:{data}/proxy", data
    finally:
        server.terminate()
        try:
            server.wait(5.0)  # [s] a server that does not end is killed
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


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
