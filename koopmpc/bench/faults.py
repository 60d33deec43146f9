"""The faults of `koopmpc bench --faults`: one small list, the same for every problem and every controller."""

import numpy as np

from koopmpc.control.limits import Limits
from koopmpc.loop.faults import (
    ActuatorDelay,
    ActuatorLoss,
    DroppedSamples,
    Fault,
    FrozenSensor,
    NaNSensor,
    SolverFailure,
)

FAULTS: dict[str, Fault] = {
    "nan-sensor": NaNSensor(probability=0.1),
    "frozen-sensor": FrozenSensor(begin=10, end=15),
    "dropped-samples": DroppedSamples(0.2),
    "actuator-loss": ActuatorLoss(0.5),
    "actuator-delay": ActuatorDelay(1),
    "solver-failure": SolverFailure(0.2),
}


def possible(limits: Limits) -> tuple[str, ...]:
    """Return the names of the faults that can occur: where no input has a limit, an actuator has no range to lose."""
    limited = any(end is not None and np.isfinite(end).any() for end in (limits.u_min, limits.u_max))
    return tuple(name for name in FAULTS if limited or name != "actuator-loss")
