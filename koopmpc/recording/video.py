# pyright: basic
"""export_video: the animation of a log as a .gif or .mp4, without a screen and without the problem's file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import checks
from koopmpc.errors import LogError
from koopmpc.figures.animation import Stroke, draw_frames, save_video
from koopmpc.recording.description import title_of
from koopmpc.recording.format.reader import about_of
from koopmpc.recording.format.rrd import LogColumns, read_columns
from koopmpc.recording.views.scenes import BACKGROUND


@dataclass
class _Layer:
    """One shape of the scene: its drawing order, the steps at which it changes, and what it is from then on."""

    order: float
    steps: np.ndarray
    strokes: list[list[Stroke]]
    body: bool  # a part of the plant, and not of its plan

    def at(self, k: int) -> list[Stroke]:
        """Return the strokes at step k."""
        i = int(np.searchsorted(self.steps, k, side="right")) - 1
        return self.strokes[i] if i >= 0 else []


def export_video(
    log: str | Path,
    path: str | Path,
    *,
    fps: int = 20,
    width: int = 640,
    speed: float = 1.0,
    until: float | None = None,
) -> None:
    """Write the animation of a log, with its plan and its reference, as a .gif or an .mp4.

    Parameters
    ----------
    log
        The log of a run whose plant has a scene.
    path
        Ends in .gif or .mp4; an .mp4 needs the extra `video`.
    fps
        Pictures a second.
    width
        Width of the picture [pixels].
    speed
        Seconds of the run in one second of the video.
    until
        Time at which the video ends [s]; by default with the run.

    Raises
    ------
    LogError
        The log is missing or damaged, has no scene, or the path cannot be written; imageio-ffmpeg is missing.
    DataError
        The path is no .gif or .mp4, or a number is not above zero.
    """
    fps, width = checks.count(fps, "fps"), checks.count(width, "width", 64)
    speed = checks.positive(speed, "speed")
    columns = read_columns(Path(log), ("/world/**", "/description", "/state"))
    about, _ = about_of(columns, Path(log))
    layers = sorted(_layers(columns), key=lambda layer: layer.order)
    if not layers:
        raise LogError(f"{log} has no scene to draw; give the Dynamics a method scene(x, u), or the plant a scene=")
    bodies = [s for one in layers if one.body for row in one.strokes for s in row]
    last = max(len(columns.vectors("/state")) - 1, 1) * about.dt
    end = last if until is None else min(checks.positive(until, "until", "s"), last)
    moments = np.arange(0.0, end + 1e-9, speed / fps)
    steps = np.floor(moments / about.dt + 1e-6).astype(int).tolist()
    title = title_of(about)
    pictures = draw_frames(
        [[stroke for layer in layers for stroke in layer.at(k)] for k in steps],
        [f"{title}   {t:.1f} s" for t in moments],
        low=np.min([s.points.min(axis=0) - s.width / 2 for s in bodies], axis=0),
        high=np.max([s.points.max(axis=0) + s.width / 2 for s in bodies], axis=0),
        width=width,
        background=BACKGROUND,
    )
    save_video(pictures, path, fps)


def _layers(columns: LogColumns) -> list[_Layer]:
    """Return the shapes that the log holds; Rerun's y points down."""
    found: list[_Layer] = []
    for entity in columns.entities():
        k, strips = columns.lists(entity, "strips")
        if not len(k):
            continue
        _, radii = columns.lists(entity, "radii")
        _, colors = columns.lists(entity, "colors")
        rows = [_strokes(*row) for row in zip(strips, radii, colors, strict=True)]
        plain = not entity.startswith("/world/prediction/")
        found.append(_Layer(float(columns.static(entity, "draw_order") or 0.0), k, rows, plain))
    return found


def _strokes(strips: Any, radii: Any, colors: Any) -> list[Stroke]:
    """Return the strokes of one row; a colour is one number, 0xRRGGBBAA."""
    drawn: list[Stroke] = []
    for strip, radius, color in zip(strips or (), radii or (), colors or (), strict=True):
        points = np.array(strip, dtype=np.float64).reshape(-1, 2) * (1.0, -1.0)
        shade = (color >> 24 & 255, color >> 16 & 255, color >> 8 & 255)
        drawn.append(Stroke(points, 2 * float(radius), shade))
    return drawn
