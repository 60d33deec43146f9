"""Bounds ‖S^−½ r‖ ≤ c_x ‖D⁻¹φ‖ + c_u ‖v/d‖ + c_0 of a model's error r, and what each is worth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.validate.binomial import bound_failure_rate

_LEAST = 1e-9  # constants below are rounding of exact data and count as this
_CELLS = 10_000  # of the grid of a covering
_NEAR = 16  # nearest pairs that bound the error on a cell; any pair is a bound


@dataclass(frozen=True)
class ErrorPairs:
    """Pairs of one step in deviations, and the episode of each: φ (M, n), v (M, m), r (M, n), x and u of the plant."""

    phi: Float[np.ndarray, "M n"]
    v: Float[np.ndarray, "M m"]
    r: Float[np.ndarray, "M n"]
    X: Float[np.ndarray, "M nx"]
    U: Float[np.ndarray, "M m"]
    episode: Float[np.ndarray, " M"]

    def within(self, low: Float[np.ndarray, " nx"], high: Float[np.ndarray, " nx"]) -> "ErrorPairs":
        """Return the pairs whose state lies in the box."""
        inside = ((low <= self.X) & (high >= self.X)).all(axis=1)
        return self.of(np.asarray(inside))

    def of(self, chosen: np.ndarray) -> "ErrorPairs":
        """Return the chosen pairs."""
        return ErrorPairs(*(getattr(self, name)[chosen] for name in ("phi", "v", "r", "X", "U", "episode")))


@dataclass(frozen=True, eq=False)
class ErrorBound(Value):
    """A bound of the error of a model on a box of states and inputs.

    Attributes
    ----------
    method
        "given": the user's constants. "lipschitz": from the user's Lipschitz constant of the error. "covering": from
        it and the pairs. "scenario": the least constants that hold on calibration pairs.
    c_x, c_u, c_0
        The constants; c_0 is 0 where the error vanishes at the set point.
    shape
        (n, n) S; the identity in the coordinates D where the constants are given.
    phi_size, v_size
        (n,), (m,) D and d: sizes of the entries of φ and v.
    episodes, pairs
        Independent episodes, and pairs, behind a scenario bound; 0 for the others.
    share, confidence
        Of a scenario bound: it holds on all pairs of at least 1 − share of episodes drawn like the calibration
        episodes, with this confidence; of a Certificate, whichever of its bounds was chosen. 0 and 1 for the others.
    held_out, broken
        Pairs that were not used, and how many of them broke the bound.
    lipschitz
        The user's Lipschitz constant; 0 without one.
    """

    method: Literal["given", "lipschitz", "covering", "scenario"]
    c_x: float
    c_u: float
    c_0: float
    shape: Float[np.ndarray, "n n"]
    phi_size: Float[np.ndarray, " n"]
    v_size: Float[np.ndarray, " m"]
    episodes: int = 0
    pairs: int = 0
    share: float = 0.0
    confidence: float = 1.0
    held_out: int = 0
    broken: int = 0
    lipschitz: float = 0.0

    def measure(self, pairs: ErrorPairs) -> Float[np.ndarray, " M"]:
        """Return ‖S^−½ r‖ − c_x ‖D⁻¹φ‖ − c_u ‖v/d‖ − c_0 of each pair; above zero it breaks the bound."""
        size, phi, v = self.norms(pairs)
        return size - self.c_x * phi - self.c_u * v - self.c_0

    def norms(
        self, pairs: ErrorPairs
    ) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"], Float[np.ndarray, " M"]]:
        """Return ‖S^−½ r‖, ‖D⁻¹φ‖ and ‖v/d‖ of each pair."""
        L = np.linalg.cholesky(self.shape)
        return (
            np.linalg.norm(np.linalg.solve(L, pairs.r.T), axis=0),
            np.linalg.norm(pairs.phi / self.phi_size, axis=1),
            np.linalg.norm(pairs.v / self.v_size, axis=1),
        )

    def scale_by(self, factor: float) -> "ErrorBound":
        """Return the bound with all its constants multiplied."""
        return replace(self, c_x=factor * self.c_x, c_u=factor * self.c_u, c_0=factor * self.c_0)


def split_pairs(pairs: ErrorPairs, rng: np.random.Generator, *, share: float = 2 / 3) -> tuple[ErrorPairs, ErrorPairs]:
    """Return the pairs of this share of the episodes, and those of the others."""
    names = np.unique(pairs.episode)
    chosen = rng.permutation(names)[: max(1, int(share * len(names)))]
    is_first = np.isin(pairs.episode, chosen)
    return pairs.of(is_first), pairs.of(~is_first)


def shape_of(pairs: ErrorPairs, phi_size: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return S, the second moment of the errors, so that ‖S^−½ r‖ is about one share of the sizes.

    A model often errs in few observables only; S lets a proof know in which.
    """
    r = pairs.r / phi_size
    # errors grow with φ and v: the share of each pair counts, and pairs near the set point count as much as others
    share = r / np.maximum(np.linalg.norm(r, axis=1, keepdims=True), 1e-300)
    moment = share.T @ share / max(len(r), 1)
    largest = float(np.linalg.eigvalsh(moment)[-1]) if len(r) else 0.0
    if not largest > 0:
        return np.diag(phi_size**2)
    # the shape of the error has eigenvalues of at least this share of the largest
    S = moment / largest + 1e-6 * np.eye(len(phi_size))
    return S * np.outer(phi_size, phi_size)


def bound_by_scenario(
    pairs: ErrorPairs,
    shape: Float[np.ndarray, "n n"],
    phi_size: Float[np.ndarray, " n"],
    v_size: Float[np.ndarray, " m"],
    *,
    sizing: ErrorPairs,
    constant: bool,
    confidence: float,
    held_out: ErrorPairs,
) -> ErrorBound | None:
    """Return the least constants that hold on all pairs, as a scenario program of two or three unknowns.

    Campi and Garatti (SIAM J. Optim. 19, 2008) speak of a convex program with d unknowns and one constraint for each
    of n independent episodes. A new episode breaks its optimum with probability at most ε, with confidence 1 − β. Here
    Σ_{i<d} C(n, i) εⁱ (1 − ε)ⁿ⁻ⁱ = β. None where there are too few episodes.

    The argument takes the shape, the sizes, the weights and the least values of the constants as given. They come from
    the `sizing` pairs, which have to be of other episodes.
    """
    episodes = len(np.unique(pairs.episode))
    # fewer calibration episodes bound nothing
    if episodes < 10:
        return None
    bound = ErrorBound("scenario", 0.0, 0.0, 0.0, shape, phi_size, v_size)
    size, phi, v = bound.norms(sizing)
    means = [max(float(column.mean()), 1e-12) for column in (phi, v, *([np.ones(len(phi))] if constant else []))]
    # samples rarely have φ or v near 0 alone: each constant is at least half the usual error per unit of both
    usual = 0.5 * float(np.median(size / np.maximum(phi + v, 1e-300)))
    size, phi, v = bound.norms(pairs)
    columns = [phi, v, *([np.ones(len(phi))] if constant else [])]
    unit = max(float(size.max()), 1e-12)
    rows = np.stack(columns, axis=1)
    bounds = [(0.0 if i == 2 else usual / unit, None) for i in range(len(columns))]
    from scipy.optimize import linprog  # slow to import

    found = linprog(means, A_ub=-rows, b_ub=-size / unit, bounds=bounds, method="highs")
    if found.status != 0:
        return None
    c = np.maximum(np.asarray(found.x, dtype=np.float64) * unit, [_LEAST, _LEAST, 0.0][: len(columns)])
    excess = float(np.max(size / np.maximum(rows @ c, 1e-300)))  # rounding of the linear program
    c = c * max(1.0, excess)
    result = replace(
        bound,
        c_x=float(c[0]),
        c_u=float(c[1]),
        c_0=float(c[2]) if constant else 0.0,
        episodes=episodes,
        pairs=len(phi),
        share=bound_failure_rate(len(columns) - 1, episodes, confidence=confidence),
        confidence=confidence,
    )
    broken = int((result.measure(held_out) > 0).sum()) if len(held_out.phi) else 0
    return replace(result, held_out=len(held_out.phi), broken=broken)


def bound_by_lipschitz(
    constant: float, pairs: ErrorPairs, phi_size: Float[np.ndarray, " n"], v_size: Float[np.ndarray, " m"]
) -> ErrorBound:
    """Return c_x = c_u = L of an error with ‖r(x, u) − r(x′, u′)‖ ≤ L (‖x − x′‖ + ‖u − u′‖) that is 0 at the set point.

    Norms are of D⁻¹r, x/d_x and u/d, where d_x are the entries of D of the states. The constant is the user's: pairs
    can refute it, and cannot prove it.
    """
    shape = np.diag(phi_size**2)
    bound = ErrorBound("lipschitz", constant, constant, 0.0, shape, phi_size, v_size, lipschitz=constant)
    excess = bound.measure(pairs)
    if len(excess) and excess.max() > 0:
        size, phi, v = bound.norms(pairs)
        needed = float(np.max(size / np.maximum(phi + v, 1e-300)))
        raise DataError(
            f"lipschitz={constant:.4g} is refuted by {int((excess > 0).sum())} of {len(excess)} pairs; the data need"
            f" {needed:.4g} at least"
        )
    return replace(bound, held_out=len(excess))


def bound_by_covering(
    constant: float,
    pairs: ErrorPairs,
    phi_size: Float[np.ndarray, " n"],
    v_size: Float[np.ndarray, " m"],
    *,
    x_size: Float[np.ndarray, " nx"],
    low: Float[np.ndarray, " nxm"],
    high: Float[np.ndarray, " nxm"],
    center: Float[np.ndarray, " nxm"],
) -> ErrorBound | None:
    """Return constants that hold on a whole box of [x; u] around `center`, from pairs and a Lipschitz constant L.

    ‖r(x, u)‖ ≤ ‖r_i‖ + L (‖x − x_i‖ + ‖u − u_i‖) for every pair i, in norms of D⁻¹r, x/d_x and u/d. On a cell of a grid
    this is at most the value in its middle, plus L times the reach of the cell. The least c_x, c_u and c_0 above it on
    all cells are those of a linear program; ‖D⁻¹φ‖ is at least ‖(x − x_s)/d_x‖, for the lifting holds the states. So
    the bound is proved where L is.
    """
    from scipy.optimize import linprog  # slow to import
    from scipy.spatial import cKDTree

    nx, size = len(x_size), np.concatenate([x_size, v_size])
    points, errors = np.hstack([pairs.X, pairs.U]) / size, pairs.r / phi_size
    if 2 ** len(size) > _CELLS:
        raise DataError(
            f"a covering of {len(size)} states and inputs has too many cells; leave estimated or lipschitz out"
        )
    tree = cKDTree(points)

    def measure(away: Float[np.ndarray, "... nxm"]) -> Float[np.ndarray, "..."]:
        return np.asarray(np.linalg.norm(away[..., :nx], axis=-1) + np.linalg.norm(away[..., nx:], axis=-1))

    near = np.asarray(tree.query(points, min(_NEAR, len(points)))[1])
    change = np.linalg.norm(errors[near] - errors[:, None], axis=-1)
    needed = float((change / np.maximum(measure(points[near] - points[:, None]), 1e-12)).max())
    if needed > constant * (1 + 1e-6):
        raise DataError(f"lipschitz={constant:.4g} is refuted by two pairs; the data need {needed:.4g} at least")
    count = max(2, int(_CELLS ** (1 / len(size))))
    half = (high - low) / (2 * count * size)
    steps = np.indices((count,) * len(size)).reshape(len(size), -1).T
    middle: Float[np.ndarray, "cells nxm"] = low / size + half * (1 + 2 * steps)
    reach = np.array([np.linalg.norm(half[:nx]), np.linalg.norm(half[nx:])])
    near = np.asarray(tree.query(middle, min(_NEAR, len(points)))[1])
    above = np.linalg.norm(errors, axis=1)[near] + constant * measure(points[near] - middle[:, None])
    most = above.min(axis=1) + constant * reach.sum()
    away = middle - center / size
    least = np.stack([np.linalg.norm(away[:, :nx], axis=1), np.linalg.norm(away[:, nx:], axis=1)], axis=1) - reach
    rows = np.hstack([np.maximum(least, 0.0), np.ones((len(middle), 1))])
    # weight of the constant part of a covering, which sets the ball, beside those of the others
    worth = rows.mean(axis=0) * [1.0, 1.0, 3.0]
    found = linprog(worth, A_ub=-rows, b_ub=-most, bounds=(0, None), method="highs")
    if found.status != 0:
        return None
    c = np.maximum(np.asarray(found.x, dtype=np.float64), _LEAST)
    c *= max(1.0, float((most / (rows @ c)).max()))  # rounding of the linear program
    shape = np.diag(phi_size**2)
    return ErrorBound(
        "covering",
        float(c[0]),
        float(c[1]),
        float(c[2]),
        shape,
        phi_size,
        v_size,
        pairs=len(points),
        lipschitz=constant,
    )


def sizes_of(values: Sequence[Float[np.ndarray, " M"]] | Float[np.ndarray, "M n"]) -> Float[np.ndarray, " n"]:
    """Return the root mean square of each column, 1 where it is zero."""
    size = np.sqrt((np.asarray(values) ** 2).mean(axis=0))
    return np.where(size > 0, size, 1.0)
