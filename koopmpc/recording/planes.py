"""Eigenfunctions over a plane of two states as pictures: magnitude and phase, the second state upwards."""
# pyright: basic

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.plane import Plane, eigenfunctions_on
from koopmpc.recording.glyphs import drawable
from koopmpc.recording.scenes import BACKGROUND
from koopmpc.recording.shades import circle, sequence

_INK = (250, 250, 250)


def draw_eigenfunctions(
    predictor: LinearPredictor, which: Sequence[int], plane: Plane
) -> list[tuple[str, str, dict[str, Any]]]:
    """Return for each picture its entity, its title, and static archetypes by entity."""
    pictures: list[tuple[str, str, dict[str, Any]]] = []
    for j, phi in zip(which, eigenfunctions_on(predictor, which, plane), strict=True):
        value = predictor.eigenvalues[j]
        entity = f"eigenfunction/{j}"
        if value.imag == 0:
            low, high = float(phi.real.min()), float(phi.real.max())
            level = (phi.real - low) / ((high - low) or 1.0)
            title = f"φ{j} from {low:.2g} (dark) to {high:.2g} (light), λ = {value.real:.4g}"
            pictures.append((f"{entity}/value", title, _picture(f"{entity}/value", sequence(level), plane)))
            continue
        shades = {"magnitude": sequence(np.abs(phi)), "phase": circle(np.angle(phi))}
        sign = "+" if value.imag > 0 else "−"
        titles = {
            "magnitude": f"|φ{j}|, 0 (dark) to 1 (light), λ = {value.real:.4g} {sign} {abs(value.imag):.4g}i",
            "phase": f"phase of φ{j}: 0 dark, ±π light, + red, − blue",
        }
        pictures += [
            (f"{entity}/{k}", titles[k], _picture(f"{entity}/{k}", shades[k], plane)) for k in shades
        ]
    return pictures


def plane_view(entity: str, title: str, plane: Plane) -> Any:
    """Return the view of one picture, with room for what is written around it."""
    import rerun.blueprint as rrb

    n, m = len(plane.across), len(plane.up)
    return rrb.Spatial2DView(
        origin=entity,
        name=drawable(title),
        background=list(BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.3 * n, 1.1 * n], y_range=[-0.08 * m, 1.25 * m]),
    )


def _picture(entity: str, shades: np.ndarray, plane: Plane) -> dict[str, Any]:
    """Return the picture, rows from the top down, and its axes in words."""
    import rerun as rr

    m, n = shades.shape[:2]
    (x, y), across, up = map(drawable, plane.names), plane.across, plane.up
    words = {
        (0.04 * n, 1.06 * m): f"{across[0]:.3g}",
        (0.5 * n, 1.14 * m): x,
        (1.0 * n, 1.06 * m): f"{across[-1]:.3g}",
        (-0.09 * n, 0.96 * m): f"{up[0]:.3g}",
        (-0.15 * n, 0.5 * m): y,
        (-0.09 * n, 0.04 * m): f"{up[-1]:.3g}",
    }
    return {
        f"{entity}/picture": rr.Image(np.ascontiguousarray(shades[::-1])),
        f"{entity}/axes": rr.Points2D(
            list(words), labels=list(words.values()), radii=0.0, colors=_INK, show_labels=True, draw_order=40
        ),
    }
