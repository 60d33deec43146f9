"""Forward orthogonal least squares: which few of many polynomial terms explain a target.

A term is a product of variables v₁ … v_n, v_{n+1} …: a row of indices from 1, padded with 0, where v₀ = 1.
"""

from itertools import combinations_with_replacement
from math import comb

import numpy as np
from jaxtyping import Float, Int

_DEAD = 1e-9  # a column with less than this standard deviation is constant
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


def select_forward(P: Float[np.ndarray, "M n"], y: Float[np.ndarray, " M"], most: int) -> list[int]:
    """Return the columns of P that explain y, the one that explains most of what is left first.

    In each step the column with the largest error reduction ratio ⟨w_j, y⟩² / (‖w_j‖² ‖y‖²) is taken, where w_j is p_j
    less its projection on the columns taken before. Columns and target are taken as deviations from their means, so a
    constant is always among the regressors.

    Parameters
    ----------
    P
        Values of the terms.
    y
        Target.
    most
        Number of columns to take; fewer where the rest explains nothing.

    References
    ----------
    Chen, Billings & Luo, "Orthogonal least squares methods and their application to non-linear system
    identification", Int. J. Control 50, 1989.
    """
    size, energy = len(P), float(np.sum((y - y.mean()) ** 2))
    centred = P - P.mean(axis=0)
    norm = np.sqrt(np.einsum("ij,ij->j", centred, centred))
    live = norm > _DEAD * np.sqrt(size)
    centred /= np.where(live, norm, 1.0)
    target = y - y.mean()
    explains, left = target @ centred, np.where(live, 1.0, 0.0)  # ⟨w_j, y⟩ and ‖w_j‖², kept up to date
    basis, chosen = np.empty((most, size)), list[int]()
    while len(chosen) < most:
        usable = left > _DEPENDENT
        usable[chosen] = False
        gain = np.where(usable, explains**2 / np.where(usable, left, 1.0), 0.0)
        best = int(np.argmax(gain))
        if not gain[best] > _EXPLAINED * energy:
            break
        w = centred[:, best].copy()
        taken = basis[: len(chosen)]
        for _ in range(2):  # twice is enough to be orthogonal to rounding error
            w -= (taken @ w) @ taken
        w /= np.linalg.norm(w)
        basis[len(chosen)] = w
        chosen.append(best)
        along = w @ centred
        explains -= along * (w @ target)
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
