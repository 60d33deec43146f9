"""Random features: their inner product is the Gaussian kernel, at the rate of Monte Carlo."""

import numpy as np
import pytest

import koopmpc as km
from tests.lifting.families import NAMES, buffer_lifting
from tests.roundtrip import returned


def _error(count: int, seed: int) -> float:
    """Return the root-mean-square error of ψ(x)·ψ(y) against the kernel over pairs of points."""
    rng = np.random.default_rng(99)
    X, Y, width = rng.normal(size=(60, 2)), rng.normal(size=(60, 2)), 1.3
    lifting = km.RandomFourier(count, width, seed).bind(NAMES[:2])
    kernel = np.exp(-((X - Y) ** 2).sum(axis=1) / (2 * width**2))
    return float(np.sqrt(np.mean(((lifting(X) * lifting(Y)).sum(axis=1) - kernel) ** 2)))


def test_inner_products_approach_the_gaussian_kernel_at_rate_one_over_the_root_of_count() -> None:
    counts = np.array([50, 200, 800, 3200])
    errors = np.array([np.sqrt(np.mean([_error(n, seed) ** 2 for seed in range(12)])) for n in counts.tolist()])
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert -0.6 < slope < -0.4
    assert (errors * np.sqrt(counts) < 1.0).all()  # the variance of a feature's product is at most 1


def test_on_average_over_seeds_the_inner_product_is_the_kernel() -> None:
    x, y = np.array([0.4, -0.3]), np.array([-0.5, 0.6])
    drawn = [km.RandomFourier(50, 0.8, seed).bind(NAMES[:2]) for seed in range(400)]
    products = np.array([lifting(x) @ lifting(y) for lifting in drawn])
    kernel = np.exp(-np.sum((x - y) ** 2) / (2 * 0.8**2))
    assert abs(products.mean() - kernel) < 4 * products.std() / np.sqrt(len(products))


def test_one_seed_is_one_lifting_and_a_generator_gives_one() -> None:
    a, b = km.RandomFourier(5, 1.0, 3).bind(NAMES), km.RandomFourier(5, 1.0, 3).bind(NAMES)
    assert a == b
    assert km.RandomFourier(5, 1.0, 4).bind(NAMES) != a
    assert km.RandomFourier(5, 1.0, np.random.default_rng(1)) == km.RandomFourier(5, 1.0, np.random.default_rng(1))
    assert (a + km.RandomFourier(5, 1.0, 4).bind(NAMES) + b).nz == 10


def test_a_bound_copy_keeps_what_it_drew_in_a_file_too() -> None:
    lifting = km.RandomFourier(4, 0.5, 7).bind(NAMES[:2])
    assert lifting.bind(("a", "b")).frequencies is not None
    assert np.array_equal(lifting.bind(("a", "b")).frequencies, lifting.frequencies)
    assert lifting.bind(NAMES) == km.RandomFourier(4, 0.5, 7).bind(NAMES)
    again = returned(lifting)
    assert again == lifting
    x = np.array([0.2, -1.0])
    assert np.array_equal(again(x), lifting(x))
    assert buffer_lifting(lifting)(x)[0] == pytest.approx(lifting(x), rel=1e-12)
