"""Random liftings and states for the property tests."""

from collections.abc import Callable

import casadi as ca
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import koopmpc as km
from koopmpc.lifting.base import buffer_lifting as buffer_lifting

NAMES = ("theta [rad]", "omega [rad/s]", "p [m]")


def swing(x: ca.SX) -> list[ca.SX]:
    return [x[0] * ca.cos(x[0]), ca.fmax(x[0], 0.3), ca.sqrt(1 + x[0] ** 2)]


Recipe = tuple[Callable[..., km.Lifting], tuple[object, ...]]  # a class, or a function, and what it is called with
Case = tuple[list[Recipe], np.ndarray]


def numbers(limit: float = 3.0) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_subnormal=False)


def states(nx: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, st.tuples(st.integers(1, 6), st.just(nx)), elements=numbers())


def product(first: Recipe, second: Recipe) -> km.Lifting:
    return first[0](*first[1]) * second[0](*second[1])


def standardized(inner: Recipe, mean: np.ndarray, scale: np.ndarray) -> km.Lifting:
    return km.lifting.Standardized(inner[0](*inner[1]), mean, scale)


def family(nx: int) -> st.SearchStrategy[Recipe]:
    simple = basic(nx)
    mean = arrays(np.float64, nx, elements=numbers(1.0))
    scale = arrays(np.float64, nx, elements=st.floats(0.5, 4))
    return st.one_of(
        simple,
        st.tuples(st.just(product), st.tuples(simple, simple)),
        st.tuples(st.just(standardized), st.tuples(simple, mean, scale)),
    )


def basic(nx: int) -> st.SearchStrategy[Recipe]:
    centers = arrays(np.float64, st.tuples(st.integers(1, 3), st.just(nx)), elements=numbers(), unique=True)
    return st.one_of(
        st.just((km.State, ())),
        st.just((km.State, (0,))),
        st.just((km.Constant, ())),
        st.tuples(st.just(km.RandomFourier), st.tuples(st.integers(1, 4), st.floats(0.3, 3), st.integers(0, 9))),
        st.tuples(st.just(km.Monomials), st.tuples(st.integers(2, 4))),
        st.tuples(st.just(km.Fourier), st.tuples(st.integers(1, 3), st.sampled_from([None, 0, NAMES[0], "theta"]))),
        st.tuples(st.just(km.ThinPlate), st.tuples(centers)),
        st.tuples(st.just(km.Gaussian), st.tuples(centers, st.floats(0.1, 3))),
        st.just((km.Expressions, (swing, ("theta*cos(theta)", "ramp", "root")))),
    )


def cases() -> st.SearchStrategy[Case]:
    """Recipes, not liftings: the type hook draws random numbers, which a strategy must not."""
    return st.integers(1, 3).flatmap(lambda nx: st.tuples(st.lists(family(nx), min_size=1, max_size=4), states(nx)))


def made(case: Case) -> tuple[km.Lifting, np.ndarray]:
    recipes, X = case
    parts = [kind(*arguments) for kind, arguments in recipes]
    return sum(parts[1:], start=parts[0]).bind(NAMES[: X.shape[1]]), X
