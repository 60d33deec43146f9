"""Station: manual and automatic control of one plant, and a standby; switches without a bump."""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Literal, cast, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE, numbers
from koopmpc.base.errors import DataError
from koopmpc.control.ask.bounds import clip_input
from koopmpc.control.ask.levels import HeldLevels
from koopmpc.control.ask.limits import Interval, Limits
from koopmpc.control.ask.preview import InputRows
from koopmpc.control.function import as_controller
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Controller, Fallback, Move, Plan, Status
from koopmpc.control.program import SavedController
from koopmpc.loop.controllers import count_disturbances
from koopmpc.loop.guarded import ControllerPair, plan_of, rows_of

Mode = Literal["manual", "automatic", "standby"]


class Station(ControllerPair):
    """A manual/automatic station: a hand value, a primary controller, or a standby one acts, inside the limits.

    All controllers are called at every step with the input that was applied, so that their estimators go on. Where one
    begins to act that has `take_over(y, reference, u)`, as `PID` has, it starts from the applied input to the digit.
    Others have no state that could be set to give that input; u then moves towards theirs by at most `bump` a step
    until it is reached. The standby also acts after `patience` steps in sequence at which the primary controller fell
    back or did not know the step, until it has been well for as many. `Move.actor` says who acted. Measured
    disturbances w go to both controllers; where the model of one has none, to the other alone.

    Parameters
    ----------
    controller
        The primary controller, which acts in the mode "automatic".
    standby
        A controller of the same plant, or a function u = f(y, r); None: the applied input is held.
    limits
        Limits of the inputs and their changes, for whoever acts; of those with rows in time the row of the step in
        which an input acts, after the controller's latency. Inputs with `levels` are rounded to an allowed one.
    mode
        "manual", "automatic" or "standby" at every reset.
    hand
        (nu,) hand value at every reset; None: the applied input.
    bump
        (nu,) see above; by default 1 % of the range of an input, without a bound where its range is infinite.
    ramp
        (nr,) by how much set points move at most [1/s]. They start from the first reference, and after the mode
        "manual" from y where y and r have the same length.
    patience
        See above.

    Attributes
    ----------
    mode
        The mode now.
    actor
        Who acted last: "manual", "automatic" or "standby".

    Raises
    ------
    DataError
        One is no controller; the two have another dt or number of inputs; an argument is none of those above; limits
        cross in a row.

    Examples
    --------
    >>> import koopmpc as km
    >>> pid = km.control.PID(kp=2.0, ki=1.0, dt=0.1)
    >>> station = km.supervise.Station(pid, limits=km.Limits(u_min=0, u_max=1), mode="manual", hand=[0.5])
    >>> station([0.8], [0.8]).u
    array([0.5])
    >>> station.switch("automatic")
    >>> move = station([0.8], [0.8])
    >>> move.u, move.actor
    (array([0.5]), 'automatic')
    """

    def __init__(
        self,
        controller: Controller,
        standby: Controller | Callable[..., ArrayLike] | None = None,
        *,
        limits: Limits | None = None,
        mode: Mode | str = "automatic",
        hand: ArrayLike | None = None,
        bump: ArrayLike | None = None,
        ramp: ArrayLike | None = None,
        patience: int = 3,
    ) -> None:
        checks.members(controller, "the controller", ("dt", "nu"), "pass a KoopmanMPC, an LQR or another Controller")
        super().__init__(controller, None if standby is None else as_controller(standby, controller.dt, controller.nu))
        if limits is not None:
            checks.kind(limits, "limits", Limits, "pass km.Limits(u_min=…, u_max=…)")
        self.limits = limits or Limits()
        base = self.limits.base
        self.inputs, self.rates = base.inputs(self.nu), base.rates(self.nu)
        self._rows = InputRows(self.limits, self.nu) if self.limits.in_time else None
        self._latency = int(getattr(controller, "latency", 0))  # an input acts, and is limited, so many steps later
        width = np.where(np.isfinite(self.inputs.high - self.inputs.low), self.inputs.high - self.inputs.low, np.inf)
        # after a switch u moves by this share of its range a step, unless the controller takes over exactly
        self.bump = 0.01 * width if bump is None else checks.vector(bump, "bump", self.nu, infinite=True)
        levels = base.input_levels(self.nu)
        self._held = None if levels is None else HeldLevels(levels)
        if levels is not None:  # an input on levels moves by a level or not at all
            self.bump = np.where(np.isin(np.arange(self.nu), levels.which), np.inf, self.bump)
        if (self.bump <= 0).any():
            raise DataError(f"bump is {self.bump}; pass changes above 0 a step")
        self.ramp = None if ramp is None else np.atleast_1d(checks.array(ramp, "ramp"))
        if self.ramp is not None and (self.ramp <= 0).any():
            raise DataError(f"ramp is {self.ramp}; pass changes above 0 a second")
        self._patience = checks.count(patience, "patience")
        self._first_mode: Mode = _check_mode(mode)
        self._first_hand = hand if hand is None else self._check_hand(hand)
        Station.reset(self)

    def as_data(self) -> SavedController:
        """Return what the station was made of.

        Raises
        ------
        DataError
            A controller in it is not of koopmpc.
        """
        return self.save_parts(
            mode=self._first_mode,
            hand=self._first_hand,
            bump=self.bump,
            ramp=self.ramp,
            patience=self._patience,
            limits=self.limits,
        )

    @property
    def nw(self) -> int | None:
        """Measured disturbances that its controllers know; None where none of them has a model."""
        counts = map(count_disturbances, self._both)
        return max((count for count in counts if count is not None), default=None)

    def _check_hand(self, u: ArrayLike) -> Float[np.ndarray, " nu"]:
        return checks.vector(u, "hand", self.nu)

    def set_hand(self, u: ArrayLike) -> None:
        """Set the (nu,) hand value; it acts in the mode "manual", inside the limits."""
        self._hand = self._check_hand(u)

    def switch(self, mode: Mode | str) -> None:
        """Change the mode from the next step on; "manual" begins with the applied input."""
        wanted = _check_mode(mode)
        if wanted == "manual" and self.mode != "manual":
            self._hand = None
        self.mode = wanted

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Begin a run in the first mode, with the first hand value.

        A controller whose model has another number of states than x0 begins without it.

        Raises
        ------
        ShapeError, DataError
            x0 is no vector of finite numbers, or has the states of no model in it; u_prev has other inputs.
        """
        self._step = 0
        zero = np.clip(np.zeros(self.nu), *self._present_limits()[0])
        self._last = zero if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))
        if self._held is not None:
            self._last = self._last if u_prev is not None else self._held.round(zero)
            self._held.reset(self._last)
        self.mode: Mode = self._first_mode
        self._hand = self._first_hand
        self.actor: str = ""
        self._ill, self._replaced, self._approaching = 0, False, False
        self._set_point: Float[np.ndarray, " nr"] | None = None
        self.reset_parts(x0, u_prev)

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        """Return the limits of the inputs, and of their changes, in this step."""
        if self._rows is None:
            return self.inputs, self.rates
        box, change = self._rows.at(self._step + self._latency)
        return box, None if self.rates is None else change

    def plan(self) -> Plan | None:
        """Return the plan behind the last move; None where it had none."""
        return plan_of(self.controller) if self.actor == "automatic" and not self._approaching else None

    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return the input of whoever acts."""
        start = perf_counter()
        if applied is not None:
            got = checks.array(applied, "applied", (self.nu,), finite=False)
            self._last = got if (np.abs(got) < HUGE).all() else self._last
        measured, rows = numbers(y, "y"), self._ramp_rows(numbers(y, "y"), numbers(reference, "reference"))
        last = self._last
        if self._held is not None:
            self._held.take(last)
        first = self.controller(measured, rows_of(rows, self.controller), last, self._select_w(self.controller, w))
        second = None
        if self.standby is not None:
            second = self.standby(measured, rows_of(rows, self.standby), last, self._select_w(self.standby, w))
        actor = self._choose(first)
        begins, self.actor = actor != self.actor and self.actor != "", actor
        move = self._ask(actor, begins, first, second, measured, rows, w)
        u = move.u
        if self._approaching:
            near = np.clip(u, last - self.bump, last + self.bump)
            self._approaching, u = not np.array_equal(near, u), near
        box, rates = self._present_limits()
        u = clip_input(u, box, rates, last)
        if self._held is not None:
            reach = None if rates is None else Interval(last + rates.low, last + rates.high)
            u = self._held.round(u, reach, None if self._rows is None else box)
        self._step += 1
        self._last = u
        status = move.status if np.array_equal(u, move.u) else Status.SATURATED
        fallback = Fallback.OTHER_CONTROLLER if actor == "standby" else move.fallback
        return replace(
            move,
            u=u.copy(),
            status=status if fallback is Fallback.NONE else move.status,
            fallback=fallback,
            known=first.known,
            actor=actor,
            solve_time=perf_counter() - start,
        )

    def _choose(self, first: Move) -> str:
        """Return who acts: by the mode, and by how the primary controller does."""
        ill = first.fallback is not Fallback.NONE or first.known is False
        self._ill = self._ill + 1 if ill != self._replaced else 0
        if self._ill >= self._patience:
            self._replaced, self._ill = not self._replaced, 0
        return "standby" if self.mode == "automatic" and self._replaced else self.mode

    def _ask(
        self,
        actor: str,
        begins: bool,
        first: Move,
        second: Move | None,
        y: Float[np.ndarray, " ny"],
        rows: Float[np.ndarray, "..."],
        w: ArrayLike | None,
    ) -> Move:
        """Return the move of whoever acts; one that begins takes over the applied input where it can."""
        if actor == "manual":
            self._approaching = False
            hand = self._last if self._hand is None else self._hand
            return Move(hand.copy(), Status.UNCONSTRAINED, Fallback.NONE, 0.0, 0)
        acting, move = (self.controller, first) if actor == "automatic" else (self.standby, second)
        if acting is None or move is None:
            return Move.hold(self._last.copy(), first.status)
        if begins:
            take_over = getattr(acting, "take_over", None)
            self._approaching = take_over is None
            if take_over is not None:
                own = rows_of(rows, acting)
                take_over(y, own, self._last)
                return acting(y, own, self._last, self._select_w(acting, w))
        return move

    def _select_w(self, part: Controller, w: ArrayLike | None) -> ArrayLike | None:
        """Return w for this controller: None if its model has no w and that of the other one has."""
        return None if w is not None and count_disturbances(part) == 0 and self.nw else w

    def _ramp_rows(self, y: Float[np.ndarray, " ny"], rows: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the reference rows with set points that move by at most `ramp` a second."""
        if self.ramp is None:
            return rows
        table = np.atleast_2d(rows)
        most = np.broadcast_to(self.ramp * self.dt, (table.shape[1],))
        now = table[0] if self._set_point is None else self._set_point
        if self.actor == "manual" and y.shape == now.shape and np.isfinite(y).all():
            now = y  # set points follow the measurement while a hand acts
        ahead, at = np.empty((self.horizon + 1, table.shape[1])), now
        for k in range(len(ahead)):
            at = at + np.clip(table[min(k, len(table) - 1)] - at, -most, most)
            ahead[k] = at
        if np.isfinite(ahead[0]).all():
            self._set_point = ahead[0].copy()
        return ahead


def _check_mode(mode: str) -> Mode:
    if mode not in get_args(Mode):
        raise DataError(f'mode is {mode!r}; pass "manual", "automatic" or "standby"')
    return cast("Mode", mode)


register_controller(ControllerKind(Station))
