"""Which states are angles, and how often a log wraps them."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episodes

_NAMES = re.compile(r"(.*[\W_\d])?(theta|phi|psi|alpha|beta|gamma|angle|roll|pitch|yaw|heading|attitude)[\W_\d]*")
_MOVES = 0.2  # the sine of an angle that moves by less [rad] is the angle itself


def find_angles(states: Sequence[str], X: Float[np.ndarray, "M nx"]) -> list[int]:
    """Return the states that move by 0.2 rad or more and are angles by their unit rad, or by name if without a unit."""
    moving = np.ptp(X, axis=0) > _MOVES
    return [i for i, name in enumerate(states) if moving[i] and _is_angle(name)]


def count_wraps(episodes: Episodes) -> dict[int, int]:
    """Return how often each angle jumps by 2π, for the angles that were wrapped."""
    X = np.concatenate([episode.X for episode in episodes])
    wraps: dict[int, int] = {}
    for i in find_angles(episodes.states, X):
        steps = np.abs(np.concatenate([np.diff(episode.X[:, i]) for episode in episodes]))
        count = int(np.sum(np.abs(steps - 2 * np.pi) < 1.0))
        if count and np.median(steps) < 1.0:
            wraps[i] = count
    return wraps


def _is_angle(name: str) -> bool:
    stem, bracket, unit = name.partition("[")
    if bracket:
        return unit.strip(" ]").lower() in ("rad", "radian", "radians")
    return _NAMES.fullmatch(stem.strip().lower()) is not None and not stem.lower().startswith("d")
