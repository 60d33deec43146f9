"""Errors of a predictor over a horizon, on episodes that it was not fitted to."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.spectrum import check_same_names

AnyPredictor = LinearPredictor | BilinearPredictor

_BLOCK_STARTS = 4096  # largest number of starts in one block of rollouts
_BLOCK_NUMBERS = 2**22  # largest number of entries in one block of forecasts, 32 MB
_QUANTILE_ERRORS = 2**20  # quantiles read about this many errors, over all states and steps
_QUANTILE_STARTS = 256  # quantiles read at least this many starts, if there are as many
_QUANTILES = (0.05, 0.5, 0.95)  # low, median and high of a score


@dataclass(frozen=True, eq=False)
class Score(Value):
    """Errors of predictions of x_{k+h} from x_k and u_k … u_{k+h−1}.

    Attributes
    ----------
    rmse
        (horizon, nx) root-mean-square error over all starts k, row h−1 for h steps ahead, in the state's unit.
    relative
        (horizon, nx) `rmse` over the root-mean-square of the true x_{k+h}.
    starts
        Number of starts k.
    states
        Names of the columns.
    low, median, high
        (horizon, nx) 5, 50 and 95 % quantiles over the starts of the error x_{k+h} − x̂_{k+h}, in the state's unit:
        90 % of the true states lie between x̂ + low and x̂ + high. If there are many starts, the quantiles use every
        n-th of them, about a million errors in all.
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
        """Root-mean-square of `relative` over horizon and states: one number to compare models by."""
        return float(np.sqrt(np.mean(self.relative**2)))


def score(predictor: AnyPredictor, episodes: Episodes, horizon: int, *, stride: int = 1, relift: bool = False) -> Score:
    """Return the errors of x̂_{k+h} = C z_h, z_{i+1} = A z_i + B u_{k+i} + E w_{k+i}, z_0 = ψ(x_k), h = 1 … horizon.

    A bilinear predictor adds Σ uⱼ Nⱼ z_i. A prediction that overflows has an infinite error.

    Parameters
    ----------
    predictor
        Linear or bilinear, with the states, inputs and dt of the episodes.
    episodes
        Episodes that the model was not fitted to, each at least `horizon` steps long. An embedding needs its own steps
        in addition, before the first start.
    horizon
        Steps ahead; use the controller's horizon to compare liftings.
    stride
        Start at every k that is a multiple of this.
    relift
        Score the map of `step_map` instead, which lifts x̂ at every step: z_i = ψ(x̂_{k+i}).

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
    >>> errors = km.score(km.edmd(train, km.State() + km.Fourier(1, states="theta")), held_out, horizon=10)
    >>> errors.rmse.shape  # a row for each step ahead, a column for each state, in its unit
    (10, 2)
    """
    horizon, stride = checks.count(horizon, "horizon"), checks.count(stride, "stride")
    points = embed_episodes(predictor, episodes, horizon)
    starts = [np.arange(0, len(episode) - horizon + 1, stride) for episode in points]
    total = sum(map(len, starts))
    nx = predictor.nx
    apart = -(-total // max(_QUANTILE_STARTS, _QUANTILE_ERRORS // (horizon * nx)))  # quantiles use each apart-th start
    sample = np.empty((horizon, nx, -(-total // apart)))
    error, size = np.zeros((horizon, nx)), np.zeros((horizon, nx))
    done = 0
    for gap, truth in forecast_errors(predictor, points, starts, horizon, relift=relift):
        with np.errstate(over="ignore"):  # the sum of a diverging prediction is infinite
            error += np.einsum("hmx,hmx->hx", gap, gap)
        size += np.einsum("hmx,hmx->hx", truth, truth)
        first = -(-done // apart)
        part = gap[:, first * apart - done :: apart]
        sample[:, :, first : first + part.shape[1]] = part.transpose(0, 2, 1)
        done += gap.shape[1]
    rmse, truths = np.sqrt(error / total), np.sqrt(size / total)
    relative = np.divide(rmse, truths, out=np.where(rmse > 0, np.inf, 0.0), where=truths > 0)
    count = sample.shape[2]
    ranks = [max(int(np.ceil(q * count - 1e-9)) - 1, 0) for q in _QUANTILES]  # inverse of the empirical distribution
    sample.partition(ranks, axis=2)
    low, median, high = (np.ascontiguousarray(sample[:, :, rank]) for rank in ranks)
    return Score(rmse, relative, total, predictor.states, low, median, high)


def embed_episodes(predictor: AnyPredictor, episodes: Episodes, horizon: int) -> Episodes:
    """Return the episodes in the predictor's embedding; raise if one is shorter than `horizon` steps."""
    models = LinearPredictor, BilinearPredictor
    checks.kind(predictor, "predictor", models, "pass what a fit returns; of a controller its .predictor")
    check_same_names(predictor, episodes_of(episodes))
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
    """Yield the errors x_{k+h} − x̂_{k+h} and the states x_{k+h} in blocks of starts k.

    The episodes are those that `embed_episodes` returns. The starts of each episode ascend, and the blocks keep their
    order.
    """
    for gaps, truth in compare_forecasts([predictor], points, starts, horizon, relift=relift):
        yield gaps[0], truth


def compare_forecasts(
    models: Sequence[AnyPredictor],
    points: Episodes,
    starts: Sequence[Int[np.ndarray, "_"]],
    horizon: int,
    *,
    relift: bool = False,
) -> Iterator[tuple[Float[np.ndarray, "models horizon m nx"], Float[np.ndarray, "horizon m nx"]]]:
    """Yield `forecast_errors` of several models at once, which share lifting, embedding and the kind of model.

    The first observables, the data and each step's calls are those of all models. A forecast that is lifted at every
    step needs C A and C N only, nx rows in place of nz.
    """
    first = models[0]
    nx, nz, past = first.nx, first.nz, first.embedding
    crossed = any(isinstance(model, BilinearPredictor) and model.multiplies_inputs for model in models)
    M, G, C = (np.array(parts) for parts in zip(*(_transpose_matrices(each, crossed) for each in models), strict=True))
    if relift:
        M, G = M @ C[:, None], G @ C
    width = nx if relift else nz
    M = np.ascontiguousarray(np.swapaxes(M, 1, 2)).reshape(len(models), nz, -1)  # one product a step gives A z and N z
    for X, V, rows in _split_blocks(points, starts, horizon, first.nw, len(models)):
        if crossed:
            U, W = V[:, : first.nu], V[:, first.nu :]
            V = np.hstack([V, *(w[:, None] * U for w in W.T)])
        point = np.repeat(X[rows][None], len(models), axis=0)
        z = np.repeat(first.lifting(X[rows])[None], len(models), axis=0)
        truth = np.empty((horizon, len(rows), nx))
        gap = np.empty((len(models), *truth.shape))
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging prediction is an infinite error
            for h in range(horizon):
                v = V[rows + h]
                images = (z @ M).reshape(*z.shape[:2], -1, width)
                x = z = images[:, :, 0] + v @ G
                for i in range(images.shape[2] - 1):
                    z += v[:, i : i + 1] * images[:, :, i + 1]
                if not relift:
                    x = z @ C
                if past is not None:
                    x = past.clip(x)
                truth[h] = X[rows + h + 1, :nx]
                np.subtract(truth[h], x, out=gap[:, h])
                if relift and h < horizon - 1:
                    u = np.broadcast_to(v[:, : first.nu], (len(models), len(v), first.nu))
                    point = x if past is None else past.shift(point, u, x)
                    z = np.empty((*point.shape[:2], nz))
                    first.lifting.lift_into(point.reshape(-1, point.shape[2]), z.reshape(-1, nz))
        gap[np.isnan(gap)] = np.inf
        yield gap, truth


def _transpose_matrices(
    model: AnyPredictor, crossed: bool
) -> tuple[Float[np.ndarray, "products nz nz"], Float[np.ndarray, "nv nz"], Float[np.ndarray, "nz nx"]]:
    """Return [Aᵀ, N₁ᵀ …, S₁ᵀ …], [B E]ᵀ or the `crossed` [B E M₁ …]ᵀ, and Cᵀ."""
    A, B = model.A.T[None], [model.B, model.E]
    if isinstance(model, BilinearPredictor):
        A = np.concatenate([A, model.N.transpose(0, 2, 1), model.S.transpose(0, 2, 1)])
        B += [*model.M] if crossed else []
    return A, np.hstack(B).T, model.C.T


_Slice = tuple[Episode, Int[np.ndarray, "_"]]  # an episode and its starts in this block
_Block = tuple[Float[np.ndarray, "m nx"], Float[np.ndarray, "m nv"], Int[np.ndarray, " n"]]


def _split_blocks(
    episodes: Episodes, starts: Sequence[Int[np.ndarray, "_"]], horizon: int, nw: int, models: int
) -> Iterator[_Block]:
    """Yield blocks of a bounded number of starts, from several short episodes or a part of a long one."""
    room = most = max(1, min(_BLOCK_STARTS, _BLOCK_NUMBERS // (horizon * episodes.nx)) // models)
    slices: list[_Slice] = []
    for episode, own_starts in zip(episodes, starts, strict=True):
        first = 0
        while first < len(own_starts):
            part = own_starts[first : first + room]
            slices.append((episode, part))
            first, room = first + len(part), room - len(part)
            if room == 0:
                yield _join_slices(slices, horizon, nw)
                slices, room = [], most
    if slices:
        yield _join_slices(slices, horizon, nw)


def _join_slices(slices: list[_Slice], horizon: int, nw: int) -> _Block:
    """Return the states, the inputs of the same rows (0 in the last row of a slice), and the rows of the starts."""
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
