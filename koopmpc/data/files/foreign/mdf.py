# pyright: basic
"""Measurement data format of the automotive industry (.mf4, .mdf, .dat versions 3 and 4), read through asammdf."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.data.files.foreign.formula import read_formula
from koopmpc.data.files.formats import Channel, LogFormat, Recording, Samples, register_format
from koopmpc.data.files.recording import split_recording

EXTRA = "mdf"
_STEP = 100_000  # records that are read at once


class MDFRecording(Recording):
    """The channels of numbers of an MDF file; a name that stands in several groups is ``name (group 2)`` there.

    asammdf runs the text of algebraic conversions as Python. Here such channels are read raw and converted by
    `read_formula`; a file with any other formula is refused before a value is read.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._places: dict[str, tuple[int, int]] = {}
        found: list[tuple[str, str, int, tuple[int, int]]] = []
        with self._opened() as mdf:
            self._formulas = _read_formulas(mdf, file)
            for g, group in enumerate(mdf.groups):
                cycles = int(group.channel_group.cycles_nr)
                master = mdf.masters_db.get(g)
                if master is None or cycles == 0:
                    continue
                for c, channel in enumerate(group.channels):
                    if c == master:
                        continue
                    raw = (g, c) in self._formulas
                    head = mdf.get(group=g, index=c, record_offset=0, record_count=1, raw=raw)
                    if head.samples.dtype.kind in "fiub" and head.samples.ndim == 1:
                        found.append((str(channel.name), str(head.unit or ""), cycles, (g, c)))
            repeated = {name for name, count in Counter(name for name, *_ in found).items() if count > 1}
            channels: list[Channel] = []
            for name, unit, count, place in found:
                own = f"{name} (group {place[0]})" if name in repeated else name
                self._places[own] = place
                channels.append(Channel(own, unit, count))
            self._channels = tuple(channels)
            groups = {place[0]: count for _, _, count, place in found}
            ends = [self._read_time(mdf, g, k, 1)[0] for g, count in groups.items() for k in (0, count - 1)]
        self._span = (min(ends), max(ends)) if ends else (0.0, 0.0)

    def channels(self) -> tuple[Channel, ...]:
        """Return the channels of numbers."""
        return self._channels

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s]."""
        return self._span

    def read(
        self, names: Sequence[str], begin: float = -np.inf, end: float = np.inf, count: int | None = None
    ) -> list[Samples]:
        """Return times and values of channels between two times."""
        counts = {channel.name: channel.count for channel in self._channels}
        found: list[Samples] = []
        with self._opened() as mdf:
            stretches: dict[int, tuple[int, int]] = {}
            for name in names:
                group, index = self._places[name]
                if group not in stretches:
                    stretches[group] = self._find_records(mdf, group, counts[name], begin, end)
                first, last = stretches[group]
                last = last if count is None else min(last, first + count)
                formula = self._formulas.get((group, index))
                times, values = [np.zeros(0)], [np.zeros(0)]
                for start in range(first, last, _STEP):
                    count_here = min(_STEP, last - start)
                    signal = mdf.get(
                        group=group, index=index, record_offset=start, record_count=count_here, raw=formula is not None
                    )
                    samples = np.asarray(signal.samples, dtype=np.float64)
                    times.append(np.asarray(signal.timestamps, dtype=np.float64))
                    values.append(samples if formula is None else formula(samples))
                found.append((np.concatenate(times), np.concatenate(values)))
        return found

    def _find_records(self, mdf: Any, group: int, count: int, begin: float, end: float) -> tuple[int, int]:
        """Return the first record with a time from `begin` on, and the first one behind `end`, by bisection."""
        return tuple(
            count if np.isposinf(edge) else 0 if np.isneginf(edge) else self._bisect(mdf, group, count, edge)
            for edge in (begin, end)
        )  # type: ignore[return-value]

    def _bisect(self, mdf: Any, group: int, count: int, edge: float) -> int:
        low, high = 0, count
        while high - low > _STEP // 100:
            middle = (low + high) // 2
            low, high = (middle, high) if self._read_time(mdf, group, middle, 1)[0] < edge else (low, middle)
        return low + int(np.searchsorted(self._read_time(mdf, group, low, high - low), edge))

    def _read_time(self, mdf: Any, group: int, first: int, count: int) -> list[float]:
        place = next(place for place in self._places.values() if place[0] == group)
        signal = mdf.get(group=group, index=place[1], record_offset=first, record_count=count, raw=True)
        return [float(t) for t in signal.timestamps]

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        from asammdf import MDF

        try:
            # of a path asammdf reads whole channels; for logs of buses it converts channels before anything is checked
            options: Any = {"process_bus_logging": False}
            with self.file.open("rb") as stream, MDF(stream, **options) as mdf:
                yield mdf
        except (KoopmpcError, ModuleNotFoundError):
            raise
        except Exception as error:  # asammdf raises what it stumbles over: MdfException, struct.error, KeyError, …
            _complete_unfinished(error)
            raise LogError(f"{self.file} cannot be read as MDF: {error}; take another copy") from error


def _read_formulas(mdf: Any, file: Path) -> dict[tuple[int, int], Callable[[np.ndarray], np.ndarray]]:
    """Return the formulas of channels by (group, channel).

    Raises
    ------
    LogError
        A formula holds more than arithmetic, computes the time of a group, or stands inside another conversion.
    """
    formulas: dict[tuple[int, int], Callable[[np.ndarray], np.ndarray]] = {}
    for g, group in enumerate(mdf.groups):
        for c, channel in enumerate(group.channels):
            conversion = channel.conversion
            text = _find_formula(conversion)
            nested = any(map(_has_formula, _list_inner(conversion)))
            if nested or (text is not None and c == mdf.masters_db.get(g)):
                where = "inside another conversion" if nested else "for the time of its group"
                raise LogError(
                    f"{file}: channel {channel.name!r} has a formula {where}, which is not computed; export the log "
                    "with converted values"
                )
            if text is not None:
                try:
                    formulas[g, c] = read_formula(text, channel.name)
                except LogError as error:
                    raise LogError(f"{file}: {error}") from error
    return formulas


def _find_formula(conversion: Any) -> str | None:
    """Return the text of an algebraic conversion, of MDF 4 or 3; else None."""
    text = getattr(conversion, "formula", None)
    return text.replace("eX1p", "exp") if text else None  # asammdf writes X1 for each x of a formula in MDF 3


def _list_inner(conversion: Any) -> list[Any]:
    """Return the conversions that a table of values refers to, instead of texts."""
    return [block for block in (getattr(conversion, "referenced_blocks", None) or {}).values() if block is not None]


def _has_formula(conversion: Any) -> bool:
    return _find_formula(conversion) is not None or any(map(_has_formula, _list_inner(conversion)))


def _complete_unfinished(error: BaseException) -> None:
    """Give the objects of asammdf whose constructor raised this error the parts that their finalizer deletes."""
    trace = error.__traceback__
    while trace is not None:
        made: Any = trace.tb_frame.f_locals.get("self")
        if type(made).__name__ in ("MDF3", "MDF4"):
            for part in ("header", "identification"):
                setattr(made, part, getattr(made, part, None))
        trace = trace.tb_next


register_format(LogFormat((".mf4", ".mdf"), MDFRecording, parts=partial(split_recording, MDFRecording), extra=EXTRA))
