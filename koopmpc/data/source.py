"""A Source: episodes that come in parts, so that a fit never holds them all."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sized
from dataclasses import dataclass

from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError

Change = Callable[[Episodes], Episodes]


class Part(ABC):
    """A share of a source; ``str(part)`` says in messages where it is from."""

    @abstractmethod
    def load(self) -> Episodes:
        """Return its episodes; where it pickles, in another process too."""


class Source(ABC):
    """Episodes of one plant at one sample time, in an ordered sequence of parts.

    The source alone fixes its parts: whoever reads them, wherever, sees the same episodes in the same order.

    Attributes
    ----------
    dt
        Sample time [s].
    states, inputs, disturbances
        Names with units.
    replayable
        The parts can be read again.
    """

    def __init__(
        self,
        dt: float,
        states: tuple[str, ...],
        inputs: tuple[str, ...],
        disturbances: tuple[str, ...],
        *,
        replayable: bool = True,
    ) -> None:
        self.dt = dt
        self.states = states
        self.inputs = inputs
        self.disturbances = disturbances
        self.replayable = replayable

    @abstractmethod
    def parts(self, history: int = 0) -> Iterable[Part]:
        """Return the parts in order, a list where their number is known.

        Parameters
        ----------
        history
            Where a part begins inside an episode, it begins this many rows earlier: an embedding needs them.
        """

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return len(self.disturbances)

    def driven(self) -> "Source":
        """Return the same with the measured disturbances behind the inputs: both drive the plant."""
        if not self.nw:
            return self
        return Changed(self, Episodes.driven, self.states, self.inputs + self.disturbances)


class Held(Source):
    """Episodes in memory, as one part."""

    def __init__(self, episodes: Episodes) -> None:
        super().__init__(episodes.dt, episodes.states, episodes.inputs, episodes.disturbances)
        self.episodes = episodes

    def parts(self, history: int = 0) -> list[Part]:
        """Return the one part."""
        return [Loaded(self.episodes, "these data")]


class Changed(Source):
    """A source whose parts go through `change` as they are loaded: an embedding, say.

    Parameters
    ----------
    source
        Where the episodes are from.
    change
        Episodes → Episodes, each episode for itself; it must pickle if other processes are to read the parts.
    states, inputs, disturbances
        What the changed episodes name.
    history
        The rows that it takes from the start of each episode.
    """

    def __init__(
        self,
        source: Source,
        change: Change,
        states: tuple[str, ...],
        inputs: tuple[str, ...],
        disturbances: tuple[str, ...] = (),
        *,
        history: int = 0,
    ) -> None:
        super().__init__(source.dt, states, inputs, disturbances, replayable=source.replayable)
        self.source, self.change, self.history = source, change, history

    def parts(self, history: int = 0) -> Iterable[Part]:
        """Return the parts in order."""
        parts = self.source.parts(history + self.history)
        changed = (ChangedPart(part, self.change) for part in parts)
        return list(changed) if isinstance(parts, Sized) else changed


@dataclass(frozen=True, eq=False)
class Loaded(Part):
    """A part that is in memory."""

    episodes: Episodes
    place: str

    def __str__(self) -> str:
        return self.place

    def load(self) -> Episodes:
        """Return the episodes."""
        return self.episodes


@dataclass(frozen=True, eq=False)
class ChangedPart(Part):
    """A part, and what is done to its episodes."""

    part: Part
    change: Change

    def __str__(self) -> str:
        return str(self.part)

    def load(self) -> Episodes:
        """Return the changed episodes."""
        return self.change(self.part.load())


def source_of(given: object) -> Source:
    """Return `given` if it is a Source, or Episodes as a source of one part.

    Raises
    ------
    DataError
        It is something else.
    """
    if isinstance(given, Episodes):
        return Held(given)
    if isinstance(given, Source):
        return given
    raise DataError(
        f"episodes is a {type(given).__name__}; pass Episodes([Episode(X=…, U=…), …], dt), what collect returns, "
        "Files(folder) or Stream(episodes)"
    )
