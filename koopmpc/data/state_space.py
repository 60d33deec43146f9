"""Filter, smoother and expectation–maximisation of the state-space model behind `Smoother`, states in unit variance."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

DELAYS = (0, 1, 2)  # past steps that a model may have


@dataclass(frozen=True)
class _Limits:
    """Limits of the fit of the smoother's model."""

    iterations: int = 40  # of expectation–maximisation, at most
    fewest: int = 10  # iterations, at least
    gain: float = 2.0  # of the log-likelihood in one iteration; with less the fit ends
    least: float = 1e-10  # variance of either noise
    rounding: float = 1e-13  # added to variances before they are inverted
    round: float = 1e-6  # least share of a variance that is not rounding
    settled: float = 1e-12  # change of a variance from step to step after which the gains stay


_LIMITS = _Limits()


class StateSpace(NamedTuple):
    """The model of a `Smoother`, of states and inputs in standard deviations; s_k = [x_k … x_{k−d}]."""

    delays: int
    products: bool
    K: Float[np.ndarray, "n nx"]
    V: Float[np.ndarray, "nx nx"]
    R: Float[np.ndarray, " nx"]
    start: Float[np.ndarray, " N"]
    start_spread: Float[np.ndarray, "N N"]

    @property
    def F(self) -> Float[np.ndarray, "N N"]:
        """Of s_{k+1} = F s_k + [drive, 0], s_k = [x_k … x_{k−d}]."""
        N, nx = len(self.start), len(self.V)
        return np.vstack([self.K[:N].T, np.eye(N)[: N - nx]])

    def regressors(self, S: Float[np.ndarray, "E L N"], U: Float[np.ndarray, "E T nu"]) -> Float[np.ndarray, "E _ m"]:
        """Return what drives s_{k+1} besides s_k: inputs, 1, and the products."""
        d, steps, nx = self.delays, U.shape[1], len(self.V)
        x = S[:, :-1, :nx]
        columns = [U[:, d - j : steps - j] for j in range(d + 1)] + [np.ones((*x.shape[:2], 1))]
        if self.products:
            i, j = np.triu_indices(nx)
            columns += [x[..., i] * x[..., j], (U[:, d:, :, None] * x[:, :, None, :]).reshape(*x.shape[:2], -1)]
        return np.concatenate(columns, axis=-1)

    def drive(self, S: Float[np.ndarray, "E L N"], U: Float[np.ndarray, "E T nu"]) -> Float[np.ndarray, "E _ nx"]:
        """Return x_{k+1} − Σ A_j x_{k−j} without noise, products at the states S."""
        return self.regressors(S, U) @ self.K[len(self.start) :]


class Stretches(NamedTuple):
    """Measurements and inputs in standard deviations, and the number of steps of each; shorter ones end in zeros."""

    X: Float[np.ndarray, "E T+1 nx"]
    U: Float[np.ndarray, "E T nu"]
    last: Int[np.ndarray, " E"]


class SmootherGains(NamedTuple):
    """Of filter and smoother, of s_d, s_{d+1} …; the last ones serve all later steps."""

    filter: list[Float[np.ndarray, "N _"]]
    back: list[Float[np.ndarray, "N _"]]
    before: list[Float[np.ndarray, "N _"]]  # covariance of s_k given y_0 … y_{k−1}
    after: list[Float[np.ndarray, "N _"]]  # and given y_k too


def gains_of(model: StateSpace, length: int) -> SmootherGains:
    """Return the gains of `length` steps s_d … s_T. They depend on no measurement, so all episodes share them."""
    N, nx, F = len(model.start), len(model.V), model.F
    one, V = np.eye(N), np.zeros((N, N))
    V[:nx, :nx] = model.V
    P, result = model.start_spread, SmootherGains([], [], [], [])
    aheads: list[Float[np.ndarray, "N _"]] = []
    onward: list[Float[np.ndarray, "N _"]] = []
    for k in range(length):
        seen, R = (N, np.tile(model.R, N // nx)) if k == 0 else (nx, model.R)  # s_d is measured as a whole
        K = np.linalg.solve(P[:seen, :seen] + np.diag(R), P[:seen]).T
        result.before.append(P)
        result.filter.append(K)
        left = one.copy()
        left[:, :seen] -= K
        P = left @ P @ left.T + (K * R) @ K.T
        result.after.append(P)
        onward.append(F @ P)
        ahead = onward[-1] @ F.T + V
        ahead = (ahead + ahead.T) / 2
        aheads.append(ahead)
        if k > 0 and np.abs(ahead - result.before[-1]).max() < _LIMITS.settled:
            break
        P = ahead
    back = np.linalg.solve(np.array(aheads) + _LIMITS.rounding * one, np.array(onward))
    result.back.extend(back.transpose(0, 2, 1))
    return result


def smooth(
    model: StateSpace, gains: SmootherGains, given: Stretches, drive: Float[np.ndarray, "E _ nx"]
) -> Float[np.ndarray, "E L N"]:
    """Return E[s_k | y_0 … y_T] of each episode: forward with the filter, then back (Rauch, Tung & Striebel)."""
    before, after, _ = _filter(model, gains, given, drive)
    return _back(gains, before, after, given.last - model.delays)


def _filter(
    model: StateSpace, gains: SmootherGains, given: Stretches, drive: Float[np.ndarray, "E _ nx"]
) -> tuple[Float[np.ndarray, "L E N"], Float[np.ndarray, "L E N"], list[Float[np.ndarray, "E nx"]]]:
    """Return E[s_k | y_0 … y_{k−1}], E[s_k | y_0 … y_k], and what each measurement after the first missed."""
    X, d, nx, F = given.X, model.delays, len(model.V), model.F
    E, length = len(X), X.shape[1] - d
    before, after = np.empty((2, length, E, len(model.start)))
    gaps: list[Float[np.ndarray, "E nx"]] = []
    m = np.broadcast_to(model.start, before.shape[1:])
    for k in range(length):
        before[k] = m
        gap = stack_delays(X[:, : d + 1], d)[:, 0] - m if k == 0 else X[:, k + d] - m[:, :nx]
        if k:
            gaps.append(gap)
        after[k] = m + gap @ gains.filter[min(k, len(gains.filter) - 1)].T
        if k < length - 1:
            m = after[k] @ F.T
            m[:, :nx] += drive[:, k]
    return before, after, gaps


def _back(
    gains: SmootherGains,
    before: Float[np.ndarray, "L E N"],
    after: Float[np.ndarray, "L E N"],
    last: Int[np.ndarray, " E"],
) -> Float[np.ndarray, "E L N"]:
    states = after.copy()
    for k in range(len(after) - 2, -1, -1):
        step = (states[k + 1] - before[k + 1]) @ gains.back[min(k, len(gains.back) - 1)].T
        states[k] += np.where((k < last)[:, None], step, 0.0)
    return states.transpose(1, 0, 2)


def _covariances(gains: SmootherGains, length: int) -> tuple[Float[np.ndarray, "L N N"], Float[np.ndarray, "N N"]]:
    """Return cov(s_k) of each step and Σ_k cov(s_{k+1}, s_k), both given all measurements."""
    last = len(gains.before) - 1
    P = [gains.after[last]] * length
    lag = np.zeros_like(P[0])
    for k in range(length - 2, -1, -1):
        G = gains.back[min(k, last)]
        P[k] = gains.after[min(k, last)] + G @ (P[k + 1] - gains.before[min(k + 1, last)]) @ G.T
        lag += P[k + 1] @ G.T
    return np.array(P), lag


def left_out(
    model: StateSpace, gains: SmootherGains, given: Stretches, states: Float[np.ndarray, "E L N"]
) -> tuple[Float[np.ndarray, "E T nx"], Float[np.ndarray, "E T nx"]]:
    """Return for each measurement by how much it misses what all others say of it, and that by its standard deviation.

    With x̂ and P of all measurements, (y − x̂) / (1 − h) is the difference to the estimate without y, of variance
    R / (1 − h), h = P / R. Rows beyond the end of an episode are zero.
    """
    d, nx = model.delays, len(model.V)
    gap, size = given.X - unstack_delays(states, d, nx), np.ones_like(given.X)
    for steps in np.unique(given.last):
        own = np.array([np.diag(P) for P in _covariances(gains, int(steps) + 1 - d)[0]])
        first = own[0].reshape(d + 1, nx)[:0:-1]
        free = np.maximum(1 - np.concatenate([first, own[:, :nx]]) / model.R, _LIMITS.round)
        of = given.last == steps
        gap[of, : steps + 1] /= free
        gap[of, steps + 1 :] = 0.0
        size[of, : steps + 1] = np.sqrt(model.R / free)
    return gap, np.abs(gap) / size


def fit_state_space(given: Stretches, delays: int, *, products: bool) -> tuple[float, StateSpace]:
    """Return the log-likelihood for each number that was measured, and the model, by expectation–maximisation.

    The likelihoods of models with other delays are of the same measurements, those from step 3 on.
    """
    X, U = given.X, given.U
    nx, S = X.shape[2], stack_delays(X, delays)
    N = S.shape[2]
    flat = S.reshape(-1, N)
    spread = np.cov(flat.T).reshape(N, N) + 1e-6 * np.eye(N)
    model = StateSpace(delays, products, np.zeros((N, nx)), np.eye(nx), np.ones(nx), flat.mean(axis=0), spread)
    D = model.regressors(S, U)
    rows, ahead = _rows(S, D), S[:, 1:, :nx].reshape(-1, nx)
    K = np.linalg.lstsq(rows, ahead, rcond=1e-9)[0]
    missed = ahead - rows @ K
    V = missed.T @ missed / (2 * len(rows)) + _LIMITS.least * np.eye(nx)  # half of it is noise, for a start
    model = model._replace(K=K, V=V, R=np.diag(V) / 2)
    reached: list[float] = []
    for _ in range(_LIMITS.iterations):
        model, likelihood, D = _improve(model, given, D)
        reached.append(likelihood)
        if len(reached) > _LIMITS.fewest and reached[-1] < reached[-2] + _LIMITS.gain:
            break
    numbers = X.shape[0] * (X.shape[1] - 1 - max(DELAYS)) * nx
    return reached[-1] / numbers, model


def _improve(
    model: StateSpace, given: Stretches, D: Float[np.ndarray, "E _ m"]
) -> tuple[StateSpace, float, Float[np.ndarray, "E _ m"]]:
    """One iteration: smooth with the model, then fit it to the smoothed states and their covariances.

    Returns the model, the log-likelihood of the model before it, and the regressors of the smoothed states.
    """
    X, d, nx, N = given.X, model.delays, len(model.V), len(model.start)
    E, length = len(X), X.shape[1] - d
    gains = gains_of(model, length)
    before, after, gaps = _filter(model, gains, given, D @ model.K[N:])
    S = _back(gains, before, after, given.last - d)
    total, lag = _covariances(gains, length)
    likelihood, first = 0.0, max(max(DELAYS) - d, 0)
    spreads = np.array([P[:nx, :nx] + np.diag(model.R) for P in gains.before])
    which = np.minimum(np.arange(first + 1, len(gaps) + 1), len(spreads) - 1)
    logarithms = np.linalg.slogdet(spreads)[1][which]
    weighed = np.linalg.solve(spreads[which], np.array(gaps[first:]).transpose(0, 2, 1))
    for gap, by, logarithm in zip(gaps[first:], weighed, logarithms, strict=True):
        likelihood -= (np.sum(gap * by.T) + E * logarithm) / 2
    D = model.regressors(S, given.U)
    rows, ahead = _rows(S, D), S[:, 1:, :nx].reshape(-1, nx)
    square, cross = rows.T @ rows, rows.T @ ahead
    square[:N, :N] += E * total[:-1].sum(axis=0)
    cross[:N] += E * lag[:nx].T
    weight = 1e-9 * np.diag(np.diag(square)) + 1e-12 * np.eye(len(square))
    K = np.linalg.solve(square + weight, cross)
    V = ahead.T @ ahead + E * total[1:, :nx, :nx].sum(axis=0) - K.T @ cross - cross.T @ K + K.T @ square @ K
    sizes, axes = np.linalg.eigh((V + V.T) / (2 * len(rows)))
    V = (axes * np.maximum(sizes, _LIMITS.least)) @ axes.T
    left = np.sum((X - unstack_delays(S, d, nx)) ** 2, axis=(0, 1))
    own = np.diagonal(total, axis1=1, axis2=2)
    left += E * (own[:, :nx].sum(axis=0) + own[0, nx:].reshape(d, nx).sum(axis=0))
    better = model._replace(K=K, V=V, R=left / (E * X.shape[1]) + _LIMITS.least)
    return better, float(likelihood), D


def _rows(S: Float[np.ndarray, "E L N"], D: Float[np.ndarray, "E _ m"]) -> Float[np.ndarray, "M n"]:
    """Return the regressors [s_k, drive] of all episodes, a row each."""
    return np.concatenate([S[:, :-1], D], axis=-1).reshape(-1, S.shape[2] + D.shape[2])


def stack_delays(X: Float[np.ndarray, "E T nx"], delays: int) -> Float[np.ndarray, "E L N"]:
    """Return s_k = [x_k … x_{k−d}] of k = d … T."""
    steps = X.shape[1]
    return np.concatenate([X[:, delays - j : steps - j] for j in range(delays + 1)], axis=-1)


def unstack_delays(S: Float[np.ndarray, "E L N"], delays: int, nx: int) -> Float[np.ndarray, "E T nx"]:
    """Return x_0 … x_T of s_d … s_T; the first ones are those that s_d holds."""
    first = S[:, 0].reshape(len(S), delays + 1, nx)[:, :0:-1]
    return np.concatenate([first, S[:, :, :nx]], axis=1)
