# pyright: basic
"""The door to .csv and .parquet: tables by column, and episodes as one table, a row a time step, exact to the bit.

A group of rows of a .parquet file is read without the rest of the file, so that a fit never holds a large file.
"""

import json
import re
import zlib
from functools import partial
from io import BytesIO
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from koopmpc.data.episodes import Episode, Episodes, PlantSignature
from koopmpc.data.source import Part
from koopmpc.disk import affordable
from koopmpc.errors import LogError

_MARK = "# koopmpc.episodes "
_OWN = ('"dt": ', '"states": ')  # in the first line of a .csv too: a damaged mark is found
_LINE = re.compile(r"rows=(\d+) crc32=([0-9a-f]{8}) (.*)")
_EARLIER = re.compile(r"(\b)([0-9a-f]{8}) (.*)")  # which has no count, and whose checksum is of the rows alone
_TEXT = ("utf-8-sig", "latin-1")
_KEY, _CHECK = b"koopmpc.episodes", b"koopmpc.check"  # of the metadata of a .parquet
_GROUP = 8_000_000  # bytes of a group of rows, about
_ADVICE = "pass a file that Episodes.save wrote, or a table as .parquet"


def write_csv(
    file: BinaryIO, X: np.ndarray, U: np.ndarray, steps: np.ndarray, names: tuple[str, ...], about: str
) -> None:
    """Write the stacked rows below a line with their number, a checksum and metadata.

    The inputs of an episode's last row stay empty. The checksum is of the metadata and the rows.
    """
    episode, step = _positions(steps)
    last = step == steps[episode]
    lines = [",".join(_quoted(name) for name in ("episode", "step", *names))]
    inputs = iter(U)
    for e, k, x, end in zip(episode, step, X, last, strict=True):
        u = [""] * U.shape[1] if end else [repr(float(v)) for v in next(inputs)]
        lines.append(",".join([str(e), str(k), *(repr(float(v)) for v in x), *u]))
    body = ("\n".join(lines) + "\n").encode()
    file.write(f"{_MARK}rows={len(X)} crc32={zlib.crc32(body, zlib.crc32(about.encode())):08x} {about}\n".encode())
    file.write(body)


def csv_about(path: Path) -> str | None:
    """Return the metadata in the first line of a table that `write_csv` wrote; None for any other table."""
    with path.open("rb") as file:
        line = file.readline(1_000_000)
    text = line.decode(_TEXT[0], errors="replace")
    if text.startswith(_MARK):
        return text[len(_MARK) :].strip()
    return text if text.startswith("#") and any(sign in text for sign in _OWN) else None


def csv_columns(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return the names of all columns, and the columns: numbers, NaN where a cell is empty; others as objects.

    Comma, semicolon or tab is found from the header; with semicolons a decimal comma is understood. Lines above the
    header that begin with # are skipped.

    Raises
    ------
    LogError
        The file is empty, has no header, or a row has another number of cells.
    """
    import pyarrow as pa
    from pyarrow import csv

    raw = path.read_bytes()
    try:
        raw.decode(_TEXT[0])
        encoding = "utf8"
    except UnicodeDecodeError:
        encoding = _TEXT[1]
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    while raw.startswith(b"#"):
        raw = raw.partition(b"\n")[2]
    head, _, rest = raw.partition(b"\n")
    if not head.strip():
        raise LogError(
            f"{path} holds no episodes that can be read: it is no .csv file, or was cut; pass a file that "
            "Episodes.save wrote, or a table: a line of names, then a row a time step"
        )
    separator = max((b",", b";", b"\t"), key=head.count)
    comma = separator == b";" and b"," in rest.partition(b"\n")[0]
    try:
        table = csv.read_csv(
            BytesIO(raw),
            read_options=csv.ReadOptions(encoding=encoding),
            parse_options=csv.ParseOptions(delimiter=separator.decode()),
            convert_options=csv.ConvertOptions(
                decimal_point="," if comma else ".",
                null_values=["", "nan", "NaN", "NAN", "null", "NULL", "NA", "N/A", "#N/A"],
                strings_can_be_null=True,
            ),
        )
    except (pa.ArrowException, OSError, ValueError) as error:
        raise LogError(f"{path} holds no episodes that can be read: {str(error).splitlines()[0]}") from error
    names = [name.strip() for name in table.column_names]
    if any(map(is_a_number, names)):
        raise LogError(f"{path} has no line of names: its first row is {', '.join(names[:4])}; write one above it")
    return names, {name: _values(table.column(i)) for i, name in enumerate(names)}


def _values(column) -> np.ndarray:
    """Return an Arrow column as an array: time stamps in seconds, an empty column as NaN."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_timestamp(kind):
        return column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy() * 1e-9
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan)
    return column.to_numpy()


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"\n') else name


def is_a_number(cell: object) -> bool:
    """Return whether a cell of a table is a real number, or the text of one."""
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def read_csv(path: Path, about: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, the steps of each episode, and the text beside them, of a table that `write_csv` wrote.

    Raises
    ------
    LogError, ValueError
        It is damaged, or its rows were changed.
    """
    line = _LINE.fullmatch(about) or _EARLIER.fullmatch(about)
    if line is None:
        raise ValueError("its first line is damaged; take another copy, or remove the line to read a plain table")
    count, check, about = line.groups()
    body = path.read_bytes().partition(b"\n")[2].replace(b"\r\n", b"\n").rstrip(b"\n") + b"\n"
    if f"{zlib.crc32(body, zlib.crc32(about.encode()) if count else 0):08x}" != check:
        held = body.count(b"\n") - 1
        what = f"it has {held} rows of {count}, and they" if count and held != int(count) else "its rows"
        raise ValueError(f"{what} are not those that were written; without its first line it is a plain table")
    return *_unpacked(csv_columns(path)[1], json.loads(about)), about


def write_parquet(
    file: BinaryIO, X: np.ndarray, U: np.ndarray, steps: np.ndarray, names: tuple[str, ...], about: str
) -> None:
    """Write the stacked rows; the inputs of an episode's last row are null, for none was applied there."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    episode, step = _positions(steps)
    last = step == steps[episode]
    full = np.zeros((len(X), U.shape[1]))
    full[~last] = U
    columns = [pa.array(column) for column in (episode, step, *X.T)]
    columns += [pa.array(column, mask=last) for column in full.T]
    table = pa.table(columns, names=["episode", "step", *names])
    rows = max(_GROUP // (8 * len(columns)), 1)
    check = json.dumps({"rows": rows, "crc32": _checksums(about, rows, 0, np.column_stack([episode, step]), X, full)})
    table = table.replace_schema_metadata({_KEY: about.encode(), _CHECK: check.encode()})
    pq.write_table(table, file, row_group_size=rows, write_page_checksum=True)


def _checksums(about: str, size: int, first: int, *columns: np.ndarray) -> list[int]:
    """Return a checksum of each whole block of `size` rows and of the metadata; `first` is the number of the first row.

    Pages have checksums of their own, but names, sizes and the places of pages have none.
    """
    seed, count = zlib.crc32(about.encode()), len(columns[0])
    sums: list[int] = []
    for start in range(-first % size, count, size):
        total = seed
        for some in columns:
            total = zlib.crc32(np.ascontiguousarray(some[start : start + size]).data, total)
        sums.append(total)
    return sums


def _verify(table: Any, named: dict[str, Any], first: int = 0, rows: int | None = None) -> None:
    """Raise where rows of a file, the first of them number `first` of `rows`, are not those that were written."""
    metadata = table.schema.metadata
    if _CHECK not in metadata:  # written by an earlier version
        return
    check = json.loads(metadata[_CHECK])
    size, rows = int(check["rows"]), len(table) if rows is None else rows
    places = np.stack([table[name].to_numpy() for name in ("episode", "step")], axis=1)
    U = _stacked(table, _driving(named))
    found = _checksums(metadata[_KEY].decode(), size, first, places, _stacked(table, named["states"]), np.nan_to_num(U))
    if (first + len(table)) % size and first + len(table) < rows:  # the last block is not whole
        found.pop()
    begin = -(-first // size)
    written = check["crc32"][begin : begin + len(found)] if first + len(table) < rows else check["crc32"][begin:]
    if found != written:
        raise ValueError("its numbers are not those that were written; take another copy")


def own_parquet(path: Path) -> bool:
    """Return True where `write_parquet` wrote the table, so that it holds its own metadata.

    Raises
    ------
    LogError
        It is no .parquet file, or one of ours whose metadata are damaged.
    """
    if any(key in (_schema(path).metadata or {}) for key in (_KEY, _CHECK)):
        return True
    with path.open("rb") as stream:  # the footer, whose length stands in the eight bytes at the end
        stream.seek(-8, SEEK_END)
        length = int.from_bytes(stream.read(4), "little")
        stream.seek(-8 - length, SEEK_END)
        footer = stream.read(length)
    if _KEY in footer or _CHECK in footer:
        raise LogError(f"{path} holds no episodes that can be read: its metadata are damaged; take another copy")
    return False


def parquet_names(path: Path) -> list[str]:
    """Return the names of the columns."""
    return _schema(path).names


def parquet_columns(path: Path, wanted: list[str]) -> dict[str, np.ndarray]:
    """Return the columns of these names; null is NaN among numbers and None among others.

    Raises
    ------
    LogError
        The file is damaged.
    """
    table = _table(path, wanted)
    return {name: table[name].to_numpy() for name in wanted}


def read_parquet(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, the steps of each episode, and the text beside them, of a table that `write_parquet` wrote.

    Raises
    ------
    LogError, ValueError
        It is damaged; its rows were changed.
    """
    table = _table(path)
    about = table.schema.metadata[_KEY].decode()
    named = json.loads(about)
    X, U, steps = _unpacked(table, named)
    _verify(table, named)
    return X, U, steps, about


def _read_rows(file: Path, stretches: list[tuple[int, int]], plant: PlantSignature | None, place: str) -> Episodes:
    """Return stretches of the episodes of a file as episodes of their own; only the groups with their rows are read.

    Parameters
    ----------
    file
        A file that `Episodes.save` wrote.
    stretches
        (first row, steps) of each.
    plant
        The sample time and names that the file must have; None for the first file, which defines them.
    place
        The file and its rows, for messages.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    first, last = stretches[0][0], sum(stretches[-1])
    try:
        with pq.ParquetFile(file, page_checksum_verification=True) as held:
            ends = np.cumsum([held.metadata.row_group(i).num_rows for i in range(held.num_row_groups)])
            groups = np.arange(np.searchsorted(ends, first, "right"), np.searchsorted(ends, last, "right") + 1)
            table = held.read_row_groups(groups.tolist())
        named = json.loads(table.schema.metadata[_KEY])
        disturbances = named.get("disturbances", [])
        X, U, W = (_stacked(table, some) for some in (named["states"], named["inputs"], disturbances))
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


def row_groups(file: Path, history: int, plant: PlantSignature | None) -> list[Part] | None:
    """Return a part for each group of rows of the file, in order; None where it is a plain table or damaged.

    No pair is lost or comes twice: x_k → x_{k+1} belongs to the group that holds x_{k+1}. A stretch that begins inside
    an episode begins `history` rows earlier, and one that an embedding would use up is left out.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

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


def _unpacked(columns: Any, named: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return X, U and the steps of each episode, of a table of all rows; ValueError where some are out of order."""
    episode, step = (np.asarray(columns[name], dtype=np.intp) for name in ("episode", "step"))
    steps = np.bincount(episode) - 1
    expected = _positions(steps)
    if not (np.array_equal(episode, expected[0]) and np.array_equal(step, expected[1])):
        raise ValueError("rows are missing or out of order")
    last = step == steps[episode]
    return _stacked(columns, named["states"]), _stacked(columns, _driving(named))[~last], steps


def _driving(named: dict[str, Any]) -> list[str]:
    """Return the names of the columns of U: the inputs, and behind them the measured disturbances."""
    return named["inputs"] + named.get("disturbances", [])


def _stacked(columns: Any, names: list[str]) -> np.ndarray:
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
        raise LogError(
            f"{path} holds no episodes that can be read: it is no .parquet file, or was cut; {_ADVICE}"
        ) from error


def _table(path: Path, wanted: list[str] | None = None) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as held:
            size = held.metadata.num_rows * (held.metadata.num_columns if wanted is None else len(wanted))
            affordable(8 * size, f"{path}: {size} cells")
            return held.read(columns=wanted)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path} holds no episodes that can be read: its columns are damaged; {_ADVICE}") from error
