"""Mender: single measurements that fit neither those before nor those after them are replaced."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.data.smoother import Passage, Smoother, state_space
from koopmpc.data.state_space import Stretches, gains_of, left_out
from koopmpc.values import Value

_SIZE = 8.0  # standard deviations of what the others say of a measurement
_FAR = 0.5  # of a state's spread: what is less far off spoils no fit
_BESIDE = 3  # rows around a glitch that miss by it too
_SOLVED = 0.3  # of a glitch that may be left in the rows around it once it is replaced
_ROUNDS = 6  # of finding the largest ones and going on without them
_FITS = 3  # of the model, each to data without the glitches that the one before found
_FLOOR = 0.01  # of V: the least variance of the measurements


class Glitch(NamedTuple):
    """A measurement that was replaced: its episode, row and state, what it was and what stands there now."""

    episode: int
    row: int
    state: int
    was: float
    now: float


@dataclass(frozen=True, eq=False)
class Mender(Value):
    """Find glitches, single measurements far from what all others say of them, and put what these say in their place.

    Least squares squares errors: one sensor that jumped once outweighs thousands of sound rows, and unstable plants
    seem to be what they are not. For each measurement the estimate of a linear `Smoother` without it is known from the
    estimate with it. One that lies further off than 8 of its standard deviations and half of the state's spread, and
    further than all within three rows, is replaced, and the search begins anew without it. It comes back where the rows
    around it go on to miss by a third of it or more: then the plant jumped, and not a sensor. Sound data stay as they
    are, to the bit.

    Attributes
    ----------
    smoother
        What the rows before and after say of a measurement; states in shares of the range that holds nine tenths.

    References
    ----------
    de Jong & Penzer, "Diagnosing shocks in time series", J. Am. Stat. Assoc. 93, 1998.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> clean = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=20, steps=30)
    >>> X = clean[3].X.copy()
    >>> X[17, 0] = 99.0
    >>> data = clean.with_episodes([*clean[:3], km.Episode(X=X, U=clean[3].U), *clean[4:]])
    >>> mender = km.data.Mender.of(data)
    >>> [(glitch.episode, glitch.row, glitch.state, glitch.was) for glitch in mender.glitches(data)]
    [(3, 17, 0, 99.0)]
    """

    smoother: Smoother

    @classmethod
    def of(cls, episodes: Episodes) -> "Mender":
        """Return what tells the glitches of these data.

        Raises
        ------
        DataError
            As `Smoother.of`.
        """
        data = episodes_of(episodes).driven()
        both = np.concatenate([np.hstack([episode.X[:-1], episode.U]) for episode in data])
        low, middle, high = np.quantile(both, [0.05, 0.5, 0.95], axis=0)
        scale, whole = (high - low) / 3.29, both.std(axis=0)  # normal data have their standard deviation
        scale = np.where(scale > 0, scale, np.where(whole > 0, whole, 1.0))
        found: list[Glitch] = []
        for _ in range(_FITS):
            model = state_space(_replaced(data, found), middle, scale, products=False)
            model = model._replace(R=np.maximum(model.R, _FLOOR * np.diag(model.V)))
            mender, before = cls(Smoother.made(model, middle, scale)), [one[:3] for one in found]
            found = mender.glitches(data)
            if [one[:3] for one in found] == before:
                return mender
        return mender  # pyright: ignore[reportPossiblyUnboundVariable]  # the loop runs

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the episodes with their glitches replaced."""
        data = episodes_of(episodes)
        return _replaced(data, self.glitches(data))

    def glitches(self, episodes: Episodes) -> list[Glitch]:
        """Return the glitches of these data, in their order."""
        data = episodes_of(episodes)
        found: list[Glitch] = []
        nx = data.nx
        for pieces, given in self.smoother.stretches(data):
            for row, k, i, value in self._searched(pieces, given):
                piece, place = pieces[row], pieces[row].first + k
                now = float(value * self.smoother.scale[:nx][i] + self.smoother.mean[:nx][i])
                found.append(Glitch(piece.episode, place, i, float(data[piece.episode].X[place, i]), now))
        return sorted(found)

    def _searched(self, pieces: list[Passage], given: Stretches) -> list[tuple[int, int, int, float]]:
        """Return (piece, row, state, what stands there now) of each glitch."""
        Y, model = given.X.copy(), self.smoother.model
        gains = gains_of(model, Y.shape[1] - model.delays)
        replaced: set[tuple[int, int, int]] = set()

        def missed() -> tuple[Float[np.ndarray, "E T nx"], Float[np.ndarray, "E T nx"]]:
            now = given._replace(X=Y)
            return left_out(model, gains, now, self.smoother.states(now))

        gap, size = missed()
        for _ in range(_ROUNDS):
            largest, fresh = size.max(axis=2), False
            for row, k in np.argwhere(largest > _SIZE).tolist():
                piece, i = pieces[row], int(size[row, k].argmax())
                counts = piece.low <= piece.first + k < piece.high and abs(gap[row, k, i]) > _FAR
                if counts and largest[row, k] >= largest[row, max(k - _BESIDE, 0) : k + _BESIDE + 1].max():
                    Y[row, k, i] -= gap[row, k, i]
                    replaced.add((row, k, i))
                    fresh = True
            if not fresh:
                break
            gap, size = missed()
        return [
            (row, k, i, float(Y[row, k, i]))
            for row, k, i in sorted(replaced)
            if np.abs(gap[row, max(k - _BESIDE, 0) : k + _BESIDE + 1]).max()
            <= _SOLVED * abs(given.X[row, k, i] - Y[row, k, i])
        ]


def _replaced(data: Episodes, glitches: list[Glitch]) -> Episodes:
    changed = {one.episode: data[one.episode].X.copy() for one in glitches}
    for one in glitches:
        changed[one.episode][one.row, one.state] = one.now
    return data.with_episodes([Episode(X=changed[i], U=e.U, W=e.W) if i in changed else e for i, e in enumerate(data)])
