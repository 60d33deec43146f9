"""What a cost and limits read from a state, as CasADi functions: for controllers on x⁺ = F(x, u) itself."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Box, Limits, Softness
from koopmpc.errors import DataError
from koopmpc.plant.step_map import StepMap


class Outputs(NamedTuple):
    """Functions of x with their weights and limits: tracked of(x) (nr, Q), limited g(x) (ng, box), and the inputs'.

    softness says what it costs to leave the box, row by row; a linear weight of inf makes a row hard.
    """

    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Box
    box: Box
    softness: Softness


def outputs(step_map: StepMap, cost: Cost, limits: Limits) -> Outputs:
    """Return what `cost` tracks and `limits` bound on the states and inputs of `step_map`; rows without limit go.

    Raises
    ------
    DataError
        There are limits or weights of the inputs' changes.
    """
    if limits.rates(step_map.nu) is not None or cost.rate(step_map.nu) is not None:
        raise DataError(
            "a controller on x⁺ = F(x, u) knows no rate limits and no R_delta; leave du_min, du_max and R_delta out, "
            "or use KoopmanMPC"
        )
    x = ca.SX.sym("x", step_map.nx)
    of = cost.of.bind(step_map.states)
    Q, R = cost.matrices(of.nz, step_map.nu)
    bound = None if limits.of is None else limits.of.bind(step_map.states)
    values = x if bound is None else ca.vertcat(x, bound.symbolic(x))
    rows = limits.rows(step_map.nx, 0 if bound is None else bound.nz)
    kept = np.flatnonzero(rows.kept).tolist()
    return Outputs(
        ca.Function("tracked", [x], [ca.densify(of.symbolic(x))]),
        ca.Function("limited", [x], [ca.densify(values[kept, 0])]),
        Q,
        R,
        limits.inputs(step_map.nu),
        rows.box,
        rows.softness,
    )
