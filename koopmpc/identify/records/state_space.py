"""polynomial_state_space: a hidden state of small order with polynomial dynamics, fitted by simulation error."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, KoopmpcError
from koopmpc.identify.levenberg_marquardt import minimise
from koopmpc.identify.records.conversion import SignalUnits, cut_segments, from_standard, to_standard
from koopmpc.identify.records.free_run import HELD
from koopmpc.identify.records.hidden import (
    HiddenModel,
    RecordSegments,
    SimulationError,
    bound_states,
    join_segments,
    simulate_hidden,
    start_states,
)
from koopmpc.identify.records.narx import Ask, check_list, is_worse, source_episodes
from koopmpc.identify.records.structure import EXACT, HORIZON
from koopmpc.identify.records.subspace import build_realisation, compute_block_moments
from koopmpc.identify.records.unseen import BLOCKS, UNSEEN
from koopmpc.predict.base import FitReport
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.values import Value

ORDERS = (1, 2, 3, 4, 6)  # orders of the hidden state that are tried
DEGREES = (1, 2, 3)  # total degrees of the polynomials that are tried
DELAYS = (8,)  # past rows from which the state begins
HORIZONS = (50, 200)  # steps of the segments whose errors are minimised
ROWS = 4000  # rows that a search learns from, at most: of longer records evenly spread pieces are taken
PIECE = 1000  # rows of such a piece
REACH = 1.2  # products of z are constant beyond this many times the largest |z| that occurs in the fit
STEPS = 8_000  # steps of all segments of one length, about
OVERLAP = 3  # a long segment begins behind this share of the one before
SHORT_OVERLAP = 7  # a short one behind this share
RESTS = 10  # rows at the least or the largest reading, at least, that make it a rail
ROBUST = 1.0  # share of the error of one step that counts as noise in the rows where the state begins
GAINED = 0.95  # try a larger order only if the last one lowered the error to less than this share
SEGMENTS = 5  # segments that fit into the records one behind the other, at least, of the longer kinds
FINALISTS = 2  # orders that are fitted to longer segments too
MOST = 300  # parameters of a model, at most
EACH = 3  # rows for each parameter, at least
_ITERATIONS = 25  # Levenberg-Marquardt steps for each degree
_PATIENCE = 5  # steps in a row that do not lower the error on unseen rows
_CONVERGED = 1e-3  # a step that lowers the squared error by a smaller share is the last
_POLISH = 8  # steps on all rows, at the end
_LOST = 1e3  # an error counts as this many spreads at most


@dataclass(frozen=True, eq=False)
class HiddenStructure(Value):
    """The sizes of a polynomial state-space model, and its errors on unseen rows.

    Attributes
    ----------
    order, degree
        Order of the hidden state, and total degree of the polynomials.
    delays, horizon
        Past rows from which the state begins, and steps of the segments that the fit forecasts; 0 where `subspace` is
        taken as it is.
    rails
        (2, ny) the least and the largest reading of each sensor; None where none saturates.
    errors
        (blocks,) errors in spreads of free runs and forecasts on the last quarter of each record.
    calm
        It stays within three times the range of the data, in free run over each record twice.
    parameters
        Number of coefficients.
    """

    order: int
    degree: int
    delays: int
    horizon: int
    rails: Float[np.ndarray, "2 ny"] | None
    errors: Float[np.ndarray, " blocks"]
    calm: bool
    parameters: int

    @cached_property
    def error(self) -> float:
        """Geometric mean of the errors of the blocks."""
        return float(np.exp(np.log(np.maximum(self.errors, EXACT)).mean()))

    @property
    def is_nonlinear(self) -> bool:
        """Whether the state has products."""
        return self.degree > 1

    def describe(self) -> str:
        """Return a sentence on the model and its error."""
        kind = f"polynomials of degree {self.degree}" if self.is_nonlinear else "linear dynamics"
        how = f"fitted to forecasts of {self.horizon} steps" if self.horizon else "by a subspace method"
        return (
            f"a hidden state of order {self.order} with {kind}, which begins with {self.delays} past rows, {how}; on "
            f"unseen rows, in free run and {HORIZON} steps ahead, it errs by {self.error:.3g} spreads"
        )


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
        within one standard error of the best, in free run and in forecasts of 20 steps on the last quarter of each
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
    limits = None if rails is None else _check_rails(rails, whole.nx)
    lists = check_list(order, 1), check_list(degree, 1), check_list(delays, 1), check_list(horizon, 1)
    found = search_hidden(whole, *lists, rails=limits)
    return fit_hidden(choose_hidden(found), whole)


def choose_hidden(found: Sequence[HiddenStructure]) -> HiddenStructure:
    """Return the structure of the fewest coefficients within one standard error of the best; a calm one if any is."""
    calm = [one for one in found if one.calm] or list(found)
    best = min(calm, key=lambda one: one.error)
    return min(
        (one for one in calm if not is_worse(one.errors, best.errors)), key=lambda one: (one.parameters, one.error)
    )


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
    data = thin_records(episodes)
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
            chain = _fit_chain(data, order, max(degrees), past, horizon, rails)
        except KoopmpcError as error:
            reasons.append(error)
            return
        for model, units in chain:
            degree = model.terms.shape[1]
            if degree in degrees:
                errors = _measure(model, data, units, past)
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


def fit_hidden(structure: HiddenStructure, episodes: Episodes) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure: learned from three quarters of each record, and polished on all rows."""
    s = structure
    if not s.horizon:
        return build_realisation(compute_block_moments(episodes, s.delays), s.order)
    data = thin_records(episodes)
    found, units = _fit_chain(data, s.order, s.degree, s.delays, s.horizon, s.rails)[-1]
    whole = _cut_sets(data, units, s.delays, s.horizon, [(0, len(e)) for e in data])
    theta, _ = minimise(
        SimulationError(found), found.parameters, whole, whole, _POLISH, patience=_PATIENCE, converged=_CONVERGED
    )
    polished = found.with_parameters(theta)
    if s.degree > 1:
        polished = bound_states(polished, whole[0], REACH)
    if is_calm_hidden(polished, data, units, s.delays) or not is_calm_hidden(found, data, units, s.delays):
        found = polished
    return from_standard(found, units, episodes, s.delays, _report(structure, found, units, data))


def find_rails(episodes: Episodes) -> Float[np.ndarray, "2 ny"] | None:
    """Return the rails of sensors that rest at their least or largest reading; None where none does.

    A rail shows in at least ten rows, and at least a quarter of them follow each other.
    """
    rails = np.vstack([np.full(episodes.nx, -np.inf), np.full(episodes.nx, np.inf)])
    Y = np.concatenate([e.X for e in episodes])
    for i, column in enumerate(Y.T):
        for side, value in enumerate((column.min(), column.max())):
            at = column == value
            if at.sum() >= RESTS and (at[1:] & at[:-1]).sum() >= at.sum() / 4 and not at.all():
                rails[side, i] = value
    return rails if np.isfinite(rails).any() else None


def thin_records(episodes: Episodes) -> Episodes:
    """Return the records, of many rows evenly spread pieces."""
    pieces = [
        e.cut(len(e) * i // count, len(e) * (i + 1) // count)
        for e in episodes
        for count in [-(-len(e) // PIECE)]
        for i in range(count)
    ]
    total = sum(map(len, pieces))
    return episodes if total <= ROWS else episodes.with_episodes(pieces[:: -(-total // ROWS)])


def is_calm_hidden(model: HiddenModel, data: Episodes, units: SignalUnits, delays: int) -> bool:
    """Return whether a model stays within three times the range of the data, run over each record twice."""
    for e in data:
        if len(e) <= delays:
            continue
        part = join_segments(cut_segments(data.with_episodes([e]), units, delays, len(e) - delays, 1))
        out = simulate_hidden(model, part.points, np.concatenate([part.inputs, part.inputs]))
        if not (
            np.abs(out) < HELD * np.abs((e.X - units.mean[: units.ny]) / units.scale[: units.ny]).max(axis=0)
        ).all():
            return False
    return True


def _fit_chain(
    data: Episodes, order: int, degree: int, delays: int, horizon: int, rails: Float[np.ndarray, "2 ny"] | None
) -> list[tuple[HiddenModel, SignalUnits]]:
    """Return the models of degrees 1, 2, … that learn from the first three quarters of each record."""
    units = SignalUnits.of(data, rails)
    ends = [round((1 - UNSEEN) * len(e)) for e in data]
    fitted = _cut_sets(data, units, delays, horizon, [(0, a) for a in ends])
    judged = _cut_sets(data, units, delays, horizon, [(a, len(e)) for e, a in zip(data, ends, strict=True)])
    learned = data.with_episodes([e.cut(0, a) for e, a in zip(data, ends, strict=True) if a > 0])
    start = build_realisation(compute_block_moments(learned, delays), order)
    model = normalise(to_standard(start, units), fitted[-1].points)
    noise = _noise_of(start, units)
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


def _noise_of(start: LinearPredictor, units: SignalUnits) -> float:
    """Return the noise in ζ: the error of one step of the linear model, in spreads."""
    assert start.report is not None, "it was fitted"
    return ROBUST * float(np.max(start.report.residual / units.scale[: units.ny]))


def normalise(model: HiddenModel, points: Float[np.ndarray, "m nzeta"]) -> HiddenModel:
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


def _cut_sets(
    data: Episodes, units: SignalUnits, delays: int, horizon: int, spans: Sequence[tuple[int, int]]
) -> list[RecordSegments]:
    """Return long segments, which tell slow modes, and many short ones, which tell where the state begins."""
    room = max(b - max(a, delays) for a, b in spans)
    found: list[RecordSegments] = []
    for steps, overlap in ((max(min(horizon, room), 1), OVERLAP), (max(min(HORIZON, room), 1), SHORT_OVERLAP)):
        total = sum(max(b - max(a, delays) - steps + 1, 0) for a, b in spans)
        apart = max(steps // overlap, total * steps // STEPS, 1)
        found.append(join_segments(cut_segments(data, units, delays, steps, apart, spans)))
    return found


def _measure(model: HiddenModel, data: Episodes, units: SignalUnits, delays: int) -> Float[np.ndarray, " blocks"]:
    """Return errors on four parts of the last quarters, in spreads: geometric means of free run and forecasts."""
    free: list[np.ndarray] = []
    short: list[np.ndarray] = []
    for e in data:
        one, spans = data.with_episodes([e]), [(round((1 - UNSEEN) * len(e)), len(e))]
        ((a, b),) = spans
        for horizon, gaps in ((b - max(a, delays), free), (HORIZON, short)):
            if b - max(a, delays) < max(horizon, 2):
                continue
            part = join_segments(cut_segments(one, units, delays, horizon, horizon, spans))
            out = simulate_hidden(model, part.points, part.inputs)
            if units.rails is not None:
                out = np.clip(out, *units.rails)
            gaps.append((out - part.outputs).transpose(1, 0, 2).reshape(-1, units.ny))
    errors, parts = np.ones(BLOCKS), [np.array_split(np.concatenate(gaps), BLOCKS) for gaps in (free, short) if gaps]
    for part in parts:
        sizes = [np.sqrt(np.mean(np.minimum(np.abs(gap), _LOST) ** 2)) if len(gap) else 1.0 for gap in part]
        errors *= np.maximum(sizes, EXACT) ** (1 / len(parts))
    return errors


def _report(structure: HiddenStructure, found: HiddenModel, units: SignalUnits, data: Episodes) -> FitReport:
    """Return the report of a fit."""
    part = join_segments(cut_segments(data, units, structure.delays, 1, 1))
    size = units.scale[: units.ny]
    gap = simulate_hidden(found, part.points, part.inputs)[0] - part.outputs[0]
    return FitReport(
        method="polynomial_state_space",
        route=f"simulation error over segments of {structure.horizon} steps",
        samples=part.points.shape[0],
        condition=float(np.linalg.cond(start_states(found, part.points))),
        rank=found.E.shape[1],
        columns=found.E.shape[1],
        ridge=0.0,
        residual=size * np.sqrt(np.mean(gap**2, axis=0)),
        state_residual=np.zeros(units.ny),
        changes=(structure.describe(),),
    )


def _check_rails(rails: ArrayLike, ny: int) -> Float[np.ndarray, "2 ny"]:
    """Return the rails, one pair for each output."""
    given = checks.array(rails, "rails", infinite=True)
    if given.shape == (2,):
        given = np.repeat(given[:, None], ny, axis=1)
    return checks.array(given, "rails", (2, ny), infinite=True)
