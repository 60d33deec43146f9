"""The maximal positively invariant polytope: invariant, maximal, without redundant rows."""

import numpy as np
import pytest

import koopmpc as km


def make_loop(seed):
    """Return a stable random loop and limits around the origin."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.6, 0.95) / np.abs(np.linalg.eigvals(A)).max()
    H = np.vstack([np.eye(n), -np.eye(n), rng.normal(size=(2, n))])
    return A, H, rng.uniform(0.5, 2.0, len(H)), rng


@pytest.mark.parametrize("seed", range(6))
def test_a_state_lies_in_it_if_and_only_if_its_loop_keeps_the_limits(seed):
    A, H, h, rng = make_loop(seed)
    found = km.guarantees.find_invariant_set(A, H, h)
    Z = rng.uniform(-2, 2, (3000, len(A)))
    inside, kept, z = found.contains(Z), np.ones(3000, dtype=bool), Z
    for _ in range(300):
        kept &= (z @ H.T <= h * (1 + 1e-9)).all(axis=1)
        z = z @ A.T
    assert (inside == kept).all()
    assert 0 < inside.sum() < 3000
    assert found.contains(Z[inside] @ A.T).all()


@pytest.mark.parametrize("seed", range(3))
def test_no_row_can_be_left_out(seed):
    from scipy.optimize import linprog

    A, H, h, _ = make_loop(seed)
    found = km.guarantees.find_invariant_set(A, H, h)
    for i in range(len(found.H)):
        others = np.delete(np.arange(len(found.H)), i)
        most = linprog(-found.H[i], A_ub=found.H[others], b_ub=found.h[others], bounds=(None, None))
        assert most.status != 0 or -most.fun > found.h[i]


def test_bad_input_is_an_error_that_says_what_to_do():
    find = km.guarantees.find_invariant_set
    with pytest.raises(km.errors.DataError, match=r"spectral radius 1\.1"):
        find([[1.1]], [[1.0]], [1.0])
    with pytest.raises(km.errors.DataError, match="exclude the set point"):
        find([[0.5]], [[1.0], [-1.0]], [1.0, 0.0])
    turn = 0.999999 * np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    with pytest.raises(km.errors.CertificateError, match="the polytope does not end"):
        find(turn, [[1.0, 0.0], [-1.0, 0.0]], [1.0, 1.0], most_steps=5)
