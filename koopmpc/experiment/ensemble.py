"""Ensemble: bootstrap models of a plant, whose disagreement gives the bands of a planned experiment."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri, stdtrit

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.values import Value

MEMBERS = 12  # bootstrap models
BLOCKS = 24  # stretches of the data that the bootstrap draws from
WINDOW = 25  # steps of the forecasts that calibrate a band
_FOLDS = 3  # parts of the data that are forecast by models of the others
UNUSUAL = 1.5  # bands of plans are this much wider than those of windows, for a plan is the oddest of a library
_MOST_WINDOWS = 300  # forecasts that calibrate a band
_RUN = 30  # residuals are drawn in runs of this many steps, for misfit lasts
_FARTHEST = 1e8  # leverage, over its mean, from which on errors do not grow further
_HUGE = 1e6  # a forecast ends where a state is this many times its size in the data
FINE = 1e-3  # errors below this share of a usual change from step to step do not matter
_PRIOR = (FINE**2, 1.0)  # least and largest weight of the prior, in rows of data

LoopLaw = Callable[[int, Float[np.ndarray, "*batch n"]], Float[np.ndarray, "*batch nu"]]
"""u = law(k, points): the input of each of many loops at once."""

Fit = Callable[[Episodes], LinearPredictor | BilinearPredictor]
"""A model of one structure, fitted to episodes."""


@dataclass(frozen=True, eq=False)
class Ensemble(Value):
    """x⁺ = Θᵀ φ(ζ, u) + e of a model, and of `MEMBERS` bootstrap models; φ = [ψ(ζ), u, w], and u_i ψ(ζ) if bilinear.

    A member is fitted to blocks of the data that are drawn with replacement, from a random prior of the size of the
    state's changes: members agree where the data decide, and disagree elsewhere (Osband et al., "Randomized prior
    functions for deep reinforcement learning", NeurIPS 2018).

    Attributes
    ----------
    lifting, embedding
        Those of the model.
    bilinear
        Whether φ holds products u_i ψ.
    theta
        (1 + members, p, nx); the first one is the model's.
    shift
        (p, nx) difference of the model to the least squares of the data.
    gram
        (p, p) Σ φφᵀ of the data, columns in units of `size`.
    size
        (p,) root mean square of the columns in the data, 1 where it is zero.
    prior
        Weight of the prior in rows of data: residuals over changes of the state, squared.
    change
        (nx,) root mean square of each state's change from step to step.
    residuals
        (M, nx) one-step errors of the fit on the data, in their order.
    w
        (nw,) measured disturbances during the experiment: their mean in the data.
    scale
        (nx,) largest size of each state in the data.
    rivals
        Models of other structures, of the same points: where they part from the model, its structure is in doubt.
    """

    lifting: Lifting
    embedding: Delay | None
    bilinear: bool
    theta: Float[np.ndarray, "members p nx"]
    shift: Float[np.ndarray, "..."]
    gram: Float[np.ndarray, "p p"]
    size: Float[np.ndarray, " p"]
    prior: float
    change: Float[np.ndarray, " nx"]
    residuals: Float[np.ndarray, "M nx"]
    w: Float[np.ndarray, " nw"]
    scale: Float[np.ndarray, " nx"]
    rivals: tuple["Ensemble", ...] = ()

    @property
    def members(self) -> int:
        """Number of models: the model itself, its bootstrap models, its rivals."""
        return len(self.theta) + len(self.rivals)

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.theta.shape[2]

    def regressors(self, points: Float[np.ndarray, "M n"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M p"]:
        """Return the rows φ(ζ, u), in the units of the model."""
        W = np.broadcast_to(self.w, (len(points), len(self.w)))
        return stack_regressors(self.lifting(points), U, W, bilinear=self.bilinear)

    def start(self, x0: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " n"]:
        """Return the point of a plant that has rested in x0 under u."""
        return x0 if self.embedding is None else self.embedding.repeat(x0, u)

    def step(
        self,
        points: Float[np.ndarray, "members loops n"],
        U: Float[np.ndarray, "members loops nu"],
        E: Float[np.ndarray, "members loops nx"] | float = 0.0,
    ) -> Float[np.ndarray, "members loops n"]:
        """Return the next points of each member (axis 0) in each loop (axis 1), with these one-step errors.

        Errors grow with the root of the leverage of a row, where that is above the mean of the data: the misfit of a
        model grows outside of its data about as its regressors do.
        """
        own = len(self.theta)
        if len(points) > own:
            main = self.step(points[:own], U[:own], E[:own] if isinstance(E, np.ndarray) else E)
            others = [r.step(points[[own + i]], U[[own + i]]) for i, r in enumerate(self.rivals)]
            return np.concatenate([main, *others])
        members, loops, n = points.shape
        with np.errstate(over="ignore", invalid="ignore"):
            rows = self.regressors(points.reshape(-1, n), U.reshape(members * loops, -1))
            x = rows.reshape(members, loops, -1) @ self.theta[:members]
            if isinstance(E, np.ndarray):
                x = x + self._widen(rows).reshape(members, loops, 1) * E
        x = np.fmax(np.fmin(x, _HUGE * self.scale), -_HUGE * self.scale)  # what is not a number is huge
        return x if self.embedding is None else self.embedding.shift(points, U, x)

    def simulate(
        self, starts: Float[np.ndarray, "loops n"], law: LoopLaw, steps: int, rng: np.random.Generator | None = None
    ) -> tuple[Float[np.ndarray, "T1 members loops n"], Float[np.ndarray, "T members loops nu"]]:
        """Return the points (steps + 1 rows) and inputs of loops under `law`.

        With `rng` all members run, with residuals of the data; without it the model alone, without them.
        """
        members = 1 if rng is None else self.members
        point = np.broadcast_to(starts, (members, *starts.shape)).copy()
        points, inputs = [point], list[np.ndarray]()
        errors = None if rng is None else self.draw_residuals(rng, steps, members * len(starts))
        for k in range(steps):
            u = law(k, point)
            E = 0.0 if errors is None else errors[k].reshape(members, len(starts), self.nx)
            point = self.step(point, u, E)
            points.append(point)
            inputs.append(u)
        return np.array(points), np.array(inputs)

    def _widen(self, rows: Float[np.ndarray, "M p"]) -> Float[np.ndarray, " M"]:
        """Return by how much residuals grow at these rows: the root of their leverage over its mean, at least 1."""
        leverage = np.sum(((rows / self.size) @ self._root) ** 2, axis=1)
        return np.sqrt(np.fmax(np.fmin(leverage, _FARTHEST), 1.0))

    @cached_property
    def _root(self) -> Float[np.ndarray, "p p"]:
        """L with LLᵀ = (G + Λ)⁻¹ M/p: ‖Lᵀφ‖² is 1 on the average of the data."""
        values, Q = np.linalg.eigh(self.gram + self.prior * np.eye(len(self.size)))
        rank = max(float(np.sum(values > 2 * self.prior)), 1.0)
        return Q * np.sqrt(len(self.residuals) / rank / np.maximum(values, self.prior))

    def draw_residuals(self, rng: np.random.Generator, steps: int, loops: int) -> Float[np.ndarray, "steps loops nx"]:
        """Return residuals of the data in runs of a few steps; the model's own loops come first and get them too."""
        rows = len(self.residuals)
        firsts = rng.integers(max(rows - _RUN, 0) + 1, size=(-(-steps // _RUN), loops))
        places = (firsts[:, None] + np.arange(_RUN)[:, None]).reshape(-1, loops)[:steps]
        return self.residuals[np.minimum(places, rows - 1)]

    def pick(self, member: int) -> "Ensemble":
        """Return the ensemble of one member alone."""
        if member >= len(self.theta):
            return self.rivals[member - len(self.theta)]
        return replace(self, theta=self.theta[[member]], rivals=())

    def spread(self, X: Float[np.ndarray, "T1 members loops nx"]) -> Float[np.ndarray, "T1 loops nx"]:
        """Return the root-mean-square deviation of members from the model's own loop, and of what does not matter."""
        deviation = (X[:, 1:] - X[:, :1]) ** 2
        own = deviation.shape[1] - len(self.rivals)
        least = np.zeros_like(deviation[:, :1])
        doubt = np.concatenate([least, deviation[:, own:]], axis=1).max(axis=1)
        return np.sqrt(deviation[:, :own].mean(axis=1) + doubt + (FINE * self.change) ** 2)


def stack_regressors(
    Z: Float[np.ndarray, "M nz"], U: Float[np.ndarray, "M nu"], W: Float[np.ndarray, "M nw"], *, bilinear: bool
) -> Float[np.ndarray, "M p"]:
    """Return the rows [ψ, u, w], with u_i ψ after them for a bilinear model."""
    products = [U[:, [i]] * Z for i in range(U.shape[1])] if bilinear else []
    return np.hstack([Z, U, W, *products])


def fit_ensemble(
    model: LinearPredictor | BilinearPredictor,
    data: Episodes,
    rng: np.random.Generator,
    members: int = MEMBERS,
    *,
    shift: Float[np.ndarray, "..."] | None = None,
    rivals: Sequence[Fit] = (),
) -> Ensemble:
    """Return the ensemble of a model and its data.

    Parameters
    ----------
    model, data
        A predictor, and episodes like those that it was fitted to.
    rng
        Draws blocks and priors.
    members
        Number of bootstrap models.
    shift
        Difference of the model to the least squares of all data, added to those of `data`; None: `data` are all data.
    rivals
        Fits of other structures.
    """
    episodes = [e for e in data if model.embedding is None or len(e) > model.embedding.steps]
    if not episodes:
        raise DataError("no episode is longer than the past that the model needs; pass longer logs")
    points = model.embed(data.with_episodes(episodes))
    bilinear = isinstance(model, BilinearPredictor)
    if bilinear and model.nw:
        raise DataError("an experiment knows no measured disturbances of a bilinear model; plan it with one of edmd")
    nw = model.nw
    nx, total = model.nx, sum(map(len, points))
    blocks: list[tuple[np.ndarray, np.ndarray]] = []
    length = max(total // BLOCKS, 5)
    for e in points:
        rows = stack_regressors(model.lifting(e.X[:-1]), e.U, e.W[:, :nw], bilinear=bilinear)
        cuts = range(0, len(e), length)
        blocks += [(rows[k : k + length], e.X[1 + k : 1 + k + length, :nx]) for k in cuts]
    P, T = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    X = np.concatenate([e.X[:-1, :nx] for e in points])
    size = np.sqrt(np.mean(P**2, axis=0))
    size = np.where(size > 1e-12, size, 1.0)
    own_theta = _read_theta(model)
    grams = np.array([(rows / size).T @ (rows / size) for rows, _ in blocks])
    crosses = np.array([(rows / size).T @ target for rows, target in blocks])
    change = np.sqrt(np.mean((T - X) ** 2, axis=0))
    change = np.where(change > 0, change, 1e-12)
    ridge = 1e-8 * max(len(P), 1) * np.eye(len(size))
    own = own_theta * size[:, None]
    gram = grams.sum(axis=0)
    least = own + _solve(gram + ridge, crosses.sum(axis=0) - gram @ own)
    residuals = T - (P / size) @ least
    residuals *= np.sqrt(len(P) / max(len(P) - len(size), len(P) / 4))  # what the fit itself took out
    noise = np.asarray(np.sqrt(np.mean(residuals**2, axis=0)), dtype=np.float64)
    prior = min(max(float(np.mean((noise / change) ** 2)), _PRIOR[0]), _PRIOR[1])
    centre = own if shift is None else least + shift * size[:, None] * np.ones_like(least)
    thetas = [centre]
    weights = np.vstack(
        [np.ones(len(blocks)), rng.multinomial(len(blocks), np.full(len(blocks), 1 / len(blocks)), members)]
    )
    draws = [np.zeros((len(size), nx)), *rng.standard_normal((members, len(size), nx))]
    fits = [
        _solve(
            np.tensordot(weight, grams, 1) + prior * np.eye(len(size)),
            np.tensordot(weight, crosses, 1) + prior * (least + draw * change),
        )
        for weight, draw in zip(weights, draws, strict=True)
    ]
    thetas += [centre + fit - fits[0] for fit in fits[1:]]
    w = np.concatenate([e.W[:, :nw] for e in points]).mean(axis=0)
    scale = np.maximum(np.abs(X).max(axis=0), 1e-12)
    theta = np.array(thetas) / size[:, None]
    shift = own_theta - least / size[:, None] if shift is None else shift
    return Ensemble(
        model.lifting,
        model.embedding,
        bilinear,
        theta,
        shift,
        gram,
        size,
        prior,
        change,
        residuals,
        w,
        scale,
        tuple(fit_ensemble(rival(data), data, rng, 0) for rival in rivals),
    )


def _solve(gram: Float[np.ndarray, "p p"], cross: Float[np.ndarray, "p nx"]) -> Float[np.ndarray, "p nx"]:
    return np.asarray(np.linalg.solve(gram, cross), dtype=np.float64)


def _read_theta(model: LinearPredictor | BilinearPredictor) -> Float[np.ndarray, "p nx"]:
    """Return Θ of x⁺ = Θᵀ φ, the model lifted at every step."""
    blocks = [model.C @ model.A, model.C @ model.B]
    if isinstance(model, BilinearPredictor):
        blocks += [model.C @ N for N in model.N]
    elif model.nw:
        blocks.append(model.C @ model.E)
    return np.hstack(blocks).T


def calibrate_bands(
    model: LinearPredictor | BilinearPredictor,
    data: Episodes,
    whole: Ensemble,
    steps: int,
    level: float,
    rng: np.random.Generator,
    rivals: Sequence[Fit] = (),
) -> float:
    """Return q: a whole experiment of so many steps stays within q spreads of its plan, with probability `level`.

    Ensembles of two thirds of the data forecast windows of the last third, the outermost windows together, since a
    plan may lead out of the data. A score is the largest error of a window in units of the spread. An experiment is as
    long as n windows, so that q is the quantile of level^(1/n); where the windows are too few for it, that of a
    log-normal law of the scores. It is raised by a half, since a plan is chosen for being unusual.
    """
    past = 0 if model.embedding is None else model.embedding.steps
    length = max(min(WINDOW, steps, max(len(e) for e in data) - past), 1)
    windows: list[Episode] = []
    for e in data:
        windows += [e.cut(k, k + past + length) for k in range(0, len(e) - past - length + 1, length)]
    if len(windows) < 2:
        return float(ndtri((1 + level) / 2)) * 3
    middle = np.median(np.concatenate([e.X for e in windows]), axis=0)
    extent = [float(np.max(np.abs(e.X - middle) / whole.scale)) for e in windows]
    order = np.argsort(np.argsort(extent, kind="stable")) * _FOLDS // len(windows)  # the outermost are the last part
    scores: list[np.ndarray] = []
    for fold in range(min(_FOLDS, len(windows))):
        rest = data.with_episodes([one for one, part in zip(windows, order, strict=True) if part != fold])
        judged = [one for one, part in zip(windows, order, strict=True) if part == fold]
        if not judged or not len(rest):
            continue
        judged = judged[:: -(-len(judged) // (_MOST_WINDOWS // _FOLDS))]
        ensemble = fit_ensemble(model, rest, rng, shift=whole.shift, rivals=rivals)
        points = model.embed(data.with_episodes(judged))
        U = np.array([e.U for e in points])

        def law(k: int, point: Float[np.ndarray, "members loops n"], U: np.ndarray = U) -> np.ndarray:
            return np.broadcast_to(U[:, k], (*point.shape[:2], U.shape[2]))

        X, _ = ensemble.simulate(np.array([e.X[0] for e in points]), law, length, rng)
        X = X[..., : model.nx]
        truth = np.array([e.X[1:, : model.nx] for e in points]).transpose(1, 0, 2)
        width = ensemble.spread(X)[1:]
        scores.append((np.abs(truth - X[1:, 0]) / width).max(axis=(0, 2)))
    ranked = np.sort(np.asarray(np.concatenate(scores), dtype=np.float64))
    share = level ** (1.0 / max(-(-steps // length), 1))
    rank = int(np.ceil((len(ranked) + 1) * share - 1e-9))
    if rank <= len(ranked):
        return max(UNUSUAL * float(ranked[rank - 1]), 1.0)
    logs = np.asarray(np.log(np.maximum(ranked, 1e-3)), dtype=np.float64)
    quantile = float(np.asarray(stdtrit(len(logs) - 1, share), dtype=np.float64))
    wide = float(logs.std(ddof=1)) * (1 + 1 / len(logs)) ** 0.5 * quantile
    return max(UNUSUAL * math.exp(float(logs.sum()) / len(logs) + wide), UNUSUAL * float(ranked[-1]), 1.0)
