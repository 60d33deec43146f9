# pyright: basic
"""A stable matrix with its Lyapunov function from one linear matrix inequality: a door to cvxpy and Clarabel."""

import warnings

import numpy as np
from jaxtyping import Float

_LEAST = 1e-3  # of the mean eigenvalue of P


def lyapunov_fit(
    A0: Float[np.ndarray, "n n"], G: Float[np.ndarray, "n n"], radius: float
) -> Float[np.ndarray, "n n"] | None:
    """Return A = H Y P⁻¹ H⁻¹, H = G^½, of min ‖H (Y − H⁻¹A₀H P)‖_F with [[ρ² P, Y], [Yᵀ, P]] ⪰ 0, tr P = n.

    The inequality is Y P⁻¹ Yᵀ ⪯ ρ² P: H P H is a Lyapunov matrix of A, so |λ(A)| ≤ ρ. Objective and constraints are
    convex in (Y, P), so the optimum is global. The squared norm is the misfit tr (A − A₀) G (A − A₀)ᵀ where P = I;
    elsewhere it weighs the observables' whitened directions by P² instead of I. P ⪰ 10⁻³ I bounds that ratio.
    Returns None where the solver stops without an answer.

    References
    ----------
    Lacy & Bernstein, "Subspace identification with guaranteed stability using constrained optimization", IEEE
    Trans. Automat. Contr. 48, 2003.
    """
    import cvxpy as cp

    n = len(A0)
    values, vectors = np.linalg.eigh(G)
    root = np.sqrt(np.maximum(values, 1e-8 * values[-1]))
    H, inverse = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    Y, P = cp.Variable((n, n)), cp.Variable((n, n), symmetric=True)
    M = cp.bmat([[radius**2 * P, Y], [Y.T, P]])
    constraints = [0.5 * (M + M.T) >> 0, P - _LEAST * np.eye(n) >> 0, cp.trace(P) == n]
    misfit = cp.norm((H / root[-1]) @ (Y - inverse @ A0 @ H @ P), "fro")
    problem = cp.Problem(cp.Minimize(misfit), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is a start like any other
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
    if Y.value is None or P.value is None:
        return None
    return H @ np.linalg.solve(np.asarray(P.value), np.asarray(Y.value).T).T @ inverse
