"""The pictures of a fit: errors by horizon, forecasts and spectrum, each with its caption."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from koopmpc.data.episodes import Episodes
from koopmpc.figures.comparisons import error
from koopmpc.figures.eigenvalues import spectrum
from koopmpc.figures.series import rollout
from koopmpc.synthesis.selection import Selection
from koopmpc.validate.report import TrustReport
from koopmpc.validate.scoring import Score, score

_ROLLOUTS = 3  # held-out episodes that are drawn


def drawn(
    selection: Selection, report: TrustReport, plain: Score, held_out: Episodes
) -> Iterator[tuple[str, str, Callable[[], Any]]]:
    """Yield the name of each picture, its caption, and the call that draws it.

    Parameters
    ----------
    selection
        The chosen model.
    report
        Its trust report: errors, bands and residuals.
    plain
        Errors of x⁺ = A x + B u + c, which the model has to beat.
    held_out
        Episodes that no fit saw; the first three are forecast.
    """
    predictor, horizon = selection.predictor, selection.horizon
    finite = bool(np.isfinite(report.band.width).all())
    bands = report.band if finite else report.score
    around = "band that holds whole forecasts nine times in ten" if finite else "5 to 95 % of the errors"

    def errors() -> Any:
        named = {selection.best.kind: report.score}
        if selection.linear is not None and selection.linear is not predictor:
            named["best linear"] = score(selection.linear, held_out, horizon)
        named["plain linear"] = plain
        return error(named, width="two columns")

    yield "error", "Errors on held-out episodes against the steps ahead, beside those of x⁺ = A x + B u + c.", errors
    for i, episode in enumerate(list(held_out)[:_ROLLOUTS]):
        caption = f"Forecast of held-out episode {i} from its start, and the {around}."
        yield f"rollout-{i}", caption, partial(rollout, predictor, episode, horizon, bands)
    caption = "Eigenvalues of A and the unit circle; crosses are spurious on the held-out episodes."
    yield "spectrum", caption, partial(spectrum, predictor, report.residuals)
