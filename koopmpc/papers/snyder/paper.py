"""Snyder & Song, "Koopman operator theory for nonlinear dynamic modeling using dynamic mode decomposition", 2021."""

from dataclasses import replace
from pathlib import Path

from koopmpc.bench.page import Page
from koopmpc.papers.reconstruction import Reconstruction, Scene
from koopmpc.papers.registry import Outcome, Paper, Progress
from koopmpc.papers.snyder import beyond, text
from koopmpc.papers.snyder.claims import Fits, of_figures, of_text
from koopmpc.papers.snyder.control import SHAKINGS, TASKS, contest, predictions
from koopmpc.papers.snyder.settings import OBSERVABLES, scenes
from koopmpc.papers.snyder.text import appendix_dmdc
from koopmpc.recording.views.curves import record_curves

RESOLVED = 1e-6  # errors below it are rounding, and differ by a factor from machine to machine


def reproduce(folder: Path, quick: bool, progress: Progress) -> Outcome:
    """Write the report, the figures and the recording into `folder`; `quick` shortens what takes long."""
    page = Page(folder, beside="snyder")
    progress("trajectories and their reconstructions")
    others = 3 if quick else 10
    stage = scenes(others)
    fits = {name: rebuilt(scene) for name, scene in stage.items()}
    change = held_change(stage, fits)
    causes = beyond.origin(stage["cart-pole-lqr"])
    progress("models of exciting data")
    exciting = 10 if quick else 40
    predicted = {name: predictions(stage[f"{name}-lqr"], shaking, exciting) for name, shaking in SHAKINGS.items()}
    progress("control on lifted models")
    length = {"steps": 20, "horizon": 8, "episodes": 30} if quick else {"steps": 200, "horizon": 60, "episodes": 100}
    tasks = {title: contest(title, **length) for title in TASKS}
    runs = {title: task.runs() for title, task in tasks.items()}
    progress("figures")
    said = of_text(fits, causes["DMD on x − x_ref"].error, predicted, beyond.ratios(runs))
    shown = of_figures(fits)
    text.settings(page, [*said, *shown], change, others)
    text.verdicts(page, said)
    text.numbers(page, stage, fits, shown)
    text.pictures(page, stage, fits)
    appendix_dmdc(page, stage["pendulum"], stage["pendulum-lqr"])
    text.variants(page, stage, fits)
    text.gains_table(page)
    text.frequencies(page, fits)
    text.theory(page, stage["pendulum"], fits)
    beyond.why(page, stage["cart-pole-lqr"], causes)
    beyond.inputs(page, predicted, exciting)
    beyond.control(page, tasks, runs, length["episodes"])
    progress("report and recording")
    report, recording = page.write(), folder / "snyder.rrd"
    record_curves(page.curves, recording, application="koopmpc-reproduce-snyder", page=page.words)
    return Outcome((*said, *shown), report, recording)


def rebuilt(scene: Scene) -> dict[tuple[str, bool], Reconstruction]:
    """Return all observables' reconstructions of a scene, at full rank and at that of the state."""
    return scene.rebuilt(OBSERVABLES, scene.dynamics.nx)


def held_change(stage: dict[str, Scene], fits: Fits) -> float:
    """Return by how much, relative, an error above `RESOLVED` changes where the feedback is held over a sample."""
    changes: list[float] = []
    for name in ("pendulum-lqr", "cart-pole-lqr"):
        held = rebuilt(replace(stage[name], held=True, others=1))
        changes += [abs(held[key].error / fit.error - 1) for key, fit in fits[name].items() if fit.error > RESOLVED]
    return max(changes)


paper = Paper("snyder", "Snyder & Song 2021, DMD and EDMD of pendulum and cart-pole", reproduce)
