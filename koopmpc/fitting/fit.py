"""fit_data: from a file or a folder of logs to a model file, with its report, its pictures and its Rerun log."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import checks
from koopmpc.bench.sweep import RESULTS
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.folder import Files
from koopmpc.fitting.hold_out import IN_MEMORY, PAST, Divided, divided
from koopmpc.fitting.repair import noted, shortened
from koopmpc.fitting.report import Page, drawn, write_page
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.state import Constant, State
from koopmpc.predict.predictors import BilinearPredictor
from koopmpc.recording.model import record_model
from koopmpc.synthesis.select import Progress, select
from koopmpc.synthesis.selection import Selection
from koopmpc.validate.report import TrustReport, trust
from koopmpc.validate.scoring import Score, score

Data = str | PathLike[str] | Iterable[str | PathLike[str]]
Say = Callable[[str], None]
LINEAR = "linear.npz"  # beside a bilinear model.npz


@dataclass(frozen=True, eq=False)
class Fitted:
    """What came of a fit.

    Attributes
    ----------
    selection
        The chosen model, and the leaderboard.
    report
        Whether to trust it, on episodes that it was not fitted to.
    plain
        Errors of x⁺ = A x + B u + c on the same.
    held_out
        Those.
    model, recording
        Paths of the model file, and of the Rerun log, None where it could not be written.
    page
        Path of the report, in Markdown.
    failures
        Pictures, or the log, that could not be made, and why.
    """

    selection: Selection
    report: TrustReport
    plain: Score
    held_out: Episodes
    model: Path
    recording: Path | None
    page: Path
    failures: tuple[str, ...]

    @property
    def usage(self) -> str:
        """Two lines of Python that load the model; where it is bilinear a third, for the best linear one."""
        model, linear = self.model.as_posix(), (self.model.parent / LINEAR).as_posix()
        lines = ["import koopmpc as km"]
        if isinstance(self.selection.predictor, BilinearPredictor):
            lines.append(f'model = km.load_model("{model}")  # for BilinearMPC')
            if self.selection.linear is not None:
                lines.append(f'linear = km.load_model("{linear}")  # for KoopmanMPC')
        else:
            lines.append(f'model = km.load_model("{model}")  # for KoopmanMPC')
        return "\n".join(lines)


def fit_data(
    data: Data,
    folder: str | PathLike[str],
    *,
    horizon: int | None = None,
    bilinear: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    memory: int = IN_MEMORY,
    say: Say | None = None,
    progress: Progress | None = None,
    rng: np.random.Generator | int = 0,
    **reading: Any,
) -> Fitted:
    """Read data, hold some out, choose and fit a model, judge it, and write model.npz, report.md and model.rrd.

    Parameters
    ----------
    data
        A folder of .npz, .parquet, .csv and .rrd files, or files; of a folder of runs the .rrd logs.
    folder
        Where all is written; it is made.
    horizon
        Steps ahead; `select` says what it is by default.
    bilinear
        Try bilinear models too; if one is chosen, the best linear one goes to linear.npz.
    workers, scheduler
        As in `koopmpc.parallel.map_tasks`.
    memory
        Bytes of files up to which they are read as a whole; beyond, the fit reads them part by part.
    say
        Called with each paragraph of text as it is known.
    progress
        As in `select`.
    rng
        Draws what is held out, and what the choice draws.
    reading
        What `load_episodes` is to be told of plain tables: ``dt=``, ``states=``, ``inputs=``, ``resample=``, ….

    Raises
    ------
    LogError
        A file cannot be read, or the folder not written.
    DataError
        The data are not of one plant, or too few.
    """
    place, draw = Path(folder), checks.generator(rng)
    horizon = None if horizon is None else checks.count(horizon, "horizon")
    tell = _silent if say is None else say
    notes: list[str] = []
    with noted(notes):
        files = Files(_logs(data), **{name: value for name, value in reading.items() if value is not None})
        split = divided(files, horizon, draw, memory)
    understood = _understood(split, shortened(notes, files.files))
    tell(understood)
    doubts: list[str] = []
    with noted(doubts):
        selection = select(
            split.fitted,
            horizon=split.horizon,
            delays=range(PAST + 1),
            bilinear=bilinear,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
            rng=draw,
        )
    model = place / "model.npz"
    selection.predictor.save(model)
    if selection.linear is not None and selection.linear is not selection.predictor:
        selection.linear.save(place / LINEAR)
    chosen = "\n".join([str(selection), *(f"! {doubt}" for doubt in doubts)])
    tell(chosen)
    with noted([]):  # the same doubts again
        report = trust(selection.predictor, split.held_out, split.horizon, train=split.seen, rng=draw)
        plain = score(edmd(split.seen, State() + Constant()), split.held_out, split.horizon)
    judged = f"{report}\n\n{_beside(report.score, plain)}"
    tell(judged)
    failures: list[str] = []
    pictures = drawn(selection, report, plain, split.held_out, place, failures)
    recording = place / "model.rrd"
    try:
        record_model(selection.predictor, split.held_out, recording, report=report)
    except Exception as error:  # a log that cannot be written must not cost the model
        failures.append(f"{recording.name}: {type(error).__name__}: {error}")
    whole = Fitted(
        selection=selection,
        report=report,
        plain=plain,
        held_out=split.held_out,
        model=model,
        recording=recording if recording.exists() else None,
        page=place / "report.md",
        failures=tuple(failures),
    )
    write_page(whole.page, Page(understood, chosen, judged, pictures, whole.usage, whole.failures))
    return whole


def _logs(data: Data) -> Data:
    """Return the logs of a folder of runs, which holds their table too; all else as it is."""
    if isinstance(data, str | PathLike) and (Path(data) / RESULTS).is_file():
        return sorted(Path(data).glob("*.rrd"))
    return data


def _understood(split: Divided, notes: list[str]) -> str:
    """Return what was made of the data: sizes, sample time, names and ranges, and all that was repaired."""
    lines = [f"data      {split.size}", f"step      dt = {split.seen.dt:g} s"]
    X = np.concatenate([e.X for e in split.seen])
    V = np.concatenate([np.hstack([e.U, e.W]) for e in split.seen])
    for what, names, columns in (
        ("states", split.seen.states, X),
        ("inputs", split.seen.inputs, V[:, : split.seen.nu]),
        ("measured", split.seen.disturbances, V[:, split.seen.nu :]),
    ):
        wide = max(map(len, names), default=0)
        for i, name in enumerate(names):
            low, high = columns[:, i].min(), columns[:, i].max()
            lines.append(f"{what if i == 0 else '':<10}{name:<{wide}}  {low:>9.3g} … {high:.3g}")
        if not names and what == "inputs":
            lines.append("inputs    none")
    steps = sum(map(len, split.held_out))
    lines.append(
        f"held out  {len(split.held_out)} episodes, {steps} steps; horizon {split.horizon} steps = "
        f"{split.horizon * split.seen.dt:.3g} s"
    )
    return "\n".join([*lines, *(f"! {note}" for note in (*notes, *split.notes))])


def _beside(score: Score, plain: Score) -> str:
    """Return the last errors as shares of those of the plain linear fit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = score.rmse[-1] / plain.rmse[-1]
    named = ", ".join(f"{name} {share:.2g}" for name, share in zip(score.states, shares, strict=True))
    return f"RMSE {score.horizon} steps ahead over that of the plain linear fit x⁺ = A x + B u + c:\n  {named}"


def _silent(_: str) -> None:
    pass
