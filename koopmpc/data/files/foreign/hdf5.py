# pyright: basic
"""HDF5 files (.h5, .hdf5): each dataset of numbers is a column, or a matrix of columns; read through h5py."""

import mmap
import struct
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.disk import affordable
from koopmpc.base.errors import DataError, FitWarning, KoopmpcError, LogError
from koopmpc.data.files.formats import LogFormat, LogTable, register_format

EXTRA = "hdf5"
_HEAP = b"GCOL\x01\0\0\0"  # begins a heap of texts
_SAMPLE_TIMES = ("dt", "ts", "sample_time", "sampletime", "tsample")  # names of a scalar that is the sample time [s]
_RATES = ("fs", "sample_rate", "samplerate", "sampling_rate", "sampling_frequency")  # of one that is 1/dt [Hz]
_UNITS = ("units", "unit", "Units", "Unit")  # attributes of a dataset that state its unit


def read_hdf5(file: Path) -> LogTable:
    """Return the datasets of numbers by their path, ``group.name``; those of one row a sample are the columns.

    A dataset of a compound type gives a column for each of its fields. Attributes ``units`` or ``unit`` are units.
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


def tabulate_arrays(file: Path, arrays: Mapping[str, np.ndarray], units: Mapping[str, str]) -> LogTable:
    """Return the arrays that have one row a sample as columns: vectors as they are, matrices as name1, name2, ….

    A name is the last part of its path where no other column has the same. The number of samples is the length that
    most columns share; of two, the longer. A matrix may lie on its side. A scalar named ``dt``, ``Ts`` or
    ``sample_time`` [s], or ``fs`` [Hz], tells the sample time.
    """
    numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiub" and array.size}
    long = {name: array for name, array in numbers.items() if max(array.shape, default=1) > 1}
    lengths = Counter[int]()
    for array in long.values():
        if array.ndim <= 2:
            lengths[max(array.shape)] += array.size // max(array.shape)
    if not lengths:
        raise DataError(f"{file} holds no vector or matrix of numbers; it holds {_list_names(arrays)}")
    samples = max(lengths, key=lambda length: (lengths[length], length))
    chosen = {path: array for path, array in long.items() if array.ndim <= 2 and samples in array.shape}
    left = [path for path in long if path not in chosen]
    if left:
        have, are = ("have", "are") if len(left) > 1 else ("has", "is")
        warnings.warn(
            f"{file}: {_list_names(left)} {have} another number of rows than the {samples} of most columns, and {are} "
            "left out",
            FitWarning,
            stacklevel=2,
        )
    named = _name_columns(chosen, samples)
    count = Counter(name for name, _, _ in named)
    return LogTable(
        tuple(name for name, _, _ in named),
        {name: column for name, _, column in named if count[name] == 1},
        {name: units.get(path, "") for name, path, _ in named},
        _find_sample_time(numbers),
    )


def _name_columns(arrays: Mapping[str, np.ndarray], samples: int) -> list[tuple[str, str, np.ndarray]]:
    """Return name, path and values of each column of these arrays."""
    stems = Counter(path.rpartition(".")[2] for path in arrays)
    columns: list[tuple[str, str, np.ndarray]] = []
    for path, array in arrays.items():
        stem = path.rpartition(".")[2]
        name = stem if stems[stem] == 1 else path
        rows = (array if array.shape[0] == samples else array.T).reshape(samples, -1)
        numbers = [""] if rows.shape[1] == 1 else range(1, rows.shape[1] + 1)
        columns += [(f"{name}{i}", path, np.ascontiguousarray(c)) for i, c in zip(numbers, rows.T, strict=True)]
    return columns


def _find_sample_time(arrays: Mapping[str, np.ndarray]) -> float | None:
    for name, array in arrays.items():
        stem = name.rpartition(".")[2].lower()
        if array.size == 1 and stem in (*_SAMPLE_TIMES, *_RATES):
            value = float(array.reshape(-1)[0])
            if np.isfinite(value) and value > 0:
                return value if stem in _SAMPLE_TIMES else 1 / value
    return None


def _list_names(names: Iterable[str], most: int = 5) -> str:
    every = list(map(str, names))
    return (", ".join(every[:most]) + (", …" if len(every) > most else "")) or "nothing"


register_format(LogFormat((".h5", ".hdf5"), read_hdf5, extra=EXTRA))
