"""What a cost and limits read from a state, as CasADi functions: for controllers on x⁺ = F(x, u) itself."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Box, Limits
from koopmpc.plant.step_map import StepMap


class Outputs(NamedTuple):
    """Functions of x with their weights and limits: tracked of(x) (nr, Q), limited g(x) (ng, box), and the inputs'."""

    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Box
    box: Box


def outputs(step_map: StepMap, cost: Cost, limits: Limits) -> Outputs:
    """Return what `cost` tracks and `limits` bound on the states and inputs of `step_map`; rows without limit go."""
    x = ca.SX.sym("x", step_map.nx)
    of = cost.of.bind(step_map.states)
    Q, R = cost.matrices(of.nz, step_map.nu)
    low, high = limits.states(step_map.nx)
    values = x
    if limits.of is not None:
        bound = limits.of.bind(step_map.states)
        y = limits.outputs(bound.nz)
        values = ca.vertcat(x, bound.symbolic(x))
        low, high = np.concatenate([low, y.low]), np.concatenate([high, y.high])
    kept = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
    return Outputs(
        ca.Function("tracked", [x], [ca.densify(of.symbolic(x))]),
        ca.Function("limited", [x], [ca.densify(values[kept.tolist(), 0])]),
        Q,
        R,
        limits.inputs(step_map.nu),
        Box(low[kept], high[kept]),
    )
