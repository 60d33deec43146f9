"""From the rows of a regression to a LinearPredictor and its report."""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from koopmpc import checks
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.doubts import doubts
from koopmpc.identify.solve import Rows, cutoff, scaled_rank, solve
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.projected import Projected
from koopmpc.predict.linear import LinearPredictor, eigen
from koopmpc.predict.report import FitReport


@dataclass(frozen=True, eq=False)
class Regression:
    """ψ(x⁺) on [ψ(x) u], ready to be solved.

    Attributes
    ----------
    method, route
        For the report.
    rows
        P = [ψ(x) u]; T begins with ψ(x⁺).
    x_next
        The columns of T that hold x⁺.
    lifting, states, inputs, dt
        As in the predictor.
    C, state_residual
        (nx, nz), None where ψ(x) is x; and the root-mean-square of x − C ψ(x).
    B
        (nz, nu) where it is known.
    scaled
        Solve on columns of unit norm.
    """

    method: str
    route: str
    rows: Rows
    x_next: Int[np.ndarray, " nx"]
    lifting: Lifting
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float
    C: Float[np.ndarray, "nx nz"] | None
    state_residual: Float[np.ndarray, " nx"]
    B: Float[np.ndarray, "nz nu"] | None = None
    scaled: bool = True


def fit(task: Regression, *, ridge: float = 0.0, rank: int | None = None) -> LinearPredictor:
    """Solve min Σ ‖ψ(x⁺) − A ψ(x) − B u‖² and report; a doubtful fit warns once, with FitWarning.

    Parameters
    ----------
    task
        The regression.
    ridge
        Weight of ‖[A B] S‖², S the diagonal of column norms; 0 takes the minimum-norm solution.
    rank
        Keep this many left singular vectors U_r of the snapshots ψ(x), columns unscaled: z = U_rᵀ ψ(x).
    """
    ridge = float(checks.array(ridge, "ridge", ()))
    if ridge < 0:
        raise DataError(f"ridge is {ridge:g}; it must be 0 or above")
    rows, nz = task.rows, task.lifting.nz
    if task.B is not None:  # what is known of x⁺ goes to the left side
        known = rows.P[:, nz:] @ task.B.T
        rows = Rows(rows.P[:, :nz], rows.T - known, rows.rest, rows.samples)
    free = task.inputs if task.B is None else ()
    sentences = doubts(rows, task.lifting.names, free, regular=ridge > 0 or rank is not None)
    condition = scaled_rank(rows, rows.P)[1]
    if rank is None:
        whole, used = _whole(task, rows, ridge)
    else:
        whole, used = _reduced(task, rows, ridge, checks.count(rank, "rank"), sentences)
    A, B, C, lifting, residual, state_residual, modes = whole
    report = FitReport(
        method=task.method,
        route=f"{task.route}, {cut(task, rows, ridge, rank)}",
        samples=rows.samples,
        condition=condition,
        rank=used,
        columns=rows.P.shape[1],
        ridge=ridge,
        residual=residual,
        state_residual=state_residual,
        warnings=tuple(sentences),
    )
    for sentence in sentences:
        warnings.warn(sentence, FitWarning, stacklevel=3)
    return LinearPredictor(A, B, C, lifting, task.dt, task.states, task.inputs, report, modes)


Whole = tuple[
    Float[np.ndarray, "nz nz"],
    Float[np.ndarray, "nz nu"],
    Float[np.ndarray, "nx nz"],
    Lifting,
    Float[np.ndarray, " nx"],
    Float[np.ndarray, " nx"],
    Complex[np.ndarray, "nl nz"] | None,
]  # A, B, C, lifting, residual, state_residual, exact modes


def _whole(task: Regression, rows: Rows, ridge: float) -> tuple[Whole, int]:
    solution = solve(rows, ridge=ridge, scaled=task.scaled)
    nz = task.lifting.nz
    K = solution.K[:, :nz]
    C = np.eye(nz) if task.C is None else task.C
    residual = rows.residual(task.x_next, K @ C.T)
    B = K[nz:].T if task.B is None else task.B
    return (K[:nz].T, B, C, task.lifting, residual, task.state_residual, None), solution.rank


def _reduced(
    task: Regression, rows: Rows, ridge: float, rank: int, sentences: list[str]
) -> tuple[Whole, int]:
    """Regress on [U_rᵀψ(x) u]; Ã = U_rᵀ X′ V_r Σ_r⁻¹ without input (Tu et al. 2014)."""
    nz = task.lifting.nz
    if rank > nz:
        raise DataError(f"rank is {rank}, but the lifting has {nz} observables; pass {nz} or less")
    Z, free = rows.P[:, :nz], rows.P[:, nz:]
    _, s, Vt = np.linalg.svd(Z, full_matrices=False)
    held = int(np.sum(s > cutoff(rows) * s[0]))
    if held < rank:
        sentences.append(
            f"rank-deficient: rank {rank} was asked for, the snapshots have rank {held}, which is taken; "
            f"pass rank={held}, or collect richer data"
        )
    r = max(min(held, rank), 1)
    basis = np.ascontiguousarray(Vt[:r].T)
    Z_r = Z @ basis
    small = Rows(np.hstack([Z_r, free]), rows.T, rows.rest, rows.samples)
    K = solve(small, ridge=ridge).K
    forward = K[:r, :nz].T  # X′ V_r Σ_r⁻¹, (nz, r)
    A = basis.T @ forward
    B = basis.T @ (K[r:, :nz].T if task.B is None else task.B)
    C = basis if task.C is None else task.C @ basis
    given = Rows(np.hstack([Z_r, task.rows.P[:, nz:]]), task.rows.T, rows.rest, rows.samples)
    residual = given.residual(task.x_next, np.vstack([A.T, B.T]) @ C.T)
    lost = Z - Z_r @ basis.T
    lost = lost if task.C is None else lost @ task.C.T
    state_residual = np.hypot(task.state_residual, np.sqrt(np.sum(lost**2, axis=0) / rows.samples))
    modes = forward @ eigen(A)[1]
    return (A, B, C, Projected(task.lifting, basis), residual, state_residual, modes), r


def cut(task: Regression, rows: Rows, ridge: float, rank: int | None) -> str:
    """Return what the solve cut or added, in words."""
    if rank is not None:
        return f"truncated SVD of unscaled columns at rank {rank}"
    if ridge > 0:
        return f"ridge {ridge:g} on unit-norm columns"
    columns = "unit-norm" if task.scaled else "unscaled"
    return f"singular values cut at {cutoff(rows):.1e} of the largest on {columns} columns"
