# pyright: basic
"""export_video: the animation of a log as a .gif or .mp4, without a screen and without the problem's file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from koopmpc.base import checks
from koopmpc.base.errors import LogError
from koopmpc.base.scene import Color
from koopmpc.views.figures.animation import Stroke, draw_frames, project, save_video
from koopmpc.views.recording.description import title_of
from koopmpc.views.recording.plots import INK
from koopmpc.views.recording.reader import about_of
from koopmpc.views.recording.rrd import LogColumns
from koopmpc.views.recording.scenes import faces


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
    columns = LogColumns(Path(log), "world/**", "description", "state")
    with columns.reading():
        about, _ = about_of(columns)
        layers = sorted(_layers(columns), key=lambda layer: layer.order)
        last = max(len(columns.vectors("state")) - 1, 1) * about.dt
    if not layers:
        raise LogError(f"{log} has no scene to draw; give the Dynamics a method scene(x, u), or the plant a scene=")
    bodies = [s for one in layers if one.body for row in one.strokes for s in row]
    end = last if until is None else min(checks.positive(until, "until", "s"), last)
    moments = np.arange(0.0, end + 1e-9, speed / fps)
    steps = np.floor(moments / about.dt + 1e-6).astype(int).tolist()
    title = title_of(about)
    pictures = draw_frames(
        [_strokes_at(layers, k) for k in steps],
        [f"{title}   {t:.1f} s" for t in moments],
        low=np.min([s.points.min(axis=0) - s.width / 2 for s in bodies], axis=0),
        high=np.max([s.points.max(axis=0) + s.width / 2 for s in bodies], axis=0),
        width=width,
        background=INK.background,
    )
    save_video(pictures, path, fps)


def _strokes_at(layers: Sequence[_Layer], k: int) -> list[Stroke]:
    """Return the strokes at step k from the lowest to the highest; of one drawing order the farthest first."""
    found = [(layer.order, stroke.near, stroke) for layer in layers for stroke in layer.at(k)]
    return [stroke for *_, stroke in sorted(found, key=lambda one: one[:2])]


def _layers(columns: LogColumns) -> list[_Layer]:
    """Return the shapes that the log holds."""
    found: list[_Layer] = []
    for entity in columns.entities():
        k, shades = columns.lists(entity, "colors")
        if not len(k):
            continue
        lower = next((i for i, part in enumerate(("reference", "prediction")) if f"world/{part}/" in entity), 2)
        order = columns.static(entity, "draw_order")  # in the plane only
        strokes = _strokes(columns, entity, [[_shade(number) for number in row or ()] for row in shades.to_pylist()])
        found.append(_Layer(lower if order is None else float(order), k, strokes, lower != 1))
    return found


def _strokes(columns: LogColumns, entity: str, colors: list[list[Color]]) -> list[list[Stroke]]:
    """Return the strokes of each row of an entity: of its lines, its balls or its boxes."""

    def rows(what: str) -> list[Any]:
        return [row or () for row in columns.lists(entity, what)[1].to_pylist()]

    boxes = zip(rows("half_sizes"), rows("centers"), rows("quaternions"), colors, strict=False)
    sides = [
        [
            _stroke(face, 0.0, color, filled=True)
            for half, center, turn, color in zip(*row, strict=True)
            for face in faces(center, 2 * np.array(half), Rotation.from_quat(turn))
        ]
        for row in boxes
    ]
    strips = rows("strips") or [[[place, place] for place in row] for row in rows("positions")]
    return sides or [
        [_stroke(np.array(strip), 2 * radius, color) for strip, radius, color in zip(*row, strict=True) if strip]
        for row in zip(strips, rows("radii"), colors, strict=True)
    ]


def _stroke(points: np.ndarray, width: float, color: Color, *, filled: bool = False) -> Stroke:
    """Return the stroke through points of a log: Rerun's y points down in the plane, its z up in space."""
    if points.shape[1] == 2:
        return Stroke(points * (1.0, -1.0), width, color)
    seen = project(points)
    return Stroke(seen[:, :2], width, color, float(seen[:, 2].mean()), filled)


def _shade(number: int) -> Color:
    """Return a colour that is one number, 0xRRGGBBAA."""
    return number >> 24 & 255, number >> 16 & 255, number >> 8 & 255
