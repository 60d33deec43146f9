"""The error of a predictor over a horizon, on episodes that it was not fitted to."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError
from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.spectrum import same_names
from koopmpc.values import Value

_STARTS = 4096  # starts that are rolled out at once


@dataclass(frozen=True, eq=False)
class Score(Value):
    """Errors of the prediction of x_{k+h} from x_k and u_k … u_{k+h−1}, lifted once at k.

    Attributes
    ----------
    rmse
        (horizon, nx) root-mean-square over all starts k, row h−1 for h steps ahead, in the state's unit.
    relative
        (horizon, nx) `rmse` over the root-mean-square of the true x_{k+h}.
    starts
        How many k.
    states
        Names of the columns.
    """

    rmse: Float[np.ndarray, "horizon nx"]
    relative: Float[np.ndarray, "horizon nx"]
    starts: int
    states: tuple[str, ...]

    @property
    def horizon(self) -> int:
        """Number of steps ahead."""
        return len(self.rmse)

    @property
    def total(self) -> float:
        """One number to choose a model by: the root-mean-square of `relative` over horizon and states."""
        return float(np.sqrt(np.mean(self.relative**2)))


def score(predictor: LinearPredictor, episodes: Episodes, horizon: int, *, stride: int = 1) -> Score:
    """Return the errors of x̂_{k+h} = C z_h, z_{i+1} = A z_i + B u_{k+i} + E w_{k+i}, z_0 = ψ(x_k), h = 1 … horizon.

    Parameters
    ----------
    predictor
        Of the same states, inputs and dt.
    episodes
        Held out of the fit; each at least `horizon` steps long.
    horizon
        Steps ahead; that of the controller is the one to choose a lifting by.
    stride
        Start at every k that is a multiple of this.

    Raises
    ------
    DataError
        An episode is shorter than the horizon, or has another dt.
    ShapeError
        The episodes have other states or inputs.
    """
    horizon, stride = checks.count(horizon, "horizon"), checks.count(stride, "stride")
    same_names(predictor, episodes)
    error, size = np.zeros((horizon, predictor.nx)), np.zeros((horizon, predictor.nx))
    starts = 0
    for i, episode in enumerate(episodes):
        if len(episode) < horizon:
            raise DataError(
                f"episode {i} has {len(episode)} steps, the horizon is {horizon}; "
                "shorten the horizon or drop the episode"
            )
        every = np.arange(0, len(episode) - horizon + 1, stride)
        starts += len(every)
        for first in range(0, len(every), _STARTS):
            _add(predictor, episode, every[first : first + _STARTS], error, size)
    rmse, truth = np.sqrt(error / starts), np.sqrt(size / starts)
    relative = np.divide(rmse, truth, out=np.where(rmse > 0, np.inf, 0.0), where=truth > 0)
    return Score(rmse, relative, starts, predictor.states)


def _add(
    predictor: LinearPredictor,
    episode: Episode,
    starts: np.ndarray,
    error: Float[np.ndarray, "horizon nx"],
    size: Float[np.ndarray, "horizon nx"],
) -> None:
    """Add the squared errors and states of these starts, row h−1 for h steps ahead."""
    z = predictor.lift(episode.X[starts])
    for h in range(1, len(error) + 1):
        z = z @ predictor.A.T + episode.U[starts + h - 1] @ predictor.B.T
        if predictor.nw:
            z += episode.W[starts + h - 1] @ predictor.E.T
        truth = episode.X[starts + h]
        error[h - 1] += np.sum((z @ predictor.C.T - truth) ** 2, axis=0)
        size[h - 1] += np.sum(truth**2, axis=0)
