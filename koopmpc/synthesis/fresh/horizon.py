"""choose_horizon: the horizon of a design that was given none, from its data."""

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.control.cost import Cost, check_cost_and_limits
from koopmpc.control.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.synthesis.asked import measure_settling

SHORTEST = 8  # steps
LONGEST = 40  # steps
SHARE = 0.5  # of the settling time; the tail of the cost stands for the rest


def choose_horizon(data: Episodes, cost: Cost, limits: Limits | None, reference: ArrayLike) -> tuple[int, str]:
    """Return the steps, and a sentence that says where they come from.

    Half of the time in which a linear loop on the data settles, see `measure_settling`; between 8 and 40 steps, and
    shorter than half of the episodes.
    """
    cost, limits = check_cost_and_limits(cost, limits, data.states, data.inputs)
    settled = measure_settling(data, cost, limits, reference, np.array([e.X[0] for e in data]))
    most = max(min(LONGEST, int(np.median([len(e) for e in data])) // 2), 1)
    N = int(min(max(np.ceil(SHARE * settled), min(SHORTEST, most)), most))
    return N, (
        f"the horizon is {N} steps of {data.dt:g} s: half of the {settled} steps in which a linear loop with limited "
        "inputs settles, within 8 to 40 steps and half of the episodes"
    )
