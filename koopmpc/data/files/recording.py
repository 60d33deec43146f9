"""Recordings, whose channels have clocks of their own: their rows on one clock."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.errors import DataError, FitWarning
from koopmpc.data.episodes import Episodes, PlantSignature
from koopmpc.data.files.columns import ColumnRoles, TableSettings, find_roles
from koopmpc.data.files.formats import Channel, LogTable, Recording, Samples
from koopmpc.data.files.sampling import GAP
from koopmpc.data.files.tables import read_table
from koopmpc.data.source import Part

TIME = "time [s]"  # name of the common clock in the table of a recording
_PACE = 1000  # first samples of a channel that tell its sample time
PART = 2_000_000  # samples of one part of a large recording, about
LARGE = 8_000_000  # samples of all chosen channels from which a recording is read in parts

OpenRecording = Callable[[Path], Recording]


@dataclass(frozen=True)
class _Layout:
    """What each channel is, the sample time and first time of the rows, and whether rows are interpolated."""

    roles: ColumnRoles
    names: tuple[str, ...]  # in the file, of all roles
    dt: float
    first: float
    paces: tuple[float, ...]  # sample time of each channel [s]
    resampled: bool


def read_recording(file: Path, recording: Recording, settings: TableSettings) -> Episodes:
    """Return the episodes of the channels that the settings name; `load_episodes` says what their names mean.

    Channels that share one clock are read as the rows of a table. Others are brought to the grid t₀, t₀ + dt, … of the
    slowest state, or of ``resample=``: states are interpolated linearly, inputs and disturbances hold their value. A
    state has no value, and an episode ends, where its samples are farther apart than 1.5 dt and 1.5 of its own usual
    steps. A warning says which channels were resampled.
    """
    layout = _find_layout(file, recording, settings)
    if layout.resampled:
        rates = ", ".join(f"{name} {pace:.3g} s" for name, pace in zip(layout.names, layout.paces, strict=True))
        warnings.warn(
            f"{file}: the channels have clocks of their own ({rates}); all are brought to steps of {layout.dt:g} s: "
            "states are interpolated, inputs hold their value; pass resample= for other steps",
            FitWarning,
            stacklevel=2,
        )
    table = _read_rows(recording, layout)
    return read_table(file, table, _settle(layout, settings))


def split_recording(
    open_recording: OpenRecording, file: Path, history: int, plant: PlantSignature | None, keywords: Mapping[str, Any]
) -> list[Part] | None:
    """Return the parts of a large recording by time, in order; None of a small one.

    No pair is lost or comes twice: x_k → x_{k+1} belongs to the part that holds x_{k+1}. A part that begins inside an
    episode begins `history` rows earlier.
    """
    recording = open_recording(file)
    counts = {channel.name: channel.count for channel in recording.channels()}
    settings = TableSettings(**keywords)
    layout = _find_layout(file, recording, settings)
    total = sum(counts[name] for name in layout.names)
    if total < LARGE:
        return None
    first, last = recording.span()
    edges = np.linspace(first, last, -(-total // PART) + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    own = replace(_settle(layout, settings), dt=layout.dt)
    load = partial(_load_part, open_recording, file, layout, own, history, plant)
    return [
        Part(f"{file} ({max(a, first):.6g} to {min(b, last):.6g} s)", partial(load, a, b))
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]


def _load_part(
    open_recording: OpenRecording,
    file: Path,
    layout: _Layout,
    settings: TableSettings,
    history: int,
    plant: PlantSignature | None,
    begin: float,
    end: float,
) -> Episodes:
    table = _read_rows(open_recording(file), layout, begin, end, history)
    episodes = read_table(file, table, settings)
    if plant is not None:
        plant.check(episodes, str(file))
    return episodes


def _find_layout(file: Path, recording: Recording, settings: TableSettings) -> _Layout:
    roles, own = _find_channels(file, recording.channels(), settings)
    silent = next((title for title, channel in own.items() if channel.count < 2), None)
    if silent is not None:
        raise DataError(f"{file}: {silent!r} has less than two samples; leave it out, or pass states= and inputs=")
    chosen = tuple(channel.name for channel in own.values())
    heads = [time for time, _ in recording.read(chosen, count=_PACE)]
    paces = tuple(_find_pace(time, title, file) for time, title in zip(heads, own, strict=True))
    shared = all(np.array_equal(time, heads[0]) for time in heads) and len({one.count for one in own.values()}) == 1
    dt = settings.resample or settings.dt or max(paces[: len(roles.states)])
    first = max(float(time[0]) for time in heads)
    return _Layout(roles, chosen, dt, first, paces, resampled=not shared or settings.resample is not None)


def _find_channels(
    file: Path, channels: Sequence[Channel], settings: TableSettings, most: int = 20
) -> tuple[ColumnRoles, dict[str, Channel]]:
    """Return the roles, and the channel of each of their names; with more than `most` channels none is guessed."""
    if not channels:
        raise DataError(f"{file} has no channel of numbers")
    titles = settings.rename([channel.title for channel in channels], str(file))
    told = settings.match_names(titles)
    if None in (told.states, told.inputs) and len(titles) > most:
        raise DataError(
            f"{file} has {len(titles)} channels, too many to guess their roles: pass states= and inputs=; they are "
            f"{', '.join(titles)}"
        )
    roles = find_roles(titles, titles, told, str(file))
    named = dict(zip(titles, channels, strict=True))
    return roles, {title: named[title] for title in roles.values}


def _settle(layout: _Layout, settings: TableSettings) -> TableSettings:
    """Return the settings of the table of rows: all roles are known, and rows that were resampled stay as they are."""
    roles = layout.roles
    dt = layout.dt if layout.resampled else settings.dt
    return TableSettings(dt, roles.states, roles.inputs, roles.disturbances)


def _find_pace(time: Float[np.ndarray, " n"], title: str, file: Path) -> float:
    steps = np.diff(time)
    steps = steps[steps > 0]
    if not len(steps):
        raise DataError(f"{file}: the time of {title!r} does not advance; leave the channel out")
    return float(f"{np.median(steps):.6g}")


def _read_rows(
    recording: Recording, layout: _Layout, begin: float = -np.inf, end: float = np.inf, history: int = 0
) -> LogTable:
    """Return the rows with times in (begin, end], and the history + 1 rows before them."""
    reach = (history + 3) * GAP * max(*layout.paces, layout.dt)
    samples = recording.read(layout.names, begin - reach, end + reach)
    if layout.resampled:
        time, columns = _align(samples, layout, begin - reach, end)
    else:
        time = samples[0][0]
        if any(len(t) != len(time) or not np.array_equal(t, time) for t, _ in samples):
            raise DataError("channels that begin on one clock leave it later: pass resample=")
        columns = [values for _, values in samples]
    stop = int(np.searchsorted(time, end, "right"))
    start = max(int(np.searchsorted(time, begin, "right")) - 1 - history, 0)
    titles = layout.roles.values
    own = {title: column[start:stop] for title, column in zip(titles, columns, strict=True)}
    return LogTable((TIME, *titles), {TIME: time[start:stop], **own})


def _align(
    samples: Sequence[Samples], layout: _Layout, begin: float, end: float
) -> tuple[Float[np.ndarray, " rows"], list[Float[np.ndarray, " rows"]]]:
    """Return the grid and the columns on it; NaN where a channel is silent or outside its samples."""
    last = min(min(float(t[-1]) if len(t) else -np.inf for t, _ in samples), end)
    low = 0 if not np.isfinite(begin) else max(int(np.ceil((begin - layout.first) / layout.dt)), 0)
    high = int(np.floor((last - layout.first) / layout.dt * (1 + 1e-12) + 1e-9)) if np.isfinite(last) else low - 1
    grid = layout.first + layout.dt * np.arange(low, max(high, low - 1) + 1)
    states = len(layout.roles.states)
    columns: list[np.ndarray] = []
    for i, ((time, values), pace) in enumerate(zip(samples, layout.paces, strict=True)):
        known = np.isfinite(values) & np.concatenate([[True], np.diff(time) > 0])[: len(time)]
        t, v = time[known], values[known]
        if not len(t):
            columns.append(np.full(len(grid), np.nan))
            continue
        before = np.clip(np.searchsorted(t, grid + 1e-9 * layout.dt, "right") - 1, 0, len(t) - 1)
        if i < states:
            silent = _is_silent(t, grid, before, GAP * max(pace, layout.dt))
            columns.append(np.where(silent, np.nan, np.interp(grid, t, v)))
        else:
            columns.append(np.where(grid < t[0] - 1e-9 * layout.dt, np.nan, v[before]))
    return grid, columns


def _is_silent(
    t: Float[np.ndarray, " n"], grid: Float[np.ndarray, " rows"], before: np.ndarray, longest: float
) -> Bool[np.ndarray, " rows"]:
    """Return whether the two samples around a row are farther apart than `longest`, and it is not at the first."""
    after = np.clip(before + 1, 0, len(t) - 1)
    near = np.abs(grid - t[before]) <= 1e-9 * longest
    return ~near & ((t[after] - t[before] > longest) | (grid < t[0]) | (grid > t[-1] + longest))
