"""Limits: the inequalities that every controller and every metric shares."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.values import Value

SOFTENED = 1e-4  # a slack above this share of 1 + |limit| is reported


class Box(NamedTuple):
    """low ≤ v ≤ high, ±inf where there is no limit."""

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Limits(Value):
    """u_min ≤ u_k ≤ u_max (hard), x_min ≤ x_k ≤ x_max and y_min ≤ of(x_k) ≤ y_max (soft), k = 1 … N.

    Parameters
    ----------
    u_min, u_max, x_min, x_max, y_min, y_max
        Scalars or vectors; None or ±inf where there is no limit.
    of
        Observables of the state that y_min and y_max limit. A controller on a lifted predictor finds them in its
        own lifting by name.
    slack
        (linear, quadratic) weight of the violation ε of every state and output limit: linear ε + quadratic ε².
        A linear weight above the largest dual keeps the limits exactly wherever that is possible. None makes them
        hard.

    Raises
    ------
    DataError
        Crossed limits; y limits without `of`; a negative slack weight.
    """

    u_min: ArrayLike | None = None
    u_max: ArrayLike | None = None
    x_min: ArrayLike | None = None
    x_max: ArrayLike | None = None
    of: Lifting | None = None
    y_min: ArrayLike | None = None
    y_max: ArrayLike | None = None
    slack: tuple[float, float] | None = (1e4, 1e2)

    def __post_init__(self) -> None:
        for low, high, name in (
            ("u_min", "u_max", "input"),
            ("x_min", "x_max", "state"),
            ("y_min", "y_max", "output"),
        ):
            for end in (low, high):
                value = getattr(self, end)
                if value is not None:
                    object.__setattr__(self, end, checks.array(value, end, infinite=True))
            _require_room(getattr(self, low), getattr(self, high), low, high, name)
        if (self.y_min is not None or self.y_max is not None) and self.of is None:
            raise DataError(
                "y_min and y_max limit observables; say which with of=, for example of=km.Fourier(1)"
            )
        if self.slack is not None:
            linear, quadratic = (float(weight) for weight in checks.array(self.slack, "slack", (2,)))
            if linear < 0 or quadratic < 0 or linear + quadratic == 0:
                raise DataError(
                    f"slack is {self.slack}; pass weights (linear, quadratic) ≥ 0, one above zero, or None"
                )
            object.__setattr__(self, "slack", (linear, quadratic))

    def inputs(self, nu: int) -> Box:
        """Return the box of the inputs."""
        return _box(self.u_min, self.u_max, "u_min", "u_max", nu)

    def states(self, nx: int) -> Box:
        """Return the box of the states."""
        return _box(self.x_min, self.x_max, "x_min", "x_max", nx)

    def outputs(self, ny: int) -> Box:
        """Return the box of the observables `of`."""
        return _box(self.y_min, self.y_max, "y_min", "y_max", ny)


def softened(slacks: Float[np.ndarray, "N ng"], outputs: Box) -> bool:
    """Return whether a soft limit gives way by more than 1e-4 (1 + |limit|) at any stage."""
    if not slacks.size:
        return False
    size = np.maximum(*(np.where(np.isfinite(end), np.abs(end), 0.0) for end in outputs))
    return bool((slacks > SOFTENED * (1 + size)).any())


def _require_room(
    low: Float[np.ndarray, "..."] | None,
    high: Float[np.ndarray, "..."] | None,
    low_name: str,
    high_name: str,
    name: str,
) -> None:
    """Raise where no number is between the limits."""
    lower, upper = (
        np.atleast_1d(-np.inf if low is None else low),
        np.atleast_1d(np.inf if high is None else high),
    )
    if lower.shape != upper.shape and 1 not in (lower.size, upper.size):
        raise ShapeError(
            f"{low_name} has shape {lower.shape} and {high_name} {upper.shape}; pass one limit a row, or scalars"
        )
    a, b = np.broadcast_arrays(lower, upper)
    checks.crossed(a, b, name)
    if (lower == np.inf).any() or (upper == -np.inf).any():
        raise DataError(
            f"{low_name} is +inf or {high_name} is −inf somewhere; use −inf, +inf where there is no limit"
        )


def _box(low: ArrayLike | None, high: ArrayLike | None, low_name: str, high_name: str, n: int) -> Box:
    return Box(
        checks.vector(-np.inf if low is None else low, low_name, n, infinite=True),
        checks.vector(np.inf if high is None else high, high_name, n, infinite=True),
    )
