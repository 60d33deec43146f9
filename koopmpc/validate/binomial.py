"""Exact bounds on a failure rate p from k failures in n independent runs (Clopper and Pearson)."""

from scipy.special import bdtr, betaincinv

from koopmpc.base import checks
from koopmpc.base.errors import DataError

_MOST_RUNS = 10**9  # refuse bounds that would need more runs than this


def bound_failure_rate(failures: int, runs: int, *, confidence: float = 0.95) -> float:
    """Return the one-sided upper bound p̄ with P(X ≤ failures | p̄, runs) = 1 − confidence.

    X is binomial. Whatever the true rate p is, the bound lies above it with at least the stated confidence. The runs
    must be independent and drawn from the distribution that the statement speaks of; it says nothing of others.

    Parameters
    ----------
    failures
        k, the number of runs that failed.
    runs
        n, the number of runs.
    confidence
        1 − β, above 0 and below 1.

    Returns
    -------
    float
        p̄, at most 1. With k = 0 it is 1 − β^(1/n), about 3/n at 95 %.

    Raises
    ------
    DataError
        If a count is negative, if there are more failures than runs, or if confidence is not inside (0, 1).

    Notes
    -----
    Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
    Biometrika 26 (1934).

    Examples
    --------
    >>> import koopmpc as km
    >>> round(km.validate.bound_failure_rate(0, 59), 4)
    0.0495
    """
    n = checks.count(runs, "runs")
    k = checks.count(failures, "failures", least=0)
    level = _check_share(confidence, "confidence")
    if k > n:
        raise DataError(f"failures={k} is above runs={n}; pass the number of runs that failed, then that of all runs")
    return 1.0 if k == n else float(betaincinv(k + 1, n - k, level))


def count_runs_needed(rate: float, *, failures: int = 0, confidence: float = 0.95) -> int:
    """Return the least n whose bound p̄(failures, n) is at most `rate`.

    Fix n before the runs: a number that grows until the bound is met loses the confidence.

    Parameters
    ----------
    rate
        Wished upper bound on the failure rate, above 0 and below 1.
    failures
        Failures that the plan allows.
    confidence
        1 − β, above 0 and below 1.

    Returns
    -------
    int
        n. Without failures it is ⌈ln β / ln(1 − rate)⌉.

    Raises
    ------
    DataError
        If a number lies outside its range, or if more than 10⁹ runs were needed.

    Examples
    --------
    >>> import koopmpc as km
    >>> km.validate.count_runs_needed(0.05)
    59
    """
    wished, level = _check_share(rate, "rate"), _check_share(confidence, "confidence")
    k = checks.count(failures, "failures", least=0)
    fewest, most = k, max(2 * k, 1)  # the bound at `fewest` is above the wish, the bound at `most` is below it
    while bdtr(k, most, wished) > 1 - level:
        fewest, most = most, 2 * most
        if most > _MOST_RUNS:
            raise DataError(f"rate={rate} needs more than {_MOST_RUNS:,} runs; ask for a larger rate")
    while most - fewest > 1:
        middle = (fewest + most) // 2
        if bdtr(k, middle, wished) > 1 - level:
            fewest = middle
        else:
            most = middle
    return most


def _check_share(value: float, name: str) -> float:
    """Return `value` as a float above 0 and below 1."""
    share = checks.positive(value, name)
    if share >= 1:
        raise DataError(f"{name} is {share:g}; it must be below one, as 0.95")
    return share
