"""`km.select`, `km.design` and `km.certify` with all their settings as keywords, for tests that vary them in tables."""

from dataclasses import fields
from typing import Any

import koopmpc as km


def _split(asked: dict[str, Any], kind: type) -> dict[str, Any]:
    """Return the keywords of a call, those that are options in one object."""
    names = {field.name for field in fields(kind)}
    options = kind(**{name: value for name, value in asked.items() if name in names})
    return {name: value for name, value in asked.items() if name not in names} | {"options": options}


def select(data: Any, **asked: Any) -> Any:
    """Return `km.select` of the data."""
    return km.select(data, **_split(asked, km.SearchOptions))


def design(data: Any, cost: km.Cost, limits: km.Limits | None = None, **asked: Any) -> Any:
    """Return `km.design` for the data, cost and limits."""
    return km.design(data, cost, limits, **_split(asked, km.DesignOptions))


def certify(*given: Any, **asked: Any) -> km.guarantees.Certificate:
    """Return `km.certify` of the model and the data."""
    return km.certify(*given, **_split(asked, km.guarantees.CertifyOptions))
