"""fit_data: from a file or a folder of logs to a model file, with its report, its pictures and its Rerun log."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.apps.fitting.logs import IN_MEMORY, PAST, Data, DividedData, collect_notes, read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.base import checks
from koopmpc.base.errors import FullDiskError
from koopmpc.base.page import Page
from koopmpc.base.parallel import StageProgress
from koopmpc.base.terminal import label_lines, render_text
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.state import Constant, State
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.predictors import BilinearPredictor
from koopmpc.models.records.narx import DELAYS
from koopmpc.synthesis.options import SearchOptions
from koopmpc.synthesis.search.leaderboard import Selection
from koopmpc.synthesis.search.records import fit_again
from koopmpc.synthesis.select import select
from koopmpc.validate.report import TrustReport, trust
from koopmpc.validate.scoring import AnyPredictor, Score, score
from koopmpc.views.figures.eigenvalues import spectrum
from koopmpc.views.figures.series import error, rollout
from koopmpc.views.figures.style import save
from koopmpc.views.recording.model import record_model

Say = Callable[[str], None]
_ROLLOUTS = 3  # draw forecasts of this many held-out episodes
LINEAR = "linear.npz"  # beside a bilinear model.npz


@dataclass(frozen=True, eq=False)
class FittedData:
    """The model that was chosen, its report, and the files that were written.

    Attributes
    ----------
    selection
        The chosen model, and the leaderboard.
    report
        The trust report, on episodes that the model was not fitted to. Of records the chosen model, fitted without the
        last fifth, is judged there; the model of the file is fitted to all rows.
    plain
        Errors of x⁺ = A x + B u + c on the same episodes.
    held_out
        The held-out episodes.
    model, recording
        Paths of the model file, and of the Rerun log, None where it could not be written.
    page
        Path of the report, in Markdown.
    usage
        Lines of Python that load the model; where it is bilinear also the best linear one.
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
    usage: str
    failures: tuple[str, ...]


def fit_data(
    data: Data,
    folder: str | PathLike[str],
    options: FitOptions | None = None,
    *,
    memory: int = IN_MEMORY,
    say: Say | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
) -> FittedData:
    """Read data, hold some out, choose and fit a model, judge it, and write model.npz, report.md and model.rrd.

    Parameters
    ----------
    data
        A folder of .npz, .parquet, .csv and .rrd files, or files. Of a folder of runs only the .rrd logs are read.
    folder
        Where everything is written; it is made if need be.
    options
        How the logs are read, and which models are tried, see `FitOptions`. If a bilinear model is chosen, the best
        linear one goes to linear.npz.
    memory
        Bytes of files up to which they are read as a whole; beyond, the fit reads them part by part.
    say
        Called with each paragraph of text as it is known.
    progress
        As in `select`.
    rng
        Draws the held-out episodes, and all that `select` draws.

    Raises
    ------
    LogError
        A file cannot be read, or the folder not written.
    DataError
        The data are not of one plant, or too few.
    """
    place, draw = Path(folder), checks.generator(rng)
    asked, tell = options or FitOptions(), ignore_text if say is None else say
    split = read_logs(data, asked.horizon, draw, memory, asked.list_reading())
    about = describe_data(split)
    tell(about)
    doubts: list[str] = []
    record = split.learned is not None  # select searches longer pasts of it by itself
    with collect_notes(doubts):
        selection = select(
            split.fitted,
            horizon=split.horizon,
            options=SearchOptions(
                delays=None if split.delay <= (max(DELAYS) if record else PAST) else [*range(PAST + 1), split.delay],
                bilinear=not asked.linear,
                feedthrough=asked.feedthrough,
                workers=asked.workers,
                scheduler=asked.scheduler,
                progress=progress,
                rng=draw,
            ),
        )
    model = place / "model.npz"
    selection.predictor.save(model)
    if selection.linear is not None and selection.linear is not selection.predictor:
        selection.linear.save(place / LINEAR)
    chosen = "\n".join([str(selection), *(f"! {doubt}" for doubt in doubts)])
    tell(chosen)
    with collect_notes([]):  # the fits repeat the doubts that stand above
        judged = selection.predictor if split.learned is None else fit_again(selection, split.learned)
        seen, held_out = (judged.align(data) for data in (split.seen, split.held_out))
        report = trust(judged, held_out, split.ahead, train=seen, rng=draw)
        plain = score(edmd(seen, State() + Constant()), held_out, split.ahead)
    verdict = f"{report}\n\n{_compare_with_plain(report.score, plain)}"
    tell(verdict)
    failures: list[str] = []
    recording = place / "model.rrd"
    try:
        record_model(judged, held_out, recording, report=report)
    except FullDiskError:
        raise
    except Exception as failure:  # a log that cannot be written must not cost the model
        failures.append(f"{recording.name}: {type(failure).__name__}: {failure}")
    usage, pictures = _format_usage(selection, model), list_pictures(selection, judged, report, plain, held_out)
    page = _write_page(Page(place), (verdict, usage, about, chosen), pictures, failures)
    return FittedData(
        selection=selection,
        report=report,
        plain=plain,
        held_out=held_out,
        model=model,
        recording=recording if recording.exists() else None,
        page=page,
        usage=usage,
        failures=tuple(failures),
    )


def _write_page(
    page: Page,
    texts: tuple[str, str, str, str],
    pictures: Iterator[tuple[str, str, Callable[[], Any]]],
    failures: list[str],
) -> Path:
    """Write the report of verdict, usage, data and choice, with its pictures; add those that fail to `failures`."""
    verdict, usage, about, chosen = texts
    page.text("# Model report", verdict.partition("\n")[0])
    page.code(usage, "python")
    page.text("## Data")
    page.code(about)
    page.text("## Trust")
    page.code(verdict)
    for name, caption, draw_picture in pictures:
        try:
            page.picture(name, caption, partial(save, draw_picture()))
        except FullDiskError:
            raise
        except Exception as failure:  # a picture that cannot be drawn must not cost the model
            failures.append(f"{name}.png: {type(failure).__name__}: {failure}")
    page.text("## Choice")
    page.code(chosen)
    if failures:
        page.text("## What could not be made")
        page.items(failures)
    return page.write()


def _format_usage(selection: Selection, path: Path) -> str:
    lines = ["import koopmpc as km"]
    if isinstance(selection.predictor, BilinearPredictor):
        lines.append(f'model = km.load_model("{path.as_posix()}")  # for BilinearMPC')
        if selection.linear is not None:
            lines.append(f'linear = km.load_model("{(path.parent / LINEAR).as_posix()}")  # for KoopmanMPC')
    else:
        lines.append(f'model = km.load_model("{path.as_posix()}")  # for KoopmanMPC')
    if selection.predictor.input_lead:
        lines.append("logs = model.align(logs)  # of logs like these the inputs move one row up")
    return "\n".join(lines)


def list_pictures(
    selection: Selection, judged: AnyPredictor, report: TrustReport, plain: Score, held_out: Episodes
) -> Iterator[tuple[str, str, Callable[[], Any]]]:
    """Yield the name of each picture, its caption, and the call that draws it.

    Parameters
    ----------
    selection
        The chosen model.
    judged
        The same model as it was judged: of records fitted without their held-out ends.
    report
        Its trust report: errors, bands and residuals.
    plain
        Errors of x⁺ = A x + B u + c, which the model has to beat.
    held_out
        Episodes that no fit saw; the first three are forecast.
    """
    horizon = report.score.horizon
    finite = bool(np.isfinite(report.band.width).all())
    bands = report.band if finite else report.score
    around = "band that holds whole forecasts nine times in ten" if finite else "5 to 95 % of the errors"

    def errors() -> Any:
        named = {selection.best.kind: report.score}
        if selection.linear is not None and selection.linear is not selection.predictor:
            named["best linear"] = score(selection.linear, held_out, horizon)
        named["plain linear"] = plain
        return error(named, width="two columns")

    yield "error", "Errors on held-out episodes against the steps ahead, beside those of x⁺ = A x + B u + c.", errors
    for i, episode in enumerate(list(held_out)[:_ROLLOUTS]):
        caption = f"Forecast of held-out episode {i} from its start, and the {around}."
        yield f"rollout-{i}", caption, partial(rollout, judged, episode, horizon, bands, relift=report.band.relift)
    caption = "Eigenvalues of A and the unit circle; crosses are spurious on the held-out episodes."
    yield "spectrum", caption, partial(spectrum, judged, report.residuals)


def describe_data(split: DividedData) -> str:
    """Return lines on the data: sizes, sample time, names and ranges, and all repairs."""
    seen, X = split.seen, np.concatenate([e.X for e in split.seen])
    pairs = [("data", split.size), ("step", f"dt = {seen.dt:g} s")]
    V = np.concatenate([np.hstack([e.U, e.W]) for e in seen])
    for what, names, columns in (
        ("states", seen.states, X),
        ("inputs", seen.inputs, V[:, : seen.nu]),
        ("measured", seen.disturbances, V[:, seen.nu :]),
    ):
        wide = max(map(len, names), default=0)
        for i, name in enumerate(names):
            low, high = columns[:, i].min(), columns[:, i].max()
            pairs.append((what if i == 0 else "", f"{name:<{wide}}  {low:>9.3g} … {high:.3g}"))
        if not names and what == "inputs":
            pairs.append(("inputs", "none"))
    steps = sum(map(len, split.held_out))
    ahead = f"horizon {split.ahead} steps = {split.ahead * seen.dt:.3g} s"
    pairs.append(("held out", f"{len(split.held_out)} episodes, {steps} steps; {ahead}"))
    return "\n".join([render_text(label_lines(pairs)), *(f"! {note}" for note in split.notes)])


def _compare_with_plain(score: Score, plain: Score) -> str:
    """Return the last errors as shares of those of the plain linear fit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = score.rmse[-1] / plain.rmse[-1]
    named = ", ".join(f"{name} {share:.2g}" for name, share in zip(score.states, shares, strict=True))
    return f"RMSE {score.horizon} steps ahead over that of the plain linear fit x⁺ = A x + B u + c:\n  {named}"


def ignore_text(_: str) -> None:
    """Say nothing."""
