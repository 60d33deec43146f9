"""The error of a predictor over a horizon, on episodes that it was not fitted to."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.predict.spectrum import same_names
from koopmpc.values import Value

AnyPredictor = LinearPredictor | BilinearPredictor

_STARTS = 4096  # starts that are rolled out at once
_FORECAST = 2**22  # numbers of one block of forecasts, 32 MB
_KEPT = 2**20  # errors that the quantiles are taken of, over all states and steps
_LEAST = 256  # starts that the quantiles are taken of, at least
BAND = (0.05, 0.5, 0.95)  # the quantiles of a score


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
    low, median, high
        (horizon, nx) 5, 50 and 95 % quantiles over the starts of the error x_{k+h} − x̂_{k+h}, in the state's unit:
        nine truths in ten lie between x̂ + low and x̂ + high. Where there are many starts they come from an evenly
        spread part of them, a million errors in all.
    """

    rmse: Float[np.ndarray, "horizon nx"]
    relative: Float[np.ndarray, "horizon nx"]
    starts: int
    states: tuple[str, ...]
    low: Float[np.ndarray, "horizon nx"]
    median: Float[np.ndarray, "horizon nx"]
    high: Float[np.ndarray, "horizon nx"]

    @property
    def horizon(self) -> int:
        """Number of steps ahead."""
        return len(self.rmse)

    @property
    def total(self) -> float:
        """One number to choose a model by: the root-mean-square of `relative` over horizon and states."""
        return float(np.sqrt(np.mean(self.relative**2)))


def score(predictor: AnyPredictor, episodes: Episodes, horizon: int, *, stride: int = 1, relift: bool = False) -> Score:
    """Return the errors of x̂_{k+h} = C z_h, z_{i+1} = A z_i + B u_{k+i} + E w_{k+i}, z_0 = ψ(x_k), h = 1 … horizon.

    A bilinear predictor adds Σ uⱼ Nⱼ z_i. A prediction that leaves the finite numbers has an infinite error.

    Parameters
    ----------
    predictor
        Linear or bilinear, of the same states, inputs and dt.
    episodes
        Held out of the fit; each at least `horizon` steps long, and those of the embedding where there is one, which
        come before the first start.
    horizon
        Steps ahead; that of the controller is the one to choose a lifting by.
    stride
        Start at every k that is a multiple of this.
    relift
        Score the map of `step_map` instead, which lifts x̂ anew at every step: z_i = ψ(x̂_{k+i}).

    Raises
    ------
    DataError
        An episode is shorter than the horizon, or has another dt.
    ShapeError
        The episodes have other states or inputs.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> train, held_out = data.split(0.8, rng=0)
    >>> found = km.score(km.edmd(train, km.State() + km.Fourier(1, states="theta")), held_out, horizon=10)
    >>> found.rmse.shape  # a row a step ahead, a column a state, in its unit
    (10, 2)
    """
    horizon, stride = checks.count(horizon, "horizon"), checks.count(stride, "stride")
    points = comparable(predictor, episodes, horizon)
    every = [np.arange(0, len(episode) - horizon + 1, stride) for episode in points]
    starts = sum(map(len, every))
    nx = predictor.nx
    apart = -(-starts // max(_LEAST, _KEPT // (horizon * nx)))  # each apart-th start counts for the quantiles
    kept = np.empty((horizon, nx, -(-starts // apart)))
    error, size = np.zeros((horizon, nx)), np.zeros((horizon, nx))
    done = 0
    for gap, truth in forecast_errors(predictor, points, every, horizon, relift=relift):
        with np.errstate(over="ignore"):  # an infinite sum is what a diverging prediction has
            error += np.einsum("hmx,hmx->hx", gap, gap)
        size += np.einsum("hmx,hmx->hx", truth, truth)
        first = -(-done // apart)
        part = gap[:, first * apart - done :: apart]
        kept[:, :, first : first + part.shape[1]] = part.transpose(0, 2, 1)
        done += gap.shape[1]
    rmse, truths = np.sqrt(error / starts), np.sqrt(size / starts)
    relative = np.divide(rmse, truths, out=np.where(rmse > 0, np.inf, 0.0), where=truths > 0)
    count = kept.shape[2]
    places = [max(int(np.ceil(q * count - 1e-9)) - 1, 0) for q in BAND]  # the inverse of the empirical distribution
    kept.partition(places, axis=2)
    low, median, high = (np.ascontiguousarray(kept[:, :, place]) for place in places)
    return Score(rmse, relative, starts, predictor.states, low, median, high)


def comparable(predictor: AnyPredictor, episodes: Episodes, horizon: int) -> Episodes:
    """Return the episodes of what ψ acts on; raise where one is too short for `horizon` steps from any start."""
    models = LinearPredictor, BilinearPredictor
    checks.kind(predictor, "predictor", models, "pass what a fit returns; of a controller its .predictor")
    same_names(predictor, episodes_of(episodes))
    points = predictor.embed(episodes)
    for i, episode in enumerate(points):
        if len(episode) < horizon:
            past = "" if predictor.embedding is None else f" behind the {predictor.embedding.steps} of the embedding"
            raise DataError(
                f"episode {i} has {len(episode)} steps{past}, the horizon is {horizon}; "
                "shorten the horizon or drop the episode"
            )
    return points


def forecast_errors(
    predictor: AnyPredictor,
    points: Episodes,
    starts: Sequence[Int[np.ndarray, "_"]],
    horizon: int,
    *,
    relift: bool = False,
) -> Iterator[tuple[Float[np.ndarray, "horizon m nx"], Float[np.ndarray, "horizon m nx"]]]:
    """Yield x_{k+h} − x̂_{k+h} and x_{k+h} for the sorted starts k of each episode in order, block by block.

    The episodes are those that `comparable` returns.
    """
    A, C = predictor.A.T, predictor.C.T
    bilinear = isinstance(predictor, BilinearPredictor)
    G = predictor.B.T if bilinear else np.hstack([predictor.B, predictor.E]).T
    for X, V, rows in _blocks(points, starts, horizon, 0 if bilinear else predictor.nw):
        point = X[rows]
        z = predictor.lifting(point)
        truth = np.empty((horizon, len(rows), predictor.nx))
        gap = np.empty_like(truth)
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging prediction is an infinite error
            for h in range(horizon):
                v = V[rows + h]
                z_next = z @ A + v @ G
                if bilinear:
                    for i, N in enumerate(predictor.N):
                        z_next += v[:, i : i + 1] * (z @ N.T)
                truth[h] = X[rows + h + 1, : predictor.nx]
                x = z_next @ C
                np.subtract(truth[h], x, out=gap[h])
                if relift:
                    past = predictor.embedding
                    point = x if past is None else past.shifted(point, v[:, : predictor.nu], x)
                    z_next = predictor.lifting(point)
                z = z_next
        gap[np.isnan(gap)] = np.inf
        yield gap, truth


_Slice = tuple[Episode, Int[np.ndarray, "_"]]  # an episode and the starts in it
_Block = tuple[Float[np.ndarray, "m nx"], Float[np.ndarray, "m nv"], Int[np.ndarray, " n"]]


def _blocks(episodes: Episodes, starts: Sequence[Int[np.ndarray, "_"]], horizon: int, nw: int) -> Iterator[_Block]:
    """Yield slices of episodes, several short ones or a part of a long one, with a bounded number of starts."""
    room = most = max(1, min(_STARTS, _FORECAST // (horizon * episodes.nx)))
    slices: list[_Slice] = []
    for episode, every in zip(episodes, starts, strict=True):
        first = 0
        while first < len(every):
            part = every[first : first + room]
            slices.append((episode, part))
            first, room = first + len(part), room - len(part)
            if room == 0:
                yield _joined(slices, horizon, nw)
                slices, room = [], most
    if slices:
        yield _joined(slices, horizon, nw)


def _joined(slices: list[_Slice], horizon: int, nw: int) -> _Block:
    """Return states, inputs on the same rows (0 on the last of a slice), and the rows of the starts."""
    X: list[np.ndarray] = []
    V: list[np.ndarray] = []
    rows: list[np.ndarray] = []
    offset = 0
    for episode, part in slices:
        first, last = int(part[0]), int(part[-1]) + horizon
        X.append(episode.X[first : last + 1])
        V.append(np.hstack([episode.U[first:last], episode.W[first:last, :nw]]))
        V.append(np.zeros((1, V[-1].shape[1])))
        rows.append(part - first + offset)
        offset += last + 1 - first
    return np.concatenate(X), np.concatenate(V), np.concatenate(rows)
