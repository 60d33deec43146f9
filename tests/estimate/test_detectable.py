"""Detectability against the observability matrix: its kernel must hold decaying modes alone."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from koopmpc.estimate.kalman import hidden

MODES = st.sampled_from([-1.3, -1.0, -0.6, 0.0, 0.4, 0.9, 1.0, 1.2])


def kernel(F, M):
    """An orthonormal basis of what y = M s never shows: the kernel of [M; MF; MF²; …]."""
    stack = [M]
    for _ in range(len(F) - 1):
        stack.append(stack[-1] @ F)
    _, sigma, right = np.linalg.svd(np.vstack(stack))
    rank = int((sigma > 1e-9 * max(sigma[0], 1e-300)).sum())
    return right[rank:].T


def detectable(F, M):
    N = kernel(F, M)
    return N.shape[1] == 0 or np.abs(np.linalg.eigvals(N.T @ F @ N)).max() < 1 - 1e-6


def rotated(modes, seen, seed):
    """F with these modes, of which only `seen` reach y, in a random orthonormal basis."""
    rng = np.random.default_rng(seed)
    T = np.linalg.qr(rng.normal(size=(len(modes), len(modes))))[0]
    M = rng.uniform(0.5, 1.5, size=(2, len(modes))) * np.array(seen)
    return T @ np.diag(modes) @ T.T, M @ T.T


@given(st.lists(st.tuples(MODES, st.booleans()), min_size=1, max_size=5, unique_by=lambda m: m[0]), st.integers())
def test_a_mode_is_hidden_exactly_where_the_observability_matrix_has_a_kernel_that_stays(modes, seed):
    F, M = rotated([m for m, _ in modes], [s for _, s in modes], abs(seed))
    lost = hidden(F, M)
    assert (lost is None) == detectable(F, M)
    if lost is not None:
        value, s = lost
        assert abs(value) >= 1 - 1e-6
        np.testing.assert_allclose(F @ s, value * s, atol=1e-6)
        np.testing.assert_allclose(M @ s, 0, atol=1e-6)


@given(st.integers(1, 4), st.integers(1, 2), st.booleans(), st.integers(0, 10**6))
def test_a_disturbance_is_detectable_exactly_where_the_rank_condition_holds(n, nd, integrator, seed):
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, nd)), rng.normal(size=(nd, n))
    Cd = rng.choice([0.0, 1.0]) * np.eye(nd)
    if integrator:
        A[:, 0] = np.eye(n)[0]  # A − I loses rank
        B, Cd = 0 * B, np.eye(nd)
    F = np.block([[A, B], [np.zeros((nd, n)), np.eye(nd)]])
    M = np.hstack([C, Cd])
    whole = np.block([[A - np.eye(n), B], [C, Cd]])
    ranks = np.linalg.matrix_rank(whole, 1e-6) == n + nd
    assert ranks == (hidden(F, M) is None) or not detectable(A, C)
    assert (hidden(F, M) is None) == detectable(F, M)


def test_units_of_y_do_not_decide():
    A, C = np.diag([1.0, 0.5]), np.array([[1.0, 1.0]])
    for scale in (1e-9, 1.0, 1e9):
        assert hidden(A, scale * C) is None
        assert hidden(np.eye(2), scale * C) is not None
