"""A reference that goes on as it moved: its rows beyond the preview, and what they ask of the end of a plan."""

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.nonlinear.equilibrium import Linearisation, TerminalTarget

_ORDERS = (2, 3, 4, 6)  # of linear recurrences with a constant: a ramp or a sine has 2, two sines have 4
_EXACT = 1e-6  # share of a column's spread by which the recurrence may miss a row of the preview
_GROWTH = 1e-3  # a recurrence may grow by this share a step
_LEAST = 1e-12  # share of the largest row below which a column does not move


def extend_rows(R: Float[np.ndarray, "N1 nr"], count: int) -> Float[np.ndarray, "T nr"]:
    """Return `count` rows after R by the shortest linear recurrence r_k = Σ c_i r_{k−i} + c that all rows of R obey.

    None, (0, nr), if nothing moves, or if a column obeys no such recurrence, or one that grows.
    """
    nothing = np.zeros((0, R.shape[1]))
    if not count or not np.ptp(R, axis=0).any():
        return nothing
    columns = [_extend_column(column, count) for column in R.T]
    known = [column for column in columns if column is not None]
    return np.column_stack(known) if len(known) == len(columns) else nothing


def _extend_column(r: Float[np.ndarray, " N1"], count: int) -> Float[np.ndarray, " T"] | None:
    spread = np.ptp(r)
    if spread <= _LEAST * np.abs(r).max():
        return np.full(count, r[-1])
    base, z = r[-1], (r - r[-1]) / spread
    for order in _ORDERS:
        rows = len(z) - order
        if rows < order + 2:
            break
        past = np.column_stack([*(z[i : rows + i] for i in range(order)), np.ones(rows)])
        c: Float[np.ndarray, " n"] = np.asarray(np.linalg.lstsq(past, z[order:], rcond=1e-11)[0], dtype=np.float64)
        roots = np.roots(np.concatenate([[1.0], -c[:order][::-1]]))
        if np.abs(past @ c - z[order:]).max() > _EXACT or np.abs(roots).max() > 1 + _GROWTH:
            continue
        last = z[-order:].copy()
        values = np.empty(count)
        for k in range(count):
            values[k] = c[:order] @ last + c[order]
            last[:-1], last[-1] = last[1:], values[k]
        return base + spread * values
    return None


def shift_target(
    end: TerminalTarget,
    at: Linearisation,
    Q: Float[np.ndarray, "nr nr"],
    R: Float[np.ndarray, "nu nu"],
    rows: Float[np.ndarray, "T1 nr"],
    *,
    hold: bool,
) -> TerminalTarget:
    """Return the target of x_N where the rows r_N, r_{N+1}, … come, by the linear tracking problem behind x_N.

    With x̃ = x − x_r and δ_k = r_k − of(x_r) the cost-to-go is x̃ᵀP x̃ − 2 p_Nᵀx̃ + …, so the target moves by P⁺p_N.
    Backward from p = 0 after the last row, p_k = JᵀQ δ_k + (A − B K)ᵀ p_{k+1} − Kᵀ R v_k. v_k is the input that costs
    nothing, from u_r on: the one that holds δ_k if inputs count from there (`hold`), else −u_r. P is the end's cost.

    References
    ----------
    Anderson & Moore, "Optimal Control: Linear Quadratic Methods", 1990, section 4.3 (servo and tracking problems).
    """
    A, B, J = at.A, at.B, at.J
    nx = len(A)
    S = end.M @ J + end.L
    P = S.T @ S
    K: Float[np.ndarray, "nu nx"] = np.linalg.lstsq(R + B.T @ P @ B, B.T @ P @ A, rcond=1e-13)[0]
    D = rows - at.of
    pushes: Float[np.ndarray, "T1 nx"] = D @ Q @ J
    wanted = D @ _hold_inputs(at, Q).T if hold else np.tile(-end.equilibrium.u, (len(D), 1))
    pushes = pushes - wanted @ (R @ K)
    closed, p = (A - B @ K).T, np.zeros(nx)
    for push in pushes[::-1]:
        p = push + closed @ p
    moved: Float[np.ndarray, " nx"] = np.asarray(np.linalg.lstsq(P, p, rcond=1e-9)[0], dtype=np.float64)
    return end._replace(m=end.m + S @ moved)


def _hold_inputs(at: Linearisation, Q: Float[np.ndarray, "nr nr"]) -> Float[np.ndarray, "nu nr"]:
    """Return G, ∂u/∂r of the equilibrium that comes nearest to a row."""
    nx = len(at.A)
    root = checks.root(Q)
    # the equilibria are the null space of [A − 1, B]; of these the nearest to the row, with the least x and u
    _, sizes, rows = np.linalg.svd(np.hstack([at.A - np.eye(nx), at.B]))
    rank = int(np.sum(sizes > 1e-10 * sizes[0]))
    null = rows[rank:].T
    gain: Float[np.ndarray, "n nr"] = np.asarray(np.linalg.lstsq(root @ at.J @ null[:nx], root, rcond=1e-9)[0])
    return null[nx:] @ gain
