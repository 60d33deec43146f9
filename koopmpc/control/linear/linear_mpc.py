"""LinearMPC: what a lifted MPC is compared with, the same class on a local linearisation."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.linear.condense import Coordinates
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.estimate.observer import Estimator
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import LinearPredictor


class LinearMPC(KoopmanMPC):
    """KoopmanMPC on the linearisation of `step_map` at (x, u): the linear MPC that a lifted one is compared with."""

    def __init__(
        self,
        step_map: StepMap,
        x: ArrayLike,
        u: ArrayLike,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: int | Sequence[int] | None = None,
        coordinates: Coordinates = "auto",
        solver: Literal["osqp", "daqp"] = "osqp",
        settings: Mapping[str, Any] | None = None,
        time_limit: float | None = None,
    ) -> None:
        checks.kind(step_map, "step_map", StepMap, "discretize the dynamics, or use KoopmanMPC for a predictor")
        super().__init__(
            LinearPredictor.local(step_map, x, u),
            cost,
            limits,
            horizon,
            estimator=estimator,
            latency=latency,
            moves=moves,
            coordinates=coordinates,
            solver=solver,
            settings=settings,
            time_limit=time_limit,
        )
