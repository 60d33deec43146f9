"""What goes into a solver and what comes out: a QP, the QP of a control step, and a solution."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Softness
from koopmpc.control.move import Status

INFINITY = 1e30  # what OSQP and DAQP take for no limit


@dataclass(frozen=True)
class QP:
    """½ vᵀP v + qᵀv → min, low ≤ A v ≤ high; P ⪰ 0 dense, ±inf where there is no limit.

    Where there is a `softness`, a row whose linear price is finite may be broken by ε ≥ 0 at linear ε + quadratic ε².
    A solver that is not `exact` keeps such rows, too; its answer is that of the QP where no multiplier is above the
    linear price.
    """

    P: Float[np.ndarray, "n n"]
    q: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    softness: Softness | None = None


@dataclass(frozen=True, kw_only=True)
class StepQP(QP):
    """½ wᵀH w + Σ (linear ε + quadratic ε²) → min over w, low ≤ s (p + D w) ≤ high for a plan p.

    It is the cost unit · wᵀH w, and the price of slacks, divided by 2 unit. The rows limit the entries `source` of the
    plan times `scale`: their limits move by that product. `shift_primal` and `shift_dual` tell where the next stage's
    entry stands; one past the end stands for zero. The `allowance` of a soft row is in the unit of its limit.
    `rate_rows` limit the first change of the inputs `rate_inputs`, hard.
    """

    softness: Softness = field(kw_only=True)
    source: Int[np.ndarray, " m"]
    scale: Float[np.ndarray, " m"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]
    rate_rows: Int[np.ndarray, " r"]
    rate_inputs: Int[np.ndarray, " r"]


@dataclass(slots=True)
class QPSolution:
    """Minimiser v, multipliers y of low ≤ A v ≤ high (positive at the upper end), how the solve ended, and in whom."""

    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]
    status: Status
    iterations: int
    solver: str
