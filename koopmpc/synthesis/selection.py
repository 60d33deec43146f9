"""Selection: the model that was chosen, and how all that were tried did."""

import textwrap
from dataclasses import dataclass

import numpy as np

from koopmpc.data.delay import Delay
from koopmpc.lifting.base import Lifting
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.synthesis.cross_validation import EXACT, Tried
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.values import Value

PLAIN = "linear: x, 1"  # [x 1] as it is, the one that others have to beat
_WIDTH = 100
_SHOWN = 15  # rows of the printed table


@dataclass(frozen=True, eq=False)
class Row(Value):
    """A line of the leaderboard: one candidate with its best ridge.

    Errors are root-mean-squares over the states, each relative to its standard deviation in the data: 1 is what the
    mean of the data would have. They are infinite where forecasts run away.

    Attributes
    ----------
    name
        Of the candidate.
    bilinear
        z⁺ = A z + B u + Σ uᵢ Nᵢ z instead of z⁺ = A z + B u.
    nz
        Number of observables.
    size
        Numbers in A, B and N.
    delays
        Past steps that the model looks at.
    ridge
        Weight on unit-norm columns.
    first, middle, last
        Error 1, h/2 and h steps ahead, h the horizon; the median over the folds.
    median, worst
        Error over the whole horizon: median over the folds, and the worst of them.
    deviation
        Standard error of the mean over the folds.
    radius
        Spectral radius ρ(A).
    seconds
        Time of the trial, with all ridges and folds.
    lifting, embedding
        Of the candidate.
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
    seconds: float
    lifting: Lifting
    embedding: Delay | None

    @property
    def kind(self) -> str:
        """Return "linear" or "bilinear"."""
        return "bilinear" if self.bilinear else "linear"

    @property
    def title(self) -> str:
        """Name, with kind and delays."""
        past = f", {self.delays} delay{'s' if self.delays > 1 else ''}" if self.delays else ""
        return f"{self.kind}: {self.name}{past}"


@dataclass(frozen=True, eq=False)
class Selection(Value):
    """The model that cross-validation chose, and the leaderboard; `print` shows it.

    Attributes
    ----------
    predictor
        The chosen one, fitted to all data: a LinearPredictor or a BilinearPredictor.
    linear
        The best linear one, fitted to all data; `predictor` itself where that is linear, None where none was tried.
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
    leaderboard: tuple[Row, ...]
    chosen: int
    chosen_linear: int
    horizon: int
    folds: int
    notes: tuple[str, ...]

    @property
    def best(self) -> Row:
        """The row of `predictor`."""
        return self.leaderboard[self.chosen]

    @property
    def best_linear(self) -> Row:
        """The row of `linear`."""
        return self.leaderboard[self.chosen_linear]

    def __str__(self) -> str:
        """Return the choice, and the first rows of the leaderboard with those chosen."""
        lines = [f"chosen: {self.best.title} ({self.best.nz} observables, ridge {self.best.ridge:g})"]
        if self.chosen != self.chosen_linear:
            lines.append(
                f"best linear: {self.best_linear.title} ({self.best_linear.nz} observables, ridge "
                f"{self.best_linear.ridge:g})"
            )
        lines += ["", *self.table(), "", *self.notes]
        return "\n".join(lines).rstrip()

    def table(self, rows: int = _SHOWN) -> list[str]:
        """Return the leaderboard in lines: a head, the first `rows`, the chosen, the plain linear one, a legend."""
        dt, h = self.predictor.dt, self.horizon
        plain = [i for i, row in enumerate(self.leaderboard) if row.title == PLAIN]
        shown = sorted({*range(min(rows, len(self.leaderboard))), self.chosen, self.chosen_linear, *plain})
        wide = max(len(self.leaderboard[i].title) for i in shown)
        steps = (f"{n} step{'s' * (n > 1)}" for n in (1, max(h // 2, 1), h))
        head = "".join(f"{text:>9}" for text in (*steps, "worst", "ρ(A)", "ridge"))
        lines = [f"    {'':<{wide}}{'nz':>4}{head}{'time':>7}"]
        for i in shown:
            row = self.leaderboard[i]
            mark = "→" if i == self.chosen else ("l" if i == self.chosen_linear else " ")
            errors = "".join(f"{e:>9.2g}" for e in (row.first, row.middle, row.last, row.worst))
            lines.append(
                f"{mark:>2}  {row.title:<{wide}}{row.nz:>4}{errors}{row.radius:>9.4g}"
                f"{f'{row.ridge:.0e}' if row.ridge else '0':>9}{row.seconds:>5.1f} s"
            )
        hidden = len(self.leaderboard) - len(shown)
        more = f" {hidden} more are in the leaderboard." if hidden else ""
        legend = (
            f"Errors relative to each state's standard deviation, {h} steps = {h * dt:.3g} s: median over "
            f"{self.folds} folds, and over the whole horizon in the worst fold. →: chosen, the smallest model within "
            f"one standard error of the best{'' if self.chosen == self.chosen_linear else '; l: best linear'}.{more}"
        )
        lines += textwrap.wrap(legend, _WIDTH)
        return lines


def row_of(trial: Tried) -> Row:
    """Return the line of the leaderboard for a trial."""
    candidate, scores, error = trial.candidate, trial.scores, trial.error
    horizon = error.shape[1]
    nz, nu = candidate.lifting.nz, trial.inputs
    with np.errstate(invalid="ignore"):
        middle = np.median(error, axis=0)
        deviation = scores.std(ddof=1) / np.sqrt(len(scores))
    return Row(
        name=candidate.name,
        bilinear=candidate.bilinear,
        nz=nz,
        size=nz * (nz + nu + nu * nz * candidate.bilinear),
        delays=candidate.delays,
        ridge=trial.ridge,
        first=float(middle[0]),
        middle=float(middle[max(horizon // 2, 1) - 1]),
        last=float(middle[-1]),
        median=float(np.median(scores)),
        worst=float(scores.max()),
        deviation=float(deviation) if np.isfinite(deviation) else 0.0,
        radius=trial.radius,
        seconds=trial.seconds,
        lifting=candidate.lifting,
        embedding=candidate.embedding,
    )


def choice(rows: tuple[Row, ...], kind: str | None = None) -> int:
    """Return the smallest model whose worst fold is within one standard error of the best one's.

    Errors below 1e-10 are rounding, and all alike. Where every forecast ran away it is the smallest of all.
    """
    places = [i for i, row in enumerate(rows) if kind is None or row.kind == kind]
    best = min((rows[i] for i in places), key=lambda row: row.worst)
    near = [i for i in places if rows[i].worst <= max(best.worst + best.deviation, EXACT)]
    return min(near, key=lambda i: (rows[i].size, rows[i].worst))
