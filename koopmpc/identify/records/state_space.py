"""polynomial_state_space: a hidden state of small order with polynomial dynamics, fitted by simulation error."""

from collections.abc import Sequence

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
    SimulationError,
    bound_states,
)
from koopmpc.identify.records.hidden_structure import (
    ROWS,
    STEPS,
    HiddenStructure,
    choose_hidden,
    cut_sets,
    find_noise,
    is_calm_hidden,
    measure_hidden,
    normalise,
    report_fit,
    thin_records,
)
from koopmpc.identify.records.narx import Ask, check_list, source_episodes
from koopmpc.identify.records.neural import fit_neural
from koopmpc.identify.records.structure import check_rails, find_forecast_horizon
from koopmpc.identify.records.subspace import build_realisation, compute_block_moments
from koopmpc.identify.records.unseen import UNSEEN
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

ORDERS = (1, 2, 3, 4, 6)  # orders of the hidden state that are tried
DEGREES = (1, 2, 3)  # total degrees of the polynomials that are tried
DELAYS = (8,)  # past rows from which the state begins
HORIZONS = (50, 200)  # steps of the segments whose errors are minimised
REACH = 1.2  # products of z are constant beyond this many times the largest |z| that occurs in the fit
GAINED = 0.95  # try a larger order only if the last one lowered the error to less than this share
SEGMENTS = 5  # segments that fit into the records one behind the other, at least, of the longer kinds
FINALISTS = 2  # orders that are fitted to longer segments too
QUICK_STEPS = ROWS  # steps of all segments of one length in a search: each row is in one of them
MOST = 300  # parameters of a model, at most
EACH = 3  # rows for each parameter, at least
_ITERATIONS = 25  # Levenberg-Marquardt steps for each degree
_PATIENCE = 5  # steps in a row that do not lower the error on unseen rows
_CONVERGED = 1e-3  # a step that lowers the squared error by a smaller share is the last
_POLISH = 8  # steps on all rows, at the end


def polynomial_state_space(
    episodes: Episodes | Source,
    order: int | Sequence[int] = ORDERS,
    degree: int | Sequence[int] = DEGREES,
    *,
    delays: int | Sequence[int] = DELAYS,
    horizon: int | Sequence[int] = HORIZONS,
    rails: ArrayLike | None = None,
) -> LinearPredictor | BilinearPredictor:
    """Fit z⁺ = E φ(z, u), y = C z + c with a hidden state z of small order, by its simulation error over segments.

    φ holds 1, the products of z up to a degree, and each input times such products of lower degree: the state is
    polynomial, and affine in the inputs. Each segment begins with z_0 = T [ζ; 1], a linear function of the past rows
    ζ. Levenberg-Marquardt with derivatives in closed form minimises Σ ‖ŷ_k − y_k‖² over all segments, by E, C, c and
    T. It starts with the linear model of `subspace`; then each degree starts with the model of the lower one. It stops
    on the last quarter of each record. Then a few steps on all rows follow.

    Segments begin at measured rows, as in multiple shooting; so the plant may be unstable.

    Parameters
    ----------
    episodes
        Records of one plant: outputs as states.
    order, degree, delays, horizon
        Order of z, total degree, past rows of ζ, and steps of a segment; several of each are tried. Of all models
        within one standard error of the best, in free run and in short forecasts on the last quarter of each
        record, the one with the fewest coefficients is taken.
    rails
        (2, ny) or (2,), the least and the largest reading of the sensors: y = min(max(C z + c, low), high). Where a
        reading is at a rail, the error counts on one side only.

    Returns
    -------
    model
        Of degree 1 a `LinearPredictor` on [T ζ, 1], as `subspace` returns. Else a `BilinearPredictor` whose embedding
        is a `HiddenState`: it is lifted afresh at each step, as `step_map` and `BilinearMPC` do, and z goes on by its
        own dynamics.

    Raises
    ------
    DataError
        The records are too short for the segments and the past rows; no output moves; a stream is read twice.

    References
    ----------
    Paduart et al., "Identification of nonlinear systems using polynomial nonlinear state space models", Automatica 46,
    2010; a state that an encoder of past rows begins: Beintema, Tóth & Schoukens, "Nonlinear state-space
    identification using deep encoder networks", L4DC 2021.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> u, y, z = np.random.default_rng(0).uniform(-1, 1, 600), np.zeros(601), np.zeros(2)
    >>> for k in range(600):
    ...     z = np.array([0.8 * z[0] + 0.3 * z[1] - 0.1 * z[0] ** 2, 0.7 * z[1] + 0.3 * u[k]])
    ...     y[k + 1] = z[0]
    >>> data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    >>> model = km.identify.polynomial_state_space(data, order=2, degree=2, horizon=50)
    >>> start = model.embed(data)[0].X[0]
    >>> bool(abs(model.step_map().rollout(start, u[8:, None])[:, 0] - y[8:]).max() < 0.02 * y.std())
    True
    """
    source = source_of(episodes)
    if source.disturbances:
        raise DataError("the data have measured disturbances, which this fit does not know; pass them as inputs")
    whole = source_episodes(source)
    limits = None if rails is None else check_rails(rails, whole.nx)
    lists = check_list(order, 1), check_list(degree, 1), check_list(delays, 1), check_list(horizon, 1)
    found = search_hidden(whole, *lists, rails=limits)
    return fit_hidden(choose_hidden(found), whole)


def search_hidden(
    episodes: Episodes,
    orders: Sequence[int] = ORDERS,
    degrees: Sequence[int] = DEGREES,
    delays: Sequence[int] = DELAYS,
    horizons: Sequence[int] = HORIZONS,
    *,
    rails: Float[np.ndarray, "2 ny"] | None = None,
    ask: Ask | None = None,
) -> list[HiddenStructure]:
    """Return all structures with their errors on the last quarter of each record.

    Raises
    ------
    DataError
        The records are too short for all of them.
    """
    data, ahead = thin_records(episodes), find_forecast_horizon(episodes)
    plans = [(n, d, min(horizons)) for n in sorted(orders) for d in delays]
    count, done, least = len(plans) + FINALISTS * (len(horizons) - 1), 0, np.inf
    found: list[HiddenStructure] = []
    reasons: list[KoopmpcError] = []

    def try_plan(order: int, past: int, horizon: int) -> None:
        nonlocal done
        if ask is not None:
            ask(f"hidden states of order {order}", done, count)
        done += 1
        try:
            chain = _fit_chain(data, order, max(degrees), past, horizon, rails, QUICK_STEPS)
        except KoopmpcError as error:
            reasons.append(error)
            return
        for model, units in chain:
            degree = model.terms.shape[1]
            if degree in degrees:
                errors = measure_hidden(model, data, units, past, ahead)
                calm = is_calm_hidden(model, data, units, past)
                found.append(HiddenStructure(model.order, degree, past, horizon, rails, errors, calm, model.E.size))

    for n in sorted(orders):
        for order, past, horizon in plans:
            if order == n:
                try_plan(order, past, horizon)
        best = min((one.error for one in found), default=np.inf)
        if n > 1 and not best < GAINED * least:
            break  # a larger state gains nothing
        least = best
    sizes = dict.fromkeys((one.order, one.delays) for one in sorted(found, key=lambda one: one.error)[:FINALISTS])
    for order, past in sizes:
        for horizon in sorted(horizons)[1:]:
            if horizon * SEGMENTS > sum(map(len, data)):
                break  # too few segments of this length
            try_plan(order, past, horizon)
    if not found:
        raise reasons[0] if reasons else DataError("no structure was asked for; pass orders and degrees")
    return found


def fit_hidden(
    structure: HiddenStructure, episodes: Episodes, *, quick: bool = False
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure: learned from three quarters of each record, and polished on all rows.

    `quick` is as in `fit_neural`; polynomials learn from half of the segments then, as in the search for their sizes.
    """
    s = structure
    if s.neurons:
        return fit_neural(s, episodes, quick=quick)
    if not s.horizon:
        return build_realisation(compute_block_moments(episodes, s.delays), s.order)
    data = thin_records(episodes)
    most = QUICK_STEPS if quick else STEPS
    found, units = _fit_chain(data, s.order, s.degree, s.delays, s.horizon, s.rails, most)[-1]
    whole = cut_sets(data, units, s.delays, s.horizon, [(0, len(e)) for e in data], steps_of_all=most)
    theta, _ = minimise(
        SimulationError(found), found.parameters, whole, whole, _POLISH, patience=_PATIENCE, converged=_CONVERGED
    )
    polished = found.with_parameters(theta)
    if s.degree > 1:
        polished = bound_states(polished, whole[0], REACH)
    if is_calm_hidden(polished, data, units, s.delays) or not is_calm_hidden(found, data, units, s.delays):
        found = polished
    return from_standard(found, units, episodes, s.delays, report_fit(structure, found, units, data))


def _fit_chain(
    data: Episodes,
    order: int,
    degree: int,
    delays: int,
    horizon: int,
    rails: Float[np.ndarray, "2 ny"] | None,
    most: int,
) -> list[tuple[HiddenModel, SignalUnits]]:
    """Return the models of degrees 1, 2, … that learn from about `most` steps of the first three quarters."""
    units = SignalUnits.of(data, rails)
    ends = [round((1 - UNSEEN) * len(e)) for e in data]
    unseen = [(a, len(e)) for e, a in zip(data, ends, strict=True)]
    fitted, judged = (
        cut_sets(data, units, delays, horizon, part, steps_of_all=most) for part in ([(0, a) for a in ends], unseen)
    )
    learned = data.with_episodes([e.cut(0, a) for e, a in zip(data, ends, strict=True) if a > 0])
    start = build_realisation(compute_block_moments(learned, delays), order)
    model = normalise(to_standard(start, units), fitted[-1].points)
    noise = find_noise(start, units)
    found: list[tuple[HiddenModel, SignalUnits]] = []
    rows = sum(map(len, data)) * units.ny
    for g in range(1, degree + 1):
        model = model.raise_degree(g) if g > 1 else model
        if g > 1 and len(model.parameters) > min(MOST, rows // EACH):
            break
        theta, _ = minimise(
            SimulationError(model, noise), model.parameters, fitted, judged, _ITERATIONS,
            patience=_PATIENCE, converged=_CONVERGED,
        )  # fmt: skip
        model = model.with_parameters(theta)
        found.append((bound_states(model, fitted[0], REACH) if g > 1 else model, units))
    return found
