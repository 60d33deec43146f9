"""The parts of the report that go past Snyder & Song (2021): why the cart-pole failed, inputs, and control."""

from collections.abc import Mapping

import numpy as np

from koopmpc.bench.page import Page
from koopmpc.figures import comparisons
from koopmpc.lifting.state import Constant, State
from koopmpc.loop.run import Run
from koopmpc.papers.contest import ORACLE, Contest, Prediction, centred, costs
from koopmpc.papers.reconstruction import Reconstruction, Scene, percent, rebuilt
from koopmpc.papers.snyder import words
from koopmpc.papers.snyder.control import LASTING, SHAKINGS, TASKS
from koopmpc.papers.snyder.settings import OBSERVABLES, TARGET

Runs = Mapping[str, Mapping[tuple[str, bool], Run]]
DRAWN = ("LQR, linearisation", "MPC, Fourier 1", "MPC, monomials 3", ORACLE)


def origin(scene: Scene) -> dict[str, Reconstruction]:
    """Return the cart-pole under LQR with and without the origin at the target, or a constant in ψ."""
    squares = OBSERVABLES["EDMD monomials 2"]
    cases = {
        "DMD": (State(), False, None),
        "DMD with a constant": (State() + Constant(), False, None),
        "DMD on x − x_ref": (State(), True, None),
        "EDMD monomials 2, rank 4": (squares, False, 4),
        "EDMD monomials 2, rank 5": (squares, False, 5),
        "EDMD monomials 2": (squares, False, None),
        "EDMD monomials 2 on x − x_ref": (squares, True, None),
    }
    found: dict[str, Reconstruction] = {}
    for name, (lifting, moved, rank) in cases.items():
        data = [centred(each, TARGET) if moved else each for each in (scene.trajectory, scene.held_out)]
        found[name] = rebuilt(data[0], lifting, data[1], rank)
    return found


def why(page: Page, scene: Scene, causes: Mapping[str, Reconstruction]) -> None:
    """Add what the origin of the coordinates and the truncation do to the cart-pole under LQR."""
    page.text("## Why the cart-pole failed", words.CAUSES)
    truth = scene.trajectory[0].X
    size, motion = float(np.linalg.norm(truth)), float(np.linalg.norm(truth - TARGET))
    rows: list[tuple[object, ...]] = []
    for name, fit in causes.items():
        gap = float(np.linalg.norm(fit.X - fit.truth))
        rows.append(
            (
                name,
                f"{fit.rank} of {fit.width}",
                f"{fit.condition:.1e}",
                percent(gap / size),
                percent(gap / motion),
            )
        )
    page.table(("model", "rank", "σ₁/σ_r", "error, of ‖x‖ [%]", "of ‖x − x_ref‖ [%]"), rows)
    curves = {
        name: causes[name].X + (np.asarray(TARGET) if "x_ref" in name else 0.0)
        for name in ("DMD", "DMD with a constant", "DMD on x − x_ref", "EDMD monomials 2")
    }
    made = comparisons.reconstruction({scene.title: (truth, curves)}, scene.dt, scene.dynamics.states)
    page.picture("why-cart-pole", "Cart-pole under LQR: origin and truncation", made)
    page.curve("why cart-pole", scene.dt, scene.dynamics.states, {"truth": truth, **curves})


def inputs(page: Page, predicted: Mapping[str, Mapping[str, Prediction]], episodes: int) -> None:
    """Add what models predict that were fitted to feedback data, and to so many episodes of exciting data."""
    noise = {name.replace("-", "_"): shaking.noise for name, shaking in SHAKINGS.items()}
    page.text(
        "## Data that show what the input does",
        words.INPUTS.format(episodes=episodes, lasting=LASTING, **noise),
    )
    page.table(
        (
            "plant",
            "model",
            "under feedback [%]",
            "feedback and noise [%]",
            "B, of the true one",
            "the fit says",
        ),
        [
            (
                plant,
                p.name,
                percent(p.feedback),
                percent(p.excited),
                "–" if np.isnan(p.b) else f"{p.b:.4f}",
                p.warned,
            )
            for plant, each in predicted.items()
            for p in each.values()
        ],
    )


def ratios(runs: Runs) -> dict[str, dict[str, float]]:
    """Return costs over that of nonlinear MPC, by task with and without limits, and controller."""
    found: dict[str, dict[str, float]] = {}
    for title, each in runs.items():
        for limited in (False, True):
            table = costs(each, limited)
            name = f"{title}, {'limited' if limited else 'without limits'}"
            found[name] = {controller: cost / table[ORACLE] for controller, cost in table.items()}
    return found


def control(page: Page, tasks: Mapping[str, Contest], runs: Runs, episodes: int) -> None:
    """Add the closed loops of all controllers, cost by cost, and a figure for each plant.

    Parameters
    ----------
    page
        Where it goes.
    tasks, runs
        By the title of the task.
    episodes
        How many each model was fitted to.
    """
    one = next(iter(tasks.values()))
    page.text(
        "## Control, which the paper left as future work",
        words.CONTROL.format(
            episodes=episodes,
            lasting=LASTING,
            noise=", ".join(f"±{TASKS[title].shaking.noise:g} for “{title}”" for title in tasks),
            seconds=one.steps * one.plant.dt,
            ahead=one.horizon * one.plant.dt,
        ),
    )
    for limited in (False, True):
        table = {title: costs(each, limited) for title, each in runs.items()}
        limits = {title: f"|u| ≤ {float(np.max(task.limits.inputs(1)[1])):g}" for title, task in tasks.items()}
        page.text("Inputs limited:" if limited else "Inputs without limits:")
        page.table(
            ("controller", *(f"{title}, {limits[title]}" if limited else title for title in table)),
            [(name, *(_cost(by[name], by[ORACLE]) for by in table.values())) for name in next(iter(table.values()))],
        )
    ratio = ratios(runs)
    hanging, upright = (ratio[f"pendulum, {what}, π/4, without limits"] for what in ("hanging", "upright"))
    page.text(
        *(
            lesson.format(
                cubic=hanging["LQR, monomials 3"],
                lifted=upright["LQR, Fourier 1"],
                local=upright["LQR, linearisation"],
            )
            for lesson in words.LESSONS
        )
    )
    for plant in ("pendulum", "cart-pole"):
        shown = {
            title.removeprefix(f"{plant}, "): {name: each[name, True] for name in DRAWN}
            for title, each in runs.items()
            if title.startswith(plant)
        }
        caption = f"{plant.capitalize()}: closed loops with limited inputs"
        page.picture(f"control-{plant}", caption, comparisons.runs(shown))
        for title, each in shown.items():
            first = next(iter(each.values()))
            values = {name: np.hstack([run.X[:-1], run.U]) for name, run in each.items()}
            page.curve(f"control, {plant}, {title}", first.dt, (*first.states, *first.inputs), values)


def _cost(value: float, best: float) -> str:
    return f"{value:.2f} ({value / best:.4f})" if np.isfinite(value) else "diverges"
