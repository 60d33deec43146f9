"""Split-conformal bands |x_{k+h} − x̂_{k+h}| ≤ q s_h, and one forecast with its band beside the measured states."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.models.predictors import relift_rollout
from koopmpc.validate.scoring import AnyPredictor, Score, embed_episodes, forecast_errors, score

Rng = np.random.Generator | int

_BLOCKS = 60  # of one record, at most
_SCALE_SHARE = 0.25  # share of the episodes that determine the scale s_h; the others calibrate q
_NORMAL = 1.959964  # two-sided 95 % quantile of the normal distribution


@dataclass(frozen=True, eq=False)
class BandCoverage(Value):
    """Share of forecasts that lie in a band at all of their steps.

    Attributes
    ----------
    share
        Share of the forecasts inside the band, 0 … 1.
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

    The probability is that of a forecast that starts at a random moment of a new episode. This episode must have the
    distribution of the calibration episodes, inputs and initial states included. A controller changes the distribution
    of the inputs: measure the share in the band (`measure_coverage`) and calibrate again (`recalibrate`) on episodes
    of its closed loop.

    Attributes
    ----------
    scale
        (horizon, nx) s_h, root-mean-square errors on episodes that do not calibrate, in the state's unit.
    quantile
        q, the ⌈(n+1) level⌉-th smallest of the n scores max |x − x̂| / s; infinite if this rank is above n.
    level
        1 − α.
    episodes
        n, the number of calibration episodes.
    relift
        True if the forecasts lift x̂ at every step, False if they lift x_k once.
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
        """Least number of calibration episodes for a finite band: 9 for 90 %."""
        return int(np.ceil(self.level / (1 - self.level) - 1e-9))

    def measure_coverage(self, predictor: AnyPredictor, episodes: Episodes, *, rng: Rng = 0) -> BandCoverage:
        """Return the share of forecasts that stay in the band; each episode gives one forecast from a random start."""
        n = len(episodes)
        inside = self._scores(predictor, episodes, rng) <= self.quantile
        p, w = float(np.mean(inside)), _NORMAL**2 / n
        middle, reach = (p + w / 2) / (1 + w), np.sqrt(w * (p * (1 - p) + w / 4)) / (1 + w)
        return BandCoverage(p, float(max(middle - reach, 0.0)), float(min(middle + reach, 1.0)), n)

    def recalibrate(self, predictor: AnyPredictor, episodes: Episodes, *, rng: Rng = 0) -> "ConformalBand":
        """Return a band of the same scale with q from these episodes; its level holds for their distribution."""
        scores = np.sort(self._scores(predictor, episodes, rng))
        rank = int(np.ceil((len(scores) + 1) * self.level - 1e-9))
        quantile = float(scores[rank - 1]) if rank <= len(scores) else np.inf
        return replace(self, quantile=quantile, episodes=len(scores))

    def _scores(self, predictor: AnyPredictor, episodes: Episodes, rng: Rng) -> Float[np.ndarray, " n"]:
        """Return the maximum of |x − x̂| / s over h and states, for one forecast an episode."""
        horizon, source = len(self.scale), checks.generator(rng)
        points = embed_episodes(predictor, episodes, horizon)
        starts = list(source.integers(0, [len(episode) - horizon + 1 for episode in points])[:, None])
        blocks = forecast_errors(predictor, points, starts, horizon, relift=self.relift)
        with np.errstate(over="ignore"):  # a large error over a tiny scale is an infinite score
            return np.concatenate([np.max(np.abs(gap) / self.scale[:, None], axis=(0, 2)) for gap, _ in blocks])


def conformal(
    predictor: AnyPredictor, episodes: Episodes, horizon: int, *, level: float = 0.9, relift: bool = False, rng: Rng = 0
) -> ConformalBand:
    """Return the band x̂_{k+h} ± q s_h that contains a whole forecast with probability ≥ level, for any distribution.

    A random quarter of the episodes determines s_h, the root-mean-square error over all starts. Each of the other
    episodes gives one score: the largest |x − x̂| / s over states and steps of one forecast from a random start. There
    is one score an episode because episodes are exchangeable and steps of one episode are not. q is the
    ⌈(n+1) level⌉-th smallest of the n scores. If no two scores are equal, the average coverage is
    ⌈(n+1) level⌉ / (n+1).

    Parameters
    ----------
    predictor
        A model that was fitted to other episodes.
    episodes
        At least two, each at least `horizon` steps long; or one record, which is cut into blocks of the horizon and the
        model's past. Blocks of one record are exchangeable only about, so its band is a little less sure. If fewer than
        level / (1 − level) of them remain for the calibration (9 for 90 %), no finite band reaches the level, and the
        band is infinite.
    horizon
        Steps ahead.
    level
        1 − α, between 0 and 1.
    relift
        Forecast with the map of `step_map`, which lifts x̂ at every step.
    rng
        Random generator or seed for the split and the starts.

    Raises
    ------
    DataError
        There is only one episode and it is too short for two blocks, one is shorter than the horizon, or the level is
        not between 0 and 1.

    References
    ----------
    Vovk, Gammerman & Shafer, "Algorithmic Learning in a Random World", 2005; Lei et al., "Distribution-free
    predictive inference for regression", J. Am. Stat. Assoc. 113, 2018. For the maximum over the steps of a
    trajectory: Cleaveland et al., "Conformal prediction regions for time series using linear complementarity
    programming", AAAI 2024.
    """
    episodes, level = episodes_of(episodes), float(checks.array(level, "level", ()))
    if not 0 < level < 1:
        raise DataError(f"level is {level:g}; pass a probability between 0 and 1, such as 0.9")
    episodes = cut_record(predictor, episodes, horizon)
    if len(episodes) < 2:
        raise DataError(
            "a conformal band needs two episodes, one for the scale and one to calibrate; got 1, too short for two "
            "blocks of the horizon and the model's past"
        )
    source = checks.generator(rng)
    share = max(round(_SCALE_SHARE * len(episodes)), 1) / len(episodes)
    scaling, calibration = episodes.split(share, source)
    errors = score(predictor, scaling, horizon, relift=relift)
    scale = np.where(np.isfinite(errors.rmse), errors.rmse, np.finfo(float).max)
    size = np.max([np.abs(episode.X).max(axis=0) for episode in scaling], axis=0)
    floor = np.maximum(np.finfo(float).eps * size, np.finfo(float).tiny)  # the scale of a model without errors
    uncalibrated = ConformalBand(np.maximum(scale, floor), np.inf, level, len(calibration), relift, predictor.states)
    return uncalibrated.recalibrate(predictor, calibration, rng=source)


def cut_record(predictor: AnyPredictor, episodes: Episodes, horizon: int) -> Episodes:
    """Return one record in blocks, each as long as the horizon and the model's past; several episodes as they are."""
    if len(episodes) != 1:
        return episodes
    record, past = episodes[0], 0 if predictor.embedding is None else predictor.embedding.steps
    count = min(len(record) // (horizon + past), _BLOCKS)
    if count < 2:
        return episodes
    ends = [len(record) * i // count for i in range(count + 1)]
    return episodes.with_episodes([record.cut(a, b) for a, b in pairwise(ends)])


Bands = ConformalBand | Score | ArrayLike


@dataclass(frozen=True, eq=False)
class Forecast(Value):
    """The prediction x̂_{k+h} of x_{k+h} from x_k and u_k … u_{k+h−1}, h = 0 … horizon.

    Attributes
    ----------
    U
        (T, nu) applied inputs.
    truth, predicted
        (T+1, nx), row 0 is x_k; predictions are NaN from the first one on that overflows.
    low, high
        (T+1, nx) ends of the band; without a band they equal the prediction.
    band
        Name of the band; empty without one.
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
    """Return the forecast x̂_{k+h} together with the measured x_{k+h}, h = 0 … horizon.

    Parameters
    ----------
    predictor
        A model of the states and inputs of the episode.
    episode
        An episode, best one that the model was not fitted to.
    horizon
        Steps ahead; by default to the end of the episode.
    bands
        A conformal band, a score (its 5 and 95 % quantiles of the error), or half-widths (horizon, nx) in the
        state's unit; of `horizon` rows or more.
    start
        k; with an embedding, k counts from the first row that has a complete history.
    relift
        Predict by the map of `step_map`, which lifts x̂ at every step.

    Raises
    ------
    ShapeError
        The episode or the bands have other shapes than the predictor needs.
    DataError
        The episode ends before the horizon, or the conformal band was made with the other value of `relift`.
    """
    checks.members(predictor, "the predictor", ("nx", "nu", "embedding"), "pass one that a fit returned")
    checks.kind(episode, "episode", Episode, "pass one episode, as episodes[0]")
    nx, nu = episode.X.shape[1], episode.U.shape[1]
    if (nx, nu) != (predictor.nx, predictor.nu):
        raise ShapeError(
            f"the episode has {nx} states and {nu} inputs, the predictor {predictor.nx} and {predictor.nu}; "
            "pass an episode of the same plant"
        )
    start = checks.count(start, "start", least=0)
    if predictor.embedding is not None:
        episode = predictor.embed(Episodes([episode], predictor.dt, predictor.states, predictor.inputs))[0]
    available = len(episode) - start
    steps = checks.count(available if horizon is None else horizon, "horizon")
    if steps > available:
        raise DataError(
            f"the episode has {available} steps from step {start} on, the horizon is {steps}; shorten the horizon"
        )
    U, x, W = episode.U[start : start + steps], episode.X[start], episode.W[start : start + steps]
    with np.errstate(over="ignore", invalid="ignore"):
        if relift:
            predicted = relift_rollout(predictor, x, U, W)[:, :nx]
        else:
            predicted = predictor.rollout(x, U, *((W,) if predictor.nw else ()))
    overflowed = ~np.logical_and.accumulate(np.isfinite(predicted).all(axis=1))
    predicted[overflowed] = np.nan
    below, above, name = _band_offsets(bands, steps, nx, relift)
    truth = episode.X[start : start + steps + 1, :nx]
    U, truth, predicted = map(np.ascontiguousarray, (U, truth, predicted))
    low, high = predicted + below, predicted + above
    return Forecast(U, truth, predicted, low, high, name, predictor.dt, predictor.states, predictor.inputs)


def _band_offsets(bands: Bands | None, steps: int, nx: int, relift: bool) -> tuple[np.ndarray, np.ndarray, str]:
    """Return both ends of the band less the prediction, in rows h = 0 … steps, and the name of the band."""
    if bands is None:
        return np.zeros((steps + 1, nx)), np.zeros((steps + 1, nx)), ""
    if isinstance(bands, ConformalBand):
        if bands.relift != relift:
            raise DataError(
                f"the band is for predictions with relift={bands.relift}; pass relift={bands.relift} here too"
            )
        below, above = -bands.width, bands.width
        finite = "" if np.isfinite(bands.quantile) else f", infinite: calibrate on {bands.needed} episodes"
        name = f"{100 * bands.level:g} % conformal band{finite}"
    elif isinstance(bands, Score):
        below, above, name = bands.low, bands.high, "5 to 95 % of the errors"
    else:
        above = checks.array(bands, "bands", (None, nx), infinite=True, finite=False)
        if (above < 0).any():
            raise DataError(f"bands holds {above.min():g}; half-widths are 0 or above")
        below, name = -above, "band"
    if len(above) < steps or above.shape[1] != nx:
        raise ShapeError(
            f"bands has {len(above)} rows of {above.shape[1]}, expected {steps} of {nx}; "
            "make the band for this horizon, or shorten the horizon"
        )
    zero = np.zeros((1, nx))
    return np.vstack([zero, below[:steps]]), np.vstack([zero, above[:steps]]), name
