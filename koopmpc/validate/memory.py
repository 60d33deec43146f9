"""find_hidden_state tests whether past rows forecast the next row beyond what the measured state can.

The next row is regressed on the present one in innovation form, y_{k+1} = A y_k + B u_k + C e_k + g(x̂_k, u_k). Here
e_k = y_k − ŷ_k is the last error of the same model, and x̂_k the estimate of the state that it implies. g has products
of two signals, hinge functions of each and radial functions; a state that moves by more than 2π may enter by sine and
cosine. If y is the state and its noise white, the rows before hold nothing more. A second model has these rows too. Its
gain on unseen rows is evidence of a hidden state if it is beyond chance, and beyond what twice the rows and twice the
functions gain. Without sine and cosine an angle that turns left its range, and past rows then told where it was.

References
----------
Ljung, "System Identification", 2nd ed., 1999, sections 4.2 and 10.3 (extended least squares).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.text import to_percent
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.lifting.base import strip_unit


@dataclass(frozen=True)
class _Limits:
    """Sizes and limits of the search for a hidden state."""

    past: tuple[int, ...] = (8, 4, 2)  # past rows of the second model: the most that the episodes allow
    few: int = 2  # past rows of a smaller second model
    left: float = 0.6  # share of the rows that must have so many rows before them
    rows: int = 2500  # read at most about this many rows
    least: int = 120  # rows, below which nothing can be told
    each: int = 10  # rows for each radial function
    centres: int = 100  # radial functions at most
    knots: int = 10  # hinge functions of each state and input
    signals: int = 10  # states and inputs at most
    passes: int = 12  # of extended least squares for the innovations
    rounds: int = 2  # of fitting the nonlinear model with the innovations of the fit before
    rough: float = 1e-4  # weight of its radial functions there
    ridges: tuple[float, ...] = (1e-8, 1e-6, 1e-4, 1e-2)  # weights on columns of unit size
    folds: int = 4
    blocks: int = 16  # of rows, for the standard error of the gain
    sure: float = 4.0  # standard errors
    gain: float = 0.4  # share of the squared error on unseen rows that past rows must remove
    beyond: float = 2.0  # times as much as twice the rows and radial functions remove, in logarithms
    # errors below this share of a usual change from row to row may be the lifting's, and do little harm
    seen: float = 0.15
    extreme: float = 0.99  # larger errors than this quantile count as it
    tiny: float = 1e-300


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class Memory(Value):
    """What the past rows of logs tell beyond the present row.

    Attributes
    ----------
    states
        Names of the measured states.
    gain
        (nx,) share of the squared one-step error on unseen rows that past rows remove.
    sure
        (nx,) the gain in standard errors.
    lifting
        (nx,) share of the squared error that twice the rows and radial functions remove without past rows.
    error
        (nx,) one-step error without past rows, as a share of the usual change from row to row.
    rows
        Past rows that were tried; 0 where the logs are too short to tell.
    """

    states: tuple[str, ...]
    gain: Float[np.ndarray, " nx"]
    sure: Float[np.ndarray, " nx"]
    lifting: Float[np.ndarray, " nx"]
    error: Float[np.ndarray, " nx"]
    rows: int

    @property
    def evidence(self) -> np.ndarray:
        """(nx,) True for each state whose next value a hidden state moves."""
        beyond = np.log1p(-self.gain) < _LIMITS.beyond * np.log1p(-np.maximum(self.lifting, 0.0))
        return (self.gain > _LIMITS.gain) & (self.sure > _LIMITS.sure) & beyond & (self.error > _LIMITS.seen)

    @property
    def shows_hidden_state(self) -> bool:
        """Whether the logs show a hidden state."""
        return bool(self.evidence.any())

    def __str__(self) -> str:
        """Return a sentence."""
        if not self.rows:
            return "cannot say whether a state is hidden: the episodes are too short, or have too many signals"
        if not self.shows_hidden_state:
            return f"no hidden state shows in {self.rows} past rows"
        i = int(np.argmax(np.where(self.evidence, self.gain, -1.0)))
        return (
            f"a hidden state shows: on unseen rows {self.rows} past rows remove {to_percent(float(self.gain[i]))} of "
            f"the squared one-step error of {strip_unit(self.states[i])} that noise and lifting leave"
        )


class _Rows(NamedTuple):
    """Rows k of all stretches, standardized, and which rows of a stretch follow each other."""

    now: Float[np.ndarray, "M nx"]
    after: Float[np.ndarray, "M nx"]
    inputs: Float[np.ndarray, "M nu"]
    past: Float[np.ndarray, "M p"]
    wide: Int[np.ndarray, " t"]  # states that move by more than 2π, which may be angles
    mean: Float[np.ndarray, " nx"]
    size: Float[np.ndarray, " nx"]  # a state is mean + size × its standardized value
    follows: Int[np.ndarray, " M"]  # place of the row before, −1 for none
    few: int  # columns of the past that hold its first rows


def find_hidden_state(data: Episodes) -> Memory:
    """Return what past rows tell of the next one beyond the measured state, which shows whether a state is hidden.

    Parameters
    ----------
    data
        Logs of the states as they are measured, without delays; about 2500 rows of them are read.

    Returns
    -------
    Memory
        ``shows_hidden_state`` is the answer; `print` says it in a sentence.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=20, steps=60)
    >>> km.validate.find_hidden_state(data).shows_hidden_state
    False
    >>> angle = km.Episodes([km.Episode(X=e.X[:, :1], U=e.U) for e in data], data.dt, states=("theta",))
    >>> km.validate.find_hidden_state(angle).shows_hidden_state
    True
    """
    data = episodes_of(data).driven()
    rows = _stack_rows(data)
    nothing = np.zeros(data.nx)
    if rows is None:
        return Memory(data.states, nothing, nothing, nothing, nothing, 0)
    change = np.sqrt(np.mean((rows.after - rows.now) ** 2, axis=0))
    innovations, lag = _find_innovations(rows)
    shares = (0.0, 1.0) if (lag < -0.05).any() else (0.0,)
    none = np.zeros(0, dtype=np.int64)
    turns = [none, *(rows.wide[[i]] for i in range(len(rows.wide))), *([rows.wide] if len(rows.wide) > 1 else [])]
    fits = [_Fit(rows, share * lag, innovations, turning) for share, turning in product(shares, turns)]
    return min(fits, key=lambda fit: float(fit.whole.sum())).measure(change, data.states)


def _stack_rows(data: Episodes) -> _Rows | None:
    """Return the rows of evenly spread stretches; None where the episodes are too short, or have too many signals."""
    X, U = (np.concatenate(parts) for parts in zip(*((e.X[:-1], e.U) for e in data), strict=True))
    moving = np.ptp(U, axis=0) > 0
    if data.nx + int(moving.sum()) > _LIMITS.signals:
        return None
    lengths = np.array([len(e) for e in data])
    fitting = [d for d in _LIMITS.past if np.maximum(lengths - d, 0).sum() >= _LIMITS.left * lengths.sum()]
    if not fitting:
        return None
    past = fitting[0]
    x_mean, x_size = X.mean(axis=0), np.where(X.std(axis=0) > 0, X.std(axis=0), 1.0)
    wide = np.flatnonzero(np.ptp(X, axis=0) > 2 * np.pi)
    u_mean, u_size = U[:, moving].mean(axis=0), U[:, moving].std(axis=0)
    parts: list[tuple[np.ndarray, ...]] = []
    count = 0
    for e, k in _choose_rows(data, past):
        Z, V = (e.X - x_mean) / x_size, (e.U[:, moving] - u_mean) / u_size
        before = np.hstack([column for i in range(1, past + 1) for column in (Z[k - i], V[k - i])])
        parts.append((Z[k], Z[k + 1], V[k], before, np.r_[-1, np.arange(count, count + len(k) - 1)]))
        count += len(k)
    if count < _LIMITS.least:
        return None
    now, after, inputs, before, follows = (np.concatenate(column) for column in zip(*parts, strict=True))
    width = data.nx + int(moving.sum())
    return _Rows(now, after, inputs, before, wide, x_mean, x_size, follows, min(_LIMITS.few, past) * width)


def _choose_rows(data: Episodes, past: int) -> Iterator[tuple[Episode, Int[np.ndarray, " n"]]]:
    """Yield the rows of evenly spread stretches, with so many rows before each."""
    long = [e for e in data if len(e) > past]
    share = max(sum(len(e) for e in long) / _LIMITS.rows, 1.0)
    pieces = 1 if len(long) >= 50 or share == 1.0 else 8
    for e in long if len(long) < 50 else long[:: int(np.ceil(share))]:
        kept = (len(e) if pieces == 1 else int(len(e) / share)) // pieces
        for low in map(int, np.linspace(0, len(e) - kept, pieces)):
            k = np.arange(low + past, min(low + max(kept, past + 1), len(e)))
            if len(k):
                yield e, k


def _find_innovations(rows: _Rows) -> tuple[Float[np.ndarray, "M nx"], Float[np.ndarray, " nx"]]:
    """Return the errors e_k of a linear model with their own last value, and x̂_k − y_k as a share of e_k."""
    nx, known = rows.now.shape[1], rows.follows >= 0
    base = np.hstack([np.ones((len(rows.now), 1)), rows.now, rows.inputs])
    last = np.zeros_like(rows.now)
    K = np.zeros((base.shape[1] + nx, nx))
    for _ in range(_LIMITS.passes):
        P = np.hstack([base, last])
        G = P.T @ P
        K = np.linalg.solve(G + 1e-8 * np.diag(np.maximum(np.diag(G), 1e-8)), P.T @ rows.after)
        left = rows.after - P @ K
        last = np.where(known[:, None], left[rows.follows], 0.0)
    A, C = K[1 : 1 + nx].T, K[-nx:].T
    lag = np.diag(np.linalg.lstsq(A.T @ A + 1e-3 * np.eye(nx), A.T @ C, rcond=None)[0])
    return last, np.clip(lag, -0.95, 0.0)


class _Fit:
    """The models of one choice of the estimate, and of the states that are angles."""

    def __init__(
        self,
        rows: _Rows,
        lag: Float[np.ndarray, " nx"],
        innovations: Float[np.ndarray, "M nx"],
        turning: Int[np.ndarray, " t"],
    ) -> None:
        self._rows, centres, known = rows, min(_LIMITS.centres, len(rows.now) // _LIMITS.each), rows.follows >= 0
        for done in range(_LIMITS.rounds + 1):
            self._F, self._ends = _stack_features(rows, rows.now + innovations * lag, innovations, centres, turning)
            if done < _LIMITS.rounds:
                F, ends = self._F[:, : self._ends.whole], self._ends
                G, H = _products(F, rows.after)
                light = np.where(np.arange(ends.whole) < ends.light, 1e-9, _LIMITS.rough) * len(F)
                left = rows.after - F @ np.linalg.solve(G + np.diag(light + 1e-10 * len(F)), H)
                innovations = np.where(known[:, None], left[rows.follows], 0.0)
        fold = np.arange(len(rows.now)) * _LIMITS.blocks // len(rows.now) % _LIMITS.folds
        self._places = [
            np.flatnonzero(fold == out) for out in range(_LIMITS.folds)
        ]  # blocks in turn: unseen rows lie among
        self._sums = [_products(self._F[place], rows.after[place]) for place in self._places]  # those of the fit
        self.whole = self._log_errors(self._ends.whole).mean(axis=0)

    def measure(self, change: Float[np.ndarray, " nx"], states: tuple[str, ...]) -> Memory:
        """Return what past rows remove of the errors of the model without them."""
        rows, ends, whole = self._rows, self._ends, self._log_errors(self._ends.whole)
        few, past = self._log_errors(ends.whole + rows.few), self._log_errors(self._F.shape[1])
        gaps = whole - np.where(few.mean(axis=0) < past.mean(axis=0), few, past)
        return Memory(
            states,
            1 - np.exp(-gaps.mean(axis=0)),
            gaps.mean(axis=0) / np.maximum(gaps.std(axis=0, ddof=1) / np.sqrt(_LIMITS.blocks), _LIMITS.tiny),
            1 - np.exp(whole.mean(axis=0) - self._log_errors(ends.half, half=True).mean(axis=0)),
            np.exp(whole.mean(axis=0) / 2) / np.maximum(change, 1e-12),
            rows.past.shape[1] // (rows.now.shape[1] + rows.inputs.shape[1]),
        )

    def _log_errors(self, columns: int, half: bool = False) -> Float[np.ndarray, "blocks nx"]:
        """Return the logarithm of each block's squared error on each fold of a fit to the others, with the best ridge.

        Each target has a ridge of its own. `half` fits to every second row.
        """
        F, targets = self._F[:, :columns], self._rows.after
        used = [place[:: 2 if half else 1] for place in self._places]
        sums = [_products(F[place], targets[place]) for place in used] if half else self._sums
        light = np.where(np.arange(columns) < self._ends.light, 1e-9, 1.0)
        errors = np.empty((len(_LIMITS.ridges), *targets.shape))
        for out, place in enumerate(self._places):
            rest = [f for f in range(_LIMITS.folds) if f != out]
            G = np.sum([sums[f][0][:columns, :columns] for f in rest], axis=0)
            H = np.sum([sums[f][1][:columns] for f in rest], axis=0)
            count, unseen = sum(len(used[f]) for f in rest), F[place]
            for r, ridge in enumerate(_LIMITS.ridges):
                K: Float[np.ndarray, "p nx"] = np.asarray(
                    np.linalg.solve(G + np.diag((ridge * light + 1e-10) * count), H), dtype=np.float64
                )
                errors[r, place] = (targets[place] - unseen @ K) ** 2
        capped = np.minimum(errors, np.quantile(errors, _LIMITS.extreme, axis=1, keepdims=True))
        chosen = capped.mean(axis=1).argmin(axis=0)
        return _log_blocks(np.stack([capped[r, :, i] for i, r in enumerate(chosen)], axis=1))


def _log_blocks(errors: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "blocks nx"]:
    """Return the logarithm of each block's mean: few blocks in which a model extrapolates do not decide."""
    return np.log([np.maximum(part.mean(axis=0), _LIMITS.tiny) for part in np.array_split(errors, _LIMITS.blocks)])


class _Ends(NamedTuple):
    """Numbers of columns: those without a weight, of the model with half of the radial functions, with all of them."""

    light: int
    half: int
    whole: int


def _stack_point(
    rows: _Rows, estimate: Float[np.ndarray, "M nx"], turning: Int[np.ndarray, " t"]
) -> Float[np.ndarray, "M n"]:
    """Return the estimate, with sine and cosine in place of angles, and the inputs."""
    angle = rows.mean[turning] + rows.size[turning] * estimate[:, turning]
    return np.hstack([np.delete(estimate, turning, axis=1), np.sin(angle), np.cos(angle), rows.inputs])


def _stack_features(
    rows: _Rows,
    estimate: Float[np.ndarray, "M nx"],
    innovations: Float[np.ndarray, "M nx"],
    count: int,
    turning: Int[np.ndarray, " t"],
) -> tuple[Float[np.ndarray, "M p"], _Ends]:
    """Return the columns of all models, of unit size: linear ones, products, radial functions, past rows."""
    M = len(rows.now)
    point = _stack_point(rows, estimate, turning)
    where = point[:, : point.shape[1] - rows.inputs.shape[1]]
    centres = point[np.random.default_rng(0).permutation(M)[:count]]
    width = np.sqrt(point.shape[1]) * np.where(np.arange(count) % 4 < 2, 0.8, 2.0)
    distance = (point**2).sum(axis=1)[:, None] - 2 * point @ centres.T + (centres**2).sum(axis=1)
    radial = np.exp(-np.maximum(distance, 0.0) / (2 * width**2))
    knots = np.quantile(
        point, np.linspace(0, 1, 2 * _LIMITS.knots + 1)[1:-1:2], axis=0
    )  # of friction, rails, dead zones
    hinges = np.maximum(point[:, None, :] - knots, 0.0)
    even, odd = (hinges[:, start::2].reshape(M, -1) for start in (0, 1))
    i, j = np.triu_indices(point.shape[1])
    gains = (innovations[:, :, None] * point[:, None, :]).reshape(M, -1)  # the filter's gain changes with the state
    light = [np.ones((M, 1)), rows.now, rows.inputs, innovations]
    middle = [where, point[:, i] * point[:, j], gains]
    F = np.hstack([*light, *middle, even, radial[:, : count // 2], odd, radial[:, count // 2 :], rows.past])
    F[:, 1:] -= F[:, 1:].mean(axis=0)
    size = F.std(axis=0)
    F /= np.where(size > 1e-9, size, 1.0)
    F[:, 0] = 1.0
    first = sum(part.shape[1] for part in light)
    second = first + sum(part.shape[1] for part in middle)
    half = second + even.shape[1] + count // 2
    return F, _Ends(first, half, second + hinges[0].size + count)


def _products(
    F: Float[np.ndarray, "M p"], targets: Float[np.ndarray, "M nx"]
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p nx"]]:
    return F.T @ F, F.T @ targets
