"""prepare_data: the data of a search: a sample without glitches, inputs in time, noise and feedback taken out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError, hide_fit_warnings
from koopmpc.base.parallel import Progress, StageProgress
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.state import Constant, State
from koopmpc.models.base import change_model
from koopmpc.models.fits.edmd import edmd
from koopmpc.synthesis.options import SearchOptions
from koopmpc.synthesis.search.candidates import check_delays
from koopmpc.synthesis.search.data import advance_inputs, is_record, replace_glitches, smooth_data, take_sample
from koopmpc.synthesis.search.feedback import remove_feedback
from koopmpc.synthesis.search.folds import cut_blocks
from koopmpc.synthesis.search.records import is_late
from koopmpc.validate.memory import Memory, find_hidden_state
from koopmpc.validate.scoring import AnyPredictor, score

_NEAR = 10  # steps of the forecasts that say whether more of the past is worth a trial
_GAINS = 0.9  # it is, where two past steps lower the error of one to this share
_LONGER = (4,)  # then these are tried too
_EPISODES = 8  # of which a quarter is forecast
LATE_COLUMN = (
    "the inputs were moved up by one row: the log's row k holds the outputs after its inputs have acted; "
    "model.align(logs) does the same to other logs"
)


@dataclass(frozen=True, eq=False)
class PreparedData:
    """The data of a search, and what was done to them."""

    # source, held: what the chosen model is fitted to, and the episodes that the choice uses; smoothed where noise
    # was found
    source: Source
    held: Episodes
    # measured_source, measured: the same before they were smoothed
    measured_source: Source
    measured: Episodes
    noise: Float[np.ndarray, " nx"]  # (nx,) standard deviation of the noise that was taken out
    noisy: bool  # noise is still to be looked for
    record: bool  # the data are a few long records and no candidates were given
    lead: int  # rows by which the inputs were moved up
    moved: str  # sentence on these, for the report of a model
    # sampled, notes: the sentence on the sample, and all sentences on what was done
    sampled: tuple[str, ...]
    notes: tuple[str, ...]

    def mark(self, model: AnyPredictor) -> AnyPredictor:
        """Return a model whose report says how the inputs were moved."""
        report = model.report
        if not self.lead or report is None:
            return model
        return change_model(model, report=replace(report, input_lead=self.lead, changes=(*report.changes, self.moved)))


def prepare_data(data: Episodes | Source, options: SearchOptions, *, feedback: bool, feedthrough: str) -> PreparedData:
    """Return a sample of the data without glitches, with inputs in time, and without noise that feedback carries."""
    used, noise, smooth = "", None, bool(options.smooth)
    if options.instruments is not None or (smooth and feedback and isinstance(data, Episodes)):
        checks.kind(data, "the data", Episodes, "instruments go with episodes; load the source, or leave them out")
        loop = remove_feedback(cast("Episodes", data), options.instruments)
        data, noise, used = loop.episodes, loop.noise, loop.sentence
        smooth = smooth and not noise.any()
    source = source_of(data)
    if options.feedthrough and not source.nu:
        raise DataError("feedthrough says how inputs act, and the data have none; give each Episode its U")
    held, sampled = take_sample(source, options.sample)
    notes = (*sampled, used) if used else sampled
    record = options.candidates is None and is_record(held)
    if smooth:
        source, held, replaced = replace_glitches(source, held)
        notes = (*notes, *replaced)
    lead = int(options.feedthrough or (record and is_late(held)))
    moved = feedthrough if options.feedthrough else LATE_COLUMN
    if lead:
        source, held = advance_inputs(source, held)
        notes = (*notes, moved)
    noise = np.zeros(held.nx) if noise is None else noise
    return PreparedData(source, held, source, held, noise, smooth, record, lead, moved, sampled, notes)


def take_out_noise(data: PreparedData) -> PreparedData:
    """Return the data smoothed, where noise is to be looked for and found."""
    if not data.noisy:
        return data
    source, held, freed, noise = smooth_data(data.source, data.held)
    return replace(data, source=source, held=held, noise=noise, notes=(*data.notes, *freed))


def extend_past(past: Sequence[int], learned: Episodes, measured: Episodes) -> list[int]:
    """Return the past steps to try where a hidden state shows: more if two of them forecast better than one.

    Linear models of the `learned` rows forecast `measured` rows of every fourth episode, which they did not see: of
    smoothed rows a model would know from the past what only the future told. Fewer than eight episodes are cut into
    blocks; where these are too short, more past steps are tried.
    """
    if len(measured) < _EPISODES:
        share = -(-_EPISODES // len(measured))
        learned, measured = (
            each.with_episodes([block for e in each for block in cut_blocks(e, max(len(e) // share, 1))])
            for each in (learned, measured)
        )
    unseen = [i for i, e in enumerate(measured) if i % 4 == 0 and len(e) > 3 * max(past)]
    if len(unseen) < 2:
        return [*past, *_LONGER]
    seen = learned.with_episodes([e for i, e in enumerate(learned) if i % 4])
    ahead = min(_NEAR, min(len(measured[i]) for i in unseen) - 2)
    errors: list[float] = []
    with hide_fit_warnings():
        for steps in (1, 2):
            model = edmd(seen, State() + Constant(), embedding=Delay(steps))
            same = measured.with_episodes([measured[i].cut(2 - steps, len(measured[i])) for i in unseen])
            errors.append(float(np.mean(score(model, same, ahead).rmse)))
    return [*past, *_LONGER] if errors[1] < _GAINS * errors[0] else list(past)


def list_delays(data: PreparedData, delays: Sequence[int] | None) -> tuple[list[int], Memory | None]:
    """Return the past steps to try, and what shows a hidden state; None where nothing does."""
    past = check_delays((0, 1, 2) if delays is None else delays)
    memory = find_hidden_state(data.measured) if max(past) else None
    if memory is None or not memory.shows_hidden_state:
        return past, None
    return past if delays is not None else extend_past(past, data.held, data.measured), memory


def report_stage(progress: StageProgress | None, name: str) -> Progress | None:
    """Return what is called with the progress of one stage."""
    return None if progress is None else partial(progress, name)
