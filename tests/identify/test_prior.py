"""What a prior says of each entry of [A B], and which parts of priors contradict each other."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.identify.constrained.prior import entries_of

PSI, U = ("a [m]", "b [m/s]"), ("u [N]", "v [N]", "w")
NAN, INF = np.nan, np.inf


def entries(**parts):
    return entries_of(km.identify.Prior(**parts), PSI, U)


def test_without_parts_all_is_free():
    own = entries()
    assert own.known.shape == own.low.shape == own.high.shape == (2, 5)
    assert np.isnan(own.known).all()
    assert (own.low == -INF).all()
    assert (own.high == INF).all()


def test_each_part_stands_in_its_place():
    own = entries(
        A=[[1.0, NAN], [NAN, NAN]],
        B=[[NAN, NAN, NAN], [7.0, NAN, NAN]],
        mask_A=[[1, 1], [0, 1]],
        mask_B=[[1, 0, 1], [1, 1, 1]],
        lower_A=-2.0,
        upper_A=[[3.0, 4.0], [5.0, INF]],
        lower_B=[[-6.0, -INF, 0.5], [0.0, 0.0, 0.0]],
        upper_B=9.0,
    )
    np.testing.assert_array_equal(own.known, [[1, NAN, NAN, 0, NAN], [0, NAN, 7, NAN, NAN]])
    np.testing.assert_array_equal(own.low, [[-2, -2, -6, -INF, 0.5], [-2, -2, 0, 0, 0]])
    np.testing.assert_array_equal(own.high, [[3, 4, 9, 9, 9], [5, INF, 9, 9, 9]])


def test_a_row_by_name_is_zero_in_what_it_does_not_name():
    for name, others in (("b [m/s]", ("a [m]", "v [N]")), ("b", ("a", "v"))):
        own = entries(rows={name: dict(zip(others, (2.0, 3.0), strict=True))})
        np.testing.assert_array_equal(own.known, [[NAN] * 5, [2, 0, 0, 3, 0]])
    agreed = entries(rows={"b": {"a": 2.0}}, A=[[NAN, NAN], [2.0, NAN]], mask_A=[[1, 1], [1, 0]])
    np.testing.assert_array_equal(agreed.known[1], [2, 0, 0, 0, 0])
    at_its_bounds = entries(rows={"a": {"a": 1.0}}, lower_A=[[1.0, 0.0], [-1, -1]], upper_A=1.0)
    assert at_its_bounds.known[0, 0] == 1.0


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"rows": {"c": {}}}, r"rows names 'c'; it can name a \[m\], b \[m/s\]"),
        ({"rows": {"u": {}}}, r"rows names 'u'; it can name a \[m\], b \[m/s\]$"),  # an input has no row
        ({"rows": {"a": {"z": 1.0}}}, r"rows names 'z'; it can name a \[m\], b \[m/s\], u \[N\], v \[N\], w"),
        ({"A": [[NAN, INF], [NAN, NAN]]}, "Prior.A holds infinite entries; use NaN where an entry is free"),
        ({"rows": {"b": {"a": 2.0}}, "A": [[NAN, NAN], [2.5, NAN]]}, r"rows\['b'\] says 2 at \(0, 0\), where another prior says 2.5"),
        ({"mask_B": [[1, 1, 1], [1, 0, 1]], "B": [[NAN] * 3, [NAN, 4.0, NAN]]}, r"Prior.B says 4 at \(1, 1\), where another prior says 0"),
        ({"A": [[NAN, NAN], [NAN, 2.0]], "upper_A": 1.9}, r"contradict each other at 'b \[m/s\]' from 'b \[m/s\]': known 2, bounds -inf … 1.9"),
        ({"B": [[NAN] * 3, [NAN, NAN, 2.0]], "lower_B": 2.1}, r"contradict each other at 'b \[m/s\]' from 'w': known 2, bounds 2.1 … inf"),
        ({"lower_B": [[0, 0, 0], [3.0, 0, 0]], "upper_B": 2.0}, r"at 'b \[m/s\]' from 'u \[N\]': known nan, bounds 3 … 2"),
    ],
)  # fmt: skip
def test_contradictions_and_unknown_names_are_told(parts, text):
    with pytest.raises(km.errors.DataError, match=text):
        entries(**parts)


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"upper_A": np.ones((2, 3))}, r"upper_A has shape \(2, 3\), expected \(2, 2\)"),
        ({"upper_B": np.ones((2, 2))}, r"upper_B has shape \(2, 2\), expected \(2, 3\)"),
        ({"mask_A": np.ones((3, 2))}, r"mask_A has shape \(3, 2\), expected \(2, 2\)"),
        ({"B": np.ones((3, 2))}, r"Prior.B has shape \(3, 2\), expected \(2, 3\)"),
        ({"combinations": [km.identify.Combination(0, 1, A=np.eye(2), B=np.ones((2, 2)))]}, r"Combination.B has shape \(2, 2\), expected \(2, 3\)"),
        ({"dissipation": km.identify.Dissipation(np.eye(2), C=np.ones((2, 2)))}, r"Dissipation.C has shape \(2, 2\), expected \(3, 2\)"),
        ({"dissipation": km.identify.Dissipation(np.eye(2), C=np.ones((3, 2)), D=np.eye(2))}, r"Dissipation.D has shape \(2, 2\), expected \(3, 3\)"),
        ({"dissipation": km.identify.Dissipation(np.eye(3))}, r"Dissipation.P has shape \(3, 3\), expected \(2, 2\)"),
    ],
)  # fmt: skip
def test_a_part_for_other_sizes_is_told(parts, text):
    with pytest.raises(km.errors.ShapeError, match=text):
        entries(**parts)


def test_what_fits_is_taken():
    entries(
        combinations=[km.identify.Combination(0, 0, B=np.ones((2, 3)))],
        dissipation=km.identify.Dissipation(np.eye(2), C=np.ones((3, 2)), D=np.eye(3)),
    )
    for prior, coupled in (
        (km.identify.Prior(), False),
        (km.identify.Prior(lower_A=0.0, rows={"a": {}}), False),
        (km.identify.Prior(symmetric=True), True),
        (km.identify.Prior(combinations=[km.identify.Combination(0, 1, A=np.eye(2))]), True),
        (km.identify.Prior(dissipation=km.identify.Dissipation(np.eye(2))), True),
    ):
        assert prior.coupled == coupled
