# pyright: basic
"""Shapes as Rerun draws them: lines in the plane; lines, balls and boxes in space."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from koopmpc.scene import Box, Color, Disk, Line, Shape

_STROKES = np.linspace(-1.0, 1.0, 5)  # places of the strokes that fill a box
_FACES = (
    np.array(  # of the cube of size 1, each a way around four corners
        [
            np.roll([(s, a, b) for a, b in [(-1, -1), (1, -1), (1, 1), (-1, 1)]], i, axis=1)
            for i in range(3)
            for s in (-1, 1)
        ]
    )
    * 0.5
)


class Drawing(NamedTuple):
    """One entity of a scene: a static archetype, if any, and columns over time."""

    style: Any
    columns: Any


def drawing_of(kind: type[Shape] | None, rows: Sequence[Sequence[tuple[Shape, Color]]], order: float) -> Drawing:
    """Return one entity: of any shapes in the plane (None), of one kind in space; each row holds any number of them.

    In the plane all are line strips with round ends: Rerun draws points as shaded balls, and a disk is a line without
    length. There `order` says what lies above what.
    """
    import rerun as rr

    shapes: list[Any] = [s for row in rows for s, _ in row]
    colors = np.array([c for row in rows for _, c in row], dtype=np.uint8).reshape(-1, 3)
    radii = np.array([line_radius(s) for s in shapes], dtype=np.float32)
    style = None
    with np.errstate(over="ignore"):
        if kind is None:
            style = rr.LineStrips2D.from_fields(draw_order=order)
            strips = [(outline(s) * (1.0, -1.0)).astype(np.float32) for s in shapes]  # Rerun's y points down
            columns = rr.LineStrips2D.columns(strips=strips, radii=radii, colors=colors)
        elif kind is Line:
            strips = [outline(s).reshape(-1, 3).astype(np.float32) for s in shapes]
            columns = rr.LineStrips3D.columns(strips=strips, radii=radii, colors=colors)
        elif kind is Disk:
            columns = rr.Points3D.columns(positions=_rows(3, [s.center for s in shapes]), radii=radii, colors=colors)
        else:
            style = rr.Boxes3D.from_fields(fill_mode="solid")
            columns = rr.Boxes3D.columns(
                centers=_rows(3, [s.center for s in shapes]),
                half_sizes=_rows(3, [s.size for s in shapes]) / 2,
                quaternions=_rows(4, [turned(s).as_quat() for s in shapes]),
                colors=colors,
            )
    return Drawing(style, columns.partition([len(row) for row in rows]))


def _rows(n: int, values: Sequence[Any]) -> Float[np.ndarray, "rows n"]:
    return np.array(values, dtype=np.float32).reshape(-1, n)


def turned(box: Box) -> Rotation:
    """Return how a box in space is turned."""
    angle = np.ravel(box.angle)
    return Rotation.from_rotvec([0.0, 0.0, angle[0]] if len(angle) == 1 else angle)


def faces(center: Any, size: Any, turn: Rotation) -> Float[np.ndarray, "6 4 3"]:
    """Return the faces of a box in space, each by its corners."""
    return turn.apply((_FACES * size).reshape(-1, 3)).reshape(6, 4, 3) + center


def outline(shape: Shape) -> Float[np.ndarray, "n d"]:
    """Return the line that draws a shape, y up; a box is a line there and back, a disk almost a point.

    Of a box in space it is a line through the corners.
    """
    if isinstance(shape, Line):
        points = np.asarray(shape.points, dtype=np.float64)
        return points if points.size else points.reshape(0, 2)
    if isinstance(shape, Disk):
        (x, *rest), length = shape.center, 1e-4 * shape.radius
        return np.array([(x - length, *rest), (x + length, *rest)])
    if len(shape.size) == 3:
        return faces(shape.center, shape.size, turned(shape)).reshape(-1, 3)
    width, height = shape.size
    r, upright = line_radius(shape), height > width
    along, across = max(shape.size) / 2 - r, min(shape.size) / 2 - r
    rim = [(-along, -across), (along, -across), (along, across), (-along, across), (-along, -across)]
    fill = [((-1) ** ((i + 1) // 2) * along, y * across) for i, y in enumerate(np.repeat(_STROKES, 2))]
    path = np.array(rim + fill)
    c, s = np.cos(shape.angle), np.sin(shape.angle)
    return (path[:, ::-1] if upright else path) @ np.array([[c, s], [-s, c]]) + np.asarray(shape.center)


def line_radius(shape: Shape) -> float:
    """Return half the width of the line that draws a shape; 0 of a box in space, which is drawn by its faces."""
    match shape:
        case Line():
            return shape.width / 2
        case Disk():
            return shape.radius
        case Box():
            return min(shape.size) / 8 if len(shape.size) == 2 else 0.0
