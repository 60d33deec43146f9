"""Checked: the result of a check, with the figures of each kind of run."""

from dataclasses import dataclass
from pathlib import Path

from koopmpc.apps.fitting.changed import ComparedLogs
from koopmpc.apps.fitting.report import OFF
from koopmpc.base.terminal import build_table, render_text
from koopmpc.base.text import format_duration, to_percent
from koopmpc.control.move import Status
from koopmpc.loop.faults import ActuatorLoss, DroppedSamples, Fault, FrozenSensor, NaNSensor, SensorDelay, SolverFailure
from koopmpc.synthesis.rates import LoopRate

ALLOWED = 0.01  # allowed violation, as a share of the range, in runs as in the data
ALLOWED_OFF = 0.05  # the same where noise or inputs differ from the data
LOUD = 3.0  # noise is this many times that of the data
_GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)


@dataclass(frozen=True)
class RunKind:
    """A kind of run: how inputs and noise differ from the data, what breaks, and which violation is allowed."""

    name: str
    gain: float = 1.0
    noise: float = 1.0
    faults: tuple[Fault, ...] = ()
    allowed: float = ALLOWED_OFF


def kinds(horizon: int, *, bounded: bool) -> list[RunKind]:
    """Return the kinds of runs; faults last for half of a horizon. Actuators are broken where inputs have limits."""
    begin, end = horizon // 4, horizon // 4 + max(horizon // 2, 1)
    broken: dict[str, Fault] = {
        "sensor frozen": FrozenSensor(begin=begin, end=end),
        "sensor NaN": NaNSensor(begin=begin, end=end),
        "half of the samples dropped": DroppedSamples(0.5, begin=begin, end=end),
        "measurements a step late": SensorDelay(1),
        "half of the solves fail": SolverFailure(0.5, begin=begin, end=end),
    }
    if bounded:
        broken["inputs lose 30 %"] = ActuatorLoss(0.3, begin=begin, end=end)
    return [
        RunKind("as in the data", allowed=ALLOWED),
        RunKind(f"noise × {LOUD:g}", noise=LOUD),
        RunKind("inputs 20 % weaker", gain=1 - OFF),
        RunKind("inputs 20 % stronger", gain=1 + OFF),
        *(RunKind(name, faults=(fault,)) for name, fault in broken.items()),
    ]


@dataclass(frozen=True)
class Figures:
    """The result of the runs of a kind.

    `lost` of `runs` left the data, or their states became NaN or infinite. `violation` is the worst one, as a share of
    the range; `error` is the largest over the last tenth of a run, as a share of the data's range, and `closest`
    that of the run that ends nearest to the reference. `bad` counts steps without a good status, `outside` those whose
    input is NaN or beyond a limit.
    """

    kind: RunKind
    runs: int
    lost: int
    cost: float
    violation: float
    error: float
    closest: float
    statuses: tuple[tuple[str, int], ...]
    bad: int
    outside: int


@dataclass(frozen=True)
class Checked:
    """The verdict, with the figures of each kind of run; `print` shows it."""

    kept: bool  # the goal is kept, and known to be
    reasons: tuple[str, ...]  # why it is not kept
    broken: tuple[str, ...]  # what happened in runs with faults; among the reasons too, where these are asked to count
    figures: tuple[Figures, ...]  # what was measured in each kind of run
    cold: float  # time of the first step of a fresh controller [s]
    hot: float  # 99 % quantile of the times of all others [s]
    dt: float  # sampling time [s]
    page: Path  # the report
    doubts: tuple[str, ...] = ()  # where nobody can say whether it is kept, for there are no data
    compared: ComparedLogs | None = None  # what new logs say, where they are given
    rate: LoopRate | None = None  # exact bound on the share of fresh loops that break a limit or are lost
    plant: LoopRate | None = None  # the rate of logged runs on the plant, where the caller has some
    remarks: tuple[str, ...] = ()  # which runs end off the reference with other noise or inputs; they do not count
    cost_steps: int = 0  # a cost is the sum over so many steps, the first of a run
    wished: float = 0.05  # the bound that the number of fresh loops was chosen for

    @property
    def verdict(self) -> str:
        """One of three values: "kept", "not kept", "cannot say"."""
        return "not kept" if self.reasons else "cannot say" if self.doubts else "kept"

    def __str__(self) -> str:
        """Return the verdict and a line for each kind of run."""
        verdict = _VERDICTS[self.verdict]
        rows = [_row(one) for one in self.figures]
        hot, cold, dt = map(format_duration, (self.hot, self.cold, self.dt))
        times = f"a step takes {hot} (99 %), the first one {cold}; dt is {dt}"
        aside = [f"- {one}" for one in self.broken if one not in self.reasons]
        aside = ["with faults, which do not count (--faults counts them):", *aside] if aside else []
        reasons = [f"- {reason}" for reason in (*self.reasons, *self.doubts, *self.remarks)]
        if self.compared is not None and self.compared.holds:
            aside = [*aside, f"new logs: {self.compared.sentence}"]
        verdicts = [each for each in (self.rate, self.plant) if each is not None]
        bound = ["", *(f"- {sentence}" for each in verdicts for sentence in each.list_sentences())]
        table = build_table(("kind of run", *_list_headings(self.cost_steps)), rows)
        return render_text(verdict, *reasons, *aside, "", table, "", _explain_cost(self), times, *bound)


_VERDICTS = {
    "kept": "the goal is kept",
    "not kept": "THE GOAL IS NOT KEPT",
    "cannot say": "NOBODY CAN SAY WHETHER THE GOAL IS KEPT: the logs do not show it",
}


def _explain_cost(checked: Checked) -> str:
    steps, figures = checked.cost_steps, checked.figures
    return (
        f"A cost is the sum over the first {steps} steps ({format_duration(steps * checked.dt)}) of a run. That of the "
        "design is over as many, from other starts and on other stand-ins. Of a run of your own, compare the first "
        f"{steps} steps: km.metrics(run.take_first({steps})).cost."
        + " A step whose measurement is missing has no good status, too."
        * any(f.bad and f.kind.faults for f in figures)
    )


def _list_headings(steps: int) -> list[str]:
    cost = f"median cost,\n{steps} steps"
    return ["lost", cost, "worst\nviolation", "error\nat the end", "steps without\na good status"]


def _row(one: Figures) -> list[str]:
    lost = f"{one.lost} of {one.runs}"
    numbers = [f"{one.cost:.4g}", to_percent(one.violation), to_percent(one.error)]
    return [one.kind.name, lost, *(numbers if one.lost < one.runs else ["-"] * 3), str(one.bad)]
