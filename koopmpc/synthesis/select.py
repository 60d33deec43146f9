"""select: lifting, embedding, ridge and kind of model, chosen by multi-step cross-validation over episodes.

`Selection` is the model that was chosen, with the leaderboard of all that were tried.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from rich.console import RenderableType

from koopmpc import checks
from koopmpc.data.angles import count_wraps
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import FitWarning
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.lifting.base import Lifting
from koopmpc.parallel import Progress, StageProgress, map_tasks
from koopmpc.predict.base import sorted_eigen
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.candidates import (
    Candidate,
    check_delays,
    expand_candidates,
    find_constant_states,
    fit_candidate,
    propose_candidates,
)
from koopmpc.synthesis.cross_validation import (
    EXACT,
    HALF,
    LEAST,
    Trial,
    Tried,
    check_ridges,
    cross_validate,
    make_folds,
    replace_glitches,
    smooth_data,
    take_sample,
    usual_horizon,
)
from koopmpc.terminal import build_table, render_text
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.values import Value

ENOUGH = 1e-2  # error of a forecast, as a share of the states' spread, below which a controller gains nothing
RIDGES = tuple(10.0**power for power in range(-9, -2))
PLAIN = "linear: x, 1"  # z = [x, 1], the model that the others have to beat
_FASTER = 3.0  # growth over the horizon, as a multiple of the smallest model's, above which a linear model is doubted
_SHOWN = 15  # rows of the leaderboard that are printed


@dataclass(frozen=True, eq=False)
class LeaderboardRow(Value):
    """A line of the leaderboard: one candidate with its best ridge.

    Errors are root-mean-squares over the states, each relative to its standard deviation in the data: 1 is what the
    mean of the data would have. They are infinite where forecasts run away.

    Attributes
    ----------
    name
        Name of the candidate.
    bilinear
        z⁺ = A z + B u + Σ uᵢ Nᵢ z instead of z⁺ = A z + B u.
    nz
        Number of observables.
    size
        Numbers in A, B and N.
    delays
        Past steps that the model looks at.
    ridge
        Tikhonov weight as in `edmd`.
    first, middle, last
        Error 1, h/2 and h steps ahead, h the horizon; the median over the folds.
    median, worst
        Geometric mean of the errors over the horizon: median over the folds, and the worst of them.
    deviation
        Standard error of the mean over the folds.
    radius
        Spectral radius ρ(A).
    growth
        max(ρ(A), 1)ʰ, what the model's fastest mode grows by over the horizon.
    seconds
        Time of the trial, with all ridges and folds.
    lifting, embedding
        Lifting and embedding of the candidate.
    """

    name: str
    bilinear: bool
    nz: int
    size: int
    delays: int
    ridge: float
    first: float
    middle: float
    last: float
    median: float
    worst: float
    deviation: float
    radius: float
    growth: float
    seconds: float
    lifting: Lifting
    embedding: Delay | None

    @property
    def kind(self) -> str:
        """Return "linear" or "bilinear"."""
        return "bilinear" if self.bilinear else "linear"

    @property
    def title(self) -> str:
        """Kind, name and delays of the model."""
        past = f", {self.delays} delay{'s' if self.delays > 1 else ''}" if self.delays else ""
        return f"{self.kind}: {self.name}{past}"


@dataclass(frozen=True, eq=False)
class Selection(Value):
    """The model that cross-validation chose, and the leaderboard; `print` shows it.

    Attributes
    ----------
    predictor
        The chosen model, fitted to all data: a LinearPredictor or a BilinearPredictor.
    linear
        The best linear model, fitted to all data: `predictor` itself where that is linear; None where no linear one was
        tried.
    bilinear
        The best bilinear model, fitted to all data; None where no bilinear one was tried.
    leaderboard
        All candidates, the least error in its worst fold first.
    chosen, chosen_linear
        Places of the two in the leaderboard.
    horizon, folds
        Steps ahead, and parts of the data that errors were measured on.
    notes
        What was done to the data, in sentences.
    """

    predictor: AnyPredictor
    linear: LinearPredictor | None
    leaderboard: tuple[LeaderboardRow, ...]
    chosen: int
    chosen_linear: int
    horizon: int
    folds: int
    notes: tuple[str, ...]
    bilinear: BilinearPredictor | None = None

    @property
    def best(self) -> LeaderboardRow:
        """The row of `predictor`."""
        return self.leaderboard[self.chosen]

    @property
    def best_linear(self) -> LeaderboardRow:
        """The row of `linear`."""
        return self.leaderboard[self.chosen_linear]

    def __str__(self) -> str:
        """Return the choice, and the first rows of the leaderboard with those chosen and the plain linear model."""
        horizon, best, linear = self.horizon, self.best, self.best_linear
        parts: list[RenderableType] = [_sentence("chosen", best)]
        if self.chosen != self.chosen_linear:
            parts.append(_sentence("best linear", linear))
        plain = [i for i, row in enumerate(self.leaderboard) if row.title == PLAIN]
        shown = sorted({*range(min(_SHOWN, len(self.leaderboard))), self.chosen, self.chosen_linear, *plain})
        steps = [f"{n} step{'s' * (n > 1)}" for n in (1, max(horizon // 2, 1), horizon)]
        headings = ["", "model", "observ-\nables", *(f"error\n{n}" for n in steps), "worst\nfold"]
        headings += ["spectral\nradius", "ridge", "time\n[s]"]
        rows: list[list[str]] = []
        for i in shown:
            row = self.leaderboard[i]
            mark = "→" if i == self.chosen else ("l" if i == self.chosen_linear else "")
            errors = [f"{error:.2g}" for error in (row.first, row.middle, row.last, row.worst)]
            ridge = f"{row.ridge:.0e}" if row.ridge else "0"
            rows.append([mark, row.title, str(row.nz), *errors, f"{row.radius:.4g}", ridge, f"{row.seconds:.1f}"])
        legend = (
            f"Errors are root-mean-squares over the states, each relative to its standard deviation, {horizon} steps = "
            f"{horizon * self.predictor.dt:.3g} s: the median over {self.folds} folds at each number of steps ahead, "
            "and their geometric mean over the horizon in the worst fold. → marks the chosen model, the smallest one "
            "within one standard error of the best"
        )
        legend += "." if self.chosen == self.chosen_linear else "; l marks the best linear model."
        hidden = len(self.leaderboard) - len(shown)
        if hidden:
            legend += f" The leaderboard has {hidden} more models."
        parts += ["", build_table(headings, rows, left=2), "", legend]
        return "\n".join([render_text(*parts), *([""] if self.notes else []), *self.notes])


def _sentence(role: str, row: LeaderboardRow) -> str:
    return f"{role}: {row.title} ({row.nz} observables, ridge {row.ridge:g})"


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
    weights = RIDGES if ridges is None else check_ridges(ridges)
    folds = checks.count(folds, "folds", 2)
    past = check_delays(delays)
    held, notes = take_sample(source, checks.count(sample, "sample"))
    for i, count in count_wraps(held).items():
        warnings.warn(
            f"{held.states[i]} jumps by 2π {count} times: it was wrapped, and a model of it as a state cannot follow; "
            "unwrap it first, with numpy.unwrap along each episode",
            FitWarning,
            stacklevel=2,
        )
    for name in find_constant_states(held):
        warnings.warn(
            f"{name} is constant in these data, so what it does cannot be learned; excite it, or leave it out",
            FitWarning,
            stacklevel=2,
        )
    if smooth:
        source, held, replaced = replace_glitches(source, held)
        source, held, freed, _ = smooth_data(source, held)
        notes = (*notes, *replaced, *freed)
    checks.kind(bilinear, "bilinear", bool, "pass True or False")
    both = bilinear and source.nu > 0 and source.nw == 0
    given = (
        propose_candidates(held, past, both, draw)
        if candidates is None
        else expand_candidates(candidates, held, past, both)
    )
    first = max(one.delays for one in given)
    ahead, short = usual_horizon(held, first) if horizon is None else (checks.count(horizon, "horizon"), ())
    data = make_folds(held, ahead + first, folds, draw)
    trials = [Trial(one, data.episodes, data.fold, ahead, first, weights, relift=relift) for one in given]
    told = report_stage(progress, "candidates")
    results = list(map_tasks(cross_validate, trials, workers=workers, scheduler=scheduler, progress=told))
    # on a grid of decades the one nearest to ε² is the first
    floor = LEAST if ridges is not None else min(result.misfit for result in results) / np.sqrt(10)
    rows = tuple(sorted((make_row(result, floor) for result in results), key=lambda row: (row.worst, row.size)))
    alike = ENOUGH if relift else EXACT
    chosen = choose_model(rows, alike=alike)
    linear = choose_model(rows, "linear", alike) if any(row.kind == "linear" for row in rows) else chosen
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
        read = ReadOptions(workers=workers, scheduler=scheduler, progress=report_stage(progress, f"fit of {row.title}"))
        return fit_candidate(Candidate(row.name, row.lifting, row.embedding, row.bilinear), source, row.ridge, read)

    predictor = refit(rows[chosen])
    best_linear = predictor if linear == chosen else refit(rows[linear])
    best_bilinear = predictor
    if rows[chosen].kind == "linear" and any(row.bilinear for row in rows):
        best_bilinear = refit(rows[choose_model(rows, "bilinear", alike)])
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


def report_stage(progress: StageProgress | None, name: str) -> Progress | None:
    """Return what is called with the progress of one stage."""
    return None if progress is None else partial(progress, name)


def make_row(trial: Tried, floor: float) -> LeaderboardRow:
    """Return the line of the leaderboard for a trial, with the best of its ridges from `floor` on."""
    best = trial.best(floor)
    candidate, scores, error = trial.candidate, trial.scores[best], trial.errors[best]
    horizon = error.shape[1]
    nz, nu = candidate.lifting.nz, trial.inputs
    radius = float(np.abs(sorted_eigen(trial.A[best])[0][0]))
    with np.errstate(invalid="ignore", over="ignore"):
        middle = np.median(error, axis=0)
        growth = float(np.float64(max(radius, 1.0)) ** horizon)
        deviation = scores.std(ddof=1) / np.sqrt(len(scores))
    return LeaderboardRow(
        name=candidate.name,
        bilinear=candidate.bilinear,
        nz=nz,
        size=nz * (nz + nu + nu * nz * candidate.bilinear),
        delays=candidate.delays,
        ridge=trial.ridges[best],
        first=float(middle[0]),
        middle=float(middle[max(horizon // 2, 1) - 1]),
        last=float(middle[-1]),
        median=float(np.median(scores)),
        worst=float(scores.max()),
        deviation=float(deviation) if np.isfinite(deviation) else 0.0,
        radius=radius,
        growth=growth,
        seconds=trial.seconds,
        lifting=candidate.lifting,
        embedding=candidate.embedding,
    )


def choose_model(rows: tuple[LeaderboardRow, ...], kind: str | None = None, alike: float = EXACT) -> int:
    """Return the smallest model whose worst fold is within one standard error of the best one's.

    Errors below `alike` count as equal; by default these are errors of rounding and of the least ridge. Where every
    forecast ran away, it is the smallest model of all. Models with delays are taken only where they halve the error, as
    they do where some of the state is not measured: elsewhere the past tells a linear model which input the data
    would have applied next, and a controller applies others. Linear models that grow too fast are left out.
    """
    places = [i for i, row in enumerate(rows) if (kind is None or row.kind == kind) and not _runaway(row, rows)]
    present = [i for i in places if not rows[i].delays]
    if present and not min(rows[i].worst for i in places) < HALF * min(rows[i].worst for i in present):
        places = present
    best = min((rows[i] for i in places), key=lambda row: row.worst)
    near = [i for i in places if rows[i].worst <= max(best.worst + best.deviation, alike)]
    return min(near, key=lambda i: (rows[i].size, rows[i].worst))


def _runaway(row: LeaderboardRow, rows: tuple[LeaderboardRow, ...]) -> bool:
    """Return whether a linear model grows three times as much over the horizon as the smallest one, and for nothing.

    Fast growth that the data bear out at least halves the error at the end of the horizon. Elsewhere it is that of
    modes which the plant does not have. The data hardly excite them, but the moves of a controller do.
    """
    plain = min((other for other in rows if (other.kind, other.delays) == (row.kind, row.delays)), key=lambda r: r.size)
    return row.kind == "linear" and row.growth > _FASTER * plain.growth and not row.last < HALF * plain.last
