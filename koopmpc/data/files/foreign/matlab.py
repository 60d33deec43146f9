# pyright: basic
"""MATLAB files (.mat): versions 4 to 7.2 through scipy, 7.3 through h5py."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import DataError, LogError
from koopmpc.data.files.foreign.hdf5 import EXTRA, load_datasets, tabulate_arrays
from koopmpc.data.files.formats import LogFormat, LogTable, register_format

_HDF5 = b"\x89HDF\r\n\x1a\n"  # begins an HDF5 file; MATLAB 7.3 writes it after 512 bytes of its own


def read_matlab(file: Path) -> LogTable:
    """Return the numeric variables; a field of a struct is ``struct.field``."""
    from scipy.io import loadmat

    with file.open("rb") as stream:
        head = stream.read(520)
    if head[512:520] == _HDF5 or head[:8] == _HDF5:
        arrays, units = load_datasets(file)
        arrays = {name: array.T for name, array in arrays.items()}  # MATLAB stores by columns
        return tabulate_arrays(file, arrays, units)
    try:
        content = loadmat(file, struct_as_record=False, squeeze_me=True)
    except Exception as error:  # loadmat raises what it stumbles over: ValueError, zlib.error, MemoryError, …
        raise LogError(f"{file} cannot be read as a .mat file: {error}; take another copy") from error
    arrays = dict[str, np.ndarray]()
    for name, value in content.items():
        if not name.startswith("__"):
            _collect(name, value, arrays)
    if "__function_workspace__" in content and not any(max(array.shape, default=1) > 1 for array in arrays.values()):
        raise DataError(
            f"{file} holds objects of MATLAB classes (iddata, timetable, timeseries), which only MATLAB can read; save "
            "their columns as plain arrays: save('log.mat', 't', 'u', 'y')"
        )
    return tabulate_arrays(file, arrays, {})


def _collect(name: str, value: Any, arrays: dict[str, np.ndarray]) -> None:
    """Add the arrays of a variable, and of the fields of a struct below it."""
    fields: Mapping[str, Any] | None = getattr(value, "__dict__", None)
    if fields is not None and "_fieldnames" in fields:
        for field in fields["_fieldnames"]:
            _collect(f"{name}.{field}", fields[field], arrays)
        return
    array = np.asarray(value)
    if array.dtype.kind in "fiub":
        arrays[name] = array


register_format(LogFormat((".mat",), read_matlab, extra=EXTRA))
