# pyright: basic
"""Line drawings over time: `draw_frames` renders pictures without a screen, `save_video` writes a .gif or .mp4."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from koopmpc.base import disk
from koopmpc.base.errors import DataError, LogError, install

_VIEW = np.deg2rad((-65.0, 25.0))  # direction to the eye [rad]: azimuth from the x-axis, elevation above the horizon


@dataclass(frozen=True)
class Stroke:
    """A line with round ends: `points` (n, 2) and `width` in m, y up, with a colour; if `filled`, a polygon.

    `near` is the distance [m] by which it is closer to the eye than the origin.
    """

    points: Float[np.ndarray, "n 2"]
    width: float
    color: tuple[int, int, int]
    near: float = 0.0
    filled: bool = False


def project(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the parallel projection of points in space (z up): coordinates to the right, upwards, and to the eye."""
    (a, e), (b, f) = ((np.cos(angle), np.sin(angle)) for angle in _VIEW)
    return points @ np.array([[-e, -f * a, b * a], [a, -f * e, b * e], [0.0, b, f]])


def draw_frames(
    frames: Sequence[Sequence[Stroke]],
    captions: Sequence[str],
    *,
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    width: int,
    background: tuple[int, int, int],
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield a picture of each frame, `width` pixels wide, of the box from `low` to `high` [m], with a caption above."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = np.maximum(high - low, 1e-9)
    pad = 0.06 * size.max()  # margin around the drawing, as a share of its size
    box = size + 2 * pad
    caption = max(18, width // 22)
    height = int(np.clip(width * box[1] / box[0], 0.3 * width, 1.5 * width)) + caption
    even = (width - width % 2, height - height % 2)  # video codecs need even numbers
    figure = Figure(figsize=(even[0] / 100, even[1] / 100), dpi=100, facecolor=_to_unit_range(background))
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1 - caption / even[1]))
    axes.set_axis_off()
    scale = min(even[0] / box[0], (even[1] - caption) / box[1])  # pixels a metre
    half = np.array([even[0], even[1] - caption]) / scale / 2
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    text = figure.text(0.02, 1 - 0.5 * caption / even[1], "", fontsize=0.45 * caption, color="#3a4048", va="center")
    for strokes, words in zip(frames, captions, strict=True):
        for old in [*axes.lines, *axes.patches]:
            old.remove()
        for stroke in strokes:
            axes.add_artist(_make_artist(stroke, scale))
        text.set_text(words)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _make_artist(stroke: Stroke, scale: float) -> Any:
    """Return the matplotlib artist of a stroke; `scale` is in pixels a metre, and 100 pixels are 72 points."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Polygon

    x, y = stroke.points.T
    linewidth, color = max(0.72 * stroke.width * scale, 0.5), _to_unit_range(stroke.color)
    if stroke.filled:
        return Polygon(stroke.points, facecolor=color, edgecolor=_to_unit_range((70, 80, 90)), linewidth=0.5, zorder=2)
    if np.ptp(stroke.points, axis=0).max() < 0.01 * stroke.width:  # matplotlib draws no round ends of so short a line
        return Line2D(x[:1], y[:1], linestyle="none", marker="o", markersize=linewidth, color=color, markeredgewidth=0)
    return Line2D(x, y, linewidth=linewidth, color=color, solid_capstyle="round", solid_joinstyle="round")


def save_video(pictures: Iterator[UInt8[np.ndarray, "height width 3"]], path: str | Path, fps: int) -> None:
    """Write the pictures to a .gif, or to an .mp4, which needs imageio-ffmpeg.

    Raises
    ------
    DataError
        The path does not end in .gif or .mp4.
    LogError
        imageio-ffmpeg is not installed, or the path cannot be written.
    """
    suffix = disk.path_of(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise DataError(f"{path} ends in {suffix or 'nothing'}; a video is a .gif or an .mp4")
    if suffix == ".gif":
        _save_gif(pictures, path, fps)
        return
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise LogError(
            f"an .mp4 needs imageio-ffmpeg, which is not installed: {install('video')}, or write a .gif"
        ) from error
    first = next(pictures)
    with TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        writer = imageio_ffmpeg.write_frames(str(video), (first.shape[1], first.shape[0]), fps=fps, macro_block_size=2)
        writer.send(None)
        for picture in chain([first], pictures):
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        with disk.writing(path) as file:
            file.write(video.read_bytes())


def _save_gif(pictures: Iterator[UInt8[np.ndarray, "height width 3"]], path: str | Path, fps: int) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    sample = Image.fromarray(np.concatenate([np.asarray(image) for image in images[:: max(1, len(images) // 8)]]))
    palette = sample.quantize(48, dither=Image.Dither.NONE)  # number of colours of a .gif
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    with disk.writing(path) as file:
        flat[0].save(
            file, format="GIF", save_all=True, append_images=flat[1:], duration=round(1000 / fps), loop=0, optimize=True
        )


def _to_unit_range(color: tuple[int, int, int]) -> tuple[float, float, float]:
    r, g, b = (c / 255 for c in color)
    return r, g, b
