"""Styles: the names, colours and widths of every curve; static, so that any viewer shows them."""
# pyright: basic

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopmpc.recording.description import About
from koopmpc.recording.glyphs import drawable
from koopmpc.recording.rows import Rows
from koopmpc.recording.scene import Color

PALETTE: tuple[Color, ...] = (
    (88, 166, 255),
    (255, 166, 87),
    (86, 211, 160),
    (240, 120, 170),
    (188, 150, 255),
    (235, 203, 100),
    (110, 205, 220),
    (190, 190, 190),
)
_LIMIT: Color = (232, 84, 84)
_QUIET: Color = (140, 148, 160)


def styles(about: About, rows: Rows) -> dict[str, Any]:
    """Return the static archetypes by entity that name and colour what `rows` hold."""
    import rerun as rr

    tracked = about.tracked(rows.reference.shape[1])
    found = {
        "state": _lines(about.states, [color(i) for i in range(len(about.states))], 2.0),
        "reference": _lines([f"{n} reference" for n in tracked], [_matching(n, about) for n in tracked], 1.0),
        "measurement": rr.SeriesPoints(
            names=[drawable(f"{n} measured") for n in about.outputs],
            colors=[_matching(n, about) for n in about.outputs],
            marker_sizes=[1.5] * len(about.outputs),
        ),
        "control/u": _lines(
            about.inputs, [color(i) for i in range(len(about.inputs))], 2.0, interpolation_mode="StepAfter"
        ),
        "solver/time_ms": _lines(["solve time [ms]"], [color(2)], 1.5),
        "solver/deadline_ms": _lines(["deadline [ms]"], [_LIMIT], 1.0),
    }
    limits = [name for name, _ in input_limits(about)]
    if limits:
        found["control/limits"] = _lines(limits, [_LIMIT] * len(limits), 1.0)
    return found


def input_limits(about: About) -> list[tuple[str, float]]:
    """Return the finite input limits with their names."""
    if about.limits is None:
        return []
    low, high = about.limits.inputs(len(about.inputs))
    pairs = [(f"{n} min", v) for n, v in zip(about.inputs, low, strict=True)]
    pairs += [(f"{n} max", v) for n, v in zip(about.inputs, high, strict=True)]
    return [(n, float(v)) for n, v in pairs if np.isfinite(v)]


def color(i: int) -> Color:
    """Return the colour of the i-th state or input."""
    return PALETTE[i % len(PALETTE)]


def _matching(name: str, about: About) -> Color:
    """Return a quieter shade of the state's colour, grey for what is no state."""
    if name not in about.states:
        return _QUIET
    r, g, b = (round(0.6 * c + 0.4 * 128) for c in color(about.states.index(name)))
    return r, g, b


def _lines(names: Sequence[str], colors: Sequence[Color], width: float, **more: Any) -> Any:
    import rerun as rr

    return rr.SeriesLines(
        names=[drawable(name) for name in names], colors=list(colors), widths=[width] * len(names), **more
    )
