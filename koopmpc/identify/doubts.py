"""What makes a fit doubtful, in sentences."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular

from koopmpc.identify.solve import Rows, norms, scaled_rank, unit

_ILL_CONDITIONED = 1e10
_NAMED = 3  # dependent columns that a message names


def doubts(
    rows: Rows, observables: Sequence[str], inputs: Sequence[str], *, regular: bool
) -> tuple[list[str], float]:
    """Return one sentence for each reason to doubt a regression on [ψ(x) u], P of `rows`, and its condition number.

    The condition number is that of columns scaled to unit norm; inf where they are dependent.

    Parameters
    ----------
    rows
        Their P holds the observables, then the inputs.
    observables, inputs
        Names of the columns of P.
    regular
        The user asked for a ridge or a rank: dependent or ill-conditioned observables are no surprise then.
    """
    nz, nu = len(observables), len(inputs)
    names = [*observables, *inputs]
    size = norms(rows.P)
    zero = np.flatnonzero(size == 0)
    zero = zero[zero >= nz] if regular else zero
    found: list[str] = []
    if zero.size:
        found.append(
            f"{_listed([names[j] for j in zero])} was 0 in all snapshots, so its coefficients are set to 0; "
            "excite it or drop it"
        )
    if rows.samples < nz + nu:
        if not regular:
            found.append(
                f"rank-deficient: {rows.samples} snapshot pairs cannot determine {nz + nu} coefficients "
                "a row; the minimum-norm solution is taken; collect more, or lift to fewer observables"
            )
        return found, np.inf
    live = np.flatnonzero(size > 0)
    Z, U = rows.P[:, live[live < nz]], rows.P[:, live[live >= nz]]
    rank, condition = scaled_rank(rows, rows.P[:, live])
    if rank == len(live):
        if condition > _ILL_CONDITIONED and not regular:
            found.append(
                f"ill-conditioned: the observables have condition number {condition:.1e} on unit-norm "
                "columns; pass a ridge, or drop observables that are almost functions of others"
            )
        return found, condition if rank == nz + nu else np.inf
    rank_z, rank_u = scaled_rank(rows, Z)[0], scaled_rank(rows, U)[0]
    for P, own, part, what in (
        (Z, rank_z, live[live < nz], "observables"),
        (U, rank_u, live[live >= nz], "inputs"),
    ):
        if own < P.shape[1] and not (regular and what == "observables"):
            found.append(
                f"rank-deficient: {P.shape[1] - own} of {P.shape[1]} {what} are linear functions of others "
                f"on these data ({_dependent(P, own, [names[int(j)] for j in part])}); the minimum-norm solution "
                "is taken; drop them, or collect richer data"
            )
    if rank < rank_z + rank_u:
        found.append(
            "feedback made A and B inseparable: on these data inputs are linear functions of ψ(x) "
            f"(rank [Z U] = {rank}, rank Z + rank U = {rank_z + rank_u}); the minimum-norm split is taken; "
            "add noise to the input, or pass a known B to dmdc"
        )
    return found, condition


def _dependent(P: Float[np.ndarray, "m n"], rank: int, names: Sequence[str]) -> str:
    """Return for the columns beyond `rank` which others they depend on."""
    R, pivots = qr(unit(P), mode="r", pivoting=True)
    sorted_names = [names[int(j)] for j in pivots]
    weights = np.abs(solve_triangular(R[:rank, :rank], R[:rank, rank:]))
    said: list[str] = []
    for name, column in zip(sorted_names[rank : rank + _NAMED], weights.T, strict=False):
        sources = [sorted_names[int(i)] for i in np.argsort(-column, kind="stable") if column[i] > 1e-6]
        said.append(f"{name!r} of {_listed(sources)}")
    return ", ".join(said) + (", …" if P.shape[1] - rank > _NAMED else "")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
