"""Shapes of a scene: plain data that a problem returns and the recording draws; SI units.

A scene lies in the plane, of points (x, y) with y up, or in space, of points (x, y, z) with z up; never in both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Real

__all__ = [
    "Box",
    "Disk",
    "Line",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


Point = Sequence[float] | Real[np.ndarray, " d"]
Color = tuple[int, int, int]


@dataclass(frozen=True)
class Line:
    """A polyline through `points` [m], `width` [m] wide."""

    name: str
    points: Sequence[Point] | Real[np.ndarray, "n d"]
    width: float = 0.03
    color: Color = (70, 90, 110)

    def __post_init__(self) -> None:
        _store(self, "points")


@dataclass(frozen=True)
class Box:
    """A rectangle of `size` (width, height) [m] about `center` [m], turned by `angle` [rad] counter-clockwise.

    In space a cuboid of `size` along x, y and z; `angle` turns it about the vertical or, of three numbers, about the
    axis in which they point, by their length [rad].
    """

    name: str
    center: Point
    size: Point
    angle: float | Point = 0.0
    color: Color = (70, 90, 110)

    def __post_init__(self) -> None:
        _store(self, "center", "size", "angle")


@dataclass(frozen=True)
class Disk:
    """A disk of `radius` [m] about `center` [m]; in space a ball."""

    name: str
    center: Point
    radius: float
    color: Color = (200, 90, 40)

    def __post_init__(self) -> None:
        _store(self, "center")


def _store(shape: Any, *names: str) -> None:
    """Store points as tuples, those of arrays too, so that shapes compare as plain data."""
    for name in names:
        object.__setattr__(shape, name, _plain(getattr(shape, name)))


def _plain(value: Any) -> Any:
    plain: Any = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(plain, list | tuple):
        return plain
    parts = cast("Sequence[Any]", plain)
    if parts and isinstance(parts[0], float | int):  # one point, as a scene draws thousands of
        return tuple(parts)
    return tuple(map(_plain, parts))


Shape = Line | Box | Disk

Scene = Callable[[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]], Sequence[Shape]]
"""scene(x, u) → the shapes of one state and input; always the same names."""
