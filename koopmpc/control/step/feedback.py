"""Feedback without a plan: the input of a law, clipped to the limits of its step, and the Program of linear laws."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import clip_input
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.preview import InputRows
from koopmpc.control.move import Fallback, Move, Status, Token, alone
from koopmpc.control.program import LinearProgram, Published
from koopmpc.control.solvers.daqp import daqp_settings
from koopmpc.estimate.observer import EstimatorProgram


class FeedbackLaw(Published):
    """What laws u(x) without a plan share: the limits of the inputs and of their changes, the last input, one thread.

    Parameters
    ----------
    dt
        Sampling time [s].
    nx
        Number of states.
    inputs, rates
        The limits that u is clipped to; `rates` is None where changes have none.
    """

    horizon = 0  # no preview
    _rows: InputRows | None = None
    _step = 0  # row of the next call

    def __init__(self, dt: float, nx: int, inputs: Interval, rates: Interval | None) -> None:
        self.dt, self.nu, self._nx, self.inputs, self.rates = dt, len(inputs.low), nx, inputs, rates
        self._token: Token = [0]
        self._inside = 0
        FeedbackLaw.reset(self)

    def __copy__(self) -> "FeedbackLaw":
        """Return a copy that shares no state with this one."""
        return copy.deepcopy(self)

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Set the last input, from which rates count, and which is held if the first measurement is bad.

        By default it is zero inside the limits. x0 (nx,) will come as the first measurement.

        Raises
        ------
        DataError
            x0 or u_prev is of another length, or holds what is no finite number; pass None where it is not known.
        """
        checks.start(x0, self._nx)
        self._step = 0
        self._take_row()
        zero = np.clip(np.zeros(self.nu), *self.inputs)
        self._last = zero if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))

    def follow_rows(self, limits: Limits | None, names: Sequence[str] = ()) -> None:
        """Clip the input of each step to its row of these limits, where they have rows; the last one is held.

        Raises
        ------
        DataError
            Limits cross in a row.
        """
        if limits is not None and limits.in_time:
            self._rows = InputRows(limits, self.nu, names)
            FeedbackLaw.reset(self)

    def _take_row(self) -> None:
        """Take the limits of the next step."""
        if self._rows is not None:
            self.inputs, change = self._rows.at(self._step)
            self.rates = None if self.rates is None else change

    def take_applied(self, applied: ArrayLike | None) -> None:
        """Take the input that the plant really got for the last one, where it can be used."""
        if applied is not None:
            got = checks.array(applied, "applied", (self.nu,), finite=False)
            if (np.abs(got) < HUGE).all():
                self._last = got

    def limit_input(self, free: Float[np.ndarray, " nu"] | None, start: float) -> Move:
        """Return the input inside the limits of its step; None, where nothing is known, is answered by the last one."""
        self._take_row()
        self._step += 1
        if free is None:
            self._last = clip_input(self._last, self.inputs, self.rates, self._last)
            return Move.hold(self._last.copy(), Status.BAD_MEASUREMENT, perf_counter() - start)
        u = clip_input(free, self.inputs, self.rates, self._last)
        status = Status.UNCONSTRAINED if (u == free).all() else Status.SATURATED
        self._last = u
        return Move(u.copy(), status, Fallback.NONE, perf_counter() - start, 0)


@dataclass(frozen=True, eq=False, kw_only=True)
class FeedbackProgram(LinearProgram):
    """u = feedforward [w; r; u_r] − K ψ(ζ) − K_rate u_{k−1}, clipped to the limits of changes and of inputs.

    Attributes
    ----------
    K, K_rate
        (nu, nz), and (nu, nu) where changes of the inputs are weighed, else (nu, 0).
    feedforward
        (nu, nw + nr + nu).
    estimator
        How z follows from y.
    """

    K: Float[np.ndarray, "nu nz"]
    K_rate: Float[np.ndarray, "nu rates"]
    feedforward: Float[np.ndarray, "nu driving"]
    estimator: EstimatorProgram = field(default_factory=EstimatorProgram)
    settings: Mapping[str, Any] = field(default_factory=daqp_settings)

    @property
    def gain(self) -> Float[np.ndarray, "nu nz"]:
        """How z moves the input."""
        return -self.K
