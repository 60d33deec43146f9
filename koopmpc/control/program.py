"""The QP of one step: deviations w from the unconstrained plan, slacks ε of soft rows, limits that move with z."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Box
from koopmpc.control.solvers.base import QP


@dataclass(frozen=True)
class Program:
    """½‖w‖² + Σ (linear ε + quadratic ε²)/(2 unit) → min over [w (N, nu); ε (N, ng)], low ≤ v + D w ≤ high.

    It is the cost unit ‖w‖² + Σ (linear ε + quadratic ε²), divided by 2 unit.

    Soft rows are relaxed by their ε ≥ 0. The first rows of the QP limit the entries `source` of v: their bounds
    are `low` and `high` less that entry; the rest are ε ≥ 0. `shift_primal` and `shift_dual` tell where the next
    stage's entry stands; one past the end stands for zero, for a plan ends unconstrained.
    """

    qp: QP
    source: Int[np.ndarray, " m1"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]


def program(
    deviation: Float[np.ndarray, "nv nw"],
    inputs: Box,
    outputs: Box,
    N: int,
    slack: tuple[float, float] | None,
    unit: float,
) -> Program:
    """Return the QP of a horizon of N steps for v = [u_0 … u_{N−1}, g_1 … g_N] and its deviation map D."""
    nu, ng = len(inputs.low), len(outputs.low)
    nw = N * nu
    ns = 0 if slack is None else N * ng

    def entries(first: int, size: int, picked: Int[np.ndarray, " p"]) -> Int[np.ndarray, " Np"]:
        return (first + size * np.arange(N)[:, None] + picked).ravel()

    limited = entries(0, nu, np.flatnonzero(np.isfinite(inputs.low) | np.isfinite(inputs.high)))
    v_low = np.concatenate([np.tile(inputs.low, N), np.tile(outputs.low, N)])
    v_high = np.concatenate([np.tile(inputs.high, N), np.tile(outputs.high, N)])
    if ns:
        upper = entries(nw, ng, np.flatnonzero(np.isfinite(outputs.high)))
        lower = entries(nw, ng, np.flatnonzero(np.isfinite(outputs.low)))
        blocks = [limited, upper, lower]
        low = [v_low[limited], np.full(len(upper), -np.inf), v_low[lower], np.zeros(ns)]
        high = [v_high[limited], v_high[upper], np.full(len(lower), np.inf), np.full(ns, np.inf)]
    else:
        blocks = [limited, entries(nw, ng, np.arange(ng))]
        low, high = [v_low[block] for block in blocks], [v_high[block] for block in blocks]

    source = np.concatenate(blocks)
    A = np.zeros((len(source) + ns, nw + ns))
    A[: len(source), :nw] = deviation[source]
    P, q = np.eye(nw + ns), np.zeros(nw + ns)
    counts = [len(block) // N for block in blocks]
    if slack is not None and ns:
        first = len(limited)
        for block, sign in zip(blocks[1:], (-1.0, 1.0), strict=True):  # ε of entry nw + i is variable nw + i
            A[first + np.arange(len(block)), block] = sign
            first += len(block)
        A[len(source) :, nw:] = np.eye(ns)
        P[nw:, nw:] *= slack[1] / unit
        q[nw:] = slack[0] / (2 * unit)
        counts.append(ng)
    lows, highs = np.concatenate(low), np.concatenate(high)
    return Program(
        QP(P, q, A, lows, highs),
        source,
        lows,
        highs,
        _next_stage([nu, ng] if ns else [nu], N),
        _next_stage(counts, N),
    )


def _next_stage(counts: Sequence[int], N: int) -> Int[np.ndarray, " m"]:
    """Return the places of the next stage for blocks of N stages with `counts` entries a stage."""
    end = N * sum(counts)
    places: list[Int[np.ndarray, " p"]] = []
    start = 0
    for count in counts:
        block = start + count + np.arange(N * count)
        block[(N - 1) * count :] = end
        places.append(block)
        start += N * count
    return np.concatenate(places)
