"""The door to .npz files: arrays of numbers and text, never a pickle."""

from pathlib import Path
from zipfile import is_zipfile

import numpy as np

from koopmpc.values import Arrays


def read_arrays(file: Path, needed: tuple[str, ...]) -> Arrays:
    """Return all arrays of the file, those that are `needed` among them.

    Raises
    ------
    ValueError
        The file cannot be read, or lacks an array; the message says why.
    """
    if not is_zipfile(file):
        raise ValueError("it is no .npz file, or was cut")
    try:
        # Opened here, for numpy leaves a file that it refuses open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
    except Exception as error:  # numpy and zipfile raise a dozen kinds, and some advise to trust the file
        raise ValueError("it is damaged, or holds something other than arrays of numbers") from error
    missing = [name for name in needed if name not in arrays]
    if missing:
        names = ", ".join(arrays) or "nothing"
        raise ValueError(f"it is of another program: it holds {names}, and lacks {', '.join(missing)}")
    return arrays
