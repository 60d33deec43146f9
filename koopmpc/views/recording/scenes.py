# pyright: basic
"""Scenes: the shapes that scene(x, u) returns over time, as Rerun draws them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.scene import Box, Color, Disk, Line, Scene, Shape
from koopmpc.loop.rows import StepRows
from koopmpc.loop.run import About, bind_outputs
from koopmpc.views.recording.plots import INK

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


ColoredShape = tuple[Shape, Color]
Drawings = dict[str, Drawing]


def drawing_of(kind: type[Shape] | None, rows: Sequence[Sequence[ColoredShape]], order: float) -> Drawing:
    """Return one entity: of any shapes in the plane (None), of one kind in space; each row holds any number of them.

    In the plane all are line strips with round ends: Rerun draws points as shaded balls, and a disk is a line without
    length. There `order` says what lies above what.
    """
    import rerun as rr

    pairs = list(chain.from_iterable(rows))
    shapes: list[Any] = [s for s, _ in pairs]
    colors = np.array([c for _, c in pairs], dtype=np.uint8).reshape(-1, 3)
    radii = np.array([line_radius(s) for s in shapes], dtype=np.float32)
    style = None
    with np.errstate(over="ignore"):
        if kind is None:
            style = rr.LineStrips2D.from_fields(draw_order=order)
            strips = [(outline(s) * (1.0, -1.0)).astype(np.float32) for s in shapes]  # Rerun's y points down
            even = len({len(strip) for strip in strips}) == 1  # Rerun takes one array faster than a list of arrays
            columns = rr.LineStrips2D.columns(strips=np.stack(strips) if even else strips, radii=radii, colors=colors)
        else:
            style = rr.Boxes3D.from_fields(fill_mode="solid") if kind is Box else None
            columns = _columns_in_space(kind, shapes, radii, colors)
    return Drawing(style, columns.partition([len(row) for row in rows]))


def _columns_in_space(kind: type[Shape], shapes: list[Any], radii: np.ndarray, colors: np.ndarray) -> Any:
    """Return the columns of shapes of one kind: lines, balls or boxes."""
    import rerun as rr

    if kind is Line:
        strips = [outline(s).reshape(-1, 3).astype(np.float32) for s in shapes]
        return rr.LineStrips3D.columns(strips=strips, radii=radii, colors=colors)
    centers = _rows(3, [s.center for s in shapes])
    if kind is Disk:
        return rr.Points3D.columns(positions=centers, radii=radii, colors=colors)
    turns = _rows(4, [find_rotation(s).as_quat() for s in shapes])
    sizes = _rows(3, [s.size for s in shapes])
    return rr.Boxes3D.columns(centers=centers, half_sizes=sizes / 2, quaternions=turns, colors=colors)


def _rows(n: int, values: Sequence[Any]) -> Float[np.ndarray, "rows n"]:
    return np.array(values, dtype=np.float32).reshape(-1, n)


def find_rotation(box: Box) -> Rotation:
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
        return faces(shape.center, shape.size, find_rotation(shape)).reshape(-1, 3)
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


@dataclass
class Bounds:
    """The least box around some points in the plane or in space [m], their last coordinate up; empty at first."""

    low: Float[np.ndarray, "..."] = field(default_factory=lambda: np.array(np.inf))
    high: Float[np.ndarray, "..."] = field(default_factory=lambda: np.array(-np.inf))

    def include(self, scenes: Iterable[Sequence[Shape]]) -> None:
        """Widen the box by all shapes."""
        for shape in (shape for scene in scenes for shape in scene):
            points = outline(shape)
            if len(points) and np.isfinite(points).all():
                self.low = np.minimum(self.low, points.min(axis=0) - line_radius(shape))
                self.high = np.maximum(self.high, points.max(axis=0) + line_radius(shape))


@dataclass
class Extent:
    """The box that the animation shows: all drawn shapes, and predicted shapes that are not far from them."""

    drawn: Bounds = field(default_factory=Bounds)
    predicted: Bounds = field(default_factory=Bounds)

    @property
    def in_space(self) -> bool:
        """Whether what was drawn has three coordinates."""
        return self.drawn.low.size == 3

    def ranges(self) -> list[list[float]] | None:
        """Return the range of each of Rerun's coordinates, with a margin; None before anything was drawn.

        Rerun's y points down in the plane, and its z up in space.
        """
        low, high = self.drawn.low, self.drawn.high
        if not np.isfinite(low).all():
            return None
        size = float((high - low).max())
        far = 0.25 * size  # margin for predictions, which may diverge
        low = np.minimum(low, np.maximum(self.predicted.low, low - far)) - 0.06 * size - 1e-9
        high = np.maximum(high, np.minimum(self.predicted.high, high + far)) + 0.06 * size + 1e-9
        found = np.column_stack([low, high])
        if not self.in_space:
            found[1] = -found[1, ::-1]
        return found.tolist()


class Names:
    """The names of a scene's shapes, in their order, and their kinds; empty before the first scene."""

    def __init__(self) -> None:
        self._kinds: dict[str, type[Shape]] | None = None
        self._coordinates: set[int] = set()  # how many a point has

    def __iter__(self) -> Iterator[str]:
        return iter(self._kinds or {})

    def kind(self, name: str) -> type[Shape] | None:
        """Return the kind of shape that a name stands for in space, None in the plane."""
        return self._kinds[name] if self._kinds and 3 in self._coordinates else None

    def check(self, scene: Sequence[Shape], step: int) -> list[Shape]:
        """Return the shapes of `scene`.

        Raises
        ------
        DataError
            A shape is at NaN, came or went since the first scene, or lies in space while another lies in the plane.
        """
        own = {shape.name: type(shape) for shape in scene}
        for shape in scene:
            self._coordinates.update(len(at) if isinstance(at, tuple) else np.size(at) for at in _places(shape))
            if len(self._coordinates) > 1 or not self._coordinates <= {2, 3}:
                many = " and ".join(str(n) for n in sorted(self._coordinates))
                raise DataError(
                    f"the scene of step {step} draws points with {many} coordinates, the last one of {shape.name!r}; "
                    "all points and sizes of a scene have two, (x, y), or all have three, (x, y, z)"
                )
            if not all(
                map(isfinite, chain([line_radius(shape), np.sum(getattr(shape, "angle", 0.0))], *_places(shape)))
            ):
                raise DataError(
                    f"the scene of step {step} draws {shape.name!r} at NaN or inf; every x and u needs a place"
                )
        self._kinds = own if self._kinds is None else self._kinds
        for name in own.keys() ^ self._kinds.keys():
            what = "has a new shape" if name in own else "lacks the shape"
            raise DataError(
                f"the scene of step {step} {what} {name!r}; a scene returns the same names for every x and u"
            )
        for shape in scene:
            if (kind := self.kind(shape.name)) not in (None, type(shape)):
                raise DataError(
                    f"the scene of step {step} draws {shape.name!r} as {checks.article(shape)} and as a "
                    f"{kind.__name__}; in space a name stands for one kind of shape"
                )
        return list(scene)


def _places(shape: Shape) -> Any:
    """Return what of a shape has a number for each coordinate."""
    if isinstance(shape, Line):
        return shape.points
    if isinstance(shape, Disk):
        return (shape.center,)
    return (shape.center, shape.size, *([shape.angle] if np.ndim(shape.angle) else []))


def draw_layer(
    layer: str, names: Names, rows: Sequence[Sequence[ColoredShape]], order: float, step: float = 0.0
) -> Drawings:
    """Return a drawing by entity of the shapes of each row, the next name `step` above; an empty row clears it."""
    found: Drawings = {}
    for i, name in enumerate(names):
        shapes = [[pair for pair in row if pair[0].name == name] for row in rows]
        found[f"{layer}/{name}"] = drawing_of(names.kind(name), shapes, order + i * step)
    return found


class Scenes:
    """The drawings of a run, row by row: scene(x, u) of its states, of a few stages of its plans, of its reference.

    `extent` holds all that was drawn; without a scene nothing is.
    """

    def __init__(self, about: About, scene: Scene | None) -> None:
        self.scene, self.extent = scene, Extent()
        self._about, self._names = about, Names()
        self._u: np.ndarray | None = None  # the last input
        self._ahead = False  # a plan was drawn before
        self._targets: dict[bytes, Float[np.ndarray, " nx"] | None] = {}  # states of the references
        self._aims: dict[bytes, list[Shape]] = {}  # scenes of the references of a block; most stay for many rows

    def draw_rows(self, first: int, rows: StepRows, plans: Sequence[tuple[int, np.ndarray, np.ndarray]]) -> Drawings:
        """Return the drawings of rows first, first + 1, … by entity; `plans` are steps with their planned X and U."""
        scene = self.scene
        if scene is None:
            return {}
        ahead = {k: self._follow_plan(scene, k, X, U) for k, X, U in plans}
        now = [self._show(scene, first + i, rows, i) for i in range(len(rows.X))]
        moves = [rows.u_reference[min(i, len(rows.U) - 1)] for i in range(len(rows.X))] if len(rows.U) else []
        self._aims.clear()
        aims = [self._aim(scene, *aim, first) for aim in zip(rows.reference, moves, strict=False)] or [[] for _ in now]
        drawings = draw_layer("world", self._names, _paint(now), 30.0, 1.0)
        self.extent.drawn.include([*now, *aims])
        self._ahead = self._ahead or any(ahead.values())
        if self._ahead:
            futures = [ahead.get(first + i, []) for i in range(len(now))]
            self.extent.predicted.include(chain.from_iterable(futures))
            drawings |= draw_layer("world/prediction", self._names, list(map(_fade_plan, now, futures)), 10.0)
        if any(aims):
            if self.extent.in_space:  # there nothing lies below: a shape at its reference is not drawn twice
                aims = [[s for s in aim if s not in shapes] for shapes, aim in zip(now, aims, strict=True)]
            drawings |= draw_layer("world/reference", self._names, _paint(aims, INK.aim), 2.0)
        return drawings

    def _follow_plan(self, scene: Scene, k: int, X: np.ndarray, U: np.ndarray) -> list[list[Shape]]:
        """Return the shapes of a few stages of a plan; none where a part of it is missing."""
        if not (np.isfinite(X).all() and np.isfinite(U).all()):
            return []
        return [self._names.check(scene(X[i], U[min(i, len(U) - 1)]), k) for i in stages(len(U))]

    def _show(self, scene: Scene, k: int, rows: StepRows, i: int) -> list[Shape]:
        """Return the shapes of row i at step k, of the measurement where the state is hidden; none without numbers."""
        self._u = rows.U[i] if i < len(rows.U) else self._u
        x, y = rows.X[i], rows.Y[i]
        x = y if np.isnan(x).any() and len(y) == len(x) else x
        if self._u is None or not np.isfinite(x).all():
            return []
        return self._names.check(scene(x, self._u), k)

    def _aim(self, scene: Scene, reference: np.ndarray, u: np.ndarray, step: int) -> list[Shape]:
        """Return the shapes at the state that a reference names; none where it names none."""
        key = reference.tobytes()
        if key not in self._targets:
            # states of so many different references are looked for
            self._targets[key] = self._find_target(reference) if len(self._targets) < 2000 else None
        x = self._targets[key]
        if x is None:
            return []
        key += u.tobytes()
        if key not in self._aims:
            self._aims[key] = self._names.check(scene(x, u), step)
        return self._aims[key]

    def _find_target(self, reference: Float[np.ndarray, " nr"]) -> Float[np.ndarray, " nx"] | None:
        """Return x with of(x) = r, of least size; None where r is not finite, or there is no such x."""
        # the viewer draws in float32
        if self._about.cost is None or not (np.abs(reference) < 1e30).all():
            return None
        of = bind_outputs(self._about.cost.of, self._about.states)
        if of is None or of.names == self._about.states:
            return reference.copy()
        from scipy.optimize import least_squares

        # an angle from its sine and cosine has flat places between the starts
        lifting = of
        starts = [np.full(len(self._about.states), first) for first in (0.01, 2.0, -2.0)]
        fits = [least_squares(lambda x: lifting(x) - reference, start) for start in starts]
        return min((fit.x for fit in fits if fit.cost < 1e-10), key=lambda x: np.abs(x).sum(), default=None)


def _paint(rows: Sequence[Sequence[Shape]], color: Color | None = None) -> list[list[ColoredShape]]:
    """Return the shapes of each row with this colour, or with their own."""
    return [[(shape, color or shape.color) for shape in row] for row in rows]


def _fade_plan(now: Sequence[Shape], futures: Sequence[Sequence[Shape]]) -> list[ColoredShape]:
    """Return the shapes of a plan that move, the later the fainter, the last one first."""
    return [
        (shape, _fade(shape.color, (i + 1) / (len(futures) + 1)))
        for i, shapes in reversed(list(enumerate(futures)))
        for shape in shapes
        if shape not in now
    ]


def stages(horizon: int, most: int = 4) -> list[int]:
    """Return the few stages of a plan that are drawn, the last one among them."""
    return sorted({round(horizon * (i + 1) / most) for i in range(most)} - {0})


def _fade(color: Color, share: float) -> Color:
    """Return `color` mixed with the background: Rerun draws lines without transparency."""
    weight = 0.45 + 0.5 * share
    r, g, b = (round((1 - weight) * c + weight * d) for c, d in zip(color, INK.background, strict=True))
    return r, g, b
