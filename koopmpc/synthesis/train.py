"""train: centres, widths and frequencies of a lifting, by variable projection on the error over a horizon."""

from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from koopmpc.base import checks
from koopmpc.base.errors import DataError, hide_fit_warnings
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting, check_lifting
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.variable_projection import TunableLifting, VariableProjection, Windows
from koopmpc.validate.scoring import score

_GAIN = 0.01  # share by which the held-out error must fall; less is chance
_PATIENCE = 50  # iterations without a better held-out error after which training stops
_FAR = 3.0  # logarithm of the largest factor by which a width may change
_EXACT = 1e-6  # relative error below which there is nothing to gain
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
    iterations: int = 300,
    rng: np.random.Generator | int = 0,
) -> LinearPredictor:
    """Fit ψ(x⁺; p) = A ψ(x; p) + B u with the numbers p of ψ trained: centres, widths, frequencies.

    p minimises the errors of forecasts of x_{k+h}, h = 1 … horizon, from x_k and u_k … u_{k+h−1}, relative to the size
    of each state as in `km.score`. For each p, A and B are those of `edmd`, so L-BFGS searches for p alone (variable
    projection). CasADi differentiates ψ; the gradient is that of the least squares and of the whole horizon. The
    iterate with the smallest error on the held-out data is taken. If it is not better there by 1 %, or if the error of
    the given lifting is below 1e-6, the lifting is not changed. On the held-out data the result is therefore never
    worse than ``edmd(episodes, lifting, ridge=ridge)``.

    Parameters
    ----------
    lifting
        ψ. The numbers of each `Gaussian`, `ThinPlate` and `RandomFourier` in it are trained.
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
        Largest number of pieces of `horizon` steps, drawn at random; memory and time grow with it.
    iterations
        Largest number of iterations.
    rng
        Draws the pieces.

    Returns
    -------
    predictor
        The fit of `edmd` on the trained lifting, ``predictor.lifting``, which every other fit accepts. The errors
        before and after are in ``predictor.report.changes``.

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
    source, generator = source_of(episodes), checks.generator(rng)
    if not source.replayable:
        raise DataError("a stream is read once, and train needs it more often; save it, and pass that")
    if embedding is not None:
        checks.kind(embedding, "embedding", Delay, "pass km.Delay(steps)")
    sized = None if embedding is None else embedding.match(source.states, source.inputs)
    given = check_lifting(lifting).bind(source.states if sized is None else sized.names)
    pieces = _draw_pieces(source, N + (0 if sized is None else sized.steps), most, generator)
    if isinstance(held_out, Episodes):
        fitted, judge, other = (
            pieces.all,
            held_out,
            _draw_pieces(source_of(held_out), pieces.length, most, generator).all,
        )
        data: Episodes | Source = episodes
    else:
        share = checks.positive(held_out, "held_out")
        if share >= 1:
            raise DataError(f"held_out is {share:g}; pass a share below 1, or episodes")
        fitted, other = pieces.split(share, generator)
        data, judge = fitted, other
    tuning = TunableLifting(given)
    own, test = (Windows.of(e if sized is None else sized(e), N, source.nx) for e in (fitted, other))
    p, taken = _search(VariableProjection(tuning, own, weight), test, iterations)
    chosen = tuning.at(p)
    before, after = (_hold_out(data, one, judge, N, embedding, weight) for one in (given, chosen))
    better = before > _EXACT and after <= (1 - _GAIN) * before
    model = edmd(episodes, chosen if better else given, embedding=embedding, ridge=weight)
    fell = f"fell from {before:.3g} to {after:.3g}" if better else "did not fall, and the lifting is as it was"
    said = f"{tuning.n} numbers trained on {N}-step errors, {taken} iterations: on held-out data the errors {fell}"
    report = model.report
    assert report is not None
    return replace(model, report=replace(report, method="train", changes=(*report.changes, said)))


def _hold_out(
    data: Episodes | Source, lifting: Lifting, judge: Episodes, horizon: int, embedding: Delay | None, ridge: float
) -> float:
    """Return the relative error over the horizon, on other episodes, of the fit to these data."""
    with hide_fit_warnings():  # that of the result is the one to read
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
            raise DataError(
                "the data are too short to hold a part of them out; pass held_out=Episodes(…), or collect more"
            )
        first, last = (
            self.all.with_episodes([e for e, one in zip(self.all, which, strict=True) if one]) for which in (kept, side)
        )
        return first, last


def _draw_pieces(source: Source, length: int, count: int, rng: np.random.Generator) -> _Pieces:
    """Return `count` pieces of `length` steps, any as likely as any other, in the order of the data."""
    kept: list[tuple[float, tuple[int, int], Episode]] = []
    number = 0
    empty: Episodes | None = None
    for part in source.parts():
        for episode in (loaded := part.load()):
            keys = rng.random(max(len(episode) - length + 1, 0))
            for k in np.argsort(keys)[:count].tolist():
                rows = slice(k, k + length)
                X, U, W = (a.copy() for a in (episode.X[k : k + length + 1], episode.U[rows], episode.W[rows]))
                piece = Episode(X=X, U=U, W=W)  # copies, which do not hold the whole episode
                kept.append((float(keys[k]), (number, k), piece))
            kept = sorted(kept, key=lambda one: one[0])[:count]
            number += 1
        empty = loaded
    if not kept or empty is None:
        raise DataError(
            f"no episode has the {length} steps that the horizon asks for; pass a shorter one, or longer data"
        )
    kept.sort(key=lambda one: one[1])
    return _Pieces(empty.with_episodes([piece for *_, piece in kept]), length, [place for _, place, _ in kept])


def _search(objective: VariableProjection, test: Windows, iterations: int) -> tuple[Float[np.ndarray, " n"], int]:
    """Return the iterate of L-BFGS with the least error on the test windows, and how many iterations there were."""
    tuning = objective.tuning
    best, least, taken, at = np.zeros(tuning.n), objective.evaluate_on(np.zeros(tuning.n), test), 0, 0

    def record_iterate(intermediate_result: Any) -> None:
        nonlocal best, least, taken, at
        taken += 1
        p = np.array(intermediate_result.x)
        error = objective.evaluate_on(p, test)
        if error < least:
            best, least, at = p, error, taken
        elif taken - at >= _PATIENCE:
            raise StopIteration

    ends = [(-_FAR, _FAR) if one else (-np.inf, np.inf) for one in tuning.positive]
    options = {"maxiter": iterations, "maxcor": 20}
    cast("Any", minimize)(
        objective,
        np.zeros(tuning.n),
        jac=True,
        method="L-BFGS-B",
        bounds=ends,
        callback=record_iterate,
        options=options,
    )
    return best, taken
