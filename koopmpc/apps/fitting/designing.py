"""design_data: from logs and a goal to a controller file with its report."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.apps.fitting.certified import describe_certificate
from koopmpc.apps.fitting.fit import Say, describe_data, ignore_text
from koopmpc.apps.fitting.goal import SHORT, Goal, list_goal_inputs, load_reading, load_toml, read_goal
from koopmpc.apps.fitting.logs import IN_MEMORY, Data, DividedData, collect_notes, read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.apps.fitting.report import write_design_report
from koopmpc.apps.fitting.set_points import take_set_points
from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.base.parallel import StageProgress
from koopmpc.lifting.state import Constant, State
from koopmpc.models.base import load_value
from koopmpc.models.fits.edmd import edmd
from koopmpc.synthesis.design import design
from koopmpc.synthesis.designed import Design, SavedDesign, rebuild_controller
from koopmpc.synthesis.doubts import describe_rest
from koopmpc.synthesis.options import DesignOptions
from koopmpc.validate.bands import Forecast, forecast
from koopmpc.validate.logs.summary import LogSummary
from koopmpc.validate.report import trust
from koopmpc.validate.scoring import score


@dataclass(frozen=True, eq=False)
class DesignedData:
    """The design that was made, and the files that were written.

    Attributes
    ----------
    design
        The controller with its evidence.
    goal
        The goal that was read.
    controller, page
        Paths of the controller file, and of the report, one HTML page that needs no other file.
    usage
        Lines of Python that load the controller.
    """

    design: Design
    goal: Goal
    controller: Path
    page: Path
    usage: str


def design_data(
    data: Data,
    goal: str | PathLike[str],
    folder: str | PathLike[str],
    options: FitOptions | None = None,
    *,
    memory: int = IN_MEMORY,
    say: Say | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
) -> DesignedData:
    """Read data and a goal, design a controller, and write controller.npz and report.html.

    The data are read and repaired as by `fit_data`; the other arguments are the same as there.

    Parameters
    ----------
    data, folder
        As for `fit_data`.
    goal
        A file as `write_template` writes it.
    options
        How the logs are read, which models are tried, and what is asked beside the goal, see `FitOptions`. What it says
        of the logs replaces the section [logs] of the goal, and its margin and certificate those of the goal. Without
        ``inputs`` the inputs of the goal are inputs. A refused certificate is a sentence of the report.
    memory, say, progress, rng
        As for `fit_data`.

    Raises
    ------
    LogError
        A file cannot be read, or the folder not written.
    DataError
        The data are not of one plant, or too few; the goal names what the data do not have.
    """
    place, draw, wished = Path(folder), checks.generator(rng), options or FitOptions()
    tell, pushed = ignore_text if say is None else say, list_goal_inputs(goal)
    reading = load_reading(goal) | wished.list_reading()
    if wished.set_point:
        reading["disturbances"] = [*reading.get("disturbances", ()), *wished.set_point]
    split = _read_for(goal, data, draw, memory, reading, ask=not pushed)
    missed = tuple(name for name in pushed if name in split.seen.states)
    if missed and "inputs" not in reading:  # the goal knows inputs that no name in the logs shows
        reading["inputs"] = (*split.seen.inputs, *missed)
        split = _read_for(goal, data, draw, memory, reading)
    split, instruments = take_set_points(split, wished.set_point)
    about = describe_data(split)
    tell(about)
    asked = read_goal(goal, split.seen)
    asked = replace(asked, margin=wished.margin or asked.margin, certify=wished.certify or asked.certify)
    with collect_notes([]):  # its advice says the same
        designed = design(
            split.fitted,
            asked.cost,
            asked.limits,
            horizon=asked.horizon,
            reference=asked.reference,
            options=DesignOptions(
                angles=asked.angles,
                bilinear=not wished.linear,
                feedthrough=wished.feedthrough,
                instruments=instruments,
                margin=asked.margin or "errors",
                workers=wished.workers,
                scheduler=wished.scheduler,
                progress=progress,
                rng=draw,
            ),
        )
    tell(str(designed))
    evidence = designed.evidence
    if evidence.goal_can_be_held:
        tell(describe_rest(evidence.surrogates, evidence.task))
    certified = ""
    if asked.certify:
        unseen = split.held_out if split.learned is None else None
        certified = describe_certificate(designed, asked.reference, unseen, place)
        tell(certified)
    file = place / "controller.npz"
    summary = _summarise_logs(split, designed, about, Path(goal).read_text(), draw)
    designed.save(file, logs=replace(summary, certified=certified))
    usage = f'import koopmpc as km\ncontroller = km.load_controller("{file.as_posix()}")'
    saved = load_value(file, SavedDesign)
    page = write_design_report(saved, rebuild_controller(saved, file), place / "report.html", file.as_posix())
    return DesignedData(designed, asked, file, page, usage)


def _read_for(
    goal: str | PathLike[str],
    data: Data,
    rng: np.random.Generator,
    memory: int,
    reading: Mapping[str, Any],
    *,
    ask: bool = True,
) -> DividedData:
    """Read logs to judge a model over the horizon of a goal, or over the usual one where they are too short for it."""
    wished = load_toml(Path(goal)).get("horizon")
    if not isinstance(wished, int) or wished < 1:  # none is given, or read_goal refuses it in a sentence
        return read_logs(data, None, rng, memory, reading, SHORT, ask=ask)
    with suppress(DataError):
        return read_logs(data, wished, rng, memory, reading, SHORT, ask=ask)
    split = read_logs(data, None, rng, memory, reading, SHORT, ask=ask)
    note = f"the logs are too short to judge a model over the {wished} steps of the goal"
    return replace(split, notes=(*split.notes, note))


_FORECASTS = 3  # held-out stretches whose forecasts a report may draw


def _summarise_logs(
    split: DividedData,
    designed: Design,
    about: str,
    goal: str,
    rng: np.random.Generator,
) -> LogSummary:
    """Return what a report shows of the logs, with forecasts of rows that the chosen model did not learn from."""
    assert split.excerpt is not None, "divide_files makes it"
    model, horizon = designed.controller.as_data().model, split.ahead
    assert model is not None, "every design has a model"
    align = model.align
    forecasts, findings = list[Forecast](), list[str]()
    error = plain = np.zeros((0, model.nx))
    with collect_notes([]):  # the fits repeat the doubts of the design
        try:
            if split.learned is not None:  # a record: the controller's model knows its end
                model = designed.best.recipe.fit(align(split.learned))
            seen, held_out = (align(data) for data in (split.seen, split.held_out))
            report = trust(model, held_out, horizon, rng=rng)
            verdict, error = str(report).partition("\n")[0], report.score.rmse
            findings = [f"{finding.says}; {finding.do}" for finding in report.findings]
            plain = score(edmd(seen, State() + Constant()), held_out, horizon).rmse
            bands = report.band if np.isfinite(report.band.width).all() else report.score
            relift = report.band.relift
            forecasts = [forecast(model, e, horizon, bands=bands, relift=relift) for e in list(held_out)[:_FORECASTS]]
        except KoopmpcError as failure:  # the report is to say so, and a design is not to be lost for it
            verdict = f"Its forecasts could not be judged: {failure}"
    return LogSummary(
        excerpt=split.excerpt,
        about=about.partition("\n! ")[0],
        notes=(*split.notes, *designed.notes),
        verdict=verdict,
        findings=tuple(findings),
        forecasts=tuple(forecasts),
        error=error,
        plain=plain,
        title=designed.best.title,
        advice=designed.advice,
        choice=str(designed),
        goal=goal,
    )
