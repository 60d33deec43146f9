"""What lies behind a reconstruction: the origin of the coordinates, and whether the data let B be found."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.bench.reproduce.reconstruction import relative
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.predict.linear import LinearPredictor


@dataclass(frozen=True)
class Prediction:
    """One model on two kinds of data that it was not fitted to: medians of ‖x̂ − x‖ / ‖x‖ over the episodes.

    Attributes
    ----------
    name
        The model and its data.
    feedback
        Under the feedback of the paper, from other starts.
    excited
        Under that feedback and noise on top, as a control model would meet.
    b
        Entry of B that the input acts through most, over its true value; NaN for a model without B.
    warned
        What the fit said of itself, in short.
    """

    name: str
    feedback: float
    excited: float
    b: float
    warned: str


def centred(episodes: Episodes, x_ref: ArrayLike) -> Episodes:
    """Return the same episodes in the coordinates x − x_ref."""
    target = checks.vector(x_ref, "x_ref", episodes.nx)
    moved = [Episode(X=e.X - target, U=e.U) for e in episodes]
    return Episodes(moved, episodes.dt, episodes.states, episodes.inputs)


def prediction(
    name: str,
    model: LinearPredictor,
    feedback: Episodes,
    excited: Episodes,
    B: Float[np.ndarray, "nx nu"],
) -> Prediction:
    """Return the errors of `model` over whole episodes; one without inputs is not told them.

    Parameters
    ----------
    name, model
        What is judged.
    feedback, excited
        Held-out episodes with inputs.
    B
        (nx, nu), ∂x⁺/∂u of the plant at the equilibrium.
    """
    i, j = np.unravel_index(int(np.abs(B).argmax()), B.shape)
    share = float((model.C @ model.B)[i, j] / B[i, j]) if model.nu else np.nan
    said = () if model.report is None else model.report.warnings
    short = "A and B inseparable" if any("inseparable" in sentence for sentence in said) else "–"
    return Prediction(name, _error(model, feedback), _error(model, excited), share, short)


def _error(model: LinearPredictor, episodes: Episodes) -> float:
    errors = [relative(model.rollout(e.X[0], e.U[:, : model.nu]), e.X) for e in episodes]
    return float(np.median(errors))
