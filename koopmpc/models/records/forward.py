"""Forward orthogonal least squares: which few of many polynomial terms explain a target.

A term is a product of variables v₁ … v_n, v_{n+1} …: a row of indices from 1, padded with 0, where v₀ = 1.
"""

from itertools import combinations_with_replacement
from math import comb

import numpy as np
from jaxtyping import Float, Int

_DEPENDENT = 1e-10  # skip a column if less than this share of its energy is independent of the chosen ones
_EXPLAINED = 1e-14  # stop where the next term explains less than this share of the target's energy

Terms = Int[np.ndarray, "_ _"]


def count_terms(variables: int, inputs: int, degree: int) -> int:
    """Return how many terms `list_terms` lists."""
    return comb(variables + degree, degree) - 1 + inputs * comb(variables + degree - 1, degree - 1)


def list_terms(variables: int, inputs: int, degree: int) -> Terms:
    """Return all products of `variables` up to a total degree, and each input times such a product.

    No term holds two inputs, so that a model of these terms is affine in the inputs. The inputs are the variables after
    the first ones.
    """
    found = [c for g in range(1, degree + 1) for c in combinations_with_replacement(range(1, variables + 1), g)]
    for j in range(variables + 1, variables + inputs + 1):
        found += [(*c, j) for g in range(degree) for c in combinations_with_replacement(range(1, variables + 1), g)]
    return np.array([(*c, *[0] * (degree - len(c))) for c in found], dtype=np.intp).reshape(len(found), degree)


def evaluate_terms(terms: Terms, V: Float[np.ndarray, "*batch nv"]) -> Float[np.ndarray, "*batch n"]:
    """Return the terms of rows V = [1, v₁, v₂, …]."""
    product = V[..., terms[:, 0]]
    for column in terms.T[1:]:
        product = product * V[..., column]
    return product


def select_forward(
    products: Float[np.ndarray, "n n"],
    cross: Float[np.ndarray, " n"],
    energy: float,
    floor: Float[np.ndarray, " n"],
    most: int,
) -> list[int]:
    """Return the columns of P that explain y, the one that explains most of what is left first.

    In each step the column with the largest error reduction ratio ⟨w_j, y⟩² / (‖w_j‖² ‖y‖²) is taken, where w_j is p_j
    less its projection on the columns taken before. Columns and target are deviations from their means, so a constant
    is always among the regressors. All of this follows from their products, by a Cholesky factorisation that pivots.

    `products` is PᵀP, `cross` Pᵀy and `energy` ‖y‖². Columns with ‖p_j‖² up to `floor` count as constant and are not
    taken. The result holds the places of at most `most` columns, of fewer where the rest explains nothing.

    References
    ----------
    Chen, Billings & Luo, "Orthogonal least squares methods and their application to non-linear system
    identification", Int. J. Control 50, 1989.
    """
    squares = products.diagonal()
    live = squares > floor
    size = np.sqrt(np.where(live, squares, 1.0))
    explains, left = np.where(live, cross, 0.0) / size, np.where(live, 1.0, 0.0)  # ⟨w_j, y⟩ and ‖w_j‖², up to date
    basis, chosen = np.empty((most, len(size))), list[int]()  # w_i of the columns taken, times all columns
    while len(chosen) < most:
        usable = left > _DEPENDENT
        usable[chosen] = False
        gain = np.where(usable, explains**2 / np.where(usable, left, 1.0), 0.0)
        best = int(np.argmax(gain))
        if not gain[best] > _EXPLAINED * energy:
            break
        taken, norm = basis[: len(chosen)], np.sqrt(left[best])
        along = (products[best] / (size[best] * size) - taken[:, best] @ taken) / norm
        basis[len(chosen)] = along
        chosen.append(best)
        explains -= along * (explains[best] / norm)
        left -= along**2
    return chosen


def solve_nested(
    P: Float[np.ndarray, "M n"], y: Float[np.ndarray, " M"], sizes: Int[np.ndarray, " s"]
) -> Float[np.ndarray, "s n1"]:
    """Return the least squares coefficients of [1, first columns of P], for each number of columns; the rest is 0."""
    A = np.hstack([np.ones((len(P), 1)), P])
    Q, R = np.linalg.qr(A)
    projected, found = Q.T @ y, np.zeros((len(sizes), A.shape[1]))
    for row, size in zip(found, sizes, strict=True):
        k = min(int(size), P.shape[1]) + 1
        row[:k] = np.linalg.lstsq(R[:k, :k], projected[:k], rcond=None)[0]
    return found
