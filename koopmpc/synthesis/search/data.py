"""What becomes of data before models are tried: a sample, glitches replaced, inputs moved up, noise taken out."""

from collections.abc import Sized
from itertools import islice
from operator import methodcaller

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.base.text import with_unit
from koopmpc.data.episodes import Episodes, join_sets
from koopmpc.data.smoother import Glitch, Mender, Smoother
from koopmpc.data.source import Changed, EpisodesMap, Held, Source
from koopmpc.lifting.base import strip_unit
from koopmpc.models.moments.read import space_evenly

_PARTS = 16  # a sample is taken from at most this many parts of a source
_TOLD = 3  # a note names at most this many glitches


def take_sample(source: Source, pairs: int) -> tuple[Episodes, tuple[str, ...]]:
    """Return episodes of about `pairs` snapshot pairs at most, spread over the source, and a sentence if not all."""
    if not source.replayable:
        raise DataError(
            "a stream is read once, and a selection reads its data several times; pass Episodes, "
            "km.data.Files(folder), or km.data.Stream of a list"
        )
    parts = source.parts()
    if isinstance(parts, Sized):
        every = list(parts)
        chosen = [every[i] for i in space_evenly(len(every), _PARTS)] if len(every) > _PARTS else every
        whole = len(chosen) == len(every)
    else:
        chosen, whole = list(islice(parts, _PARTS)), False
    quota = max(pairs // len(chosen), 1)
    taken: list[Episodes] = []
    for part in chosen:
        loaded = part.load()
        taken.append(_thin_episodes(loaded, quota))
        whole = whole and taken[-1] is loaded
    result = join_sets(taken)
    if whole:
        return result, ()
    steps = sum(len(episode) for episode in result)
    count = f"{len(result)} episode{'s' * (len(result) != 1)}"
    return result, (f"chosen on {steps} steps in {count}, evenly spread over the data, and fitted to all",)


def replace_glitches(source: Source, held: Episodes) -> tuple[Source, Episodes, tuple[str, ...]]:
    """Return the source and the episodes `held` of it with glitches replaced, and a sentence if there are any."""
    try:
        mender = Mender.of(held)
    except DataError:  # too few data to tell a glitch from the plant, or too many states
        return source, held, ()
    found = mender.glitches(held)
    if not found:
        return source, held, ()
    named = [_name_glitch(one, held) for one in found[:_TOLD]]
    rest = f", and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    note = f"measurements that fit neither those before nor those after were replaced: {'; '.join(named)}{rest}"
    return *_apply_change(source, held, mender), (note,)


def _name_glitch(glitch: Glitch, data: Episodes) -> str:
    """Return what was measured, where, and what stands there now; where the data are of a table, by file and line."""
    state, origin = data.states[glitch.state], data[glitch.episode].origin
    was, place = glitch.was, f"in row {glitch.row} of episode {glitch.episode}"
    if origin is not None:
        number, was = origin.locate(glitch.row, state, glitch.now)
        place = f"in {origin.place(number)}"
    return f"{with_unit(state, f'= {was:.5g}')} {place}, now {glitch.now:.4g}"


def smooth_data(source: Source, held: Episodes) -> tuple[Source, Episodes, tuple[str, ...], Float[np.ndarray, " nx"]]:
    """Return source and episodes, smoothed where noise is found, a sentence that says so, and the size of the noise.

    The size is the (nx,) standard deviation of what was taken out, zero where that is nothing. The smoother is found
    on `held`; where that is not all of the source, its parts are smoothed as they are read.
    """
    nothing = source, held, (), np.zeros(held.nx)
    try:
        smoother = Smoother.of(held)
    except DataError:
        return nothing
    if not smoother.is_noisy.any():
        return nothing
    told = ", ".join(
        with_unit(name, f"± {size:.2g}")
        for name, size, found in zip(held.states, smoother.noise, smoother.is_noisy, strict=True)
        if found
    )
    quiet = [strip_unit(name) for name, found in zip(held.states, smoother.is_noisy, strict=True) if not found]
    others = f"; that of {', '.join(quiet)} is too small to tell" if quiet else ""
    note = (
        f"the measurements hold noise (standard deviations): {told}{others}; candidates are fitted to smoothed states"
    )
    return *_apply_change(source, held, smoother), (note,), smoother.noise


def _apply_change(source: Source, held: Episodes, change: EpisodesMap) -> tuple[Source, Episodes]:
    changed = change(held)
    if isinstance(source, Held) and source.episodes is held:
        return Held(changed), changed
    return Changed(source, change, held.states, held.inputs, held.disturbances), changed


def _thin_episodes(episodes: Episodes, quota: int) -> Episodes:
    """Return evenly spread episodes of about `quota` steps in total; a longer episode is cut to its beginning."""
    total = sum(len(episode) for episode in episodes)
    if total <= quota:
        return episodes
    wanted = max(len(episodes) * quota // total, 1)
    kept = [episodes[i] for i in space_evenly(len(episodes), wanted)]
    cut = [e if len(e) <= quota else e.cut(0, quota) for e in kept]
    return episodes.with_episodes(cut)


FEW = 10  # records are fewer episodes than this, which select would cut into blocks
LONG = 150  # steps: half of the data are in episodes at least as long, so that a free run says something
OUTPUTS = 4  # states of a record at most: with more the search for terms takes too long


def is_record(episodes: Episodes) -> bool:
    """Return whether these are a few long records of few signals, on which models run freely."""
    lengths = np.sort([len(episode) for episode in episodes])[::-1]
    half = int(lengths[np.argmax(np.cumsum(lengths) >= lengths.sum() / 2)])
    return len(lengths) < FEW and half >= LONG and episodes.nx <= OUTPUTS and episodes.nw == 0


def advance_inputs(source: Source, held: Episodes) -> tuple[Source, Episodes]:
    """Return the source and the episodes `held` of it with the inputs one row up."""
    return _apply_change(source, held, methodcaller("with_inputs_advanced", 1))
