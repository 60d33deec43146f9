# pyright: basic
"""record_model: a predictor and how far it can be trusted, as one Rerun log."""

import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.text import format_markdown_table, shorten_observable
from koopmpc.data.episodes import Episodes
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.bands import Bands, Forecast, forecast
from koopmpc.validate.report import TrustReport
from koopmpc.validate.residuals import ResidualDMD
from koopmpc.validate.scoring import AnyPredictor, Score, score
from koopmpc.views.figures.eigenvalues import Axes, Plane, evaluate_eigenfunctions, make_plane
from koopmpc.views.figures.style import CYCLIC, SEQUENTIAL, map_colors
from koopmpc.views.recording.blueprint import draw_eigenvalues, eigenvalue_views, plane_view
from koopmpc.views.recording.description import Entity, drawable, written_with
from koopmpc.views.recording.plots import INK, Curve, Plot, Series, color, frame_views, shared_time
from koopmpc.views.recording.rrd import LogColumns, RerunLog

_PREDICTED = color(0)
_STYLE_SIGNS = re.compile(r"([*_`])")  # Markdown would read these signs as style: each gets a backslash
_FORMAT = "koopmpc-model-1"

Picture = tuple[str, str, dict[str, Any]]  # entity, title, archetypes by entity


@raise_swallowed()  # Python drops a Ctrl-C that comes while a recording is deleted
def record_model(
    predictor: AnyPredictor,
    episodes: Episodes,
    path: str | Path,
    *,
    report: TrustReport | None = None,
    horizon: int | None = None,
    rollouts: int = 3,
    which: Sequence[int] | None = None,
    plane: Axes = (0, 1),
    at: ArrayLike | None = None,
) -> None:
    """Write spectrum, eigenfunctions, forecasts, error by horizon and the report of a predictor to one .rrd.

    Series stand over `sim_time`, the time ahead of the forecast's start. The data are in the log to the bit.

    Parameters
    ----------
    predictor
        Linear or bilinear; a bilinear one has no eigenfunctions.
    episodes
        Held out of the fit; the first ones are forecast from their start.
    path
        The .rrd to write; its folders are made.
    report
        The report of `trust`, whose residuals, errors, bands and text are shown.
    horizon
        Steps ahead; the report's by default, else as long as the shortest episode.
    rollouts
        How many episodes are forecast.
    which
        Eigenfunctions, in the order of ``predictor.eigenvalues``; by default the first two, those with the
        smallest residuals where there is a report, and one of each conjugate pair.
    plane
        Two states, by index or name; the ranges are those of the episodes.
    at
        (nx,) values of the other states; the median of the episodes by default.

    Raises
    ------
    DataError
        The horizon is longer than an episode; there is no such state or eigenfunction.
    LogError
        The path cannot be written.
    """
    import rerun as rr

    if horizon is None:
        horizon = min(map(len, predictor.embed(episodes))) if report is None else report.score.horizon
    errors, bands, residuals, relift = _find_trust(predictor, episodes, horizon, report)
    chosen = list(episodes)[: checks.count(rollouts, "rollouts")]
    ahead = [forecast(predictor, episode, horizon, bands=bands, relift=relift) for episode in chosen]
    pictures, surface, note = _pictures(predictor, episodes, report, which, plane, at)
    tabs = {
        f"Forecast of episode {r}": _plot_forecast(predictor, one, f"rollout/{r}") for r, one in enumerate(ahead)
    } | {"Error by time ahead": _plot_errors(errors, predictor)}
    facts = _facts(predictor) | {"horizon": horizon, "band": ahead[0].band if ahead else ""}
    about = {"format": _FORMAT, "written_with": written_with(), "dt": predictor.dt, "facts": facts}
    about |= {"states": list(predictor.states), "forecasts": len(ahead)}
    drawn = draw_eigenvalues(predictor, residuals)
    with RerunLog("koopmpc-model", path=path) as log:
        log.lay_out(_lay_out(predictor, horizon, tabs, pictures, surface, told=residuals is not None))
        log.rec.send_recording_name(drawable(f"model of {', '.join(predictor.states)}"))
        log.page("report", _page(predictor, report, note))
        log.style(Entity.DESCRIPTION, rr.AnyValues(json=json.dumps(about, ensure_ascii=False)))
        for parts in (drawn, *(parts for *_, parts in pictures)):
            for entity, archetype in parts.items():
                log.style(entity, archetype)
        for plot in chain.from_iterable(tabs.values()):
            for series in plot.series:
                series.write(log)


def _find_trust(
    predictor: AnyPredictor, episodes: Episodes, horizon: int, report: TrustReport | None
) -> tuple[Score, Bands, ResidualDMD | None, bool]:
    """Return the errors, the bands and the residuals to show, and whether forecasts are lifted again at each step."""
    if report is not None:
        return report.score, report.band, report.residuals, report.band.relift
    relift = isinstance(predictor, BilinearPredictor)
    errors = score(predictor, episodes, horizon, relift=relift)
    return errors, errors, None, relift


def _plot_forecast(predictor: AnyPredictor, ahead: Forecast, entity: str) -> list[Plot]:
    """Return a plot a state of truth, prediction and, where it is finite, the band; and one of all inputs."""
    plots: list[Plot] = []
    for i, name in enumerate(predictor.states):
        curves: list[Curve] = [("prediction", _PREDICTED, 3.0, ahead.predicted[:, i])]
        known, band = np.isfinite(ahead.predicted[:, i]), {"low": ahead.low[:, i], "high": ahead.high[:, i]}
        if ahead.band and all(np.isfinite(values[known]).all() for values in band.values()):
            curves += [(f"{ahead.band}, {end}", INK.band, 1.0, values) for end, values in band.items()]
        curves.append(("truth", INK.truth, 1.2, ahead.truth[:, i]))  # thin, and over the prediction
        at = f"{entity}/state/{i}"
        plots.append(Plot(at, name, [Series(at, curves, predictor.dt)], legend=i == 0))
    if predictor.nu:
        curves = [(name, color(1 + j), 2.0, ahead.U[:, j]) for j, name in enumerate(ahead.inputs)]
        series = Series(f"{entity}/inputs", curves, predictor.dt, held=True)
        plots.append(Plot(series.entity, ", ".join(predictor.inputs), [series], legend=predictor.nu > 1))
    return plots


def _plot_errors(score: Score, predictor: AnyPredictor) -> list[Plot]:
    """Return a plot a state of the root-mean-square error and the 5 and 95 % quantiles of the errors."""
    plots: list[Plot] = []
    for i, name in enumerate(predictor.states):
        curves: list[Curve] = [
            ("RMSE", _PREDICTED, 2.5, score.rmse[:, i]),
            ("5 % of the errors", INK.band, 1.0, score.low[:, i]),
            ("95 % of the errors", INK.band, 1.0, score.high[:, i]),
        ]
        series = Series(f"error/{i}", curves, predictor.dt, first=1)
        plots.append(Plot(series.entity, f"Error of {name}, by time ahead", [series], legend=i == 0))
    return plots


def _pictures(
    predictor: AnyPredictor,
    episodes: Episodes,
    report: TrustReport | None,
    which: Sequence[int] | None,
    plane: Axes,
    at: ArrayLike | None,
) -> tuple[list[Picture], Plane | None, str]:
    """Return pictures of eigenfunctions, their plane, and the reason where there are none."""
    if not isinstance(predictor, LinearPredictor) or (predictor.nx < 2 and which is None):
        why = "has no eigenfunctions" if predictor.nx > 1 else "has one state: there is no plane to draw them on"
        if which is not None:
            raise DataError("a bilinear predictor has no eigenfunctions; leave `which` out")
        return [], None, f"The predictor {why}."
    surface = make_plane(predictor.point_names, plane, predictor.embed(episodes), at, points=181)
    chosen = _leading(predictor, report) if which is None else list(which)
    try:
        return _eigenfunctions(predictor, chosen, surface), surface, ""
    except DataError as error:
        if which is not None:
            raise
        return [], None, f"No eigenfunctions are drawn: {error}."


def _eigenfunctions(predictor: LinearPredictor, which: Sequence[int], plane: Plane) -> list[Picture]:
    """Return the pictures of eigenfunctions: of a real one itself, of a complex one its magnitude and its phase."""
    pictures: list[Picture] = []
    for j, phi in zip(which, evaluate_eigenfunctions(predictor, which, plane), strict=True):
        value = predictor.eigenvalues[j]
        if value.imag == 0:
            low, high = float(phi.real.min()), float(phi.real.max())
            level = (phi.real - low) / ((high - low) or 1.0)
            shown = {"value": (f"φ{j}, λ = {value.real:.4g}", map_colors(level, SEQUENTIAL))}
        else:
            title = f"|φ{j}|, λ = {value.real:.4g} {'+' if value.imag > 0 else '−'} {abs(value.imag):.4g}i"
            turns = np.angle(phi) / (2 * np.pi) + 0.5  # dark at 0, blue below, red above, light at ±π
            shown = {
                "magnitude": (title, map_colors(np.abs(phi), SEQUENTIAL)),
                "phase": (f"Phase of φ{j}", map_colors(turns, CYCLIC)),
            }
        for part, (title, pixels) in shown.items():
            entity = f"eigenfunction/{j}/{part}"
            pictures.append((entity, title, _picture(entity, pixels, plane)))
    return pictures


def _picture(entity: str, pixels: np.ndarray, plane: Plane) -> dict[str, Any]:
    """Return the picture, rows from the top down, and its axes in words."""
    import rerun as rr

    m, n = pixels.shape[:2]
    (x, y), across, up = map(drawable, plane.names), plane.across, plane.up
    words = {
        (0.04 * n, 1.06 * m): f"{across[0]:.3g}",
        (0.5 * n, 1.14 * m): x,
        (1.0 * n, 1.06 * m): f"{across[-1]:.3g}",
        (-0.09 * n, 0.96 * m): f"{up[0]:.3g}",
        (-0.15 * n, 0.5 * m): y,
        (-0.09 * n, 0.04 * m): f"{up[-1]:.3g}",
    }
    return {
        f"{entity}/picture": rr.Image(np.ascontiguousarray(pixels[::-1])),
        f"{entity}/axes": rr.Points2D(
            list(words), labels=list(words.values()), radii=0.0, colors=INK.prediction, show_labels=True, draw_order=40
        ),
    }


def _leading(predictor: LinearPredictor, report: TrustReport | None) -> list[int]:
    """Return a few eigenpairs, one of each conjugate pair: the most trusted, or the slowest."""
    values = predictor.eigenvalues
    order = np.arange(len(values))
    if report is not None:
        near = np.abs(values[:, None] - report.residuals.eigenvalues).argmin(axis=1)
        order = np.argsort(report.residuals.residuals[near], kind="stable")
    moving = [int(j) for j in order if values[j].imag >= 0 and abs(values[j] - 1) > 1e-9]  # λ = 1: often φ = 1
    return moving[:2] or [0]  # drawn unless told


def _page(predictor: AnyPredictor, report: TrustReport | None, note: str) -> str:
    """Return the page beside the plots: the report of `trust`, a note on pictures, and a table of the model."""
    lines = [f"# Model of {', '.join(predictor.states)}", ""]
    if report is not None:
        lines += ["```", str(report), "```", ""]
    lines += [
        note or "Eigenfunctions: dark is the least value, light the largest; of a phase, dark is 0, light ±π.",
        "",
    ]
    table = format_markdown_table(
        ("model", ""), [(key, _STYLE_SIGNS.sub(r"\\\1", value)) for key, value in _facts(predictor).items()]
    )
    return "\n".join([*lines, table])


def _facts(predictor: AnyPredictor) -> dict[str, str]:
    """Return what the model is, and how it was fitted, in words."""
    rows = {
        "kind": type(predictor).__name__,
        "inputs": ", ".join(predictor.inputs) or "none",
        "sampling time": f"{predictor.dt:g} s",
        "observables": f"{predictor.nz}: {', '.join(map(shorten_observable, predictor.lifting.names[:12]))}"
        + (" …" if predictor.nz > 12 else ""),
        "spectral radius": f"{abs(predictor.eigenvalues[0]):.6g}",
    }
    if predictor.report is not None:
        fit = predictor.report
        rows |= {
            "fit": f"{fit.method}, {fit.route}",
            "snapshots": f"{fit.samples}",
            "condition": f"{fit.condition:.3g}",
        }
        rows |= {f"doubt {i + 1}": doubt for i, doubt in enumerate(fit.warnings)}
    return rows


def _lay_out(
    predictor: AnyPredictor,
    horizon: int,
    tabs: Mapping[str, Sequence[Plot]],
    pictures: Sequence[Picture],
    surface: Plane | None,
    *,
    told: bool,
) -> Any:
    """Return the layout: a tab for each group of plots, of the first few states; eigenvalues, pictures and the page."""
    import rerun.blueprint as rrb

    time = shared_time((horizon + 1) * predictor.dt)
    left = rrb.Tabs(
        *(
            rrb.Vertical(*(plot.view("LeftTop", axis_x=time) for plot in _choose_plots(plots)), name=name)
            for name, plots in tabs.items()
        )
    )
    rows: list[Any] = [rrb.Horizontal(*eigenvalue_views(predictor, residuals=told))]
    if surface is not None:
        n, m = len(surface.across), len(surface.up)
        room = [-0.3 * n, 1.1 * n], [-0.08 * m, 1.25 * m]  # for the words around a picture
        views = [plane_view(entity, drawable(title), *room) for entity, title, _ in pictures]
        rows.append(rrb.Grid(*views, grid_columns=min(len(views), 2)))
    text = rrb.TextDocumentView(origin="report", name="Report")
    right = rrb.Vertical(*rows, text, row_shares=[*[3.0, 4.0][: len(rows)], 3.0])
    return frame_views(rrb.Horizontal(left, right, column_shares=[1.0, 1.2]))


def _choose_plots(plots: Sequence[Plot], most: int = 6) -> list[Plot]:
    """Return the plots of the first states, at most so many, and that of the inputs."""
    return [plot for i, plot in enumerate(plots) if i < most or plot.entity.endswith("inputs")]


@dataclass(frozen=True, eq=False)
class ModelLog:
    """What the log of a model holds: `facts` in words, and curves.

    `errors` has the root-mean-square error of each state 1, 2, … steps ahead. By the numbers of an episode and a state,
    `forecasts` has the prediction, the truth and, where there is one, the band (T+1, 2).
    """

    facts: Mapping[str, str]
    states: tuple[str, ...]
    dt: float
    errors: tuple[np.ndarray, ...]
    forecasts: Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray | None]]


def load_model_log(path: str | Path) -> ModelLog:
    """Return what `record_model` wrote about a model.

    Raises
    ------
    LogError
        The file is missing or damaged, or no log of a model whose format this version knows.

    Warns
    -----
    UserWarning
        The end of the file is cut.
    """
    log = LogColumns(Path(path), Entity.DESCRIPTION, "error/**", "rollout/**")
    with log.reading():
        if not log.closed:
            warnings.warn(f"{path}: its end is cut; take another copy, curves may lack rows", UserWarning, stacklevel=2)
        text = log.static(Entity.DESCRIPTION, "json")
        about: dict[str, Any] = {} if text is None else json.loads(text)
        if about.get("format") != _FORMAT:
            raise LogError(f"{path} holds no model that this koopmpc reads: its format is {about.get('format')!r}")
        errors = [log.matrix(f"error/{i}")[1][:, 0] for i in range(len(about["states"]))]
        forecasts = {}
        for r in range(about["forecasts"]):
            for i in range(len(about["states"])):
                curves = log.matrix(f"rollout/{r}/state/{i}")[1]
                forecasts[r, i] = curves[:, 0], curves[:, -1], curves[:, 1:3] if curves.shape[1] > 2 else None
        facts = {name: str(value) for name, value in about["facts"].items() if value != ""}
        return ModelLog(facts, tuple(about["states"]), float(about["dt"]), tuple(errors), forecasts)
