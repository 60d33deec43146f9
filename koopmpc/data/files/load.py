"""load_episodes: the episodes of one file or of several, in any format that is registered."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from koopmpc import disk
from koopmpc.data.episodes import Episodes, PlantSignature, join_sets
from koopmpc.data.files.columns import TableSettings
from koopmpc.data.files.formats import find_format, read_log
from koopmpc.data.files.tables import read_table
from koopmpc.errors import DataError


def save_episodes(episodes: Episodes, path: str | PathLike[str]) -> None:
    """Write the episodes in the format of the path's suffix; `Episodes.save` is this."""
    file = disk.path_of(path)
    write = find_format(file, writable=True).write
    assert write is not None, "find_format returned a format that is only read"
    with disk.writing(file) as stream:
        write(stream, episodes)


def load_episodes(
    path: str | PathLike[str],
    *more: str | PathLike[str],
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    resample: float | None = None,
    columns: Sequence[str] | None = None,
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

    Parameters
    ----------
    path, more
        .npz, .parquet, .csv, .dat, .txt or .rrd.
    dt
        Sample time of a table without a column of time [s].
    states, inputs, disturbances
        The names of a table's columns, or their numbers from 1; ``inputs=[]`` where there are none.
    resample
        Sample time [s] to interpolate to, for a table whose steps are unequal: states linearly, inputs held.
    columns
        Names of all columns of a table, which replace its own: for a file without a line of names.

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
        There are gaps, columns that are constant or repeat another, or no column with the name of an input.
    """
    settings = TableSettings(dt, states, inputs, disturbances, resample, columns)
    files = [disk.path_of(file) for file in (path, *more)]
    sets = [_load_file(file, settings) for file in files]
    plant = PlantSignature.of(sets[0], str(files[0]))
    for file, episodes in zip(files, sets, strict=True):
        plant.check(episodes, str(file), tolerance=0.0)
    return join_sets(sets)


def _load_file(file: Path, settings: TableSettings) -> Episodes:
    content = read_log(file)
    if not isinstance(content, Episodes):
        return read_table(file, content, settings)
    if not settings.nothing:
        raise DataError(f"{file} holds its own names and dt; leave out dt, states and inputs")
    return content
