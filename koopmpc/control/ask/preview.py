"""What limits in time need of a controller: a row in its program for each of them, and rows for its whole preview."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import same
from koopmpc.control.ask.bounds import refuse_crossed_rows
from koopmpc.control.ask.limits import BOUNDS, Interval, Limits, Movable

_FIXED = tuple(f.name for f in fields(Limits) if f.name not in (*BOUNDS, "rows", "capped"))  # stay as they were made
_GROUPS = ("u", "du", "x")


class InputRows:
    """Limits of nu inputs and of their changes, a row a step; the last one is held.

    Raises
    ------
    DataError
        Limits cross in a row.
    """

    def __init__(self, limits: Limits, nu: int, names: Sequence[str] = ()) -> None:
        count = max(limits.count_rows().values())
        self._box, self._change = limits.input_rows(nu, 0, count), limits.rate_rows(nu, 0, count)
        refuse_crossed_rows(*self._box, "input", names)
        refuse_crossed_rows(*self._change, "rate", names)

    def at(self, step: int) -> tuple[Interval, Interval]:
        """Return the limits of the inputs, and of their changes, in this step."""
        k = min(step, len(self._box.low) - 1)
        box, change = (Interval(rows.low[k], rows.high[k]) for rows in (self._box, self._change))
        return box, change


def require_preview(limits: Limits, steps: int, who: str = "the plan") -> None:
    """Raise where a bound has fewer rows than a plan or a run reads, u_0 … u_{steps−1} and x_0 … x_steps."""
    for end, count in limits.count_rows().items():
        needed = steps + (end[0] in "xy")
        if count < needed:
            raise ShapeError(
                f"{end} has {count} rows, {who} reads rows 0 … {needed - 1}, and row {count} is missing; "
                f"pass {needed} rows, or a vector that holds"
            )


def check_bounds_alone(limits: object, own: Limits, states: Sequence[str], inputs: Sequence[str]) -> Limits:
    """Return the limits of a call with arrays in place of names."""
    if not isinstance(limits, Limits):
        raise DataError(f"limits is {checks.article(limits)}; pass controller.limits.with_bounds(u_max=…)")
    known = limits.resolve(states, inputs)
    theirs, mine = vars(known), vars(own)  # those that `with_bounds` made hold the same objects
    other = [name for name in _FIXED if theirs[name] is not mine[name] and not same(theirs[name], mine[name])]
    if other:
        raise DataError(
            f"limits at a call move bounds alone, and these have another {other[0]} than the controller's; pass "
            "controller.limits.with_bounds(u_max=…)"
        )
    return known


def require_movable(
    movable: Movable, boxes: tuple[Interval, Interval, Interval], inputs: Sequence[str], outputs: Sequence[str], nx: int
) -> None:
    """Raise where a limit is set that has no row in the program of a controller.

    Parameters
    ----------
    movable
        Which inputs, rates and outputs have a row.
    boxes
        The limits of these in time, (steps, n) each.
    inputs, outputs
        Their names; the first `nx` outputs are states.
    """
    for group, can_move, box in zip(_GROUPS, movable, boxes, strict=True):
        low, high = (np.isfinite(end) & ~can_move for end in box)
        missing = low | high
        if missing.any():
            k, i = (int(v) for v in np.argwhere(missing)[0])
            names = outputs if group == "x" else inputs
            kind = "y" if group == "x" and i >= nx else group
            end = f"{kind}_{'min' if low[k, i] else 'max'}"
            raise DataError(
                f"{end} limits {names[i]} at step {k}, and the controller was made without a limit there; "
                f'give it a finite one, or Limits(rows=("{end}",))'
            )
