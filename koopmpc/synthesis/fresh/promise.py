"""CoveragePromise: the share of loops on stand-ins that keep their limits, as a design promises it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from koopmpc.text import to_percent
from koopmpc.validate.binomial import bound_failure_rate
from koopmpc.values import Value

REFUTED = 0.05  # the promise is refuted if so many failures on fresh loops are less probable than this


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
        if not self.failures:
            return False
        return bool(betainc(self.failures, self.verified_on - self.failures + 1, 1 - self.coverage) < REFUTED)

    @property
    def failure_bound(self) -> float:
        """Exact upper bound, at 95 %, of the probability that a loop drawn like these fails."""
        return bound_failure_rate(self.failures, self.verified_on)

    def __str__(self) -> str:
        """Return the promise, or why there is none."""
        share = to_percent(self.coverage)
        length = f" for {self.steps} steps" if self.steps else ""
        how = "without a margin" if self.shape == "none" else f"with a {self.shape} margin of {self.scale:.3g} tubes"
        seen = (
            f"{self.failures} of {self.verified_on} loops that took no part in the choice failed, so that at most "
            f"{to_percent(self.failure_bound)} of loops do, with 95 % confidence"
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
