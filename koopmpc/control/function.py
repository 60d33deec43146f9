"""FunctionController: a plain function u = f(y, r) where a loop expects a controller."""

from collections.abc import Callable
from time import perf_counter
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.move import Controller, Fallback, Move, Status
from koopmpc.data.excitation import Excitation

_LONGEST = 100_000  # steps of an excitation that stands for a controller; it holds the last input then
MEMBERS = ("dt", "nu", "horizon", "reset")
"""What a controller has and a plain function lacks."""


class FunctionController:
    """u_k = f(y_k, r_k), with no preview.

    Parameters
    ----------
    function
        f(y, r) → u: (ny,) measurement and (nr,) reference row, as copies, to (nu,) inputs or a number.
    dt, nu
        Sampling time [s], and number of inputs.

    Raises
    ------
    DataError
        The function does not take two arguments.
    """

    horizon = 0

    def __init__(self, function: Callable[..., ArrayLike], dt: float, nu: int) -> None:
        checks.takes(function, "the function", 2, "write def f(y, r), which returns the input u")
        self.function, self.dt, self.nu = function, dt, nu
        FunctionController.reset(self)

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Set the input that is held if the first measurement is bad, zero by default."""
        del x0
        self._last = np.zeros(self.nu) if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return f(y, r); if y or r is not finite and u is not either, the last input.

        Raises
        ------
        DataError, ShapeError
            The function returned no (nu,) numbers, or a number that is not finite for finite y and r.
        """
        del w
        start = perf_counter()
        if applied is not None:
            self._last = checks.array(applied, "applied", (self.nu,), finite=False)
        measured, rows = np.array(y, dtype=np.float64), np.array(reference, dtype=np.float64)
        row: Float[np.ndarray, " nr"] = rows[0] if rows.ndim == 2 else rows
        known = bool(np.isfinite(measured).all() and np.isfinite(row).all())
        u = np.atleast_1d(checks.array(self.function(measured, row), "u of the function", finite=False))
        if u.shape != (self.nu,):
            raise ShapeError(f"the function returned u of shape {u.shape}, expected ({self.nu},), one value an input")
        if np.isfinite(u).all():
            self._last = u
            return Move(u.copy(), Status.UNCONSTRAINED, Fallback.NONE, perf_counter() - start, 0)
        if known:
            raise DataError(f"the function returned u = {u} for a finite y and r; return finite numbers")
        return Move.hold(self._last.copy(), Status.BAD_MEASUREMENT, perf_counter() - start)


class ExcitationController(FunctionController):
    """An excitation where a loop expects a controller: u_k = policy(k, y_k), whatever the reference.

    Parameters
    ----------
    excitation
        The excitation; after `reset` it begins with the same draws again.
    dt
        Sampling time [s].

    Raises
    ------
    DataError
        It cannot run at this dt.
    """

    def __init__(self, excitation: Excitation, dt: float) -> None:
        self._excitation = excitation
        super().__init__(self._follow, dt, excitation.nu)
        self.reset()

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Begin the excitation again."""
        super().reset(x0, u_prev)
        self._k = 0
        self._policy = self._excitation.start(_LONGEST, self.dt, np.random.default_rng(0))

    def skip(self) -> None:
        """Pass over a step that was not run: time goes on, and the excitation with it."""
        self._k += 1

    def _follow(self, y: Float[np.ndarray, " ny"], reference: Float[np.ndarray, " nr"]) -> Float[np.ndarray, " nu"]:
        del reference
        k, self._k = self._k, self._k + 1
        return self._policy(min(k, _LONGEST - 1), y)


def as_controller(controller: Controller | Excitation | Callable[..., Any], dt: float, nu: int) -> Controller:
    """Return a controller as it is; an excitation, or a plain function u = f(y, r), as a controller of this dt.

    An object that is called like a function may have a ``dt`` of its own, which then counts.
    """
    if isinstance(controller, Excitation):
        return ExcitationController(controller, dt)
    if callable(controller) and not any(hasattr(controller, name) for name in MEMBERS if name != "dt"):
        own = checks.positive(getattr(controller, "dt", dt), "dt of the controller", "s")
        return FunctionController(controller, own, nu)
    return cast("Controller", controller)
