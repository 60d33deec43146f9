"""Small exact plants and brute-force oracles for the tests of identification."""

from collections.abc import Callable

import numpy as np

import koopmpc as km


def random_episodes(
    seed: int, lengths: list[int], nx: int, nu: int, *, noise: float = 1.0, scale: float = 1.0
) -> km.Episodes:
    """Episodes of pure noise: nothing of one row follows from another, so that no wrong pair goes unseen."""
    rng = np.random.default_rng(seed)
    parts = [
        km.Episode(
            X=scale * rng.uniform(-noise, noise, (length + 1, nx)),
            U=rng.uniform(-1, 1, (length, nu)),
        )
        for length in lengths
    ]
    return km.Episodes(parts, 0.1)


def one_step_pairs(
    step: Callable[[np.ndarray, np.ndarray], np.ndarray], nx: int, nu: int, count: int, seed: int = 0
) -> km.Episodes:
    """Return `count` episodes of one step from x, u ~ U[-1, 1]."""
    rng = np.random.default_rng(seed)
    parts: list[km.Episode] = []
    for _ in range(count):
        x, u = rng.uniform(-1, 1, nx), rng.uniform(-1, 1, nu)
        parts.append(km.Episode(X=[x, step(x, u)], U=[u]))
    return km.Episodes(parts, 0.01)


def brute_force(episodes: km.Episodes, lifting: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return every row [ψ(x) u ψ(x⁺)], one at a time."""
    return np.array(
        [np.concatenate([lifting(e.X[k]), e.U[k], lifting(e.X[k + 1])]) for e in episodes for k in range(len(e))]
    )
