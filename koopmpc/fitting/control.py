"""design_data: from logs and a goal to a controller file, with the page of its evidence."""

from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.fitting.audited import Data, evenly
from koopmpc.fitting.fit import Say, guessed, logs_of, silent, understood
from koopmpc.fitting.goal import Goal, goal_template, inputs_of, read_goal
from koopmpc.fitting.repair import IN_MEMORY, Divided, divided, noted, shortened
from koopmpc.parallel import StageProgress
from koopmpc.recording.page import Page
from koopmpc.synthesis.design import design
from koopmpc.synthesis.designed import Design


@dataclass(frozen=True, eq=False)
class DesignedData:
    """The design that was made, and the files that were written.

    Attributes
    ----------
    design
        The controller with its evidence.
    goal
        The goal that was read.
    controller, page
        Paths of the controller file, and of the report in Markdown.
    usage
        Lines of Python that load the controller.
    """

    design: Design
    goal: Goal
    controller: Path
    page: Path
    usage: str


def design_data(
    data: Data,
    goal: str | PathLike[str],
    folder: str | PathLike[str],
    *,
    bilinear: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    memory: int = IN_MEMORY,
    say: Say | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
    **reading: Any,
) -> DesignedData:
    """Read data and a goal, design a controller, and write controller.npz and controller.md.

    The data are read and repaired as by `fit_data`; the other arguments are the same as there.

    Parameters
    ----------
    data, folder
        As for `fit_data`.
    goal
        A file as `template_of` writes it.
    bilinear, workers, scheduler, memory, say, progress, rng
        As for `fit_data`.
    reading
        Keywords of `load_episodes` for plain tables; without ``inputs`` the inputs of the goal are inputs.

    Raises
    ------
    LogError
        A file cannot be read, or the folder not written.
    DataError
        The data are not of one plant, or too few; the goal names what the data do not have.
    """
    place, draw = Path(folder), checks.generator(rng)
    tell = silent if say is None else say
    pushed = inputs_of(goal)
    split, notes = _read(data, memory, draw, reading)
    missed = tuple(name for name in pushed if name in split.seen.states)
    if missed and reading.get("inputs") is None:  # the goal knows inputs that no name in the logs shows
        split, notes = _read(data, memory, draw, {**reading, "inputs": (*split.seen.inputs, *missed)})
    about = understood(split, notes)
    tell(about)
    asked = read_goal(goal, split.seen)
    with noted([]):  # its advice says the same
        found = design(
            split.fitted,
            asked.cost,
            asked.limits,
            horizon=asked.horizon,
            reference=asked.reference,
            angles=asked.angles,
            bilinear=bilinear,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
            rng=draw,
        )
    tell(str(found))
    file = place / "controller.npz"
    found.save(file)
    usage = f'import koopmpc as km\ncontroller = km.load_controller("{file.as_posix()}")'
    page = Page(place)
    page.text("# Controller report", f"Chosen: {found.best.title}.")
    page.code(usage, "python")
    if found.advice:
        page.text("## Advice")
        page.items(found.advice)
    page.text("## What to expect")
    page.code(str(found.expected))
    page.text("## Choice")
    page.code(str(found))
    page.text("## Goal")
    page.code(Path(goal).read_text(), "toml")
    page.text("## Data")
    page.code(about)
    return DesignedData(found, asked, file, page.write("controller.md"), usage)


def template_of(data: Data, *, memory: int = IN_MEMORY, **reading: Any) -> str:
    """Return the text of a goal file for the plant of some logs, with the ranges found.

    Raises
    ------
    DataError
        No column is an input.
    """
    split, notes = _read(data, memory, checks.generator(0), reading)
    if not split.seen.nu:
        raise DataError("\n".join(["the logs have no input, so nothing can be controlled; pass --inputs u,v", *notes]))
    return goal_template(split.seen.with_episodes([*split.seen, *split.held_out]))


def _read(data: Data, memory: int, draw: np.random.Generator, reading: dict[str, Any]) -> tuple[Divided, list[str]]:
    notes: list[str] = []
    told = {name: value for name, value in reading.items() if value is not None}
    divide = partial(divided, horizon=None, rng=draw, memory=memory, short="record more episodes, or longer ones")
    with noted(notes):
        files, split = evenly(logs_of(data), told, divide, notes)
    return split, [*shortened(notes, files.files), *guessed(files.files, told)]
