"""A covering bound is a proof, given L: the true error never exceeds it where L is right, and pairs may refute L."""

import numpy as np
import pytest

import koopmpc as km
from tests.searches import certify
from tests.tiers import few

A, B = np.array([[1.1, 0.2], [0.0, 0.8]]), np.array([[0.0], [0.5]])
MODEL = km.LinearPredictor(A, B, np.eye(2), km.State(), 1.0, ["a", "b"], ["u"])


def find_error(X, U, size, offset):
    """Return size sin(2 a + u) + offset in the second state: |∂r/∂a| ≤ 2 size, |∂r/∂u| ≤ size."""
    return np.stack([np.zeros(len(X)), size * np.sin(2 * X[:, 0] + U[:, 0]) + offset], axis=1)


def draw_pairs(count, size, offset):
    """Return independent pairs, and L in the sizes of these data."""
    rng = np.random.default_rng(0)
    X, U = rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, (count, 1))
    X_next = X @ A.T + U @ B.T + find_error(X, U, size, offset)
    pairs = [km.Episode(X=np.stack(pair), U=u[None]) for *pair, u in zip(X, X_next, U, strict=True)]
    d_x, d_u = np.sqrt((X**2).mean(axis=0)), np.sqrt((U**2).mean())
    return km.Episodes(pairs, dt=1.0), 1.001 * size / d_x[1] * max(2 * d_x[0], d_u)


@pytest.mark.parametrize("offset", few([0.0, 0.01], 0.01))
def test_the_true_error_never_exceeds_a_covering_bound(offset):
    data, L = draw_pairs(500, 0.02, offset)
    certificate = certify(MODEL, data, lipschitz=L, estimated=True)
    error, rng = certificate.error, np.random.default_rng(1)
    X = rng.uniform(certificate.low, certificate.high, (10_000, 2))
    U = certificate.deviation.u + certificate.v_max * rng.uniform(-1, 1, (10_000, 1))
    phi, v = certificate.deviation.lift(X), U - certificate.deviation.u
    r = X @ A.T + U @ B.T + find_error(X, U, 0.02, offset) - certificate.deviation.advance(phi, v)
    size, other = (np.linalg.norm(one / error.phi_size, axis=1) for one in (r - certificate.deviation.x, phi))
    bound = error.c_x * other + error.c_u * np.linalg.norm(v / error.v_size, axis=1) + error.c_0
    assert (size <= bound).all()
    assert size.max() > 0.2 * (error.c_0 + error.c_x + error.c_u)  # it is not far above the error everywhere
    assert certificate.is_proof
    assert 0 < certificate.ball < 1
    page = certificate.page()
    assert "a proof, given L" in page
    assert f"you gave L = {L:.4g}" in page


def test_denser_pairs_prove_a_smaller_ball():
    few, many = (draw_pairs(count, 0.02, 0.0) for count in (300, 3000))
    wide, small = (certify(MODEL, data, lipschitz=L, estimated=True) for data, L in (few, many))
    assert small.ball < 0.7 * wide.ball
    assert small.error.c_0 < wide.error.c_0


def test_pairs_refute_a_constant_and_bad_input_is_said():
    data, L = draw_pairs(500, 0.02, 0.0)
    with pytest.raises(km.errors.DataError, match="is refuted by two pairs; the data need"):
        certify(MODEL, data, lipschitz=0.3 * L, estimated=True)
    with pytest.raises(km.errors.DataError, match="leave error out, or pass lipschitz"):
        certify(MODEL, data, error=(0.1, 0.1), estimated=True)
    with pytest.raises(km.errors.DataError, match="a covering needs exact pairs"):
        certify(MODEL, data, lipschitz=L, estimated=True, noise=0.01)
    steep, L = draw_pairs(500, 0.05, 0.01)
    with pytest.raises(km.errors.CertificateError, match=r"c_0 .* or a wider box, and denser data for the covering"):
        certify(MODEL, steep, lipschitz=2 * L, estimated=True)
