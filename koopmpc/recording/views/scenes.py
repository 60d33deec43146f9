# pyright: basic
"""Scenes: the shapes that scene(x, u) returns over time, as columns for Rerun."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.errors import DataError
from koopmpc.loop.run import About, StepRows
from koopmpc.scene import Box, Color, Disk, Line, Scene, Shape

BACKGROUND: Color = (247, 248, 250)
_FAR = 0.25  # margin for predictions, which may diverge, as a share of the size of the drawn shapes
_AIM: Color = (188, 193, 201)  # of the reference
_DRAWN = 1e30  # the viewer draws in float32
_AIMS = 2000  # states of so many different references are looked for
_STAGES = 4  # how many future stages of a plan are drawn
_STROKES = np.linspace(-1.0, 1.0, 5)  # places of the strokes that fill a box


class Drawing(NamedTuple):
    """One entity of a scene: a static archetype with the drawing order, and columns over time."""

    style: Any
    columns: Any


@dataclass
class Box2D:
    """The least box around some points, y up [m]; empty at first."""

    low: Float[np.ndarray, "2"] = field(default_factory=lambda: np.full(2, np.inf))
    high: Float[np.ndarray, "2"] = field(default_factory=lambda: np.full(2, -np.inf))

    def include(self, shape: Shape) -> None:
        """Widen the box by one shape."""
        points = _points(shape)
        if len(points) and np.isfinite(points).all():
            self.low = np.minimum(self.low, points.min(axis=0) - _radius(shape))
            self.high = np.maximum(self.high, points.max(axis=0) + _radius(shape))


@dataclass
class Extent:
    """The box that the animation shows: all drawn shapes, and predicted shapes that are not far from them."""

    drawn: Box2D = field(default_factory=Box2D)
    predicted: Box2D = field(default_factory=Box2D)

    def ranges(self) -> tuple[list[float], list[float]] | None:
        """Return the ranges of x and of Rerun's y (down), with a margin; None before anything was drawn."""
        low, high = self.drawn.low, self.drawn.high
        if not np.isfinite(low).all():
            return None
        size = float((high - low).max())
        (x0, y0) = np.minimum(low, np.maximum(self.predicted.low, low - _FAR * size)) - 0.06 * size - 1e-9
        (x1, y1) = np.maximum(high, np.minimum(self.predicted.high, high + _FAR * size)) + 0.06 * size + 1e-9
        return [float(x0), float(x1)], [-float(y1), -float(y0)]


class Names:
    """The names of a scene's shapes, in their order; empty before the first scene."""

    def __init__(self) -> None:
        self._names: dict[str, None] | None = None

    def __iter__(self) -> Iterator[str]:
        return iter(self._names or {})

    def checked(self, scene: Sequence[Shape], step: int) -> list[Shape]:
        """Return the shapes of `scene`.

        Raises
        ------
        DataError
            A shape came or went since the first scene.
        """
        own = {shape.name: None for shape in scene}
        for shape in scene:
            if not all(
                np.isfinite(np.asarray(getattr(shape, f.name), dtype=np.float64)).all() for f in _numbers(shape)
            ):
                raise DataError(
                    f"the scene of step {step} draws {shape.name!r} at NaN or inf; every x and u needs a place"
                )
        self._names = own if self._names is None else self._names
        for name in own.keys() ^ self._names.keys():
            what = "has a new shape" if name in own else "lacks the shape"
            raise DataError(
                f"the scene of step {step} {what} {name!r}; a scene returns the same names for every x and u"
            )
        return list(scene)


def _numbers(shape: Shape) -> list[Field[Any]]:
    """Return the fields of a shape that are places and sizes."""
    return [field for field in fields(shape) if field.name not in ("name", "color")]


def draw(names: Iterable[str], scenes: Sequence[Sequence[Shape]], extent: Extent) -> dict[str, Drawing]:
    """Return a drawing by name for one scene a row; an empty scene clears what was there."""
    for shape in (shape for scene in scenes for shape in scene):
        extent.drawn.include(shape)
    return {
        name: _drawing([[(s, s.color) for s in scene if s.name == name] for scene in scenes], 30.0 + i)
        for i, name in enumerate(names)
    }


def draw_ahead(
    names: Iterable[str],
    scenes: Sequence[Sequence[Shape]],
    ahead: Sequence[Sequence[Sequence[Shape]]],
    extent: Extent,
) -> dict[str, Drawing]:
    """Return a drawing by name for the predicted scenes of each row, the later the fainter.

    A shape that does not move within the plan is not drawn again.
    """
    for shape in (shape for row in ahead for scene in row for shape in scene):
        extent.predicted.include(shape)
    drawings: dict[str, Drawing] = {}
    for name in names:
        rows: list[list[tuple[Shape, Color]]] = []
        for now, futures in zip(scenes, ahead, strict=True):
            here = [s for s in now if s.name == name]
            later = [(i, s) for i, scene in enumerate(futures) for s in scene if s.name == name and s not in here]
            rows.append([(s, _faded(s.color, (i + 1) / (len(futures) + 1))) for i, s in reversed(later)])
        drawings[name] = _drawing(rows, 10.0)
    return drawings


def draw_reference(names: Iterable[str], scenes: Sequence[Sequence[Shape]], extent: Extent) -> dict[str, Drawing]:
    """Return a drawing by name, in grey below all others, for the scene of the reference of each row."""
    for shape in (shape for scene in scenes for shape in scene):
        extent.drawn.include(shape)
    return {name: _drawing([[(s, _AIM) for s in scene if s.name == name] for scene in scenes], 2.0) for name in names}


class ReferenceScenes:
    """The scene at the state that a reference names; no shapes where it names none."""

    def __init__(self, about: About) -> None:
        self._about = about
        self._known: dict[bytes, Float[np.ndarray, " nx"] | None] = {}

    def of(self, rows: StepRows, scene: Scene) -> list[list[Shape]]:
        """Return the shapes of each row's reference."""
        if self._about.cost is None or not len(rows.U):
            return [[] for _ in rows.X]
        moves = [rows.u_reference[min(i, len(rows.U) - 1)] for i in range(len(rows.X))]
        states = [self._state(r) for r in rows.reference]
        return [[] if x is None else list(scene(x, u)) for x, u in zip(states, moves, strict=True)]

    def _state(self, reference: Float[np.ndarray, " nr"]) -> Float[np.ndarray, " nx"] | None:
        """Return x with of(x) = r, of least size; None where r is not finite, or there is no such x."""
        key = reference.tobytes()
        if key not in self._known:
            self._known[key] = self._found(reference) if len(self._known) < _AIMS else None
        return self._known[key]

    def _found(self, reference: Float[np.ndarray, " nr"]) -> Float[np.ndarray, " nx"] | None:
        assert self._about.cost is not None
        of = self._about.cost.of.bind(self._about.states)
        if not (np.abs(reference) < _DRAWN).all():
            return None
        if of.names == self._about.states:
            return reference.copy()
        from scipy.optimize import least_squares

        least = None
        for first in (0.01, 2.0, -2.0):  # an angle from its sine and cosine has flat places between
            fit = least_squares(lambda x: of(x) - reference, np.full(len(self._about.states), first))
            if fit.cost < 1e-10 and (least is None or np.abs(fit.x).sum() < np.abs(least).sum()):
                least = fit.x
        return least


def stages(horizon: int) -> list[int]:
    """Return the few stages of a plan that are drawn, the last one among them."""
    return sorted({round(horizon * (i + 1) / _STAGES) for i in range(_STAGES)} - {0})


def _drawing(rows: Sequence[Sequence[tuple[Shape, Color]]], order: float) -> Drawing:
    """Return one entity; each row holds any number of shapes.

    All are line strips with round ends: Rerun draws points as shaded balls, and a disk is a line without length.
    """
    import rerun as rr

    flat = [pair for row in rows for pair in row]
    with np.errstate(over="ignore"):
        strips = [(_points(s) * (1.0, -1.0)).astype(np.float32) for s, _ in flat]  # Rerun's y points down
    columns = rr.LineStrips2D.columns(
        strips=strips,
        radii=np.array([_radius(s) for s, _ in flat], dtype=np.float32),
        colors=np.array([c for _, c in flat], dtype=np.uint8).reshape(-1, 3),
    )
    return Drawing(rr.LineStrips2D.from_fields(draw_order=order), columns.partition([len(row) for row in rows]))


def _points(shape: Shape) -> Float[np.ndarray, "n 2"]:
    """Return the line that draws a shape, y up; a box is a line there and back, a disk almost a point."""
    if isinstance(shape, Line):
        return np.asarray(shape.points, dtype=np.float64).reshape(-1, 2)
    if isinstance(shape, Disk):
        (x, y), length = shape.center, 1e-4 * shape.radius
        return np.array([(x - length, y), (x + length, y)])
    width, height = shape.size
    r, upright = _radius(shape), height > width
    along, across = max(shape.size) / 2 - r, min(shape.size) / 2 - r
    rim = [(-along, -across), (along, -across), (along, across), (-along, across), (-along, -across)]
    fill = [((-1) ** ((i + 1) // 2) * along, y * across) for i, y in enumerate(np.repeat(_STROKES, 2))]
    path = np.array(rim + fill)
    c, s = np.cos(shape.angle), np.sin(shape.angle)
    return (path[:, ::-1] if upright else path) @ np.array([[c, s], [-s, c]]) + np.asarray(shape.center)


def _radius(shape: Shape) -> float:
    """Return half the width of the line that draws a shape."""
    match shape:
        case Line():
            return shape.width / 2
        case Disk():
            return shape.radius
        case Box():
            return min(shape.size) / 8


def _faded(color: Color, share: float) -> Color:
    """Return `color` mixed with the background: Rerun draws lines without transparency."""
    weight = 0.45 + 0.5 * share
    r, g, b = (round((1 - weight) * c + weight * d) for c, d in zip(color, BACKGROUND, strict=True))
    return r, g, b
