"""Episodes: what a plant did, run by run, and the snapshots that a fit reads from them."""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from math import isclose
from os import PathLike
from pathlib import Path
from typing import Any, cast, overload

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.lazy import load_joint
from koopmpc.base.values import Named, Value, freeze


@dataclass(frozen=True, eq=False)
class Origin:
    """Where the rows of an episode stand in a table, for messages.

    Attributes
    ----------
    file
        Path of the table.
    states
        Names of its states.
    numbers
        (K,) number of each row of the table that was read, 1 for the first one.
    X
        (K, nx) states in these rows.
    at
        (T+1,) index into them for each row of the episode; after resampling, of the row at or before it, or of the wild
        reading in it.
    resampled
        Whether a row of the episode lies between two rows of the table.
    """

    file: str
    states: tuple[str, ...]
    numbers: Int[np.ndarray, " K"]
    X: Float[np.ndarray, "K nx"]
    at: Int[np.ndarray, " rows"]
    resampled: bool

    def cut(self, first: int, last: int) -> "Origin":
        """Return the origin of rows first … last − 1 of the episode."""
        return replace(self, at=self.at[first:last])

    def locate(self, row: int, state: str, sound: float) -> tuple[int, float]:
        """Return the number and the value of the row that a row of the episode comes from.

        Of the two rows that a resampled one lies between it is the one whose state is farther from `sound`.
        """
        first = int(self.at[row])
        column = self.X[first : first + 1 + self.resampled, self.states.index(state)]
        worst = int(np.argmax(np.abs(column - sound)))
        return int(self.numbers[first + worst]), float(column[worst])

    def place(self, first: int, last: int | None = None) -> str:
        """Return file and lines of the rows with these numbers: lines as an editor shows them, else rows."""
        unit, numbers = find_lines(self.file, [first] if last is None or last == first else [first, last])
        return f"{self.file}, {unit}{'s' * (len(numbers) > 1)} {' to '.join(map(str, numbers))}"


def find_lines(file: str, numbers: Sequence[int]) -> tuple[str, list[int]]:
    """Return "line" and the lines of rows of a .csv file, as an editor shows them; of other files "row" and the rows.

    Rows count from 1, below comments, the names of columns where there are any, and empty lines.
    """
    if not file.lower().endswith(".csv") or not Path(file).is_file():
        return "row", list(numbers)
    with Path(file).open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        lines = csv.reader(stream)
        rows = ((lines.line_num, cells) for cells in lines if cells and not cells[0].startswith("#"))
        first = next(rows, (0, list[str]()))
        named = re.search(r"[^\W\d_]", re.sub(r"\b(nan|inf)\b|\de", "", " ".join(first[1]).lower())) is not None
        at = [line for line, _ in islice(rows, max(numbers, default=0))]
    at = at if named else [first[0], *at]
    known = [at[number - 1] for number in numbers if 0 < number <= len(at)]
    return ("line", known) if len(known) == len(numbers) else ("row", list(numbers))


@dataclass(frozen=True, eq=False, init=False)
class Episode(Value):
    """One uninterrupted run: x_0 … x_T as measured and the u_0 … u_{T−1} that were applied.

    Parameters
    ----------
    X
        (T+1, nx), time down.
    U
        (T, nu); without it the plant is autonomous and nu is 0.
    W
        (T, nw) disturbances w_0 … w_{T−1} that were measured; without it nw is 0.
    origin
        Where the rows stand in a table; neither saved nor compared.

    Raises
    ------
    ShapeError
        X has not one row more than U and W.
    DataError
        There is NaN or inf.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> episode = km.Episode(X=np.zeros((101, 2)), U=np.ones((100, 1)))  # x_0 … x_100, u_0 … u_99
    >>> episode.X.shape
    (101, 2)
    """

    U: Float[np.ndarray, "T nu"]
    X: Float[np.ndarray, "T+1 nx"]
    W: Float[np.ndarray, "T nw"]
    origin: Origin | None = field(compare=False, repr=False)

    def __init__(
        self,
        *,
        X: ArrayLike,
        U: ArrayLike | None = None,
        W: ArrayLike | None = None,
        origin: Origin | None = None,
    ) -> None:
        states = checks.array(X, "X", (None, None))
        if len(states) == 0:
            raise ShapeError("X has no row; an episode holds x_0 at least")
        inputs = np.empty((len(states) - 1, 0)) if U is None else checks.array(U, "U", (None, None))
        if len(states) != len(inputs) + 1:
            raise ShapeError(
                f"U has {len(inputs)} rows and X {len(states)}: X must have one row more than U; "
                "x_0 … x_T, u_0 … u_{T-1}"
            )
        disturbances = np.empty((len(inputs), 0)) if W is None else checks.array(W, "W", (None, None))
        if len(disturbances) != len(inputs):
            raise ShapeError(f"W has {len(disturbances)} rows and U {len(inputs)}; both have one a step")
        freeze(self, U=inputs, X=states, W=disturbances, origin=origin)

    def __len__(self) -> int:
        """Return the number of steps T."""
        return len(self.U)

    def cut(self, first: int, last: int) -> "Episode":
        """Return the episode of the steps first … last − 1, which has the states x_first … x_last."""
        origin = None if self.origin is None else self.origin.cut(first, last + 1)
        return Episode(X=self.X[first : last + 1], U=self.U[first:last], W=self.W[first:last], origin=origin)

    def with_states(self, X: Float[np.ndarray, "rows nx"]) -> "Episode":
        """Return the episode with other states."""
        return Episode(X=X, U=self.U, W=self.W, origin=self.origin)


@dataclass(frozen=True, eq=False)
class Snapshots(Value):
    """Rows (x_k, u_k, x_{k+1}), M in all, each from within one episode."""

    X: Float[np.ndarray, "M nx"]
    U: Float[np.ndarray, "M nu"]
    X_next: Float[np.ndarray, "M nx"]

    def __len__(self) -> int:
        """Return the number of rows M."""
        return len(self.X)


@dataclass(frozen=True, eq=False, init=False)
class Episodes(Named, Value):
    """Episodes of one plant at one sample time; a sequence of `Episode`.

    Parameters
    ----------
    episodes
        At least one, each of at least one step, all with the same nx, nu and nw.
    dt
        Sample time [s].
    states, inputs
        Names with units; ``x0, x1, …`` and ``u0, u1, …`` by default.
    disturbances
        Names of the measured disturbances with units; ``w0, w1, …`` by default.

    Raises
    ------
    ShapeError
        The episodes, or the names, differ in nx, nu or nw.
    DataError
        There is no episode, one is too short, dt is not above zero, or a name is used twice.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> X, U = np.zeros((101, 2)), np.ones((100, 1))
    >>> data = km.Episodes([km.Episode(X=X, U=U)] * 10, dt=0.01, states=["x [m]", "v [m/s]"], inputs=["force [N]"])
    >>> train, held_out = data.split(0.8, rng=0)  # by episode, never inside one
    >>> len(train), data.snapshots().X.shape
    (8, (1000, 2))
    """

    episodes: tuple[Episode, ...]
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]

    def __init__(
        self,
        episodes: Sequence[Episode],
        dt: float,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        disturbances: Sequence[str] | None = None,
    ) -> None:
        if not isinstance(cast(object, episodes), Sequence):
            raise DataError(f"episodes is {checks.article(episodes)}; pass a list of Episode(X=…, U=…)")
        if not episodes:
            raise DataError("there is no episode; pass at least one")
        for i, episode in enumerate(episodes):
            if not isinstance(cast(object, episode), Episode):
                raise DataError(f"episode {i} is {checks.article(episode)}; pass Episode(X=…, U=…)")
        nx, nu, nw = episodes[0].X.shape[1], episodes[0].U.shape[1], episodes[0].W.shape[1]
        for i, episode in enumerate(episodes):
            if len(episode) < 1:
                raise DataError(
                    f"episode {i} is too short: X has {len(episode.X)} row and so no step; "
                    "an episode needs at least 2 rows, drop it"
                )
            own = episode.X.shape[1], episode.U.shape[1]
            if own != (nx, nu):
                raise ShapeError(
                    f"episode {i} has {own[0]} states and {own[1]} inputs, episode 0 has {nx} and {nu}; "
                    "episodes of one set come from one plant"
                )
            if episode.W.shape[1] != nw:
                raise ShapeError(
                    f"episode {i} has {episode.W.shape[1]} measured disturbances, episode 0 has {nw}; "
                    "measure the same ones throughout"
                )
        freeze(
            self,
            episodes=tuple(episodes),
            dt=checks.positive(dt, "dt", "s"),
            states=checks.names(states, "states", "x", nx),
            inputs=checks.names(inputs, "inputs", "u", nu),
            disturbances=checks.names(disturbances, "disturbances", "w", nw),
        )
        checks.distinct(self.states, self.inputs, self.disturbances)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)

    @overload
    def __getitem__(self, index: int) -> Episode: ...
    @overload
    def __getitem__(self, index: slice) -> "Episodes": ...
    def __getitem__(self, index: int | slice) -> "Episode | Episodes":
        return self.with_episodes(self.episodes[index]) if isinstance(index, slice) else self.episodes[index]

    def __add__(self, other: "Episodes") -> "Episodes":
        """Return both sets as one; they must agree in dt and in names."""
        PlantSignature.of(self, "the first set").check(other, "the second set", tolerance=0.0)
        return self.with_episodes(self.episodes + other.episodes)

    def snapshots(self) -> Snapshots:
        """Return all rows (x_k, u_k, x_{k+1}); none pairs the end of an episode with the start of another."""
        return Snapshots(
            X=np.concatenate([episode.X[:-1] for episode in self.episodes]),
            U=np.concatenate([episode.U for episode in self.episodes]),
            X_next=np.concatenate([episode.X[1:] for episode in self.episodes]),
        )

    def driven(self, *, products: bool = False) -> "Episodes":
        """Return these episodes with the measured disturbances appended to the inputs: both drive the plant.

        With `products` the signals wⱼ uᵢ follow, all u times the first w first.
        """
        if not self.nw:
            return self
        joined: list[Episode] = []
        for e in self.episodes:
            crossed = [w[:, None] * e.U for w in e.W.T] if products else []
            joined.append(Episode(X=e.X, U=np.hstack([e.U, e.W, *crossed])))
        return Episodes(joined, self.dt, self.states, name_drives(self.inputs, self.disturbances, products=products))

    def split(self, fraction: float, rng: np.random.Generator | int = 0) -> "tuple[Episodes, Episodes]":
        """Return (train, held_out): whole episodes drawn at random, of which `fraction` trains.

        Raises
        ------
        DataError
            One side would be empty; the fraction is no number.
        """
        total = len(self)
        fraction = float(checks.array(fraction, "fraction", ()))
        count = round(fraction * total)
        if not 0 < count < total:
            raise DataError(
                f"a split of {total} episodes at fraction {fraction:g} leaves {count} to train and "
                f"{total - count} held out; both need at least one"
            )
        order = checks.generator(rng).permutation(total)
        train: list[int] = np.sort(order[:count]).tolist()
        held_out: list[int] = np.sort(order[count:]).tolist()
        first, second = ([self.episodes[i] for i in side] for side in (train, held_out))
        return self.with_episodes(first), self.with_episodes(second)

    def save(self, path: str | PathLike[str]) -> None:
        """Write a .npz, .parquet or .csv file, its folders made, which `load_episodes` reads back to the bit.

        The first two hold checksums; a .csv is a plain table, in which a change goes unnoticed.

        Raises
        ------
        DataError
            The suffix is another, or a .parquet or .csv file would not keep a name.
        LogError
            The path cannot be written.
        """
        _call_files("save", self, path)

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        by: str | None = None,
        time: str | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        disturbances: Sequence[str] | None = None,
        dt: float | None = None,
        resample: float | None = None,
    ) -> "Episodes":
        """Return the episodes of a pandas.DataFrame: a row a time step, a column a signal, as in a .csv file.

        Parameters
        ----------
        frame
            The table. A column or an index of times may hold seconds, datetimes or timedeltas.
        by
            The column that tells episodes apart; by default ``episode``, ``run`` or ``trial`` where there is one.
        time
            The column of time; by default ``t``, ``time [s]``, ``time [ms]`` or ``timestamp``, or an index of
            datetimes.
        states, inputs, disturbances, dt, resample
            As in `load_episodes`.

        Raises
        ------
        DataError
            It is no DataFrame, a column is missing, or as `load_episodes` says of tables.

        Examples
        --------
        >>> import koopmpc as km
        >>> import pandas as pd
        >>> frame = pd.DataFrame({"t": [0.0, 0.1, 0.2], "theta": [0.0, 0.1, 0.3], "u": [1.0, 1.0, 0.0]})
        >>> km.Episodes.from_frame(frame).dt
        0.1
        """
        return _call_files("read_frame", frame, by, time, (dt, states, inputs, disturbances, resample))

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame with episode, step, time [s] and all signals, which `from_frame` reads back.

        The inputs of an episode's last row are NaN: none was applied there.
        """
        return _call_files("build_frame", self)

    def with_inputs_advanced(self, rows: int = 1) -> "Episodes":
        """Return the episodes with u_{k+rows} beside x_k, for logs whose input column is written `rows` rows late.

        In such a log u_k stands beside the x_k that it has already moved. Each episode loses its last `rows` steps;
        measured disturbances stay where they are.

        Raises
        ------
        DataError
            No episode has more than `rows` steps.
        """
        rows = checks.count(rows, "rows", 0)
        if rows == 0:
            return self
        long = [episode for episode in self if len(episode) > rows]
        if not long:
            raise DataError(f"no episode has more than {rows} steps; pass longer ones, or a smaller number of rows")
        return self.with_episodes([Episode(X=e.X[:-rows], U=e.U[rows:], W=e.W[:-rows]) for e in long])

    def with_episodes(self, episodes: Sequence[Episode]) -> "Episodes":
        """Return a set of other episodes with the sample time and the names of this set."""
        return Episodes(episodes, self.dt, self.states, self.inputs, self.disturbances)


_FILES: dict[str, Callable[..., Any]] = {}


def register_files(**functions: Callable[..., Any]) -> None:
    """Have `Episodes` call these to save, read_frame and build_frame: files build Episodes, so they import this one."""
    _FILES.update(functions)


def _call_files(name: str, *arguments: Any) -> Any:
    load_joint("files of episodes", until=lambda: name in _FILES)
    return _FILES[name](*arguments)


def episodes_of(given: object) -> Episodes:
    """Return `given` if it is Episodes."""
    if isinstance(given, Episodes):
        return given
    raise explain_wrong_data(given, "or what collect returns")


def explain_wrong_data(given: object, others: str) -> DataError:
    """Return the error for another object than data; for a path or a DataFrame it names the function that reads it."""
    kind = type(given).__name__
    if isinstance(given, str | PathLike) or kind == "DataFrame":
        name = "frame" if kind == "DataFrame" else repr(str(cast("object", given)))
        return DataError(f"episodes is a {kind}; pass km.load_episodes({name}), which reads it")
    if kind == "PartialEpisodes":
        return DataError(
            "episodes is a PartialEpisodes, in which cells were not measured; pass its complete_pairs(), or fit with"
            " km.identify.unequal_rates"
        )
    return DataError(f"episodes is a {kind}; pass Episodes([Episode(X=…, U=…), …], dt), {others}")


_CLOSE = 1e-6  # relative; the clocks that wrote the files round


@dataclass(frozen=True)
class PlantSignature:
    """Sample time [s] and names, which all sets of episodes of one plant share; `place` names their origin."""

    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    place: str

    @classmethod
    def of(cls, episodes: Episodes, place: str) -> "PlantSignature":
        """Return the signature of the episodes that stand at `place`."""
        return cls(episodes.dt, episodes.states, episodes.inputs, episodes.disturbances, place)

    def check(self, episodes: Episodes, place: str, tolerance: float = _CLOSE) -> None:
        """Check that the episodes at `place` have this sample time and these names.

        Raises
        ------
        DataError
            They differ in dt by more than the relative `tolerance`, or in names.
        """
        if not isclose(self.dt, episodes.dt, rel_tol=tolerance):
            raise DataError(f"{place} has dt = {episodes.dt!r} s, {self.place} has {self.dt!r} s; resample one of them")
        for what in ("states", "inputs", "disturbances"):
            mine, theirs = getattr(self, what), getattr(episodes, what)
            if mine != theirs:
                raise DataError(
                    f"{place} names the {what} {_quote(theirs)}, {self.place} {_quote(mine)}; "
                    "rename them, or leave it out"
                )


def name_drives(inputs: tuple[str, ...], disturbances: tuple[str, ...], *, products: bool) -> tuple[str, ...]:
    """Return the names of the signals of `Episodes.driven`."""
    crossed = tuple(f"{u} * {w}" for w in disturbances for u in inputs) if products else ()
    return (*inputs, *disturbances, *crossed)


def join_sets(sets: Sequence[Episodes]) -> Episodes:
    """Return sets of one plant as one set, with the sample time and the names of the first."""
    return sets[0] if len(sets) == 1 else sets[0].with_episodes([episode for one in sets for episode in one])


def _quote(names: tuple[str, ...]) -> str:
    """Return the names in quotes, or "none"."""
    return ", ".join(map(repr, names)) or "none"
