# pyright: basic
"""The door to CSV: columns of a text table by name, and episodes as one such table, to the bit."""

import json
import re
import zlib
from decimal import Decimal
from io import BytesIO
from numbers import Real
from pathlib import Path
from typing import BinaryIO

import numpy as np

from koopmpc.data.files.parquet import positions
from koopmpc.errors import DataError, LogError

_MARK = "# koopmpc.episodes "
_OWN = ('"dt": ', '"states": ')  # in the first line too: a damaged mark is found
_LINE = re.compile(r"rows=(\d+) crc32=([0-9a-f]{8}) (.*)")
_EARLIER = re.compile(r"(\b)([0-9a-f]{8}) (.*)")  # which has no count, and whose checksum is of the rows alone
_TEXT = ("utf-8-sig", "latin-1")


def write(file: BinaryIO, X: np.ndarray, U: np.ndarray, steps: np.ndarray, names: tuple[str, ...], about: str) -> None:
    """Write the stacked rows below a line with their number, a checksum and metadata.

    The inputs of an episode's last row stay empty. The checksum is of the metadata and the rows.
    """
    episode, step = positions(steps)
    last = step == steps[episode]
    lines = [",".join(_quoted(name) for name in ("episode", "step", *names))]
    inputs = iter(U)
    for e, k, x, end in zip(episode, step, X, last, strict=True):
        u = [""] * U.shape[1] if end else [repr(float(v)) for v in next(inputs)]
        lines.append(",".join([str(e), str(k), *(repr(float(v)) for v in x), *u]))
    body = ("\n".join(lines) + "\n").encode()
    file.write(f"{_MARK}rows={len(X)} crc32={zlib.crc32(body, zlib.crc32(about.encode())):08x} {about}\n".encode())
    file.write(body)


def described(path: Path) -> str | None:
    """Return the metadata in the first line of a table that `write` wrote; None for any other table."""
    with path.open("rb") as file:
        line = file.readline(1_000_000)
    text = line.decode(_TEXT[0], errors="replace")
    if text.startswith(_MARK):
        return text[len(_MARK) :].strip()
    return text if text.startswith("#") and any(sign in text for sign in _OWN) else None


def columns(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
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
    if any(map(_is_a_number, names)):
        raise LogError(f"{path} has no line of names: its first row is {', '.join(names[:4])}; write one above it")
    return names, {name: _values(table.column(i)) for i, name in enumerate(names)}


def read(path: Path, about: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, the steps of each episode, and the text beside them, of a table that `write` wrote.

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
    named = json.loads(about)
    found = columns(path)[1]
    episode, step = (np.asarray(found[name], dtype=np.intp) for name in ("episode", "step"))
    steps = np.bincount(episode) - 1
    last = step == steps[episode]
    rows = len(episode)
    X = np.array([found[name] for name in named["states"]], dtype=np.float64).reshape(-1, rows).T
    driven = named["inputs"] + named.get("disturbances", [])
    U = np.array([found[name] for name in driven], dtype=np.float64).reshape(len(driven), rows).T[~last]
    return np.ascontiguousarray(X), np.ascontiguousarray(U), steps, about


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


def numbers(column: np.ndarray, name: str, where: str) -> np.ndarray:
    """Return a column of objects as floats, None as NaN; return a column of text unchanged.

    Parameters
    ----------
    column
        (rows,) of any kind.
    name, where
        The column and its file, for messages.

    Raises
    ------
    DataError
        At least half of the cells look like numbers, but one is no real number: a decimal comma, a complex number or
        a word. The whole column would be lost for that cell.
    """
    if column.dtype.kind != "O":
        return column
    present = [cell for cell in column if cell is not None]
    if present and all(isinstance(cell, Real | Decimal) for cell in present):
        return np.array([np.nan if cell is None else float(cell) for cell in column])
    like = sum(map(_like_a_number, present))
    if like == 0 or 2 * like < len(present):
        return column
    row, cell = next((i, cell) for i, cell in enumerate(column) if cell is not None and not _is_a_number(cell))
    raise DataError(
        f"{where}: {name!r} holds {str(cell)!r} in row {row + 1}, which is no real number; repair the cell, leave it "
        "empty where the value is missing, or name the columns to use: pass states= and inputs="
    )


def _is_a_number(cell: object) -> bool:
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def _like_a_number(cell: object) -> bool:
    try:
        complex(str(cell).strip().replace(",", "."))
    except ValueError:
        return False
    return True
