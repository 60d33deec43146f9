# pyright: basic
"""ScaledQP: a QP in units of its own, in which DAQP's absolute tolerances are relative ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.values import Value
from koopmpc.control.solvers.base import QP

ACCURACY = 1e-6  # of the scaled KKT conditions where P is not diagonal and definite, relative
_CURVED = 1e-8  # least curvature of a price by its slope, per unit of a row: DAQP divides by it, and with 1e-10 it errs


class ScaledQP:
    """H, f, M with v = D x: unit diagonal of H, unit rows of M, a cost of the size of v; and what soft rows cost.

    Attributes
    ----------
    H, f, M, columns, rows, unit
        ½ xᵀH x + fᵀx → min within limits on M x; D, the factor of each row, and of the cost.
    multipliers
        The factor of each row's multiplier, and of its price.
    linear, curvature, is_soft
        The price linear ε + ½ curvature ε² of a scaled row, inf and 0 where it is hard.
    is_plain
        Whether nothing is scaled, for all is near one.
    is_exact
        Whether P is diagonal and definite: then an answer needs no check.
    """

    def __init__(self, qp: QP) -> None:
        P, q, A = qp.P, qp.q, qp.A
        diagonal = np.diag(P)
        curved = diagonal > 0
        unit = float(np.exp(np.log(diagonal[curved]).mean())) if curved.any() else 1.0
        columns = np.sqrt(unit / np.where(curved, diagonal, unit))
        norms = np.linalg.norm(A * columns, axis=1)
        rows = 1.0 / np.where(norms > 0, norms, 1.0)
        self.is_exact = bool(curved.all()) and not np.count_nonzero(P - np.diag(diagonal))
        sizes = np.concatenate([[unit], columns, np.sqrt(rows)])
        self.is_plain = not (sizes.min() < 0.01 or sizes.max() > 100)
        if self.is_plain:
            unit, columns, rows = 1.0, np.ones_like(columns), np.ones_like(rows)
        self.H, self.f = P * np.outer(columns, columns) / unit, q * columns / unit
        self.M = A * columns * rows[:, None]
        self.columns, self.rows, self.multipliers, self.unit = columns, rows, rows * unit, unit
        none = np.full(len(rows), np.inf)
        linear, quadratic = (none, none) if qp.softness is None else qp.softness[:2]
        self.linear = linear / self.multipliers
        self.curvature = np.maximum(2 * quadratic / (self.multipliers * rows), _CURVED * self.linear)
        self.is_soft = np.isfinite(linear)

    def is_met(
        self,
        x: Float[np.ndarray, " n"],
        multipliers: Float[np.ndarray, " m"],
        low: Float[np.ndarray, " m"],
        high: Float[np.ndarray, " m"],
    ) -> bool:
        """Tell whether H x + f + Mᵀλ = 0 holds, low ≤ M x ≤ high, and |λ| is the price of what a soft row gives way.

        Where soft rows are, λ must push to an end that M x is at, or beyond.
        """
        Hx, Mx, Ml = self.H @ x, self.M @ x, multipliers @ self.M
        size = max(float(np.abs(part).max(initial=1.0)) for part in (Hx, self.f, Ml))
        near = ACCURACY * float(np.abs(Mx).max(initial=1.0))
        over, under = Mx - high, low - Mx
        outside = np.maximum(over, under)
        if float(np.abs(Hx + self.f + Ml).max()) > ACCURACY * size:
            return False
        if not self.is_soft.any():
            return float(outside.max(initial=0.0)) <= near
        soft, push = self.is_soft, np.abs(multipliers)
        slack = np.maximum(outside, 0.0)[soft]
        price = self.linear[soft] + self.curvature[soft] * slack
        little = ACCURACY * (size + self.linear[soft])
        short = np.where(slack > near, price - push[soft], 0.0) - self.curvature[soft] * near
        inside = -np.where(multipliers > 0, over, under)[push > ACCURACY * size]
        return bool(
            outside[~soft].max(initial=0.0) <= near
            and (push[soft] - price <= little + self.curvature[soft] * near).all()
            and (short <= little).all()
            and inside.max(initial=0.0) <= near
        )


@dataclass(frozen=True, eq=False)
class DAQPSetup(Value):
    """½ xᵀH x → min, low ≤ M x ≤ high, v = D x: a QP with q = 0 as DAQP solves it.

    Attributes
    ----------
    H, M
        (n, n), (m, n).
    columns, rows
        (n,) the diagonal D, (m,) the factor of each row and of its limits.
    soft
        (m,) whether a row may be broken by ε ≥ 0 at the price linear ε + ½ curvature ε².
    linear, curvature
        (m,) these prices, by the scaled row.
    metric
        (n, n) AᵀA of the hard rows where these are so close to dependent that proximal points solve the QP; else None.
    settings
        All settings of DAQP.
    """

    H: Float[np.ndarray, "n n"]
    M: Float[np.ndarray, "m n"]
    columns: Float[np.ndarray, " n"]
    rows: Float[np.ndarray, " m"]
    soft: Bool[np.ndarray, " m"]
    linear: Float[np.ndarray, " m"]
    curvature: Float[np.ndarray, " m"]
    metric: Float[np.ndarray, "n n"] | None
    settings: Mapping[str, Any]
