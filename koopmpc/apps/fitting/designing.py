"""design_data: from logs and a goal to a controller file with its report."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.apps.fitting.fit import Say, describe_data
from koopmpc.apps.fitting.goal import SHORT, list_goal_inputs, load_reading, load_toml, read_goal
from koopmpc.apps.fitting.logs import Data, DividedData, collect_notes, read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.apps.fitting.report import write_design_report
from koopmpc.base import disk
from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.base.parallel import StageProgress
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.files.columns import drop_unit
from koopmpc.guarantees.certify import CertifyOptions, certify
from koopmpc.lifting.state import Constant, State
from koopmpc.models.base import load_value
from koopmpc.models.fits.edmd import edmd
from koopmpc.synthesis.design import design
from koopmpc.synthesis.designed import Design, SavedDesign, rebuild_controller
from koopmpc.synthesis.doubts import describe_rest
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.search.recipe import get_model
from koopmpc.validate.bands import Forecast, forecast
from koopmpc.validate.logs.summary import LogSummary
from koopmpc.validate.report import trust
from koopmpc.validate.scoring import score

_CERTIFICATE = "certificate.md"  # states the certificate, beside its file


@dataclass(frozen=True, eq=False)
class DesignedData:
    """The design that was made, the controller file and the report, and lines of Python that load the controller."""

    design: Design
    controller: Path
    page: Path
    usage: str


def design_data(
    data: Data, goal: Path, folder: Path, wished: FitOptions, say: Say, progress: StageProgress | None
) -> DesignedData:
    """Read data and a goal, design a controller, and write controller.npz and report.html.

    What `wished` says of the logs replaces the section [logs] of the goal, and its margin and certificate those of the
    goal. Without ``inputs`` the inputs of the goal are inputs. A refused certificate is a sentence of the report. The
    other arguments are those of `fit_data`.
    """
    draw, pushed = np.random.default_rng(0), list_goal_inputs(goal)
    reading = load_reading(goal) | wished.list_reading()
    if wished.set_point:
        reading["disturbances"] = [*reading.get("disturbances", ()), *wished.set_point]
    split = _read_for(goal, data, draw, reading, ask=not pushed)
    missed = tuple(name for name in pushed if name in split.seen.states)
    if missed and "inputs" not in reading:  # the goal knows inputs that no name in the logs shows
        reading["inputs"] = (*split.seen.inputs, *missed)
        split = _read_for(goal, data, draw, reading)
    split, instruments = take_set_points(split, wished.set_point)
    about = describe_data(split)
    say(about)
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
    say(str(designed))
    evidence = designed.evidence
    if evidence.goal_can_be_held:
        say(describe_rest(evidence.surrogates, evidence.task))
    certified = ""
    if asked.certify:
        unseen = split.held_out if split.learned is None else None
        certified = describe_certificate(designed, asked.reference, unseen, folder)
        say(certified)
    file = folder / "controller.npz"
    summary = _summarise_logs(split, designed, about, goal.read_text(), draw)
    designed.save(file, logs=replace(summary, certified=certified))
    usage = f'import koopmpc as km\ncontroller = km.load_controller("{file.as_posix()}")'
    saved = load_value(file, SavedDesign)
    page = write_design_report(saved, rebuild_controller(saved, file), folder / "report.html", file.as_posix())
    return DesignedData(designed, file, page, usage)


def _read_for(
    goal: Path, data: Data, rng: np.random.Generator, reading: Mapping[str, Any], *, ask: bool = True
) -> DividedData:
    """Read logs to judge a model over the horizon of a goal, or over the usual one where they are too short for it."""
    wished = load_toml(goal).get("horizon")
    if not isinstance(wished, int) or wished < 1:  # none is given, or read_goal refuses it in a sentence
        return read_logs(data, None, rng, reading, SHORT, ask=ask)
    with suppress(DataError):
        return read_logs(data, wished, rng, reading, SHORT, ask=ask)
    split = read_logs(data, None, rng, reading, SHORT, ask=ask)
    note = f"the logs are too short to judge a model over the {wished} steps of the goal"
    return replace(split, notes=(*split.notes, note))


def _summarise_logs(
    split: DividedData, designed: Design, about: str, goal: str, rng: np.random.Generator, *, drawn: int = 3
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
            forecasts = [forecast(model, e, horizon, bands=bands, relift=relift) for e in list(held_out)[:drawn]]
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


def take_set_points(
    split: DividedData, names: Sequence[str]
) -> tuple[DividedData, list[Float[np.ndarray, "T nr"]] | None]:
    """Return the data without the columns of set points, and these columns for each fitted episode.

    The data were read with the set points among the measured disturbances; names may leave out units.
    """
    if not names:
        return split, None
    if not isinstance(split.fitted, Episodes):
        raise DataError("--set-point goes with logs that fit into memory; pass fewer logs")
    known = list(split.fitted.disturbances)
    stems, taken = [drop_unit(name) for name in known], list[int]()
    for name in names:
        if name not in known and stems.count(name.strip().lower()) != 1:
            raise DataError(f"the logs lack the column {name}; --set-point names columns of a table")
        taken.append(known.index(name) if name in known else stems.index(name.strip().lower()))
    kept = [i for i in range(len(known)) if i not in taken]

    def drop(episodes: Episodes) -> Episodes:
        left = [Episode(X=e.X, U=e.U, W=e.W[:, kept]) for e in episodes]
        return Episodes(left, episodes.dt, episodes.states, episodes.inputs, tuple(known[i] for i in kept))

    fitted, seen, held_out = map(drop, (split.fitted, split.seen, split.held_out))
    signals = [e.W[:, taken] for e in split.fitted]
    return replace(split, fitted=fitted, seen=seen, held_out=held_out, learned=None), signals


def describe_certificate(
    design: Design, reference: Float[np.ndarray, "..."], unseen: Episodes | None, folder: Path
) -> str:
    """Seek a certificate at the reference, write its file and page, and return what came of it in a sentence."""
    evidence, model = design.evidence, get_model(design.controller)
    why = _explain_unfit(design, reference)
    if why or unseen is None or not len(unseen):
        why = why or "no log is left that the model was not fitted to; record more episodes"
        return f"No certificate: {why}."
    rest = evidence.surrogates[0].holding(evidence.task.cost, evidence.task.limits)(evidence.task.reference[0])
    limits = evidence.task.limits
    try:
        certificate = certify(
            model,
            model.align(unseen),
            limits,
            x=np.asarray(rest.x)[: model.nx],
            u=np.asarray(rest.u),
            options=CertifyOptions(estimated=True),
        )
    except KoopmpcError as error:
        return f"{str(error)[0].upper()}{str(error)[1:]}."
    certificate.save(folder / "certificate.npz")
    with disk.writing(folder / _CERTIFICATE) as stream:
        stream.write(certificate.page().encode())
    return (
        f"A feedback on the chosen model has a certificate around the reference: {_CERTIFICATE} states it with its"
        " assumptions, certificate.npz holds it. It is a certificate of that feedback, and not of the predictive"
        " controller."
    )


def _explain_unfit(design: Design, reference: Float[np.ndarray, "..."]) -> str:
    """Return why a certificate cannot be sought at all; empty if it can."""
    asked, model = design.evidence.task, get_model(design.controller)
    of = asked.cost.of.bind(model.states)
    if design.best.recipe.feedthrough:
        return "the inputs act on outputs at once, and a certificate is of a state that a controller reads"
    if model.embedding is not None:
        return "the chosen model holds past rows, and a certificate is of a model of the present state"
    if np.ndim(reference) > 1:
        return "the reference moves, and a certificate is of one set point"
    if not isinstance(of, State):
        return "the cost tracks other observables than states, so the set point is not given"
    return ""
