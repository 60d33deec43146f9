"""What each field of `Cost` and `Limits` may be: a table of fields and checks, and what contradicts what."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, cast

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.ask import bounds
from koopmpc.control.ask.bounds import check_prices
from koopmpc.control.ask.levels import check_dwell, check_levels
from koopmpc.control.ask.terminal import read_terminal_set
from koopmpc.lifting.base import Lifting
from koopmpc.plants.graph import Graph

ENDS = (
    ("u_min", "u_max", "input"),
    ("du_min", "du_max", "rate"),
    ("x_min", "x_max", "state"),
    ("y_min", "y_max", "output"),
)  # fields of the lower and the upper limit, and what they limit


BOUNDS = tuple(end for pair in ENDS for end in pair[:2])
"""Names of the bounds of `Limits`."""


def _check_weight(value: Any, name: str) -> Any:
    if not isinstance(value, Mapping):
        stored = checks.array(value, name)
        checks.weight(stored, name)
        return stored
    if name == "Q_N":
        raise DataError("Q_N is a table of names; pass a matrix (nx, nx) or (nz, nz)")
    named = checks.check_named(value, name)
    for key, weight in named.items():
        checks.weight(np.array(weight), f"{name}[{key!r}]")
    return named


def _check_target(value: Any, name: str) -> Any:
    if isinstance(value, str):
        if value not in ("equilibrium", "zero"):
            raise DataError(f'{name} is {value!r}; pass "equilibrium", "zero", an input or rows of inputs')
        return value
    rows = np.atleast_1d(checks.array(value, name))
    if rows.ndim > 2 or not rows.size:
        raise ShapeError(f"{name} has shape {rows.shape}, expected (nu,) or rows (k, nu), one a step")
    return rows


def _check_price(value: Any, name: str) -> Any:
    for each in bounds.list_bound(value):
        checks.array(each, name)  # finite, and named by its row where it is not
    return bounds.check_bound(value, name)


def _check_output_price(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return checks.check_named(value, name)
    stored = np.atleast_1d(checks.array(value, name))
    if stored.ndim > 1:
        raise ShapeError(f"{name} has shape {stored.shape}; pass a number for each tracked output")
    return stored


def _check_rows(value: Any, name: str) -> Any:
    for each in bounds.list_bound(value):
        if (checks.array(each, name) < 0).any():
            raise DataError(f"{name} holds a number below 0; pass weights of 0 or above")
    rows = bounds.check_bound(value, name)
    if not bounds.is_rows(rows):
        raise ShapeError(f"{name} is {rows!r}; pass rows (steps, n), or by name a value a step")
    return rows


def _check_stage(value: Any, name: str) -> Any:
    if not (callable(value) or isinstance(value, Graph)):
        raise DataError(f"{name} is {value!r}; pass a function of x and u, such as lambda x, u: x[0] * u[0]")
    return value


def _check_beyond(value: Any, name: str) -> Any:
    if value not in ("rest", "motion"):
        raise DataError(f'{name} is {value!r}; pass "rest" or "motion"')
    return value


def _check_of(value: Any, name: str, advice: str = 'for example km.Fourier(1, states="theta")') -> Any:
    checks.kind(value, name, Lifting, advice)
    return value


COST_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "of": partial(_check_of, advice='for example km.State("theta"), or km.Fourier(1, states="theta")'),
    **dict.fromkeys(("Q", "R", "Q_N", "R_delta"), _check_weight),
    "u_target": _check_target,
    "price": _check_price,
    "output_price": _check_output_price,
    **dict.fromkeys(("Q_rows", "R_rows"), _check_rows),
    "stage": _check_stage,
    "beyond": _check_beyond,
    "tail": lambda value, name: int(checks.count(value, name, 0)),
}
"""Field of `Cost` → what checks a value of it, and returns what is stored."""


def refuse_contradictions(cost: Any) -> None:
    """Raise where fields of a cost contradict each other."""

    def is_full(weight: Any) -> bool:
        if isinstance(weight, Mapping) or np.ndim(weight) != 2:
            return False
        return bool((weight != np.diag(np.diagonal(weight))).any())

    rows = next((name for name in ("Q_rows", "R_rows") if getattr(cost, name) is not None), None)
    full = None if rows is None else next((name for name in ("Q", "R") if is_full(getattr(cost, name))), None)
    nothing = next((name for name in ("Q", "R") if getattr(cost, name) is None), None)
    ended = not (cost.Q_N is None and cost.tail is None)
    for wrong, sentence in (
        (nothing, f"{nothing} must be a weight, got None; pass 0 to leave it out"),
        (
            cost.price is not None and cost.R_rows is not None,
            "a price is paid back by R, which R_rows moves in time; pass one of the two",
        ),
        (
            cost.output_price is not None and cost.Q_rows is not None,
            "an output_price is paid back by Q, which Q_rows moves in time; pass one of the two",
        ),
        (full, f"{rows} are diagonals, and {full} is a full matrix; pass a diagonal one"),
        (
            cost.beyond == "motion" and ended,
            'beyond="motion" moves the end that the default costs; leave Q_N and tail out',
        ),
        (
            cost.Q_N is not None and cost.tail is not None,
            f"Q_N and tail = {cost.tail} are given; Q_N takes the tail's place: pass one of them",
        ),
    ):
        if wrong:
            raise DataError(sentence)


def _check_prices(value: Any, name: str) -> Any:
    return value if name != "du_slack" and checks.among(value, ("auto",)) else check_prices(value, name)


def _check_priority(value: Any, name: str) -> Any:
    return cast("Any", value) if isinstance(value, Mapping) else checks.array(value, name, (None,))


def _check_names(value: Any, name: str) -> tuple[str, ...]:
    if not all(checks.among(end, BOUNDS) for end in checks.texts(value, name)):
        raise DataError(f"rows is {value!r}; pass a tuple of {', '.join(BOUNDS)}")
    return tuple(value)


LIMIT_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "terminal": lambda value, name: read_terminal_set(value),
    **dict.fromkeys(BOUNDS, bounds.check_limit),
    "rows": _check_names,
    "of": _check_of,
    **dict.fromkeys(("slack", "du_slack", "terminal_slack"), _check_prices),
    "margin": lambda value, name: checks.array(value, name, (None, None)),
    "priority": _check_priority,
    "levels": lambda value, name: check_levels(value),
    "dwell": lambda value, name: check_dwell(value),
    "level_steps": checks.count,
}
"""Field of `Limits` → what checks a value of it, and returns what is stored."""


def refuse_crossed_limits(limits: Any, ends: Sequence[str]) -> None:
    """Raise where one of these bounds crosses the other end of its pair, or is of the wrong sign."""
    for low, high, name in ENDS:
        pair = getattr(limits, low), getattr(limits, high)
        if (low in ends or high in ends) and not any(isinstance(value, Mapping) for value in pair):
            bounds.require_room(*pair, low, high, name)
    if (limits.y_min is not None or limits.y_max is not None) and limits.of is None:
        raise DataError("y_min and y_max limit observables; say which with of=, for example of=km.Fourier(1)")
    for end, sign in (("du_min", 1.0), ("du_max", -1.0)):
        value = getattr(limits, end) if end in ends else None
        if value is not None and any((sign * np.asarray(v) > 0).any() for v in bounds.list_bound(value)):
            raise DataError(f"{end} is {value}; an input must be free to stay, so keep 0 inside its rates")


def refuse_margin(limits: Any) -> None:
    """Raise where a margin is negative, or makes the limits of a state cross."""
    if limits.margin is None:
        return
    margin = np.asarray(limits.margin)
    if (margin < 0).any() or not len(margin):
        raise DataError(f"margin is {margin.tolist()}; pass rows of numbers of 0 or above, one a step")
    low, high = limits.base.states(margin.shape[1])
    most = margin.max(axis=0)
    crossed = np.flatnonzero(low + most > high - most)
    if crossed.size:
        i = crossed[0]
        raise DataError(
            f"the limits of state {i} cross once tightened: {low[i]:g} … {high[i]:g} with a margin of {most[i]:g}; "
            "pass a smaller margin, or a wider range"
        )


FEEDBACK_FIELDS = frozenset(
    (
        *("u_min", "u_max", "du_min", "du_max", "du_slack", "rows", "x_min", "x_max", "of", "y_min", "y_max"),
        *("slack", "margin", "capped", "priority", "terminal", "terminal_slack"),
    )
)
"""Fields of `Limits` that a law with one feedback takes: it clips inputs and, as it says, sees no outputs."""

REFUSALS = {
    "levels": (
        "the limits have levels={value}, which {who} does not keep;"
        " take a KoopmanMPC, a LinearMPC, a BilinearMPC or a NonlinearMPC, or pass limits without levels"
    ),
    "priority": (
        "the limits have a priority, which {who} does not know; weigh the limits with slack=, and make the"
        " controller anew with the priority"
    ),
    **dict.fromkeys(
        ("du_min", "du_max"),
        "limits of changes of the inputs are not part of {who}; pass limits without du_max",
    ),
}
"""Field of `Limits` → why someone does not take it; any other field is said to be unknown."""
