"""Beyond Snyder & Song (2021): data from exciting inputs, and control on models of these data."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

import koopmpc as km
from koopmpc import papers

from .settings import SHAKINGS, TASKS, Excitement, Setting, centre_episodes, design_feedbacks

ORACLE = "nonlinear MPC"
_DIVERGED = 1e3  # a closed loop has diverged if its cost is above this many times the best
Runs = Mapping[str, Mapping[tuple[str, bool], km.Run]]  # by title of the task, then as `Contest.runs`
DRAWN = ("LQR, linearisation", "MPC, Fourier 1", "MPC, monomials 3", ORACLE)
DT = 0.05  # sample time of the controllers [s]
LASTING = 3.0  # length of an exciting episode [s]
LIFTINGS: Mapping[str, km.Lifting] = {
    "DMDc": km.State() + km.Constant(),
    "Fourier 1": km.State() + km.Fourier(1) + km.Constant(),
    "monomials 3": km.State() + km.Monomials(3) + km.Constant(),
}

INPUTS = """\
Under u = −K x the input is a function of the state: a fit without B describes the closed loop, and a fit with B
cannot separate A from B. Noise on top of the feedback separates them. *Feedback data* are the one trajectory of the
figures, with its input held over each sample; *exciting data* are {episodes} episodes of {lasting:g} s under the
same feedback and uniform noise of ±{pendulum:g} N m or ±{cart_pole:g} N. Medians over ten episodes of 2 s that were
not fitted, relative to ‖x − x_ref‖, each lifted once at its start."""

CONTROL = """\
LQR and MPC on lifted models identified from exciting data, under the paper's weights (pendulum Q = diag(0, 10),
R = 1; cart-pole Q = diag(5, 10, 0, 0), R = 1), sampled at 0.05 s; the observables are the paper's and a
constant. The data of each task are {episodes} episodes of {lasting:g} s under uniform noise, on top of LQR where the
plant would fall: {noise}, in N m or N. Costs are 0.05 Σ (‖x − r‖²_Q + ‖u‖²_R) over {seconds:g} s, and in brackets
their ratio to nonlinear MPC on the true model with a horizon of {ahead:g} s."""

LESSONS = (
    """\
Hanging, with these weights, without limits and in continuous time, u = −√10 ω is optimal for the nonlinear
pendulum too: 2√10 times its energy solves the Hamilton–Jacobi–Bellman equation. There no lifted model can do better
than LQR on the linearisation.""",
    """\
Monomials of degree 3 rebuild the hanging pendulum best, and steer it at {cubic:.2f} times the best cost: a
small reconstruction error does not make a control model.""",
    """\
Upright, from π/4, LQR on Fourier observables takes {lifted:.4f} times the best cost and LQR on the
linearisation {local:.4f}: there the lifted model describes what the linearisation leaves out.""",
    """\
In the shift of the cart-pole, which stays within 0.04 rad of upright, all models are alike.""",
)


@dataclass(frozen=True)
class Prediction:
    """Errors of one model on two kinds of held-out data: medians of ‖x̂ − x‖ / ‖x‖ over the episodes.

    Attributes
    ----------
    name
        The model and its data.
    feedback
        Error under the feedback of the paper, from other starts.
    excited
        Error under that feedback with noise on top.
    b
        The entry of B whose true value is largest, divided by that value; NaN for a model without B.
    warned
        The warning of the fit, in short.
    """

    name: str
    feedback: float
    excited: float
    b: float
    warned: str


def predict_held_out(setting: Setting, shaking: Excitement, episodes: int) -> dict[str, Prediction]:
    """Return the prediction errors of models fitted to one trajectory under feedback, or to exciting data.

    Inputs are held over a sample, and the coordinates are x − x_ref.

    Parameters
    ----------
    setting
        The plant, its feedback and its start.
    shaking
        Excitation about x_ref, of the exciting data and of the held-out ones.
    episodes
        Number of exciting episodes to fit.
    """
    plant = km.discretize(setting.dynamics, setting.dt, km.RK4(2))
    K = setting.K
    assert K is not None
    x_ref = np.broadcast_to(setting.x_ref, plant.nx)
    law = km.Feedback(K, x_ref=x_ref)
    one = centre_episodes(km.collect(plant, setting.x0, law, episodes=1, steps=setting.steps), x_ref)
    steps = round(LASTING / setting.dt)
    rich = centre_episodes(_collect_excited(plant, x_ref, K, shaking, episodes=episodes, steps=steps), x_ref)
    starts = km.Uniform(x_ref - shaking.spread, x_ref + shaking.spread)
    feedback = centre_episodes(km.collect(plant, starts, law, episodes=10, steps=200, rng=1), x_ref)
    excited = centre_episodes(_collect_excited(plant, x_ref, K, shaking, episodes=10, steps=200, seed=2), x_ref)
    B = plant.linearize(x_ref, np.zeros(plant.nu)).B
    with km.errors.hide_fit_warnings():
        models = {
            "DMD, feedback data": km.dmd(one),
            "DMDc, feedback data": km.dmdc(one),
            "DMDc, exciting data": km.dmdc(rich),
            "EDMDc, exciting data": km.edmd(rich, km.State() + km.Fourier(1)),
        }
    return {name: _measure_prediction(name, model, feedback, excited, B) for name, model in models.items()}


def _measure_prediction(
    name: str, model: km.LinearPredictor, feedback: km.Episodes, excited: km.Episodes, B: Float[np.ndarray, "nx nu"]
) -> Prediction:
    """Return the errors of `model` over whole episodes; a model without inputs ignores them.

    Parameters
    ----------
    name, model
        The model and its name in the table.
    feedback, excited
        Held-out episodes with inputs.
    B
        (nx, nu), ∂x⁺/∂u of the plant at the equilibrium.
    """
    i, j = np.unravel_index(int(np.abs(B).argmax()), B.shape)
    share = float((model.C @ model.B)[i, j] / B[i, j]) if model.nu else np.nan
    said = () if model.report is None else model.report.warnings
    make_paper = "A and B inseparable" if any("inseparable" in sentence for sentence in said) else "–"
    return Prediction(name, _median_error(model, feedback), _median_error(model, excited), share, make_paper)


def _median_error(model: km.LinearPredictor, episodes: km.Episodes) -> float:
    errors = [papers.relative_error(model.rollout(e.X[0], e.U[:, : model.nu]), e.X) for e in episodes]
    return float(np.median(errors))


def add_inputs(page: papers.Page, predicted: Mapping[str, Mapping[str, Prediction]], episodes: int) -> None:
    """Add a table of these predictions; `episodes` is the number of exciting episodes."""
    noise = {name.replace("-", "_"): shaking.noise for name, shaking in SHAKINGS.items()}
    page.text("## Data that show what the input does", INPUTS.format(episodes=episodes, lasting=LASTING, **noise))
    page.table(
        ("plant", "model", "under feedback [%]", "feedback and noise [%]", "B, of the true one", "the fit says"),
        [
            (
                plant,
                p.name,
                papers.percent(p.feedback),
                papers.percent(p.excited),
                "–" if np.isnan(p.b) else f"{p.b:.4f}",
                p.warned,
            )
            for plant, each in predicted.items()
            for p in each.values()
        ],
    )


@dataclass(frozen=True, eq=False)
class Contest:
    """The controllers of one of `TASKS`: one start, one reference and one cost, with and without input limits.

    Attributes
    ----------
    title
        The task's name in `TASKS`.
    plant
        x⁺ = F(x, u).
    models
        Lifted models by name.
    steps, horizon
        Length of each run, and of a plan, in steps.
    """

    title: str
    plant: km.StepMap
    models: Mapping[str, km.LinearPredictor]
    steps: int
    horizon: int

    def runs(self) -> "dict[tuple[str, bool], km.Run]":
        """Return the run of each controller by its name and by whether the inputs are limited.

        LQR and, where inputs are limited, MPC run on each model; nonlinear MPC runs on the plant.
        """
        task = TASKS[self.title]
        local = km.LinearPredictor.local(self.plant, task.x_eq, np.zeros(self.plant.nu))
        found: dict[tuple[str, bool], km.Run] = {}
        for limits in (None, km.Limits(u_min=-task.limit, u_max=task.limit)):
            controllers: dict[str, km.control.Controller] = {}
            for name, model in {"linearisation": local, **self.models}.items():
                controllers[f"LQR, {name}"] = km.LQR(model, task.cost, limits or km.Limits())
                if limits is not None:
                    controllers[f"MPC, {name}"] = km.KoopmanMPC(model, task.cost, limits, self.horizon)
            controllers[ORACLE] = km.NonlinearMPC(self.plant, task.cost, limits or km.Limits(), self.horizon)
            for name, controller in controllers.items():
                found[name, limits is not None] = km.simulate(
                    self.plant,
                    controller,
                    x0=task.x0,
                    reference=task.reference,
                    steps=self.steps,
                    cost=task.cost,
                    limits=limits,
                    options=km.loop.LoopOptions(metadata={"problem": self.title, "controller": name}),
                )
        return found


def compute_costs(runs: "Mapping[tuple[str, bool], km.Run]", limited: bool) -> dict[str, float]:
    """Return dt Σ (‖x − r‖²_Q + ‖u‖²_R) of each controller; inf if the loop diverged."""
    totals = {name: run.dt * km.metrics(run).cost for (name, kind), run in runs.items() if kind is limited}
    best = totals[ORACLE]
    return {name: value if value < _DIVERGED * best else np.inf for name, value in totals.items()}


def prepare_contest(title: str, steps: int, horizon: int, episodes: int) -> Contest:
    """Return one of `TASKS` as a contest, with models fitted to `episodes` exciting episodes."""
    task = TASKS[title]
    plant = km.discretize(task.dynamics, DT, km.RK4(4))
    K = None if task.K is None else design_feedbacks()[task.K]
    data = _collect_excited(plant, task.x_eq, K, task.shaking, episodes=episodes, steps=round(LASTING / DT))
    with km.errors.hide_fit_warnings():
        models = {name: km.edmd(data, lifting) for name, lifting in LIFTINGS.items()}
    return Contest(title, plant, models, steps, horizon)


def compute_ratios(runs: Runs) -> dict[str, dict[str, float]]:
    """Return each controller's cost divided by that of nonlinear MPC, for each task with and without limits."""
    result: dict[str, dict[str, float]] = {}
    for title, task_runs in runs.items():
        for limited in (False, True):
            table = compute_costs(task_runs, limited)
            name = f"{title}, {'limited' if limited else 'without limits'}"
            result[name] = {controller: cost / table[ORACLE] for controller, cost in table.items()}
    return result


def add_loops(page: papers.Page, tasks: Mapping[str, Contest], runs: Runs, episodes: int) -> None:
    """Add a table of the closed-loop costs with and without limits, the lessons, and a figure for each plant.

    Parameters
    ----------
    page
        The report.
    tasks, runs
        By the title of the task.
    episodes
        Number of episodes that each model was fitted to.
    """
    one = next(iter(tasks.values()))
    page.text(
        "## Control, which the paper left as future work",
        CONTROL.format(
            episodes=episodes,
            lasting=LASTING,
            noise=", ".join(f"±{TASKS[title].shaking.noise:g} for “{title}”" for title in tasks),
            seconds=one.steps * one.plant.dt,
            ahead=one.horizon * one.plant.dt,
        ),
    )
    for limited in (False, True):
        table = {title: compute_costs(each, limited) for title, each in runs.items()}
        limits = {title: f"|u| ≤ {TASKS[title].limit:g}" for title in tasks}
        page.text("Inputs limited:" if limited else "Inputs without limits:")
        page.table(
            ("controller", *(f"{title}, {limits[title]}" if limited else title for title in table)),
            [
                (name, *(_format_cost(by[name], by[ORACLE]) for by in table.values()))
                for name in next(iter(table.values()))
            ],
        )
    ratio = compute_ratios(runs)
    hanging, upright = (ratio[f"pendulum, {what}, π/4, without limits"] for what in ("hanging", "upright"))
    page.items(
        lesson.format(
            cubic=hanging["LQR, monomials 3"], lifted=upright["LQR, Fourier 1"], local=upright["LQR, linearisation"]
        )
        for lesson in LESSONS
    )
    for plant in ("pendulum", "cart-pole"):
        shown = {
            title.removeprefix(f"{plant}, "): {name: each[name, True] for name in DRAWN}
            for title, each in runs.items()
            if title.startswith(plant)
        }
        caption = f"{plant.capitalize()}: closed loops with limited inputs"
        page.picture(f"control-{plant}", caption, partial(km.plot.save, km.plot.runs(shown)))
        for title, each in shown.items():
            first = next(iter(each.values()))
            values = {name: np.hstack([run.X[:-1], run.U]) for name, run in each.items()}
            page.curve(f"control, {plant}, {title}", first.dt, (*first.states, *first.inputs), values)


def _collect_excited(
    plant: km.StepMap,
    x_ref: ArrayLike,
    K: Float[np.ndarray, "nu nx"] | None,
    shaking: Excitement,
    *,
    episodes: int,
    steps: int,
    seed: int = 0,
) -> km.Episodes:
    """Collect episodes that start in x_ref ± spread under noise, on top of the feedback if K is given."""
    middle = np.broadcast_to(np.asarray(x_ref, dtype=float), (plant.nx,))
    shaken = km.Noise(-shaking.noise, shaking.noise, hold=max(1, round(0.05 / plant.dt)))
    excitation = shaken if K is None else km.Feedback(K, shaken, x_ref=middle)
    starts = km.Uniform(middle - shaking.spread, middle + shaking.spread)
    return km.collect(plant, starts, excitation, episodes=episodes, steps=steps, rng=seed)


def _format_cost(value: float, best: float) -> str:
    return f"{value:.2f} ({value / best:.4f})" if np.isfinite(value) else "diverges"
