"""The eigenvalues of A over the unit circle, and how far each can be trusted."""
# pyright: basic

from typing import Any

import numpy as np

from koopmpc.identify.residual_dmd import ResidualDMD
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor
from koopmpc.recording.scenes import BACKGROUND
from koopmpc.recording.shades import sequence

_WIDEST = 3.0  # beyond it an eigenvalue is not in the picture
_CROWDED = 0.35  # share of the picture below which the eigenvalues get one of their own
_BELOW, _ABOVE = 1e-2, 1e1  # shares of the tolerance that the shades go from and to
_LIGHT = 0.85  # of the shades: the rest is too light for points


Model = LinearPredictor | BilinearPredictor


def draw_eigenvalues(model: Model, residuals: ResidualDMD | None = None) -> dict[str, Any]:
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
        colors = sequence(_LIGHT * level)
    drawn = {
        "model/axes": rr.LineStrips2D(
            axes, radii=rr.Radius.ui_points(0.5), colors=[205, 210, 216], draw_order=1
        ),
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


def reach(model: Model) -> float:
    """Return how far the picture goes: over the unit circle, and over eigenvalues not far outside."""
    values = np.asarray(model.eigenvalues)
    return min(1.15 * max(1.0, float(np.abs(values).max(initial=0.0))), _WIDEST)


def eigenvalue_views(model: Model, *, residuals: bool = False) -> list[Any]:
    """Return the view of the unit circle, and a closer one where the eigenvalues crowd."""
    size, values = reach(model), np.asarray(model.eigenvalues)
    views = [_view("Eigenvalues of A and the unit circle", 0.0, 0.0, size)]
    told = "Darker: smaller residual; rings may be spurious" if residuals else "Closer"
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
