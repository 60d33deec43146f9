"""Units: the coordinates in which a linear problem is solved, so that those of a model and of its user mean nothing.

Recursions and rank decisions lose digits where entries differ by many powers of ten, and where observables are almost
dependent. So z = L q, u = D_u ũ, r = D_r r̃, limited outputs D_g g̃, and a cost of `scale` times its own unit.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, solve_triangular

from koopmpc.control.cost import Cost, LiftedTracking
from koopmpc.control.linear.condense import Condensed
from koopmpc.control.linear.horizon import Horizon
from koopmpc.control.target import Targets, observable_sizes
from koopmpc.predict.predictors import LinearPredictor


class Units(NamedTuple):
    """L, its inverse, and the diagonals of D_u, D_r and D_g; see the file."""

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

    def horizon(self, h: Horizon) -> Horizon:
        """Return a horizon in these units."""
        A, B, E = self.inverse @ h.A @ self.L, self.inverse @ h.B * self.inputs, self.inverse @ h.E
        C, G = h.C @ self.L / self.tracked[:, None], h.G @ self.L / self.limited[:, None]
        R_delta = None if h.R_delta is None else self._weight(h.R_delta, self.inputs)
        Q, R = self._weight(h.Q, self.tracked), self._weight(h.R, self.inputs)
        return replace(h, A=A, B=B, E=E, C=C, G=G, Q=Q, R=R, R_delta=R_delta)

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
        return replace(cost, Q_N=self._weight(Q_N, self.tracked)) if len(Q_N) == len(self.tracked) else cost

    def gain(self, K: Float[np.ndarray, "nu nx"]) -> Float[np.ndarray, "nu nx"]:
        """Return the gain of [z; u_{k−1}], or of z, of one in these units."""
        return self.inputs[:, None] * K @ self._back(K.shape[1])

    def value(self, P: Float[np.ndarray, "nx nx"]) -> Float[np.ndarray, "nx nx"]:
        """Return the P of a value of [z; u_{k−1}], or of z, of one in these units."""
        back = self._back(len(P))
        return self.scale * back.T @ P @ back

    def maps(self, maps: Condensed, h: Horizon) -> Condensed:
        """Return what `condense` made of a horizon in these units, in those of the model."""
        moves = len(h.blocks) * (1 + h.bounded)
        rows = np.concatenate([np.tile(self.inputs, moves), np.tile(self.limited, h.N)])[:, None]
        drive, nd = maps.from_drive.copy(), h.signals.nd
        if nd:
            drive[:, -nd:] = drive[:, -nd:] @ self.inverse
        return replace(
            maps,
            from_state=rows * (maps.from_state @ self._back(h.size)),
            from_reference=rows * maps.from_reference / np.tile(self.tracked, h.N + 1),
            from_target=rows * maps.from_target,
            from_given=rows * maps.from_given / np.tile(self.inputs, h.N + 1),
            from_drive=rows * drive,
            offset=rows[:, 0] * maps.offset,
            deviation=rows * maps.deviation,
            unit=self.scale * maps.unit,
        )

    def _back(self, size: int) -> Float[np.ndarray, "nx nx"]:
        """Return what takes [z; u_{k−1}], or z, into these units."""
        return self.inverse if size == len(self.inverse) else block_diag(self.inverse, np.diag(1 / self.inputs))

    def _weight(self, Q: Float[np.ndarray, "n n"], size: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
        return Q * np.outer(size, size) / self.scale


def _norms(rows: Float[np.ndarray, "n nz"]) -> Float[np.ndarray, " n"]:
    size = np.linalg.norm(rows, axis=1)
    return np.where(size > 0, size, 1.0)
