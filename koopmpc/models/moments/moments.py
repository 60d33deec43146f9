"""Second moments of the rows [ψ(x) u u⊗ψ(x) ψ(x⁺)], all that the regressions need."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.errors import DataError, FitWarning
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.lifting.base import Lifting
from koopmpc.models.moments.rows import RowColumns, absorb, row_columns
from koopmpc.models.moments.solve import RegressionRows, solve


@dataclass(frozen=True, eq=False)
class Moments(Value):
    """Second moments of the rows d = [ψ(x) u ψ(x⁺)] of M snapshot pairs: G = Σ w dᵀd, or R with RᵀR = Σ w dᵀd.

    ``a + b`` are the moments of both data sets; the grouping of such sums changes only rounding errors. A state that ψ
    lacks is appended to ψ in these rows, so that C and the residuals need no second pass over the data.

    Attributes
    ----------
    lifting
        ψ, bound to the states, or to ζ of the embedding.
    inputs
        Names with units; none for an autonomous system.
    dt
        Sample time [s].
    samples
        M, the pairs of weight above 0.
    weight
        Σ w; M where the pairs are not weighted.
    route
        "gram" for raw sums of products, "qr" for the triangular factor: twice the digits, six times the cost.
    sums
        G or R, (nd, nd).
    bilinear
        The rows are [ψ(x) u u⊗ψ(x) ψ(x⁺)]; the products leave out a Constant, because u · 1 is u.
    embedding
        The embedding that makes ζ if ψ acts on ζ; else None.
    """

    lifting: Lifting
    inputs: tuple[str, ...]
    dt: float
    samples: int
    weight: float
    route: str
    sums: Float[np.ndarray, "nd nd"]
    bilinear: bool = False
    embedding: Delay | None = None

    @cached_property
    def columns(self) -> RowColumns:
        """Names and places of the columns."""
        return row_columns(self.lifting, self.inputs, self.bilinear)

    @property
    def nz(self) -> int:
        """Number of observables in ψ."""
        return self.lifting.nz

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states x, without their past."""
        return self.lifting.bound_states if self.embedding is None else self.embedding.states

    @property
    def products(self) -> Int[np.ndarray, " np"]:
        """Indices of the observables in u⊗ψ(x): all without the Constant; empty if not bilinear."""
        return self.columns.products

    @property
    def condition(self) -> float:
        """Condition number of the regressors on unit-norm columns, without columns that are 0 in all rows."""
        P = self.rows(self.columns.regressors, self.columns.targets[:0]).P
        size = np.sqrt(np.einsum("ij,ij->j", P, P))
        unit = P[:, size > 0] / size[size > 0]
        if self.samples < unit.shape[1]:
            return np.inf
        if self.route == "gram":  # the rows of Gram sums are orthogonal
            s = np.sort(np.sqrt(np.einsum("ij,ij->i", unit, unit)))[::-1][: unit.shape[1]]
        else:
            s = np.linalg.svd(unit, compute_uv=False)
        return float(s[0] / s[-1]) if s.size and s[-1] > 0 else (np.inf if s.size else 1.0)

    def __add__(self, other: "Moments") -> "Moments":
        """Return the moments of both data sets; R + G becomes G, with a warning that half of R's digits are lost."""
        layout = (self.lifting, self.inputs, self.dt, self.bilinear, self.embedding)
        if layout != (other.lifting, other.inputs, other.dt, other.bilinear, other.embedding):
            raise DataError(
                "the moments differ in lifting, inputs or dt, or one is bilinear; "
                "add moments of one plant in one lifting only"
            )
        both = replace(self, samples=self.samples + other.samples, weight=self.weight + other.weight)
        if self.route == other.route == "qr":
            R = self.sums.copy(order="F")
            absorb(R, other.sums)
            return replace(both, sums=np.ascontiguousarray(R))
        if self.route != other.route:
            warnings.warn(
                "a triangular factor was added to Gram sums: the result is Gram sums, with half the digits; "
                'read both with route="qr"',
                FitWarning,
                stacklevel=2,
            )
        return replace(both, route="gram", sums=self._gram() + other._gram())

    def rows(self, regressors: Int[np.ndarray, " n"], targets: Int[np.ndarray, " m"]) -> RegressionRows:
        """Return a few rows [P T] with the same second moments as these columns of all M rows.

        The weights are scaled to mean 1, so that dividing a sum of squares by M gives the weighted mean.
        """
        n, scale = len(regressors), self.samples / self.weight
        constant = self._find_constant(regressors)
        if self.route == "qr":
            columns = np.sqrt(scale) * self.sums[:, np.concatenate([regressors, targets])]
            R = np.asarray(np.linalg.qr(columns, mode="r"), dtype=np.float64)
            return RegressionRows(R[:n, :n], R[:n, n:], np.sum(R[n:, n:] ** 2, axis=0), self.samples, constant)
        G = scale * self.sums
        size = np.sqrt(G.diagonal()[regressors])
        size[size == 0] = 1.0
        values, vectors = np.linalg.eigh(G[np.ix_(regressors, regressors)] / np.outer(size, size))
        # an eigenvalue below this is a rounding error of the sums
        resolved = values > np.finfo(float).eps * max(self.samples, n) * values.max(initial=0.0)
        root = np.sqrt(np.where(resolved, values, 0.0))
        P = root[:, None] * vectors.T * size
        inverse = np.where(resolved, 1.0, 0.0) / np.where(resolved, root, 1.0)
        T = inverse[:, None] * (vectors.T @ (G[np.ix_(regressors, targets)] / size[:, None]))
        rest = np.maximum(G.diagonal()[targets] - np.sum(T**2, axis=0), 0.0)
        return RegressionRows(P, T, rest, self.samples, constant)

    def complete_rows(self, regressors: Int[np.ndarray, " n"], targets: Int[np.ndarray, " m"]) -> RegressionRows:
        """Return rows [P T] like `rows`, but with all of T inside: TᵀT too is that of all M rows.

        Made from Gram sums, they are a root of the whole matrix and have half the digits.
        """
        n = len(regressors)
        both = self.rows(np.concatenate([regressors, targets]), targets[:0]).P
        constant = self._find_constant(regressors)
        return RegressionRows(both[:, :n], both[:, n:], np.zeros(len(targets)), self.samples, constant)

    def decoder(self, where: Int[np.ndarray, " nx"]) -> tuple[Float[np.ndarray, "nx nz"], Float[np.ndarray, " nx"]]:
        """Return C = argmin Σ ‖x − C ψ(x)‖² and its root-mean-square residual.

        The row of a state that ψ holds selects that state. `where` holds the index of each state among the observables
        and the states appended to them.
        """
        nz = self.nz
        C, residual = np.zeros((len(where), nz)), np.zeros(len(where))
        lifted = where < nz
        C[lifted, where[lifted]] = 1.0
        if not lifted.all():
            rows = self.rows(np.arange(nz), where[~lifted])
            K = solve(rows).K
            C[~lifted] = K.T
            residual[~lifted] = rows.residual(np.arange(len(rows.rest)), K)
        return C, residual

    def _find_constant(self, regressors: Int[np.ndarray, " n"]) -> int | None:
        place = np.flatnonzero(regressors == self.lifting.constant_index)
        return int(place[0]) if place.size else None

    def _gram(self) -> Float[np.ndarray, "nd nd"]:
        return self.sums if self.route == "gram" else self.sums.T @ self.sums


def both_sides(total: Moments) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m nz"], float]:
    """Return rows P, T with the PᵀP, PᵀT and TᵀT of the M snapshots, p = [ψ(x) u …] and t = ψ(x⁺), and a cut.

    On columns of unit norm, singular values below the cut are rounding errors; rows of Gram sums have half the digits.
    """
    rows = total.complete_rows(total.columns.regressors, total.columns.targets[: total.nz])
    rounding = float(np.finfo(float).eps * max(total.samples, len(total.columns.regressors) + total.nz))
    return rows.P, rows.T, rounding if total.route == "qr" else float(np.sqrt(rounding))
