"""polynomial_state_space and neural_state_space: a hidden state of small order, fitted by simulation error.

Both are one search: `fit_chain` fits models of one order, upwards in degrees or in neurons; orders are tried upwards
until one gains little; the sizes of least error on unseen rows, and of the fewest coefficients among these, are fitted
again by `fit_hidden`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.hidden_fit import (
    LONGER,
    NEURAL,
    NEURONS,
    POLYNOMIAL,
    HiddenSettings,
    fit_chain,
    fit_hidden,
)
from koopmpc.models.records.hidden_structure import (
    HiddenStructure,
    choose_hidden,
    is_calm_hidden,
    measure_hidden,
    thin_records,
)
from koopmpc.models.records.narx import Ask, check_list, source_episodes
from koopmpc.models.records.structure import HORIZON, check_rails, find_forecast_horizon
from koopmpc.models.records.unseen import UNSEEN

ORDERS = (1, 2, 3, 4, 6)  # orders of a polynomial hidden state that are tried
DEGREES = (1, 2, 3)  # total degrees of the polynomials that are tried
DELAYS = (8,)  # past rows from which the state begins
HORIZONS = (50, 200)  # steps of the segments whose errors are minimised
NEURAL_ORDERS = (1, 2, 3, 4)  # orders of a hidden state with neurons that are tried
_SEGMENTS = 5  # segments that fit into the records one behind the other, at least, of the longer kinds
_FINALISTS = 2  # orders that are fitted to longer segments too
_STARTS = 2  # sets of candidates for the neurons that the best order is tried with
_PACE = 10  # the past rows reach over 1/10 of the rows in which the outputs move by their spread
_WINDOWS = (8, 40)  # past rows from which a state with neurons begins, at least and at most
_SHORTER = (50, 200)  # steps of the shorter segments of fits with neurons, at least and at most


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
    whole, limits = _check_records(episodes, rails)
    lists = check_list(order, 1), check_list(degree, 1), check_list(delays, 1), check_list(horizon, 1)
    return fit_hidden(choose_hidden(search_hidden(whole, *lists, rails=limits)), whole)


def neural_state_space(
    episodes: Episodes | Source,
    order: int | Sequence[int] = NEURAL_ORDERS,
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
    whole, limits = _check_records(episodes, rails)
    tried = search_neural(whole, check_list(order, 1), check_list(neurons, 1), check_list(degree, 1), rails=limits)
    model = fit_hidden(choose_hidden(tried), whole)
    assert isinstance(model, BilinearPredictor), "neurons are nonlinear"
    return model


def _check_records(
    episodes: Episodes | Source, rails: ArrayLike | None
) -> tuple[Episodes, Float[np.ndarray, "2 ny"] | None]:
    """Return the records as episodes in memory, and the rails, one pair for each output."""
    source = source_of(episodes)
    if source.disturbances:
        raise DataError("the data have measured disturbances, which this fit does not know; pass them as inputs")
    whole = source_episodes(source)
    return whole, None if rails is None else check_rails(rails, whole.nx)


@dataclass
class _Search:
    """Structures of hidden states, tried one chain after the other, with their errors on the last quarters."""

    episodes: Episodes
    settings: HiddenSettings
    say: Callable[[int], object]  # called with the number of chains done
    tried: list[HiddenStructure] = field(default_factory=list[HiddenStructure])
    chains: int = 0
    reason: KoopmpcError | None = None  # of the first chain that could not be fitted

    def __post_init__(self) -> None:
        self.data = thin_records(self.episodes, self.settings.rows, self.settings.piece)
        self._ahead = find_forecast_horizon(self.episodes)

    def try_chain(self, plan: HiddenStructure, neurons: Sequence[int] = (), *, quick: bool = True) -> None:
        """Fit the models of a chain and measure them."""
        self.say(self.chains)
        self.chains += 1
        data, delays, anywhere = self.data, plan.delays, self.settings.contained
        try:
            for model, units in fit_chain(data, plan, neurons, quick=quick):
                errors = measure_hidden(model, data, units, delays, self._ahead)
                calm = is_calm_hidden(model, data, units, delays, anywhere=anywhere)
                sizes = {"degree": model.terms.shape[1], "neurons": len(model.neurons)}
                sizes["parameters"] = model.E.size + model.neurons.size
                self.tried.append(replace(plan, errors=errors, calm=calm, **sizes))
        except KoopmpcError as error:
            self.reason = self.reason or error

    def climb(self, orders: Sequence[int], try_order: Callable[[int], object]) -> None:
        """Try orders upwards until one gains too little; of models with neurons those count that are calm."""
        least = np.inf
        for order in sorted(orders):
            try_order(order)
            counted = [s.error for s in self.tried if s.calm or not self.settings.contained]
            best = min(counted, default=np.inf)
            if order > 1 and not best < self.settings.gained * least:
                return
            least = best

    def finish(self, advice: str) -> list[HiddenStructure]:
        """Return the structures that were tried."""
        if not self.tried:
            raise self.reason or DataError(f"there is no structure to try; pass {advice}")
        return self.tried


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
    """Return all polynomial structures with their errors on the last quarter of each record."""
    count = len(orders) * len(delays) + _FINALISTS * (len(horizons) - 1)
    name = "hidden states with polynomials"
    search = _Search(episodes, POLYNOMIAL, lambda done: ask and ask(name, done, count))

    def plan(order: int, past: int, horizon: int) -> HiddenStructure:
        return HiddenStructure(order, max(degrees), past, horizon, rails, np.ones(1), False, 0)

    def try_order(order: int) -> None:
        for past in delays:
            search.try_chain(plan(order, past, min(horizons)))

    search.climb(orders, try_order)
    wanted = [s for s in search.tried if s.degree in degrees]
    finalists = dict.fromkeys((s.order, s.delays) for s in sorted(wanted, key=lambda s: s.error)[:_FINALISTS])
    for order, past in finalists:
        for horizon in sorted(horizons)[1:]:
            if horizon * _SEGMENTS > sum(map(len, search.data)):
                break  # too few segments of this length
            search.try_chain(plan(order, past, horizon))
    return [s for s in search.finish("orders and degrees") if s.degree in degrees]


def search_neural(
    episodes: Episodes,
    orders: Sequence[int] = NEURAL_ORDERS,
    neurons: Sequence[int] = NEURONS,
    degrees: Sequence[int] = (1, 2),
    *,
    rails: Float[np.ndarray, "2 ny"] | None = None,
    quick: bool = False,
    ask: Ask | None = None,
) -> list[HiddenStructure]:
    """Return structures with neurons, with their errors on the last quarter of each record.

    Degrees above the first, and other starts for the neurons, are tried with the best order; with `quick` no other
    starts.
    """
    count, name = len(orders) + len(degrees) + _STARTS - 2, "hidden states with neurons"
    search = _Search(episodes, NEURAL, lambda done: ask and ask(name, done, count))
    delays, horizon = choose_window(search.data)

    def try_order(order: int, degree: int = min(degrees), start: int = 0) -> None:
        plan = HiddenStructure(order, degree, delays, horizon, rails, np.ones(1), False, 0, start=start)
        search.try_chain(plan, neurons, quick=quick)

    search.climb(orders, try_order)
    if search.tried:
        best = choose_hidden(search.tried)
        for degree in sorted(degrees)[1:]:
            try_order(best.order, degree)
        for start in range(1, 1 if quick else _STARTS):
            try_order(best.order, start=start)
    return search.finish("orders and neurons")


def choose_window(data: Episodes) -> tuple[int, int]:
    """Return the past rows from which a state begins and the steps of long segments, by the pace of the outputs.

    The pace is the number of rows in which an output moves by its spread: √(spread² / mean square of its differences).
    """
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    moves = np.sqrt(np.mean(np.concatenate([np.diff(e.X, axis=0) for e in data]) ** 2, axis=0))
    live = (spread > 0) & (moves > 0)
    pace = float(np.min(spread[live] / moves[live])) if live.any() else 1.0
    delays = int(np.clip(round(pace / _PACE), *_WINDOWS))
    short = int(np.clip(round(pace / 3), *_SHORTER))
    room = min(round((1 - UNSEEN) * len(e)) for e in data) - delays
    return delays, min(LONGER * short, max(room // 2, HORIZON))
