"""Guarded: a second controller takes over where the model of the first does not know the step.

`ControllerPair` is what `Guarded` and `Station` share: a controller and another one that may act in its place.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import numbers
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Controller, Fallback, Move, Plan
from koopmpc.control.program import Program, Published, SavedController, no_export
from koopmpc.control.watching import StepWatch
from koopmpc.loop.controllers import start_for, start_sizes


class ControllerPair(Published):
    """Two controllers of one plant, of which one acts; the second may be missing."""

    _PARTS = ("the controller", "the standby")

    def __init__(self, controller: Controller, standby: Controller | None) -> None:
        self.controller, self.standby = controller, standby
        for what, part in zip(self._PARTS, self._both, strict=False):
            checks.members(
                part, what, ("dt", "nu", "horizon", "reset"), "pass a KoopmanMPC, a PID, an LQR or another Controller"
            )
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


class Guarded(ControllerPair):
    """A controller with a monitor, and a second one that takes over where the first one's model does not know.

    After `patience` unknown steps in sequence the second one's moves are returned, with the fallback OTHER_CONTROLLER,
    until the first has known as many steps in sequence. Both compute every step, so that either can go on at once.

    Parameters
    ----------
    controller
        One whose Moves say whether they are `known`: a KoopmanMPC or BilinearMPC with ``monitor=``, or an Adaptive one.
    standby
        Any controller of the same plant that needs no model of where it is: an LQR, a safe feedback.
    patience
        Unknown steps in sequence after which the second takes over. Of 100 steps like the data about 2 are unknown.
    region
        Count a step as unknown only where state and input lie outside the data, and not where the measurement alone
        differs from its prediction: a plant that has changed is the business of an estimator.

    Raises
    ------
    DataError
        One is no controller; the two have another dt or number of inputs; `region` without a monitor.
    """

    _PARTS = ("the controller", "the one that stands by")

    def __init__(self, controller: Controller, standby: Controller, *, patience: int = 3, region: bool = False) -> None:
        super().__init__(controller, standby)
        self._patience = checks.count(patience, "patience")
        self._watch: StepWatch | None = getattr(controller, "watch", None) if region else None
        if region and self._watch is None:
            raise DataError("region=True asks the controller's monitor; give it monitor=data")
        self._forget()

    def as_data(self) -> SavedController:
        """Return what the controller was made of.

        Raises
        ------
        DataError
            One of the two cannot be saved as data.
        """
        return self.save_parts(patience=self._patience, region=self._watch is not None)

    def _forget(self) -> None:
        self.handed_over, self._in_sequence = False, 0
        self._given: Float[np.ndarray, " nu"] | None = None

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Begin a run with the first controller; one whose model has other states than x0 begins without it."""
        self._forget()
        self.reset_parts(x0, u_prev)

    def plan(self) -> Plan | None:
        """Return the plan behind the last move; None where it had none."""
        return plan_of(self.standby if self.handed_over else self.controller)

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return the move of the controller that is in charge.

        Raises
        ------
        DataError
            The first controller does not say whether it knows.
        """
        got = self._given if applied is None else applied
        rows = numbers(reference, "reference")
        standby = cast("Controller", self.standby)
        first = self.controller(y, rows_of(rows, self.controller), got, w)
        second = standby(y, rows_of(rows, standby), got, w)
        if first.known is None:
            raise DataError("the controller does not say whether it knows; give it monitor=data")
        known = first.known if self._watch is None else self._watch.inside
        against = known if self.handed_over else not known
        self._in_sequence = self._in_sequence + 1 if against else 0
        if self._in_sequence >= self._patience:
            self.handed_over, self._in_sequence = not self.handed_over, 0
        taken = first.solve_time + second.solve_time
        move = replace(first, solve_time=taken)
        if self.handed_over:
            move = replace(second, solve_time=taken, fallback=Fallback.OTHER_CONTROLLER, known=first.known)
        self._given = move.u.copy()
        return move


register_controller(ControllerKind(Guarded))
