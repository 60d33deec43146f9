"""Stream: episodes from an iterator, read once and forgotten."""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import cast

from koopmpc.data.agreement import about, joined
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Loaded, Part, Source
from koopmpc.errors import DataError

_PART = 8_000_000  # bytes of small sets that are one part


class Stream(Source):
    """Episodes from an iterable of sets, in parts of one set, or of several small ones; no part is kept.

    An iterator, or a generator, is read once: a fit of it sums in QR, since it cannot look twice. An iterable
    that begins anew each time, a list or a reader of one's own, is replayable.

    Parameters
    ----------
    sets
        Episodes, each of one plant at one sample time; the first tells dt and names.

    Raises
    ------
    DataError
        There is none; one is no Episodes, or differs from the first; a one-shot stream is read twice.
    """

    def __init__(self, sets: Iterable[Episodes]) -> None:
        if not isinstance(cast(object, sets), Iterable):
            raise DataError(f"the stream is a {type(sets).__name__}; pass an iterable of Episodes")
        again = iter(sets)
        replayable = again is not sets
        first = next(again, None)
        if first is None:
            raise DataError("the stream is empty; it must give at least one set of Episodes")
        self._about = about(_set(first, "set 0 of the stream"), "set 0")
        self._sets = sets if replayable else chain([first], again)
        self._read = False
        super().__init__(first.dt, first.states, first.inputs, first.disturbances, replayable=replayable)

    def parts(self, history: int = 0) -> Iterator[Part]:
        """Return the parts in order."""
        if self._read and not self.replayable:
            raise DataError(
                "the stream was read already, and an iterator gives its episodes once; make a new Stream, or "
                "pass Stream a list, or Files"
            )
        self._read = True
        return self._parts()

    def _parts(self) -> Iterator[Part]:
        held: list[Episodes] = []
        start, size = 0, 0
        for i, one in enumerate(self._sets):
            place = f"set {i} of the stream"
            self._about.check(_set(one, place), place)
            own = sum(e.X.nbytes + e.U.nbytes + e.W.nbytes for e in one)
            if held and size + own > _PART:
                yield Loaded(joined(held), _place(start, len(held)))
                held, start, size = [], i, 0
            held.append(one)
            size += own
        if held:
            yield Loaded(joined(held), _place(start, len(held)))


def _set(given: object, place: str) -> Episodes:
    if isinstance(given, Episodes):
        return given
    raise DataError(f"{place} is a {type(given).__name__}; pass Episodes([Episode(X=…, U=…)], dt)")


def _place(start: int, count: int) -> str:
    return (
        f"set {start} of the stream" if count == 1 else f"sets {start} to {start + count - 1} of the stream"
    )
