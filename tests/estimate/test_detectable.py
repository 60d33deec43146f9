"""Detectability against the observability matrix: its kernel must hold decaying modes alone."""

import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import koopmpc as km

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


def told(A, B, H, disturbance):
    """Return the λ that LiftedKalman names as not detectable from H z; None where it filters."""
    states, inputs = ([f"{letter}{i}" for i in range(n)] for letter, n in zip("xu", B.shape, strict=True))
    model = km.LinearPredictor(A, B, np.eye(len(A)), km.State(), 0.1, states, inputs)
    try:
        km.LiftedKalman(H, disturbance, noise=np.sum(H**2, axis=1)).start(model, 20)
    except km.errors.DataError as error:
        return complex(re.search(r"not detectable from .* with λ = ([^ ]+), ", str(error))[1])
    return None


def augmented(A, B, H, disturbance):
    """Return the motion of [z; d] and its rows in y."""
    n, nd = len(A), len(H)
    pushed, offset = (B, np.zeros((nd, nd))) if disturbance == "input" else (np.zeros((n, nd)), np.eye(nd))
    return np.block([[A, pushed], [np.zeros((nd, n)), np.eye(nd)]]), np.hstack([H, offset])


@given(st.lists(st.tuples(MODES, st.booleans()), min_size=2, max_size=5, unique_by=lambda m: m[0]), st.integers(0, 999))
def test_a_mode_is_told_exactly_where_the_observability_matrix_has_a_kernel_that_stays(modes, seed):
    A, H = rotated([m for m, _ in modes], [s for _, s in modes], seed)
    assume(sum(seen for _, seen in modes) > 1)  # else the two outputs depend on each other
    F, M = augmented(A, np.zeros((len(A), 1)), H, "output")
    value = told(A, np.zeros((len(A), 1)), H, "output")
    assert (value is None) == detectable(F, M)
    if value is not None:
        N = kernel(F, M)
        assert abs(value) >= 1 - 1e-6
        assert np.abs(np.linalg.eigvals(N.T @ F @ N) - value).min() < 1e-3


@given(
    st.integers(2, 4),
    st.integers(1, 2),
    st.sampled_from(["input", "no trace", "output", "integrator"]),
    st.integers(0, 10**6),
)
def test_a_disturbance_is_detectable_exactly_where_the_rank_condition_holds(n, nd, kind, seed):
    rng = np.random.default_rng(seed)
    A, B, H = rng.normal(size=(n, n)), rng.normal(size=(n, nd)), rng.normal(size=(nd, n))
    disturbance = "input" if kind in ("input", "no trace") else "output"
    if kind == "integrator":
        A[:, 0] = np.eye(n)[0]  # A − I loses rank
    if kind == "no trace":
        assume(nd < n)
        B[:, 0] = (np.eye(n) - A) @ np.linalg.svd(H)[2][-1]  # holds a z that y does not show
    F, M = augmented(A, B, H, disturbance)
    ranks = np.linalg.matrix_rank(np.block([[A - np.eye(n), F[:n, n:]], [H, M[:, n:]]]), 1e-6) == n + nd
    value = told(A, B, H, disturbance)
    assert ranks == (kind in ("input", "output"))
    assert (value is None) == detectable(F, M) == (ranks and detectable(A, H))
    assert ranks or abs(value - 1) < 1e-3 or not detectable(A, H)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_of_y_do_not_decide(scale):
    H, B = np.array([[scale, scale]]), np.ones((2, 1))
    assert told(np.diag([1.0, 0.5]), B, H, "input") is None
    assert told(np.eye(2), B, H, "input") == 1.0


def test_a_sensor_that_its_noise_drowns_is_refused_in_a_sentence():
    model = km.LinearPredictor(np.diag([1.0, 0.5]), np.ones((2, 1)), np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))
    with pytest.raises(km.errors.DataError, match="no stationary filter was found"):
        km.LiftedKalman([[1e-9, 1e-9]]).start(model, 20)
