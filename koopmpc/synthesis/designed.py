"""Design: the controller chosen by closed loop, what to expect of it, the leaderboard, and the file that keeps it."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import RenderableType

from koopmpc import checks
from koopmpc.control.kinds import build_controller
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from koopmpc.control.program import SavedController
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError, KoopmpcError, LogError
from koopmpc.predict.base import load_value, save_value
from koopmpc.supervise.guarded import Guarded
from koopmpc.synthesis.asked import DesignTask
from koopmpc.synthesis.candidates import Designed, Recipe
from koopmpc.synthesis.fresh.neighbours import NeighbourMap, choose_starts_to_record
from koopmpc.synthesis.fresh.promise import CoveragePromise
from koopmpc.synthesis.fresh.verdict import FreshLoops, bound_value, cost_interval
from koopmpc.synthesis.judging import UNSURE, is_alike
from koopmpc.synthesis.surrogates import Surrogate
from koopmpc.terminal import build_leaderboard, label_lines, render_text
from koopmpc.text import format_duration, to_percent
from koopmpc.validate.binomial import bound_failure_rate
from koopmpc.validate.logs.summary import LogSummary
from koopmpc.values import Value

BREAKS = 0.01  # a larger violation, as a share of the range, is less safe
WORTH = 0.02  # a controller with an estimator may cost this share more
WORTH_UNSTABLE = 0.05  # on an unstable plant one without an estimator may cost this share more
AnyMPC = KoopmanMPC | BilinearMPC | NonlinearMPC


@dataclass(frozen=True, eq=False)
class DesignRow(Value):
    """A line of the leaderboard: one recipe.

    Attributes
    ----------
    recipe
        Model and controller.
    score
        Mean over its runs of cost × (1 + 10 max(0, violation − 0.5 %)), over the best on the same surrogate and start.
    worst
        The largest of these ratios; 20 is a lost run.
    violation
        Largest violation of a limit in any run that was not lost, as a share of its range.
    lost
        Number of lost runs: they left the data by more than half of its range, or became NaN or infinite.
    runs
        Number of runs.
    off
        True if runs with inputs 20 % off are among them. Only scores of rows with equal `off` can be compared.
    error
        Standard error of the score's difference to the best of the rows with equal `off`, as a share of the score.
    """

    recipe: Recipe
    score: float
    worst: float
    violation: float
    lost: int
    runs: int
    off: bool
    error: float = 0.0

    @property
    def title(self) -> str:
        """The recipe in words."""
        return str(self.recipe)


@dataclass(frozen=True, eq=False)
class ExpectedLoop(Value):
    """Expected closed loop of a design, from runs on surrogates that were fitted to data unknown to its model.

    The runs of `cost` and `cost_off` took part in the choice; those of `fresh` came after it, and the interval and the
    bounds are theirs. It is an estimate from data alone and no guarantee: no surrogate shows an error that all models
    share.

    Attributes
    ----------
    cost
        (runs,) cost of each run in which the inputs act as in the data; infinite where it was lost.
    cost_off
        (runs,) the same with inputs that act 20 % more or less.
    violation, violation_off
        (runs,) largest violation of a limit, as a share of its range.
    broken
        Share of all steps that violate a limit by more than 0.1 % of its range.
    starts
        (runs, nx) where the runs of `cost` began.
    surrogate
        (runs,) the surrogate of each run.
    steps
        Length of a run.
    fresh
        Loops after the choice; None where there are none.
    compared
        Number of loops of all finalists, in which the choice was confirmed or changed.
    """

    cost: Float[np.ndarray, " runs"]
    cost_off: Float[np.ndarray, " off"]
    violation: Float[np.ndarray, " runs"]
    violation_off: Float[np.ndarray, " off"]
    broken: float
    starts: Float[np.ndarray, "runs nx"]
    surrogate: tuple[int, ...]
    steps: int
    fresh: FreshLoops | None = None
    compared: int = 0

    @property
    def cost_interval(self) -> tuple[float, float]:
        """The interval that holds 90 % of the costs of loops like the fresh ones, lost ones infinite."""
        return cost_interval(self._judged_runs(self.cost, self.cost_off, "cost"))

    @property
    def violation_bound(self) -> float:
        """What the largest violation of a loop like the fresh ones exceeds in at most 5 % of them."""
        return bound_value(self._judged_runs(self.violation, self.violation_off, "violation"))

    @property
    def lost_bound(self) -> float:
        """Exact upper bound, at 95 %, of the probability that a loop like the fresh ones is lost."""
        cost = self._judged_runs(self.cost, self.cost_off, "cost")
        return bound_failure_rate(int(np.sum(~np.isfinite(cost))), len(cost))

    @property
    def loops(self) -> dict[str, int]:
        """Number of loops of each kind: those of the choice, and the fresh ones by what stood in for the plant."""
        chosen = {"choice": len(self.cost), "choice, inputs 20 % off": len(self.cost_off)}
        chosen |= {"finalists": self.compared} if self.compared else {}
        return chosen if self.fresh is None else chosen | self.fresh.counts

    def _judged_runs(
        self, near: Float[np.ndarray, " n"], off: Float[np.ndarray, " m"], name: str
    ) -> Float[np.ndarray, " loops"]:
        return np.concatenate([near, off]) if self.fresh is None else getattr(self.fresh, name)

    @property
    def lost(self) -> int:
        """How many of all runs were lost."""
        return int(np.sum(~np.isfinite(np.concatenate([self.cost, self.cost_off]))))

    def __str__(self) -> str:
        """Return what to expect in words."""
        pairs = [
            ("cost", _format_spread(self.cost)),
            ("with inputs 20 % off", _format_spread(self.cost_off)),
            (
                "largest violation",
                f"{_format_worst(self.violation)}; with inputs 20 % off {_format_worst(self.violation_off)}",
            ),
            ("steps that violate", f"{to_percent(self.broken)}, an estimate from held-out surrogates and no promise"),
            ("lost runs", f"{self.lost} of {len(self.cost) + len(self.cost_off)}"),
        ]
        if self.fresh is not None:
            low, high = self.cost_interval
            number, lost = len(self.fresh.cost), int(np.sum(~np.isfinite(self.fresh.cost)))
            corners = self.fresh.corner_cost
            kinds = ", ".join(f"{count} {_PLACES.get(kind, kind)}" for kind, count in self.loops.items())
            pairs += [
                ("fresh loops", f"{lost} of {number} lost: below {to_percent(self.lost_bound)} at 95 %"),
                ("cost in 90 %", f"{low:.4g} to {high:.4g}"),
                ("violation in 95 %", f"up to {to_percent(self.violation_bound)} of the range"),
                ("outside the data", f"{to_percent(float(self.fresh.outside.mean()))} of the steps"),
                ("corners", f"{int(np.sum(~np.isfinite(corners)))} of {len(corners)} lost"),
                ("loops", kinds),
            ]
        return render_text(label_lines(pairs))


@dataclass(frozen=True, eq=False)
class Evidence(Value):
    """The evidence of a design: the task, the surrogates, and the expected closed loop.

    Attributes
    ----------
    asked
        Cost, limits, reference and starts.
    surrogates
        Learned stand-ins of the plant.
    low, high
        (nx,) the box of the states; a run that leaves it is lost.
    expected
        What to expect of the chosen controller.
    goal_can_be_held
        True if the reference is constant and an input inside the limits holds it.
    neighbours
        Stand-in by the nearest rows of the data; None in a design without fresh loops.
    logs
        Some of the data, not smoothed, with which new logs are compared; their inputs stand where the model has them.
        None in files of earlier designs.
    promise
        The promised share of loops that keep their limits; None if no `coverage` was asked for.
    """

    asked: DesignTask
    surrogates: tuple[Surrogate, ...]
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    expected: ExpectedLoop
    goal_can_be_held: bool
    neighbours: NeighbourMap | None = None
    logs: Episodes | None = None
    promise: CoveragePromise | None = None


@dataclass(frozen=True, eq=False)
class SavedDesign(Value):
    """A designed controller in a file, with the evidence on which it can be checked.

    Attributes
    ----------
    controller, evidence
        What the controller is made of, and what speaks for it.
    logs
        What a report shows of its logs; None where it was designed from episodes in memory.
    """

    controller: SavedController
    evidence: Evidence
    logs: LogSummary | None = None


@dataclass(frozen=True, eq=False)
class Design:
    """A controller that was chosen by closed loop from data alone; `print` shows it with its evidence.

    Attributes
    ----------
    controller
        KoopmanMPC or BilinearMPC, fitted to all data.
    linear
        The best KoopmanMPC, which may be `controller` itself; None if no KoopmanMPC was confirmed.
    leaderboard
        All recipes: first those that were judged in all conditions, the best first, then those of the first round.
    chosen, chosen_linear
        Places of the two in the leaderboard.
    evidence
        The task, the surrogates, and what to expect of `controller`.
    standby
        A plain linear MPC of the states alone, fitted to the same data, for `guarded`; None if there is none.
    advice
        What limits the closed loop, and which data would help, in sentences.
    notes
        What was done to the data, in sentences.
    """

    controller: Designed
    linear: KoopmanMPC | None
    leaderboard: tuple[DesignRow, ...]
    chosen: int
    chosen_linear: int | None
    evidence: Evidence
    advice: tuple[str, ...]
    notes: tuple[str, ...]
    standby: KoopmanMPC | None = None

    def guarded(self, patience: int = 1) -> Guarded:
        """Return a new `km.supervise.Guarded`: `controller`, and the plain linear `standby` outside the data.

        A lifted model that has left its data may have the wrong sign there; a linear one goes on straight. Measured on
        two vessels that no log had so far apart, see docs/closed_loop.md. A misfit inside the data hands nothing over.

        Parameters
        ----------
        patience
            Unknown steps in sequence after which the standby takes over.

        Raises
        ------
        DataError
            The design has no standby, or too few rows for a monitor.
        """
        if self.standby is None or self.controller.watch is None:
            raise DataError(
                "the design has no standby: its candidates hold no model of the states alone, or the data have fewer "
                "than 100 rows for a monitor; pass such a candidate, or more data"
            )
        main = build_controller(self.controller.as_data())
        return Guarded(main, build_controller(self.standby.as_data()), patience=patience, region=True)

    def starts_to_record(self, count: int = 8) -> Float[np.ndarray, "n nx"]:
        """Return states of the goal's range that have no data around them: episodes from there make it known.

        Each is the farthest from the data and from those before it; none, (0, nx), where the range is known.
        `km.plot.blindness` draws them.

        Raises
        ------
        DataError
            The design has no nearest rows; `count` is below 1.
        """
        if self.evidence.neighbours is None:
            raise DataError("the design keeps no rows of its data; make it again with this version")
        return choose_starts_to_record(self.evidence.asked, self.evidence.neighbours, checks.count(count, "count"))

    @property
    def best(self) -> DesignRow:
        """The row of `controller`."""
        return self.leaderboard[self.chosen]

    @property
    def expected(self) -> ExpectedLoop:
        """What to expect of `controller`: an estimate, and no promise."""
        return self.evidence.expected

    @property
    def promise(self) -> CoveragePromise | None:
        """The promised share of loops that keep their limits; None if no `coverage` was asked for."""
        return self.evidence.promise

    def save(self, path: str | Path, *, logs: LogSummary | None = None) -> None:
        """Write the controller and its evidence as data; `km.load_controller` and ``koopmpc check`` read it.

        Parameters
        ----------
        path
            The file to write.
        logs
            What a report shows of the logs, as ``koopmpc fit --goal`` makes it.

        Raises
        ------
        LogError
            The path cannot be written.
        """
        save_value(SavedDesign(self.controller.as_data(), self.evidence, logs), path)

    def _find_twins(self) -> tuple[list[int], list[int]]:
        """Return the rows to print, and for each row its place among them.

        Rows with the same figures that differ only in the ridge or in the end of the horizon are printed as one.
        """
        kept: list[int] = []
        leads: list[int] = []
        known: dict[tuple[str, ...], int] = {}
        for i, row in enumerate(self.leaderboard):
            key = (str(replace(row.recipe, tail=None)), *_list_figures(row))
            if key not in known:
                known[key] = len(kept)
                kept.append(i)
            elif i == self.chosen:
                kept[known[key]] = i
            leads.append(known[key])
        return kept, leads

    def __str__(self) -> str:
        """Return the choice, what to expect of it, advice, and the first rows of the leaderboard."""
        parts: list[RenderableType] = [f"chosen: {self.best.title}"]
        place = self.chosen_linear
        if place is not None and place != self.chosen:
            parts.append(f"best linear: {self.leaderboard[place].title}")
        steps = self.expected.steps
        parts += [
            "",
            f"expected over {steps} steps ({format_duration(steps * self.controller.dt)})",
            str(self.expected),
            "",
            f"A cost is the sum over a run of {steps} steps; koopmpc check sums over as many, from other starts. Of a "
            f"run of your own, compare the first {steps} steps: km.metrics(run.take_first({steps})).cost.",
            "",
        ]
        rows: list[list[str]] = []
        titles = Counter(row.title for row in self.leaderboard)
        kept, leads = self._find_twins()
        for i in kept:
            row, twins = self.leaderboard[i], [k for k, lead in enumerate(leads) if lead == len(rows) and k != i]
            title = (
                row.title
                if titles[row.title] == 1
                else f"{row.title} (ridge {row.recipe.ridge:.0e})".replace("0e+00", "0")
            )
            rows.append([title + f"; {len(twins)} more alike" * bool(twins), *_list_figures(row)])
        headings = ["controller", "score", "worst\nrun", "viol-\nation", "lost\nruns"]
        parts.append(build_leaderboard(headings, rows, leads[self.chosen], None if place is None else leads[place])[0])
        parts += [
            "",
            "A score is the mean over closed loops on surrogates of the cost, with a price on violations, relative to "
            "the best controller in the same loop. → marks the chosen controller, l the best linear one. Of rows "
            "within 0.5 % of the best, or within their standard error up to 3 %, whose worst run is at most 3 % worse, "
            "the safest and then the simplest is chosen. One with an estimator may cost 2 % more. Then up to three "
            "finalists, other models within 3 %, run the same fresh loops, and one that is safer or 2 % cheaper there "
            "takes its place; the notes say so. Rows without inputs 20 % off are of the first round and stand last.",
        ]
        said = [render_text(*parts)]
        if self.promise is not None:
            said += ["", render_text(str(self.promise))]
        if self.advice:
            said += ["", render_text(*(f"- {sentence}" for sentence in self.advice))]
        if self.notes:
            said += ["", *self.notes]
        return "\n".join(said)


def _list_figures(row: DesignRow) -> list[str]:
    return [f"{row.score:.3f}", f"{row.worst:.3f}", to_percent(row.violation), f"{row.lost} of {row.runs}"]


_PLACES = {  # a kind of loops in `ExpectedLoop.loops`, as it is printed
    "choice": "in the choice",
    "choice, inputs 20 % off": "there with inputs 20 % off",
    "finalists": "of all finalists",
    "models": "fresh on learned models",
    "neighbours": "fresh on nearest rows of the logs",
    "corners": "from corners of the goal's range",
}


def _format_spread(values: Float[np.ndarray, " runs"]) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "every run was lost"
    return f"median {np.median(known):.4g}, from {known.min():.4g} to {known.max():.4g} over surrogates and starts"


def _format_worst(values: Float[np.ndarray, " runs"]) -> str:
    known = values[np.isfinite(values)]
    return f"{to_percent(known.max())} of the range" if known.size else "unknown"


def choose_row(rows: Sequence[DesignRow], kind: str | None = None, *, unstable: bool = False) -> int | None:
    """Return the place of the safest, then simplest row that is as good as the best, of those judged in all conditions.

    A row is as good as the best if its score is within 0.5 % of it, or within the standard error of their difference
    where that is larger, at most 3 %. Its worst run may be at most 3 % worse: where a plant differs from its logs, one
    run shows it before the mean does. Safer is a row with fewer lost runs, then one without a violation above 1 %.
    Simpler is a row without weights, then one with a smaller model; a bilinear model counts twice its observables.
    A controller with an estimator may cost 2 % more than without one, since it corrects errors that surrogates and
    models share. So may an estimator that finds its gain, over one with a small fixed gain, which corrects them late.
    On a plant that is `unstable` where it is used, one without an estimator may cost 5 % more, for an estimator takes
    the model's error in a transient for a load.
    """
    places = [i for i, row in enumerate(rows) if row.off and kind in (None, row.recipe.candidate.kind)]
    if not places:
        return None
    best = min((rows[i] for i in places), key=lambda row: (row.score, row.worst))
    near = [i for i in places if is_alike(rows[i].score, best.score, rows[i].error)]
    near = [i for i in near if rows[i].worst <= best.worst * (1 + UNSURE)]

    def rank(i: int) -> tuple[object, ...]:
        row, one = rows[i], rows[i].recipe
        safe = row.lost, row.violation > BREAKS
        return *safe, one.weighted, one.candidate.size, one.candidate.delays, one.estimator is None, row.score, i

    def without_estimator(i: int) -> Recipe:
        return replace(rows[i].recipe, estimator=None)

    place = min(near, key=rank)
    same = [i for i in places if without_estimator(i) == without_estimator(place)]
    if unstable:
        plain = [i for i in same if rows[i].recipe.estimator is None and rows[i].lost <= rows[place].lost]
        return next((i for i in plain if rows[i].score <= (1 + WORTH_UNSTABLE) * rows[place].score), place)
    if rows[place].recipe.estimator is None:
        estimating = [
            i for i in same if rows[i].recipe.estimator is not None and rows[i].score <= (1 + WORTH) * rows[place].score
        ]
        place = min(estimating, key=lambda i: (rows[i].score, i), default=place)
    estimator, row = rows[place].recipe.estimator, rows[place]
    if estimator is None or estimator.gain is None:
        return place
    own = [i for i in same if rows[i].recipe.estimator == replace(estimator, gain=None) and rows[i].lost <= row.lost]
    own = [i for i in own if rows[i].worst <= (1 + UNSURE) * row.worst]
    return next((i for i in own if rows[i].score <= (1 + WORTH) * row.score), place)


def choose_estimator(scores: Sequence[float], *, unstable: bool) -> int:
    """Return the place of the estimator that other models of the kind get; the first score is that without one.

    One that costs at most 2 % more than none is taken, for it leaves no offset; none of those on an unstable plant.
    """
    place, some = int(np.argmin(scores)), 1 + int(np.argmin(scores[1:]))
    return some if not unstable and scores[some] <= (1 + WORTH) * scores[place] else place


def load_controller(path: str | Path) -> Any:
    """Return the controller that `save`, of a controller or of a Design, wrote. It begins as after `reset`.

    The file holds numbers and names only; reading it runs no code of it.

    Raises
    ------
    LogError
        The file is missing, cut or damaged, holds something else, or is of another version.
    """
    return rebuild_controller(read_controller(path), path)


def read_controller(path: str | Path) -> SavedController | SavedDesign:
    """Return the content of the file: a controller, or a design."""
    return load_value(path, SavedController, SavedDesign)


def rebuild_controller(saved: SavedController | SavedDesign, path: str | Path) -> Any:
    """Return the controller that was saved.

    Raises
    ------
    LogError
        Its parts do not go together.
    """
    try:
        return build_controller(saved.controller if isinstance(saved, SavedDesign) else saved)
    except LogError:
        raise
    except (KoopmpcError, AttributeError, KeyError, TypeError) as error:
        raise LogError(f"{path} holds a controller whose parts do not go together: {error}") from error
