"""Units: the QP of a step without dimension, so that the tolerances of a solver mean the same whatever the plant's.

Each variable is measured by the square root of its curvature, all of them by the room between the limits of the
inputs, and each row by how far the variables move it. The units of a stage are those of every other: a solution
moved on by one step needs no conversion.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Box


class Units(NamedTuple):
    """w = columns · w′, of every stage, and H′ = columns H columns / curvature."""

    columns: Float[np.ndarray, " nw"]
    curvature: float


def units(
    hessian: Float[np.ndarray, "nw nw"], moved: Float[np.ndarray, "nw nw"], inputs: Box, stages: int
) -> Units:
    """Return the units of w; `moved` tells how w moves the inputs of each stage, `inputs` their limits."""
    curvature = np.diag(hessian).reshape(stages, -1).mean(axis=0)
    columns = np.tile(1 / np.sqrt(curvature), stages)
    room = 0.5 * (inputs.high - inputs.low)
    reach = room / row_sizes(moved * columns, stages)
    known = reach[np.isfinite(reach) & (reach > 0)]
    size = float(known.max()) if known.size else 1.0
    return Units(size * columns, size**2)


def row_sizes(rows: Float[np.ndarray, "m nw"], stages: int) -> Float[np.ndarray, " n"]:
    """Return the norm of the rows of a stage, root mean square of all stages; 1 for rows that nothing moves."""
    squares = (rows**2).sum(axis=1).reshape(stages, -1).mean(axis=0)
    return np.sqrt(np.where(squares > 0, squares, 1.0))
