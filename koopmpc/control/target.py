"""Targets: the equilibrium (z_r, u_r) that holds a reference, or comes nearest to it inside the limits; and Units."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, null_space, solve_triangular

from koopmpc.base import checks
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, magnitude
from koopmpc.control.move import Status
from koopmpc.control.plan.tracking import LiftedTracking, Sizes
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.models.predictors import LinearPredictor

TOLERANCE = 1e-8  # singular values of [A − I, B] below this share of the largest span the equilibria
ROUNDING = 1e-9  # by how much of its value and its limit a target may stand outside before it is moved
KEPT = 10_000  # the memory of coordinates is cleared when it holds this many
_SHARES = (1.0, 0.7, 0.45)  # observables are evaluated at these shares of the states' sizes to find their own sizes
_LEAST = 1e-150  # an observable below this at all these points has size 1


@dataclass(frozen=True)
class Targets:
    """All equilibria z = A z + B u + e as z = z₀ + z_e e + Z α, u = u₀ + u_e e + W α, and a reference's α.

    e is what disturbances add to z⁺, zero by default. With a Constant observable its coordinate is 1 in z₀ and 0 in Z.
    α(r, e) minimises ‖C z − r‖²_Q. Where u, or a limited output G z, would leave its limits, α is the minimiser inside
    them: low ≤ rows α + rows_disturbance e ≤ high, the first `hard` rows being the inputs'.
    """

    z0: Float[np.ndarray, " nz"]
    Z: Float[np.ndarray, "nz na"]
    u0: Float[np.ndarray, " nu"]
    W: Float[np.ndarray, "nu na"]
    z_disturbance: Float[np.ndarray, "nz nz"]
    u_disturbance: Float[np.ndarray, "nu nz"]
    from_reference: Float[np.ndarray, "na nr"]
    offset: Float[np.ndarray, " na"]
    rows: Float[np.ndarray, "nl na"]
    rows_disturbance: Float[np.ndarray, "nl nz"]
    low: Float[np.ndarray, " nl"]
    high: Float[np.ndarray, " nl"]
    size: Float[np.ndarray, " nl"]  # the finite end of each limit that is farther from 0
    values: Float[np.ndarray, " nl"]  # of the limited inputs and outputs at [z0; u0], from which the limits count
    hard: int
    weighted: Float[np.ndarray, "nr na"]
    from_disturbance: Float[np.ndarray, "na nz"]
    _known: dict[bytes, Float[np.ndarray, " na"]] = field(default_factory=dict[bytes, Float[np.ndarray, " na"]])
    _solvers: dict[int, DAQP] = field(default_factory=dict[int, DAQP])

    def nearest(
        self, R: Float[np.ndarray, "T nr"], e: Float[np.ndarray, " nz"] | None = None
    ) -> Float[np.ndarray, "T na"]:
        """Return α for each row of references as if there were no limits."""
        alpha = R @ self.from_reference.T + self.offset
        return alpha if e is None else alpha + self.from_disturbance @ e

    def coordinates(
        self, R: Float[np.ndarray, "T nr"], e: Float[np.ndarray, " nz"] | None = None, box: Interval | None = None
    ) -> Float[np.ndarray, "T na"]:
        """Return α for each row of references, inside the limits; `box` has limits (T, nl) of each row."""
        alpha = self.nearest(R, e)
        pushed = np.zeros(len(self.rows)) if e is None else self.rows_disturbance @ e
        values = alpha @ self.rows.T
        low, high = (self.low - pushed, self.high - pushed) if box is None else (box.low - pushed, box.high - pushed)
        slack = ROUNDING * (np.abs(values) + self.size)
        outside = ((values < low - slack) | (values > high + slack)).any(axis=1)
        for k in np.flatnonzero(outside):
            key = R[k].tobytes() + (b"" if e is None else e.tobytes())
            own = low, high
            if box is not None:
                own = low[k], high[k]
                key += box.low[k].tobytes() + box.high[k].tobytes()
            if key not in self._known:
                if len(self._known) >= KEPT:
                    self._known.clear()
                self._known[key] = self._inside(alpha[k], *own)
            alpha[k] = self._known[key]
        return alpha

    def _inside(
        self, alpha: Float[np.ndarray, " na"], low: Float[np.ndarray, " nl"], high: Float[np.ndarray, " nl"]
    ) -> Float[np.ndarray, " na"]:
        """Return the nearest α inside all limits, or inside the input limits where there is none."""
        moved = self.rows @ alpha
        for count in (len(self.rows), self.hard):
            solver = self.solver(count)
            solver.reset()
            solver.set_bounds(low[:count] - moved[:count], high[:count] - moved[:count])
            solution = solver.solve(np.zeros(len(alpha)), np.zeros(count))
            if solution.status is Status.OPTIMAL:
                return alpha + solution.v
        return np.zeros_like(alpha)

    def solver(self, count: int) -> DAQP:
        """Return the solver of ‖weighted β‖² → min within limits on the first `count` rows of β."""
        if count not in self._solvers:
            # H of trace 1: the tolerance is relative to the weight, so the unit of the cost does not move the target
            H = self.weighted.T @ self.weighted
            H = H / max(float(np.trace(H)), 1e-300) + 1e-9 * np.eye(len(H))
            free = np.full(count, np.inf)
            qp = QP(H, np.zeros(len(H)), self.rows[:count], -free, free)
            self._solvers[count] = FINISHER(qp)
        return self._solvers[count]


def observable_sizes(predictor: LinearPredictor, sizes: Sizes) -> Float[np.ndarray, " nz"]:
    """Return the sizes of observables: those of a model's data, else the largest |ψ| at shares of the states' sizes.

    An observable that is zero there has size 1.
    """
    if predictor.scale is not None:
        return np.linalg.norm(predictor.scale, axis=0)
    point = sizes.states
    if predictor.embedding is not None:
        point = predictor.embedding.spread(sizes.states, sizes.inputs)
    seen = np.abs(predictor.lifting(np.outer(_SHARES, point))).max(axis=0)
    if seen.shape != (predictor.nz,):  # a reduced model
        return np.ones(predictor.nz)
    return np.where(np.isfinite(seen) & (seen > _LEAST), seen, 1.0)


class Units(NamedTuple):
    """The units of a linear problem: L, its inverse, and the diagonals of D_u, D_r and D_g.

    Recursions and rank decisions lose digits where entries differ by many powers of ten, and where observables are
    almost dependent. A problem is therefore solved in units that do not depend on those of the model: z = L q,
    u = D_u ũ, r = D_r r̃, limited outputs D_g g̃, and a cost of `scale` times its own unit.
    """

    L: Float[np.ndarray, "nz nz"]
    inverse: Float[np.ndarray, "nz nz"]
    inputs: Float[np.ndarray, " nu"]
    tracked: Float[np.ndarray, " nr"]
    limited: Float[np.ndarray, " ng"]
    scale: float

    @staticmethod
    def of(predictor: LinearPredictor, track: LiftedTracking) -> "Units":
        """Return the units of a predictor under a cost and limits.

        L is the transposed factor of the lifted data, in which q has root-mean-square 1 in every direction; for a model
        that was not fitted the sizes of its observables.
        """
        known = predictor.scale
        L = np.diag(observable_sizes(predictor, track.sizes)) if known is None else known.T.copy()
        inverse = np.asarray(solve_triangular(L, np.eye(len(L)), lower=True))
        C, G = (_norms(rows @ L) for rows in (track.tracked, track.limited))
        return Units(L, inverse, track.sizes.inputs, C, G, track.sizes.scale)

    def targets(self, targets: Targets) -> Targets:
        """Return targets, as far as a horizon reads them, in these units."""
        return replace(
            targets,
            z0=self.inverse @ targets.z0,
            Z=self.inverse @ targets.Z,
            u0=targets.u0 / self.inputs,
            W=targets.W / self.inputs[:, None],
            z_disturbance=self.inverse @ targets.z_disturbance @ self.L,
            u_disturbance=targets.u_disturbance @ self.L / self.inputs[:, None],
        )

    def cost(self, cost: Cost) -> Cost:
        """Return a cost with its Q_N in these units."""
        if cost.Q_N is None:
            return cost
        Q_N = np.asarray(cost.Q_N)
        if Q_N.ndim < 2:
            Q_N = np.diag(np.broadcast_to(Q_N, Q_N.shape or (len(self.tracked),)))
        if len(Q_N) == len(self.L) and len(Q_N) != len(self.tracked):
            return replace(cost, Q_N=self.L.T @ Q_N @ self.L / self.scale)
        if len(Q_N) != len(self.tracked):
            return cost
        return replace(cost, Q_N=Q_N * np.outer(self.tracked, self.tracked) / self.scale)

    def gain(self, K: Float[np.ndarray, "nu nx"]) -> Float[np.ndarray, "nu nx"]:
        """Return the gain on [z; u_{k−1}], or on z, for a gain in these units."""
        return self.inputs[:, None] * K @ self._back(K.shape[1])

    def value(self, P: Float[np.ndarray, "nx nx"]) -> Float[np.ndarray, "nx nx"]:
        """Return the P of a quadratic cost of [z; u_{k−1}], or of z, for a P in these units."""
        back = self._back(len(P))
        return self.scale * back.T @ P @ back

    def _back(self, size: int) -> Float[np.ndarray, "nx nx"]:
        """Return what takes [z; u_{k−1}], or z, into these units."""
        return self.inverse if size == len(self.inverse) else block_diag(self.inverse, np.diag(1 / self.inputs))


def _norms(rows: Float[np.ndarray, "n nz"]) -> Float[np.ndarray, " n"]:
    size = np.linalg.norm(rows, axis=1)
    return np.where(size > 0, size, 1.0)


def targets_of(predictor: LinearPredictor, track: LiftedTracking) -> Targets:
    """Return the equilibria of a predictor under a cost and limits."""
    u_target = track.cost.u_target
    hold = isinstance(u_target, str) and u_target == "equilibrium"
    A, B, constant = predictor.A, predictor.B, predictor.lifting.constant_index
    return targets(
        A,
        B,
        track.tracked,
        track.Q_root,
        track.inputs,
        (track.limited, track.outputs),
        constant,
        hold=hold,
        R_root=track.R_root,
        sizes=np.concatenate([observable_sizes(predictor, track.sizes), track.sizes.inputs]),
    )


def targets(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    C: Float[np.ndarray, "nr nz"],
    Q_root: Float[np.ndarray, "nr nr"],
    inputs: Interval,
    limited: tuple[Float[np.ndarray, "ng nz"], Interval],
    constant: int | None,
    *,
    hold: bool,
    R_root: Float[np.ndarray, "nu nu"] | None = None,
    sizes: Float[np.ndarray, " n"] | None = None,
) -> Targets:
    """Return the equilibria of z⁺ = A z + B u for tracked outputs C z and limits on u and G z.

    Ranks are decided by the sizes of states and inputs, so that their units mean nothing. Of all equilibria that are as
    near to a reference, the one with the least ‖u‖_R is taken.

    Parameters
    ----------
    Q_root
        S with SᵀS = Q.
    limited
        G, and the limits of G z.
    constant
        Index of the Constant observable, pinned to 1.
    hold
        False: u_r is not that of the equilibrium, but zero or given.
    R_root
        S with SᵀS = R, by default the identity.
    sizes
        Sizes of the entries of [z; u], by default 1.
    """
    (nz, nu), (G, outputs) = B.shape, limited
    measure = checks.array(1.0 if sizes is None else sizes, "sizes") * np.ones(nz + nu)
    size = measure[:nz]
    E, push = np.hstack([A - np.eye(nz), B]) * measure / size[:, None], np.diag(1 / size)
    if constant is not None:  # the Constant stays 1, whatever its row is in a fit
        E, push = np.delete(E, constant, axis=0), np.delete(push, constant, axis=0)
    free = np.array([i for i in range(nz + nu) if i != constant])
    pinned = np.zeros(nz) if constant is None else -E[:, constant] / size[constant]
    left, sigma, right = np.linalg.svd(E[:, free])
    rank = int((sigma > TOLERANCE * max(float(sigma[0]), 1e-300)).sum())
    inverse = right[:rank].T @ (left[:, :rank].T / sigma[:rank, None])
    base, span, pushed = np.zeros(nz + nu), np.zeros((nz + nu, len(free) - rank)), np.zeros((nz + nu, nz))
    base[free], span[free], pushed[free] = inverse @ pinned, right[rank:].T, -inverse @ push
    base, span, pushed = measure * base, measure[:, None] * span, measure[:, None] * pushed
    if constant is not None:
        base[constant] = 1.0
    z0, u0, Z, W = base[:nz], base[nz:], span[:nz], span[nz:]
    weighted = Q_root @ C @ Z
    back = np.linalg.pinv(weighted, rcond=TOLERANCE) @ Q_root
    price = np.eye(nu) if R_root is None else R_root / max(float(np.linalg.norm(R_root * measure[nz:])), 1e-300)
    free_of_cost = null_space(weighted, rcond=TOLERANCE) if len(weighted) else np.eye(weighted.shape[1])
    cheaper = -free_of_cost @ np.linalg.pinv(price @ W @ free_of_cost, rcond=TOLERANCE) @ price
    offset, from_disturbance = -back @ C @ z0, -back @ C @ pushed[:nz]
    offset = offset + cheaper @ (u0 + W @ offset)
    from_disturbance = from_disturbance + cheaper @ (pushed[nz:] + W @ from_disturbance)
    back = back + cheaper @ W @ back
    rows, values = np.vstack([W, G @ Z]), np.concatenate([u0, G @ z0])
    rows_disturbance = np.vstack([pushed[nz:], G @ pushed[:nz]])
    low, high = (np.concatenate([inputs[i], outputs[i]]) - values for i in (0, 1))
    return Targets(
        z0=z0,
        Z=Z,
        u0=u0 * float(hold),
        W=W * float(hold),
        z_disturbance=pushed[:nz],
        u_disturbance=pushed[nz:] * float(hold),
        from_reference=back,
        offset=offset,
        rows=rows,
        rows_disturbance=rows_disturbance,
        low=low,
        high=high,
        size=magnitude(Interval(low, high)),
        values=values,
        hard=nu,
        weighted=weighted,
        from_disturbance=from_disturbance,
    )
