"""The data that every check of the audit reads: columns, places of faults, and one-step regressions."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes

_MOST_SQUARED = 6  # up to this number of states, products of two states are regressors
_MOST_CUBED = 3  # up to this number of states, products of three states are regressors
_RIDGE = 1e-10  # ridge of the regressions, on columns of unit size
_FINE = 0.02  # errors below this share of a usual change from row to row are ignored
ALONE = 0.2  # if the leverage of a row is at least this, too few rows are similar to judge the row after it
_ROUNDING = 1e-9  # a residual below this share of a state's size counts as rounding


@dataclass(frozen=True)
class Place:
    """Rows first … last − 1 of one episode have a fault; with `jump`, only the step from the first to the last row."""

    episode: int
    first: int
    last: int
    jump: bool = False

    def __str__(self) -> str:
        rows = f"row {self.first}" if self.last == self.first + 1 else f"rows {self.first} to {self.last - 1}"
        return f"episode {self.episode}, {rows}"


class Repair(Enum):
    """What `koopmpc fit` does about a fault before a model is fitted."""

    COLUMN = "the column is left out, or unwrapped"
    LEAVE_OUT = "its rows are left out"
    BRIDGE = "single rows of a record are replaced by the line between their neighbours; others are left out"
    TRY_WITHOUT = "its rows are left out of episodes; of a record only where models forecast better without them"


@dataclass(frozen=True, eq=False)
class LogFault(Value):
    """One fault of the logs: what was found, the sentence that says it, and how it is repaired.

    A function that takes a `Log` and yields faults is registered with `register_check`.

    Attributes
    ----------
    name
        Kind of the fault; docs/how/audit.md lists all kinds.
    says
        The fault, with its numbers.
    do
        The remedy, with the call.
    columns
        Names of the states and inputs that have the fault.
    places
        Rows that no model should be fitted to; empty if the fault affects the whole log.
    steps
        Steps by which a signal is late; 0 for other kinds.
    repair
        What is done about it before a fit.
    """

    name: str
    says: str
    do: str
    columns: tuple[str, ...] = ()
    places: tuple[Place, ...] = ()
    steps: int = 0
    repair: Repair = Repair.TRY_WITHOUT


Find = Callable[["Log"], Iterator[LogFault]]


@dataclass(frozen=True)
class Check:
    """A check of logs that is registered.

    Attributes
    ----------
    find
        Log → its faults.
    of_inputs
        It looks at logs with inputs alone.
    of_rest
        It looks at the rows that no check before it reports, with angles unwrapped.
    unless
        Kinds of faults after which it tells nothing.
    """

    find: Find
    of_inputs: bool = False
    of_rest: bool = False
    unless: frozenset[str] = frozenset()


CHECKS: dict[Find, Check] = {}  # in the order of registration, which is that of the audit


def register_check(find: Find, *, of_inputs: bool = False, of_rest: bool = False, unless: Collection[str] = ()) -> Find:
    """Have `audit` look for this fault too, after those that are registered; `Check` says what the keywords mean."""
    CHECKS[find] = Check(find, of_inputs, of_rest, frozenset(unless))
    return find


@dataclass(frozen=True, eq=False)
class Log:
    """Episodes, and quantities of them that the checks read."""

    data: Episodes

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the states, then of the inputs."""
        return self.data.states + self.data.inputs

    @cached_property
    def X(self) -> Float[np.ndarray, "M nx"]:
        """All measured states, stacked over the episodes."""
        return np.concatenate([e.X for e in self.data])

    @cached_property
    def U(self) -> Float[np.ndarray, "M nu"]:
        """All inputs, stacked over the episodes."""
        return np.concatenate([e.U for e in self.data])

    @cached_property
    def changes(self) -> Float[np.ndarray, "M nx"]:
        """Change of each state from row to row, stacked over the episodes."""
        return np.concatenate([np.diff(e.X, axis=0) for e in self.data])

    @cached_property
    def center(self) -> Float[np.ndarray, " nx"]:
        """Median of each state."""
        return np.median(self.X, axis=0)

    @cached_property
    def size(self) -> Float[np.ndarray, " nx"]:
        """Spread of each state: half the distance between its 5 % and 95 % quantiles; 1 if the state is constant."""
        low, high = np.quantile(self.X, [0.05, 0.95], axis=0)
        half, most = np.asarray(high - low) / 2, np.asarray(self.X.max(axis=0) - self.X.min(axis=0)) / 2
        half = np.where(half > 0, half, most)
        return np.where(half > 0, half, 1.0)

    @cached_property
    def input_center(self) -> Float[np.ndarray, " nu"]:
        """Middle of the range of each input."""
        return (self.U.min(axis=0) + self.U.max(axis=0)) / 2

    @cached_property
    def input_size(self) -> Float[np.ndarray, " nu"]:
        """Half the range of each input; 1 if the input is constant."""
        half = np.subtract(self.U.max(axis=0), self.U.min(axis=0), dtype=np.float64) / 2
        return np.where(half > 0, half, 1.0)

    @cached_property
    def fine(self) -> Float[np.ndarray, " nx"]:
        """2 % of the root-mean-square change of each state from row to row, as a share of its size."""
        return np.maximum(_FINE * np.sqrt(((self.changes / self.size) ** 2).mean(axis=0)), _ROUNDING)

    @cached_property
    def steps(self) -> int:
        """Number of steps of all episodes."""
        return sum(len(e) for e in self.data)

    def scale(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> tuple[np.ndarray, np.ndarray]:
        """Return states and inputs, centred and divided by their sizes."""
        return (X - self.center) / self.size, (U - self.input_center) / self.input_size

    def regressors(self, X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M p"]:
        """Return 1, the states, their products, and sines and cosines of states that may be angles."""
        Z = (X - self.center) / self.size
        n = Z.shape[1]
        parts = [np.ones((len(Z), 1)), Z]
        if n <= _MOST_SQUARED:
            two = _choose_columns(n, 2)
            three = _choose_columns(n, 3) if n <= _MOST_CUBED else np.repeat(_choose_columns(n, 1), 3, axis=0)
            parts.append(Z[:, two[0]] * Z[:, two[1]])
            parts.append(Z[:, three[0]] * Z[:, three[1]] * Z[:, three[2]])
        for i in self.angles:
            parts.append(np.stack([np.sin(X[:, i]), np.cos(X[:, i])], axis=1))
            parts.append(Z * np.sin(X[:, [i]]))
            parts.append(Z * np.cos(X[:, [i]]))
        return np.concatenate(parts, axis=1)

    @cached_property
    def residuals(self) -> tuple[Float[np.ndarray, "T nx"], ...]:
        """One-step residuals of each episode, in sizes of the states; the fit leaves out the worst 3 % of the rows."""
        P = np.concatenate([self.stack_regressors(e.X[:-1], e.U) for e in self.data])
        Y = self.changes / self.size
        E = fit_residuals(P, Y)
        for _ in range(2):
            size = np.abs(E) / np.maximum(np.quantile(np.abs(E), 0.9, axis=0), _ROUNDING)
            kept = size.max(axis=1) <= np.quantile(size.max(axis=1), 0.97)
            E = Y - P @ solve_weights(P[kept].T @ P[kept], P[kept].T @ Y[kept])
        ends = np.cumsum([len(e) for e in self.data])[:-1]
        return tuple(np.split(E, ends))

    @cached_property
    def leverage(self) -> tuple[Float[np.ndarray, " T"], ...]:
        """Leverage pᵀ(PᵀP)⁻¹p, 0 … 1, of each row p of the regressors: the weight of the row in its own fit."""
        P = np.concatenate([self.stack_regressors(e.X[:-1], e.U) for e in self.data])
        leverages = np.einsum("kp,pk->k", P, solve_weights(P.T @ P, P.T))
        return tuple(np.split(leverages, np.cumsum([len(e) for e in self.data])[:-1]))

    def stack_regressors(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M p"]:
        """Return the regressors of the states, the inputs, and the products of states and inputs."""
        Z, V = self.scale(X, U)
        return np.hstack([self.regressors(X), V, *(Z * V[:, [j]] for j in range(V.shape[1]))])

    @cached_property
    def angles(self) -> tuple[int, ...]:
        """States in rad or without a unit whose size is between 0.3 and 500: they may be angles."""
        candidates = [i for i, name in enumerate(self.data.states) if "[" not in name or "[rad]" in name]
        return tuple(i for i in candidates if 0.3 < self.size[i] < 500)


@cache
def _choose_columns(n: int, count: int) -> Int[np.ndarray, "count chosen"]:
    """Return all combinations of `count` of n columns, with repetition."""
    return np.array(list(combinations_with_replacement(range(n), count))).T


def fit_residuals(P: Float[np.ndarray, "M p"], Y: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "M n"]:
    """Return the residuals of the least-squares fit of Y by P, with a tiny ridge."""
    W = solve_weights(P.T @ P, P.T @ Y)
    return Y - P @ W


def solve_weights(gram: Float[np.ndarray, "p p"], cross: Float[np.ndarray, "p n"]) -> Float[np.ndarray, "p n"]:
    """Return the weights of a regression from its moments, with columns scaled to unit norm."""
    norm = np.sqrt(np.diag(gram))
    norm = np.where(norm > 0, norm, 1.0)
    scaled = gram / np.outer(norm, norm) + _RIDGE * np.eye(len(gram))
    return np.linalg.solve(scaled, cross / norm[:, None]) / norm[:, None]


def compute_information(E: Float[np.ndarray, "M n"], fine: Float[np.ndarray, " n"]) -> Float[np.ndarray, " two"]:
    """Return −½ log det of the residuals' mean square, in nats a sample; a larger value is a better prediction.

    The first number counts all errors. It does not reward a move of information from one state to another. The second
    number raises smaller errors to `fine`, so that it does not reward a tiny smooth misfit.
    """
    S = E.T @ E / len(E)
    floors = (np.full(len(fine), _ROUNDING**2), fine**2)
    return np.array([-0.5 * np.linalg.slogdet(S + np.diag(floor))[1] for floor in floors])


def find_stretches(flags: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return [first, last) of each stretch of True."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))


def list_places(places: tuple[Place, ...]) -> str:
    """Return a text with the first three places and the number of further ones."""
    shown = "; ".join(str(place) for place in places[:3])
    return shown + (f"; and {len(places) - 3} more" if len(places) > 3 else "")


def name_episodes(places: tuple[Place, ...]) -> str:
    """Return a text with the numbers of the episodes, such as "episodes 3, 4, 7"."""
    numbers = sorted({place.episode for place in places})
    if len(numbers) == 1:
        return f"episode {numbers[0]}"
    shown = ", ".join(map(str, numbers[:6]))
    return f"episodes {shown}{', …' if len(numbers) > 6 else ''}"
