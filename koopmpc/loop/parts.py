"""ControllerPair: what `Guarded` and `Station` share, a controller and another one that may act in its place."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.move import Controller, Plan
from koopmpc.control.program import Program, Published, SavedController, no_export
from koopmpc.loop.controllers import start_for, start_sizes

_NEEDED = ("dt", "nu", "horizon", "reset")


class ControllerPair(Published):
    """Two controllers of one plant, of which one acts; the second may be missing."""

    _PARTS = ("the controller", "the standby")

    def __init__(self, controller: Controller, standby: Controller | None) -> None:
        self.controller, self.standby = controller, standby
        for what, part in zip(self._PARTS, self._both, strict=False):
            checks.members(part, what, _NEEDED, "pass a KoopmanMPC, a PID, an LQR or another Controller")
            for name in ("dt", "nu"):
                first, other = getattr(controller, name), getattr(part, name)
                if first != other:
                    raise DataError(f"the controller has {name} = {first:g}, {what} {other:g}; they must agree")
        self.dt, self.nu = controller.dt, controller.nu
        self.horizon = max(part.horizon for part in self._both)

    @property
    def _both(self) -> list[Controller]:
        return [self.controller] if self.standby is None else [self.controller, self.standby]

    def save_parts(self, **options: Any) -> SavedController:
        """Return these options, and what the controllers were made of, as data."""
        saved: dict[str, Any] = {"controller": None, "standby": None}
        for name, part in zip(saved, self._both, strict=False):
            if not isinstance(part, Published):
                raise DataError(f"{checks.article(part)} is not a controller of koopmpc and cannot be saved as data")
            saved[name] = part.as_data()
        limits = options.pop("limits", None)
        return SavedController(type(self).__name__, None, limits=limits, options=options | saved)

    @classmethod
    def from_data(cls, saved: SavedController) -> Any:
        """Return the controller that is made of these data, in which the two are controllers again."""
        options = dict(saved.options) | ({} if saved.limits is None else {"limits": saved.limits})
        return cast("Any", cls)(options.pop("controller"), options.pop("standby"), **options)

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(self, "it holds several controllers", "each of them")

    @property
    def predictor(self) -> Any:
        """The model of the first controller; None where it has none."""
        return getattr(self.controller, "predictor", getattr(self.controller, "model", None))

    @property
    def start_sizes(self) -> frozenset[int]:
        """Numbers of states of its controllers' models; `reset` takes an x0 of one of these lengths."""
        return frozenset[int]().union(*map(start_sizes, self._both))

    def reset_parts(self, x0: ArrayLike | None, u_prev: ArrayLike | None) -> None:
        """Begin a run with each controller; one whose model has another number of states begins without x0."""
        sizes = sorted(self.start_sizes)
        start = None if x0 is None else checks.array(x0, "x0", None if sizes else (None,))
        if start is not None and sizes and start.shape not in [(size,) for size in sizes]:
            shapes = " or ".join(f"({size},)" for size in sizes)
            raise ShapeError(f"x0 has shape {start.shape}, expected {shapes}, the states of a model; or pass None")
        for part in self._both:
            part.reset(start_for(part, start), u_prev)


def plan_of(controller: Controller | None) -> Plan | None:
    """Return the plan behind the last move of a controller; None where it has none."""
    look = cast("Callable[[], Plan | None] | None", getattr(controller, "plan", None))
    return None if look is None else look()


def rows_of(rows: Float[np.ndarray, "..."], controller: Controller) -> Float[np.ndarray, "..."]:
    """Return the rows of the reference that this controller reads."""
    return rows if rows.ndim == 1 else rows[: controller.horizon + 1]
