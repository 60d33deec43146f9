"""compare_logs: whether a design still holds for the plant that new logs show."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from koopmpc.data.episodes import Episode, Episodes, join_sets
from koopmpc.data.files.load import load_episodes
from koopmpc.errors import DataError
from koopmpc.synthesis.designed import SavedDesign, read_controller
from koopmpc.validate.drift import DriftReport, find_drift

_TABLES = (".csv", ".dat", ".txt")  # files whose columns have to be named
_OFF = 0.2  # runs with inputs off by this share say whether a design bears such a change


@dataclass(frozen=True, eq=False)
class ComparedLogs:
    """What new logs say of a design.

    Attributes
    ----------
    report
        What changed.
    holds
        True, False, or None where nobody can say.
    sentence
        The result in words.
    """

    report: DriftReport
    holds: bool | None
    sentence: str


def compare_logs(old: Episodes | None, new: Episodes, kept: Sequence[str]) -> ComparedLogs:
    """Compare new logs with the data of a design, and say whether it still holds.

    It holds where nothing has changed; where the gain of an input has, by at most a fifth, it holds if the runs with
    inputs 20 % off keep the goal.

    Parameters
    ----------
    old
        The logs of the design, in its evidence.
    new
        New logs, with the states and inputs of the design in their order.
    kept
        Names of the kinds of runs that keep the goal.

    Raises
    ------
    DataError
        The design was saved without its logs.
    """
    if old is None:
        raise DataError("the design was saved without its logs, so new ones cannot be compared; design again, and save")
    report = find_drift(old, new)
    if report.verdict == "unchanged":
        return ComparedLogs(report, True, f"the design still holds: {report.sentences[0]}")
    if report.verdict == "cannot say":
        return ComparedLogs(report, None, f"nobody can say whether the plant has changed: {report.sentences[0]}")
    gains = [one for one in report.changes if one.kind == "input" and abs(one.share) <= _OFF * 1.1]
    borne = [f"inputs 20 % {'weaker' if one.share < 0 else 'stronger'}" in kept for one in gains]
    if gains and all(borne) and len(gains) == len(report.changes):
        return ComparedLogs(
            report, True, f"the plant has changed: {report.sentences[0]}; the design keeps its goal with such inputs"
        )
    return ComparedLogs(
        report, False, f"the plant has changed: {report.sentences[0]}; design again from the new logs, or repair it"
    )


def read_new_logs(path: str | PathLike[str], files: Sequence[str | PathLike[str]]) -> Episodes:
    """Return logs with the states and inputs of a saved design, in its order; columns that it lacks are left out.

    Raises
    ------
    DataError
        A column of the design is missing, or the file holds no design with its logs.
    LogError
        A file cannot be read.
    """
    saved = read_controller(Path(path))
    own = saved.evidence.logs if isinstance(saved, SavedDesign) else None
    if own is None:
        raise DataError(f"{path} holds no logs of a design, so new ones cannot be compared; design again, and save")
    parts = [
        load_episodes(file, states=own.states, inputs=own.inputs)
        if Path(file).suffix.lower() in _TABLES
        else load_episodes(file)
        for file in files
    ]
    for file, part in zip(files, parts, strict=True):
        if (part.states, part.inputs) != (own.states, own.inputs):
            found, known = (", ".join(one.states + one.inputs) for one in (part, own))
            raise DataError(f"{file} holds {found}, the design {known}; pass logs with these columns, in this order")
    return join_sets([part.with_episodes([Episode(X=e.X, U=e.U) for e in part]) for part in parts])
