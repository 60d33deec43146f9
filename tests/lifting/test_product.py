"""Products of liftings: every pair once, in one order of factors."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings

import koopmpc as km
from tests.lifting.families import NAMES, Case, buffer_lifting, cases, made
from tests.roundtrip import returned


def places(whole: km.Lifting, part: km.Lifting) -> list[int]:
    """Return where the observables of `part` stand in `whole`, by name."""
    return [whole.names.index(name) for name in part.names]


SWING = km.Fourier(2, "theta") * km.State("omega")


def test_a_rotating_frame_s_observables() -> None:
    X = np.random.default_rng(0).normal(size=(30, 2))
    lifting = SWING.bind(NAMES[:2])
    theta, omega = X.T
    expected = [omega * f(k * theta) for k in (1, 2) for f in (np.sin, np.cos)]
    assert lifting.names == (
        "omega*sin(theta)",
        "omega*cos(theta)",
        "omega*sin(2 theta)",
        "omega*cos(2 theta)",
    )
    assert np.array_equal(lifting(X), np.column_stack(expected))
    assert buffer_lifting(lifting)(X[3])[0] == pytest.approx(lifting(X[3]), rel=1e-14)


def test_products_of_states_are_the_monomials() -> None:
    squares, monomials = (km.State() * km.State()).bind(NAMES), km.Monomials(2).bind(NAMES)
    X = np.random.default_rng(1).normal(size=(9, 3))
    assert set(squares.names) == set(monomials.names)
    assert squares(X)[:, places(squares, monomials)] == pytest.approx(monomials(X), rel=1e-15)
    assert (squares + monomials).nz == 6


@settings(max_examples=40, deadline=None)
@given(cases(), cases())
def test_it_holds_each_pair_of_factors_and_does_not_mind_their_order(first: Case, second: Case) -> None:
    (a, X), (b, _) = made(first), made(second)
    if a.bound != b.bound:
        with pytest.raises(km.errors.DataError, match="bound to other states"):
            _ = a * b
        return
    assume(a.nz * b.nz <= 4000)  # a dictionary of 500 plates times itself would take minutes
    ab, ba = a * b, b * a
    assert set(ab.names) == set(ba.names)
    np.testing.assert_allclose(ab(X), ba(X)[:, places(ba, ab)], rtol=1e-13, atol=1e-300)
    products = (a(X)[:, :, None] * b(X)[:, None, :]).reshape(len(X), -1).T
    held = ab(X).T
    for z in held:
        assert ((products == z) | (np.isnan(products) & np.isnan(z))).all(axis=1).any()
    for product in products:
        assert np.isclose(held, product, rtol=1e-13, atol=1e-300, equal_nan=True).all(axis=1).any()
    assert ab.nz <= len({tuple(sorted((i, j))) for i in a.names for j in b.names})


def test_one_is_neutral_and_sums_distribute() -> None:
    assert (km.Constant() * km.State()).bind(NAMES).names == NAMES
    assert ((km.Constant() + km.State()) * km.Fourier(1, 0)).bind(NAMES[:1]).names == (
        "sin(theta)",
        "cos(theta)",
        "theta*sin(theta)",
        "theta*cos(theta)",
    )
    assert (km.Monomials(2) * km.Monomials(2)).bind(NAMES[:1]).names == ("(theta^2)^2",)


def test_saved_bound_or_not_and_with_a_traced_factor() -> None:
    X = np.array([[0.3, -2.0]])
    assert returned(SWING) == SWING
    lifting = (km.Expressions(lambda x: [ca.fabs(x[0])], ["size"]) * km.State()).bind(NAMES[:2])
    again = returned(lifting)
    assert again.names == lifting.names == ("theta*size", "omega*size")
    assert np.array_equal(again(X), lifting(X))


def test_states_that_differ_in_the_unit_alone_keep_it() -> None:
    assert (km.State() * km.State(2)).bind(("a [m]", "a [s]", "b")).names == ("a [m]*b", "a [s]*b", "b^2")
