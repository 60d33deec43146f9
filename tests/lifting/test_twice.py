"""A lifting evaluates arrays and symbols as one function."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.lifting.families import NAMES, Case, cases, made, swing
from tests.roundtrip import returned


def symbolically(lifting: km.Lifting, X: np.ndarray) -> np.ndarray:
    x = ca.SX.sym("x", X.shape[1])
    psi = ca.Function("psi", [x], [lifting.symbolic(x)])
    return np.array([np.array(psi(row)).ravel() for row in X])


@given(cases())
def test_arrays_and_symbols_agree(case: Case) -> None:
    lifting, X = made(case)
    Z, S = lifting(X), symbolically(lifting, X)
    assert Z.shape == (len(X), lifting.nz)
    assert (np.abs(Z - S) <= 1e-12 * np.maximum(1.0, np.abs(S))).all()


@given(cases())
def test_a_batch_is_its_rows(case: Case) -> None:
    lifting, X = made(case)
    Z = lifting(X)
    assert Z.dtype == np.float64
    assert Z.flags.c_contiguous
    for row, z in zip(X, Z, strict=True):
        np.testing.assert_allclose(lifting(row), z, rtol=1e-12, atol=1e-15)


@given(cases(), st.integers(0, 2**32 - 1))
def test_long_tables_are_cut_into_blocks_without_a_seam(case: Case, seed: int) -> None:
    lifting, X = made(case)
    rng = np.random.default_rng(seed)
    many = rng.choice(X, 2500)
    some = rng.choice(2500, 20)
    np.testing.assert_allclose(lifting(many)[some], lifting(many[some]), rtol=1e-12, atol=1e-15)


@given(cases())
def test_saved_as_data_and_back(case: Case) -> None:
    lifting, X = made(case)
    again = returned(lifting)
    assert again == lifting
    assert np.array_equal(again(X), lifting(X))


@pytest.mark.parametrize(
    ("lifting", "expected"),
    [
        (km.State(), lambda x: [x[0], x[1]]),
        (km.Constant(), lambda x: [1.0]),
        (
            km.Monomials(3),
            lambda x: [x[0] ** a * x[1] ** b for a, b in [(2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]],
        ),
        (km.Fourier(2, 1), lambda x: [f(k * x[1]) for k in (1, 2) for f in (np.sin, np.cos)]),
        (km.ThinPlate([[1, 2], [0, -1]]), lambda x: [r**2 * np.log(r) for r in _distances(x)]),
        (km.Gaussian([[1, 2], [0, -1]], 0.7), lambda x: [np.exp(-((r / 0.7) ** 2) / 2) for r in _distances(x)]),
        (
            km.Expressions(swing, ["a", "b", "c"]),
            lambda x: [x[0] * np.cos(x[0]), max(x[0], 0.3), np.hypot(1, x[0])],
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_each_family_is_its_formula(lifting: km.Lifting, expected: object) -> None:
    X = np.random.default_rng(1).normal(size=(50, 2))
    Z = lifting.bind(NAMES[:2])(X)
    assert callable(expected)
    np.testing.assert_allclose(Z, [expected(x) for x in X], rtol=1e-12, atol=1e-14)


def _distances(x: np.ndarray) -> list[float]:
    return [float(np.linalg.norm(x - c)) for c in ([1, 2], [0, -1])]


def test_a_thin_plate_is_zero_and_smooth_at_its_centre() -> None:
    center = [0.3, -1.7]
    lifting = km.ThinPlate([center]).bind(NAMES[:2])
    x = ca.SX.sym("x", 2)
    z = lifting.symbolic(x)
    hessian, gradient = ca.hessian(z, x)
    values = ca.Function("values", [x], [z, gradient, hessian])
    at_center = [np.array(value) for value in values(center)]
    assert lifting(center) == pytest.approx(0, abs=1e-300)
    assert (at_center[0] == 0).all()
    assert (at_center[1] == 0).all()
    assert np.isfinite(at_center[2]).all()


@pytest.mark.parametrize("offset", [0.0, 1e4])
@pytest.mark.parametrize("nx", [1, 2, 6])
def test_distances_keep_their_digits_near_a_centre_and_far_from_the_origin(nx: int, offset: float) -> None:
    rng = np.random.default_rng(nx)
    centers = offset + rng.standard_normal((40, nx))
    near = centers + np.repeat([0.0, 1e-12, 1e-6, 1e-2], 10)[:, None] * rng.standard_normal((40, nx))
    X = np.vstack([near, offset + 10 * rng.standard_normal((40, nx))])
    found = km.ThinPlate(centers).bind([f"x{i}" for i in range(nx)])(X)
    wide = X.astype(np.longdouble)[:, None] - centers.astype(np.longdouble)
    squares = np.sum(wide**2, axis=2)
    logs = np.log(np.where(squares > 0, squares, 1.0)) / 2
    assert (np.abs(found - squares * logs) <= 1e-12 * squares * (1 + np.abs(logs))).all()
