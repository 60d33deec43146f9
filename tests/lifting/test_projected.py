"""A projection is the product with its basis, on arrays, on symbols and from a file."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.roundtrip import returned

STATES = ("a [m]", "b [m/s]")
INNER = km.Constant() + km.State() + km.Monomials(3)


@given(st.integers(1, 10), st.integers(0, 999))
def test_it_is_the_product_with_the_basis_on_arrays_and_symbols(r: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    basis = rng.standard_normal((INNER.bind(STATES).nz, r))
    lifting = km.lifting.Projected(INNER, basis).bind(STATES)
    X = rng.uniform(-2, 2, (5, 2))
    expected = INNER.bind(STATES)(X) @ basis
    assert np.allclose(lifting(X), expected, atol=1e-12)
    x = ca.SX.sym("x", 2)
    f = ca.Function("f", [x], [lifting.symbolic(x)])
    assert np.allclose([np.array(f(row)).ravel() for row in X], expected, atol=1e-12)
    assert lifting.nz == r == len(lifting.names)


def test_it_is_saved_as_data_with_a_traced_function_inside() -> None:
    inner = km.State() + km.Expressions(lambda x: [ca.sin(x[0]) * x[1]], ["swing"])
    lifting = km.lifting.Projected(inner, np.arange(6.0).reshape(3, 2)).bind(STATES)
    again = returned(lifting)
    assert isinstance(again, km.lifting.Projected)
    assert np.array_equal(again([[0.3, 2.0]]), lifting([[0.3, 2.0]]))


def test_a_basis_of_another_height_is_refused() -> None:
    with pytest.raises(km.errors.ShapeError, match="basis has 4 rows, the lifting returns 2 observables"):
        km.lifting.Projected(km.State(), np.ones((4, 2))).bind(STATES)
