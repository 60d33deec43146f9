"""select: lifting, embedding, ridge and kind of model, chosen by multi-step cross-validation over episodes."""

import warnings
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.fits.bilinear import bilinear_edmd
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.lifting.base import Lifting
from koopmpc.parallel import StageProgress, map_tasks
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.candidates import Candidate, expanded, jumps, still, usual
from koopmpc.synthesis.cross_validation import EXACT, LEAST, Trial, ridges_of, tried
from koopmpc.synthesis.folds import folded, mended, sampled, smoothed, usual_horizon
from koopmpc.synthesis.selection import LeaderboardRow, Selection, choice, row_of
from koopmpc.validate.scoring import AnyPredictor

ENOUGH = 1e-2  # error of a forecast, as a share of the states' spread, below which a controller gains nothing
RIDGES = tuple(10.0**power for power in range(-9, -2))


def select(
    episodes: Episodes | Source,
    *,
    candidates: Sequence[Candidate | Lifting] | None = None,
    horizon: int | None = None,
    folds: int = 5,
    ridges: ArrayLike | None = None,
    delays: Sequence[int] = (0, 1, 2),
    bilinear: bool = True,
    relift: bool = True,
    smooth: bool = True,
    sample: int = 30_000,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
) -> Selection:
    """Choose the model with min over models of max over folds of the mean log error, h = 1 … horizon steps ahead.

    Each candidate is fitted to all folds but one and rolled out over that one, over the whole horizon, for a model
    with small one-step errors need not predict a horizon well. Its score is the geometric mean of its errors over the
    horizon, so that the next step counts as much as the last one, where the errors of an unstable plant are largest;
    the winner is fitted to all data. An error is relative to the state's standard
    deviation, so neither units nor where zero is count; a forecast that runs away counts as infinite, and no such
    model is taken while there is another. The models are ranked by their worst fold, and of all within one standard
    error of the best the smallest is taken (Breiman et al. 1984), one with delays only where that halves the error, and
    a linear one that grows three times as much over the horizon as the smallest one, max(ρ(A), 1)ʰ, only where that
    halves the error at the horizon's end.

    A source larger than memory is chosen on a sample of it, whole episodes from evenly spread parts; the winner is
    then fitted to all of it, part by part.

    Parameters
    ----------
    episodes
        Several episodes, for no fold cuts through one, or a Source that can be read again. Fewer than twice the folds
        are cut into blocks first, and the notes say so.
    candidates
        Liftings, each of which is tried with all `delays` and both kinds; or `Candidate`, each as it stands. By default
        linear, polynomial, trigonometric, radial and random ones, for plants of 2 to 12 states.
    horizon
        Steps ahead: pass the controller's horizon. By default 20; fewer, and a note says so, where most of the
        data are in shorter episodes.
    folds
        At least 2.
    ridges
        Weights to try, as in `edmd`; those below 1e-9 are raised to it. Linear models without delays are fitted with
        ``towards="affine"``, see `edmd`. By default 1e-9 to 1e-3 by decades, for models with delays from ε² on, ε the
        share of the states' spread that the best candidate misses in one step: what the data hold of noise, or of what
        no candidate knows. Noise ε in the regressors adds M ε² σ² = ε² ‖p − p̄‖² to the diagonal of PᵀP, which is a
        ridge ε² on deviations of unit norm. With less, a state and its past, which are almost functions of each other,
        get large weights of opposite signs, which cancel on the training data alone.
    delays
        Past steps to try in an embedding.
    bilinear
        Try z⁺ = A z + B u + Σ uᵢ Nᵢ z too, where there are inputs and no measured disturbances.
    relift
        Judge a bilinear model by forecasts that lift afresh at each step, as BilinearMPC plans, `step_map()` simulates
        and `score(relift=True)` measures; then errors below 1 % of the spread are all alike, for a controller corrects
        them at the next step, and small models go wrong less where there are few data. False: by forecasts in z, as
        `rollout` predicts and a linear model is judged, and as exactly as the data allow.
    smooth
        Replace glitches with a `Mender`, and where the states hold noise, free them of it with a `Smoother`. Least
        squares on noisy states makes an unstable plant look tame, and so do forecasts that begin at them. The notes
        tell what was found.
    sample
        Snapshot pairs to choose on, about.
    workers, scheduler
        As in `koopmpc.parallel.map_tasks`: a candidate is a task, and then a part of the source.
    progress
        Called with what is done, how many of it are, and how many there are, None where that is not known.
    rng
        Deals out the episodes, draws centres and features.

    Raises
    ------
    DataError
        Too few steps for two folds of one horizon; a stream that can be read once only; no candidate; a negative ridge.
    KoopmpcError
        A worker died on the same task each time, or no scheduler answers.

    Warns
    -----
    FitWarning
        A state jumps by 2π: it was wrapped, and no model can follow that; every candidate's forecasts run away; or the
        chosen fit itself is doubtful.

    References
    ----------
    Breiman, Friedman, Olshen & Stone, "Classification and Regression Trees", 1984, section 3.4.3.
    """
    source, draw = source_of(episodes), checks.generator(rng)
    weights = RIDGES if ridges is None else ridges_of(ridges)
    folds = checks.count(folds, "folds", 2)
    checks.kind(delays, "delays", (Sequence, np.ndarray), "pass the numbers of past steps in a list")
    past = sorted({checks.count(d, "delays", 0) for d in delays})
    if not past:
        raise DataError("delays is empty; pass 0 for a model without an embedding")
    held, notes = sampled(source, checks.count(sample, "sample"))
    for i, count in jumps(held).items():
        warnings.warn(
            f"{held.states[i]} jumps by 2π {count} times: it was wrapped, and a model of it as a state cannot follow; "
            "unwrap it first, with numpy.unwrap along each episode",
            FitWarning,
            stacklevel=2,
        )
    for name in still(held):
        warnings.warn(
            f"{name} is constant in these data, so what it does cannot be learned; excite it, or leave it out",
            FitWarning,
            stacklevel=2,
        )
    if smooth:
        source, held, replaced = mended(source, held)
        (source, held, freed), _ = smoothed(source, held)
        notes = (*notes, *replaced, *freed)
    checks.kind(bilinear, "bilinear", bool, "pass True or False")
    both = bilinear and source.nu > 0 and source.nw == 0
    given = usual(held, past, both, draw) if candidates is None else expanded(candidates, held, past, both)
    first = max(one.delays for one in given)
    ahead, short = usual_horizon(held, first) if horizon is None else (checks.count(horizon, "horizon"), ())
    data = folded(held, ahead + first, folds, draw)
    trials = [Trial(one, data.episodes, data.fold, ahead, first, weights, relift=relift) for one in given]
    told = None if progress is None else partial(progress, "candidates")
    results = list(map_tasks(tried, trials, workers=workers, scheduler=scheduler, progress=told))
    # on a grid of decades the one nearest to ε² is the first
    floor = LEAST if ridges is not None else min(result.misfit for result in results) / np.sqrt(10)
    rows = tuple(sorted((row_of(result, floor) for result in results), key=lambda row: (row.worst, row.size)))
    alike = ENOUGH if relift else EXACT
    chosen = choice(rows, alike=alike)
    linear = choice(rows, "linear", alike) if any(row.kind == "linear" for row in rows) else chosen
    for place, which in ((chosen, f"all {len(rows)} candidates"), (linear, "all linear candidates")):
        if not np.isfinite(rows[place].worst):
            warnings.warn(
                f"the forecasts of {which} run away within {ahead} steps, and the smallest is taken: trust no "
                "controller of it; pass a shorter horizon, or candidates that know the plant",
                FitWarning,
                stacklevel=2,
            )
            break

    def refit(row: LeaderboardRow) -> AnyPredictor:
        told = None if progress is None else partial(progress, f"fit of {row.title}")
        read = ReadOptions(workers=workers, scheduler=scheduler, progress=told)
        psi, embedding, ridge = row.lifting, row.embedding, row.ridge
        if row.kind == "linear":
            towards = "affine" if embedding is None else "zero"
            return edmd(source, psi, embedding=embedding, ridge=ridge, towards=towards, **read)
        return bilinear_edmd(source, psi, embedding=embedding, ridge=ridge, difference=True, **read)

    predictor = refit(rows[chosen])
    best_linear = predictor if linear == chosen else refit(rows[linear])
    best_bilinear = predictor
    if rows[chosen].kind == "linear" and any(row.bilinear for row in rows):
        best_bilinear = refit(rows[choice(rows, "bilinear", alike)])
    return Selection(
        predictor=predictor,
        linear=best_linear if isinstance(best_linear, LinearPredictor) else None,
        leaderboard=rows,
        chosen=chosen,
        chosen_linear=linear,
        horizon=ahead,
        folds=data.number,
        notes=(*notes, *short, *data.notes),
        bilinear=best_bilinear if isinstance(best_bilinear, BilinearPredictor) else None,
    )
