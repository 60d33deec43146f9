"""Split-conformal bands |x_{k+h} − x̂_{k+h}| ≤ q s_h, and one forecast with its band beside what happened."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, ShapeError
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.validate.scoring import AnyPredictor, Score, comparable, forecast_errors, score
from koopmpc.values import Value

Rng = np.random.Generator | int

_SCALED = 0.25  # share of the episodes that give the scale
_NORMAL = 1.959964  # two-sided 95 % of a normal law


@dataclass(frozen=True, eq=False)
class Covered(Value):
    """The number of forecasts that lay in a band at all of their steps.

    Attributes
    ----------
    share
        Share of the episodes whose forecast did.
    low, high
        Wilson's 95 % interval of that share.
    episodes
        Number of episodes, with one forecast each.
    """

    share: float
    low: float
    high: float
    episodes: int


@dataclass(frozen=True, eq=False)
class ConformalBand(Value):
    """x_{k+h} ∈ x̂_{k+h} ± q s_h for all states and all h = 1 … horizon at once, with probability ≥ level.

    The promise is for a forecast that starts at a random moment of a new episode of the same law, inputs and
    initial states included, as those of the calibration. A controller changes the law of the inputs: measure
    (`measured`) and calibrate again (`recalibrated`) on episodes of its closed loop.

    Attributes
    ----------
    scale
        (horizon, nx) s_h, root-mean-square errors of episodes apart, in the state's unit.
    quantile
        q, the ⌈(n+1) level⌉-th smallest of the n scores max |x − x̂| / s; infinite where that is beyond n.
    level
        1 − α.
    episodes
        n, the number of calibration episodes.
    relift
        The forecasts lift x̂ anew at every step.
    states
        Names of the columns.
    """

    scale: Float[np.ndarray, "horizon nx"]
    quantile: float
    level: float
    episodes: int
    relift: bool
    states: tuple[str, ...]

    @property
    def width(self) -> Float[np.ndarray, "horizon nx"]:
        """Half-width q s_h of the band, in the state's unit; infinite with too few episodes."""
        with np.errstate(over="ignore"):
            return self.quantile * self.scale

    @property
    def needed(self) -> int:
        """Calibration episodes from which the band is finite: 9 for 90 %."""
        return int(np.ceil(self.level / (1 - self.level) - 1e-9))

    def measured(self, predictor: AnyPredictor, episodes: Episodes, *, rng: Rng = 0) -> Covered:
        """Return the share of these episodes whose forecast, from one random start each, stays in the band."""
        n = len(episodes)
        inside = self._scores(predictor, episodes, rng) <= self.quantile
        p, w = float(np.mean(inside)), _NORMAL**2 / n
        middle, reach = (p + w / 2) / (1 + w), np.sqrt(w * (p * (1 - p) + w / 4)) / (1 + w)
        return Covered(p, float(max(middle - reach, 0.0)), float(min(middle + reach, 1.0)), n)

    def recalibrated(self, predictor: AnyPredictor, episodes: Episodes, *, rng: Rng = 0) -> "ConformalBand":
        """Return the band of the same scale whose q comes from these episodes: its promise holds for their law."""
        scores = np.sort(self._scores(predictor, episodes, rng))
        rank = int(np.ceil((len(scores) + 1) * self.level - 1e-9))
        quantile = float(scores[rank - 1]) if rank <= len(scores) else np.inf
        return replace(self, quantile=quantile, episodes=len(scores))

    def _scores(self, predictor: AnyPredictor, episodes: Episodes, rng: Rng) -> Float[np.ndarray, " n"]:
        """Return max over h and states of |x − x̂| / s, one forecast an episode."""
        horizon, source = len(self.scale), checks.generator(rng)
        points = comparable(predictor, episodes, horizon)
        starts = list(source.integers(0, [len(episode) - horizon + 1 for episode in points])[:, None])
        blocks = forecast_errors(predictor, points, starts, horizon, relift=self.relift)
        with np.errstate(over="ignore"):  # an error far beyond a tiny scale
            return np.concatenate([np.max(np.abs(gap) / self.scale[:, None], axis=(0, 2)) for gap, _ in blocks])


def conformal(
    predictor: AnyPredictor, episodes: Episodes, horizon: int, *, level: float = 0.9, relift: bool = False, rng: Rng = 0
) -> ConformalBand:
    """Return the band x̂_{k+h} ± q s_h that holds a whole forecast with probability ≥ level, whatever the law.

    A quarter of the episodes, drawn at random, gives s_h, the root-mean-square error over all starts. Each of
    the others gives one score: the largest |x − x̂| / s over states and steps of one forecast from a random
    start, for the steps of an episode are not exchangeable and episodes are. q is the ⌈(n+1) level⌉-th smallest
    of the n scores. Where the scores have no ties, the coverage is ⌈(n+1) level⌉ / (n+1) on average.

    Parameters
    ----------
    predictor
        Fitted to other episodes.
    episodes
        At least two, each at least `horizon` steps long. With fewer than level / (1 − level) of them left for
        the calibration (9 for 90 %) no finite band can promise the level, and the band is infinite.
    horizon
        Steps ahead.
    level
        1 − α, between 0 and 1.
    relift
        Forecast with the map of `step_map`, which lifts x̂ anew at every step.
    rng
        Draws the split and the starts.

    Raises
    ------
    DataError
        There is one episode, one is shorter than the horizon, or the level is not between 0 and 1.

    References
    ----------
    Vovk, Gammerman & Shafer, "Algorithmic Learning in a Random World", 2005; Lei et al., "Distribution-free
    predictive inference for regression", J. Am. Stat. Assoc. 113, 2018; the maximum over the steps of a
    trajectory: Cleaveland et al., "Conformal prediction regions for time series using linear complementarity
    programming", AAAI 2024.
    """
    level = float(checks.array(level, "level", ()))
    if not 0 < level < 1:
        raise DataError(f"level is {level:g}; pass a probability between 0 and 1, such as 0.9")
    if len(episodes) < 2:
        raise DataError("a conformal band needs two episodes, one for the scale and one to calibrate; got 1")
    source = checks.generator(rng)
    share = max(round(_SCALED * len(episodes)), 1) / len(episodes)
    scaling, calibration = episodes.split(share, source)
    errors = score(predictor, scaling, horizon, relift=relift)
    scale = np.where(np.isfinite(errors.rmse), errors.rmse, np.finfo(float).max)
    size = np.max([np.abs(episode.X).max(axis=0) for episode in scaling], axis=0)
    floor = np.maximum(np.finfo(float).eps * size, np.finfo(float).tiny)  # a perfect model has no error to scale by
    unset = ConformalBand(np.maximum(scale, floor), np.inf, level, len(calibration), relift, predictor.states)
    return unset.recalibrated(predictor, calibration, rng=source)


Bands = ConformalBand | Score | ArrayLike


@dataclass(frozen=True, eq=False)
class Forecast(Value):
    """The prediction x̂_{k+h} of x_{k+h} from x_k and u_k … u_{k+h−1}, h = 0 … horizon.

    Attributes
    ----------
    U
        (T, nu) inputs as applied.
    truth, predicted
        (T+1, nx), row 0 is x_k; a prediction that leaves the finite numbers is NaN from there on.
    low, high
        (T+1, nx) ends of the band, at the prediction where there is none.
    band
        What the band is, in words; empty where there is none.
    dt, states, inputs
        Sample time [s] and names of the predictor.
    """

    U: Float[np.ndarray, "T nu"]
    truth: Float[np.ndarray, "T+1 nx"]
    predicted: Float[np.ndarray, "T+1 nx"]
    low: Float[np.ndarray, "T+1 nx"]
    high: Float[np.ndarray, "T+1 nx"]
    band: str
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]

    @property
    def time(self) -> Float[np.ndarray, " T1"]:
        """Time ahead of every row [s]."""
        return np.arange(len(self.truth)) * self.dt


def forecast(
    predictor: AnyPredictor,
    episode: Episode,
    horizon: int | None = None,
    *,
    bands: Bands | None = None,
    start: int = 0,
    relift: bool = False,
) -> Forecast:
    """Return x̂_{k+h} for h = 0 … horizon beside the episode's x_{k+h}.

    Parameters
    ----------
    predictor
        A model of the states and inputs of the episode.
    episode
        An episode, best one that is not of the fit.
    horizon
        Steps ahead; to the end of the episode by default.
    bands
        A conformal band, a score (its 5 and 95 % quantiles of the error), or half-widths (horizon, nx) in the
        state's unit; for the horizon or longer.
    start
        k; with an embedding counted from the first moment whose past is known.
    relift
        Predict by the map of `step_map`, which lifts x̂ anew at every step.

    Raises
    ------
    ShapeError
        The episode, or the bands, do not fit the predictor.
    DataError
        The episode ends before the horizon; the conformal band is for predictions that are lifted otherwise.
    """
    nx, nu = episode.X.shape[1], episode.U.shape[1]
    if (nx, nu) != (predictor.nx, predictor.nu):
        raise ShapeError(
            f"the episode has {nx} states and {nu} inputs, the predictor {predictor.nx} and {predictor.nu}; "
            "pass an episode of the same plant"
        )
    start = checks.count(start, "start", least=0)
    if predictor.embedding is not None:
        episode = predictor.embed(Episodes([episode], predictor.dt, predictor.states, predictor.inputs))[0]
    left = len(episode) - start
    steps = checks.count(left if horizon is None else horizon, "horizon")
    if steps > left:
        raise DataError(
            f"the episode has {left} steps from step {start} on, the horizon is {steps}; shorten the horizon"
        )
    U, x, W = episode.U[start : start + steps], episode.X[start], episode.W[start : start + steps]
    with np.errstate(over="ignore", invalid="ignore"):
        if relift:
            predicted = predictor.step_map().rollout(x, U)[:, :nx]
        else:
            known = (W,) if isinstance(predictor, LinearPredictor) and predictor.nw else ()
            predicted = predictor.rollout(x, U, *known)
    lost = ~np.logical_and.accumulate(np.isfinite(predicted).all(axis=1))
    predicted[lost] = np.nan
    below, above, words = _offsets(bands, steps, nx, relift)
    truth = episode.X[start : start + steps + 1, :nx]
    U, truth, predicted = map(np.ascontiguousarray, (U, truth, predicted))
    low, high = predicted + below, predicted + above
    return Forecast(U, truth, predicted, low, high, words, predictor.dt, predictor.states, predictor.inputs)


def _offsets(bands: Bands | None, steps: int, nx: int, relift: bool) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the widths of the band below and above the prediction, in rows h = 0 … steps, and the name of the band."""
    if bands is None:
        return np.zeros((steps + 1, nx)), np.zeros((steps + 1, nx)), ""
    if isinstance(bands, ConformalBand):
        if bands.relift != relift:
            raise DataError(
                f"the band is for predictions with relift={bands.relift}; pass relift={bands.relift} here too"
            )
        below, above = -bands.width, bands.width
        finite = "" if np.isfinite(bands.quantile) else f", infinite: calibrate on {bands.needed} episodes"
        words = f"{100 * bands.level:g} % conformal band{finite}"
    elif isinstance(bands, Score):
        below, above, words = bands.low, bands.high, "5 to 95 % of the errors"
    else:
        above = checks.array(bands, "bands", (None, nx), infinite=True, finite=False)
        if (above < 0).any():
            raise DataError(f"bands holds {above.min():g}; half-widths are 0 or above")
        below, words = -above, "band"
    if len(above) < steps or above.shape[1] != nx:
        raise ShapeError(
            f"bands has {len(above)} rows of {above.shape[1]}, expected {steps} of {nx}; "
            "make it for the horizon, or shorten that"
        )
    zero = np.zeros((1, nx))
    return np.vstack([zero, below[:steps]]), np.vstack([zero, above[:steps]]), words
