"""compare_logs: whether a design still holds for the plant that new logs show."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.files.load import load_alike, load_episodes
from koopmpc.synthesis.designed import SavedDesign, read_controller
from koopmpc.validate.drift import DriftReport, find_drift

_OFF = 0.2  # runs with inputs off by this share say whether a design bears such a change


@dataclass(frozen=True, eq=False)
class ComparedLogs:
    """What new logs say of a design."""

    report: DriftReport  # what changed
    holds: bool | None  # None where nobody can say
    sentence: str  # the result in words


def compare_logs(old: Episodes | None, new: Episodes, kept: Sequence[str]) -> ComparedLogs:
    """Compare new logs with the data of a design, and say whether it still holds.

    It holds where nothing has changed; where the gain of an input has, by at most a fifth, it holds if the runs with
    inputs 20 % off keep the goal.

    `kept` names the kinds of runs that keep the goal.
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
    """Return logs with the states and inputs of a saved design, in its order; columns that it lacks are left out."""
    own = _logs_of(path)
    if own is None:
        raise DataError(f"{path} holds no logs of a design, so new ones cannot be compared; design again, and save")
    new = load_alike(files, own)
    if (new.states, new.inputs) != (own.states, own.inputs):
        found, known = (", ".join(one.states + one.inputs) for one in (new, own))
        raise DataError(f"{files[0]} holds {found}, the design {known}; pass logs with these columns, in this order")
    return new.with_episodes([Episode(X=e.X, U=e.U) for e in new])


def read_plant_runs(path: str | PathLike[str], files: Sequence[str | PathLike[str]]) -> Episodes:
    """Return logged runs of a saved design on its plant; columns of tables have the names that it gave them."""
    own = _logs_of(path)
    return load_episodes(*files) if own is None else load_alike(files, own)


def _logs_of(path: str | PathLike[str]) -> Episodes | None:
    saved = read_controller(Path(path))
    return saved.evidence.logs if isinstance(saved, SavedDesign) else None
