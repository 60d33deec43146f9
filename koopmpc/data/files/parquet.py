# pyright: basic
"""Episodes in .parquet files, a row a time step, equal to the bit; tables of other programs, by column.

A group of rows of a .parquet file is read without the rest of the file, so that a fit never holds a large file.
"""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from koopmpc.base.disk import affordable
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.values import checksum
from koopmpc.data.episodes import Episode, Episodes, PlantSignature
from koopmpc.data.files.formats import ADVICE, LogFormat, LogTable, register_format
from koopmpc.data.files.npz import describe_episodes, split_rows, stack_episodes
from koopmpc.data.source import Part

_KEY = b"koopmpc.episodes"  # metadata of the file: sample time and names
_CHECK = b"koopmpc.check"  # metadata of the file: checksums of its blocks of rows, each with the names
_PLACES = ("episode", "step")  # columns that say where a row stands
_GROUP = 8_000_000  # bytes of a group of rows, about
_LARGE = 32_000_000  # bytes from which a file is read in groups of rows
_DAMAGED = "holds no episodes that can be read"
_TABLE_ADVICE = "pass a file that Episodes.save wrote, or a table as .parquet"


def write_parquet(stream: BinaryIO, episodes: Episodes) -> None:
    """Write the stacked rows; the inputs of an episode's last row are null, for none was applied there."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = (*episodes.states, *episodes.inputs, *episodes.disturbances)
    taken = next((name for name in _PLACES if name in names), None)
    if taken is not None:
        raise DataError(f"a .parquet file has a column {taken!r} of its own; rename the state, or save as .npz")
    X, U, steps = stack_episodes(episodes)
    about = describe_episodes(episodes)
    episode, step = _positions(steps)
    last = step == steps[episode]
    full = np.zeros((len(X), U.shape[1]))
    full[~last] = U
    columns = [pa.array(column) for column in (episode, step, *X.T)]
    columns += [pa.array(column, mask=last) for column in full.T]
    table = pa.table(columns, names=[*_PLACES, *names])
    rows = max(_GROUP // (8 * len(columns)), 1)
    check = json.dumps({"rows": rows, "crc32": _checksums(about, rows, 0, np.column_stack([episode, step]), X, full)})
    table = table.replace_schema_metadata({_KEY: about.encode(), _CHECK: check.encode()})
    pq.write_table(table, stream, row_group_size=rows, write_page_checksum=True)


def _checksums(about: str, size: int, first: int, *columns: np.ndarray) -> list[int]:
    """Return a checksum of each whole block of `size` rows and of the metadata; `first` is the number of the first row.

    Pages have checksums of their own, but names, sizes and the places of pages have none.
    """
    seed, blocks = checksum(about.encode()), range(-first % size, len(columns[0]), size)
    whole = [np.ascontiguousarray(some) for some in columns]
    return [checksum(*(some[at : at + size].data for some in whole), start=seed) for at in blocks]


def _verify(table: Any, named: Mapping[str, Any], first: int = 0, rows: int | None = None) -> None:
    """Raise where rows of a file, the first of them number `first` of `rows`, are not those that were written."""
    if _CHECK not in table.schema.metadata:
        raise ValueError("its checksums are missing; take another copy")
    check = json.loads(table.schema.metadata[_CHECK])
    size, rows = int(check["rows"]), len(table) if rows is None else rows
    places = np.stack([table[name].to_numpy() for name in _PLACES], axis=1)
    U = np.nan_to_num(_stack(table, named["inputs"] + named["disturbances"]))
    sums = _checksums(table.schema.metadata[_KEY].decode(), size, first, places, _stack(table, named["states"]), U)
    if (first + len(table)) % size and first + len(table) < rows:  # the last block is not whole
        sums.pop()
    begin = -(-first // size)
    written = check["crc32"][begin : begin + len(sums)] if first + len(table) < rows else check["crc32"][begin:]
    if sums != written:
        raise ValueError("its numbers are not those that were written; take another copy")


def read_parquet(file: Path) -> Episodes | LogTable:
    """Return the episodes of a file that `write_parquet` wrote, or the columns of another program's table."""
    schema = _schema(file)
    if not {_KEY, _CHECK} & (schema.metadata or {}).keys():
        table = _table(file, [name for name in schema.names if schema.names.count(name) == 1])
        return LogTable(tuple(schema.names), {name: table[name].to_numpy() for name in table.column_names})
    table = _table(file)
    try:
        about = table.schema.metadata[_KEY].decode()
        named = json.loads(about)
        episode, step = (np.asarray(table[name], dtype=np.intp) for name in _PLACES)
        steps = np.bincount(episode) - 1
        if not np.array_equal((episode, step), _positions(steps)):
            raise ValueError("rows are missing or out of order")
        X, U = _stack(table, named["states"]), _stack(table, named["inputs"] + named["disturbances"])
        _verify(table, named)
        return split_rows(X, U[step != steps[episode]], steps, about)
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{file} {_DAMAGED}: {error}; {ADVICE}") from error


def _read_rows(file: Path, stretches: list[tuple[int, int]], plant: PlantSignature | None, place: str) -> Episodes:
    """Return stretches of the episodes of a file as episodes of their own; only the groups with their rows are read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    first, last = stretches[0][0], sum(stretches[-1])
    try:
        with pq.ParquetFile(file, page_checksum_verification=True) as held:
            ends = np.cumsum([held.metadata.row_group(i).num_rows for i in range(held.num_row_groups)])
            groups = np.arange(np.searchsorted(ends, first, "right"), np.searchsorted(ends, last, "right") + 1)
            table = held.read_row_groups(groups.tolist())
        named = json.loads(table.schema.metadata[_KEY])
        disturbances = named["disturbances"]
        X, U, W = (_stack(table, some) for some in (named["states"], named["inputs"], disturbances))
        episode, step = (table[name].to_numpy() for name in ("episode", "step"))
        before = int(ends[groups[0] - 1]) if groups[0] else 0
        found: list[Episode] = []
        for row, steps in stretches:
            a, b = row - before, row - before + steps
            if np.ptp(episode[a : b + 1]) or (np.diff(step[a : b + 1]) != 1).any():
                raise ValueError("rows are missing or out of order")
            found.append(Episode(X=X[a : b + 1], U=U[a:b], W=W[a:b]))
        _verify(table, named, before, int(ends[-1]))
        episodes = Episodes(found, named["dt"], named["states"], named["inputs"], disturbances)
    except (KeyError, IndexError, TypeError, ValueError, OSError, pa.ArrowException) as error:
        raise LogError(f"{place} holds no episodes that can be read: {error}") from error
    if plant is not None:
        plant.check(episodes, str(file))
    return episodes


def split_groups(
    file: Path, history: int, plant: PlantSignature | None, keywords: Mapping[str, Any]
) -> list[Part] | None:
    """Return a part for each group of rows of a large file, in order; None if it is small, a plain table or damaged.

    No pair is lost or comes twice: x_k → x_{k+1} belongs to the group that holds x_{k+1}. A stretch that begins inside
    an episode begins `history` rows earlier, and one that an embedding would use up is left out.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if file.stat().st_size < _LARGE or keywords:
        return None
    counts, lengths = np.zeros(0, dtype=np.intp), list[int]()
    try:
        with pq.ParquetFile(file, page_checksum_verification=True) as held:
            if _KEY not in (held.schema_arrow.metadata or {}):
                return None
            for i in range(held.num_row_groups):
                episode = held.read_row_group(i, columns=["episode"])["episode"].to_numpy()
                own = np.bincount(episode, minlength=len(counts))
                own[: len(counts)] += counts
                counts, lengths = own, [*lengths, len(episode)]
    except (KeyError, TypeError, ValueError, OSError, pa.ArrowException):
        return None
    ends = np.cumsum(counts)
    parts: list[Part] = []
    for stop, length in zip(np.cumsum(lengths).tolist(), lengths, strict=True):
        stretches: list[tuple[int, int]] = []
        first, last = (int(np.searchsorted(ends, row, "right")) for row in (stop - length, stop - 1))
        for e in range(first, last + 1):
            row = int(ends[e] - counts[e])  # that holds x_0
            start = max(stop - length - 1 - history, row)
            steps = min(stop, int(ends[e])) - 1 - start
            if steps > history:
                stretches.append((start, steps))
        if stretches:
            place = f"{file} (rows {stretches[0][0]} to {sum(stretches[-1])})"
            parts.append(Part(place, partial(_read_rows, file, stretches, plant, place)))
    return parts


def _stack(columns: Any, names: list[str]) -> np.ndarray:
    """Return the columns of these names side by side, (rows, columns), as numbers; null is NaN."""
    found = [np.asarray(columns[name], dtype=np.float64) for name in names]
    return np.stack(found, axis=1) if found else np.empty((len(columns["episode"]), 0))


def _positions(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the episode and the step of every row."""
    rows = steps + 1
    first = np.cumsum(rows) - rows
    return np.repeat(np.arange(len(steps)), rows), np.arange(rows.sum()) - np.repeat(first, rows)


def _schema(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path} {_DAMAGED}: it is no .parquet file, or was cut; {_TABLE_ADVICE}") from error


def _table(path: Path, wanted: list[str] | None = None) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as held:
            size = held.metadata.num_rows * (held.metadata.num_columns if wanted is None else len(wanted))
            affordable(8 * size, f"{size} cells")
            return held.read(columns=wanted)
    except ValueError as error:
        raise LogError(f"{path} {_DAMAGED}: {error}; {ADVICE}") from error
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path} {_DAMAGED}: its columns are damaged; {_TABLE_ADVICE}") from error


register_format(LogFormat((".parquet",), read_parquet, write_parquet, split_groups))
