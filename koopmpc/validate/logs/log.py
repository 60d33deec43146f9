"""Logs as the audit reads them: columns side by side, faults with their places, and one-step regressions."""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.data.episodes import Episodes
from koopmpc.values import Value

_PAIRED = 6  # states up to which their products are regressors too
_CUBED = 3  # states up to which the products of three are
_RIDGE = 1e-10  # of the regressions, on columns of unit size
_FINE = 0.02  # share of a change from row to row that a prediction need not tell
ALONE = 0.2  # leverage of a row from which on so few rows are like it that nothing is known of what follows
_SMALLEST = 1e-9  # share of a state's size below which a residual counts as rounding


@dataclass(frozen=True)
class Place:
    """Rows first … last − 1 of one episode are at fault; with `jump`, only the step from the first to the last row."""

    episode: int
    first: int
    last: int
    jump: bool = False

    def __str__(self) -> str:
        rows = f"row {self.first}" if self.last == self.first + 1 else f"rows {self.first} to {self.last - 1}"
        return f"episode {self.episode}, {rows}"


@dataclass(frozen=True, eq=False)
class LogFault(Value):
    """One fault of the logs.

    Attributes
    ----------
    name
        Kind of the fault, as docs/identification.md lists them.
    says
        What is wrong, with the numbers.
    do
        What to do about it, with the call.
    columns
        Names of the states and inputs that have it.
    places
        Rows that no model should be fitted to; empty where the fault is not confined to rows.
    steps
        Steps by which a signal is late, 0 for all other kinds.
    """

    name: str
    says: str
    do: str
    columns: tuple[str, ...] = ()
    places: tuple[Place, ...] = ()
    steps: int = 0


@dataclass(frozen=True, eq=False)
class Log:
    """Episodes, and the quantities that every check reads."""

    data: Episodes

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the states, then of the inputs."""
        return self.data.states + self.data.inputs

    @cached_property
    def X(self) -> Float[np.ndarray, "M nx"]:
        """All measured states, one episode below the other."""
        return np.concatenate([e.X for e in self.data])

    @cached_property
    def U(self) -> Float[np.ndarray, "M nu"]:
        """All inputs, one episode below the other."""
        return np.concatenate([e.U for e in self.data])

    @cached_property
    def changes(self) -> Float[np.ndarray, "M nx"]:
        """Change of each state from row to row, one episode below the other."""
        return np.concatenate([np.diff(e.X, axis=0) for e in self.data])

    @cached_property
    def center(self) -> Float[np.ndarray, " nx"]:
        """Median of each state, or its mean."""
        return np.median(self.X, axis=0)

    @cached_property
    def size(self) -> Float[np.ndarray, " nx"]:
        """Spread of each state: half of what lies between its quantiles 5 % and 95 %; 1 where it does not move."""
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
        """Half the range of each input; 1 where it does not move."""
        half = np.subtract(self.U.max(axis=0), self.U.min(axis=0), dtype=np.float64) / 2
        return np.where(half > 0, half, 1.0)

    @cached_property
    def fine(self) -> Float[np.ndarray, " nx"]:
        """2 % of the root mean square change of each state from row to row, in its size."""
        return np.maximum(_FINE * np.sqrt(((self.changes / self.size) ** 2).mean(axis=0)), _SMALLEST)

    @cached_property
    def steps(self) -> int:
        """Number of steps of all episodes."""
        return sum(len(e) for e in self.data)

    def scaled(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> tuple[np.ndarray, np.ndarray]:
        """Return states and inputs around 0 with sizes around 1."""
        return (X - self.center) / self.size, (U - self.input_center) / self.input_size

    def regressors(self, X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M p"]:
        """Return 1, the states, their products, and sines and cosines where a state may be an angle."""
        Z = (X - self.center) / self.size
        n = Z.shape[1]
        parts = [np.ones((len(Z), 1)), Z]
        if n <= _PAIRED:
            two = _choices(n, 2)
            three = _choices(n, 3) if n <= _CUBED else np.repeat(_choices(n, 1), 3, axis=0)
            parts.append(Z[:, two[0]] * Z[:, two[1]])
            parts.append(Z[:, three[0]] * Z[:, three[1]] * Z[:, three[2]])
        for i in self.angles:
            parts.append(np.stack([np.sin(X[:, i]), np.cos(X[:, i])], axis=1))
            parts.append(Z * np.sin(X[:, [i]]))
            parts.append(Z * np.cos(X[:, [i]]))
        return np.concatenate(parts, axis=1)

    @cached_property
    def residuals(self) -> tuple[Float[np.ndarray, "T nx"], ...]:
        """One-step residuals of each episode in sizes of the states, of a fit without the worst 3 % of the rows."""
        P = np.concatenate([self.stacked(e.X[:-1], e.U) for e in self.data])
        Y = self.changes / self.size
        E = fitted(P, Y)
        for _ in range(2):
            size = np.abs(E) / np.maximum(np.quantile(np.abs(E), 0.9, axis=0), _SMALLEST)
            kept = size.max(axis=1) <= np.quantile(size.max(axis=1), 0.97)
            E = Y - P @ solved(P[kept].T @ P[kept], P[kept].T @ Y[kept])
        ends = np.cumsum([len(e) for e in self.data])[:-1]
        return tuple(np.split(E, ends))

    @cached_property
    def leverage(self) -> tuple[Float[np.ndarray, " T"], ...]:
        """pᵀ(PᵀP)⁻¹p of each row p of the regressors: how much of the fit there rests on that row alone, 0 to 1."""
        P = np.concatenate([self.stacked(e.X[:-1], e.U) for e in self.data])
        found = np.einsum("kp,pk->k", P, solved(P.T @ P, P.T))
        return tuple(np.split(found, np.cumsum([len(e) for e in self.data])[:-1]))

    def stacked(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M p"]:
        """Return the regressors of the states, the inputs, and the products of states and inputs."""
        Z, V = self.scaled(X, U)
        return np.hstack([self.regressors(X), V, *(Z * V[:, [j]] for j in range(V.shape[1]))])

    @cached_property
    def angles(self) -> tuple[int, ...]:
        """States that move by more than 0.3 and are not known to be in another unit than rad."""
        free = [i for i, name in enumerate(self.data.states) if "[" not in name or "[rad]" in name]
        return tuple(i for i in free if 0.3 < self.size[i] < 500)


@cache
def _choices(n: int, count: int) -> Int[np.ndarray, "count chosen"]:
    """Return all ways to choose `count` of n columns, a column of them twice or more too."""
    return np.array(list(combinations_with_replacement(range(n), count))).T


def fitted(P: Float[np.ndarray, "M p"], Y: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "M n"]:
    """Return the residuals of the least-squares fit of Y by P, with a trace of ridge."""
    W = solved(P.T @ P, P.T @ Y)
    return Y - P @ W


def solved(gram: Float[np.ndarray, "p p"], cross: Float[np.ndarray, "p n"]) -> Float[np.ndarray, "p n"]:
    """Return the weights of a regression from its moments, the columns scaled to one size."""
    norm = np.sqrt(np.diag(gram))
    norm = np.where(norm > 0, norm, 1.0)
    scaled = gram / np.outer(norm, norm) + _RIDGE * np.eye(len(gram))
    return np.linalg.solve(scaled, cross / norm[:, None]) / norm[:, None]


def information(E: Float[np.ndarray, "M n"], fine: Float[np.ndarray, " n"]) -> Float[np.ndarray, " two"]:
    """Return −½ log det of the residuals' mean square, in nats a sample: the larger, the better the prediction.

    The first number counts all errors. The second takes errors below `fine` for as large as `fine`, so that it does not
    reward a smooth misfit for being small; the first does not reward moving information from one state to another.
    """
    S = E.T @ E / len(E)
    floors = (np.full(len(fine), _SMALLEST**2), fine**2)
    return np.array([-0.5 * np.linalg.slogdet(S + np.diag(floor))[1] for floor in floors])


def runs(flags: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return [first, last) of each stretch of True."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))


def listed(places: tuple[Place, ...]) -> str:
    """Return the first three places in words, and how many more there are."""
    shown = "; ".join(str(place) for place in places[:3])
    return shown + (f"; and {len(places) - 3} more" if len(places) > 3 else "")


def episodes_of_places(places: tuple[Place, ...]) -> str:
    """Return the numbers of the episodes in words: "episodes 3, 4 and 7"."""
    which = sorted({place.episode for place in places})
    if len(which) == 1:
        return f"episode {which[0]}"
    shown = ", ".join(map(str, which[:6]))
    return f"episodes {shown}{', …' if len(which) > 6 else ''}"
