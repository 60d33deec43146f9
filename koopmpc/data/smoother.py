"""Smoother and Mender: what all measurements of an episode say of each one of them, by a model from the data alone.

A `Smoother` takes the noise out of states; a `Mender` finds single measurements far from what all others say of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.data.state_space import (
    DELAYS,
    StateSpace,
    Stretches,
    fit_state_space,
    gains_of,
    left_out,
    smooth,
    stack_delays,
    unstack_delays,
)


@dataclass(frozen=True)
class _Limits:
    """Sizes and limits of the smoother."""

    largest: int = 30  # entries of x_k … x_{k−d}: the work grows with their third power
    window: int = 60  # a model is fitted to stretches of at most this many steps
    windows: int = 100  # and to at most this many stretches
    block: int = 1000  # episodes of twice this many rows or more are smoothed in parts of about this length
    overlap: int = 200  # each part sees this many rows more at either end
    each: int = 10  # snapshot pairs for each regressor, at least
    better: float = 0.05  # more delays must raise the log-likelihood a number by this: prediction errors 5 % smaller
    passes: int = 4  # the products are those of the smoothed states, which the first pass does not have
    small: float = 1e-4  # noise below this share of a state's spread counts as rounding
    share: float = 0.5  # noise below this share of the model's one-step error cannot be distinguished from that error
    size: float = 8.0  # standard deviations of what the others say of a measurement
    far: float = 0.5  # of a state's spread: what is less far off spoils no fit
    beside: int = 3  # rows around a glitch that miss by it too
    solved: float = 0.3  # of a glitch that may be left in the rows around it once it is replaced
    rounds: int = 6  # of finding the largest ones and going on without them
    fits: int = 3  # of the model, each to data without the glitches that the one before found
    floor: float = 0.01  # of V: the least variance of the measurements


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class Smoother(Value):
    """Estimate x_0 … x_T of an episode from all of its measurements, y_k = x_k + n_k, n_k ~ N(0, R), R diagonal.

    Least squares on noisy states shrinks A towards zero, by about R (cov x)⁻¹: an unstable plant looks tame, and a
    controller that believes it loses such plants. The smoother fits a model of how states move between measurements:

        x_{k+1} = Σ_j A_j x_{k−j} + Σ_j B_j u_{k−j} + c + G [x_k ⊗ x_k, u_k ⊗ x_k] + v_k,  j = 0 … d;  v_k ~ N(0, V).

    With it each measurement is weighed against those before and after. A, B, c, G, V and R maximise the likelihood of
    the measurements, found by expectation–maximisation (Shumway & Stoffer 1982). The products are taken
    at the smoothed states; what they do not describe is part of V, and where V is large the measurements are kept.
    Where not all states are measured, the past stands in for them: of d = 0, 1, 2 the smallest is taken whose
    prediction errors are within 5 % of the least. Measured disturbances, and their products with inputs, act as inputs.

    A smoother is for data that were recorded. It looks ahead in time, so no controller can use it.

    Attributes
    ----------
    noise
        (nx,) standard deviation of the measurement noise, √R, in the states' units.
    missed
        (nx,) standard deviation of what the model misses in one step, √V, in the states' units.
    delays
        d.
    products
        False where there are too few data for G, which is then zero.
    gains
        ([A_0 … A_d, B_0 … B_d, c, G]ᵀ) of states and inputs in standard deviations from their means.
    spread
        (nx, nx) V of states in standard deviations.
    start, start_spread
        Mean and covariance of [x_d … x_0], in standard deviations.
    mean, scale
        (nx + nu,) mean and standard deviation of states and inputs.

    References
    ----------
    Shumway & Stoffer, "An approach to time series smoothing and forecasting using the EM algorithm", J. Time Series
    Anal. 3, 1982; Rauch, Tung & Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA J. 3, 1965.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> clean = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> draw = np.random.default_rng(0)
    >>> noisy = clean.with_episodes(
    ...     [km.Episode(X=e.X + draw.normal(0, [0.05, 0.2], e.X.shape), U=e.U) for e in clean]
    ... )
    >>> smoother = km.data.Smoother.of(noisy)
    >>> smoother.noise.round(2)
    array([0.04, 0.19])
    >>> data = smoother(noisy)
    >>> errors = [np.std(np.concatenate([a.X - b.X for a, b in zip(each, clean)]), axis=0) for each in (noisy, data)]
    >>> bool((errors[1] < errors[0] / 2).all())
    True
    """

    noise: Float[np.ndarray, " nx"]
    missed: Float[np.ndarray, " nx"]
    delays: int
    products: bool
    gains: Float[np.ndarray, "n nx"]
    spread: Float[np.ndarray, "nx nx"]
    start: Float[np.ndarray, " N"]
    start_spread: Float[np.ndarray, "N N"]
    mean: Float[np.ndarray, " nxu"]
    scale: Float[np.ndarray, " nxu"]

    @classmethod
    def of(cls, episodes: Episodes) -> "Smoother":
        """Return the smoother of these data; of many a part is taken, up to 100 stretches of 60 steps.

        Raises
        ------
        DataError
            More than 30 states; episodes of fewer than 6 steps, or fewer than 10 steps for each regressor.
        """
        data = episodes_of(episodes).driven(products=True)
        both = np.concatenate([np.hstack([episode.X[:-1], episode.U]) for episode in data])
        mean, scale = both.mean(axis=0), both.std(axis=0)
        scale = np.where(scale > 1e-12 * np.abs(mean), scale, 1.0)
        return cls.from_model(_state_space(data, mean, scale), mean, scale)

    @classmethod
    def from_model(
        cls, model: StateSpace, mean: Float[np.ndarray, " nxu"], scale: Float[np.ndarray, " nxu"]
    ) -> "Smoother":
        """Return the smoother with this model of data that are standardized so."""
        size = scale[: len(model.V)]
        return cls(
            noise=np.sqrt(model.R) * size,
            missed=np.sqrt(np.diag(model.V)) * size,
            delays=model.delays,
            products=model.products,
            gains=model.K,
            spread=model.V,
            start=model.start,
            start_spread=model.start_spread,
            mean=mean,
            scale=scale,
        )

    @property
    def model(self) -> StateSpace:
        """The model of standardized data."""
        R = (self.noise / self.scale[: len(self.noise)]) ** 2
        return StateSpace(self.delays, self.products, self.gains, self.spread, R, self.start, self.start_spread)

    @property
    def is_noisy(self) -> Bool[np.ndarray, " nx"]:
        """(nx,) True for each state with noise that can be told from what the model misses, and from rounding."""
        return (self.noise > _LIMITS.share * self.missed) & (self.noise > _LIMITS.small * self.scale[: len(self.noise)])

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the episodes with smoothed states; an episode of d steps or fewer stays as it is."""
        data = episodes_of(episodes)
        nx, changed = data.nx, [episode.X.copy() for episode in data]
        for pieces, given in self.stretches(data):
            found = unstack_delays(self.states(given), self.delays, nx) * self.scale[:nx] + self.mean[:nx]
            for row, piece in zip(found, pieces, strict=True):
                changed[piece.episode][piece.low : piece.high] = row[piece.low - piece.first : piece.high - piece.first]
        return data.with_episodes([e.with_states(X) for X, e in zip(changed, data, strict=True)])

    def states(self, given: Stretches) -> Float[np.ndarray, "E L N"]:
        """Return E[s_k | all measurements]; products are those of the smoothed states."""
        model = self.model
        gains, states = gains_of(model, given.X.shape[1] - self.delays), stack_delays(given.X, self.delays)
        for _ in range(_LIMITS.passes if self.products else 1):
            states = smooth(model, gains, given, model.drive(states, given.U))
        return states

    def stretches(self, data: Episodes) -> Iterator[tuple[list["_Passage"], Stretches]]:
        """Yield pieces of about one length, standardized, which together hold each row of each episode once.

        What is further away than the overlap of two pieces does not count. Episodes of d steps or fewer are left out.

        Raises
        ------
        DataError
            The data have other numbers of states and inputs.
        """
        nx, driven = len(self.noise), data.driven(products=True)
        if (driven.nx, driven.nx + driven.nu) != (nx, len(self.mean)):
            raise DataError(
                f"the smoother is of {nx} states and {len(self.mean) - nx} inputs, the data have {driven.nx} and "
                f"{driven.nu}"
            )
        for pieces in _alike([len(episode) for episode in driven], self.delays):
            steps = np.array([piece.last - piece.first - 1 for piece in pieces])
            X = np.zeros((len(pieces), steps.max() + 1, nx))
            U = np.zeros((len(pieces), steps.max(), driven.nu))
            for row, (i, a, b, _, _) in enumerate(pieces):
                X[row, : b - a] = (driven[i].X[a:b] - self.mean[:nx]) / self.scale[:nx]
                U[row, : b - a - 1] = (driven[i].U[a : b - 1] - self.mean[nx:]) / self.scale[nx:]
            yield pieces, Stretches(X, U, steps)


class _Passage(NamedTuple):
    """Rows `first` to `last` of an episode, of which those from `low` to `high` count; the ends are one beyond."""

    episode: int
    first: int
    last: int
    low: int
    high: int


def _state_space(
    data: Episodes, mean: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"], *, products: bool = True
) -> StateSpace:
    """Return the model of episodes without disturbances: of 0, 1 and 2 delays the fewest that are within 5 %."""
    windows = _windows(data, mean, scale)
    pairs = windows.U.shape[0] * windows.U.shape[1]
    fits: list[tuple[float, StateSpace]] = []
    for delays in DELAYS:
        size = data.nx * (delays + 1)
        linear = size + data.nu * (delays + 1) + 1
        if size > _LIMITS.largest or pairs < _LIMITS.each * linear:
            continue
        enough = pairs >= _LIMITS.each * (linear + data.nx * (data.nx + 1) // 2 + data.nx * data.nu)
        fits.append(fit_state_space(windows, delays, products=products and enough))
    if not fits:
        raise DataError(
            f"{pairs} steps of {data.nx} states are too few for a smoother: it needs {_LIMITS.each} steps for each "
            f"regressor and takes {_LIMITS.largest} states at most"
        )
    best = max(likelihood for likelihood, _ in fits)
    return next(model for likelihood, model in fits if likelihood > best - _LIMITS.better)


def _windows(data: Episodes, mean: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"]) -> Stretches:
    """Return stretches of one length, at most 60 steps, evenly spread over the data, in standard deviations.

    Episodes that are at least as long hold half of all steps.
    """
    lengths = np.sort([len(episode) for episode in data])[::-1]
    half = int(lengths[np.argmax(np.cumsum(lengths) >= lengths.sum() / 2)])
    steps = min(half, _LIMITS.window)
    if steps < 2 * max(DELAYS) + 2:
        raise DataError(
            f"episodes of {half} steps hold half of the data; a smoother needs {2 * max(DELAYS) + 2} steps or more"
        )
    places = [(i, k) for i, e in enumerate(data) for k in range(0, len(e) - steps + 1, steps)]
    count = min(len(places), _LIMITS.windows)
    chosen = [places[(len(places) - 1) * i // max(count - 1, 1)] for i in range(count)]
    X = np.array([data[i].X[k : k + steps + 1] for i, k in chosen])
    U = np.array([data[i].U[k : k + steps] for i, k in chosen])
    nx = X.shape[2]
    return Stretches((X - mean[:nx]) / scale[:nx], (U - mean[nx:]) / scale[nx:], np.full(len(X), steps))


def _alike(lengths: Sequence[int], delays: int) -> Iterator[list[_Passage]]:
    """Yield pieces of about one length, which are smoothed together: whole episodes, and parts of long ones."""
    groups: dict[int, list[_Passage]] = {}
    for i, length in enumerate(lengths):
        if length <= delays:
            continue
        count = 1 if length < 2 * _LIMITS.block else length // _LIMITS.block
        ends = [(length + 1) * k // count for k in range(count + 1)]
        for low, high in pairwise(ends):
            piece = _Passage(i, max(low - _LIMITS.overlap, 0), min(high + _LIMITS.overlap, length + 1), low, high)
            groups.setdefault((piece.last - piece.first).bit_length(), []).append(piece)
    yield from groups.values()


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
    further than all within three rows, is replaced, and the search starts again without it. It comes back if the rows
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
        data = episodes_of(episodes).driven(products=True)
        both = np.concatenate([np.hstack([episode.X[:-1], episode.U]) for episode in data])
        low, middle, high = np.quantile(both, [0.05, 0.5, 0.95], axis=0)
        scale, whole = (high - low) / 3.29, both.std(axis=0)  # normal data have their standard deviation
        scale = np.where(scale > 0, scale, np.where(whole > 0, whole, 1.0))

        def fit_without(found: list[Glitch]) -> Mender:
            """Return the mender by a model of the data without these glitches."""
            model = _state_space(_replace(data, found), middle, scale, products=False)
            model = model._replace(R=np.maximum(model.R, _LIMITS.floor * np.diag(model.V)))
            return cls(Smoother.from_model(model, middle, scale))

        mender, found = fit_without([]), list[Glitch]()
        for _ in range(_LIMITS.fits - 1):
            before, found = found, mender.glitches(data)
            if [one[:3] for one in found] == [one[:3] for one in before]:
                break
            mender = fit_without(found)
        return mender

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the episodes with their glitches replaced."""
        data = episodes_of(episodes)
        return _replace(data, self.glitches(data))

    def glitches(self, episodes: Episodes) -> list[Glitch]:
        """Return the glitches of these data, in their order."""
        data = episodes_of(episodes)
        found: list[Glitch] = []
        nx = data.nx
        for pieces, given in self.smoother.stretches(data):
            for row, k, i, value in self._search(pieces, given):
                piece, place = pieces[row], pieces[row].first + k
                now = float(value * self.smoother.scale[:nx][i] + self.smoother.mean[:nx][i])
                found.append(Glitch(piece.episode, place, i, float(data[piece.episode].X[place, i]), now))
        return sorted(found)

    def _search(self, pieces: list[_Passage], given: Stretches) -> list[tuple[int, int, int, float]]:
        """Return (piece, row, state, what stands there now) of each glitch."""
        Y, model = given.X.copy(), self.smoother.model
        gains = gains_of(model, Y.shape[1] - model.delays)
        replaced: set[tuple[int, int, int]] = set()

        def measure_gaps() -> tuple[Float[np.ndarray, "E T nx"], Float[np.ndarray, "E T nx"]]:
            now = given._replace(X=Y)
            return left_out(model, gains, now, self.smoother.states(now))

        gap, size = measure_gaps()
        for _ in range(_LIMITS.rounds):
            largest, fresh = size.max(axis=2), False
            for row, k in np.argwhere(largest > _LIMITS.size).tolist():
                piece, i = pieces[row], int(size[row, k].argmax())
                counts = piece.low <= piece.first + k < piece.high and abs(gap[row, k, i]) > _LIMITS.far
                if (
                    counts
                    and largest[row, k] >= largest[row, max(k - _LIMITS.beside, 0) : k + _LIMITS.beside + 1].max()
                ):
                    Y[row, k, i] -= gap[row, k, i]
                    replaced.add((row, k, i))
                    fresh = True
            if not fresh:
                break
            gap, size = measure_gaps()
        return [
            (row, k, i, float(Y[row, k, i]))
            for row, k, i in sorted(replaced)
            if np.abs(gap[row, max(k - _LIMITS.beside, 0) : k + _LIMITS.beside + 1]).max()
            <= _LIMITS.solved * abs(given.X[row, k, i] - Y[row, k, i])
        ]


def _replace(data: Episodes, glitches: list[Glitch]) -> Episodes:
    changed = {one.episode: data[one.episode].X.copy() for one in glitches}
    for one in glitches:
        changed[one.episode][one.row, one.state] = one.now
    return data.with_episodes([e.with_states(changed[i]) if i in changed else e for i, e in enumerate(data)])
