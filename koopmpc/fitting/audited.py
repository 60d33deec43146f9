"""The audit before a fit: rows at fault are left out where enough data remain, and every fault is noted."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Any, TypeVar

from koopmpc.data.episodes import Episodes
from koopmpc.data.sampling import UnevenSamplingError
from koopmpc.data.storage import Files
from koopmpc.errors import DataError
from koopmpc.validate.logs.audit import audit

Data = str | PathLike[str] | Iterable[str | PathLike[str]]
T = TypeVar("T")
_REPAIRED = ("constant input", "repeated column", "wrapped angle")  # `needed` puts these right, and says so
_LEAST = 0.5  # share of the steps that must be left once rows at fault are left out


@dataclass(frozen=True, eq=False)
class Audited:
    """Episodes without the rows at fault.

    Attributes
    ----------
    episodes
        The episodes that are left.
    notes
        The faults, and what was done about each, in sentences.
    delay
        Steps of the past that a model needs for signals that are late; 0 where none is.
    """

    episodes: Episodes
    notes: tuple[str, ...]
    delay: int


def audited(episodes: Episodes, *, cut: bool = True) -> Audited:
    """Audit the episodes and leave out the rows at fault, unless that would leave less than half of the steps.

    Parameters
    ----------
    episodes
        The episodes as they were read.
    cut
        False where the episodes are only a sample of the data, so that nothing can be left out.
    """
    report = audit(episodes)
    rest = episodes
    if cut and any(fault.places for fault in report.faults):
        try:
            rest = report.without_faults(episodes)
        except DataError:  # every row is at fault
            rest = episodes
        if sum(map(len, rest)) < _LEAST * sum(map(len, episodes)):
            rest = episodes
    notes: list[str] = []
    for fault in report.faults:
        if fault.name in _REPAIRED:
            continue
        if fault.places and rest is not episodes:
            done = "these rows were left out"
        elif fault.steps:
            done = f"models that see {fault.steps} steps of the past are tried: embedding=km.Delay({fault.steps})"
        else:
            done = fault.do
        notes.append(f"{fault.name}: {fault.says}; {done}")
    return Audited(rest, tuple(notes), report.delay)


def evenly(paths: Data, told: dict[str, Any], use: Callable[[Files], T], notes: list[str]) -> tuple[Files, T]:
    """Return the files and use(files). Where their steps are unequal they are interpolated, and a note says so.

    Parameters
    ----------
    paths
        A folder, or files.
    told
        Keywords of `load_episodes`; with ``resample`` among them nothing is done here.
    use
        The function that reads the files.
    notes
        The list to which the sentence is added.
    """
    try:
        files = Files(paths, **told)
        return files, use(files)
    except UnevenSamplingError as uneven:
        if "resample" in told:
            raise
        notes.append(f"{str(uneven).rpartition('; pass')[0]}; interpolated to {uneven.dt:g} s")
        told = {**told, "resample": uneven.dt}
        files = Files(paths, **told)
        return files, use(files)
