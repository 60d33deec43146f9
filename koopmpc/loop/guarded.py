"""Guarded: a second controller takes over where the model of the first does not know the step."""

from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import numbers
from koopmpc.base.errors import DataError
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Controller, Fallback, Move, Plan
from koopmpc.control.program import SavedController
from koopmpc.control.watching import StepWatch
from koopmpc.loop.parts import ControllerPair, plan_of, rows_of


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
