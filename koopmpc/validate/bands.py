"""Split-conformal prediction bands: |x_{k+h} − x̂_{k+h}| ≤ q s_h for all states and steps at once, nine times in ten."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.validate.scoring import Predictor, comparable, forecast_errors, score
from koopmpc.values import Value

_SCALED = 0.25  # share of the episodes that the scale is taken from
_NORMAL = 1.959964  # two-sided 95 % of a normal law


@dataclass(frozen=True, eq=False)
class Covered(Value):
    """How many forecasts lay in a band throughout.

    Attributes
    ----------
    share
        Of the episodes.
    low, high
        Wilson's 95 % interval of it.
    episodes
        How many, one forecast each.
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
        n, those of the calibration.
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

    def measured(self, predictor: Predictor, episodes: Episodes, *, rng: np.random.Generator | int = 0) -> Covered:
        """Return the share of these episodes whose forecast, from one random start each, stays in the band."""
        n = len(episodes)
        inside = self._scores(predictor, episodes, rng) <= self.quantile
        p, w = float(np.mean(inside)), _NORMAL**2 / n
        middle, reach = (p + w / 2) / (1 + w), np.sqrt(w * (p * (1 - p) + w / 4)) / (1 + w)
        return Covered(p, float(max(middle - reach, 0.0)), float(min(middle + reach, 1.0)), n)

    def recalibrated(
        self, predictor: Predictor, episodes: Episodes, *, rng: np.random.Generator | int = 0
    ) -> "ConformalBand":
        """Return the band of the same scale whose q comes from these episodes: its promise holds for their law."""
        scores = np.sort(self._scores(predictor, episodes, rng))
        rank = int(np.ceil((len(scores) + 1) * self.level - 1e-9))
        quantile = float(scores[rank - 1]) if rank <= len(scores) else np.inf
        return replace(self, quantile=quantile, episodes=len(scores))

    def _scores(
        self, predictor: Predictor, episodes: Episodes, rng: np.random.Generator | int
    ) -> Float[np.ndarray, " n"]:
        """Return max over h and states of |x − x̂| / s, one forecast an episode."""
        horizon, source = len(self.scale), checks.generator(rng)
        points = comparable(predictor, episodes, horizon)
        starts = list(source.integers(0, [len(episode) - horizon + 1 for episode in points])[:, None])
        blocks = forecast_errors(predictor, points, starts, horizon, relift=self.relift)
        with np.errstate(over="ignore"):  # an error far beyond a tiny scale
            return np.concatenate([np.max(np.abs(gap) / self.scale[:, None], axis=(0, 2)) for gap, _ in blocks])


def conformal(
    predictor: Predictor,
    episodes: Episodes,
    horizon: int,
    *,
    level: float = 0.9,
    relift: bool = False,
    rng: np.random.Generator | int = 0,
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
