"""Whether a terminal set lies inside limits that move in time: the extremes of outputs, inputs and changes on it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.control.limits import Interval
from koopmpc.control.terminal.sets import TerminalSet

_TOLERANCE = 1e-7  # a limit is kept if it is exceeded by at most this share of 1 + its size
_HELD = 1e-9  # what an output has besides the coordinates of the set, as a share of it


class EndReach(NamedTuple):
    """The extremes on a terminal set: of limited outputs, of the inputs of its feedback, and of their changes.

    Without a known feedback `inputs` and `rates` have the value None.
    """

    outputs: Interval
    inputs: Interval | None
    rates: Interval | None


def find_support(rows: Float[np.ndarray, "p n"], direction: Float[np.ndarray, " n"], *, ball: bool) -> float:
    """Return max a·ξ over F ξ ≤ 1, by a linear program, or over ‖F ξ‖ ≤ 1; inf where nothing bounds it."""
    if ball:
        return float(np.linalg.norm(np.linalg.solve(rows.T, direction)))
    from scipy.optimize import linprog  # slow to import

    found = linprog(-direction, A_ub=rows, b_ub=np.ones(len(rows)), bounds=(None, None), method="highs")
    return float(-found.fun) if found.status == 0 and found.fun is not None else np.inf


def measure_reach(
    wanted: TerminalSet,
    places: Float[np.ndarray, "n nz"],
    outputs: Float[np.ndarray, "ny nz"],
    constant: int | None,
) -> EndReach:
    """Return the extremes on a set of ξ = E z, or [E z; u_{k−1}] where it holds the last input.

    Parameters
    ----------
    places
        E.
    outputs
        What is limited, as rows on z.
    constant
        The coordinate of z that is 1; None if there is none.
    """
    center: np.ndarray = np.asarray(wanted.center, dtype=np.float64)
    n, free = len(places), [i for i in range(places.shape[1]) if i != constant]
    E, G = places[:, free], outputs[:, free]
    A = np.linalg.lstsq(E.T, G.T, rcond=None)[0].T if n else np.zeros((len(G), 0))  # G = A E where ξ tells it
    known = np.abs(A @ E - G).max(axis=1, initial=0.0) <= _HELD * (1 + np.abs(G).max(axis=1, initial=0.0))
    value = A @ center[:n]
    if constant is not None:
        value = value + outputs[:, constant] - A @ places[:, constant]
    wide = np.hstack([A, np.zeros((len(A), len(center) - n))])
    shown = _find_extremes(wanted, wide, value)
    ends = (np.where(known, end, far) for end, far in zip(shown, (-np.inf, np.inf), strict=True))
    law = wanted.feedback
    if law is None or (law.K_w is not None and np.asarray(law.K_w).any()):
        return EndReach(Interval(*ends), None, None)
    u, K = np.asarray(law.u, dtype=np.float64), np.asarray(law.K, dtype=np.float64)
    rates = None
    if wanted.with_input:  # u_{k−1} is the center's input and the last coordinates of the deviation
        last = np.hstack([np.zeros((len(u), n)), np.eye(len(u))])
        rates = _find_extremes(wanted, K - last, u - center[n:])
    return EndReach(Interval(*ends), _find_extremes(wanted, K, u), rates)


def _find_extremes(wanted: TerminalSet, rows: Float[np.ndarray, "k n"], value: Float[np.ndarray, " k"]) -> Interval:
    """Return the extremes of value + rows (ξ − c) over the set."""
    F, ball = wanted.rows, wanted.is_ellipsoid
    far = [[find_support(F, sign * row, ball=ball) for row in rows] for sign in (-1.0, 1.0)]
    return Interval(value - np.array(far[0]), value + np.array(far[1]))


def require_inside(
    what: str, reach: Interval | None, rows: Interval, first: int, names: Sequence[str], *, moved: bool
) -> None:
    """Raise where a terminal set leaves its limits in a row, from `first` on; the last row is held.

    Where the reach is not known, the limits may not move.

    Raises
    ------
    DataError
        The set leaves them, or they move and its reach is not known.
    """
    if reach is None:
        if moved:
            raise DataError(
                f"limits of {what} move in time, and the terminal set does not tell the {what} of its feedback; pass a"
                " set of km.guarantees.find_terminal_set with the same cost and limits, or leave one out"
            )
        return
    first = min(first, len(rows.low) - 1)
    for end, bound, sign in ((reach.low, rows.low[first:], -1.0), (reach.high, rows.high[first:], 1.0)):
        known = np.isfinite(bound)
        limit = np.where(known, bound, 0.0)
        over = np.where(known, sign * (end - limit) - _TOLERANCE * (1 + np.abs(limit)), -np.inf)
        if (over > 0).any():
            k, i = (int(at) for at in np.argwhere(over == over.max())[0])
            raise DataError(
                f"the terminal set reaches {names[i]} = {end[i]:.7g} and the {what} limit of row {k + first} is"
                f" {bound[k, i]:.7g}, so plans that end in it may leave limits of later rows; make the set with the"
                " tightest limits of these rows, or leave one out"
            )
