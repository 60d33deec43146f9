"""SavedController: all that a predictive controller on a learned model is made of, as data, and how it is saved."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.monitor import Monitor, Watch
from koopmpc.errors import DataError
from koopmpc.estimate.observer import Estimator
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.base import save_value
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.values import Value

Kind = Literal["KoopmanMPC", "BilinearMPC", "NonlinearMPC"]


@dataclass(frozen=True, eq=False)
class SavedController(Value):
    """The data that a controller is made of. A loaded controller begins as after `reset`.

    Attributes
    ----------
    name
        The class of the controller.
    model
        The predictor of the controller.
    cost, limits, horizon, estimator, latency, moves, time_limit
        Arguments of the controller; `moves` are the lengths of the blocks of held inputs.
    options
        The arguments that only this class has.
    monitor
        The monitor, where it has one.
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


class Savable:
    """A predictive controller that says what it was made of; see `MPCBase`."""

    cost: Cost
    limits: Limits
    _estimator: Estimator | None
    _latency: int
    _blocks: tuple[int, ...]
    _time_limit: float | None
    _watch: Watch | None

    def as_data(self) -> SavedController:
        """Return what the controller was made of.

        Raises
        ------
        DataError
            Its model is a StepMap, whose equations are code, or its estimator is no class of koopmpc.
        """
        kind, model, options = self._made_of()
        if isinstance(model, StepMap):
            raise DataError("the controller's model is a StepMap, which is code and cannot be saved; fit a predictor")
        if not isinstance(self._estimator, Value | None):
            raise DataError(
                f"a {type(self._estimator).__name__} is no estimator of koopmpc and cannot be saved as data"
            )
        return SavedController(
            kind,
            model,
            self.cost,
            self.limits,
            sum(self._blocks),
            self._estimator,
            self._latency,
            self._blocks,
            self._time_limit,
            options,
            None if self._watch is None else self._watch.monitor,
        )

    def _made_of(self) -> tuple[Kind, LinearPredictor | BilinearPredictor | StepMap, dict[str, Any]]:
        """Return the class, the model, and the arguments that only this class has."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write the controller as data (.npz: arrays and one JSON text); `km.load_controller` reads it.

        Raises
        ------
        DataError
            A part of it is code: a StepMap, or a user's own estimator.
        LogError
            The path cannot be written.
        """
        save_value(self.as_data(), path)
