import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import koopmpc as km
from koopmpc.base import checks
from tests.bare import shown


@given(value=hnp.arrays(np.float64, hnp.array_shapes(max_dims=3, max_side=4), elements=st.floats(-1e9, 1e9)))
def test_an_array_is_copied_and_contiguous(value):
    for given_ in (value, value.T, value.tolist(), np.asfortranarray(value)):
        got = checks.array(given_, "x")
        np.testing.assert_array_equal(got, np.asarray(given_))
        assert got.dtype == np.float64
        assert got.flags["C_CONTIGUOUS"]
        assert not np.shares_memory(got, value)


def test_other_numbers_are_numbers():
    for given_ in (3, True, np.int8(3), [1, 2], (1.5, 2), np.float32(2), ca.DM([1, 2])):
        np.testing.assert_array_equal(checks.array(given_, "x").ravel(), np.ravel(np.array(given_, float)))


def test_arrays():
    for value, kwargs, error, text in (
        (np.zeros(3), {"shape": (2,)}, km.errors.ShapeError, r"x0 has shape \(3,\), expected \(2,\)"),
        (np.zeros((3, 2)), {"shape": (None, 4)}, km.errors.ShapeError, r"x0 has shape \(3, 2\), expected \(any, 4\)"),
        ([1, 2], {"shape": ()}, km.errors.ShapeError, r"x0 has shape \(2,\), expected \(\)"),
        ([[0, 1], [np.nan, np.inf]], {}, km.errors.DataError, r"x0 holds 2 NaN or inf, the first at \(1, 0\); remove"),
        ([np.inf, np.nan], {"infinite": True}, km.errors.DataError, "x0 holds NaN; use ±inf where there is no limit"),
        ([1j], {}, km.errors.DataError, r"x0 is complex; pass real numbers"),
        ([[1], [1, 2]], {}, km.errors.DataError, "x0 is not an array of numbers: got list, .*; pass numbers of one"),
        ("12", {}, km.errors.DataError, r"x0 is not an array of numbers: got str, numbers cannot be None or text"),
        ([1, None], {}, km.errors.DataError, "x0 is not an array of numbers: got list, numbers cannot be None or text"),
    ):
        with pytest.raises(error, match=text):
            checks.array(value, "x0", **kwargs)
    assert np.isnan(checks.array(np.nan, "x0", finite=False))
    assert checks.array(-np.inf, "x0", infinite=True) == -np.inf


def test_vectors():
    np.testing.assert_array_equal(checks.vector(2, "u", 3), [2, 2, 2])
    np.testing.assert_array_equal(checks.vector([1, 2], "u", 2), [1, 2])
    for wrong in ([1, 2], [[1, 2, 3]], [1]):
        with pytest.raises(km.errors.ShapeError, match=r"u has shape \(.*\), expected \(3,\) or a scalar"):
            checks.vector(wrong, "u", 3)


def test_weights():
    np.testing.assert_array_equal(checks.weight(2, "Q", 2), 2 * np.eye(2))
    np.testing.assert_array_equal(checks.weight([1, 2], "Q"), np.diag([1, 2]))
    checks.weight(np.zeros((2, 2)), "Q")
    for value, kwargs, error, text in (
        ([1, 2, 3], {"size": 2}, km.errors.ShapeError, r"Q has shape \(3,\), expected \(2, 2\) or its diagonal"),
        (np.eye(3), {"size": 2}, km.errors.ShapeError, r"Q has shape \(3, 3\), expected \(2, 2\) or its diagonal"),
        (np.ones((1, 2)), {}, km.errors.ShapeError, r"Q has shape \(1, 2\), expected a square matrix or its diagonal"),
        ([[1, 1e-3], [0, 1]], {}, km.errors.DefinitenessError, r"Q is not symmetric; pass \(M \+ Mᵀ\)/2"),
        ([[1, 2], [2, 1]], {}, km.errors.DefinitenessError, "Q is indefinite: its least eigenvalue is -1; weights"),
        ([1, 0], {"definite": True}, km.errors.DefinitenessError, r"Q is not positive definite: .* is 0; raise it"),
    ):
        with pytest.raises(error, match=text):
            checks.weight(value, "Q", **kwargs)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 6), size=st.sampled_from([1e-12, 1.0, 1e12]))
def test_a_semidefinite_matrix_passes_whatever_its_unit(seed, n, size):
    half = np.random.default_rng(seed).normal(size=(n, max(1, n - 1)))
    got = checks.weight(size * half @ half.T, "Q", n)
    np.testing.assert_array_equal(got, got.T)


def test_numbers():
    assert checks.positive(2, "dt") == 2.0
    assert checks.count(3, "steps") == 3
    for call, error, text in (
        (lambda: checks.positive(0, "dt", "s"), km.errors.DataError, r"dt is 0 s; it must be above zero"),
        (lambda: checks.positive(-1.5, "dt"), km.errors.DataError, r"dt is -1.5; it must be above zero"),
        (lambda: checks.positive(np.nan, "dt"), km.errors.DataError, r"dt holds 1 NaN or inf"),
        (lambda: checks.count(0, "horizon"), km.errors.DataError, r"horizon is 0; it must be at least 1"),
        (lambda: checks.count(1, "steps", 2), km.errors.DataError, r"steps is 1; it must be at least 2"),
        (lambda: checks.count(True, "steps"), km.errors.DataError, r"steps is True; pass a whole number"),
    ):
        with pytest.raises(error, match=text):
            call()


def test_crossed_limits():
    checks.refuse_crossed(np.zeros(2), np.zeros(2), "input")
    checks.refuse_crossed(np.full(1, -np.inf), np.full(1, np.inf), "input")
    with pytest.raises(km.errors.DataError, match="input limits cross at index 1: lower 2 is above upper 1; swap or"):
        checks.refuse_crossed(np.array([0.0, 2]), np.array([0.0, 1]), "input")


def test_an_int_is_a_seed_and_a_generator_is_itself():
    rng = np.random.default_rng(3)
    assert checks.generator(rng) is rng
    assert checks.generator(3).random() == checks.generator(3).random()


def test_what_is_no_number_at_all():
    """What the type hook of the tests would catch first, as users see it."""
    lines = shown(
        """
from koopmpc.base import checks
show(lambda: checks.array(None, "x0"))
show(lambda: checks.array({}, "x0"))
show(lambda: checks.count(2.0, "steps"))
show(lambda: checks.count("2", "steps"))
for rng in ("a", None, 1.5, True, -1):
    show(lambda: checks.generator(rng))
print(checks.count(np.int64(3), "steps"))
"""
    )
    assert lines == [
        "DataError x0 is not an array of numbers: got NoneType, numbers cannot be None or text;"
        " pass numbers of one shape",
        "DataError x0 is not an array of numbers: got dict, float() argument must be a string or a real number,"
        " not 'dict'; pass numbers of one shape",
        "DataError steps is 2.0; pass a whole number",
        "DataError steps is '2'; pass a whole number",
        *(
            f"DataError rng is {rng}; pass a seed (a whole number from 0 on) or a numpy Generator"
            for rng in ("'a'", "None", "1.5", "True", "-1")
        ),
        "3",
    ]


def test_names_come_in_anything_that_holds_texts_in_order():
    for held in (["a", "b"], ("a", "b"), np.array(["a", "b"]), {"a": 1, "b": 2}, iter("ab")):
        assert checks.texts(held, "states") == ("a", "b")
    for bad in ("ab", None, 3, b"ab", [1, "b"], {1: "a"}):
        with pytest.raises(km.errors.DataError, match=r"states is .*; pass a tuple of names"):
            checks.texts(bad, "states")
