"""Shades: numbers as colours, from dark to light for sizes and around a circle for phases."""

import numpy as np
from jaxtyping import Float, UInt8

# Anchors of equal steps: lightness grows evenly along the first, and the second closes.
_SEQUENCE = np.array(
    [[68, 1, 84], [71, 45, 123], [59, 82, 139], [44, 114, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99],
     [170, 220, 50], [253, 231, 37]], dtype=np.float64,
)  # fmt: skip
_CIRCLE = np.array(
    [[226, 217, 226], [140, 163, 200], [97, 94, 178], [75, 32, 113], [47, 20, 55], [110, 30, 70], [170, 87, 83],
     [205, 165, 145], [226, 217, 226]], dtype=np.float64,
)  # fmt: skip


def sequence(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "... 3"]:
    """Return colours of values from 0, dark, to 1, light."""
    return _between(_SEQUENCE, np.clip(values, 0.0, 1.0))


def circle(phases: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "... 3"]:
    """Return colours of phases [rad]: dark at 0, blue below, red above, light at ±π."""
    return _between(_CIRCLE, np.clip(phases / (2 * np.pi) + 0.5, 0.0, 1.0))


def _between(
    anchors: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "..."]
) -> UInt8[np.ndarray, "... 3"]:
    places = np.linspace(0.0, 1.0, len(anchors))
    bands: list[np.ndarray] = [np.asarray(np.interp(values, places, anchors[:, i])) for i in range(3)]
    return np.stack(bands, axis=-1).round().astype(np.uint8)
