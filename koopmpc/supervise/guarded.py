"""Guarded: a second controller takes over where the model of the first does not know the step."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import numbers
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Controller, Fallback, Move, Plan
from koopmpc.control.program import Program, Published, SavedController, no_export
from koopmpc.control.watching import StepWatch
from koopmpc.errors import DataError
from koopmpc.supervise.parts import join_start_sizes, reset_parts


class Guarded(Published):
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

    def __init__(self, controller: Controller, standby: Controller, *, patience: int = 3, region: bool = False) -> None:
        for what, one in (("the controller", controller), ("the one that stands by", standby)):
            checks.members(
                one, what, ("dt", "nu", "horizon", "reset"), "pass a KoopmanMPC, an LQR or another Controller"
            )
        for name in ("dt", "nu"):
            mine, other = getattr(controller, name), getattr(standby, name)
            if mine != other:
                raise DataError(
                    f"the controller has {name} = {mine:g}, the one that stands by {other:g}; they must agree"
                )
        self.controller, self.standby = controller, standby
        self.dt, self.nu = controller.dt, controller.nu
        self.horizon = max(controller.horizon, standby.horizon)
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
        options: dict[str, Any] = {"patience": self._patience, "region": self._watch is not None}
        for name, part in (("controller", self.controller), ("standby", self.standby)):
            if not isinstance(part, Published):
                raise DataError(f"{checks.article(part)} is not a controller of koopmpc and cannot be saved as data")
            options[name] = part.as_data()
        return SavedController("Guarded", None, options=options)

    @classmethod
    def from_data(cls, saved: SavedController) -> "Guarded":
        """Return the controller that is made of these data, in which the two are controllers again."""
        options = dict(saved.options)
        return cls(options.pop("controller"), options.pop("standby"), **options)

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(self, "it holds two controllers", "each of them")

    def _forget(self) -> None:
        self.handed_over, self._in_sequence = False, 0
        self._given: Float[np.ndarray, " nu"] | None = None

    @property
    def predictor(self) -> Any:
        """The model of the first controller; None where it has none."""
        return getattr(self.controller, "predictor", getattr(self.controller, "model", None))

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Begin a run with the first controller; one whose model has other states than x0 begins without it."""
        self._forget()
        reset_parts((self.controller, self.standby), x0, u_prev)

    @property
    def start_sizes(self) -> frozenset[int]:
        """Numbers of states of its controllers' models; `reset` takes an x0 of one of these lengths."""
        return join_start_sizes((self.controller, self.standby))

    def plan(self) -> Plan | None:
        """Return the plan behind the last move; None where it had none."""
        acting = self.standby if self.handed_over else self.controller
        look = cast("Callable[[], Plan | None] | None", getattr(acting, "plan", None))
        return None if look is None else look()

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
        first = self.controller(y, _ahead(rows, self.controller), got, w)
        second = self.standby(y, _ahead(rows, self.standby), got, w)
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


def _ahead(rows: Float[np.ndarray, "..."], controller: Controller) -> Float[np.ndarray, "..."]:
    """Return the rows of the reference that this controller reads."""
    return rows if rows.ndim == 1 else rows[: controller.horizon + 1]


register_controller(ControllerKind(Guarded))
