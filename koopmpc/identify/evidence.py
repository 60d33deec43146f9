"""The facts that a verdict on a predictor rests on, and how many steps they let one trust."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.identify.coverage import Coverage
from koopmpc.identify.excitation import Persistency
from koopmpc.identify.invariance import Invariance
from koopmpc.identify.residual_dmd import ResidualDMD
from koopmpc.predict.conformal import ConformalBand, Covered
from koopmpc.predict.score import Score
from koopmpc.values import Value

USABLE = 0.2  # share of a state's range beyond which the band of its errors is of no use
SMALL = 0.05  # share up to which it need not beat x̂ = x_k


@dataclass(frozen=True, eq=False)
class Evidence(Value):
    """What a predictor does on episodes that it was not fitted to.

    Attributes
    ----------
    score, holding
        Errors of the predictor, and those of x̂_{k+h} = x_k, which needs no model.
    spread
        (nx,) range of each state in the held-out episodes, in its unit.
    residuals
        Residual of each eigenpair on the held-out episodes; for a linear predictor the same as `linearity_error`.
    invariance
        Of the dictionary, on the held-out episodes.
    coverage
        Of the training episodes where they were given, else of those held out.
    persistency, feedback
        Of the inputs, on the same episodes as `coverage`; None without inputs.
    band
        Conformal band of the held-out episodes.
    train_score, unseen
        Errors on the training episodes, and the share of the held-out samples that lie where these never were;
        None where they were not given.
    closed_loop, recalibrated
        How many closed-loop forecasts lay in the band, and the band calibrated on those episodes; None where
        they were not given.
    radius
        Spectral radius of A.
    dt
        Sampling time [s].
    inputs
        Those that `feedback` is about.
    """

    score: Score
    holding: Score
    spread: Float[np.ndarray, " nx"]
    residuals: ResidualDMD
    invariance: Invariance
    coverage: Coverage
    persistency: Persistency | None
    feedback: Float[np.ndarray, " nu"] | None
    band: ConformalBand
    train_score: Score | None
    unseen: float | None
    closed_loop: Covered | None
    recalibrated: ConformalBand | None
    radius: float
    dt: float
    inputs: tuple[str, ...]

    @property
    def error(self) -> Float[np.ndarray, "horizon nx"]:
        """(horizon, nx) the larger edge of the 5 … 95 % band of the errors, as a share of the state's range."""
        edge = np.maximum(np.abs(self.score.low), np.abs(self.score.high))
        return np.divide(edge, self.spread, out=np.where(edge > 0, np.inf, 0.0), where=self.spread > 0)

    @property
    def usable(self) -> np.ndarray:
        """(nx,) steps ahead to which each state can be trusted: its errors are small, or beat x̂ = x_k and not large."""
        beaten = self.score.rmse < self.holding.rmse
        good = (self.error <= SMALL) | ((self.error <= USABLE) & beaten)
        return np.cumprod(good, axis=0).sum(axis=0)

    @property
    def steps(self) -> int:
        """How many steps ahead all states can be trusted."""
        return int(self.usable.min())
