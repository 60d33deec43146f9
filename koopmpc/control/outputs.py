"""What a cost and limits read from a state, as CasADi functions: for controllers on x⁺ = F(x, u) itself."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Box, Limits, Softness


class Outputs(NamedTuple):
    """Functions of x with their weights and limits: tracked of(x) (nr, Q), limited g(x) (ng, box), and the inputs'.

    softness says what it costs to leave the box, row by row; a linear weight of inf makes a row hard. R_delta and
    `rates` are None where the change of the inputs is free.
    """

    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Box
    box: Box
    softness: Softness
    R_delta: Float[np.ndarray, "nu nu"] | None
    rates: Box | None
    rate_softness: Softness

    @property
    def rated(self) -> bool:
        """Whether the change of the inputs counts."""
        return self.R_delta is not None or self.rates is not None


def outputs(states: tuple[str, ...], nu: int, cost: Cost, limits: Limits, size: int | None = None) -> Outputs:
    """Return what `cost` tracks and `limits` bound, of these states and of `nu` inputs; rows without limit go.

    The functions take `size` values, the states first; by default the states alone.
    """
    nx = len(states)
    point = ca.SX.sym("x", nx if size is None else size)
    x = point[:nx]
    of = cost.of.bind(states)
    Q, R = cost.matrices(of.nz, nu)
    bound = None if limits.of is None else limits.of.bind(states)
    values = x if bound is None else ca.vertcat(x, bound.symbolic(x))
    rows = limits.rows(nx, 0 if bound is None else bound.nz)
    kept = np.flatnonzero(rows.kept).tolist()
    return Outputs(
        ca.Function("tracked", [point], [ca.densify(of.symbolic(x))]),
        ca.Function("limited", [point], [ca.densify(values[kept, 0])]),
        Q,
        R,
        limits.inputs(nu),
        rows.box,
        rows.softness,
        cost.rate(nu),
        limits.rates(nu),
        limits.rate_softness(nu),
    )
