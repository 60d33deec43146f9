# pyright: basic
"""The eigenvalues of a model in the viewer: points in the plane, and the views around them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from koopmpc.models.base import Predictor
from koopmpc.views.figures.style import SEQUENTIAL, map_colors
from koopmpc.views.recording.scenes import BACKGROUND

if TYPE_CHECKING:
    from koopmpc.validate.residuals import ResidualDMD

_BELOW = 1e-2  # residual over tolerance that gets the darkest shade


_ABOVE = 1e1  # residual over tolerance that gets the lightest shade


def plane_view(origin: str, name: str, x: Sequence[float], y: Sequence[float]) -> Any:
    """Return the view of what is drawn in the plane within these ranges of x and y, y down."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(origin=origin, name=name, background=list(BACKGROUND), visual_bounds=bounds)


def draw_eigenvalues(model: Predictor, residuals: "ResidualDMD | None" = None) -> dict[str, Any]:
    """Return static archetypes by entity. Rerun's y points down.

    Without residuals eigenvalues outside the unit circle are red. With them a point is the darker the smaller its
    residual, and one that may be spurious is a ring.
    """
    import rerun as rr

    values = np.asarray(model.eigenvalues if residuals is None else residuals.eigenvalues)
    turn = np.linspace(0, 2 * np.pi, 721)
    size = _reach(model)
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
        # share of the colour scale in use; the rest is too light for points
        colors = map_colors(0.85 * level, SEQUENTIAL)
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


def _reach(model: Predictor) -> float:
    """Return the half width of the picture, which holds the unit circle and the eigenvalues up to |λ| = 2.6."""
    values = np.asarray(model.eigenvalues)
    # largest half width of the picture of eigenvalues
    return min(1.15 * max(1.0, float(np.abs(values).max(initial=0.0))), 3.0)


def eigenvalue_views(model: Predictor, *, residuals: bool = False) -> list[Any]:
    """Return the view of the unit circle, and a closer one where the eigenvalues crowd."""
    size, values = _reach(model), np.asarray(model.eigenvalues)
    views = [_around("Eigenvalues, unit circle", 0.0, size)]
    told = "Closer; rings may be spurious" if residuals else "Closer"
    re, im = np.real(values), np.imag(values)
    half = max(np.ptp(re), np.ptp(im)) / 2
    # share of the picture below which the eigenvalues get one of their own
    if half < 0.35 * size:
        views.append(_around(told, (re.min() + re.max()) / 2, 1.3 * half + 1e-3))
    return views


def _around(name: str, x: float, size: float) -> Any:
    """Return the view of the eigenvalues in the square of half width `size` about x on the real axis."""
    return plane_view("model", name, [x - size, x + size], [-size, size])
