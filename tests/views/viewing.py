"""Looking at a log without a screen: the views that the viewer drew, and a picture of them."""

import time
from pathlib import Path
from typing import Any

import pytest

from koopmpc.views.recording.viewer import free_port, start_viewer

SETTLE = 2.5  # until plots have found their ranges [s]


def drawn(log: Path, picture: Path, at: float) -> list[Any]:
    """Save a picture of the log at this time [s], and return the views that it shows; skip where nothing can draw."""
    from rerun.experimental import ViewerClient

    port = free_port()
    process = start_viewer("--headless", "--hide-welcome-screen", "--window-size", "1600x1000", port=port)
    if process is None:
        pytest.skip("the viewer does not start here: no Vulkan driver (Debian's is mesa-vulkan-drivers)")
    try:
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.open(str(log))
        client.set_time("sim_time", duration=at, play_state="paused")
        client.save_screenshot(str(picture))  # lays the plots out
        time.sleep(SETTLE)
        client.save_screenshot(str(picture))
        return client.get_state().views
    finally:
        process.kill()
        process.wait()
