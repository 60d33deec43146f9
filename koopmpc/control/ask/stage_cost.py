"""A custom stage cost: an expression of x_k and u_k as a graph, that files, metrics and controllers read."""

from collections.abc import Callable
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.plants.graph import Graph

StageCost: TypeAlias = Callable[[ca.SX, ca.SX], Any] | Graph


@raise_swallowed()
def trace_stage(stage: StageCost, nx: int, nu: int) -> Graph:
    """Return the graph of ℓ(x, u), a number, of nx states and nu inputs.

    Raises
    ------
    DataError
        The function raises, or holds an operation that a graph cannot hold.
    ShapeError
        It is of other sizes, or returns no single number.
    """
    if isinstance(stage, Graph):
        if (stage.n, stage.m) != (nx + nu, 1):
            raise ShapeError(
                f"stage is of {stage.n} states and inputs together, and the plant has {nx} and {nu}; pass the function"
                " of this plant"
            )
        return stage
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    try:
        value = ca.SX(stage(x, u))
    except (RuntimeError, TypeError, ValueError, IndexError, NotImplementedError, AttributeError) as error:
        raise DataError(
            f"stage(x, u) raised {type(error).__name__}: {error}; write it with CasADi's functions of x ({nx} states)"
            f" and u ({nu} inputs), for example lambda x, u: x[0] ** 2 + 0.3 * u[0]"
        ) from error
    if value.shape != (1, 1):
        raise ShapeError(f"stage(x, u) has shape {value.shape}, expected one number")
    own = ca.vertcat(x, u)
    free = [str(symbol) for symbol in ca.symvar(value) if not ca.depends_on(symbol, own)]
    if free:
        raise DataError(f"stage(x, u) holds the symbol {free[0]}, which is neither of its arguments; pass a number")
    return Graph.trace(ca.Function("stage", [own], [ca.densify(value)]))


def evaluate_stage(
    stage: StageCost, X: Float[np.ndarray, "T nx"], U: Float[np.ndarray, "T nu"]
) -> Float[np.ndarray, " T"]:
    """Return ℓ(x_k, u_k) row by row."""
    return trace_stage(stage, X.shape[1], U.shape[1]).evaluate(np.hstack([X, U]))[:, 0]
