"""plan_further: the next experiment for the plant of some logs and a goal, written as .csv with its picture."""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.errors import KoopmpcError
from koopmpc.experiment.plan import ExperimentPlan
from koopmpc.experiment.planning import next_experiment
from koopmpc.figures.plans import plan as draw_plan
from koopmpc.figures.style import save
from koopmpc.synthesis.designed import Design

_HORIZONS = 5  # an episode is this many horizons long
_LONGEST = 500  # steps of an episode at most
_WIDEST = 12  # states that a picture can show


@dataclass(frozen=True, eq=False)
class FurtherData:
    """The next experiment, or why there is none.

    Attributes
    ----------
    plan
        The plan; None where no safe one exists.
    sentence
        Its verdict, or the reason why there is none.
    file, picture
        What was written; None where the experiment is not worth its length, or cannot be planned.
    """

    plan: ExperimentPlan | None
    sentence: str
    file: Path | None = None
    picture: Path | None = None

    def __str__(self) -> str:
        """Return the plan in words, and where it lies."""
        if self.plan is None:
            return f"the next experiment: {self.sentence}"
        if self.file is None:
            return f"the next experiment: {self.sentence}; no plan is written"
        return f"{self.plan}\nplan: {self.file}, picture: {self.picture}"


def plan_further(
    data: Episodes | Source,
    cost: Cost,
    limits: Limits,
    reference: np.ndarray,
    file: str | PathLike[str],
    *,
    horizon: int,
    design: Design | None = None,
    steps: int | None = None,
    episodes: int = 1,
    rng: np.random.Generator | int = 0,
) -> FurtherData:
    """Plan the next experiment and write it; an experiment that is not worth its length is not written.

    Parameters
    ----------
    data, cost, limits, reference, design, episodes, rng
        As for `next_experiment`. Where no plan is safe by the model of the design, one of its own is fitted.
    file
        The .csv to write; the picture stands beside it, as .png.
    horizon
        Horizon of the controller: an episode has five of them by default, at most 500 steps.
    steps
        Steps of an episode.

    Raises
    ------
    DataError
        The file does not end with .csv.
    LogError
        It cannot be written.
    """
    plan, sentence = None, ""
    for known in (design, None) if design is not None else (None,):  # a design of few logs may have a poor model
        try:
            plan = next_experiment(
                data,
                cost,
                limits,
                reference=reference,
                design=known,
                steps=min(_HORIZONS * horizon, _LONGEST) if steps is None else steps,
                episodes=episodes,
                rng=rng,
            )
            break
        except KoopmpcError as reason:  # it must not cost the design
            sentence = str(reason)
    if plan is None:
        return FurtherData(None, sentence)
    if not plan.is_worth_it:
        return FurtherData(plan, plan.verdict)
    plan.save(file)
    picture = Path(file).with_suffix(".png")
    save(draw_plan(plan, states=range(min(len(plan.states), _WIDEST)), width="two columns"), picture)
    return FurtherData(plan, plan.verdict, Path(file), picture)
