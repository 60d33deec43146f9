"""`km.select`, `km.design` and `km.certify` with all their settings as keywords, for tests that vary them in tables."""

from typing import Any

import koopmpc as km
from tests.gathered import gather


def select(data: Any, **asked: Any) -> Any:
    """Return `km.select` of the data."""
    return km.select(data, **gather(km.SearchOptions, **asked))


def design(data: Any, cost: km.Cost, limits: km.Limits | None = None, **asked: Any) -> Any:
    """Return `km.design` for the data, cost and limits."""
    return km.design(data, cost, limits, **gather(km.DesignOptions, **asked))


def certify(*given: Any, **asked: Any) -> km.guarantees.Certificate:
    """Return `km.certify` of the model and the data."""
    return km.certify(*given, **gather(km.guarantees.CertifyOptions, **asked))
