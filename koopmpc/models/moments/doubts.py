"""Doubts about the rows of a regression, in sentences."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular

from koopmpc.models.moments.solve import ILL_CONDITIONED, RegressionRows, column_norms, scale_to_unit_norm, scaled_rank

_NAMED = 3  # a message names at most so many dependent columns


def find_doubts(
    rows: RegressionRows, observables: Sequence[str], inputs: Sequence[str], *, regular: bool
) -> tuple[list[str], float]:
    """Return a sentence for each reason to doubt the regression on P = [ψ(x) u], and its condition number.

    The condition number is that of columns scaled to unit norm; inf if they are dependent.
    """
    nz, nu = len(observables), len(inputs)
    names = [*observables, *inputs]
    size = column_norms(rows.P)
    zero = np.flatnonzero(size == 0)
    zero = zero[zero >= nz] if regular else zero
    sentences: list[str] = []
    if zero.size:
        sentences.append(
            f"{_list_names([names[j] for j in zero])} was 0 in all snapshots, so its coefficients are set to 0; "
            "excite it or drop it"
        )
    if rows.samples < nz + nu:
        if not regular:
            sentences.append(
                f"rank-deficient: {rows.samples} snapshot pairs cannot determine {nz + nu} coefficients "
                "a row; the minimum-norm solution is taken; collect more, or lift to fewer observables"
            )
        return sentences, np.inf
    live = np.flatnonzero(size > 0)
    Z, U = rows.P[:, live[live < nz]], rows.P[:, live[live >= nz]]
    rank, condition = scaled_rank(rows, rows.P[:, live])
    if rank == len(live):
        if condition > ILL_CONDITIONED and not regular:
            sentences.append(
                f"ill-conditioned: the observables have condition number {condition:.1e} on unit-norm "
                "columns; pass a ridge, or drop observables that are almost functions of others"
            )
        return sentences, condition if rank == nz + nu else np.inf
    rank_z, rank_u = scaled_rank(rows, Z)[0], scaled_rank(rows, U)[0]
    for P, rank_P, part, what in ((Z, rank_z, live[live < nz], "observables"), (U, rank_u, live[live >= nz], "inputs")):
        if rank_P < P.shape[1] and not (regular and what == "observables"):
            dependent = _name_dependent_columns(P, rank_P, [names[int(j)] for j in part])
            sentences.append(
                f"rank-deficient: {P.shape[1] - rank_P} of {P.shape[1]} {what} are linear functions of others "
                f"on these data ({dependent}); the minimum-norm solution is taken; drop them, or collect richer data"
            )
    if rank < rank_z + rank_u:
        sentences.append(
            "feedback made A and B inseparable: on these data inputs are linear functions of ψ(x) "
            f"(rank [Z U] = {rank}, rank Z + rank U = {rank_z + rank_u}); the minimum-norm split is taken; "
            "add noise to the input, or pass a known B to dmdc"
        )
    return sentences, condition


def _name_dependent_columns(P: Float[np.ndarray, "m n"], rank: int, names: Sequence[str]) -> str:
    """Return in words, for each column beyond `rank`, the columns on which it depends."""
    R, pivots = qr(scale_to_unit_norm(P), mode="r", pivoting=True)
    sorted_names = [names[int(j)] for j in pivots]
    weights = np.abs(solve_triangular(R[:rank, :rank], R[:rank, rank:]))
    dependences: list[str] = []
    for name, column in zip(sorted_names[rank : rank + _NAMED], weights.T, strict=False):
        sources = [sorted_names[int(i)] for i in np.argsort(-column, kind="stable") if column[i] > 1e-6]
        dependences.append(f"{name!r} of {_list_names(sources)}")
    return ", ".join(dependences) + (", …" if P.shape[1] - rank > _NAMED else "")


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
