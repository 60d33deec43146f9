"""Whether to trust a predictor: all checks on held-out episodes in one call and one report."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.read import second_moments
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.bands import conformal
from koopmpc.validate.excitation import feedback_share, persistency
from koopmpc.validate.regions import Coverage, coverage
from koopmpc.validate.residuals import residual_dmd
from koopmpc.validate.scoring import Predictor, score
from koopmpc.validate.subspace import invariance
from koopmpc.validate.text import written
from koopmpc.validate.verdict import Evidence, Finding, findings

_ORDER = 20  # persistency of excitation is looked at up to here


@dataclass(frozen=True, eq=False)
class TrustReport(Evidence):
    """What a predictor does on episodes that it was not fitted to; `print` shows it, the verdict first.

    Its attributes are those of `Evidence`.
    """

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against the predictor, the gravest first; empty where nothing does."""
        return findings(self)

    @property
    def trusted(self) -> bool:
        """Whether the predictor can be trusted over the whole horizon; `findings` may still ask for care."""
        return self.steps == self.score.horizon

    def __str__(self) -> str:
        """Return the report: verdict, what to do, evidence."""
        return written(self, self.findings)


def trust(
    predictor: Predictor,
    held_out: Episodes,
    horizon: int,
    *,
    train: Episodes | None = None,
    closed_loop: Episodes | None = None,
    level: float = 0.9,
    rng: np.random.Generator | int = 0,
) -> TrustReport:
    """Check a predictor on episodes that it was not fitted to: errors, spectrum, dictionary, coverage, bands.

    The verdict rests on one rule. A number of steps is trusted while, for every state, the 5 … 95 % band of the
    errors stays within 20 % of the state's range in the held-out episodes; and where it is beyond 5 %, the
    root-mean-square error must be below that of x̂ = x_k, which needs no model. Care is asked for where

    - an eigenpair has a residual above 5 % a step (spurious), the more so where it grows over the horizon;
    - an observable's own one-step error is above 10 % (the dictionary is not invariant);
    - the errors on held-out episodes are more than twice those on the training episodes;
    - more than 5 % of the held-out samples lie in cells that the training data never saw;
    - the inputs do not excite to order 2, or ψ(x) explains more than 90 % of an input (feedback);
    - the conformal band is infinite for want of episodes;
    - closed-loop forecasts stay in the band less often than promised, beyond chance.

    Measured on a pendulum over 12 steps (docs/identification.md): a good model, fitted where it is used, has a band
    of 4.6 % of the range at the last step and 0.13 times the error of x̂ = x_k. A bad one, fitted near rest to many
    monomials, has 19 % and 3.5 times, 85 times its training error, 83 % of the held-out samples unseen, and
    spurious eigenpairs that grow 21-fold; nine steps of it are trusted.

    Parameters
    ----------
    predictor
        Linear or bilinear.
    held_out
        Two episodes or more, each at least `horizon` steps long; 12 or more for a finite band at 90 %.
    horizon
        Steps ahead, those of the controller.
    train
        The episodes of the fit: then coverage and excitation are theirs, and overfitting shows.
    closed_loop
        Episodes of the controller at work. The band's promise is for the inputs of the held-out episodes; what it
        is worth under feedback is measured on these.
    level
        Of the conformal band.
    rng
        Draws the split and the starts of the conformal calibration.

    Raises
    ------
    ShapeError
        Episodes and predictor differ in states or inputs.
    DataError
        They differ in dt, an episode is shorter than the horizon, or there is one alone.
    """
    horizon, source = checks.count(horizon, "horizon"), checks.generator(rng)
    errors = score(predictor, episodes_of(held_out), horizon)
    if len(held_out) < 2:
        raise DataError("there is 1 held-out episode; the conformal band needs 2 or more")
    band = conformal(predictor, held_out, horizon, level=level, rng=source)
    total = _moments(predictor, held_out)
    fitted = held_out if train is None else train
    low, high = _range(held_out)
    seen = coverage(fitted) if train is None else coverage(fitted, low=low, high=high)
    total_fitted = total if train is None else _moments(predictor, train)
    driven = fitted if isinstance(predictor, BilinearPredictor) else fitted.driven()
    order = min(_ORDER, max(len(episode) for episode in driven))
    return TrustReport(
        score=errors,
        holding=score(_hold(predictor), held_out, horizon),
        spread=(high - low)[: predictor.nx],
        residuals=residual_dmd(predictor, total),
        invariance=invariance(total),
        coverage=seen,
        persistency=persistency(driven, order) if driven.nu else None,
        feedback=feedback_share(total_fitted) if driven.nu else None,
        band=band,
        train_score=None if train is None else score(predictor, train, horizon),
        unseen=None if train is None else _unseen(seen, held_out),
        closed_loop=None if closed_loop is None else band.measured(predictor, closed_loop, rng=source),
        recalibrated=None if closed_loop is None else band.recalibrated(predictor, closed_loop, rng=source),
        radius=float(np.abs(predictor.eigenvalues[0])),
        dt=predictor.dt,
        inputs=total.inputs,
    )


def _moments(predictor: Predictor, episodes: Episodes) -> Moments:
    """Return the moments of these episodes in the predictor's lifting, by QR: residuals down to rounding."""
    if isinstance(predictor, BilinearPredictor):
        return second_moments(episodes, predictor.lifting, embedding=predictor.embedding, route="qr", bilinear=True)
    driven = episodes.driven() if predictor.nw else episodes
    return second_moments(driven, predictor.lifting, embedding=predictor.embedding, route="qr")


def _hold(predictor: Predictor) -> LinearPredictor:
    """Return x̂_{k+h} = x_k."""
    nx, nu = predictor.nx, predictor.nu
    return LinearPredictor(
        np.eye(nx), np.zeros((nx, nu)), np.eye(nx), State(), predictor.dt, predictor.states, predictor.inputs
    )


def _range(episodes: Episodes) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the least and the largest of each state and input."""
    low = [np.concatenate([e.X.min(axis=0), e.U.min(axis=0)]) for e in episodes]
    high = [np.concatenate([e.X.max(axis=0), e.U.max(axis=0)]) for e in episodes]
    return np.min(low, axis=0), np.max(high, axis=0)


def _unseen(seen: Coverage, episodes: Episodes) -> float:
    missed = [np.sum(~seen.seen(episode.X[:-1], episode.U)) for episode in episodes]
    return float(sum(missed) / sum(len(episode) for episode in episodes))
