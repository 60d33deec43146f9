"""PartialEpisodes: runs in which some states were not measured in every row, as sensors of unequal rates do."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value, freeze
from koopmpc.data.episodes import Episode, Episodes


@dataclass(frozen=True, eq=False, init=False)
class PartialEpisodes(Value):
    """Runs x_0 … x_T under u_0 … u_{T−1} and w_0 … w_{T−1}, in which NaN in X means: not measured in this row.

    The class is not Episodes, so that code cannot take a missing number for a measured one. Fits of one step take
    `complete_pairs()`; `km.identify.unequal_rates` fits to the measured cells alone. Nothing is interpolated.

    Parameters
    ----------
    X
        Of each run (T+1, nx), NaN where a state was not measured.
    U
        Of each run (T, nu), complete.
    W
        Of each run (T, nw) measured disturbances, complete; none by default.
    dt
        Sampling time of the rows [s].
    states, inputs, disturbances
        Names, x0 …, u0 … and w0 … by default.

    Raises
    ------
    ShapeError
        X has not one row more than U and W; the runs have other numbers of states, inputs or disturbances.
    DataError
        There is no run; a state was never measured; U or W has NaN, or X inf.

    Examples
    --------
    >>> import koopmpc as km
    >>> X = [[0.0, 1.0], [0.1, float("nan")], [0.2, float("nan")], [0.3, 1.3]]  # the second sensor is slow
    >>> data = km.data.PartialEpisodes(X=[X], U=[[[1.0], [0.5], [0.2]]], dt=0.1)
    >>> data.count_measured().tolist()
    [4, 2]
    """

    X: tuple[Float[np.ndarray, "T1 nx"], ...]
    U: tuple[Float[np.ndarray, "T nu"], ...]
    W: tuple[Float[np.ndarray, "T nw"], ...]
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]

    def __init__(
        self,
        *,
        X: Sequence[ArrayLike],
        U: Sequence[ArrayLike],
        W: Sequence[ArrayLike] | None = None,
        dt: float,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        disturbances: Sequence[str] | None = None,
    ) -> None:
        for given, name in ((X, "X"), (U, "U"), (U if W is None else W, "W")):
            checks.kind(given, name, (tuple, list, np.ndarray), "pass one array for every run")
        runs = [checks.array(each, f"X of run {i}", (None, None), finite=False) for i, each in enumerate(X)]
        moves = [checks.array(each, f"U of run {i}", (None, None)) for i, each in enumerate(U)]
        if W is None:
            driven = [np.zeros((len(u), 0)) for u in moves]
        else:
            driven = [checks.array(each, f"W of run {i}", (None, None)) for i, each in enumerate(W)]
        if not runs or not len(runs) == len(moves) == len(driven):
            counts = f"X has {len(runs)} runs, U {len(moves)} and W {len(driven)}"
            raise DataError(f"{counts}; pass one array of each for every run")
        widths = runs[0].shape[1], moves[0].shape[1], driven[0].shape[1]
        for i, (x, u, w) in enumerate(zip(runs, moves, driven, strict=True)):
            if not len(x) == len(u) + 1 == len(w) + 1 or (x.shape[1], u.shape[1], w.shape[1]) != widths:
                raise ShapeError(
                    f"run {i} has X {x.shape}, U {u.shape} and W {w.shape}; X has one row more than U and W, and all"
                    " runs the same columns"
                )
            infinite = np.argwhere(np.isinf(x))
            if len(infinite):
                raise DataError(f"X of run {i} is inf in row {infinite[0, 0]}; pass NaN where nothing was measured")
        nx, nu, nw = widths
        names = checks.names(states, "states", "x", nx), checks.names(inputs, "inputs", "u", nu)
        counts = sum((np.isfinite(x).sum(axis=0) for x in runs), np.zeros(nx, dtype=np.intp))
        if (counts == 0).any():
            raise DataError(f"{names[0][int(counts.argmin())]} was never measured; leave it out of the states")
        freeze(
            self,
            X=tuple(runs),
            U=tuple(moves),
            W=tuple(driven),
            dt=checks.positive(dt, "dt", "s"),
            states=names[0],
            inputs=names[1],
            disturbances=checks.names(disturbances, "disturbances", "w", nw),
        )

    def count_measured(self) -> np.ndarray:
        """Return in how many rows each state was measured."""
        return np.sum([np.isfinite(x).sum(axis=0) for x in self.X], axis=0)

    def find_gap(self) -> int:
        """Return the most rows from one measurement of a state to its next one."""
        most = 1
        for x in self.X:
            for column in np.isfinite(x).T:
                rows = np.concatenate([[-1], np.flatnonzero(column), [len(column)]])
                most = max(most, int(np.diff(rows).max()))
        return most

    def complete_pairs(self, least: int = 1) -> Episodes:
        """Return the stretches of rows in which everything was measured, as Episodes: their pairs fit one step.

        Parameters
        ----------
        least
            Refuse where there are fewer pairs of complete rows, one after the other.

        Raises
        ------
        DataError
            Too few pairs are complete; the message has their number.
        """
        least = checks.count(least, "least")
        found: list[Episode] = []
        for x, u, w in zip(self.X, self.U, self.W, strict=True):
            whole = np.atleast_1d(np.isfinite(x).all(axis=1))
            edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(int)))
            for first, last in zip(edges[::2], edges[1::2], strict=True):
                if last - first > 1:
                    found.append(Episode(X=x[first:last], U=u[first : last - 1], W=w[first : last - 1]))
        pairs, every = sum(map(len, found)), sum(map(len, self.U))
        if pairs < least:
            raise DataError(
                f"{pairs} of {every} pairs of rows are complete, and {least} are needed; fit to the measured cells"
                " with km.identify.unequal_rates"
            )
        return Episodes(found, self.dt, self.states, self.inputs, self.disturbances)
