"""Words for an unknown name: the nearest one that there is."""

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'pendulum'?"`` for the known name nearest to `name`; empty where none is near."""
    close = get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f", did you mean {close[0]!r}?" if close else ""
