"""Targets: the equilibrium (z_r, u_r) that holds a reference, or comes nearest to it inside the limits."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Box
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.osqp import OSQP

TOLERANCE = 1e-8  # singular values of [A − I, B] below this share of the largest span the equilibria
PRECISE = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000}


@dataclass(frozen=True)
class Targets:
    """All equilibria z = A z + B u as z = z₀ + Z α, u = u₀ + W α, and the map from a reference to its α.

    With a Constant observable its coordinate is 1 in z₀ and 0 in Z. α(r) minimises ‖C z − r‖²_Q; where u, or a
    limited output G z, would leave its limits, it minimises the same inside them.
    """

    z0: Float[np.ndarray, " nz"]
    Z: Float[np.ndarray, "nz na"]
    u0: Float[np.ndarray, " nu"]
    W: Float[np.ndarray, "nu na"]
    from_reference: Float[np.ndarray, "na nr"]
    offset: Float[np.ndarray, " na"]
    rows: Float[np.ndarray, "nl na"]
    low: Float[np.ndarray, " nl"]
    high: Float[np.ndarray, " nl"]
    hard: int
    weighted: Float[np.ndarray, "nr na"]

    def coordinates(self, R: Float[np.ndarray, "T nr"]) -> Float[np.ndarray, "T na"]:
        """Return α for each row of references."""
        alpha = R @ self.from_reference.T + self.offset
        values = alpha @ self.rows.T
        slack = 1e-9 * (1 + np.abs(values))
        outside = ((values < self.low - slack) | (values > self.high + slack)).any(axis=1)
        if outside.any():
            known: dict[bytes, Float[np.ndarray, " na"]] = {}
            for k in np.flatnonzero(outside):
                key = R[k].tobytes()
                if key not in known:
                    known[key] = self._inside(alpha[k])
                alpha[k] = known[key]
        return alpha

    def _inside(self, alpha: Float[np.ndarray, " na"]) -> Float[np.ndarray, " na"]:
        """Return the nearest α inside all limits, or inside the input limits where there is none."""
        # H of trace 1: the tolerance is relative to the weight, and cost in other units has the same target
        H = self.weighted.T @ self.weighted
        H = H / max(float(np.trace(H)), 1e-300) + 1e-9 * np.eye(len(H))
        q = -H @ alpha
        for count in (len(self.rows), self.hard):
            qp = QP(H, q, self.rows[:count], self.low[:count], self.high[:count])
            solution = OSQP(qp, PRECISE).solve(np.zeros(len(alpha)), np.zeros(count))
            if solution.status is Status.OPTIMAL:
                return solution.v
        return np.zeros_like(alpha)


def targets(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    C: Float[np.ndarray, "nr nz"],
    Q: Float[np.ndarray, "nr nr"],
    inputs: Box,
    G: Float[np.ndarray, "ng nz"],
    outputs: Box,
    constant: int | None,
    *,
    hold: bool,
) -> Targets:
    """Return the equilibria of z⁺ = A z + B u for tracked outputs C z and limits on u and G z.

    Parameters
    ----------
    constant
        Index of the Constant observable, pinned to 1.
    hold
        False: u_r = 0 on request; z_r is the equilibrium without it.
    """
    nz, nu = B.shape
    E = np.hstack([A - np.eye(nz), B])
    if constant is not None:
        E = np.delete(E, constant, axis=0)  # 1 = 1, whatever a fit has made of it
    free = np.array([i for i in range(nz + nu) if i != constant])
    pinned = np.zeros(nz) if constant is None else -E[:, constant]
    left, sigma, right = np.linalg.svd(E[:, free])
    rank = int((sigma > TOLERANCE * max(float(sigma[0]), 1e-300)).sum())
    base, span = np.zeros(nz + nu), np.zeros((nz + nu, len(free) - rank))
    base[free] = right[:rank].T @ ((left[:, :rank].T @ pinned) / sigma[:rank])
    span[free] = right[rank:].T
    if constant is not None:
        base[constant] = 1.0
    z0, u0, Z, W = base[:nz], base[nz:], span[:nz], span[nz:]
    root = _root(Q)
    weighted = root @ C @ Z
    inverse = np.linalg.pinv(weighted, rcond=TOLERANCE)
    rows, values = np.vstack([W, G @ Z]), np.concatenate([u0, G @ z0])
    return Targets(
        z0=z0,
        Z=Z,
        u0=u0 * float(hold),
        W=W * float(hold),
        from_reference=inverse @ root,
        offset=-inverse @ root @ C @ z0,
        rows=rows,
        low=np.concatenate([inputs.low, outputs.low]) - values,
        high=np.concatenate([inputs.high, outputs.high]) - values,
        hard=nu,
        weighted=weighted,
    )


def _root(Q: Float[np.ndarray, "nr nr"]) -> Float[np.ndarray, "nr nr"]:
    """Return a matrix S with SᵀS = Q."""
    values, vectors = np.linalg.eigh(Q)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
