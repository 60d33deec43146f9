"""The steps of a closed loop, one by one and as arrays.

`StepRows` is the one place that lists what is kept of a `Move`: its columns say what a missing value counts as, and
under which name a log keeps them.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.control.move import Fallback, Move, Plan, Status


@dataclass(slots=True)
class Step:
    """One step of a closed loop as an observer sees it: x_k, y_k, the Move, and where it led.

    `simulate` fills every field; in a loop of your own k, y, u and reference are enough. `look_ahead` is the `plan` of
    the controller: it is asked when `plan` is read, which an observer does while it is called, or never.
    """

    k: int
    y: Float[np.ndarray, " ny"]
    u: Float[np.ndarray, " nu"]
    reference: Float[np.ndarray, " nr"]
    move: Move | None = None
    x: Float[np.ndarray, " nx"] | None = None
    x_next: Float[np.ndarray, " nx"] | None = None
    y_next: Float[np.ndarray, " ny"] | None = None
    reference_next: Float[np.ndarray, " nr"] | None = None
    u_reference: Float[np.ndarray, " nu"] | None = None
    look_ahead: Callable[[], Plan | None] | None = None
    own: bool = False  # nobody writes into its arrays again, so that an observer may keep them

    @property
    def plan(self) -> Plan | None:
        """The plan behind the move; None where the controller has none.

        Raises
        ------
        DataError
            It is read when the controller has gone on, and `simulate` does not keep the plans.
        """
        return None if self.look_ahead is None else self.look_ahead()


@dataclass(frozen=True)
class MoveColumn:
    """One field of `Move` over all steps of a loop.

    `log` is the entity of a log that keeps the values which differ from `absent`, or the words where they change; if it
    is empty, the writer of logs keeps this column in a form of its own.
    """

    absent: Any  # value of a step whose move lacks the field, or has None there
    dtype: type | None = None  # type of the numbers in an array; None: Python objects in a tuple
    log: str = ""
    timed: bool = False  # the value depends on the clock, so that a repeated run has others
    name: str = ""  # the same in `Move` and in `StepRows`

    def collect(self, values: Iterable[Any]) -> Any:
        """Return the values of consecutive steps as a column."""
        filled = [self.absent if value is None else value for value in values]
        return tuple(filled) if self.dtype is None else cast("Any", np.array(filled, dtype=self.dtype))


def _no_numbers() -> Float[np.ndarray, " none"]:
    """Return the place of a column of numbers that is not given; the rows fill it."""
    return np.empty(0)


@dataclass(frozen=True, eq=False, kw_only=True)
class StepRows(Value):
    """Consecutive steps of a closed loop as arrays; row k of each belongs to step k.

    There are m moves. There are n = m + 1 states where the one that the last move led to is among them, else n = m.

    Attributes
    ----------
    X
        (n, nx) true states, NaN where the plant hides them.
    Y
        (n, ny) measurements as the controller got them, noise and faults included.
    U
        (m, nu) inputs as applied.
    reference
        (n, nr) row k belongs to x_k.
    status, fallback
        m entries each.
    solve_time
        (m,) wall-clock time of each step [s].
    iterations
        (m,) solver iterations of each step.
    slack
        (m,) how far the plan of each step breaks the soft limit that gives way most, in its own unit; zeros by default.
    u_reference
        (m, nu) inputs that hold the reference: the cost charges an input's distance from them; zeros by default.
    known
        (m,) 1 where the controller's monitor knew the step, 0 where it did not, −1 without a monitor, by default.
    solver
        m entries: which solver made the move, "osqp" or "daqp", "" where none was asked or it is not known, by default.
    refused
        (m,) 1 where a measurement was too far from its prediction and was not used; zeros by default.
    actor
        m entries: who acted, of a `Station`; "" by default.
    gap
        (m,) share of its cost that a better plan of inputs on levels might save; zeros by default.
    """

    X: Float[np.ndarray, "n nx"]
    Y: Float[np.ndarray, "n ny"]
    U: Float[np.ndarray, "m nu"]
    reference: Float[np.ndarray, "n nr"]
    status: tuple[Status, ...] = field(default_factory=tuple, metadata={"move": MoveColumn(Status.OPTIMAL)})
    fallback: tuple[Fallback, ...] = field(default_factory=tuple, metadata={"move": MoveColumn(Fallback.NONE)})
    solve_time: Float[np.ndarray, " m"] = field(
        default_factory=_no_numbers, metadata={"move": MoveColumn(0.0, np.float64, timed=True)}
    )
    iterations: Int[np.ndarray, " m"] = field(default_factory=_no_numbers, metadata={"move": MoveColumn(0, np.int64)})
    slack: Float[np.ndarray, " ms"] = field(
        default_factory=_no_numbers, metadata={"move": MoveColumn(0.0, np.float64, "solver/slack")}
    )
    known: Int[np.ndarray, " mk"] = field(
        default_factory=_no_numbers, metadata={"move": MoveColumn(-1, np.int64, "solver/known")}
    )
    solver: tuple[str, ...] = field(default_factory=tuple, metadata={"move": MoveColumn("", log="solver/qp")})
    refused: Int[np.ndarray, " mr"] = field(
        default_factory=_no_numbers, metadata={"move": MoveColumn(0, np.int64, "solver/refused")}
    )
    actor: tuple[str, ...] = field(default_factory=tuple, metadata={"move": MoveColumn("", log="solver/actor")})
    gap: Float[np.ndarray, " mg"] = field(
        default_factory=_no_numbers, metadata={"move": MoveColumn(0.0, np.float64, "solver/gap")}
    )
    u_reference: Float[np.ndarray, "m nu"] = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        for name in ("X", "Y", "U", "reference", "u_reference"):
            if not isinstance(getattr(self, name), np.ndarray):
                raise DataError(f"{name} is not an array; a Run is what simulate or load_run returns")
        if not self.u_reference.size:
            object.__setattr__(self, "u_reference", np.zeros(self.U.shape))
        for column in MOVE_COLUMNS:
            if not len(getattr(self, column.name)):
                object.__setattr__(self, column.name, column.collect([None] * len(self.U)))

    @staticmethod
    def of(steps: Sequence[Step], nx: int, *, end: bool) -> "StepRows":
        """Return consecutive steps as rows; with `end`, the state that the last one led to is the last row.

        A state that the plant hides is NaN. A step without a Move counts as solved, in no time.
        """
        hidden, last = np.full(nx, np.nan), steps[-1]
        X = [hidden if s.x is None else s.x for s in steps]
        Y, reference = [s.y for s in steps], [s.reference for s in steps]
        if end and last.y_next is not None:
            X.append(hidden if last.x_next is None else last.x_next)
            Y.append(last.y_next)
            reference.append(last.reference if last.reference_next is None else last.reference_next)
        held = [np.zeros(len(s.u)) if s.u_reference is None else s.u_reference for s in steps]
        return StepRows(
            X=np.array(X, dtype=np.float64),
            Y=np.array(Y, dtype=np.float64),
            U=np.array([s.u for s in steps], dtype=np.float64),
            reference=np.array(reference, dtype=np.float64),
            u_reference=np.array(held, dtype=np.float64),
            **columns_of_moves(s.move for s in steps),
        )

    @staticmethod
    def join(parts: Sequence["StepRows"]) -> "StepRows":
        """Return consecutive parts as one, without the last move where the state that it led to is missing."""
        checks.kind(parts, "parts", (tuple, list), "pass a list of StepRows")
        if not parts:
            raise DataError("parts is empty; pass one StepRows at least")
        for part in parts:
            checks.kind(part, "a part", StepRows, "pass a list of StepRows")
        moves = sum(len(part.X) for part in parts) - 1
        whole: dict[str, Any] = {}
        for name in (f.name for f in fields(StepRows)):
            values = [getattr(part, name) for part in parts]
            joined = sum(values, ()) if isinstance(values[0], tuple) else np.concatenate(values)
            whole[name] = joined if name in OF_STATES else joined[:moves]
        return StepRows(**whole)

    def columns(self) -> dict[str, Any]:
        """Return the rows as keywords of a Run."""
        return {f.name: getattr(self, f.name) for f in fields(StepRows)}

    def part(self, first: int, last: int) -> "StepRows":
        """Return rows first … last − 1; the state after the last move is among them where `last` is beyond it."""
        return StepRows(**{name: values[first:last] for name, values in self.columns().items()})


OF_STATES = ("X", "Y", "reference")  # the columns with a row for each state; the others have one for each move
MOVE_COLUMNS = tuple(replace(f.metadata["move"], name=f.name) for f in fields(StepRows) if "move" in f.metadata)
"""What is kept of each `Move`, in the order of the columns of `StepRows`."""


_read_move = attrgetter(*(column.name for column in MOVE_COLUMNS))


def read_move(move: Move | None) -> tuple[Any, ...]:
    """Return what is kept of a move, in the order of `MOVE_COLUMNS`; None for a field that a user's own move lacks."""
    if type(move) is Move:
        return _read_move(move)
    return tuple(getattr(move, column.name, None) for column in MOVE_COLUMNS)


def columns_of_moves(moves: Iterable[Move | None]) -> dict[str, Any]:
    """Return the columns of consecutive moves as keywords of `StepRows`; without a Move a step counts as solved."""
    return collect_columns([value for move in moves for value in read_move(move)])


def collect_columns(values: Sequence[Any]) -> dict[str, Any]:
    """Return what `read_move` gave of consecutive moves, one after the other, as keywords of `StepRows`."""
    width = len(MOVE_COLUMNS)
    return {column.name: column.collect(values[i::width]) for i, column in enumerate(MOVE_COLUMNS)}


@dataclass(frozen=True, eq=False)
class Plans(Value):
    """The plan of every step: X (T, N+1, nx), U (T, N, nu); NaN where a step had none."""

    X: Float[np.ndarray, "T N1 nx"]
    U: Float[np.ndarray, "T N nu"]

    @staticmethod
    def of(plans: Sequence[Plan | None]) -> "Plans | None":
        """Return the plans of consecutive steps; None where no step had one."""
        first = next((p for p in plans if p is not None), None)
        if first is None:
            return None
        nothing = Plan(np.full_like(first.X, np.nan), np.full_like(first.U, np.nan))
        whole = [nothing if p is None else p for p in plans]
        return Plans(np.stack([p.X for p in whole]), np.stack([p.U for p in whole]))


class LoopRows:
    """What happens in a loop, row by row; one array holds states and measurements where they are the same."""

    def __init__(
        self,
        y0: Float[np.ndarray, " ny"],
        x0: Float[np.ndarray, " nx"],
        reference: Float[np.ndarray, "rows nr"],
        u_reference: Float[np.ndarray, "T nu"],
        *,
        sees_state: bool,
        plans: bool,
    ) -> None:
        self.reference, self.u_reference, self.steps = reference, u_reference, len(u_reference)
        self.Y, self.U = np.empty((self.steps + 1, len(y0))), np.empty(u_reference.shape)
        self.X = self.Y if sees_state else np.full((self.steps + 1, len(x0)), np.nan)
        self.X[0], self.Y[0] = x0, y0
        self.at_once: dict[str, Any] | None = None  # the columns of all moves, where they were made at once
        self._moves: list[Any] = []  # no Move itself: thousands of objects keep the garbage collector busy
        self._plans: list[Plan | None] | None = [] if plans else None

    def keep(self, move: Move, look_ahead: Callable[[], Plan | None] | None) -> Callable[[], Plan | None] | None:
        """Keep the move of a step, and its plan where plans are kept; return what an observer asks for the plan."""
        self._moves.extend(read_move(move))
        if self._plans is None or look_ahead is None:
            return look_ahead
        plan = look_ahead()
        self._plans.append(None if plan is None else Plan(plan.X.copy(), plan.U.copy()))
        return lambda: plan

    def columns(self) -> dict[str, Any]:
        """Return the rows, and the plans of all steps where they were kept, as keywords of a Run."""
        T = self.steps
        X = self.Y.copy() if self.X is self.Y else self.X[: T + 1]
        moves = collect_columns(self._moves) if self.at_once is None else self.at_once
        own = {"U": self.U[:T], "reference": self.reference[: T + 1], "u_reference": self.u_reference[:T]}
        return {"X": X, "Y": self.Y[: T + 1], **own, **moves, "plans": Plans.of(self._plans or [])}
