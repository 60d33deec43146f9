"""SavedController: all that a predictive controller on a learned model is made of, as data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.monitor import Monitor
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.values import Value

Kind = Literal["KoopmanMPC", "BilinearMPC", "NonlinearMPC"]


@dataclass(frozen=True, eq=False)
class SavedController(Value):
    """What a controller was made of; it begins anew when it is loaded, as after `reset`.

    Attributes
    ----------
    name
        The class of the controller.
    model
        Its predictor.
    cost, limits, horizon, estimator, latency, moves, time_limit
        Its arguments; `moves` are the lengths of the blocks of held inputs.
    options
        The arguments that only this class has.
    monitor
        What it knows, where it watches.
    """

    name: Kind
    model: LinearPredictor | BilinearPredictor
    cost: Cost
    limits: Limits
    horizon: int
    estimator: Value | None
    latency: int
    moves: tuple[int, ...]
    time_limit: float | None
    options: Mapping[str, Any]
    monitor: Monitor | None = None
