"""Weights of snapshot pairs: Σ w dᵀd, so that a pair of weight 2 counts as if it came twice."""

from collections.abc import Callable, Iterable, Sequence
from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Held, Source
from koopmpc.errors import DataError, ShapeError

Weights = Callable[[Episode], ArrayLike] | Sequence[ArrayLike] | Float[np.ndarray, "..."]
Steps = list[Float[np.ndarray, " T"]]  # of each episode, one a step


def weights_of(weights: Weights, episodes: Episodes) -> Steps:
    """Return the weight of each step of each episode.

    Raises
    ------
    ShapeError
        There is not one item an episode, or an item is neither a number nor one a step.
    DataError
        A weight is below zero or not finite.
    """
    if callable(weights):
        given = [weights(episode) for episode in episodes]
    else:
        single = isinstance(weights, np.ndarray) and weights.ndim == 0
        if single or not isinstance(cast(object, weights), Iterable):
            raise DataError(f"weights is {weights!r}; pass one item an episode, or a function of an Episode")
        given = list(cast("Sequence[ArrayLike]", weights))
        if len(given) != len(episodes):
            raise ShapeError(
                f"there are {len(given)} weights and {len(episodes)} episodes; give each episode a number, or "
                "an array of one a step"
            )
    steps = [
        checks.vector(item, f"the weight of episode {i}", len(episode))
        for i, (item, episode) in enumerate(zip(given, episodes, strict=True))
    ]
    for i, own in enumerate(steps):
        if own.min() < 0:
            raise DataError(f"the weight of episode {i} is {own.min():g}; weights are 0 or above")
    return steps


def changed(weights: Weights | None, source: Source) -> Weights | None:
    """Return the weights that belong to the episodes as `source` changes them: an embedding drops their first steps.

    Raises
    ------
    DataError
        They are a list, and the source is not made from Episodes, which alone have an order that is known.
    """
    if weights is None or callable(weights):
        return weights
    dropped, inner = 0, source
    while isinstance(inner, Changed):
        dropped, inner = dropped + inner.history, inner.source
    if not isinstance(inner, Held):
        raise DataError(
            "weights are a list, which only Episodes have an order for; pass a function of an Episode"
        )
    return [own[dropped:] for own in weights_of(weights, inner.episodes) if len(own) > dropped]
