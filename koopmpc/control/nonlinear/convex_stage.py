"""The quadratic model of a custom stage cost along a plan, made convex."""

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from koopmpc.control.nonlinear.problem import StagedProblem
from koopmpc.plants.routines import Routine

_ROUNDING = 1e-9  # an eigenvalue is negative if it is below this share of the largest one, in size


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
        self.convex = bool((values[:, 0] >= -_ROUNDING * np.abs(values).max(axis=1)).all())
        H = self._H
        if not self.convex:
            H = np.einsum("kij,kj,klj->kil", vectors, np.maximum(values, 0.0), vectors)
        Q[:-1] += 0.5 * H[1:, :ns, :ns]
        q[:-1] += 0.5 * self._g[1:, :ns]
        R[free] += 0.5 * H[free, ns:, ns:]
        r[free] += 0.5 * self._g[free, ns:]
