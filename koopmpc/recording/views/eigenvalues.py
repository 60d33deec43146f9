# pyright: basic
"""The eigenvalues of A over the unit circle, with their residuals, and the eigenfunctions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopmpc.figures.plane import Plane, eigenfunctions_on
from koopmpc.figures.style import CYCLIC, SEQUENTIAL, shades
from koopmpc.predict.base import Predictor
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.recording.description import drawable
from koopmpc.recording.views.scenes import BACKGROUND
from koopmpc.validate.residuals import ResidualDMD

_WIDEST = 3.0  # largest half width of the picture
_CROWDED = 0.35  # share of the picture below which the eigenvalues get one of their own
_BELOW, _ABOVE = 1e-2, 1e1  # residuals of the darkest and the lightest shade, over the tolerance
_LIGHT = 0.85  # share of the colour scale in use; the rest is too light for points


def draw_eigenvalues(model: Predictor, residuals: ResidualDMD | None = None) -> dict[str, Any]:
    """Return static archetypes by entity. Rerun's y points down.

    Without residuals eigenvalues outside the unit circle are red. With them a point is the darker the smaller its
    residual, and one that may be spurious is a ring.
    """
    import rerun as rr

    values = np.asarray(model.eigenvalues if residuals is None else residuals.eigenvalues)
    turn = np.linspace(0, 2 * np.pi, 721)
    size = reach(model)
    axes = [[(-size, 0), (size, 0)], [(0, -size), (0, size)]]
    at = np.stack([np.real(values), -np.imag(values)], axis=1)
    labels = [f"λ = {v:.4f}, |λ| = {abs(v):.4f}" for v in values]
    if residuals is None:
        outside = np.abs(values) > 1 + 1e-9
        colors = np.where(outside[:, None], [214, 60, 60], [40, 110, 200]).astype(np.uint8)
    else:
        labels = [f"{label}, residual {r:.2g}" for label, r in zip(labels, residuals.residuals, strict=True)]
        share = np.clip(residuals.residuals / residuals.tolerance, _BELOW, _ABOVE)
        level = np.log(share / _BELOW) / np.log(_ABOVE / _BELOW)
        colors = shades(_LIGHT * level, SEQUENTIAL)
    drawn = {
        "model/axes": rr.LineStrips2D(axes, radii=rr.Radius.ui_points(0.5), colors=[205, 210, 216], draw_order=1),
        "model/circle": rr.LineStrips2D(
            [np.stack([np.cos(turn), np.sin(turn)], axis=1)],
            radii=rr.Radius.ui_points(1.0),
            colors=[120, 130, 145],
            draw_order=2,
        ),
        "model/eigenvalues": rr.Points2D(
            at, radii=rr.Radius.ui_points(5.0), colors=colors, labels=labels, show_labels=False, draw_order=30
        ),
    }
    if residuals is not None and residuals.spurious.any():
        drawn["model/spurious"] = rr.Points2D(
            at[residuals.spurious], radii=rr.Radius.ui_points(2.6), colors=BACKGROUND, draw_order=31
        )
    return drawn


def reach(model: Predictor) -> float:
    """Return the half width of the picture, which holds the unit circle and the eigenvalues up to |λ| = 2.6."""
    values = np.asarray(model.eigenvalues)
    return min(1.15 * max(1.0, float(np.abs(values).max(initial=0.0))), _WIDEST)


def eigenvalue_views(model: Predictor, *, residuals: bool = False) -> list[Any]:
    """Return the view of the unit circle, and a closer one where the eigenvalues crowd."""
    size, values = reach(model), np.asarray(model.eigenvalues)
    views = [_view("Eigenvalues, unit circle", 0.0, 0.0, size)]
    told = "Closer; rings may be spurious" if residuals else "Closer"
    re, im = np.real(values), np.imag(values)
    half = max(np.ptp(re), np.ptp(im)) / 2
    if half < _CROWDED * size:
        views.append(_view(told, (re.min() + re.max()) / 2, 0.0, 1.3 * half + 1e-3))
    return views


def _view(name: str, x: float, y: float, size: float) -> Any:
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(
        origin="model",
        name=name,
        background=list(BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[x - size, x + size], y_range=[y - size, y + size]),
    )


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
            title = f"φ{j}, λ = {value.real:.4g}"
            pictures.append((f"{entity}/value", title, _picture(f"{entity}/value", shades(level, SEQUENTIAL), plane)))
            continue
        turns = np.angle(phi) / (2 * np.pi) + 0.5  # dark at 0, blue below, red above, light at ±π
        shaded = {"magnitude": shades(np.abs(phi), SEQUENTIAL), "phase": shades(turns, CYCLIC)}
        sign = "+" if value.imag > 0 else "−"
        titles = {"magnitude": f"|φ{j}|, λ = {value.real:.4g} {sign} {abs(value.imag):.4g}i", "phase": f"Phase of φ{j}"}
        pictures += [(f"{entity}/{k}", titles[k], _picture(f"{entity}/{k}", shaded[k], plane)) for k in shaded]
    return pictures


def plane_view(entity: str, title: str, plane: Plane) -> Any:
    """Return the view of one picture, with room for the words around it."""
    import rerun.blueprint as rrb

    n, m = len(plane.across), len(plane.up)
    return rrb.Spatial2DView(
        origin=entity,
        name=drawable(title),
        background=list(BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.3 * n, 1.1 * n], y_range=[-0.08 * m, 1.25 * m]),
    )


def _picture(entity: str, pixels: np.ndarray, plane: Plane) -> dict[str, Any]:
    """Return the picture, rows from the top down, and its axes in words."""
    import rerun as rr

    m, n = pixels.shape[:2]
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
        f"{entity}/picture": rr.Image(np.ascontiguousarray(pixels[::-1])),
        f"{entity}/axes": rr.Points2D(
            list(words), labels=list(words.values()), radii=0.0, colors=_INK, show_labels=True, draw_order=40
        ),
    }
