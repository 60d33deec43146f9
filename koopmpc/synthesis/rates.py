"""What a design expects and promises of loops on surrogates: rates of failure with their bounds, costs, violations."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from koopmpc.base.terminal import label_lines, render_text
from koopmpc.base.text import to_percent
from koopmpc.base.values import Value
from koopmpc.validate.binomial import bound_failure_rate

KEPT = 0.01  # a loop keeps its limits if it violates none by more than this share of its range
SHIFT = 0.05  # a fresh start is a start of the task moved by up to this share of the data's range
SURE = 0.95  # confidence of one-sided bounds
INSIDE = 0.9  # share of loops whose cost lies inside the two-sided interval


@dataclass(frozen=True)
class LoopRate:
    """How many of some independent loops, or logged runs on the plant, failed, and what that says of others like them.

    Attributes
    ----------
    runs, broken, lost
        Number of runs, of those that broke a limit by more than 1 % of its range, and of those that were lost.
    on_rows
        How many of them were on nearest neighbours of the logged rows; the others were on learned models.
    own
        On the plant: share of the logged inputs that the controller asks for in the logged states; None elsewhere.
    """

    runs: int
    broken: int
    lost: int = 0
    on_rows: int = 0
    own: float | None = None

    @property
    def failures(self) -> int:
        """How many runs broke a limit or were lost."""
        return self.broken + self.lost

    @property
    def failure_bound(self) -> float:
        """Exact upper bound, at 95 %, of the probability that a run drawn like these fails (Clopper and Pearson)."""
        return bound_failure_rate(self.failures, self.runs, confidence=SURE)

    @property
    def next_fails(self) -> float:
        """(k + 1) / (n + 1): at most so probably the next run fails, on average over starts and sets of runs."""
        return (self.failures + 1) / (self.runs + 1)

    def refutes(self, share: float) -> bool:
        """Return whether so many failures have a probability below 5 % if this share of runs keeps the limits."""
        n, k = self.runs, self.failures
        return bool(k and betainc(k, n - k + 1, 1 - share) < 1 - SURE)

    def list_sentences(self) -> list[str]:
        """Return what was found, on what, and what that is worth."""
        sure, bound = to_percent(SURE), to_percent(self.failure_bound)
        if self.own is not None:
            return [
                f"on the plant {self.failures} of {self.runs} logged runs broke a limit by more than "
                f"{to_percent(KEPT)} of its range: with {sure} confidence at most {bound} of runs drawn like these do",
                f"the next run from a start drawn like theirs keeps its limits with a probability of "
                f"{to_percent(1 - self.next_fails)} or more, on average over starts; {sure} needs "
                f"{round(1 / (1 - SURE)) - 1} runs without a failure",
            ]
        return [
            f"{self.broken} of {self.runs} fresh loops broke a limit by more than {to_percent(KEPT)} of its range and "
            f"{self.lost} were lost: with {sure} confidence at most {bound} of loops drawn like these do either",
            f"each loop drew a start of the design moved by up to {to_percent(SHIFT)} of the data's range, its noise, "
            f"and its stand-in: {self.on_rows} were on nearest neighbours of the logged rows, "
            f"{self.runs - self.on_rows} on models learned from them",
            "all stand-ins come from the same logs: where the logs are blind, so are they, and the bound does not hold "
            "for the plant",
        ]


@dataclass(frozen=True, eq=False)
class FreshLoops(Value):
    """Closed loops of the chosen controller, after the choice.

    Attributes
    ----------
    cost
        (loops,) cost of each; infinite where it was lost.
    violation
        (loops,) largest violation of a limit, as a share of its range; infinite where it was lost.
    outside
        (loops,) share of the steps that have no data around them.
    kinds
        (loops,) what stood in for the plant: "neighbours" or "models".
    corner_cost, corner_violation, corner_outside
        (corners,) the same of loops from the corners of the goal's range, which say nothing of a probability.
    outside_states
        (n, nx) states of the loops that have no data around them, at most 400.
    begun_outside
        Number of loops that begin outside the data.
    """

    cost: Float[np.ndarray, " loops"]
    violation: Float[np.ndarray, " loops"]
    outside: Float[np.ndarray, " loops"]
    kinds: tuple[str, ...]
    corner_cost: Float[np.ndarray, " corners"]
    corner_violation: Float[np.ndarray, " corners"]
    corner_outside: Float[np.ndarray, " corners"]
    outside_states: Float[np.ndarray, "n nx"]
    begun_outside: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Number of loops of each kind."""
        return {kind: self.kinds.count(kind) for kind in sorted(set(self.kinds))} | {"corners": len(self.corner_cost)}


def bound_value(values: Float[np.ndarray, " n"], sure: float = SURE) -> float:
    """Return what the value of one more loop exceeds with a probability of at most 1 − sure, or the largest value.

    The ⌈(n + 1) sure⌉-th smallest value of n exchangeable loops has this property (Vovk, Gammerman & Shafer,
    "Algorithmic Learning in a Random World", 2005); fewer than sure / (1 − sure) loops have none, so their largest
    value is returned.
    """
    if not len(values):
        return float("inf")
    rank = min(int(np.ceil((len(values) + 1) * sure - 1e-9)), len(values))
    return float(np.sort(values)[rank - 1])


def cost_interval(values: Float[np.ndarray, " n"], inside: float = INSIDE) -> tuple[float, float]:
    """Return the two-sided interval that holds the cost of one more loop with this probability."""
    side = (1 + inside) / 2
    return -bound_value(-values, side), bound_value(values, side)


@dataclass(frozen=True, eq=False)
class CoveragePromise(Value):
    """What a design promises of loops on stand-ins drawn like its own, and how it was found.

    Attributes
    ----------
    coverage
        The wished share 1 − α of loops that keep their limits, none violated by more than 1 % of its range.
    shape
        "none" without a margin, "growing" with the tube along the plan, or "rigid" with its largest width at each step.
    scale
        Factor on the tube.
    margin
        (h, nx) margin of each state at step min(k, h) of a plan.
    chosen_from, chosen_failures
        Loops on which the factor was chosen, and how many of them failed with it.
    verified_on, failures
        Loops that took no part in the choice, run with the margin fixed, and how many of them failed.
    found
        Whether some margin gives the wished share on the loops of the choice.
    steps
        Length of a loop; what happens later is not promised. 0 where an older file does not say it.
    """

    coverage: float
    shape: str
    scale: float
    margin: Float[np.ndarray, "h nx"]
    chosen_from: int
    chosen_failures: int
    verified_on: int
    failures: int
    found: bool
    steps: int = 0

    @property
    def holds(self) -> bool:
        """Whether a margin was found, and the loops of the verification do not refute the promise."""
        return self.found and not self.is_refuted

    @property
    def is_refuted(self) -> bool:
        """Whether so many failures have a probability below 5 % if the promise is true."""
        return self.rate.refutes(self.coverage)

    @property
    def rate(self) -> LoopRate:
        """How many loops of the verification failed."""
        return LoopRate(self.verified_on, self.failures)

    def __str__(self) -> str:
        """Return the promise, or why there is none."""
        share = to_percent(self.coverage)
        length = f" for {self.steps} steps" if self.steps else ""
        how = "without a margin" if self.shape == "none" else f"with a {self.shape} margin of {self.scale:.3g} tubes"
        seen = (
            f"{self.failures} of {self.verified_on} loops that took no part in the choice failed, so that at most "
            f"{to_percent(self.rate.failure_bound)} of loops do, with 95 % confidence"
        )
        if not self.found:
            return (
                f"no margin keeps the limits in {share} of loops on stand-ins: {how}, the most that leaves room for "
                f"the reference, {self.chosen_failures} of {self.chosen_from} failed. {seen[0].upper()}{seen[1:]}"
            )
        if self.is_refuted:
            return f"{share} of loops on stand-ins is not promised {how}: {seen}"
        return (
            f"at least {share} of runs on stand-ins drawn like these keep their limits{length}, {how}: {seen}. It says "
            "nothing of the plant before `koopmpc check --on-plant` has seen enough of its runs"
        )


@dataclass(frozen=True, eq=False)
class ExpectedLoop(Value):
    """Expected closed loop of a design, from runs on surrogates that were fitted to data unknown to its model.

    The runs of `cost` and `cost_off` took part in the choice; those of `fresh` came after it, and the interval and the
    bounds are theirs. It is an estimate from data alone and no guarantee: no surrogate shows an error that all models
    share.

    Attributes
    ----------
    cost
        (runs,) cost of each run in which the inputs act as in the data; infinite where it was lost.
    cost_off
        (runs,) the same with inputs that act 20 % more or less.
    violation, violation_off
        (runs,) largest violation of a limit, as a share of its range.
    broken
        Share of all steps that violate a limit by more than 0.1 % of its range.
    starts
        (runs, nx) where the runs of `cost` began.
    surrogate
        (runs,) the surrogate of each run.
    steps
        Length of a run.
    fresh
        Loops after the choice; None where there are none.
    compared
        Number of loops of all finalists, in which the choice was confirmed or changed.
    """

    cost: Float[np.ndarray, " runs"]
    cost_off: Float[np.ndarray, " off"]
    violation: Float[np.ndarray, " runs"]
    violation_off: Float[np.ndarray, " off"]
    broken: float
    starts: Float[np.ndarray, "runs nx"]
    surrogate: tuple[int, ...]
    steps: int
    fresh: FreshLoops | None = None
    compared: int = 0

    @property
    def cost_interval(self) -> tuple[float, float]:
        """The interval that holds 90 % of the costs of loops like the fresh ones, lost ones infinite."""
        return cost_interval(self._judged_runs(self.cost, self.cost_off, "cost"))

    @property
    def violation_bound(self) -> float:
        """What the largest violation of a loop like the fresh ones exceeds in at most 5 % of them."""
        return bound_value(self._judged_runs(self.violation, self.violation_off, "violation"))

    @property
    def lost_bound(self) -> float:
        """Exact upper bound, at 95 %, of the probability that a loop like the fresh ones is lost."""
        cost = self._judged_runs(self.cost, self.cost_off, "cost")
        return LoopRate(len(cost), 0, int(np.sum(~np.isfinite(cost)))).failure_bound

    @property
    def loops(self) -> dict[str, int]:
        """Number of loops of each kind: those of the choice, and the fresh ones by what stood in for the plant."""
        chosen = {"choice": len(self.cost), "choice, inputs 20 % off": len(self.cost_off)}
        chosen |= {"finalists": self.compared} if self.compared else {}
        return chosen if self.fresh is None else chosen | self.fresh.counts

    def _judged_runs(
        self, near: Float[np.ndarray, " n"], off: Float[np.ndarray, " m"], name: str
    ) -> Float[np.ndarray, " loops"]:
        return np.concatenate([near, off]) if self.fresh is None else getattr(self.fresh, name)

    @property
    def lost(self) -> int:
        """How many of all runs were lost."""
        return int(np.sum(~np.isfinite(np.concatenate([self.cost, self.cost_off]))))

    def __str__(self) -> str:
        """Return what to expect in words."""
        pairs = [
            ("cost", _format_spread(self.cost)),
            ("with inputs 20 % off", _format_spread(self.cost_off)),
            (
                "largest violation",
                f"{_format_worst(self.violation)}; with inputs 20 % off {_format_worst(self.violation_off)}",
            ),
            ("steps that violate", f"{to_percent(self.broken)}, an estimate from held-out surrogates and no promise"),
            ("lost runs", f"{self.lost} of {len(self.cost) + len(self.cost_off)}"),
        ]
        if self.fresh is not None:
            low, high = self.cost_interval
            number, lost = len(self.fresh.cost), int(np.sum(~np.isfinite(self.fresh.cost)))
            corners = self.fresh.corner_cost
            kinds = ", ".join(f"{count} {_PLACES.get(kind, kind)}" for kind, count in self.loops.items())
            pairs += [
                ("fresh loops", f"{lost} of {number} lost: below {to_percent(self.lost_bound)} at 95 %"),
                ("cost in 90 %", f"{low:.4g} to {high:.4g}"),
                ("violation in 95 %", f"up to {to_percent(self.violation_bound)} of the range"),
                ("outside the data", f"{to_percent(float(self.fresh.outside.mean()))} of the steps"),
                ("corners", f"{int(np.sum(~np.isfinite(corners)))} of {len(corners)} lost"),
                ("loops", kinds),
            ]
        return render_text(label_lines(pairs))


_PLACES = {  # a kind of loops in `ExpectedLoop.loops`, as it is printed
    "choice": "in the choice",
    "choice, inputs 20 % off": "there with inputs 20 % off",
    "finalists": "of all finalists",
    "models": "fresh on learned models",
    "neighbours": "fresh on nearest rows of the logs",
    "corners": "from corners of the goal's range",
}


def _format_spread(values: Float[np.ndarray, " runs"]) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "every run was lost"
    return f"median {np.median(known):.4g}, from {known.min():.4g} to {known.max():.4g} over surrogates and starts"


def _format_worst(values: Float[np.ndarray, " runs"]) -> str:
    known = values[np.isfinite(values)]
    return f"{to_percent(known.max())} of the range" if known.size else "unknown"
