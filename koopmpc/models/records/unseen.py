"""The last quarter of each record, which a first fit does not see, and the errors of models on it."""

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.structure import EXACT

UNSEEN = 0.25  # share of each record, its end, that judges
BLOCKS = 4  # parts of all unseen rows, each with an error of its own
_LOST = 1e3  # an error counts as this many spreads at most


def cut_quarter(episodes: Episodes) -> tuple[Episodes, list[tuple[int, int]]]:
    """Return the first three quarters of each record, and the spans of rows behind them."""
    spans = [(round((1 - UNSEEN) * len(e)), len(e)) for e in episodes]
    return episodes.with_episodes([e.cut(0, a) for e, (a, _) in zip(episodes, spans, strict=True) if a > 0]), spans


def measure_forecasts(
    model: LinearPredictor | BilinearPredictor, episodes: Episodes, spans: list[tuple[int, int]], horizon: int
) -> Float[np.ndarray, " blocks"]:
    """Return errors on four parts of these spans, in spreads: of a free run and of forecasts of `horizon` steps.

    The free run begins at the past of each span's first row, forecasts begin at every `horizon`-th row. Both count
    alike: an error is the geometric mean of the two. A bilinear model is lifted afresh at each step.
    """
    spread = np.concatenate([e.X for e in episodes]).std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    past = 0 if model.embedding is None else model.embedding.steps
    free: list[np.ndarray] = []
    short: list[np.ndarray] = []
    for e, (a, b) in zip(episodes, spans, strict=True):
        first = max(a, past)
        if b - first < 2:
            continue
        points = model.embed(episodes.with_episodes([e]))[0].X
        free.append(roll_out(model, points[first - past, None], e.U[None, first:b])[0] - e.X[first + 1 : b + 1])
        starts = np.arange(first, b - horizon + 1, horizon)
        if len(starts):
            U = np.stack([e.U[k : k + horizon] for k in starts])
            truth = np.stack([e.X[k + 1 : k + 1 + horizon] for k in starts])
            short.append((roll_out(model, points[starts - past], U) - truth).reshape(-1, model.nx))
    if not free:
        raise DataError(f"no record is longer than the {past} past rows; pass fewer delays, or longer records")
    return average_gaps(*([gap / spread for gap in gaps] for gaps in (free, short)))


def average_gaps(*kinds: list[Float[np.ndarray, "..."]]) -> Float[np.ndarray, " blocks"]:
    """Return the root-mean-square error of each of four parts of the rows, in spreads: its mean over the kinds.

    The mean is the geometric one, over those kinds that have rows.
    """
    parts = [np.array_split(np.concatenate(gaps), BLOCKS) for gaps in kinds if gaps]
    errors = np.ones(BLOCKS)
    for part in parts:
        sizes = [np.sqrt(np.mean(np.minimum(np.abs(gap), _LOST) ** 2)) if len(gap) else 1.0 for gap in part]
        errors *= np.maximum(sizes, EXACT) ** (1 / len(parts))
    return errors


def roll_out(
    model: LinearPredictor | BilinearPredictor,
    points: Float[np.ndarray, "m npoint"],
    U: Float[np.ndarray, "m steps nu"],
) -> Float[np.ndarray, "m steps nx"]:
    """Return x̂_1, … from several points ζ at once; a bilinear model is lifted afresh at each step."""
    relift = isinstance(model, BilinearPredictor)
    z, out, point = model.lifting(points), np.empty((*U.shape[:2], model.nx)), points
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(U.shape[1]):
            u = U[:, k]
            z_next = z @ model.A.T + u @ model.B.T
            if isinstance(model, BilinearPredictor):
                for i, N in enumerate(model.N):
                    z_next += u[:, i : i + 1] * (z @ N.T)
            x = z_next @ model.C.T
            if relift:
                point = x if model.embedding is None else model.embedding.shift(point, u, x)
                z_next = model.lifting(point)
                if model.embedding is not None:
                    x = point[:, : model.nx]
            out[:, k], z = x, z_next
    return np.where(np.isfinite(out), out, np.inf)
