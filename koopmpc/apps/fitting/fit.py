"""fit_data: from a file or a folder of logs to a model file, with its report, its pictures and its Rerun log."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.apps.fitting.logs import PAST, Data, DividedData, collect_notes, read_logs
from koopmpc.apps.fitting.options import FitOptions
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
LINEAR = "linear.npz"  # beside a bilinear model.npz


@dataclass(frozen=True, eq=False)
class FittedData:
    """The files that a fit wrote."""

    model: Path
    recording: Path | None  # the Rerun log, None where it could not be written
    page: Path  # the report, in Markdown
    usage: str  # lines of Python that load the model; where it is bilinear also the best linear one
    failures: tuple[str, ...]  # pictures, or the log, that could not be made, and why


def fit_data(data: Data, folder: Path, asked: FitOptions, say: Say, progress: StageProgress | None) -> FittedData:
    """Read data, hold some out, choose and fit a model, judge it, and write model.npz, report.md and model.rrd.

    Of a folder of runs only the .rrd logs are read. If a bilinear model is chosen, the best linear one goes to
    linear.npz. `say` is called with each paragraph of text as it is known, `progress` as in `select`.
    """
    draw = np.random.default_rng(0)
    split = read_logs(data, asked.horizon, draw, asked.list_reading())
    about = describe_data(split)
    say(about)
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
    model = folder / "model.npz"
    selection.predictor.save(model)
    if selection.linear is not None and selection.linear is not selection.predictor:
        selection.linear.save(folder / LINEAR)
    chosen = "\n".join([str(selection), *(f"! {doubt}" for doubt in doubts)])
    say(chosen)
    with collect_notes([]):  # the fits repeat the doubts that stand above
        judged = selection.predictor if split.learned is None else fit_again(selection, split.learned)
        seen, held_out = (judged.align(data) for data in (split.seen, split.held_out))
        report = trust(judged, held_out, split.ahead, train=seen, rng=draw)
        plain = score(edmd(seen, State() + Constant()), held_out, split.ahead)
    verdict = f"{report}\n\n{_compare_with_plain(report.score, plain)}"
    say(verdict)
    failures: list[str] = []
    recording = folder / "model.rrd"
    try:
        record_model(judged, held_out, recording, report=report)
    except FullDiskError:
        raise
    except Exception as failure:  # a log that cannot be written must not cost the model
        failures.append(f"{recording.name}: {type(failure).__name__}: {failure}")
    usage, pictures = _format_usage(selection, model), list_pictures(selection, judged, report, plain, held_out)
    page = _write_page(Page(folder), (verdict, usage, about, chosen), pictures, failures)
    return FittedData(
        model=model,
        recording=recording if recording.exists() else None,
        page=page,
        usage=usage,
        failures=tuple(failures),
    )


def _write_page(
    page: Page,
    texts: tuple[str, str, str, str],
    pictures: Iterable[tuple[str, str, Callable[[], Any]]],
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

    `judged` is the chosen model as it was judged: of records fitted without their held-out ends. `plain` are the errors
    of x⁺ = A x + B u + c. The first three held-out episodes are forecast.
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
    for i, episode in enumerate(list(held_out)[:3]):
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
