"""Design: the controller chosen by closed loop, the leaderboard, and the file that keeps it."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from rich.console import RenderableType

from koopmpc.base import checks
from koopmpc.base.errors import DataError, Hint, KoopmpcError, LogError
from koopmpc.base.terminal import build_leaderboard, render_text
from koopmpc.base.text import format_duration, to_percent
from koopmpc.base.values import Value
from koopmpc.control.kinds import build_controller
from koopmpc.control.kinds.bilinear_mpc import BilinearMPC
from koopmpc.control.kinds.koopman_mpc import KoopmanMPC
from koopmpc.control.kinds.nonlinear_mpc import NonlinearMPC
from koopmpc.control.program import SavedController
from koopmpc.data.episodes import Episodes
from koopmpc.loop.guarded import Guarded
from koopmpc.models.base import load_value, save_value
from koopmpc.synthesis.choice import DesignRow
from koopmpc.synthesis.loops.neighbours import NeighbourMap, choose_starts_to_record
from koopmpc.synthesis.loops.surrogates import Surrogate
from koopmpc.synthesis.rates import CoveragePromise, ExpectedLoop
from koopmpc.synthesis.search.leaderboard import group_twins
from koopmpc.synthesis.search.recipe import Designed
from koopmpc.synthesis.task import DesignTask
from koopmpc.validate.logs.summary import LogSummary

AnyMPC = KoopmanMPC | BilinearMPC | NonlinearMPC


@dataclass(frozen=True, eq=False)
class Evidence(Value):
    """The evidence of a design: the task, the surrogates, and the expected closed loop.

    Attributes
    ----------
    task
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
        The promised share of loops that keep their limits; None for a margin of another kind.
    """

    _FORMER: ClassVar = {"asked": "task"}
    asked = Hint("write evidence.task")

    task: DesignTask
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
        return choose_starts_to_record(self.evidence.task, self.evidence.neighbours, checks.count(count, "count"))

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
        """The promised share of loops that keep their limits; None for a margin of another kind."""
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
        # rows with the same figures that differ only in the ridge or in the end of the horizon are printed as one
        keys = [(str(replace(row.recipe, tail=None)), *_list_figures(row)) for row in self.leaderboard]
        kept, leads = group_twins(keys, self.chosen)
        for i in kept:
            row, twins = self.leaderboard[i], leads.count(len(rows)) - 1
            title = (
                row.title
                if titles[row.title] == 1
                else f"{row.title} (ridge {row.recipe.ridge:.0e})".replace("0e+00", "0")
            )
            rows.append([title + f"; {twins} more alike" * bool(twins), *_list_figures(row)])
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
    """Return the controller that was saved."""
    try:
        return build_controller(saved.controller if isinstance(saved, SavedDesign) else saved)
    except LogError:
        raise
    except (KoopmpcError, AttributeError, KeyError, TypeError) as error:
        raise LogError(f"{path} holds a controller whose parts do not go together: {error}") from error
