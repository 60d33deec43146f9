"""Predictors for the tests: random, stable, in several liftings."""

import numpy as np

import koopmpc as km


def random_predictor(
    seed: int, nx: int, nu: int, lifting: km.Lifting | None = None, radius: float = 0.95, dt: float = 0.1
) -> km.LinearPredictor:
    """Return a predictor whose A has this spectral radius; C is the identity on State, else random."""
    rng = np.random.default_rng(seed)
    states = tuple(f"x{i} [m]" for i in range(nx))
    bound = (lifting or km.State()).bind(states)
    A = rng.standard_normal((bound.nz, bound.nz))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C = np.eye(nx) if lifting is None else rng.standard_normal((nx, bound.nz))
    B = rng.standard_normal((bound.nz, nu))
    return km.LinearPredictor(A, B, C, bound, dt, states, tuple(f"u{i} [N]" for i in range(nu)))
