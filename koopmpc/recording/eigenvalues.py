"""The eigenvalues of A over the unit circle."""
# pyright: basic

from typing import Any

import numpy as np

from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor

_WIDEST = 3.0  # beyond it an eigenvalue is not in the picture


Model = LinearPredictor | BilinearPredictor


def draw_eigenvalues(model: Model) -> dict[str, Any]:
    """Return static archetypes by entity; eigenvalues outside the unit circle are red. Rerun's y points down."""
    import rerun as rr

    values = np.asarray(model.eigenvalues)
    turn = np.linspace(0, 2 * np.pi, 181)
    size = reach(model)
    axes = [[(-size, 0), (size, 0)], [(0, -size), (0, size)]]
    outside = np.abs(values) > 1 + 1e-9
    return {
        "model/axes": rr.LineStrips2D(axes, radii=0.003 * size, colors=[205, 210, 216], draw_order=1),
        "model/circle": rr.LineStrips2D(
            [np.stack([np.cos(turn), np.sin(turn)], axis=1)], radii=0.005 * size, colors=[120, 130, 145]
        ),
        "model/eigenvalues": rr.Points2D(
            np.stack([np.real(values), -np.imag(values)], axis=1),
            radii=0.025 * size,
            colors=np.where(outside[:, None], [214, 60, 60], [40, 110, 200]).astype(np.uint8),
            labels=[f"|λ| = {abs(v):.4f}" for v in values],
            show_labels=False,
        ),
    }


def reach(model: Model) -> float:
    """Return how far the picture goes: over the unit circle, and over eigenvalues not far outside."""
    values = np.asarray(model.eigenvalues)
    return min(1.15 * max(1.0, float(np.abs(values).max(initial=0.0))), _WIDEST)
