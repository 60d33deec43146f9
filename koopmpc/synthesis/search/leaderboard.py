"""The leaderboard of `select`: a row a candidate, the choice among them, and the Selection that holds both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.console import RenderableType

from koopmpc.base.terminal import build_leaderboard, render_text
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.lifting.base import Lifting
from koopmpc.models.base import sorted_eigen
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.models.records.structure import Structure
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.cross_validation import EXACT, HALF, Tried
from koopmpc.validate.scoring import AnyPredictor

PLAIN = "linear: x, 1"  # z = [x, 1], the model that the others have to beat
_WORTH = 0.01  # share of a linear model's error that a bilinear one may reach to be taken in its place
_FASTER = 3.0  # growth over the horizon, as a multiple of the smallest model's, above which a linear model is doubted


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
    lifting, embedding, structure, relifted
        Those of the candidate.
    free
        Error on unseen stretches of a record, in free run and in short forecasts; NaN where none was made.
    rough
        Fitted to the rows as they were measured, where smoothed ones did not forecast unseen rows better.
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
    structure: Structure | HiddenStructure | None = None
    relifted: bool = False
    free: float = np.nan
    rough: bool = False

    @property
    def kind(self) -> str:
        """Return "linear" or "bilinear"."""
        return "bilinear" if self.bilinear else "linear"

    @property
    def candidate(self) -> Candidate:
        """The candidate."""
        fitted = self.bilinear and not self.relifted
        return Candidate(self.name, self.lifting, self.embedding, fitted, self.structure, self.relifted)

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
    refined
        Steps of the forecasts that the chosen model was refined on; 0 if one-step least squares stood.
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
    refined: int = 0

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
        ran = [row for row in self.leaderboard if not np.isnan(row.free)]
        steps = [f"{n} step{'s' * (n > 1)}" for n in (1, max(horizon // 2, 1), horizon)]
        headings = ["model", "observ-\nables", *(f"error\n{n}" for n in steps), "worst\nfold"]
        headings += [*["free\nrun"] * bool(ran), "spectral\nradius", "ridge", "time\n[s]"]
        # rows of one lifting with the same figures, of another name or ridge, are printed as one
        keys = [(row.nz, _list_figures(row), replace(row.candidate, name="")) for row in self.leaderboard]
        kept, leads = group_twins(keys, self.chosen, self.chosen_linear)
        rows: list[list[str]] = []
        extra: list[int] = []
        for place, i in enumerate(kept):
            row, twins = self.leaderboard[i], leads.count(place) - 1
            *errors, radius = _list_figures(row)
            title = row.title + f"; {twins} more alike" * bool(twins)
            ridge = f"{row.ridge:.0e}" if row.ridge else "0"
            rows.append([title, str(row.nz), *(errors if ran else errors[:-1]), radius, ridge, f"{row.seconds:.1f}"])
            if row.title == PLAIN or not np.isnan(row.free):
                extra.append(place)
        legend = (
            f"Errors are root-mean-squares over the states, each relative to its standard deviation, {horizon} steps = "
            f"{horizon * self.predictor.dt:.3g} s: the median over {self.folds} folds at each number of steps ahead, "
            "and their geometric mean over the horizon in the worst fold. → marks the chosen model, the smallest one "
            "within one standard error of the best"
        )
        if ran:
            legend += (
                " in the column of free runs: these are over stretches that no fit saw, from the record's first rows "
                "and the inputs alone, and count as much as short forecasts; inf leaves three times the data's range"
            )
        legend += "." if self.chosen == self.chosen_linear else "; l marks the best linear model."
        table, hidden = build_leaderboard(headings, rows, leads[self.chosen], leads[self.chosen_linear], extra)
        if hidden:
            legend += f" The leaderboard has {hidden} more models."
        parts += ["", table, "", legend]
        return "\n".join([render_text(*parts), *([""] if self.notes else []), *self.notes])


def _list_figures(row: LeaderboardRow) -> list[str]:
    """Return the errors and the spectral radius as printed; nothing for a free run that was not made."""
    errors = [f"{error:.2g}" for error in (row.first, row.middle, row.last, row.worst)]
    return [*errors, "" if np.isnan(row.free) else f"{row.free:.2g}", f"{row.radius:.4g}"]


def group_twins(keys: Sequence[object], chosen: int, second: int | None = None) -> tuple[list[int], list[int]]:
    """Return a row for each key, `chosen` and `second` before others, and for each row the place of its key."""
    kept: list[int] = []
    leads: list[int] = []
    for i, key in enumerate(keys):
        twin = next((place for place, k in enumerate(kept) if keys[k] == key), len(kept))
        if twin == len(kept):
            kept.append(i)
        elif i == chosen or (i == second and kept[twin] != chosen):
            kept[twin] = i
        leads.append(twin)
    return kept, leads


def _sentence(role: str, row: LeaderboardRow) -> str:
    return f"{role}: {row.title} ({row.nz} observables, ridge {row.ridge:g})"


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
        structure=candidate.structure,
    )


def choose_model(
    rows: tuple[LeaderboardRow, ...],
    kind: str | None = None,
    alike: float = EXACT,
    among: Sequence[int] | None = None,
    hidden: bool = False,
) -> int:
    """Return the smallest model whose worst fold is within one standard error of the best one's.

    Errors below `alike` count as equal; by default these are errors of rounding and of the least ridge. Where every
    forecast ran away, it is the smallest model of all. Models with delays are taken only where they halve the error, as
    they do where some of the state is not measured: elsewhere the past tells a linear model which input the data
    would have applied next, and a controller applies others. Linear models that grow too fast are left out. In place
    of a linear model whose errors count as equal, a bilinear one is taken if its own are at most a hundredth of them.
    `among` holds the places to choose from; by default all. Where the data show a hidden state, `hidden`, models with
    delays need not halve the error.
    """
    same = [i for i in (range(len(rows)) if among is None else among) if kind in (None, rows[i].kind)]
    places = [i for i in same if not _runaway(rows[i], rows)] or same
    best = min((rows[i] for i in places), key=lambda row: row.worst)
    present = [i for i in places if not rows[i].delays]
    if present and not hidden and not best.worst < HALF * min(rows[i].worst for i in present):
        places = present
        best = min((rows[i] for i in places), key=lambda row: row.worst)
    near = [i for i in places if rows[i].worst <= max(best.worst + best.deviation, alike)]
    chosen = min(near, key=lambda i: (rows[i].size, rows[i].worst))
    exact = [
        i for i in places if rows[i].kind == "bilinear" and max(rows[i].worst, EXACT) <= _WORTH * rows[chosen].worst
    ]
    if rows[chosen].kind == "linear" and exact:
        return choose_model(rows, "bilinear", EXACT, exact, hidden)
    return chosen


def _runaway(row: LeaderboardRow, rows: tuple[LeaderboardRow, ...]) -> bool:
    """Return whether a linear model grows three times as much over the horizon as the smallest one, and for nothing.

    Fast growth that the data bear out at least halves the error at the end of the horizon. Elsewhere it is that of
    modes which the plant does not have. The data hardly excite them, but the moves of a controller do.
    """
    alike = [other for other in rows if (other.kind, other.delays) == (row.kind, row.delays)]
    plain = min((other for other in alike if other.structure is None), key=lambda r: r.size, default=row)
    return row.kind == "linear" and row.growth > _FASTER * plain.growth and not row.last < HALF * plain.last
