"""write_design_report: what a design was asked, made of, and is expected to do, as one HTML page for a colleague."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.page import Page
from koopmpc.base.text import shorten_observable, to_percent, with_unit
from koopmpc.control.ask.limits import Interval
from koopmpc.lifting.base import strip_unit
from koopmpc.loop.metrics import violation_shares
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import LoopOptions
from koopmpc.synthesis.designed import AnyMPC, Evidence, SavedDesign
from koopmpc.synthesis.doubts import describe_rest
from koopmpc.synthesis.loops.judging import Fenced, read_reference, run_on_surrogate
from koopmpc.synthesis.loops.neighbours import choose_starts_to_record, probe_range
from koopmpc.validate.logs.summary import LogExcerpt, LogSummary
from koopmpc.views.figures.evidence import draw_forecast, draw_log, draw_loops
from koopmpc.views.figures.regions import draw_blindness
from koopmpc.views.figures.style import render_svg

LOOPS = 3  # loops of a kind that a report draws
OFF = 0.2  # inputs of some loops, and of some runs of a check, act by this share more or less
_SHOWN = 8  # signals of a kind that are drawn
_FORECASTS = 2  # held-out stretches that are drawn
_ADVISED = 6  # states from which to record that are named
_ALIKE = 4  # more observables of one kind are counted
_NAMED = 16  # observables that are named
_NONE = "–"

Section = Callable[[Page], None]


def write_design_report(
    saved: SavedDesign,
    controller: AnyMPC,
    path: Path,
    file: str,
    *,
    verdict: Section | None = None,
    tested: Section | None = None,
) -> Path:
    """Write the report of a design and return its path.

    The controller, whose `file` the commands name, runs the loops that are drawn; it is reset before and after.
    `verdict` adds that of a check below the title, in place of the promise of the design, and `tested` its runs.
    """
    evidence, logs = saved.evidence, saved.logs
    of = evidence.task.cost.of.bind(controller_states(evidence))
    page = Page(path.parent, title=f"Controller report: {', '.join(strip_unit(name) for name in of.names)}")
    if verdict is None:
        page.verdict("good" if not evidence.expected.lost else "doubt", *_list_promise(evidence)[:2])
    else:
        verdict(page)
    page.heading("What was asked")
    _add_goal(page, evidence, controller)
    page.heading("What the logs hold")
    _add_logs(page, logs)
    page.heading("Which controller and model")
    _add_model(page, saved)
    page.heading("Measured and forecast")
    _add_forecasts(page, logs)
    page.heading("Closed loops on stand-ins of the plant")
    loops = run_shown_loops(evidence, controller)
    _add_loops(page, evidence, controller, loops)
    if tested is not None:
        tested(page)
    page.heading("Where it is blind")
    _add_blind(page, evidence, loops)
    page.heading("What it promises")
    page.items(_list_promise(evidence))
    if logs is not None and logs.certified:
        page.text(logs.certified)
    page.heading("What to record next, and what else would help")
    advice = () if logs is None else logs.advice
    if advice:
        page.items(advice)
    else:
        page.text(
            "The checks of the design ask for no further data. Logs of this controller on the plant are the best."
        )
    page.heading("How to run it")
    _add_usage(page, file, controller, evidence)
    if logs is not None:
        page.heading("All candidates")
        page.code(logs.choice)
        page.heading("The goal file")
        page.code(logs.goal)
    return page.write(path.name)


def controller_states(evidence: Evidence) -> tuple[str, ...]:
    """Return the names of the states of a design."""
    return evidence.surrogates[0].states


def _format_range(low: float, high: float, unit: str = "") -> str:
    if not np.isfinite(low) and not np.isfinite(high):
        return _NONE
    if not np.isfinite(low) or not np.isfinite(high):
        return f"at most {high:.4g}" if np.isfinite(high) else f"at least {low:.4g}"
    return f"{low:.4g} to {high:.4g}"


def _add_goal(page: Page, evidence: Evidence, controller: AnyMPC) -> None:
    asked, states, inputs = evidence.task, controller_states(evidence), evidence.surrogates[0].model.inputs
    of = asked.cost.of.bind(states)
    Q, R = asked.cost.matrices(of.nz, len(inputs))
    changes = asked.cost.rate(len(inputs))
    low, high = asked.limits.states(len(states))
    rows: list[list[str]] = []
    for i, name in enumerate([*states, *(extra for extra in of.names if extra not in states)]):
        place = of.names.index(name) if name in of.names else None
        reference = weight = _NONE
        if place is not None and Q[place, place] > 0:
            column = asked.reference[:, place]
            moves = bool((column != column[0]).any())
            reference = f"{column.min():.4g} to {column.max():.4g}, moving" if moves else f"{column[0]:.4g}"
            weight = f"{Q[place, place]:.3g}"
        kept = _format_range(float(low[i]), float(high[i])) if i < len(states) else _NONE
        seen = f"{asked.low[i]:.4g} to {asked.high[i]:.4g}" if i < len(states) else _NONE
        rows.append([name, reference, weight, kept, seen])
    page.table(["measured", "reference", "weight", "limits", "range in the logs"], rows)
    u_low, u_high = asked.limits.inputs(len(inputs))
    rates = asked.limits.rates(len(inputs))
    rows = []
    for j, name in enumerate(inputs):
        step = _NONE if rates is None else _format_range(float(rates.low[j]), float(rates.high[j]))
        change = _NONE if changes is None else f"{changes[j, j]:.3g}"
        rows.append([name, _format_range(float(u_low[j]), float(u_high[j])), step, f"{R[j, j]:.3g}", change])
    page.table(["input", "limits, always kept", "change in a step", "weight", "weight of change"], rows)
    ahead = controller.horizon * controller.dt
    page.text(
        f"A step takes {controller.dt:g} s, and the controller looks {controller.horizon} steps ahead, which is "
        f"{ahead:.4g} s. Limits of measured signals are soft: they give way where no input keeps them."
    )
    if evidence.goal_can_be_held:
        rest = describe_rest(evidence.surrogates, asked)
        page.text(f"{rest[0].upper()}{rest[1:]}.")
    elif not asked.moves:
        page.verdict(
            "doubt", "No input inside the limits holds the reference.", "The advice below says what is in the way."
        )


def _add_logs(page: Page, logs: LogSummary | None) -> None:
    if logs is None:
        page.text("The controller was designed in Python from episodes in memory; its file keeps no rows of them.")
        return
    excerpt = logs.excerpt
    cells, out = len(excerpt.replaced), len(excerpt.left_out)
    page.text(
        f"{cells} measurement{'s were' if cells != 1 else ' was'} replaced, and {out} stretch"
        f"{'es' if out != 1 else ''} of rows left out. Red marks show where. Ochre marks rows that a check suspects "
        "and that were kept, since models without them forecast no better."
    )
    columns = _choose_columns(excerpt)
    page.pictures(_draw((f"{strip_unit(excerpt.names[i])}: as logged", partial(draw_log, excerpt, i)) for i in columns))
    if len(columns) < len(excerpt.names):
        page.text(f"Not drawn: {', '.join(name for i, name in enumerate(excerpt.names) if i not in columns)}.")
    page.code(logs.about)
    if logs.notes:
        page.heading("How the logs were read and repaired", 3)
        page.items(logs.notes)


def _choose_columns(excerpt: LogExcerpt) -> list[int]:
    nx, nu, width = excerpt.nx, excerpt.nu, len(excerpt.names)
    return [*range(min(nx, _SHOWN)), *range(nx, nx + min(nu, _SHOWN)), *range(nx + nu, min(width, nx + nu + _SHOWN))]


def _draw(figures: Iterable[tuple[str, Callable[[], Any]]]) -> list[tuple[str, str]]:
    """Return each figure as an <svg> element with its caption."""
    return [(render_svg(draw()), caption) for caption, draw in figures]


def _add_model(page: Page, saved: SavedDesign) -> None:
    one, logs = saved.controller, saved.logs
    model = one.model
    assert model is not None, "every design has a model"
    pairs = [] if logs is None else [["chosen", logs.title]]
    pairs.append(["controller", f"{one.name}, {one.horizon} steps"])
    pairs.append(["model", f"{type(model).__name__} of {model.nz} observables"])
    if model.embedding is not None:
        pairs.append(["past", f"{model.embedding.steps} past rows are part of the state"])
    if one.estimator is not None:
        pairs.append(["load", "a constant load is estimated, so that no error remains at rest"])
    page.table(["", ""], pairs, words=True)
    page.text(f"Observables: {_list_observables(model.lifting.names)}.")


def _list_observables(names: Sequence[str]) -> str:
    """Return the names; many that begin with the same function are counted."""
    kinds = [name.partition("(")[0] if "(" in name else "" for name in names]
    said: list[str] = []
    for kind, name in zip(kinds, names, strict=True):
        many = kind and kinds.count(kind) > _ALIKE
        words = f"{kinds.count(kind)} of the kind {kind}" if many else shorten_observable(name)
        said += [words] * (words not in said)
    more = len(said) - _NAMED
    return ", ".join(said[:_NAMED]) + (f", and {more} more" if more > 0 else "")


def _add_forecasts(page: Page, logs: LogSummary | None) -> None:
    if logs is None or not logs.forecasts:
        page.text("No rows were held out." if logs is None else logs.verdict)
        return
    first = logs.forecasts[0]
    page.text(
        f"{logs.verdict}. The pictures show rows that the model did not learn from, its forecast from the first of "
        f"them under the inputs as applied, and a band: {first.band}."
    )
    if logs.findings:
        page.items(logs.findings)
    page.pictures(
        _draw(
            (f"{strip_unit(name)}: forecast of held-out stretch {k + 1}", partial(draw_forecast, ahead, i))
            for k, ahead in enumerate(logs.forecasts[:_FORECASTS])
            for i, name in enumerate(first.states[:_SHOWN])
        )
    )
    if len(logs.error):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = logs.error[-1] / logs.plain[-1]
        rows = [
            [name, f"{logs.error[0, i]:.3g}", f"{logs.error[-1, i]:.3g}", f"{logs.plain[-1, i]:.3g}", f"{share[i]:.2g}"]
            for i, name in enumerate(first.states)
        ]
        far = f"{len(logs.error)} steps ahead"
        page.table(["error (RMSE) of", "1 step ahead", far, "plain linear model", "ratio"], rows)


def run_shown_loops(evidence: Evidence, controller: AnyMPC) -> dict[str, list[Run | None]]:
    """Return closed loops by what stands in for the plant; None for one that was lost."""
    asked, starts = evidence.task, evidence.expected.starts
    starts = starts if len(starts) else asked.starts
    rows = read_reference(asked, 0, asked.steps + 1 + controller.horizon)
    inputs = np.zeros((asked.steps, controller.nu))  # only the cost needs them, and no loop here is judged by it
    count = len(evidence.surrogates)

    def run(stand_in: Any, plant: Any, k: int) -> Run | None:
        controller.reset()
        return run_on_surrogate(
            asked,
            stand_in,
            Fenced(plant, evidence.low, evidence.high),
            controller,
            starts[k % len(starts)],
            reference=rows,
            u_reference=inputs,
            options=LoopOptions(noise=stand_in.noise, rng=k),
        )

    made: dict[str, list[Run | None]] = {"learned models": [], "inputs 20 % off": []}
    for k in range(LOOPS):
        one = evidence.surrogates[k % count]
        made["learned models"].append(run(one, one.plant(), k))
    for k, gain in enumerate((1 - OFF, 1 + OFF)):
        one = evidence.surrogates[k % count]
        made["inputs 20 % off"].append(run(one, one.plant(gain), LOOPS + k))
    if (near := evidence.neighbours) is not None:
        plants = [near.draw(np.random.default_rng(k)) for k in range(LOOPS)]
        made["nearest rows of the logs"] = [run(near, plant, 2 * LOOPS + k) for k, plant in enumerate(plants)]
    controller.reset()
    return made


def _add_loops(page: Page, evidence: Evidence, controller: AnyMPC, loops: dict[str, list[Run | None]]) -> None:
    every = [run for runs in loops.values() for run in runs]
    ended = [run for run in every if run is not None]
    lost = len(every) - len(ended)
    worst = max((float(violation_shares(run, evidence.task.limit_sizes).max()) for run in ended), default=0.0)
    page.text(
        f"{len(every)} loops of {evidence.task.steps} steps from starts of the logs: {lost} of them "
        f"{'is' if lost == 1 else 'are'} lost, and {_say_violated(worst)}. "
        "Stand-ins are models that the controller's own model does not know, the same with inputs that act 20 % more "
        "or less, and the nearest rows of the logs themselves."
    )
    if not ended:
        return
    states, inputs = controller_states(evidence), ended[0].inputs
    asked, tracked = evidence.task, evidence.task.cost.of.bind(states).names
    boxes: tuple[Interval, Interval] = asked.limits.states(len(states)), asked.limits.inputs(len(inputs))
    groups = {name: there for name, runs in loops.items() if (there := [run for run in runs if run is not None])}

    def draw_state(i: int) -> Any:
        curves = {name: [(run.time, run.X[:, i]) for run in runs] for name, runs in groups.items()}
        line = None
        if states[i] in tracked:
            line = ended[0].time, ended[0].reference[:, tracked.index(states[i])]
        return draw_loops(states[i], curves, _list_finite(boxes[0], i), line)

    def draw_input(j: int) -> Any:
        curves = {name: [(run.time[:-1], run.U[:, j]) for run in runs] for name, runs in groups.items()}
        return draw_loops(inputs[j], curves, _list_finite(boxes[1], j), steps=True)

    figures = [
        (f"{strip_unit(name)}: closed loops", partial(draw, i))
        for names, draw in ((states, draw_state), (inputs, draw_input))
        for i, name in enumerate(names[:_SHOWN])
    ]
    page.pictures(_draw(figures))


def _list_finite(box: Interval, i: int) -> list[float]:
    return [float(end[i]) for end in box if np.isfinite(end[i])]


def _add_blind(page: Page, evidence: Evidence, loops: dict[str, list[Run | None]]) -> None:
    fresh, near = evidence.expected.fresh, evidence.neighbours
    if fresh is not None and near is not None and near.embedding is None and len(fresh.outside):
        share = float(fresh.outside.mean())
        corners = int(np.sum(~np.isfinite(fresh.corner_cost)))
        page.text(
            f"{to_percent(share)} of the steps of the loops after the choice had no data around them. Of "
            f"{len(fresh.corner_cost)} loops from corners of the goal's range {corners} were lost."
        )
    if near is None:
        page.text("The design kept no rows of its data, so nobody can say where they end.")
        return
    states = near.states
    _, away = probe_range(evidence.task, near)
    page.text(
        f"{to_percent(float(away.mean()))} of the goal's range, which is what limits and ranges of the signals allow, "
        "has no data around it. There the controller guesses, and its moves say known = False."
    )
    if len(states) > 1:
        ended = [run.X for runs in loops.values() for run in runs if run is not None]
        more = f" The map shows two of {len(states)} signals." if len(states) > 2 else ""
        caption = f"Rows of the logs, points of the goal's range that have none around them, and loops.{more}"
        page.pictures(_draw([(caption, partial(draw_blindness, evidence, loops=ended))]))
    advised = choose_starts_to_record(evidence.task, near, _ADVISED)
    if len(advised):
        page.text("Episodes that start in these states make the range known:")
        page.table(states, [[f"{value:.4g}" for value in row] for row in advised])


def _list_promise(evidence: Evidence) -> list[str]:
    """Return what the closed loops after the choice bound, in sentences."""
    expected = evidence.expected
    fresh = expected.fresh
    if fresh is None or not len(fresh.cost):
        return [
            "No loops were run after the choice, so nothing is promised.",
            f"In the choice {expected.lost} of {len(expected.cost) + len(expected.cost_off)} loops were lost.",
        ]
    promise = [] if evidence.promise is None else [f"{str(evidence.promise)[:1].upper()}{str(evidence.promise)[1:]}."]
    number, lost = len(fresh.cost), int(np.sum(~np.isfinite(fresh.cost)))
    low, high = expected.cost_interval
    return [
        *promise,
        f"Of {number} loops after the choice, {lost} were lost: fewer than {to_percent(expected.lost_bound)} of loops "
        "like these are (95 % confidence).",
        f"In 95 % of them {_say_violated(expected.violation_bound)}.",
        f"In 90 % of them the cost over {expected.steps} steps is between {low:.4g} and {high:.4g}.",
        f"With inputs that act 20 % more or less, {int(np.sum(~np.isfinite(expected.cost_off)))} of "
        f"{len(expected.cost_off)} loops were lost.",
        "These numbers are estimates, and no guarantee. All stand-ins are learned from the same logs, and an error "
        "that they share does not show.",
    ]


def _say_violated(share: float) -> str:
    return f"limits are violated by at most {to_percent(share)} of their range" if share > 0 else "no limit is violated"


def _add_usage(page: Page, file: str, controller: AnyMPC, evidence: Evidence) -> None:
    row: Float[np.ndarray, " nr"] = evidence.task.reference[0]
    reference = ", ".join(f"{value:.6g}" for value in row)
    states = ", ".join(controller_states(evidence))
    page.text("Test it on the stand-ins, write it as C, or run it in Python:")
    page.code(
        f"koopmpc check {quote(file)}\n"
        f"koopmpc export {quote(file)} --out c_code\n\n"
        "import koopmpc as km\n"
        f"controller = km.load_controller({file!r})\n"
        f"move = controller(y, [{reference}])   # every {controller.dt:g} s; y = [{states}]\n"
        f"move.u                                # {', '.join(evidence.surrogates[0].model.inputs)}\n"
        "move.known                            # False where the logs have not been"
    )
    page.text(
        "km.realtime keeps the time, the watchdog and the log of a loop on hardware. km.supervise.Station switches "
        f"between hand, automatic and a standby such as the present controller. The last inputs begin at "
        f"{_format_inputs(evidence)} unless reset(u_prev=) names them."
    )


def _format_inputs(evidence: Evidence) -> str:
    return ", ".join(with_unit(name, "= 0") for name in evidence.surrogates[0].model.inputs)
