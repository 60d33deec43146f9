"""Folds: episodes, or blocks of a few long ones, dealt into parts of about equal size."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episode, Episodes

_AHEAD = 20  # steps of the default horizon


class Folds(NamedTuple):
    """Episodes, the fold of each episode, and sentences on changes of the data."""

    episodes: Episodes
    fold: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def number(self) -> int:
        """Number of folds."""
        return max(self.fold) + 1


def usual_horizon(episodes: Episodes, past: int = 0) -> tuple[int, tuple[str, ...]]:
    """Return 20 steps, or as many as whole episodes allow, and a sentence if these are fewer.

    At least half of all steps are in episodes that are long enough for this and the `past` that embeddings need, so
    that the shortest ones do not determine the horizon. A single episode is later cut into four blocks.
    """
    lengths = np.sort([len(episode) for episode in episodes])[::-1]
    reached = np.cumsum(lengths) >= lengths.sum() / 2
    half = int(lengths[np.argmax(reached)])  # episodes of at least this length hold half of all steps
    room = half if np.sum(lengths >= half) > 1 else half // 4
    ahead = min(_AHEAD, max(room - past, 1))
    if ahead == _AHEAD:
        return ahead, ()
    return ahead, (
        f"judged {ahead} step{'s' * (ahead > 1)} ahead, not {_AHEAD}: episodes of {half} steps hold half of the data, "
        "which leaves no more; a controller that looks further ahead than this needs longer episodes",
    )


def make_folds(episodes: Episodes, needed: int, folds: int, rng: np.random.Generator) -> Folds:
    """Return the episodes in folds of about equal size; few long ones are first cut into blocks.

    Episodes of fewer than `needed` steps are left out, for no forecast fits into them. The others are dealt out at
    random. Neighbouring blocks are alike, so blocks keep their order and a fold is one stretch of time.
    """
    notes: list[str] = []
    long = [episode for episode in episodes if len(episode) >= needed]
    short = len(episodes) - len(long)
    if short:
        notes.append(
            f"{short} of {len(episodes)} episodes are shorter than the {needed} steps that a forecast needs, and took "
            "no part in the choice"
        )
    cut = 0 < len(long) < 2 * folds
    if cut:
        number, total = len(long), sum(map(len, long))
        block = max(2 * needed, total // (4 * folds))
        long = [piece for episode in long for piece in cut_blocks(episode, block)]
        cut = len(long) > number
        if cut:
            notes.append(
                f"{number} episode{'s are' if number > 1 else ' is'} too few for {folds} folds: cut into {len(long)} "
                "blocks, and a fold is one stretch of them; neighbouring blocks are alike, so errors may be too small"
            )
    if len(long) < 2:
        given = "one episode" if len(episodes) == 1 else f"{len(episodes)} episodes, the longest"
        raise DataError(
            f"the data have {given} of {max(map(len, episodes))} steps, and a choice needs two of {needed} steps or "
            f"more, or one of {4 * needed}: pass a shorter horizon, or longer episodes"
        )
    count = min(folds, len(long))
    lengths = np.array([len(episode) for episode in long])
    fold = np.zeros(len(long), dtype=np.intp)
    if cut:
        fold[:] = np.minimum((np.cumsum(lengths) - lengths / 2) * count / lengths.sum(), count - 1)
        fold[:] = np.unique(fold, return_inverse=True)[1]
    else:
        size = np.zeros(count)
        for i in rng.permutation(len(long)):
            fold[i] = np.argmin(size)
            size[fold[i]] += lengths[i]
    if fold.max() == 0:
        raise DataError(f"all {len(long)} episodes fell into one fold; pass more of them, or a shorter horizon")
    return Folds(episodes.with_episodes(long), tuple(fold.tolist()), tuple(notes))


def select_fold(episodes: Episodes, fold: Sequence[int], wanted: int) -> Episodes:
    """Return the episodes of one fold."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own == wanted])


def drop_fold(episodes: Episodes, fold: Sequence[int], out: int) -> Episodes:
    """Return the episodes of all folds but one."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own != out])


def cut_blocks(episode: Episode, steps: int) -> list[Episode]:
    """Return an episode in equal blocks of at least `steps` steps; no two blocks share a snapshot pair."""
    count = max(len(episode) // steps, 1)
    at = np.linspace(0, len(episode), count + 1).astype(int)
    return [episode.cut(a, b) for a, b in pairwise(at.tolist())]
