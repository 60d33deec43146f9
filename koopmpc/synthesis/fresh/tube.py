"""Tubes: how far the errors of a model can move a loop from its plan, step by step, under a local feedback."""

import numpy as np
from jaxtyping import Float

from koopmpc.control.riccati import find_gain, one_step, stationary
from koopmpc.errors import KoopmpcError
from koopmpc.synthesis.asked import DesignTask
from koopmpc.validate.scoring import AnyPredictor

_ITERATIONS = 10_000  # of the Riccati equation
_SLACK = 1e-6  # weight of the states in the feedback of the tube, as a share of 1 / range², beside those of the cost
_RESTED = 1e-4  # the tube ends once a step widens it by less than this share
_LONGEST = 400  # steps of a tube, at most


def propagate_errors(
    A: Float[np.ndarray, "n n"], error: Float[np.ndarray, " n"], steps: int
) -> Float[np.ndarray, "steps n"]:
    """Return half-widths of e_k, k = 1 … steps, for e_{k+1} = A e_k + w, e_0 = 0 and every |w| ≤ error.

    |e_k| is at most Σ_{j<k} |Aʲ| error, and errors of these sizes with fitting signs reach it.
    """
    row, width, widths = np.eye(len(A)), np.zeros(len(A)), np.zeros((steps, len(A)))
    for k in range(steps):
        width = width + np.abs(row) @ error
        row = row @ A
        widths[k] = width
    return widths


def find_tube(
    model: AnyPredictor,
    asked: DesignTask,
    error: Float[np.ndarray, " nx"],
    x: Float[np.ndarray, " nx"],
    u: Float[np.ndarray, " nu"],
) -> Float[np.ndarray, "steps nx"] | None:
    """Return half-widths of each state 1 … steps after a plan, one-step errors being at most `error` in size.

    The loop around (x, u) follows the model's linearisation under the feedback of the stationary Riccati equation of
    the cost. The tube ends where it no longer widens. Returns None for a model of past rows, and where there is no such
    feedback.
    """
    if model.embedding is not None:
        return None
    try:
        at = model.step_map().linearize(x, u)
        A, B = at.A, at.B
        n, size = len(A), np.maximum(asked.high - asked.low, 1e-12)
        R = asked.cost.matrices(asked.reference.shape[1], B.shape[1])[1]
        tracked = asked.weigh_states(x, model.states, B.shape[1])
        weight = tracked + _SLACK * float(np.trace(tracked @ np.diag(size**2))) / n * np.diag(1 / size**2)
        stage = one_step(A, B, weight, R + 1e-9 * np.eye(len(R)) * max(float(np.trace(R)), 1e-9), None)
        K, _ = find_gain(stage, stationary(stage, _ITERATIONS).P)
    except (KoopmpcError, np.linalg.LinAlgError):
        return None
    loop = A - B @ K
    if not np.isfinite(loop).all() or np.abs(np.linalg.eigvals(loop)).max() >= 1:
        return None
    widths = propagate_errors(loop, error, _LONGEST)
    still = np.flatnonzero((np.diff(widths, axis=0) <= _RESTED * widths[:-1] + 1e-300).all(axis=1))
    return widths[: int(still[0]) + 2] if still.size else widths
