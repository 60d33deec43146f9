"""Named arrays of a file, as .mat and .h5 hold them, as the columns of one table."""

import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import DataError, FitWarning
from koopmpc.data.files.formats import LogTable

_SAMPLE_TIMES = ("dt", "ts", "sample_time", "sampletime", "tsample")  # names of a scalar that is the sample time [s]
_RATES = ("fs", "sample_rate", "samplerate", "sampling_rate", "sampling_frequency")  # of one that is 1/dt [Hz]
_SHOWN = 5  # arrays that a message names


def tabulate_arrays(file: Path, arrays: Mapping[str, np.ndarray], units: Mapping[str, str]) -> LogTable:
    """Return the arrays that have one row a sample as columns: vectors as they are, matrices as name1, name2, ….

    A name is the last part of its path where no other column has the same. The number of samples is the length that
    most columns share; of two, the longer. A matrix may lie on its side. A scalar named ``dt``, ``Ts`` or
    ``sample_time`` [s], or ``fs`` [Hz], tells the sample time.

    Raises
    ------
    DataError
        No array has two rows or more.
    """
    numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiub" and array.size}
    long = {name: array for name, array in numbers.items() if max(array.shape, default=1) > 1 and array.ndim <= 2}
    lengths = Counter[int]()
    for array in long.values():
        lengths[max(array.shape)] += array.size // max(array.shape)
    if not lengths:
        raise DataError(f"{file} holds no vector or matrix of numbers; it holds {_list_names(arrays)}")
    samples = max(lengths, key=lambda length: (lengths[length], length))
    names, columns, column_units = list[str](), dict[str, np.ndarray](), dict[str, str]()
    stems = Counter(name.rpartition(".")[2] for name, array in long.items() if samples in array.shape)
    for path, array in long.items():
        if samples not in array.shape:
            continue
        stem = path.rpartition(".")[2]
        name = stem if stems[stem] == 1 else path
        rows = array if array.shape[0] == samples else array.T
        rows = rows.reshape(samples, -1)
        many = rows.shape[1] > 1
        for i, column in enumerate(rows.T):
            own = f"{name}{i + 1}" if many else name
            names.append(own)
            columns[own] = np.ascontiguousarray(column)
            column_units[own] = units.get(path, "")
    left = [name for name in long if samples not in long[name].shape]
    left += [name for name in numbers if numbers[name].ndim > 2]
    if left:
        warnings.warn(
            f"{file}: {_list_names(left)} {'have' if len(left) > 1 else 'has'} another number of rows than the "
            f"{samples} of most columns, and {'are' if len(left) > 1 else 'is'} left out",
            FitWarning,
            stacklevel=2,
        )
    repeated = {name for name, count in Counter(names).items() if count > 1}
    columns = {name: column for name, column in columns.items() if name not in repeated}
    return LogTable(tuple(names), columns, column_units, _find_sample_time(numbers))


def _find_sample_time(arrays: Mapping[str, np.ndarray]) -> float | None:
    for name, array in arrays.items():
        stem = name.rpartition(".")[2].lower()
        if array.size != 1 or stem not in (*_SAMPLE_TIMES, *_RATES):
            continue
        value = float(array.reshape(-1)[0])
        if np.isfinite(value) and value > 0:
            return value if stem in _SAMPLE_TIMES else 1 / value
    return None


def _list_names(names: Any) -> str:
    every = list(map(str, names))
    return (", ".join(every[:_SHOWN]) + (", …" if len(every) > _SHOWN else "")) or "nothing"
