"""FreshLoops: loops of a designed controller from starts that took no part in its choice, and bounds of them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.values import Value

SURE = 0.95  # confidence of one-sided bounds
INSIDE = 0.9  # share of loops whose cost lies inside the two-sided interval


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
