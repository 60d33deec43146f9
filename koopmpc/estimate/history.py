"""History: the ζ of an embedding, one step after another."""

import numpy as np
from jaxtyping import Float

from koopmpc.data.delay import Delay


class History:
    """ζ_k = [x_k, u_{k−1}, x_{k−1}, …] of a run.

    The first measurement stands in for what was before it. A missed one makes the x_k of its own ζ_k NaN; in those that
    follow, the last state that was measured stands in.

    Parameters
    ----------
    embedding
        Bound.
    """

    def __init__(self, embedding: Delay) -> None:
        self._embedding, self._nx = embedding, len(embedding.states)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._zeta: Float[np.ndarray, " nzeta"] | None = None

    def take(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ after the step that led to x under u."""
        known, embedding = bool(np.isfinite(x).all()), self._embedding
        if self._zeta is None:
            zeta = embedding.held(x, u)
            self._zeta = zeta if known else None
            return zeta
        zeta = embedding.shifted(self._zeta, u, x)
        self._zeta = zeta if known else embedding.shifted(self._zeta, u, self._zeta[: self._nx])
        return zeta


def history_of(embedding: Delay | None) -> History | None:
    """Return the history that an observer keeps; None without an embedding."""
    return None if embedding is None else History(embedding)
