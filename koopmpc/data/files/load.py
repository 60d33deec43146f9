"""load_episodes: the episodes of one file or of several, in any format that is registered."""

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from koopmpc.base import disk
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes, PlantSignature, join_sets, register_files
from koopmpc.data.files.columns import TableSettings
from koopmpc.data.files.formats import LogTable, find_format, read_log
from koopmpc.data.files.frames import build_frame, is_frame, list_columns, read_frame
from koopmpc.data.files.notes import join_warnings
from koopmpc.data.files.recording import read_recording
from koopmpc.data.files.tables import read_table


def save_episodes(episodes: Episodes, path: str | PathLike[str]) -> None:
    """Write the episodes in the format of the path's suffix; `Episodes.save` is this."""
    file = disk.path_of(path)
    write = find_format(file, writable=True).write
    assert write is not None, "find_format returned a format that is only read"
    with disk.writing(file) as stream:
        write(stream, episodes)


def load_episodes(
    path: Any,
    *more: Any,
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    resample: float | None = None,
    columns: Sequence[str] | Mapping[str, str] | None = None,
) -> Episodes:
    """Read the episodes of one file, or of several as one set.

    A .npz or .parquet that `Episodes.save` wrote, and logs of runs, hold their own names and dt. Any other file is a
    table with a row for each time step and a column for each state and input. A column ``t``, ``time [s]``,
    ``time [ms]`` or ``timestamp`` tells the sample time; where it goes back an episode ends. ``episode``, ``run`` or
    ``trial`` tells episodes apart, by numbers or names; ``step`` orders rows without time. Columns with the words u,
    command, input, force, torque, voltage, valve, pump, heater and the like in their names are inputs: ``u_left``,
    ``pump voltage [V]``, ``valve [%]``, but not ``motor speed``. ``w`` and ``disturbance`` are measured disturbances. A
    set point is left out. All other columns of numbers are states; arguments count before such guesses. The inputs of
    an episode's last row are not read. Missing values and gaps in time cut episodes, and a warning counts them.

    A .mf4, .mcap or .db3 holds channels with clocks of their own. Those of one clock are the rows of a table; others
    are brought to the steps of the slowest state, or of `resample`, and a warning says so.

    Parameters
    ----------
    path, more
        Files of a format below, or a pandas.DataFrame. .npz, .parquet, .csv, .dat, .txt and .rrd are always read; .mat
        and .h5 with the extra ``hdf5``, .mf4 with ``mdf``, .mcap and the .db3 of ROS 2 bags with ``ros``.
    dt
        Sample time of a table without a column of time [s].
    states, inputs, disturbances
        The names of a table's columns, or their numbers from 1; ``inputs=[]`` where there are none.
    resample
        Sample time [s] to interpolate to, for a table whose steps are unequal: states linearly, inputs held.
    columns
        Names of all columns of a table, for a file without a line of names; or {name in the log: name to use}, where a
        new name without a unit keeps the unit of the old one.

    Raises
    ------
    LogError
        A file is missing, is cut, or holds no episodes.
    DataError
        The suffix is another, the files have unequal dt or names, a table lacks a column or a step, a column
        of numbers holds a cell that is no number, or its sampling is unequal.

    Warns
    -----
    FitWarning
        There are gaps, columns that are constant or repeat another, or no column with the name of an input; unequal
        steps were interpolated. What is the same in several files is one warning, with their count and names.
    """
    return _load((path, *more), TableSettings(dt, states, inputs, disturbances, resample, columns))


def load_alike(files: Sequence[str | PathLike[str]], like: Episodes) -> Episodes:
    """Read files as one set, tables with the names and the sample time of other episodes of the same plant."""
    return _load(files, TableSettings(like.dt, like.states, like.inputs), own=True)


def _load(logs: Sequence[Any], settings: TableSettings, *, own: bool = False) -> Episodes:
    """Read files as one set; with `own`, those that hold their own names and dt keep them."""
    files = [log if is_frame(log) else disk.path_of(log) for log in logs]
    places = ["a DataFrame" if is_frame(log) else str(log) for log in files]
    if len(files) == 1:
        return _load_file(files[0], settings, own)
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            sets = [_load_file(file, settings, own) for file in files]
    finally:
        said = [one.message for one in caught if isinstance(one.message, Warning)]
        for joined in join_warnings(said, places):
            warnings.warn(joined, stacklevel=3)
    plant = PlantSignature.of(sets[0], places[0])
    for place, episodes in zip(places, sets, strict=True):
        plant.check(episodes, place, tolerance=0.0)
    return join_sets(sets)


def _load_file(file: Any, settings: TableSettings, own: bool) -> Episodes:
    if is_frame(file):
        return read_frame(file, settings)
    content = read_log(file)
    if isinstance(content, LogTable):
        return read_table(file, content, settings)
    if not isinstance(content, Episodes):
        return read_recording(file, content, settings)
    if not own and not settings.nothing:
        raise DataError(f"{file} holds its own names and dt; leave out dt, states and inputs")
    return content


def _read_frame(frame: Any, by: str | None, time: str | None, told: Sequence[Any]) -> Episodes:
    return read_frame(frame, TableSettings(*told), by, time)


def _build_frame(episodes: Episodes) -> Any:
    return build_frame(list_columns(episodes))


register_files(save=save_episodes, read_frame=_read_frame, build_frame=_build_frame)
