"""Bounds on a failure rate: exact in the binomial distribution, and kept with the stated confidence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

import koopmpc as km


@given(n=st.integers(1, 3000), share=st.floats(0, 1), confidence=st.floats(0.01, 0.999))
def test_at_the_bound_so_few_failures_have_the_probability_that_is_left(n, share, confidence):
    k = min(int(share * n), n - 1)
    bound = km.validate.bound_failure_rate(k, n, confidence=confidence)
    assert binom.cdf(k, n, bound) == pytest.approx(1 - confidence, rel=1e-6)


@given(rate=st.floats(1e-4, 0.9), failures=st.integers(0, 20), confidence=st.floats(0.05, 0.999))
def test_the_number_of_runs_needed_is_the_least(rate, failures, confidence):
    n = km.validate.count_runs_needed(rate, failures=failures, confidence=confidence)
    assert km.validate.bound_failure_rate(failures, n, confidence=confidence) <= rate * (1 + 1e-9)
    if n > max(failures, 1):
        assert km.validate.bound_failure_rate(failures, n - 1, confidence=confidence) > rate * (1 - 1e-9)


@pytest.mark.parametrize(("n", "p"), [(20, 0.1), (59, 0.05), (200, 0.02)])
def test_the_bound_lies_above_the_true_rate_as_often_as_promised(n, p):
    k = np.arange(n + 1)
    above = [km.validate.bound_failure_rate(int(failures), n) >= p for failures in k]
    assert binom.pmf(k, n, p)[above].sum() >= 0.95


def test_without_failures_it_is_a_formula():
    assert km.validate.bound_failure_rate(0, 300) == pytest.approx(1 - 0.05 ** (1 / 300))
    assert km.validate.bound_failure_rate(7, 7) == 1.0
    assert km.validate.count_runs_needed(0.01) == int(np.ceil(np.log(0.05) / np.log(0.99)))


def test_wrong_numbers_are_errors_that_say_what_to_pass():
    with pytest.raises(km.errors.DataError, match=r"failures=4 is above runs=3"):
        km.validate.bound_failure_rate(4, 3)
    with pytest.raises(km.errors.DataError, match=r"confidence is 95; it must be below one"):
        km.validate.bound_failure_rate(0, 3, confidence=95)
    with pytest.raises(km.errors.DataError, match=r"rate is 0; it must be above zero"):
        km.validate.count_runs_needed(0)
    with pytest.raises(km.errors.DataError, match="more than 1,000,000,000 runs"):
        km.validate.count_runs_needed(1e-12)
