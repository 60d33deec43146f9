"""One forecast beside what happened: truth, prediction and band from one moment of an episode on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, ShapeError
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.validate.bands import ConformalBand
from koopmpc.validate.scoring import Predictor, Score
from koopmpc.values import Value

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
        As in the predictor.
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
    predictor: Predictor,
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
        Of the states and inputs of the episode.
    episode
        Best held out of the fit.
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
    if (episode.X.shape[1], episode.U.shape[1]) != (predictor.nx, predictor.nu):
        raise ShapeError(
            f"the episode has {episode.X.shape[1]} states and {episode.U.shape[1]} inputs, the predictor "
            f"{predictor.nx} and {predictor.nu}; pass an episode of the same plant"
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
    U, x = episode.U[start : start + steps], episode.X[start]
    with np.errstate(over="ignore", invalid="ignore"):
        if relift:
            predicted = predictor.step_map().rollout(x, U)[:, : predictor.nx]
        elif isinstance(predictor, LinearPredictor) and predictor.nw:
            predicted = predictor.rollout(x, U, episode.W[start : start + steps])
        else:
            predicted = predictor.rollout(x, U)
    lost = ~np.logical_and.accumulate(np.isfinite(predicted).all(axis=1))
    predicted[lost] = np.nan
    below, above, words = _offsets(bands, steps, predictor.nx, relift)
    truth = episode.X[start : start + steps + 1, : predictor.nx]
    return Forecast(
        np.ascontiguousarray(U),
        np.ascontiguousarray(truth),
        np.ascontiguousarray(predicted),
        predicted + below,
        predicted + above,
        words,
        predictor.dt,
        predictor.states,
        predictor.inputs,
    )


def _offsets(bands: Bands | None, steps: int, nx: int, relift: bool) -> tuple[np.ndarray, np.ndarray, str]:
    """Return how far the band reaches below and above the prediction, rows h = 0 … steps, and what it is."""
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
