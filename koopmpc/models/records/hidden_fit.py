"""One fit for hidden states: a linear start, then products or neurons, each stage by simulation error over segments."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.data.episodes import Episodes
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.conversion import SignalUnits, cut_segments, from_standard, to_standard
from koopmpc.models.records.hidden import (
    HiddenModel,
    RecordSegments,
    Sets,
    SimulationError,
    bound_states,
    join_segments,
    start_states,
)
from koopmpc.models.records.hidden_structure import (
    HiddenStructure,
    is_calm_hidden,
    measure_hidden,
    report_fit,
    thin_records,
)
from koopmpc.models.records.neurons import (
    ContainedError,
    contain,
    draw_neurons,
    smooth_basis,
    start_with_differences,
    take_neurons,
)
from koopmpc.models.records.structure import HORIZON, find_forecast_horizon
from koopmpc.models.records.subspace import build_realisation, compute_block_moments
from koopmpc.models.records.unseen import cut_quarter
from koopmpc.models.shared.levenberg_marquardt import PATIENCE, minimise


@dataclass(frozen=True)
class HiddenSettings:
    """How much a fit of a hidden state learns from, and how long it goes on."""

    # rows that it learns from, at most: of longer records evenly spread pieces of `piece` rows are taken
    rows: int
    piece: int
    # steps of all segments of one length, about; in a search of many sizes
    steps: int
    quick_steps: int
    # Levenberg-Marquardt steps of a stage, steps in a row that do not gain on unseen rows, and the share of the squared
    # error below which a step is the last
    effort: tuple[int, int, float]
    polish: tuple[int, int]  # steps on all rows at the end, and how many in a row may not gain
    gained: float  # try a larger order only if the last one lowered the error to less than this share
    # hold the eigenvalues of the linear part inside the unit circle, judge calmness from other states too, and begin
    # with differences of the outputs where these forecast better than `subspace`
    contained: bool


POLYNOMIAL = HiddenSettings(4000, 1000, 8000, 4000, (25, 5, 1e-3), (8, 5), 0.95, contained=False)
NEURAL = HiddenSettings(12_000, 4000, 30_000, 10_000, (40, 8, 1e-3), (15, PATIENCE), 0.9, contained=True)

NEURONS = (1, 3, 6)  # numbers of neurons that are tried
LONGER = 5  # the longer segments of fits with neurons have this many times the steps of the shorter ones
_STARTS = 2  # sets of candidates for the neurons that short records are fitted from
_SHORT = 1_500  # rows of such records, at most
_CLOSE = (80, 20, 1e-4)  # their effort
_OVERLAP = 3  # a long segment begins behind this share of the one before
_SHORT_OVERLAP = 7  # a short one behind this share
_REACH = 1.2  # products of z are constant beyond this many times the largest |z| that occurs in the fit
_MOST = 300  # parameters of a polynomial model, at most
_EACH = 3  # rows for each of them, at least

Chain = Iterator[tuple[HiddenModel, SignalUnits]]


def find_settings(structure: HiddenStructure) -> HiddenSettings:
    """Return the settings of fits of this structure."""
    return NEURAL if structure.neurons else POLYNOMIAL


def fit_hidden(
    structure: HiddenStructure, episodes: Episodes, *, quick: bool = False
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure: learned from three quarters of each record, and polished on all rows.

    With `quick` it learns from fewer segments, as in the search for its sizes. Short records with neurons are fitted
    from several sets of candidates, and the one of least error on the last quarters is taken: they are cheap, and their
    few rows leave minima apart. Others with neurons learn from a third of the segments, and without `quick` the last
    number of neurons goes on with all of them. Where the free run of the polished model is not calm, the last model
    before it that is takes its place: before the polish, with fewer neurons, or without any.
    """
    s, settings = structure, find_settings(structure)
    if not s.horizon:
        return build_realisation(compute_block_moments(episodes, s.delays), s.order)
    data = thin_records(episodes, settings.rows, settings.piece)
    counts = [q for q in NEURONS if q < s.neurons] + [s.neurons]
    if not s.neurons:
        chain = list(fit_chain(data, s, quick=quick))[-1:]
    elif not quick and sum(map(len, data)) <= _SHORT:
        starts = [replace(s, start=s.start + i) for i in range(_STARTS)]
        chains = [list(fit_chain(data, start, counts, plain=True, effort=_CLOSE)) for start in starts]
        chain = min(chains, key=lambda models: _rank(*models[-1], data, s.delays))
    else:
        chain = list(fit_chain(data, s, counts, quick=True, plain=True, last=not quick))
    units, models = chain[-1][1], [model for model, _ in reversed(chain)]
    models.insert(0, _polish(models[0], data, units, s, quick=quick))
    anywhere = settings.contained
    calm = next((model for model in models if is_calm_hidden(model, data, units, s.delays, anywhere=anywhere)), None)
    if calm is None and s.neurons and not quick:
        raise DataError(
            f"free runs of a hidden state of order {s.order} leave ten ranges of the data, with neurons and without; "
            "pass another order, or use polynomial_state_space"
        )
    model = models[0] if calm is None else calm  # who judges it sees that it is not calm
    return from_standard(model, units, episodes, s.delays, report_fit(s, model, units, data))


def _rank(model: HiddenModel, units: SignalUnits, data: Episodes, delays: int) -> tuple[bool, float]:
    errors = measure_hidden(model, data, units, delays, find_forecast_horizon(data))
    return not is_calm_hidden(model, data, units, delays, anywhere=True), float(np.log(errors).sum())


def fit_chain(
    data: Episodes,
    plan: HiddenStructure,
    neurons: Sequence[int] = (),
    *,
    quick: bool = False,
    plain: bool = False,
    effort: tuple[int, int, float] | None = None,
    last: bool = False,
) -> Chain:
    """Yield models of more and more terms that learn from the first three quarters of each record.

    Without `neurons` these are the linear model and those of degrees 2 up to that of the plan. With neurons each has
    the next number of them, beside products of the plan's degree; `plain` yields the model without them first. `quick`
    learns from the segments of a search; `last` has the last number of neurons go on with all segments.
    """
    settings, s = NEURAL if neurons else POLYNOMIAL, plan
    units = SignalUnits.of(data, s.rails)
    basis = _choose_basis(data, units, s, settings)
    learned, unseen = cut_quarter(data)
    spans = [(0, a) for a, _ in unseen], unseen
    horizons = [max(s.horizon // LONGER, 1), s.horizon] if neurons else [s.horizon]

    def cut(most: int) -> list[tuple[list[RecordSegments], ...]]:
        return [
            tuple(_project(_cut(data, units, s, settings, h, part, most), basis) for part in spans) for h in horizons
        ]

    sets = cut(settings.quick_steps if quick else settings.steps)
    model, noise = _start(learned, units, s, basis, sets[0], settings)
    if neurons:
        if s.degree > 1:
            model = _fit(model.raise_degree(s.degree), noise, sets[0], settings)
        if plain:
            yield _change_past(model, basis), units
        rng = np.random.default_rng(s.start)
        for before, count in pairwise([0, *neurons]):
            drawn = draw_neurons(model, sets[0][0][0], rng)
            model = model.add_neurons(take_neurons(model, sets[0][0], drawn, count - before, noise))
            for part in (*sets, *(cut(settings.steps) if last and count == neurons[-1] else ())):
                model = _fit(model, noise, part, settings, effort)
            yield _change_past(model, basis), units
        return
    yield model, units
    for degree in range(2, s.degree + 1):
        model = model.raise_degree(degree)
        if len(model.parameters) > min(_MOST, sum(map(len, data)) * units.ny // _EACH):
            return
        model = _fit(model, noise, sets[0], settings)
        yield bound_states(model, sets[0][0][0], _REACH), units


def _start(
    learned: Episodes,
    units: SignalUnits,
    plan: HiddenStructure,
    basis: Float[np.ndarray, "k nzeta"],
    part: tuple[Sets, ...],
    settings: HiddenSettings,
) -> tuple[HiddenModel, float]:
    """Return the linear model to begin with, and the noise of a row: of two starts the one that forecasts better."""
    order, delays, noise = plan.order, plan.delays, np.inf
    starts: list[HiddenModel] = []
    if settings.contained:
        starts.append(start_with_differences(units.ny, len(units.mean) - units.ny, order, delays))
    try:
        realisation = build_realisation(compute_block_moments(learned, delays), order)
        assert realisation.report is not None, "it was fitted"
        starts.append(to_standard(realisation, units))
        noise = float(np.max(realisation.report.residual / units.scale[: units.ny]))
    except KoopmpcError:  # too short, or no subspace of this order
        if not starts:
            raise
    fitted: list[tuple[float, HiddenModel]] = []
    for start in starts:
        small = _normalise(_change_past(start, basis.T), part[0][-1].points)
        error = SimulationError(small)
        if settings.contained and not fitted:
            noise = min(noise, np.sqrt(error.evaluate(small.parameters, [_first_step(part[0][-1])])))
        if not settings.contained or np.isfinite(error.evaluate(small.parameters, part[0])):
            small = _fit(small, float(noise), part, settings)
            fitted.append((error.evaluate(small.parameters, part[1]), small))
    if not fitted:
        raise DataError(f"no linear model of order {order} has a forecast that stays finite; pass another order")
    return min(fitted, key=lambda pair: pair[0])[1], float(noise)


def _fit(
    model: HiddenModel,
    noise: float,
    part: tuple[Sets, ...],
    settings: HiddenSettings,
    effort: tuple[int, int, float] | None = None,
) -> HiddenModel:
    """Return the model that Levenberg-Marquardt finds; unseen segments stop it."""
    (fitted, judged), (iterations, patience, converged) = part, effort or settings.effort
    error = SimulationError(model, noise)
    inside = ContainedError(error) if settings.contained else None
    theta, _ = minimise(
        inside or error, model.parameters, fitted, judged, iterations,
        patience=patience, converged=converged, project=inside and inside.project,
    )  # fmt: skip
    return contain(model.with_parameters(theta)) if inside else model.with_parameters(theta)


def _polish(
    model: HiddenModel, data: Episodes, units: SignalUnits, structure: HiddenStructure, *, quick: bool
) -> HiddenModel:
    """Return the model after some steps on all rows."""
    settings = find_settings(structure)
    basis = _choose_basis(data, units, structure, settings)
    most = settings.quick_steps if quick else settings.steps
    spans = [(0, len(e)) for e in data]
    whole = _project(_cut(data, units, structure, settings, structure.horizon, spans, most), basis)
    iterations, patience = settings.polish
    effort = iterations, patience, settings.effort[2]
    polished = _change_past(_fit(_change_past(model, basis.T), 0.0, (whole, whole), settings, effort), basis)
    bounded = not structure.neurons and structure.degree > 1
    return bound_states(polished, whole[0], _REACH) if bounded else polished


def _normalise(model: HiddenModel, points: Float[np.ndarray, "m nzeta"]) -> HiddenModel:
    """Return a linear model whose state has mean zero and a spread of one at these points."""
    z, n = start_states(model, points), model.order
    mean, size = z.mean(axis=0), z.std(axis=0)
    size = np.where(size > 0, size, 1.0)
    E, H, T = model.E.copy(), model.H.copy(), model.T.copy()
    E[:, 0] += E[:, 1 : 1 + n] @ mean - mean
    H[:, -1] += H[:, :-1] @ mean
    T[:, -1] -= mean
    E[:, 1 : 1 + n] *= size
    H[:, :-1] *= size
    return replace(model, E=E / size[:, None], H=H, T=T / size[:, None])


def _cut(
    data: Episodes,
    units: SignalUnits,
    plan: HiddenStructure,
    settings: HiddenSettings,
    horizon: int,
    spans: Sequence[tuple[int, int]],
    steps_of_all: int,
) -> list[RecordSegments]:
    """Return long segments, which tell slow modes, and many short ones, which tell where the state begins."""
    room = max(b - max(a, plan.delays) for a, b in spans)
    short = max(HORIZON, horizon // LONGER) if settings.contained else HORIZON
    parts: list[RecordSegments] = []
    for steps, overlap in ((max(min(horizon, room), 1), _OVERLAP), (max(min(short, room), 1), _SHORT_OVERLAP)):
        total = sum(max(b - max(a, plan.delays) - steps + 1, 0) for a, b in spans)
        apart = max(steps // overlap, total * steps // steps_of_all, 1)
        parts.append(join_segments(cut_segments(data, units, plan.delays, steps, apart, spans)))
    return parts


def _first_step(data: RecordSegments) -> RecordSegments:
    rails = (None, None) if data.low is None or data.high is None else (data.low[:1], data.high[:1])
    return RecordSegments(data.points, data.inputs[:1], data.outputs[:1], *rails)


def _choose_basis(
    data: Episodes, units: SignalUnits, plan: HiddenStructure, settings: HiddenSettings
) -> Float[np.ndarray, "k nzeta"]:
    """Return the rows of ζ that tell where the state begins: with neurons of many past rows the smooth part alone."""
    if settings.contained:
        return smooth_basis(units.ny, data.nu, plan.delays)
    return np.eye(units.ny + plan.delays * len(units.mean))


def _project(parts: Sets, basis: Float[np.ndarray, "k nzeta"]) -> list[RecordSegments]:
    return [replace(part, points=part.points @ basis.T) for part in parts]


def _change_past(model: HiddenModel, basis: Float[np.ndarray, "k points"]) -> HiddenModel:
    """Return the model whose T takes points in place of `basis` times points."""
    return replace(model, T=np.hstack([model.T[:, :-1] @ basis, model.T[:, -1:]]))
