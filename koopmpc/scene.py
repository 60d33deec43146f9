"""Shapes of a scene: plain data that a problem returns and the recording draws; SI units, y up."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Point = tuple[float, float]
Color = tuple[int, int, int]


@dataclass(frozen=True)
class Line:
    """A polyline through `points` [m], `width` [m] wide."""

    name: str
    points: Sequence[Point]
    width: float = 0.03
    color: Color = (70, 90, 110)


@dataclass(frozen=True)
class Box:
    """A rectangle of `size` (width, height) [m] about `center` [m], turned by `angle` [rad] counter-clockwise."""

    name: str
    center: Point
    size: Point
    angle: float = 0.0
    color: Color = (70, 90, 110)


@dataclass(frozen=True)
class Disk:
    """A disk of `radius` [m] about `center` [m]."""

    name: str
    center: Point
    radius: float
    color: Color = (200, 90, 40)


Shape = Line | Box | Disk

Scene = Callable[[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]], Sequence[Shape]]
"""scene(x, u) → the shapes of one state and input; always the same names."""
