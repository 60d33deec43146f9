"""A linear plant that its predictor knows to the digit, and one that it does not."""

import numpy as np

import koopmpc as km

STATES, INPUTS = ("angle [rad]", "rate [rad/s]"), ("torque [N m]",)
DT = 0.1


def turning(radius: float = 0.95, angle: float = 0.3) -> km.LinearPredictor:
    A = radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return km.LinearPredictor(A, [[0.0], [1.0]], np.eye(2), km.State(), DT, STATES, INPUTS)


def three_states() -> km.LinearPredictor:
    """A turn of (a, b) by 0.3 rad a step, and c halved."""
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = turning(0.9).A, 0.5
    return km.LinearPredictor(A, np.ones((3, 1)), np.eye(3), km.State(), DT, ("a [m]", "b [m/s]", "c [A]"), ["u"])


BILINEAR = km.BilinearPredictor(
    turning().A, turning().B, np.zeros((1, 2, 2)), np.eye(2), km.State(), DT, STATES, INPUTS
)
DEFECTIVE = km.LinearPredictor([[0.9, 1.0], [0.0, 0.9]], [[0.0], [1.0]], np.eye(2), km.State(), DT, STATES, INPUTS)
VALUES = np.array([1.2, -0.9, 0.5, 0.1])


def diagonal() -> km.LinearPredictor:
    """The eigenvalues VALUES, without an input."""
    return km.LinearPredictor(np.diag(VALUES), np.zeros((4, 0)), np.eye(4), km.State(), 0.1, list("abcd"), [])


def episodes(count: int = 12, steps: int = 30, noise: float = 0.0) -> km.Episodes:
    rng, model = np.random.default_rng(4), turning()
    made = []
    for _ in range(count):
        U = rng.normal(size=(steps, 1))
        X = model.rollout(rng.normal(size=2), U)
        made.append(km.Episode(X=X + noise * rng.normal(size=X.shape), U=U))
    return km.Episodes(made, DT, STATES, INPUTS)


def curve(axes, label: str):
    """Return x and y of the curve with this label."""
    (found,) = [one for one in axes.get_lines() if one.get_label() == label]
    return found.get_xdata(), found.get_ydata()
