"""Predictors for the tests: random, stable, in several liftings."""

import numpy as np

from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import State
from koopmpc.predict.linear import LinearPredictor


def random_predictor(
    seed: int, nx: int, nu: int, lifting: Lifting | None = None, radius: float = 0.95, dt: float = 0.1
) -> LinearPredictor:
    """Return a predictor whose A has this spectral radius; C is the identity on State, else random."""
    rng = np.random.default_rng(seed)
    states = tuple(f"x{i} [m]" for i in range(nx))
    bound = (lifting or State()).bind(states)
    A = rng.standard_normal((bound.nz, bound.nz))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C = np.eye(nx) if lifting is None else rng.standard_normal((nx, bound.nz))
    B = rng.standard_normal((bound.nz, nu))
    return LinearPredictor(A, B, C, bound, dt, states, tuple(f"u{i} [N]" for i in range(nu)))
