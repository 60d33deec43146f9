"""Snyder & Song, "Koopman operator theory for nonlinear dynamic modeling using dynamic mode decomposition", 2021."""

from dataclasses import replace

from koopmpc.papers.registry import Claim, Paper, Tell, verdicts
from koopmpc.papers.snyder import control, report, theory
from koopmpc.papers.snyder.settings import SHAKINGS, TASKS, Fits, Setting, all_settings, rebuilt
from koopmpc.recording.page import Page

RESOLVED = 1e-6  # smaller errors are rounding and differ from machine to machine


def work(page: Page, quick: bool, progress: Tell) -> list[Claim]:
    """Fill the page and return all claims; `quick` shortens what takes long."""
    progress("trajectories and their reconstructions")
    others = 3 if quick else 10
    settings = all_settings(others)
    fits = {name: rebuilt(setting) for name, setting in settings.items()}
    change = held_change(settings, fits)
    causes = theory.causes(settings["cart-pole-lqr"])
    progress("models of exciting data")
    exciting = 10 if quick else 40
    predicted = {
        name: control.predictions(settings[f"{name}-lqr"], shaking, exciting) for name, shaking in SHAKINGS.items()
    }
    progress("control on lifted models")
    length = {"steps": 20, "horizon": 8, "episodes": 30} if quick else {"steps": 200, "horizon": 60, "episodes": 100}
    tasks = {title: control.contest(title, **length) for title in TASKS}
    runs = {title: task.runs() for title, task in tasks.items()}
    progress("figures")
    said = report.of_text(fits, causes["DMD on x − x_ref"].error, predicted, control.ratios(runs))
    shown = report.of_figures(fits)
    aside = Page(page.folder, page.beside)  # its claim counts in the opening, and its part comes later
    warned = theory.caution(aside, settings, fits)
    report.opening(page, [*said, *shown, *warned], change, others)
    page.text("## What the paper says in words")
    verdicts(page, said)
    report.numbers(page, settings, fits, shown)
    report.pictures(page, settings, fits)
    report.appendix_dmdc(page, settings["pendulum"], settings["pendulum-lqr"])
    report.variants(page, settings, fits)
    report.feedbacks(page)
    theory.frequencies(page, fits)
    theory.formulas(page, settings["pendulum"], fits)
    page.parts += aside.parts
    theory.failure(page, settings["cart-pole-lqr"], causes)
    control.inputs(page, predicted, exciting)
    control.loops(page, tasks, runs, length["episodes"])
    return [*said, *shown, *warned]


def held_change(settings: dict[str, Setting], fits: Fits) -> float:
    """Return the largest relative change of an error above `RESOLVED` where the feedback is held over a sample."""
    changes: list[float] = []
    for name in ("pendulum-lqr", "cart-pole-lqr"):
        held = rebuilt(replace(settings[name], held=True, others=1))
        changes += [abs(held[key].error / fit.error - 1) for key, fit in fits[name].items() if fit.error > RESOLVED]
    return max(changes)


paper = Paper("snyder", "Snyder & Song 2021, DMD and EDMD of pendulum and cart-pole", work)
