"""The quadratic program of all stages, condensed, in coordinates in which its Hessian is the identity.

Its variables w are defined by δx = δx_free + x̃ and δu_k = δu_free,k − K_k x̃_k + L_k⁻ᵀ w_k, where
S_k = R + BᵀP_{k+1}B = L_k L_kᵀ. The cost is that of the program without limits plus ½ ‖w‖².
"""

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.errors import DefinitenessError
from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.stages import StagedProblem
from koopmpc.control.riccati import Stage, step
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import QP, SolverTurn, StepQP
from koopmpc.control.solvers.levels import LevelSearch, LevelSolver
from koopmpc.plants.routines import Routine

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


class StageLevels:
    """The search over levels in the quadratic programs of a BilinearMPC.

    Parameters
    ----------
    search
        The levels, and those of the last plan.
    rated
        Whether v is the change of the inputs.
    """

    def __init__(self, search: LevelSearch, *, rated: bool) -> None:
        self.search, self._rated = search, rated
        self._solver: LevelSolver | None = None

    def solve(
        self,
        stages: Stages,
        free: Float[np.ndarray, "N nq"],
        limits: Interval,
        softness: Softness,
        deadline: float,
    ) -> Deviation | None:
        """Return the least deviation from the solution without limits; None where the recursion has no digits left.

        `free` are the values [U_k; g(X_{k+1})] of that solution, `limits` those of the same values.
        """
        condensed = condense_stages(stages)
        if condensed is None:
            return None
        X, U, rows = condensed
        nu, n = U.shape[1:]
        starts = np.flatnonzero(stages.free)
        first = nu if self._rated else 0
        mine = slice(first, first + nu)  # where u_k stands among the values of a stage
        kept = np.isfinite(limits.low) | np.isfinite(limits.high)
        kept[~stages.free, :nu] = False
        kept[:, mine] = False
        low = np.maximum.reduceat(limits.low[:, mine], starts, axis=0).ravel()
        high = np.minimum.reduceat(limits.high[:, mine], starts, axis=0).ravel()
        moves = np.isfinite(low) | np.isfinite(high)
        A = np.concatenate([rows[starts, mine].reshape(-1, n)[moves], rows[kept]])
        if not np.isfinite(A).all():
            return None
        none = np.zeros(nu * len(starts)), np.full(nu * len(starts), np.inf)
        prices = [
            np.concatenate([none[hard][moves], np.tile(part, (len(rows), 1))[kept]])
            for part, hard in zip(softness, (1, 0, 0), strict=True)
        ]
        source = np.concatenate([np.flatnonzero(moves), len(low) + np.arange(int(kept.sum()))])
        qp = StepQP(
            P=np.eye(n),
            q=np.zeros((n,)),
            A=A,
            low=np.concatenate([low[moves], limits.low[kept]]),
            high=np.concatenate([high[moves], limits.high[kept]]),
            softness=Softness(*prices),
            source=source,
            scale=np.ones(len(source)),
            shift_primal=np.arange(int(n)),
            shift_dual=np.arange(len(source)),
            rate_rows=np.zeros(0, np.intp),
            rate_inputs=np.zeros(0, np.intp),
        )
        if self._solver is None or self._solver.qp.source.tolist() != source.tolist():
            self._solver = LevelSolver(qp, SolverTurn(FINISHER, {}), self.search)
        else:
            self._solver.update(qp)
        plan = np.concatenate([free[starts, mine].ravel(), free[kept]])
        end = None if np.isinf(deadline) else deadline
        found, _ = self._solver.solve(plan, None, end, Interval(qp.low, qp.high))
        return Deviation(X[1:] @ found.v, U @ found.v, found.y, found.status, found.iterations)


class ConvexStage:
    """ℓ(s_k, v_k) ≈ ℓ + gᵀδ + ½ δᵀH⁺δ, δ = [δs; δv]: H⁺ has the eigenvalues of the Hessian that are above zero.

    Products of s and v count by their slopes alone: H⁺ loses the blocks beside its diagonal. Quadratic programs that
    follow one another have the same fixed point so, and as [2 H_ss, 0; 0, 2 H_vv] ⪰ H they approach it.

    Parameters
    ----------
    problem
        The stages; their cost has a custom stage.
    X, U
        The plan (N+1, ns), (N, nu), read at each call.

    Attributes
    ----------
    convex
        Whether ℓ was convex at every stage of the last plan.
    """

    def __init__(
        self, problem: StagedProblem, X: Float[np.ndarray, "N1 ns"], U: Float[np.ndarray, "N nu"], *, compiles: bool
    ) -> None:
        assert problem.stage is not None, "only made for a stage cost"
        N, ns, nu = len(problem.free), problem.nx, len(problem.R)
        point = ca.SX.sym("point", ns + nu)
        H, g = ca.hessian(problem.stage(point[:ns], point[ns:]), point)
        model = ca.Function("model", [point], [ca.densify(g), ca.densify(H)]).map(N)
        S, inputs = ca.MX.sym("S", ns, N + 1), ca.MX.sym("V", nu, N)
        slopes, curvatures = model(ca.vertcat(S[:, :N], inputs))
        function = ca.Function("stage_model", [S, inputs], [slopes, curvatures])
        self._g, self._H = np.zeros((N, ns + nu)), np.zeros((N, ns + nu, ns + nu))
        self._model = Routine(function, [X, U], [self._g, self._H], compiles=compiles)
        self._free: Bool[np.ndarray, " N"] = problem.free
        self.convex = True

    def add(
        self,
        Q: Float[np.ndarray, "N ns ns"],
        q: Float[np.ndarray, "N ns"],
        R: Float[np.ndarray, "N nu nu"],
        r: Float[np.ndarray, "N nu"],
    ) -> None:
        """Add half of the model to weights of half of the cost; those of a state are of s_1 … s_N."""
        self._model.call()
        ns, free = Q.shape[1], self._free
        if not (np.isfinite(self._g).all() and np.isfinite(self._H).all()):
            r[:] = np.nan  # the program has no solution, and the step says so
            return
        values, vectors = np.linalg.eigh(self._H)
        self.convex = bool(
            (values[:, 0] >= -1e-9 * np.abs(values).max(axis=1)).all()
        )  # below this share it is rounding
        H = self._H
        if not self.convex:
            H = np.einsum("kij,kj,klj->kil", vectors, np.maximum(values, 0.0), vectors)
        Q[:-1] += 0.5 * H[1:, :ns, :ns]
        q[:-1] += 0.5 * self._g[1:, :ns]
        R[free] += 0.5 * H[free, ns:, ns:]
        r[free] += 0.5 * self._g[free, ns:]
