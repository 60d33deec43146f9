"""How a fault takes part in a run: `Fault.start` makes an `Injection`, which lives as long as the run.

A fault itself holds no state, so the same object serves any number of runs.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.control.limits import Interval
from koopmpc.control.move import Controller, Fallible, Move
from koopmpc.errors import DataError


class Wiring(NamedTuple):
    """What a fault may know of the loop that it breaks: the number of measurements, and the input limits."""

    ny: int
    inputs: Interval


class Injection:
    """What one fault does in one run; this one does nothing.

    Each method is called once a step, for k = 0, 1, 2, … in order.
    """

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return what the controller gets in place of the measurement y_k."""
        return y

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        """Return what the plant gets in place of the controller's u_k."""
        return u

    def solver_fails(self, k: int) -> bool:
        """Return whether the controller's solver loses its answer at step k."""
        return False


class Fault(ABC):
    """A fault; subclass as a frozen dataclass."""

    @abstractmethod
    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return this fault's part in one run, at its beginning.

        Raises
        ------
        DataError
            The fault does not fit the loop.
        """


class Injections(Injection):
    """All faults of one run, each with random numbers of its own; a signal passes through them in order.

    `rng` is not advanced: noise and disturbance are the same with and without faults.
    """

    def __init__(self, faults: Sequence[Fault], wiring: Wiring, rng: np.random.Generator) -> None:
        if isinstance(cast(object, faults), Fault):
            raise DataError(f"faults is {faults}; pass a list of faults, for example faults=[{faults}]")
        for fault in faults:
            if not isinstance(cast(object, fault), Fault):
                raise DataError(f"faults holds {fault!r}; pass objects, for example faults=[km.faults.NaNSensor()]")
        streams = rng.spawn(len(faults))
        self._parts = [fault.start(wiring, own) for fault, own in zip(faults, streams, strict=True)]

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return y_k as the controller gets it."""
        for part in self._parts:
            y = part.measured(k, y)
        return y

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        """Return u_k as the plant gets it.

        Raises
        ------
        DataError
            A fault made u_k infinite, NaN, or of another shape.
        """
        got = u
        for part in self._parts:
            got = part.applied(k, got)
        if np.shape(got) != np.shape(u) or not np.isfinite(got).all():
            raise DataError(f"the faults made u = {got} of u = {u} at step {k}; they must keep it finite")
        return got

    def solver_fails(self, k: int) -> bool:
        """Return whether any fault makes the solver fail; each is asked, so that each keeps its own luck."""
        luck = [part.solver_fails(k) for part in self._parts]
        return any(luck)


def named(faults: Sequence[Fault]) -> list[str]:
    """Return the faults as a run's metadata name them."""
    return [str(fault) for fault in faults]


def call(
    controller: Controller,
    y: ArrayLike,
    reference: ArrayLike,
    applied: ArrayLike | None,
    *,
    solver_fails: bool,
    **more: ArrayLike,
) -> Move:
    """Return the controller's move, its solver's answer lost if so told and if it has one; `more` is passed on."""
    ask = cast("Callable[..., Move]", controller)
    if not (solver_fails and isinstance(controller, Fallible)):
        return ask(y, reference, applied, **more)
    controller.solver_fails = True
    try:
        return ask(y, reference, applied, **more)
    finally:
        controller.solver_fails = False
