"""neural_state_space: a hidden state of small order whose dynamics have bends, fitted by simulation error."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, KoopmpcError
from koopmpc.identify.levenberg_marquardt import minimise
from koopmpc.identify.records.conversion import SignalUnits, from_standard, to_standard
from koopmpc.identify.records.hidden import (
    HiddenModel,
    RecordSegments,
    Sets,
    SimulationError,
    smooth_basis,
    start_with_differences,
)
from koopmpc.identify.records.hidden_structure import (
    HiddenStructure,
    choose_hidden,
    cut_sets,
    find_noise,
    is_calm_anywhere,
    measure_hidden,
    normalise,
    report_fit,
    thin_records,
)
from koopmpc.identify.records.narx import Ask, check_list, source_episodes
from koopmpc.identify.records.neurons.candidates import draw_neurons, take_neurons
from koopmpc.identify.records.neurons.contained import ContainedError, contain
from koopmpc.identify.records.structure import HORIZON, check_rails, find_forecast_horizon
from koopmpc.identify.records.subspace import build_realisation, compute_block_moments
from koopmpc.identify.records.unseen import UNSEEN
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

ORDERS = (1, 2, 3, 4)  # orders of the hidden state that are tried
NEURONS = (1, 3, 6)  # numbers of neurons that are tried
DEGREES = (1, 2)  # total degrees of the polynomials beside them
GAINED = 0.9  # try a larger order only if the last one lowered the error to less than this share
ROWS = 12_000  # rows that a search learns from, at most: of longer records evenly spread pieces are taken
PIECE = 4_000  # rows of such a piece
STEPS = 30_000  # steps of all segments of one length, about
QUICK_STEPS = 10_000  # the same in a search of many sizes
WINDOWS = 8, 40  # past rows from which the state begins, at least and at most
SEGMENTS = 50, 200  # steps of the shorter segments, at least and at most
LONGER = 5  # the longer segments have this many times the steps of the shorter ones
PACE = 10  # the past rows reach over 1/10 of the rows in which the outputs move by their spread
STARTS = 2  # sets of candidates for the neurons that the best order is tried with
SHORT = 1_500  # rows of records whose last fit tries all these sets too, at most
_CONVERGED = 1e-3  # a step that lowers the squared error by a smaller share is the last
_USUAL = 40, 8, _CONVERGED  # steps for each number of neurons, steps in a row that do not gain on unseen rows, and this
_CLOSE = 80, 20, 1e-4  # the same three of short records
_POLISH = 15  # steps on all rows, at the end


def neural_state_space(
    episodes: Episodes | Source,
    order: int | Sequence[int] = ORDERS,
    neurons: int | Sequence[int] = NEURONS,
    *,
    degree: int | Sequence[int] = 1,
    rails: ArrayLike | None = None,
) -> BilinearPredictor:
    """Fit z⁺ = E φ(z, u) + W tanh(V [z; 1]), y = C z + c with a hidden state z, by its simulation error over segments.

    A few neurons hold what polynomials cannot: dry friction, a diode, a tank that overflows, hysteresis. φ holds 1, z
    and u, and from degree 2 on products of z and inputs times such products. Each segment begins with z_0 = T [ζ; 1], a
    linear function of the past rows ζ.

    The linear model starts with `subspace`, or with z = the output and its differences, whichever forecasts better.
    Candidates for neurons bend along the output, its differences, and random directions. Those are taken, one after
    the other, which lower the simulation error most to first order. Levenberg-Marquardt then fits E, W, V, C, c and T
    together. The length of the segments follows the pace of the outputs.

    Far from the data the dynamics are linear, z⁺ = A z and a bounded rest, and no eigenvalue of A is above one: free
    runs do not grow exponentially. A model that leaves the data by ten ranges, from eight rows of each record over all
    its inputs, is taken only where all do.

    Parameters
    ----------
    episodes
        Records of one plant: outputs as states.
    order, neurons, degree
        Order of z, number of neurons and total degree of the polynomials; several of each are tried. Of all models
        within one standard error of the best, in free run and in short forecasts on the last quarter of each
        record, the one with the fewest coefficients is taken.
    rails
        As in `polynomial_state_space`.

    Raises
    ------
    DataError
        The records are too short for the segments and the past rows; no output moves; a stream is read twice; the free
        runs of all models leave the data.

    References
    ----------
    Schoukens, "Improved initialization of state-space artificial neural networks", ECC 2021.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> u, y, v = np.random.default_rng(0).uniform(-1, 1, 300), np.zeros(301), 0.0
    >>> for k in range(300):
    ...     v = 0.9 * v + u[k] - 0.3 * np.tanh(10 * v)
    ...     y[k + 1] = v
    >>> data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    >>> model = km.identify.neural_state_space(data, order=1, neurons=1)
    >>> start = model.embed(data)[0].X[0]
    >>> bool(abs(model.step_map().rollout(start, u[8:, None])[:, 0] - y[8:]).max() < 0.02 * y.std())
    True
    """
    source = source_of(episodes)
    if source.disturbances:
        raise DataError("the data have measured disturbances, which this fit does not know; pass them as inputs")
    whole = source_episodes(source)
    limits = None if rails is None else check_rails(rails, whole.nx)
    found = search_neural(whole, check_list(order, 1), check_list(neurons, 1), check_list(degree, 1), rails=limits)
    model = fit_neural(choose_hidden(found), whole)
    assert isinstance(model, BilinearPredictor), "neurons are nonlinear"
    return model


def search_neural(
    episodes: Episodes,
    orders: Sequence[int] = ORDERS,
    neurons: Sequence[int] = NEURONS,
    degrees: Sequence[int] = DEGREES,
    *,
    rails: Float[np.ndarray, "2 ny"] | None = None,
    quick: bool = False,
    ask: Ask | None = None,
) -> list[HiddenStructure]:
    """Return structures with their errors on the last quarter of each record.

    Orders are tried upwards, until one gains less than a tenth. Degrees above the first, and other starts for the
    neurons, are tried with the best order. `quick` is as in `fit_neural`, and without other starts.

    Raises
    ------
    DataError
        The records are too short for all of them.
    """
    data, ahead = thin_records(episodes, ROWS, PIECE), find_forecast_horizon(episodes)
    delays, horizon = choose_window(data)
    found: list[HiddenStructure] = []
    reasons: list[KoopmpcError] = []

    def try_chain(order: int, degree: int, start: int = 0) -> None:
        if ask is not None:
            ask(f"neurons with a hidden state of order {order}", len(found), len(orders) * len(neurons))
        plan = HiddenStructure(order, degree, delays, horizon, rails, np.ones(1), False, 0, start=start)
        try:
            for model, units in fit_chain(data, plan, neurons, quick=quick):
                errors = measure_hidden(model, data, units, delays, ahead)
                calm = is_calm_anywhere(model, data, units, delays)
                size, count = model.E.size + model.neurons.size, len(model.neurons)
                found.append(replace(plan, errors=errors, calm=calm, parameters=size, neurons=count))
        except KoopmpcError as error:
            reasons.append(error)

    def best_error() -> float:
        return min((one.error for one in found if one.calm), default=np.inf)

    least = np.inf
    for n in sorted(orders):
        try_chain(n, min(degrees))
        if n > 1 and not best_error() < GAINED * least:
            break
        least = best_error()
    if found:
        best = choose_hidden(found)
        for degree in sorted(degrees)[1:]:
            try_chain(best.order, degree)
        for start in range(1, 1 if quick else STARTS):
            try_chain(best.order, min(degrees), start)
    if not found:
        raise reasons[0] if reasons else DataError("no structure was asked for; pass orders and neurons")
    return found


def fit_neural(
    structure: HiddenStructure, episodes: Episodes, *, quick: bool = False
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure: learned from three quarters of each record, and polished on all rows.

    Short records are fitted from several sets of candidates, and the one of least error on the last quarters is taken:
    they are cheap, and their few rows leave minima apart. Others learn from a third of the segments, and without
    `quick` the last number of neurons goes on with all of them. Where that is not calm, the last model before it that
    is: before the polish, with fewer neurons, or without any.

    Raises
    ------
    DataError
        The free runs of all of them leave the data, without `quick`.
    """
    s, data = structure, thin_records(episodes, ROWS, PIECE)
    counts = [q for q in NEURONS if q < s.neurons] + [s.neurons]
    few = not quick and sum(map(len, data)) <= SHORT
    chain = (
        _best_chain(data, s, counts)
        if few
        else list(fit_chain(data, s, counts, quick=True, plain=True, last=not quick))
    )
    units, models = chain[-1][1], [model for model, _ in reversed(chain)]
    models.insert(0, _polish(models[0], data, units, s, quick))
    for one in models:
        if is_calm_anywhere(one, data, units, s.delays):
            return from_standard(one, units, episodes, s.delays, report_fit(structure, one, units, data))
    if quick:  # who judges it sees that it is not calm
        return from_standard(models[0], units, episodes, s.delays, report_fit(structure, models[0], units, data))
    raise DataError(
        f"free runs of a hidden state of order {s.order} leave ten ranges of the data, with neurons and without; pass "
        "another order, or use polynomial_state_space"
    )


def _best_chain(
    data: Episodes, structure: HiddenStructure, counts: Sequence[int]
) -> list[tuple[HiddenModel, SignalUnits]]:
    """Return the models of the set of candidates whose last one errs least on the last quarters; calm ones go first."""
    s, ahead = structure, find_forecast_horizon(data)

    def rank(chain: list[tuple[HiddenModel, SignalUnits]]) -> tuple[bool, float]:
        model, units = chain[-1]
        errors = measure_hidden(model, data, units, s.delays, ahead)
        return not is_calm_anywhere(model, data, units, s.delays), float(np.log(errors).sum())

    starts = range(s.start, s.start + STARTS)
    return min((list(fit_chain(data, replace(s, start=i), counts, plain=True, close=True)) for i in starts), key=rank)


def _polish(
    model: HiddenModel, data: Episodes, units: SignalUnits, structure: HiddenStructure, quick: bool
) -> HiddenModel:
    """Return the model after some steps on all rows."""
    basis = smooth_basis(units.ny, data.nu, structure.delays)
    most = QUICK_STEPS if quick else STEPS
    whole = _project(_cut(data, units, structure, structure.horizon, [(0, len(e)) for e in data], most), basis)
    small = _change_past(model, basis.T)
    error = ContainedError(SimulationError(small))
    theta, _ = minimise(error, small.parameters, whole, whole, _POLISH, converged=_CONVERGED, project=error.project)
    return contain(_change_past(small.with_parameters(theta), basis))


def choose_window(data: Episodes) -> tuple[int, int]:
    """Return the past rows from which a state begins and the steps of long segments, by the pace of the outputs.

    The pace is the number of rows in which an output moves by its spread: √(spread² / mean square of its differences).
    """
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    moves = np.sqrt(np.mean(np.concatenate([np.diff(e.X, axis=0) for e in data]) ** 2, axis=0))
    live = (spread > 0) & (moves > 0)
    pace = float(np.min(spread[live] / moves[live])) if live.any() else 1.0
    delays = int(np.clip(round(pace / PACE), *WINDOWS))
    short = int(np.clip(round(pace / 3), *SEGMENTS))
    room = min(round((1 - UNSEEN) * len(e)) for e in data) - delays
    return delays, min(LONGER * short, max(room // 2, HORIZON))


def fit_chain(
    data: Episodes,
    structure: HiddenStructure,
    neurons: Sequence[int],
    *,
    quick: bool = False,
    plain: bool = False,
    close: bool = False,
    last: bool = False,
) -> Iterator[tuple[HiddenModel, SignalUnits]]:
    """Yield models with more and more neurons that learn from the first three quarters of each record.

    With `plain` the linear model that they begin with comes first; `quick` is as in `fit_neural`, and `close` takes
    more and smaller steps. With `last` the last number of neurons learns from all segments behind them.
    """
    s = structure
    units = SignalUnits.of(data, s.rails)
    basis = smooth_basis(units.ny, data.nu, s.delays)
    ends = [round((1 - UNSEEN) * len(e)) for e in data]
    spans = [(0, a) for a in ends], [(a, len(e)) for e, a in zip(data, ends, strict=True)]
    steps = [max(s.horizon // LONGER, 1), s.horizon]

    def cut(most: int) -> list[tuple[list[RecordSegments], ...]]:
        return [tuple(_project(_cut(data, units, s, h, part, most), basis) for part in spans) for h in steps]

    sets = cut(QUICK_STEPS if quick else STEPS)
    learned = data.with_episodes([e.cut(0, a) for e, a in zip(data, ends, strict=True) if a > 0])
    model, noise = _start(learned, units, s, basis, sets[0])
    if s.degree > 1:
        model = _fit(model.raise_degree(s.degree), noise, sets[0])
    if plain:
        yield _change_past(model, basis), units
    rng = np.random.default_rng(s.start)
    for before, count in pairwise([0, *neurons]):
        drawn = draw_neurons(model, sets[0][0][0], rng)
        model = model.add_neurons(take_neurons(model, sets[0][0], drawn, count - before, noise))
        for part in (*sets, *(cut(STEPS) if last and count == neurons[-1] else ())):
            model = _fit(model, noise, part, _CLOSE if close else _USUAL)
        yield _change_past(model, basis), units


def _cut(
    data: Episodes,
    units: SignalUnits,
    structure: HiddenStructure,
    horizon: int,
    spans: Sequence[tuple[int, int]],
    most: int = STEPS,
) -> list[RecordSegments]:
    return cut_sets(data, units, structure.delays, horizon, spans, max(HORIZON, horizon // LONGER), most)


def _fit(
    model: HiddenModel, noise: float, part: tuple[Sets, ...], effort: tuple[int, int, float] = _USUAL
) -> HiddenModel:
    """Return the model that Levenberg-Marquardt finds, whose linear part does not grow; unseen segments stop it."""
    (fitted, judged), (iterations, patience, converged) = part, effort
    error = ContainedError(SimulationError(model, noise))
    theta, _ = minimise(
        error, model.parameters, fitted, judged, iterations, patience=patience, converged=converged,
        project=error.project,
    )  # fmt: skip
    return contain(model.with_parameters(theta))


def _start(
    learned: Episodes,
    units: SignalUnits,
    structure: HiddenStructure,
    basis: Float[np.ndarray, "k nzeta"],
    part: tuple[Sets, ...],
) -> tuple[HiddenModel, float]:
    """Return the linear model to begin with, and the noise of a row: of two starts the one that forecasts better."""
    order, delays = structure.order, structure.delays
    starts = [start_with_differences(units.ny, len(units.mean) - units.ny, order, delays)]
    noise = np.inf
    try:
        found = build_realisation(compute_block_moments(learned, delays), order)
        starts.append(to_standard(found, units))
        noise = find_noise(found, units)
    except KoopmpcError:  # too short, or no subspace of this order
        pass
    fitted: list[tuple[float, HiddenModel]] = []
    for one in starts:
        small = normalise(_change_past(one, basis.T), part[0][-1].points)
        error = SimulationError(small)
        if len(fitted) == 0:
            noise = min(noise, np.sqrt(error.evaluate(small.parameters, [_first_step(part[0][-1])])))
        if np.isfinite(error.evaluate(small.parameters, part[0])):
            small = _fit(small, float(noise), part)
            fitted.append((error.evaluate(small.parameters, part[1]), small))
    if not fitted:
        raise DataError(f"no linear model of order {order} has a forecast that stays finite; pass another order")
    return min(fitted, key=lambda pair: pair[0])[1], float(noise)


def _first_step(data: RecordSegments) -> RecordSegments:
    rails = (None, None) if data.low is None or data.high is None else (data.low[:1], data.high[:1])
    return RecordSegments(data.points, data.inputs[:1], data.outputs[:1], *rails)


def _project(parts: Sets, basis: Float[np.ndarray, "k nzeta"]) -> list[RecordSegments]:
    return [replace(part, points=part.points @ basis.T) for part in parts]


def _change_past(model: HiddenModel, basis: Float[np.ndarray, "k points"]) -> HiddenModel:
    """Return the model whose T takes points in place of `basis` times points."""
    return replace(model, T=np.hstack([model.T[:, :-1] @ basis, model.T[:, -1:]]))
