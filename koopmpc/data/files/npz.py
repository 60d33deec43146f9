"""The door to .npz files: arrays of numbers and text, never a pickle."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZIP_STORED, BadZipFile, ZipFile, is_zipfile

import numpy as np
from jaxtyping import Float, Int
from numpy.lib import format as npy

from koopmpc.data.episodes import About, Episode, Episodes
from koopmpc.data.source import Part
from koopmpc.errors import LogError
from koopmpc.values import Arrays


def read_arrays(file: Path, needed: tuple[str, ...]) -> Arrays:
    """Return all arrays of the file, those that are `needed` among them.

    Raises
    ------
    ValueError
        It cannot be read, or lacks an array; the text is the cause, in words for people.
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


_LOCAL = struct.Struct("<26x2H")  # the lengths of name and extra field close the header of a zip's member


@dataclass(frozen=True, eq=False)
class RangePart(Part):
    """Stretches of the episodes of one file.

    Attributes
    ----------
    file
        What `Episodes.save` wrote.
    stretches
        (first row of X, first row of U, steps) of each.
    about
        What the file must agree with; None for the file that tells it.
    """

    file: Path
    stretches: tuple[tuple[int, int, int], ...]
    about: About | None

    def __str__(self) -> str:
        first, last = self.stretches[0], self.stretches[-1]
        return f"{self.file} (rows {first[0]} to {last[0] + last[2]})"

    def load(self) -> Episodes:
        """Return the stretches as episodes of their own."""
        try:
            X, U, text = _member(self.file, "X"), _member(self.file, "U"), _held(self.file)[1]
            names = json.loads(text)
            disturbances = names.get("disturbances", [])
            nu = U.shape[1] - len(disturbances)
            found: list[Episode] = []
            for x, u, steps in self.stretches:
                driven = U[u : u + steps]
                found.append(Episode(X=X[x : x + steps + 1], U=driven[:, :nu], W=driven[:, nu:]))
            episodes = Episodes(found, names["dt"], names["states"], names["inputs"], disturbances)
        except (KeyError, TypeError, ValueError, OSError, BadZipFile) as error:
            raise LogError(f"{self} holds no episodes that can be read: {error}") from error
        if self.about is not None:
            self.about.check(episodes, str(self.file))
        return episodes


def ranges(file: Path, size: int, history: int, about: About | None) -> list[RangePart] | None:
    """Return the file's rows in order, in parts of about `size` bytes; None where it can only be read whole.

    No pair is lost or comes twice. A stretch that begins inside an episode begins `history` rows earlier, and one
    that an embedding would use up is left out.
    """
    try:
        X, U, steps = _member(file, "X"), _member(file, "U"), _held(file)[0]
    except (KeyError, TypeError, ValueError, OSError, BadZipFile):
        return None
    if len(X) != len(U) + len(steps) or len(U) != steps.sum():
        return None
    pairs = max(size // (8 * (X.shape[1] + U.shape[1])), 1)
    parts: list[list[tuple[int, int, int]]] = [[]]
    room, row = pairs, 0
    for e, total in enumerate(steps.tolist()):
        first = 0
        while first < total:
            if room == 0:
                parts.append([])
                room = pairs
            last = min(first + room, total)
            start = max(first - history, 0)
            if last - start > history:
                parts[-1].append((row + e + start, row + start, last - start))
            room -= last - first
            first = last
        row += total
    return [RangePart(file, tuple(own), about) for own in parts if own]


def _held(file: Path) -> tuple[Int[np.ndarray, " E"], str]:
    """Return the steps of each episode, and the text beside them."""
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as held:
        return held["steps"], str(held["about"])


def _member(file: Path, name: str) -> Float[np.ndarray, "M n"]:
    """Return an array of the file, mapped and not read."""
    with ZipFile(file) as held, file.open("rb") as stream:
        info = held.getinfo(f"{name}.npy")
        if info.compress_type != ZIP_STORED:
            raise ValueError("it is compressed")
        stream.seek(info.header_offset)
        stream.seek(sum(_LOCAL.unpack(stream.read(_LOCAL.size))), 1)
        major = npy.read_magic(stream)[0]
        header = npy.read_array_header_1_0 if major == 1 else npy.read_array_header_2_0
        shape, columns_first, dtype = header(stream)
        if dtype != np.float64 or columns_first or len(shape) != 2:
            raise ValueError(f"its {name} is no table of float64")
        if 0 in shape:
            return np.empty(shape)
        return np.memmap(file, dtype, "r", stream.tell(), shape)
