"""find_pace: the time in which outputs forget themselves, from their autocorrelation."""

import numpy as np

from koopmpc.data.episodes import Episodes

FORGOTTEN = np.exp(-1)  # an output has forgotten itself where its autocorrelation falls below this
_SHARE = 4  # lags reach over a quarter of an episode


def find_pace(episodes: Episodes) -> int:
    """Return the rows after which the autocorrelation of an output falls below 1/e, of several outputs the fewest.

    It is the time constant τ of a first-order lag that noise drives, r(i) = exp(−i/τ), in rows.
    Only outputs that move count. Where none forgets itself within a quarter of an episode, that quarter is returned.

    Parameters
    ----------
    episodes
        Records of one plant.
    """
    longest = max(max(map(len, episodes)) // _SHARE, 1)
    mean = np.concatenate([episode.X for episode in episodes]).mean(axis=0)
    total = np.zeros((longest + 1, episodes.nx))
    for episode in episodes:
        gap = episode.X - mean
        spectrum = np.abs(np.fft.rfft(gap, 2 * len(gap), axis=0)) ** 2  # twice the length: no lag wraps around
        lags = np.fft.irfft(spectrum, axis=0)[: min(longest + 1, len(gap))]
        total[: len(lags)] += lags
    rows = sum(len(episode.X) for episode in episodes)
    weight = sum(np.maximum(len(episode.X) - np.arange(longest + 1), 0) for episode in episodes)
    covariance = total / np.maximum(weight, 1)[:, None] * rows
    moving = total[0] > 0
    if not moving.any():
        return longest
    low = covariance[:, moving] < FORGOTTEN * covariance[0, moving]
    return int(np.min(np.where(low.any(axis=0), np.argmax(low, axis=0), longest)))
