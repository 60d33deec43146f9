"""Words of reports: numbers, times, names and shares in a sentence; tables in Markdown."""

import re
from collections.abc import Iterable, Sequence

_LONG = 32  # characters of an observable's name in a sentence
_SCALED = re.compile(r"~[0-9a-f]{8}")  # how names tell one standardization from another
_WEIGHED = re.compile(r"\|[0-9a-f]{8}")  # how names of neurons tell their weights


def format_duration(seconds: float) -> str:
    """Return a time in µs, ms or s with three digits: ``"13.0 µs"``."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def format_markdown_table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown; a | inside a cell is escaped."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", r"\|") for cell in line) + " |" for line in lines)


def to_percent(share: float) -> str:
    """Return 0.123 as "12 %", and 0.996 as "99.6 %": what is not all is never said to be."""
    value = 100 * float(share)
    if not value <= 1000:
        return "> 1000 %"
    if 99.5 <= value < 100 - 1e-9:
        return f"{int(10 * value) / 10:g} %"
    return f"{value:.0f} %" if value >= 10 or value == round(value) else f"{value:.2g} %"


def shorten_observable(name: str) -> str:
    """Return an observable's name for a sentence: standardized states said in words, a long name cut in its middle."""
    plain, scaled = _SCALED.subn("", _WEIGHED.sub("", name))
    short = plain if len(plain) <= _LONG else f"{plain[: _LONG // 2]}…{plain[-_LONG // 2 + 1 :]}"
    return f"{short} of the standardized states" if scaled else short


def with_unit(name: str, value: str) -> str:
    """Return a value with the unit of a state or input: of ``"theta [rad]"`` and "± 1" it is "theta ± 1 rad"."""
    short, bracket, unit = name.partition(" [")
    return f"{short} {value} {unit.rstrip(']')}" if bracket else f"{short} {value}"
