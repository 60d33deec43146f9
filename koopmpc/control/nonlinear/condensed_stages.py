"""The quadratic program of all stages in condensed form, in coordinates in which its Hessian is the identity.

Its variables w are defined by δx = δx_free + x̃ and δu_k = δu_free,k − K_k x̃_k + L_k⁻ᵀ w_k, where
S_k = R + BᵀP_{k+1}B = L_k L_kᵀ. The cost is that of the program without limits plus ½ ‖w‖².
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.errors import DefinitenessError
from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.riccati import Stage, step
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import QP

FINISHED = 150  # about as many interior-point steps take as long as an active-set method


class Stages(NamedTuple):
    """What the program consists of: x̃_{k+1} = A_k x̃_k + B_k ũ_k from x̃_0 = 0, weights, and G of the limited outputs.

    CasADi writes matrices by columns, so that A[k], B[k] and G[k] are the transposed ones.
    """

    A: Float[np.ndarray, "N nx nx"]
    B: Float[np.ndarray, "N nu nx"]
    Q: Float[np.ndarray, "N nx nx"]
    R: Float[np.ndarray, "N nu nu"]
    G: Float[np.ndarray, "N nx ng"]
    free: Bool[np.ndarray, " N"]


class Deviation(NamedTuple):
    """What is added to the solution without limits, δX and δU; multipliers of the rows, and how DAQP ended."""

    X: Float[np.ndarray, "N nx"]
    U: Float[np.ndarray, "N nu"]
    multipliers: Float[np.ndarray, " m"]
    status: Status
    iterations: int


class StageStep(NamedTuple):
    """The step (δX, δU), how far each soft limit gave way, how the solver ended, and after how many iterations."""

    X: Float[np.ndarray, "N nx"]
    U: Float[np.ndarray, "N nu"]
    slacks: Float[np.ndarray, "N nsoft"]
    status: Status
    iterations: int
    finished: bool = False  # by an active-set method, whose iterations rounding decides

    @property
    def effort(self) -> int:
        """What the program cost, in interior-point steps; rounding decides nothing of it."""
        return FINISHED if self.finished else self.iterations


@runtime_checkable
class SearchesLevels(Protocol):
    """What solves the program of the stages with inputs on levels."""

    def solve(
        self,
        stages: Stages,
        free: Float[np.ndarray, "N nq"],
        limits: Interval,
        softness: Softness,
        deadline: float,
    ) -> Deviation | None:
        """Return the least deviation from the solution without limits; None where it has no digits left."""
        ...


def condense_stages(
    stages: Stages,
) -> tuple[Float[np.ndarray, "N1 nx n"], Float[np.ndarray, "N nu n"], Float[np.ndarray, "N nq n"]] | None:
    """Return x̃_k, ũ_k and [ũ_k; G_k x̃_{k+1}] as matrices on w; None where the recursion has no digits left."""
    A, B, Q, R, G, free = stages
    N, nu, nx = len(B), B.shape[1], B.shape[2]
    K, spread = np.zeros((N, nu, nx)), np.zeros((N, nu, nu))
    P, nothing = Q[-1], np.zeros((nx, nx))
    for k in reversed(range(N)):
        weight = Q[k - 1] if k else nothing  # of x̃_k; that of x̃_N is where P begins
        if not free[k]:
            P = weight + A[k] @ P @ A[k].T
            continue
        try:
            K[k], L, P = step(Stage(A[k].T, B[k].T, weight, None, R[k]), P)
        except (DefinitenessError, np.linalg.LinAlgError):
            return None
        spread[k] = np.linalg.inv(L).T
    at = np.cumsum(free) - free
    n = nu * np.count_nonzero(free)
    X, U = np.zeros((N + 1, nx, n)), np.zeros((N, nu, n))
    for k in range(N):
        if free[k]:
            U[k] = -K[k] @ X[k]
            U[k][:, nu * at[k] : nu * at[k] + nu] += spread[k]
        X[k + 1] = A[k].T @ X[k] + B[k].T @ U[k]
    rows = np.concatenate([U, G.transpose(0, 2, 1) @ X[1:]], axis=1)
    return X, U, rows


def least_deviation(
    stages: Stages,
    room: Interval,
    softness: Softness,
    multipliers: Float[np.ndarray, " m"] | None,
    seconds: float,
) -> Deviation | None:
    """Return the least deviation within `room`, the limits of [ũ_k; G_k x̃_{k+1}] of each stage (N, nu + ng).

    A row costs linear ε + quadratic ε² where it gives way by ε. DAQP starts from the rows that
    these multipliers push to, and has so many seconds. Returns None where the recursion has no digits left.
    """
    condensed = condense_stages(stages)
    if condensed is None:
        return None
    X, U, rows = condensed
    (N, nu, n), free = U.shape, stages.free
    low, high = room
    kept = np.isfinite(low) | np.isfinite(high)
    kept[~free, :nu] = False
    if not np.isfinite(rows).all():
        return None
    linear, quadratic, allowance = (np.tile(part, (N, 1))[kept] for part in softness)
    none = np.zeros((n,))
    qp = QP(np.eye(n), none, rows[kept], low[kept], high[kept], Softness(linear, quadratic, allowance))
    y = np.zeros(len(linear)) if multipliers is None else multipliers
    found = FINISHER(qp).solve(none, y, seconds if np.isfinite(seconds) else None)
    return Deviation(X[1:] @ found.v, U @ found.v, found.y, found.status, found.iterations)
