"""The evidence for or against a predictor, and how many steps ahead it can be trusted."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.base.values import Value
from koopmpc.validate.bands import BandCoverage, ConformalBand
from koopmpc.validate.memory import Memory
from koopmpc.validate.residuals import Invariance, ResidualDMD
from koopmpc.validate.scoring import Score
from koopmpc.validate.sufficiency import (
    Coverage,
    Persistency,
)


@dataclass(frozen=True)
class TrustLimits:
    """Limits beyond which the report doubts a model, and sizes of what it shows."""

    most_order: int = 20  # test persistency of excitation up to this order
    most_regions: int = 3  # list at most this many empty regions
    usable: float = 0.2  # forecasts are trusted while the band of the errors is within this share of the state's range
    small: float = 0.05  # above this share of the range, the errors must also be smaller than those of x̂ = x_k
    # above this one-step error of an observable, as a share of its size, the dictionary is not invariant
    invariant: float = 0.1
    overfit: float = 2.0  # above this ratio of held-out to training error, a model is overfitted
    # above this share of held-out samples in cells without training data, the report asks for care
    unseen: float = 0.05
    # an eigenvalue below this belongs to observables whose next values the model does not forecast
    forgotten: float = 1e-9
    notable_growth: float = 2.0  # mention a spurious eigenfunction that grows by more than this factor over the horizon
    feedback: float = 0.9  # if ψ(x) explains a larger share of an input's energy, the input counts as feedback …
    beyond: float = 0.1  # … unless it explains a smaller share than this of what the input's own past leaves open
    episodes: int = 36  # with so many `koopmpc fit` has a band of 90 %: a third is held out, and 9 of these calibrate
    most_names: int = 3  # list at most this many names in one sentence


LIMITS = TrustLimits()


@dataclass(frozen=True, eq=False)
class TrustEvidence(Value):
    """What all checks of a predictor on episodes that it was not fitted to have measured.

    Attributes
    ----------
    score, holding
        Errors of the predictor, and those of the guess x̂_{k+h} = x_k.
    spread
        (nx,) range of each state in the held-out episodes, in its unit.
    residuals
        Residual of each eigenpair on the held-out episodes; for a linear predictor it equals `linearity_error`.
    invariance
        Invariance of the dictionary on the held-out episodes.
    coverage
        Bins and cells that the training episodes visited; without training episodes, those of the held-out episodes.
    persistency, feedback
        Excitation of the inputs, and the share of them that ψ(x) explains, of slow inputs the share of what their own
        past leaves open; on the same episodes as `coverage`. None without inputs.
    band
        Conformal band of the held-out episodes.
    train_score, unseen
        Errors on the training episodes, and the share of the held-out samples in cells without training samples; None
        without training episodes.
    closed_loop, recalibrated
        Share of closed-loop forecasts that stayed in the band, and the band calibrated on the closed-loop episodes;
        None without such episodes.
    radius
        Spectral radius of A.
    dt
        Sampling time [s].
    inputs
        Names of the inputs in the order of `feedback`.
    memory
        What past rows tell beyond the present one, on the same episodes as `coverage`; None for a model that sees past
        rows or has a hidden state.
    divisible
        True if a held-out episode has room for two forecasts, each with the model's past.
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
    closed_loop: BandCoverage | None
    recalibrated: ConformalBand | None
    radius: float
    dt: float
    inputs: tuple[str, ...]
    memory: Memory | None = None
    divisible: bool = True

    @property
    def error(self) -> Float[np.ndarray, "horizon nx"]:
        """(horizon, nx) the larger edge of the 5 … 95 % band of the errors, as a share of the state's range."""
        edge = np.maximum(np.abs(self.score.low), np.abs(self.score.high))
        return np.divide(edge, self.spread, out=np.where(edge > 0, np.inf, 0.0), where=self.spread > 0)

    @property
    def usable(self) -> np.ndarray:
        """(nx,) number of steps ahead for which the forecast of each state can be trusted.

        A step counts if its error is at most 5 % of the range, or at most 20 % and smaller than that of x̂ = x_k.
        """
        better = self.score.rmse < self.holding.rmse
        good = (self.error <= LIMITS.small) | ((self.error <= LIMITS.usable) & better)
        return np.cumprod(good, axis=0).sum(axis=0)

    @property
    def steps(self) -> int:
        """The number of steps ahead for which all states can be trusted."""
        return int(self.usable.min())

    @property
    def trusted(self) -> bool:
        """True if the predictor can be trusted over the whole horizon; `findings` may still ask for care."""
        return self.steps == self.score.horizon
