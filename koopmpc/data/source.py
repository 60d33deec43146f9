"""A Source: episodes that come in parts, so that a fit never holds them all."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from itertools import chain
from operator import getitem
from typing import cast

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Named
from koopmpc.data.episodes import Episodes, PlantSignature, explain_wrong_data, join_sets, name_drives

EpisodesMap = Callable[[Episodes], Episodes]


@dataclass(frozen=True, eq=False)
class Part:
    """A share of a source: where it is from, in words for messages, and what loads its episodes.

    `load` pickles, so that a part can be loaded in another process.
    """

    place: str
    load: Callable[[], Episodes]

    def __str__(self) -> str:
        return self.place

    @classmethod
    def in_memory(cls, episodes: Episodes, place: str) -> "Part":
        """Return a part that is in memory."""
        return cls(place, partial(getitem, (episodes,), 0))  # processes can pickle it

    def map(self, change: EpisodesMap) -> "Part":
        """Return a part whose episodes go through `change` when it is loaded."""
        return Part(self.place, partial(_load_changed, self.load, change))


def _load_changed(load: Callable[[], Episodes], change: EpisodesMap) -> Episodes:
    return change(load())


class Source(Named, ABC):
    """Episodes of one plant at one sample time, in an ordered sequence of parts.

    The parts depend on the source alone: every reader, in any process, sees the same episodes in the same order.

    Attributes
    ----------
    dt
        Sample time [s].
    states, inputs, disturbances
        Names with units.
    replayable
        True where the parts can be read more than once.
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

    def driven(self, *, products: bool = False) -> "Source":
        """Return a source with the measured disturbances appended to the inputs, as `Episodes.driven` does."""
        if not self.nw:
            return self
        change = partial(Episodes.driven, products=products)
        return Changed(self, change, self.states, name_drives(self.inputs, self.disturbances, products=products))


class Held(Source):
    """Episodes in memory, as one part."""

    def __init__(self, episodes: Episodes) -> None:
        super().__init__(episodes.dt, episodes.states, episodes.inputs, episodes.disturbances)
        self.episodes = episodes

    def parts(self, history: int = 0) -> list[Part]:
        """Return a list of the one part."""
        return [Part.in_memory(self.episodes, "these data")]


class Changed(Source):
    """A source whose parts go through `change` as they are loaded: an embedding, say.

    Parameters
    ----------
    source
        The source of the unchanged episodes.
    change
        Episodes → Episodes, one episode at a time; it must pickle if other processes read the parts.
    states, inputs, disturbances
        Names of the changed episodes.
    history
        Number of rows that `change` uses up at the start of each episode.
    """

    def __init__(
        self,
        source: Source,
        change: EpisodesMap,
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
        changed = (part.map(self.change) for part in parts)
        return list(changed) if isinstance(parts, Sized) else changed


def source_of(given: object) -> Source:
    """Return `given` if it is a Source, or Episodes as a source of one part."""
    if isinstance(given, Episodes):
        return Held(given)
    if isinstance(given, Source):
        return given
    raise explain_wrong_data(given, "what collect returns, km.data.Files(folder) or km.data.Stream(episodes)")


_PART = 8_000_000  # bytes of small sets that are one part


class Stream(Source):
    """Episodes from an iterable of sets, in parts of one set, or of several small ones; no part is kept.

    An iterator or a generator is read once; a fit of it uses QR sums, which need no second pass. An iterable that
    starts again each time, such as a list, is replayable.

    Parameters
    ----------
    sets
        Episodes, each of one plant at one sample time; the first tells dt and names.

    Raises
    ------
    DataError
        The iterable is empty, gives something other than Episodes, or sets that differ in dt or names; an iterator is
        read twice.
    """

    def __init__(self, sets: Iterable[Episodes]) -> None:
        if not isinstance(cast(object, sets), Iterable):
            raise DataError(f"the stream is {checks.article(sets)}; pass an iterable of Episodes")
        again = iter(sets)
        replayable = again is not sets
        first = next(again, None)
        if first is None:
            raise DataError("the stream is empty; it must give at least one set of Episodes")
        self._plant = PlantSignature.of(_set(first, "set 0 of the stream"), "set 0")
        self._sets = sets if replayable else chain([first], again)
        self._read = False
        super().__init__(first.dt, first.states, first.inputs, first.disturbances, replayable=replayable)

    def parts(self, history: int = 0) -> Iterator[Part]:
        """Return the parts in order."""
        if self._read and not self.replayable:
            raise DataError(
                "the stream was read already, and an iterator gives its episodes once; make a new km.data.Stream, "
                "or pass Stream a list, or km.data.Files"
            )
        self._read = True
        return self._parts()

    def _parts(self) -> Iterator[Part]:
        held: list[Episodes] = []
        start, size = 0, 0
        for i, one in enumerate(self._sets):
            place = f"set {i} of the stream"
            self._plant.check(_set(one, place), place)
            own = sum(e.X.nbytes + e.U.nbytes + e.W.nbytes for e in one)
            if held and size + own > _PART:
                yield Part.in_memory(join_sets(held), _place(start, len(held)))
                held, start, size = [], i, 0
            held.append(one)
            size += own
        if held:
            yield Part.in_memory(join_sets(held), _place(start, len(held)))


def _set(given: object, place: str) -> Episodes:
    if isinstance(given, Episodes):
        return given
    raise DataError(f"{place} is {checks.article(given)}; pass Episodes([Episode(X=…, U=…)], dt)")


def _place(start: int, count: int) -> str:
    return f"set {start} of the stream" if count == 1 else f"sets {start} to {start + count - 1} of the stream"


class Subset(Source):
    """The parts of a source at the indices `which`, in the source's order.

    Parameters
    ----------
    source
        A source whose parts can be listed.
    which
        Indices of parts.
    """

    def __init__(self, source: Source, which: Sequence[int]) -> None:
        super().__init__(source.dt, source.states, source.inputs, source.disturbances)
        self.source, self.which = source, tuple(sorted(which))

    def parts(self, history: int = 0) -> list[Part]:
        """Return the parts in order."""
        every = list(self.source.parts(history))
        return [every[i] for i in self.which]
