"""Description: what does not change from step to step of a run, as exact JSON and as a page to read."""

import dataclasses
import json
import re
import unicodedata
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

import numpy as np

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.errors import LogError
from koopmpc.lifting.base import Lifting
from koopmpc.loop.metrics import Metrics
from koopmpc.loop.run import About
from koopmpc.values import from_data, to_data

_FORMAT = "koopmpc-log-1"


def application_of(about: About) -> str:
    """Return one application a problem: Rerun keeps the layouts that people make by it."""
    return "koopmpc-" + re.sub(r"[^A-Za-z0-9_-]", "_", str(about.metadata.get("problem", "run")))


def title_of(about: About) -> str:
    """Return problem, case, controller and fault, as far as they are known."""
    parts = [about.metadata.get(key) for key in ("problem", "case", "controller", "fault")]
    return " · ".join(str(p) for p in parts if p is not None) or "run"


def to_json(about: About, steps: int | None) -> str:
    """Return `about` as JSON, exact to the bit; `steps` where the length is known beforehand."""
    tree = {"format": _FORMAT, "steps": steps, "written_with": _versions(), "about": to_data(about)}
    return json.dumps(tree, ensure_ascii=False)


def from_json(text: str) -> tuple[About, int | None]:
    """Return what `to_json` wrote.

    Raises
    ------
    LogError
        The text is damaged or of another format.
    """
    try:
        tree: Any = json.loads(text)
        if tree["format"] != _FORMAT:
            raise LogError(f"the description has format {tree['format']!r}, this koopmpc reads {_FORMAT!r}")
        about, steps = from_data(tree["about"]), tree["steps"]
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(f"the description is damaged: {error}") from error
    if not isinstance(about, About):
        raise LogError(f"the description holds a {type(about).__name__}, not what a run is about")
    return about, steps


def to_markdown(about: About) -> str:
    """Return a page that says what ran, under which cost and limits, with which seeds and versions."""
    lines = [f"# {title_of(about)}", ""]
    if "title" in about.metadata:
        lines += [str(about.metadata["title"]), ""]
    lines += [f"**States** {', '.join(about.states)}  ", f"**Inputs** {', '.join(about.inputs)}  "]
    lines += [f"**Sampling time** {about.dt:g} s", ""]
    if about.cost is not None:
        lines += ["| cost | value |", "|---|---|", *_table(about.cost, about), ""]
    if about.limits is not None:
        lines += ["| limits | value |", "|---|---|", *_table(about.limits, about), ""]
    rows = [(key, value) for key, value in about.metadata.items() if key != "title"]
    rows.append(("written with", _versions()))
    lines += ["| run | value |", "|---|---|", *(f"| {key} | {_short(value)} |" for key, value in rows), ""]
    return "\n".join(lines)


def metrics_to_markdown(metrics: Metrics, tracked: tuple[str, ...]) -> str:
    """Return the metrics as a table."""
    rows = [f"| {name} | {_short(value)} |" for name, value in metrics.figures(tracked).items()]
    return "\n".join(["| metric | value |", "|---|---|", *rows])


def _table(value: Cost | Limits, about: About) -> list[str]:
    pairs = [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)]
    pairs = [(n, ", ".join(v.bind(about.states).names) if isinstance(v, Lifting) else v) for n, v in pairs]
    return [f"| {name} | {_short(v)} |" for name, v in pairs if v is not None]


def _short(value: Any) -> str:
    """Return `value` in a few characters, fit for a cell."""
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_short(v)}" for k, v in cast("Mapping[str, Any]", value).items())
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, np.ndarray):
        text = np.array2string(cast("np.ndarray", value), precision=4, threshold=16, separator=", ")
    else:
        text = str(value)
    text = " ".join(text.split()).replace("|", "\\|")
    return text if len(text) <= 200 else text[:199] + "…"


@cache
def _versions() -> dict[str, str]:
    found: dict[str, str] = {}
    for package in ("koopmpc", "numpy", "casadi", "osqp", "rerun-sdk"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


# The viewer draws in Inter. It holds these, first to last; a few rare signs that it has too are not listed.
_RANGES = (
    (0x0020, 0x007E), (0x00A0, 0x0148), (0x014A, 0x01C3), (0x01C5, 0x031E), (0x0384, 0x038A), (0x038E, 0x03A1),
    (0x03A3, 0x03E1), (0x03F0, 0x049D), (0x04A0, 0x04FF), (0x1E00, 0x1F15), (0x2010, 0x2027), (0x202F, 0x205F),
    (0x2074, 0x208E), (0x2090, 0x209C), (0x20A0, 0x20BF), (0x2190, 0x2199), (0x2264, 0x2265),
)  # fmt: skip
_SINGLE = "\n\t⁰ⁱᵏᵢᵣᵤᵥₓ℃ℓ№™Ω⇒⇔∂∅∆∏∑−√∞∫≈≠■▲▶▼◆●★✓✗"
_HELD = frozenset(_SINGLE).union(*(map(chr, range(first, last + 1)) for first, last in _RANGES))
_WORDS = {"ᵀ": "^T", "ᴴ": "^H", "∇": "grad ", "∈": " in ", "⟨": "<", "⟩": ">", "⊤": "^T", "⋅": "·", "∣": "|"}
_UNKNOWN = "?"


def drawable(text: str) -> str:
    """Return `text` with each sign that the viewer's font lacks spelled otherwise: 𝜓 is ψ, Uᵀ is U^T, the rest "?"."""
    return "".join(sign if sign in _HELD else _spelled(sign) for sign in text)


def _spelled(sign: str) -> str:
    plain = _WORDS.get(sign) or unicodedata.normalize("NFKC", sign)
    return plain if _HELD.issuperset(plain) else _UNKNOWN
