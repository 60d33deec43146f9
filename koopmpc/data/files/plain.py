# pyright: basic
"""Tables as text (.csv, .dat, .txt): a line of names, then a row a time step."""

import re
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from koopmpc.base.errors import DataError, KoopmpcError, LogError
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.columns import TableSettings, find_roles
from koopmpc.data.files.formats import LogFormat, LogTable, register_format
from koopmpc.data.files.tables import SAVED, is_a_number, pick_driving

_MISSING = ["", "nan", "NaN", "NAN", "null", "NULL", "NA", "N/A", "#N/A"]


def write_plain(stream: BinaryIO, episodes: Episodes) -> None:
    """Write the episodes as a table with the columns episode, step and time [s] before the states and inputs.

    Numbers read back to the bit. The inputs of an episode's last row are empty: none was applied there, and by this the
    reader knows them.
    """
    driven = episodes.driven()
    head = ",".join(_quote(name) for name in (*SAVED, *driven.states, *driven.inputs))
    _check_names(episodes, head)
    stream.write(f"{head}\n".encode())
    for e, episode in enumerate(driven):
        inputs = [",".join(map(repr, u)) for u in episode.U.tolist()] + ["," * (driven.nu - 1)]
        for k, (x, u) in enumerate(zip(episode.X.tolist(), inputs, strict=True)):
            cells = [str(e), str(k), repr(k * episodes.dt), *map(repr, x), *([u] if driven.nu else [])]
            stream.write(f"{','.join(cells)}\n".encode())


def _check_names(episodes: Episodes, head: str) -> None:
    """Raise DataError unless the table reads back with the names and roles of these episodes."""
    names = (*episodes.states, *episodes.inputs, *episodes.disturbances)
    numbers = ["0.0"] * (len(SAVED) + episodes.nx)
    rows = [",".join(numbers + [cell] * (episodes.nu + episodes.nw)) for cell in ("0.0", "")]
    try:
        table = _parse("\n".join([head, *rows, ""]).encode(), Path("table.csv"))
        roles = find_roles(
            table.names, table.names, TableSettings(), "table.csv", pick_driving(table.names, table.columns)
        )
        pairs = [(getattr(episodes, role), getattr(roles, role)) for role in ("states", "inputs", "disturbances")]
        changed = {name for given, read in pairs for name in {*given} ^ {*read}}
    except KoopmpcError:
        changed = {n for n in names if n in SAVED or n != n.strip() or is_a_number(n)} or {names[0]}
    wrong = next(filter(changed.__contains__, names), None)
    if wrong is not None:
        raise DataError(
            f"a .csv file would not keep the name {wrong!r} in its role; rename it (disturbances as w, w0 or "
            "disturbance), or save as .npz or .parquet"
        )


def _quote(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"\n;\t') else name


def read_plain(file: Path) -> LogTable:
    """Return the columns of a table.

    Comma, semicolon, tab or spaces are found from the first line; with semicolons a decimal comma is understood. Lines
    above it that begin with # or % are skipped. A file that begins with numbers has columns 1, 2, ….
    """
    return _parse(file.read_bytes(), file)


def _parse(raw: bytes, file: Path) -> LogTable:
    import pyarrow as pa
    from pyarrow import csv

    encoding = "utf8" if _is_utf8(raw) else "latin-1"
    raw = re.sub(rb"\A(?:[#%][^\n]*\n?)+", b"", raw.removeprefix(b"\xef\xbb\xbf"))
    head, _, rest = raw.partition(b"\n")
    if not head.strip():
        raise LogError(
            f"{file} holds no episodes that can be read: it is no {file.suffix} file, or was cut; pass a file that "
            "Episodes.save wrote, or a table: a line of names, then a row a time step"
        )
    if _has_spaces(head, rest.partition(b"\n")[0]):
        raw = b"\n".join(b"\t".join(line.split()) for line in raw.splitlines() if line.strip())
        head, _, rest = raw.partition(b"\n")
    separator = max((b",", b";", b"\t"), key=head.count)
    comma = separator == b";" and b"," in rest.partition(b"\n")[0]
    cells = (head.replace(b",", b".") if comma else head).split(separator)
    named = not _are_numbers(cells)
    numbered = [f"column {i + 1}" for i in range(len(cells))]
    try:
        table = csv.read_csv(
            BytesIO(raw),
            read_options=csv.ReadOptions(encoding=encoding, column_names=None if named else numbered),
            parse_options=csv.ParseOptions(delimiter=separator.decode()),
            convert_options=csv.ConvertOptions(
                decimal_point="," if comma else ".", null_values=_MISSING, strings_can_be_null=True
            ),
        )
    except (pa.ArrowException, OSError, ValueError) as error:
        raise LogError(f"{file} holds no episodes that can be read: {str(error).splitlines()[0]}") from error
    names = tuple(name.strip() for name in table.column_names)
    if any(map(is_a_number, names)):
        raise LogError(f"{file} has no line of names: its first row is {', '.join(names[:4])}; write one above it")
    return LogTable(names, {name: _convert(table.column(i)) for i, name in enumerate(names)}, named=named)


def _is_utf8(raw: bytes) -> bool:
    try:
        raw.decode()
    except UnicodeDecodeError:
        return False
    return True


def _has_spaces(first: bytes, second: bytes) -> bool:
    """Return whether spaces separate the cells of the first two lines of a file, or spaces and tabs."""
    if b"," in first or b";" in first or (b"\t" in first and not _are_numbers(first.split())):
        return False
    return len(first.split()) == len(second.split()) > 1


def _are_numbers(cells: list[bytes]) -> bool:
    """Return whether these cells are numbers or empty, as in a file without a line of names."""
    texts = [text for cell in cells if (text := cell.decode("latin-1").strip())]
    return bool(texts) and all(map(is_a_number, texts))


def _convert(column) -> np.ndarray:
    """Return an Arrow column as an array: time stamps in seconds, an empty column as NaN."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_timestamp(kind):
        return column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy() * 1e-9
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan)
    return column.to_numpy()


register_format(LogFormat((".csv",), read_plain, write_plain))
register_format(LogFormat((".dat", ".txt"), read_plain, folders=False))
