"""check_controller: the acceptance test of a designed controller on surrogates of its plant, with a page."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float

from koopmpc.apps.fitting.changed import compare_logs
from koopmpc.apps.fitting.checked import (
    _GOOD,
    _VERDICTS,
    ALLOWED_OFF,
    Checked,
    Figures,
    RunKind,
    _explain_cost,
    _list_headings,
    _row,
    kinds,
)
from koopmpc.apps.fitting.report import write_design_report
from koopmpc.apps.fitting.verdict import judge_plant_runs, judge_rate, plan_verdict
from koopmpc.base import checks
from koopmpc.base.errors import LogError
from koopmpc.base.page import Page
from koopmpc.base.parallel import StageProgress
from koopmpc.base.text import format_duration, to_percent
from koopmpc.control.ask.limits import Interval
from koopmpc.data.episodes import Episodes
from koopmpc.loop.metrics import total_cost, tracking_error, violation_shares
from koopmpc.loop.rows import Step
from koopmpc.loop.simulate import LoopOptions
from koopmpc.plants.step_map import StepMap
from koopmpc.synthesis.designed import AnyMPC, Evidence, SavedDesign, read_controller, rebuild_controller
from koopmpc.synthesis.doubts import explain_unreachable
from koopmpc.synthesis.loops.judging import Fenced, read_reference, run_on_surrogate
from koopmpc.synthesis.search.recipe import get_model
from koopmpc.synthesis.task import goal_box

ARRIVED = 0.05  # error over the last tenth of a run, as a share of the data's range
LONGER = 3  # times the runs of the design that there is for arriving at a reference: a start may be far, a limit slow
UNKNOWN = 0.1  # share of steps outside the data above which the verdict is "cannot say"


def check_controller(
    path: str | Path,
    folder: str | Path,
    *,
    runs: int = 12,
    faults: bool = False,
    new: Episodes | None = None,
    rate: float = 0.05,
    on_plant: Episodes | None = None,
    progress: StageProgress | None = None,
) -> Checked:
    """Run a saved design on its surrogates from random starts, in every kind of run, and judge the results.

    The goal is kept if all of these conditions hold:

    - In all runs, those with faults too, every input that the controller asks for is inside its limits.
    - No run without faults is lost, and every step of these has a good status.
    - No run without faults violates a limit by more than 1 % of its range; 5 % with three times the noise, or with
      inputs 20 % off.
    - The first step, and 99 % of the others, take less than dt.
    - Where inputs and noise are as in the data, a constant reference is reached to 5 % of the data's range in all runs;
      in one run at least where no input holds it. Runs with other noise or inputs that miss it are named.

    Then as many runs start anywhere in the range of the goal, which is what its limits and the ranges of the signals
    allow, on the nearest rows of the logs. One that is lost or violates a limit by more than 5 % counts against the
    goal if it started where there are data. If it started outside of them, or if more than 10 % of the steps of these
    runs are outside, the verdict is "cannot say".

    A goal says nothing of broken sensors, actuators and solvers. Runs that are lost under them, and limits violated by
    more than 5 %, are listed separately; they count if `faults` is true. The surrogates are learned from the same logs
    as the controller, and may share its errors.

    `runs` is the number of runs of each kind, and `rate` the wished bound on the share of loops that break a limit or
    are lost, which says how many fresh loops are run. `new` logs of the plant say whether it has changed since the
    design, and `on_plant` are logged runs of this controller on its plant, each an episode. `progress` is called with
    what is done, how many of it are, and how many there are.
    """
    saved, draw, runs = read_controller(path), np.random.default_rng(0), checks.count(runs, "runs")
    if not isinstance(saved, SavedDesign):
        raise LogError(
            f"{path} holds a controller without the evidence that a check needs; pass what `koopmpc fit --goal` or the "
            "save of a km.design wrote"
        )
    evidence = saved.evidence
    controller = rebuild_controller(saved, path)
    asked = evidence.task
    controller.reset(asked.starts[0])
    start = perf_counter()
    controller(asked.starts[0], asked.reference[: controller.horizon + 1])
    cold = perf_counter() - start
    every = kinds(asked.horizon, bounded=bool(np.isfinite(asked.limits.inputs(controller.nu)).all()))
    bench, figures = _TestBench(evidence, controller), list[Figures]()
    done, total = 0, runs * len(every)
    picked = draw.integers(len(asked.first_states), size=runs)
    for kind in every:
        outcomes: list[_Outcome] = []
        for j in range(runs):
            outcomes.append(bench.run(kind, asked.first_states[picked[j]], j))
            done += 1
            if progress is not None:
                progress(kind.name, done, total)
        figures.append(_figures(kind, outcomes))
    hot = float(np.quantile(bench.times, 0.99)) if bench.times else np.inf
    reasons, broken = _reasons(evidence, figures, cold, hot, controller.dt)
    reasons += broken if faults else []
    lost_inside, doubts = bench.run_anywhere(runs, draw)
    reasons += lost_inside
    compared = None
    if new is not None:
        kept_kinds = [one.kind.name for one in figures if not _reasons(evidence, [one], cold, hot, controller.dt)[0]]
        compared = compare_logs(evidence.logs, get_model(controller).align(new), kept_kinds)
        reasons += [compared.sentence] if compared.holds is False else []
        doubts += [compared.sentence] if compared.holds is None else []
    controller.reset()
    told = None if progress is None else partial(progress, "fresh loops")
    verdict = judge_rate(evidence, controller, rate, draw, told)
    plant = None if on_plant is None else judge_plant_runs(evidence, controller, on_plant)
    result = Checked(
        kept=not (reasons or doubts),
        reasons=tuple(reasons),
        broken=tuple(broken),
        figures=tuple(figures),
        cold=cold,
        hot=hot,
        dt=controller.dt,
        page=Path(folder, "report.html"),
        doubts=tuple(doubts),
        compared=compared,
        rate=verdict,
        plant=plant,
        remarks=tuple(_list_remarks(evidence, figures)),
        cost_steps=asked.steps,
        wished=rate,
    )
    _write_page(result, path, saved, controller)
    return result


@dataclass(frozen=True)
class _Outcome:
    cost: float
    violation: float
    error: float
    statuses: Counter[str]
    outside: int


class _StepWatch:
    """An observer that records status and time of each step, and how often the input is outside its limits."""

    def __init__(self, times: list[float], inputs: Interval) -> None:
        self._times, self._inputs, self.outside, self.statuses = times, inputs, 0, Counter[str]()

    def __call__(self, step: Step) -> None:
        """Record a step."""
        if (move := step.move) is not None:
            low, high = self._inputs
            self.statuses[move.status.name] += 1
            self._times.append(move.solve_time)
            self.outside += not bool(((move.u >= low) & (move.u <= high)).all())


class _TestBench:
    """The surrogates of a design as plants, with the inputs that hold the reference on each, built when first used."""

    def __init__(self, evidence: Evidence, controller: AnyMPC) -> None:
        self._evidence, self._controller, self.times = evidence, controller, list[float]()
        asked = evidence.task
        self._steps = asked.steps
        self._reference = read_reference(asked, 0, asked.steps + 1 + controller.horizon)
        if not asked.moves:
            self._steps *= LONGER
            self._reference = np.repeat(self._reference[:1], self._steps + 1, axis=0)
        self._plants: dict[tuple[int, float], tuple[StepMap, Float[np.ndarray, "T nu"]]] = {}

    def run(self, kind: RunKind, first: Float[np.ndarray, " n"], seed: int) -> _Outcome:
        """Run the controller from a state, and return what `metrics` says of the run."""
        evidence, asked, place = self._evidence, self._evidence.task, seed % len(self._evidence.surrogates)
        surrogate, key = evidence.surrogates[place], (place, kind.gain)
        if key not in self._plants:
            inputs = surrogate.find_reference_inputs(
                asked.cost, asked.limits, self._reference[: self._steps], kind.gain
            )
            self._plants[key] = surrogate.plant(kind.gain), inputs
        plant, inputs = self._plants[key]
        watch = _StepWatch(self.times, asked.limits.inputs(self._controller.nu))
        run = run_on_surrogate(
            asked,
            surrogate,
            Fenced(plant, evidence.low, evidence.high),
            self._controller,
            first,
            reference=self._reference,
            u_reference=inputs,
            options=LoopOptions(noise=kind.noise * surrogate.noise, faults=kind.faults, rng=seed),
            observers=[watch],
        )
        if run is None:
            return _Outcome(np.inf, np.inf, np.inf, watch.statuses, watch.outside)
        of, error = asked.cost.of.bind(run.states), tracking_error(run)
        size = np.abs(np.diff(of(np.array([asked.low, asked.high])), axis=0))[0]
        last = np.abs(error[-max(len(error) // 10, 1) :]) / np.where(size > 0, size, 1.0)
        weighed = np.diag(asked.cost.matrices(of.nz, run.U.shape[1])[0]) > 0
        return _Outcome(
            cost=total_cost(run.take_first(asked.steps)),
            violation=float(violation_shares(run, asked.limit_sizes).max()),
            error=float(last[:, weighed].max(initial=0.0)),
            statuses=watch.statuses,
            outside=watch.outside,
        )

    def run_anywhere(self, runs: int, rng: np.random.Generator) -> tuple[list[str], list[str]]:
        """Return reasons and doubts of runs that start anywhere in the range of the goal."""
        neighbours, evidence = self._evidence.neighbours, self._evidence
        if neighbours is None:
            return [], []
        asked, u_reference = evidence.task, self._plants[0, 1.0][1] if (0, 1.0) in self._plants else None
        if u_reference is None:
            u_reference = evidence.surrogates[0].find_reference_inputs(
                asked.cost, asked.limits, self._reference[: self._steps]
            )
        low, high = goal_box(asked)
        starts = low + (high - low) * rng.uniform(size=(runs, len(low)))
        bad_inside, bad_outside, unknown = 0, 0, 0.0
        for j, x0 in enumerate(starts):
            run = run_on_surrogate(
                asked,
                neighbours,
                Fenced(neighbours.draw(rng), evidence.low, evidence.high),
                self._controller,
                x0,
                reference=self._reference,
                u_reference=u_reference,
                options=LoopOptions(noise=neighbours.noise, rng=j),
            )
            known = not neighbours.find_outside(neighbours.start(x0)[None], neighbours.middle[None])[0]
            bad = run is None or bool(violation_shares(run, asked.limit_sizes)[len(run.X) // 2 :].max() > ALLOWED_OFF)
            bad_inside, bad_outside = bad_inside + (bad and known), bad_outside + (bad and not known)
            if run is not None and neighbours.embedding is None:
                unknown += float(neighbours.find_outside(run.X[:-1], run.U).mean()) / runs
        reasons, doubts = list[str](), list[str]()
        what = "are lost, or still violate a limit in their second half"
        if bad_inside:
            reasons.append(
                f"from the goal's range: {bad_inside} of {runs} runs {what}, and started where there are data"
            )
        if bad_outside:
            doubts.append(
                f"from the goal's range: {bad_outside} of {runs} runs {what}, and started where no log has been: "
                "record episodes that start there, or never start there"
            )
        if unknown > UNKNOWN:
            doubts.append(
                f"from the goal's range: {to_percent(unknown)} of the steps have no data around them: record episodes "
                "there, or narrow the limits of the goal to where it will be used"
            )
        return reasons, doubts


def _figures(kind: RunKind, outcomes: Sequence[_Outcome]) -> Figures:
    ended = [one for one in outcomes if np.isfinite(one.cost)]
    statuses = sum((one.statuses for one in outcomes), Counter[str]())
    good = {status.name for status in _GOOD}
    return Figures(
        kind=kind,
        runs=len(outcomes),
        lost=len(outcomes) - len(ended),
        cost=float(np.median([one.cost for one in ended])) if ended else np.inf,
        violation=max((one.violation for one in ended), default=np.inf),
        error=max((one.error for one in ended), default=np.inf),
        closest=min((one.error for one in ended), default=np.inf),
        statuses=tuple(sorted(statuses.items())),
        bad=sum(count for name, count in statuses.items() if name not in good),
        outside=sum(one.outside for one in outcomes),
    )


def _reasons(
    evidence: Evidence, figures: Sequence[Figures], cold: float, hot: float, dt: float
) -> tuple[list[str], list[str]]:
    """Return why the goal is not kept, and what happened in runs with faults, in sentences."""
    said, broken = list[str](), list[str]()
    for one in figures:
        name, counted = one.kind.name, broken if one.kind.faults else said
        if one.lost:
            counted.append(f"{name}: {one.lost} of {one.runs} runs left the data, or their states became NaN")
        if one.lost < one.runs and one.violation > one.kind.allowed:
            much, allowed = to_percent(one.violation), to_percent(one.kind.allowed)
            counted.append(f"{name}: a limit is violated by {much} of its range, {allowed} are allowed")
        if one.outside:
            said.append(f"{name}: {one.outside} inputs were outside their limits")
        if one.bad and not one.kind.faults:
            told = ", ".join(f"{count} {status}" for status, count in one.statuses)
            said.append(f"{name}: {one.bad} steps had no good status: {told}")
    said += _explain_arrival(evidence, figures[0])
    for what, taken in (("the first step", cold), ("one step in a hundred", hot)):
        if taken > dt:
            said.append(f"{what} takes {format_duration(taken)} or more, and dt is {format_duration(dt)}")
    return said, broken


def _explain_arrival(evidence: Evidence, one: Figures) -> list[str]:
    """Return why a constant reference is not reached; one that no input holds must be missed by every run."""
    off = one.error if evidence.goal_can_be_held else one.closest
    if evidence.task.moves or one.lost == one.runs or off <= ARRIVED:
        return []
    if evidence.goal_can_be_held:
        return [f"{_say_off(one)}, {to_percent(ARRIVED)} are allowed"]
    return [
        f"{one.kind.name}: every run ends {to_percent(off)} of the data's range or more off its reference, "
        f"{to_percent(ARRIVED)} are allowed",
        *explain_unreachable(evidence.surrogates[0], evidence.task),
    ]


def _list_remarks(evidence: Evidence, figures: Sequence[Figures]) -> list[str]:
    """Return which runs end off a reference that can be held, where noise or inputs, and nothing else, differ."""
    return [
        f"{_say_off(one)}; this does not count, since noise or inputs differ from the data"
        for one in figures[1:]
        if evidence.goal_can_be_held and not one.kind.faults and one.lost < one.runs and one.error > ARRIVED
    ]


def _say_off(one: Figures) -> str:
    return f"{one.kind.name}: a run ends {to_percent(one.error)} of the data's range off its reference"


def _write_page(result: Checked, path: str | Path, saved: SavedDesign, controller: AnyMPC) -> None:
    """Write the report of the design with the verdict of the check on top."""

    def add_verdict(page: Page) -> None:
        kind = {"kept": "good", "not kept": "bad", "cannot say": "doubt"}[result.verdict]
        reasons = [*result.reasons, *result.doubts, *result.remarks] or ["Nothing speaks against it."]
        page.verdict(kind, f"{_VERDICTS[result.verdict].capitalize()}.", *reasons)

    def add_tested(page: Page) -> None:
        page.heading("What was tested")
        page.text(
            f"{len(result.figures)} kinds of runs on {len(saved.evidence.surrogates)} models that were learned from "
            "its logs. An error that all of these models share does not show in these runs."
        )
        headings = [heading.replace("\n", " ") for heading in _list_headings(result.cost_steps)]
        page.table(["kind of run", *headings], map(_row, result.figures))
        page.text(_explain_cost(result))
        if result.rate is not None:
            page.heading("How often it fails", 3)
            page.text(f"Said before the loops: {plan_verdict(result.wished)}.")
            plant = [] if result.plant is None else result.plant.list_sentences()
            page.items([*result.rate.list_sentences(), *plant])
        page.heading("With faults", 3)
        if set(result.broken) - set(result.reasons):
            page.text("A goal says nothing of what breaks, so this does not count. koopmpc check --faults counts it.")
        nothing = f"no run was lost, and no limit violated by more than {to_percent(ALLOWED_OFF)} of its range"
        page.items(result.broken or [nothing])
        page.heading("How steps ended", 3)
        statuses = [[f.kind.name, ", ".join(f"{n} {name}" for name, n in f.statuses)] for f in result.figures]
        page.table(["kind of run", "steps"], statuses, words=True)
        page.heading("Times", 3)
        cold, hot = format_duration(result.cold), format_duration(result.hot)
        page.items(
            [
                f"the first step of a fresh controller: {cold}",
                f"99 % of all others: at most {hot}; dt is {result.dt:g} s",
            ]
        )

    file = Path(path).as_posix()
    write_design_report(saved, controller, result.page, file, verdict=add_verdict, tested=add_tested)
