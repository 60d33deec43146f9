# pyright: basic
"""HDF5 files (.h5, .hdf5): each dataset of numbers is a column, or a matrix of columns; read through h5py."""

import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.disk import affordable
from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.data.files.foreign.arrays import tabulate_arrays
from koopmpc.data.files.formats import LogFormat, LogTable, register_format

EXTRA = "hdf5"
_HEAP = b"GCOL\x01\0\0\0"  # begins a heap of texts
_UNITS = ("units", "unit", "Units", "Unit")  # attributes of a dataset that state its unit


def read_hdf5(file: Path) -> LogTable:
    """Return the datasets of numbers by their path, ``group.name``; those of one row a sample are the columns.

    A dataset of a compound type gives a column for each of its fields. Attributes ``units`` or ``unit`` are units.

    Raises
    ------
    LogError
        It is no HDF5 file, or it is damaged.
    """
    arrays, units = load_datasets(file)
    return tabulate_arrays(file, arrays, units)


def load_datasets(file: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the numeric datasets of a file by their path, and their units."""
    import h5py

    _require_sound_heaps(file)
    arrays, units = dict[str, np.ndarray](), dict[str, str]()

    def load(path: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or path.startswith("#") or item.is_virtual or item.external:
            return
        name = path.replace("/", ".")
        kind = item.dtype
        if kind.names is None and kind.kind not in "fiub":
            return
        affordable(int(item.size or 0) * max(kind.itemsize, 8), f"{item.size} numbers of {path}")
        content = np.asarray(item[()])
        unit = next((str(_decode(item.attrs[key])) for key in _UNITS if key in item.attrs), "")
        if kind.names is None:
            arrays[name], units[name] = content, unit
            return
        for field in kind.names:
            if content[field].dtype.kind in "fiub":
                arrays[f"{name}.{field}"] = np.ascontiguousarray(content[field])

    try:
        with h5py.File(file, "r") as stream:
            stream.visititems(load)
            arrays |= {key: value for key in ("dt", "fs", "Ts") if (value := _read_scalar(stream, key)) is not None}
    except (KoopmpcError, ModuleNotFoundError):
        raise
    except Exception as error:  # h5py raises what its C library reports: OSError, RuntimeError, KeyError, ValueError, …
        raise LogError(f"{file} cannot be read as HDF5: {error}; take another copy") from error
    return arrays, units


def _require_sound_heaps(file: Path) -> None:
    """Raise a LogError where a heap of texts has free space of no length, on which the HDF5 library walks for ever.

    A heap is GCOL, version, three zeros and its size; then objects of number, count, zero, size and padded content. An
    object of number 0 is free space, whose size includes these 16 bytes.
    """
    with file.open("rb") as stream:
        if not stream.seek(0, 2):
            return
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as whole:
            start = whole.find(_HEAP)
            while start >= 0:
                place = start + 16
                end = (
                    min(start + struct.unpack_from("<Q", whole, start + 8)[0], len(whole)) if place <= len(whole) else 0
                )
                while place + 16 <= end:
                    number, _, _, size = struct.unpack_from("<HHIQ", whole, place)
                    if number == 0 and size == 0:
                        raise LogError(f"{file} cannot be read as HDF5: a heap of texts is damaged; take another copy")
                    place += size if number == 0 else 16 + -(-size // 8) * 8
                start = whole.find(_HEAP, start + 1)


def _read_scalar(stream: Any, key: str) -> np.ndarray | None:
    """Return an attribute of the file as a scalar, if it is a number."""
    if key not in stream.attrs:
        return None
    value = np.asarray(stream.attrs[key])
    return value if value.dtype.kind in "fiu" and value.size == 1 else None


def _decode(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


register_format(LogFormat((".h5", ".hdf5"), read_hdf5, extra=EXTRA))
