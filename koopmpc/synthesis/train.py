"""train: centres, widths and frequencies of a lifting, by variable projection on the error over a horizon."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.lifting.tuning import Tuning
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.validate.scoring import score

_GAIN = 0.01  # share by which the held-out error must fall; less is chance
_PATIENCE = 20  # iterations without a better held-out error after which training stops
_FAR = 3.0  # logarithm of the largest factor by which a width may change
_LOST = 1e3  # the objective, a logarithm, where a prediction leaves the finite numbers
_FEW = 4  # episodes below which data are held out by time, not by episode


def train(
    lifting: Lifting,
    episodes: Episodes | Source,
    *,
    horizon: int = 10,
    held_out: float | Episodes = 0.25,
    embedding: Delay | None = None,
    ridge: float = 1e-8,
    windows: int = 1000,
    iterations: int = 200,
    rng: np.random.Generator | int = 0,
) -> LinearPredictor:
    """Fit ψ(x⁺; p) = A ψ(x; p) + B u with the numbers p of ψ trained: centres, widths, frequencies.

    The error that p minimises is that of x_{k+h} over h = 1 … horizon, predicted from x_k and u_k … u_{k+h−1}, relative
    to the size of each state, as `km.score` has it. For each p the matrices A and B are those of `edmd`, so p alone is
    searched for (variable projection), by L-BFGS; CasADi differentiates ψ, and the gradient goes back through the least
    squares and the horizon. Of all iterates the one that predicts the held-out data best is taken. Where none is better
    there by 1 %, or where its fit is not, the lifting stays as it is: on the held-out data the result is never
    worse than ``edmd(episodes, lifting, ridge=ridge)``.

    Parameters
    ----------
    lifting
        ψ; what is trained are the numbers of `Gaussian`, `ThinPlate` and `RandomFourier` in it, wherever they stand.
        Standardize states of different units: ``Standardized.of(episodes, lifting)``.
    episodes
        As in `edmd`. Training works on at most `windows` pieces of them; the fit at the end reads all.
    horizon
        N, in steps; that of the controller, or what the data allow.
    held_out
        The share of the episodes that chooses the iterate; below four episodes, of the time. Or other episodes, which
        the fit at the end does not read.
    embedding, ridge
        As in `edmd`; the ridge must be above zero.
    windows
        Largest number of pieces of `horizon` steps, drawn at random; memory and time go with it.
    iterations
        Largest number of iterations.
    rng
        Draws the pieces.

    Returns
    -------
    predictor
        That of `edmd` on the trained lifting, which is ``predictor.lifting``: other fits take it as they take any. The
        errors before and after stand in ``predictor.report.changes``.

    Raises
    ------
    DataError
        The lifting has nothing to train, the ridge is not above zero, no episode is as long as the horizon, or a
        source can be read once only.

    Warns
    -----
    FitWarning
        As `edmd`.

    References
    ----------
    Golub & Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables
    separate", SIAM J. Numer. Anal. 10, 1973; dictionary learning: Li, Dietrich, Bollt & Kevrekidis, Chaos 27, 2017.
    """
    N, most = checks.count(horizon, "horizon"), checks.count(windows, "windows")
    checks.count(iterations, "iterations")
    weight = checks.positive(ridge, "ridge")
    source, generator = source_of(episodes), np.random.default_rng(rng)
    if not source.replayable:
        raise DataError("a stream is read once, and train needs it more often; save it, and pass that")
    sized = None if embedding is None else embedding.fitted(source.states, source.inputs)
    given = lifting_of(lifting).bind(source.states if sized is None else sized.names)
    pieces = _drawn(source, N + (0 if sized is None else sized.steps), most, generator)
    if isinstance(held_out, Episodes):
        fitted, judge, other = pieces.all, held_out, _drawn(source_of(held_out), pieces.length, most, generator).all
        data: Episodes | Source = episodes
    else:
        share = checks.positive(held_out, "held_out")
        if share >= 1:
            raise DataError(f"held_out is {share:g}; pass a share below 1, or episodes")
        fitted, other = pieces.split(share, generator)
        data, judge = fitted, other
    tuning = Tuning(given)
    own, test = (_Windows.of(e if sized is None else sized(e), N, source.nx) for e in (fitted, other))
    p, taken = _search(VariableProjection(tuning, own, weight), test, iterations)
    chosen = tuning.at(p)
    before, after = (_held(data, one, judge, N, embedding, weight) for one in (given, chosen))
    better = after <= (1 - _GAIN) * before
    model = edmd(episodes, chosen if better else given, embedding=embedding, ridge=weight)
    said = f"{tuning.n} numbers of the lifting trained on {N}-step errors, {taken} iterations: the error on held-out data "
    said += f"fell from {before:.3g} to {after:.3g}" if better else f"{before:.3g} did not fall; the lifting is as it was"
    report = model.report
    assert report is not None
    return replace(model, report=replace(report, method="train", changes=(*report.changes, said)))


def _held(
    data: Episodes | Source, lifting: Lifting, judge: Episodes, horizon: int, embedding: Delay | None, ridge: float
) -> float:
    """Return the relative error over the horizon, on other episodes, of the fit to these data."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # that of the result is the one to read
        model = edmd(data, lifting, embedding=embedding, ridge=ridge)
    return score(model, judge, horizon).total


class _Pieces(NamedTuple):
    """Pieces of `length` steps, and the number of the episode that each is from and its first row there."""

    all: Episodes
    length: int
    places: list[tuple[int, int]]

    def split(self, share: float, rng: np.random.Generator) -> tuple[Episodes, Episodes]:
        """Return the pieces of some episodes and those of others; of few episodes, the first and the last by time."""
        sources = sorted({episode for episode, _ in self.places})
        if len(sources) >= _FEW:
            held = set(rng.permutation(sources)[: max(1, round(share * len(sources)))].tolist())
            side = [episode in held for episode, _ in self.places]
            kept = [not one for one in side]
        else:
            cut = round((1 - share) * len(self.places))
            border = self.places[min(max(cut, 1), len(self.places) - 1)]
            side = [place >= border for place in self.places]
            kept = [e < border[0] or (e == border[0] and k + self.length <= border[1]) for e, k in self.places]
        if not any(kept) or not any(side):
            raise DataError("the data are too short to hold a part of them out; pass held_out=Episodes(…), or collect more")
        return tuple(  # pyright: ignore[reportReturnType]
            self.all.with_episodes([e for e, one in zip(self.all, which, strict=True) if one]) for which in (kept, side)
        )


def _drawn(source: Source, length: int, count: int, rng: np.random.Generator) -> _Pieces:
    """Return `count` pieces of `length` steps, any as likely as any other, in the order of the data."""
    kept: list[tuple[float, tuple[int, int], Episode]] = []
    number = 0
    empty: Episodes | None = None
    for part in source.parts():
        for episode in (loaded := part.load()):
            keys = rng.random(max(len(episode) - length + 1, 0))
            for k in np.argsort(keys)[:count].tolist():
                rows = slice(k, k + length)
                piece = Episode(X=episode.X[k : k + length + 1], U=episode.U[rows], W=episode.W[rows])
                kept.append((float(keys[k]), (number, k), piece))
            kept = sorted(kept, key=lambda one: one[0])[:count]
            number += 1
        empty = loaded
    if not kept or empty is None:
        raise DataError(f"no episode has the {length} steps that the horizon asks for; pass a shorter one, or longer data")
    kept.sort(key=lambda one: one[1])
    return _Pieces(empty.with_episodes([piece for *_, piece in kept]), length, [place for _, place, _ in kept])


@dataclass(frozen=True)
class _Windows:
    """Pieces of N steps as arrays: what ψ acts on, with the states first; all inputs; 1 / (N nx Σ x²) of each state."""

    X: Float[np.ndarray, "M N1 np"]
    V: Float[np.ndarray, "M N nv"]
    weight: Float[np.ndarray, "N nx"]

    @classmethod
    def of(cls, points: Episodes, N: int, nx: int) -> "_Windows":
        X = np.stack([e.X for e in points])
        size = np.sum(X[:, 1:, :nx] ** 2, axis=0)
        weight = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0) / (N * nx)
        return cls(X, np.stack([np.hstack([e.U, e.W]) for e in points]), weight)


class _LeastSquares:
    """K = argmin ‖T − P K‖² + ridge ‖D K‖², D the norms of P's columns, and the way back through it."""

    def __init__(self, P: Float[np.ndarray, "m n"], T: Float[np.ndarray, "m k"], ridge: float) -> None:
        self.P, self.T, self.ridge = P, T, ridge
        G = P.T @ P
        self.norms = np.sqrt(np.where(G.diagonal() > 0, G.diagonal(), 1.0))
        self.factor = cho_factor(G / np.outer(self.norms, self.norms) + ridge * np.eye(len(G)))
        self.K = self._solve(P.T @ T)

    def _solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        return cast("Any", cho_solve(self.factor, right / self.norms[:, None])) / self.norms[:, None]

    def pullback(self, dK: Float[np.ndarray, "n k"]) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m k"]]:
        """Return the derivatives by P and T of what has the derivative dK by K."""
        right = self._solve(dK)
        dG = -right @ self.K.T
        by_norms = 2 * self.ridge * dG.diagonal()
        return self.T @ right.T + self.P @ (dG + dG.T) + self.P * by_norms, self.P @ right


class VariableProjection:
    """J(p) = log of the relative error over the horizon, with the A, B and C that p's least squares give.

    Parameters
    ----------
    tuning
        ψ(x; p).
    windows
        The data.
    ridge
        Of the least squares, on columns of unit norm.
    """

    def __init__(self, tuning: Tuning, windows: _Windows, ridge: float) -> None:
        self.tuning, self.windows, self.ridge = tuning, windows, ridge
        names, states = tuning.lifting.names, tuning.lifting.bound_states[: windows.weight.shape[1]]
        self.held = [(i, names.index(state)) for i, state in enumerate(states) if state in names]
        self.missing = [i for i, state in enumerate(states) if state not in names]

    def __call__(self, p: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        """Return J and its gradient."""
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                return self._both(p)
            except (LinAlgError, ValueError):  # the observables, or the forecasts, left the finite numbers
                return _LOST, np.zeros(len(p))

    def elsewhere(self, p: Float[np.ndarray, " n"], other: _Windows) -> float:
        """Return J on other windows, with the matrices that these give."""
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                Z = self._lifted(p, self.windows)
                fit, decode = self._fitted(Z)
                error = _forecast(self._lifted(p, other), fit.K, self._decoder(decode), other)[0]
            except (LinAlgError, ValueError):
                return _LOST
        return 0.5 * float(np.log(max(error, 1e-300))) if np.isfinite(error) else _LOST

    def _both(self, p: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        data, nz = self.windows, self.tuning.lifting.nz
        Z = self._lifted(p, data)
        fit, decode = self._fitted(Z)
        error, back = _forecast(Z, fit.K, self._decoder(decode), data)
        if not np.isfinite(error) or error == 0:
            return (_LOST if error else -_LOST), np.zeros(len(p))
        dZ0, dK, dC = back()
        dP, dT = fit.pullback(dK)
        dZ = np.zeros_like(Z)
        dZ[:, 0] += dZ0
        dZ[:, :-1] += dP[:, :nz].reshape(dZ[:, :-1].shape)
        dZ[:, 1:] += dT.reshape(dZ[:, 1:].shape)
        if decode is not None:
            dZ[:, :-1] += decode.pullback(dC[:, self.missing])[0].reshape(dZ[:, :-1].shape)
        flat = data.X.reshape(-1, data.X.shape[2])
        gradient = self.tuning.pullback(flat, p, dZ.reshape(len(flat), nz))
        return 0.5 * float(np.log(error)), gradient / (2 * error)

    def _lifted(self, p: Float[np.ndarray, " n"], data: _Windows) -> Float[np.ndarray, "M N1 nz"]:
        M, N1, n = data.X.shape
        return self.tuning(data.X.reshape(-1, n), p).reshape(M, N1, -1)

    def _fitted(self, Z: Float[np.ndarray, "M N1 nz"]) -> "tuple[_LeastSquares, _LeastSquares | None]":
        """Return the fit of [A B]ᵀ, and that of C where the lifting does not hold all states."""
        nz, X = Z.shape[2], self.windows.X
        now, ahead = Z[:, :-1].reshape(-1, nz), Z[:, 1:].reshape(-1, nz)
        V = self.windows.V.reshape(len(now), -1)
        fit = _LeastSquares(np.hstack([now, V]), ahead, self.ridge)
        if not self.missing:
            return fit, None
        return fit, _LeastSquares(now, X[:, :-1, self.missing].reshape(len(now), -1), self.ridge)

    def _decoder(self, decode: "_LeastSquares | None") -> Float[np.ndarray, "nz nx"]:
        """Return Cᵀ: rows of the identity for the states that the lifting holds, least squares for the others."""
        C = np.zeros((self.tuning.lifting.nz, len(self.held) + len(self.missing)))
        for state, place in self.held:
            C[place, state] = 1.0
        if decode is not None:
            C[:, self.missing] = decode.K
        return C


_Back = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _forecast(
    Z: Float[np.ndarray, "M N1 nz"], K: Float[np.ndarray, "n nz"], C: Float[np.ndarray, "nz nx"], data: _Windows
) -> tuple[float, _Back]:
    """Return the mean relative squared error over the horizon, and what gives its derivatives by z_0, K and C."""
    nz, N, nx = Z.shape[2], data.V.shape[1], C.shape[1]
    A, B = K[:nz], K[nz:]
    path = [Z[:, 0]]
    for h in range(N):
        path.append(path[-1] @ A + data.V[:, h] @ B)
    gaps = [path[h + 1] @ C - data.X[:, h + 1, :nx] for h in range(N)]
    error = float(sum(np.sum(gap**2, axis=0) @ weight for gap, weight in zip(gaps, data.weight, strict=True)))

    def back() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        dz, dK, dC = np.zeros_like(path[0]), np.zeros_like(K), np.zeros_like(C)
        for h in reversed(range(N)):
            slope = 2 * gaps[h] * data.weight[h]
            dC += path[h + 1].T @ slope
            dz += slope @ C.T
            dK[:nz] += path[h].T @ dz
            dK[nz:] += data.V[:, h].T @ dz
            dz = dz @ A.T
        return dz, dK, dC

    return error, back


def _search(objective: VariableProjection, test: _Windows, iterations: int) -> tuple[Float[np.ndarray, " n"], int]:
    """Return the iterate of L-BFGS with the least error on the test windows, and how many iterations there were."""
    tuning = objective.tuning
    best, least, taken, at = np.zeros(tuning.n), objective.elsewhere(np.zeros(tuning.n), test), 0, 0

    def judged(intermediate_result: Any) -> None:
        nonlocal best, least, taken, at
        taken += 1
        p = np.array(intermediate_result.x)
        error = objective.elsewhere(p, test)
        if error < least:
            best, least, at = p, error, taken
        elif taken - at >= _PATIENCE:
            raise StopIteration

    ends: Iterator[tuple[float, float]] = ((-_FAR, _FAR) if one else (-np.inf, np.inf) for one in tuning.positive)
    options = {"maxiter": iterations, "maxcor": 20}
    cast("Any", minimize)(
        objective, np.zeros(tuning.n), jac=True, method="L-BFGS-B", bounds=list(ends), callback=judged, options=options
    )
    return best, taken
