"""Episodes for cross-validation: a part of the data that memory holds, in folds of whole episodes or of blocks."""

from collections.abc import Sequence, Sized
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes, joined
from koopmpc.data.smoother import Mender, Smoother
from koopmpc.data.source import Changed, EpisodesMap, Held, Source
from koopmpc.errors import DataError
from koopmpc.identify.moments.read import spread
from koopmpc.validate.text import quantity

_PARTS = 16  # of a source that a sample is taken from
_AHEAD = 20  # steps of the default horizon


class Folds(NamedTuple):
    """Episodes, which fold each is in, and what was done to the data, in sentences."""

    episodes: Episodes
    fold: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def number(self) -> int:
        """Number of folds."""
        return max(self.fold) + 1


def sampled(source: Source, pairs: int) -> tuple[Episodes, tuple[str, ...]]:
    """Return episodes of about `pairs` snapshot pairs at most, spread over the source, and a sentence if not all.

    Raises
    ------
    DataError
        The source can be read once only.
    """
    if not source.replayable:
        raise DataError(
            "a stream is read once, and a selection reads its data several times; pass Episodes, "
            "km.data.Files(folder), or km.data.Stream of a list"
        )
    parts = source.parts()
    if isinstance(parts, Sized):
        every = list(parts)
        chosen = [every[i] for i in spread(len(every), _PARTS)] if len(every) > _PARTS else every
        whole = len(chosen) == len(every)
    else:
        chosen, whole = list(islice(parts, _PARTS)), False
    quota = max(pairs // len(chosen), 1)
    taken: list[Episodes] = []
    for part in chosen:
        loaded = part.load()
        taken.append(_thinned(loaded, quota))
        whole = whole and taken[-1] is loaded
    result = joined(taken)
    if whole:
        return result, ()
    steps = sum(len(episode) for episode in result)
    return result, (
        f"chosen on {steps} steps in {len(result)} episodes, evenly spread over the data, and fitted to all",
    )


_TOLD = 3  # glitches that a note names


class Cleaned(NamedTuple):
    """A source, the episodes that are held of it, and what was done to them, in sentences."""

    source: Source
    held: Episodes
    notes: tuple[str, ...]


def mended(source: Source, held: Episodes) -> Cleaned:
    """Return the source and the episodes `held` of it with glitches replaced, or as they are where there is none."""
    try:
        mender = Mender.of(held)
    except DataError:  # too few data to tell a glitch from the plant, or too many states
        return Cleaned(source, held, ())
    found = mender.glitches(held)
    if not found:
        return Cleaned(source, held, ())
    named = [
        f"{quantity(held.states[one.state], f'= {one.was:.4g}')} in row {one.row} of episode {one.episode}, "
        f"now {one.now:.4g}"
        for one in found[:_TOLD]
    ]
    rest = f", and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    note = f"measurements that fit neither those before nor those after were replaced: {'; '.join(named)}{rest}"
    return Cleaned(*_changed(source, held, mender), (note,))


def smoothed(source: Source, held: Episodes) -> tuple[Cleaned, Float[np.ndarray, " nx"]]:
    """Return source and episodes with smoothed states, or as they are where no noise is found, and its size.

    The size is the (nx,) standard deviation of what was taken out, zero where that is nothing. The smoother is found
    on `held`; where that is not all of the source, its parts are smoothed as they are read.
    """
    nothing = Cleaned(source, held, ()), np.zeros(held.nx)
    try:
        smoother = Smoother.of(held)
    except DataError:
        return nothing
    if not smoother.found.any():
        return nothing
    told = ", ".join(
        quantity(name, f"± {size:.2g}")
        for name, size, found in zip(held.states, smoother.noise, smoother.found, strict=True)
        if found
    )
    note = f"the measurements hold noise (standard deviations): {told}; models are of smoothed states"
    return Cleaned(*_changed(source, held, smoother), (note,)), smoother.noise


def _changed(source: Source, held: Episodes, change: EpisodesMap) -> tuple[Source, Episodes]:
    changed = change(held)
    if isinstance(source, Held) and source.episodes is held:
        return Held(changed), changed
    return Changed(source, change, held.states, held.inputs, held.disturbances), changed


def usual_horizon(episodes: Episodes, past: int = 0) -> tuple[int, tuple[str, ...]]:
    """Return 20 steps, or as many as whole episodes allow, and a sentence if these are fewer.

    At least half of all steps are in episodes that are long enough for this and the `past` that embeddings need, so
    that the shortest ones do not decide. A single one is cut into four blocks.
    """
    lengths = np.sort([len(episode) for episode in episodes])[::-1]
    held = np.cumsum(lengths) >= lengths.sum() / 2
    half = int(lengths[np.argmax(held)])  # episodes as long as this hold half of the steps
    room = half if np.sum(lengths >= half) > 1 else half // 4
    ahead = min(_AHEAD, max(room - past, 1))
    if ahead == _AHEAD:
        return ahead, ()
    return ahead, (
        f"judged {ahead} step{'s' * (ahead > 1)} ahead, not {_AHEAD}: episodes of {half} steps hold half of the data, "
        "which leaves no more; a controller that looks further ahead than this needs longer episodes",
    )


def folded(episodes: Episodes, needed: int, folds: int, rng: np.random.Generator) -> Folds:
    """Return the episodes in folds of about equal size; few long ones are first cut into blocks.

    Episodes are dealt out at random. Blocks stay in order, so that a fold is one stretch of time: neighbours are alike.

    Parameters
    ----------
    episodes
        Of any length.
    needed
        Steps that an episode must have to be scored.
    folds
        How many folds there are; fewer where there are fewer episodes.
    rng
        Deals out the episodes.

    Raises
    ------
    DataError
        Less than two episodes, or blocks, are long enough.
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
        long = [piece for episode in long for piece in blocks(episode, block)]
        cut = len(long) > number
        if cut:
            notes.append(
                f"{number} episode{'s are' if number > 1 else ' is'} too few for {folds} folds: cut into {len(long)} "
                "blocks, and a fold is one stretch of them; neighbouring blocks are alike, so errors may be too small"
            )
    if len(long) < 2:
        raise DataError(
            f"of {len(episodes)} episodes {len(long)} have {needed} steps or more, and a choice needs 2: pass a "
            "shorter horizon, or longer episodes"
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
    kept = episodes.with_episodes(long)
    if fold.max() == 0:
        raise DataError(f"all {len(long)} episodes fell into one fold; pass more of them, or a shorter horizon")
    return Folds(kept, tuple(fold.tolist()), tuple(notes))


def only(episodes: Episodes, fold: Sequence[int], wanted: int) -> Episodes:
    """Return the episodes of one fold."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own == wanted])


def without(episodes: Episodes, fold: Sequence[int], out: int) -> Episodes:
    """Return the episodes of all folds but one."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own != out])


def blocks(episode: Episode, steps: int) -> list[Episode]:
    """Return an episode in equal blocks of `steps` or more; none shares a pair with another."""
    count = max(len(episode) // steps, 1)
    at = np.linspace(0, len(episode), count + 1).astype(int)
    return [Episode(X=episode.X[a : b + 1], U=episode.U[a:b], W=episode.W[a:b]) for a, b in pairwise(at)]


def _thinned(episodes: Episodes, quota: int) -> Episodes:
    """Return evenly spread episodes of about `quota` steps in all; of a longer single one, its beginning."""
    total = sum(len(episode) for episode in episodes)
    if total <= quota:
        return episodes
    wanted = max(len(episodes) * quota // total, 1)
    kept = [episodes[i] for i in spread(len(episodes), wanted)]
    cut = [e if len(e) <= quota else Episode(X=e.X[: quota + 1], U=e.U[:quota], W=e.W[:quota]) for e in kept]
    return episodes.with_episodes(cut)
