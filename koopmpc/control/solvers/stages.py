"""QPStages: the QP of a step before it is condensed, stage by stage, for solvers that use its zeros."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from koopmpc.base.values import Value


@dataclass(frozen=True, eq=False, kw_only=True)
class QPStages(Value):
    """ξ_{j+1} = A ξ_j + B u_j from ξ_0 = 0: what a deviation from the plan does, at ½ Σ yᵀW y + ½ ξ_NᵀP ξ_N.

    y = [ξ_j; u_j]. The cost is ½ wᵀH w of the condensed QP in Riccati coordinates, w_j = factors_j (u_j + K_j ξ_j).

    Attributes
    ----------
    A, B, W, P
        The stage and the end.
    rows
        What a stage limits as rows on [u_j; ξ_{j+1}; u_{j−1}]: its inputs, their changes where these have limits, and
        its outputs.
    groups
        How many rows of a stage are inputs, changes and outputs.
    factors, K
        How w follows, stage by stage.
    """

    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    W: Float[np.ndarray, "nxu nxu"]
    P: Float[np.ndarray, "nx nx"]
    rows: Float[np.ndarray, "rows nv"]
    groups: tuple[int, int, int]
    factors: Float[np.ndarray, "N nu nu"]
    K: Float[np.ndarray, "N nu nx"]

    @property
    def N(self) -> int:
        """Number of stages."""
        return len(self.K)

    def condense(self, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " n"]:
        """Return w of [u_0; ξ_1; u_1; …; ξ_N]."""
        nx, nu = self.B.shape
        stages = y.reshape(self.N, nu + nx)
        moved = stages[:, :nu].copy()
        moved[1:] += (self.K[1:] @ stages[:-1, nu:, None])[:, :, 0]
        return (self.factors @ moved[:, :, None]).ravel()

    def cost(self) -> scipy.sparse.csc_matrix:
        """Return the Hessian on [u_0; ξ_1; u_1; …; ξ_N]."""
        nx, N, W = len(self.A), self.N, self.W
        inner = scipy.sparse.kron(scipy.sparse.eye(N - 1), W)  # of [ξ_1; u_1; …; ξ_{N−1}; u_{N−1}]
        return scipy.sparse.csc_matrix(scipy.sparse.block_diag([W[nx:, nx:], inner, self.P]))

    def dynamics(self) -> scipy.sparse.csc_matrix:
        """Return the rows ξ_{j+1} − A ξ_j − B u_j on the same variables."""
        (nx, nu), N = self.B.shape, self.N
        now = scipy.sparse.kron(scipy.sparse.eye(N), np.hstack([-self.B, np.eye(nx)]))
        before = scipy.sparse.kron(scipy.sparse.eye(N, k=-1), np.hstack([np.zeros((nx, nu)), -self.A]))
        return scipy.sparse.csc_matrix(now + before)

    def limits(self, source: Int[np.ndarray, " m"], scale: Float[np.ndarray, " m"]) -> scipy.sparse.csc_matrix:
        """Return the rows of the condensed QP on the same variables: entries `source` of the plan times `scale`."""
        (nx, nu), N = self.B.shape, self.N
        now = scipy.sparse.kron(scipy.sparse.eye(N), self.rows[:, : nu + nx])
        last = np.hstack([self.rows[:, nu + nx :], np.zeros((len(self.rows), nx))])
        every = (now + scipy.sparse.kron(scipy.sparse.eye(N, k=-1), last)).tocsr()
        place = np.arange(N * len(self.rows)).reshape(N, -1)
        inputs, changes, _ = self.groups
        parts = np.split(place, [inputs, inputs + changes], axis=1)  # a plan has the inputs of all stages first
        order = np.concatenate([part.ravel() for part in parts])
        return scipy.sparse.csc_matrix(scipy.sparse.diags(scale) @ every[order[source]])
