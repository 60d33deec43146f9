"""Warnings about several files as one sentence of each kind, with the count and the names of the files."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from koopmpc.base.errors import FitWarning

_NAMED = 12  # files of a sentence that are named, unless they are the whole sequence


class ResampledWarning(FitWarning):
    """The rows of a file have unequal steps and were interpolated.

    Parameters
    ----------
    file
        The file.
    counts
        How many steps differ from the usual one, and how many there are.
    first
        Line or row at which the first such step ends, and its length [s].
    usual, dt
        The median step, and the one interpolated to [s].
    """

    def __init__(self, file: str, counts: tuple[int, int], first: tuple[str, float], usual: float, dt: float) -> None:
        self.file, self.counts, self.first, self.dt = file, counts, first, dt
        super().__init__(
            f"{file}: sampling is unequal: {counts[0]} of {counts[1]} steps differ from dt = {usual:g} s by more than "
            f"2 %, the first at {first[0]}, where it is {first[1]:g} s; interpolated to {dt:g} s"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a pickle makes it of again: its text and attributes."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


def _shorten_names(files: Sequence[str]) -> list[str]:
    """Return the names of files, without the folder of those that share it with the first one."""
    return [files[0], *(Path(f).name if Path(f).parent == Path(files[0]).parent else f for f in files[1:])]


def name_files(files: Sequence[str], known: Sequence[str]) -> str:
    """Return the count of several files and their names, without the folder that they share with the first one."""
    if len(files) == 1:
        return files[0]
    short = _shorten_names(files)
    at = known.index(files[0]) if files[0] in known else 0
    if len(files) > 3 and list(known[at : at + len(files)]) == list(files):
        return f"{len(files)} files ({short[0]} to {short[-1]})"
    return f"{len(files)} files ({', '.join(short[:_NAMED])}{', …' * (len(short) > _NAMED)})"


def name_resampled(caught: Sequence[ResampledWarning]) -> str:
    """Return the sentence on files whose rows were interpolated, with the first line of each."""
    if len(caught) == 1:
        return str(caught[0])
    names = _shorten_names([one.file for one in caught])
    places = [
        f"{name} ({one.counts[0]} of {one.counts[1]}, from {one.first[0]})"
        for name, one in zip(names, caught, strict=True)
    ]
    listed = ", ".join(places[:_NAMED]) + f", and {len(places) - _NAMED} more" * (len(places) > _NAMED)
    return (
        f"sampling is unequal in {len(caught)} files, interpolated to {caught[0].dt:g} s; steps that differ by more "
        f"than 2 %: {listed}"
    )


def join_warnings(caught: Iterable[Warning], places: Sequence[str]) -> list[Warning]:
    """Return the warnings; equal ones of several places become one, and so do those of interpolated rows."""
    groups: dict[tuple[type[Warning], str], list[tuple[str, Warning]]] = {}
    for one in caught:
        file, _, text = str(one).partition(": ")
        if isinstance(one, ResampledWarning):
            groups.setdefault((ResampledWarning, ""), []).append((one.file, one))
        elif file in places:
            groups.setdefault((type(one), text), []).append((file, one))
        else:
            groups.setdefault((type(one), str(one)), []).append(("", one))
    joined: list[Warning] = []
    for (_, text), members in groups.items():
        first, alike = members[0][1], [one for _, one in members if isinstance(one, ResampledWarning)]
        if alike:
            first.args = (name_resampled(alike),)
        elif len(files := list(dict.fromkeys(file for file, _ in members))) > 1:
            first.args = (f"{name_files(files, places)}: {text}", *first.args[1:])
        joined.append(first)
    return joined
