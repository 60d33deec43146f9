"""StepWatch: what a controller asks at each step, whether its model knows it. `koopmpc.loop` answers."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from koopmpc.base.lazy import load_joint
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.observer import StateModel
from koopmpc.models.predictors import LinearPredictor

if TYPE_CHECKING:
    from koopmpc.control.step.observe import InitialCondition


@runtime_checkable
class StepWatch(Protocol):
    """What one closed loop knows of its steps."""

    @property
    def monitor(self) -> "StepMonitor":
        """The data of the watch, which a saved controller holds."""
        ...

    @property
    def inside(self) -> bool:
        """Whether the last state and input are inside the data."""
        ...

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Compare with the predictions of another model from now on."""
        ...

    def reset(self) -> None:
        """Forget the step before."""
        ...

    def look(self, start: "InitialCondition", u: Float[ndarray, " nu"], applied: ArrayLike | None) -> bool:
        """Return whether the model knows the step that starts here, with input u."""
        ...


class StepMonitor(Value):
    """Base of what makes a watch for each closed loop; `km.supervise.Monitor` is one."""

    def watch(self, model: LinearPredictor | StateModel, latency: int) -> StepWatch:
        """Return the watch of a loop whose inputs act `latency` steps late."""
        raise NotImplementedError


MonitorMaker = Callable[[object, Any], StepMonitor]
_MAKERS: list[MonitorMaker] = []


def register_monitor(make: MonitorMaker) -> None:
    """Have `make(given, model)` return the monitor that a controller's argument ``monitor=`` stands for."""
    _MAKERS[:] = [make]


def find_monitor(given: StepMonitor | Episodes, model: object) -> StepMonitor:
    """Return the monitor of a controller, made of the data where these were given."""
    load_joint("monitor")
    return _MAKERS[0](given, model)
