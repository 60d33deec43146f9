"""`trust` checks a predictor on held-out episodes, and reports the verdict, the findings and the evidence."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.terminal import label_lines, render_text
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.lifting.state import State
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.bands import conformal, cut_record
from koopmpc.validate.closed_loop import explain_beyond_past, explain_inputs
from koopmpc.validate.evidence import LIMITS, TrustEvidence
from koopmpc.validate.findings import Finding, build_error_table, format_verdict, list_evidence, list_findings
from koopmpc.validate.memory import find_hidden_state
from koopmpc.validate.residuals import compute_moments, measure_eigenpairs, measure_invariance
from koopmpc.validate.scoring import AnyPredictor, score
from koopmpc.validate.sufficiency import (
    Coverage,
    coverage,
    persistency,
)


@dataclass(frozen=True, eq=False)
class TrustReport(TrustEvidence):
    """All checks of a predictor on episodes that it was not fitted to; `print` shows the verdict first."""

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the predictor, grave ones first."""
        return list_findings(self)

    def __str__(self) -> str:
        """Return the verdict, each finding with its remedy, and the evidence."""
        return render_text(
            format_verdict(self),
            label_lines(
                pair
                for finding in self.findings
                for pair in (("✗" if finding.grave else "!", finding.says), ("", f"→ {finding.do}"))
            ),
            "",
            f"Errors x − x̂ of {self.score.starts} forecasts of held-out episodes. The share of range is the larger of "
            "|5 % quantile| and |95 % quantile|, divided by the range of the state. The last column divides the RMSE "
            "by that of the guess that nothing changes, x̂ = x_k.",
            "",
            build_error_table(self),
            "",
            label_lines(list_evidence(self)),
        )


def trust(
    predictor: AnyPredictor,
    held_out: Episodes,
    horizon: int,
    *,
    train: Episodes | None = None,
    closed_loop: Episodes | None = None,
    level: float = 0.9,
    rng: np.random.Generator | int = 0,
) -> TrustReport:
    """Check a predictor on episodes that it was not fitted to: errors, spectrum, dictionary, coverage, bands.

    The forecasts are those that a controller makes: a `KoopmanMPC` lifts a linear predictor once, a `BilinearMPC` lifts
    a bilinear one at each step.

    One rule gives the verdict. A step ahead is trusted if, for every state, the 5 … 95 % band of the errors stays
    within 20 % of the state's range in the held-out episodes. If the band exceeds 5 %, the root-mean-square error must
    also be below that of the guess x̂ = x_k. The report asks for care if

    - an eigenpair has a residual above 5 % a step (spurious); the report says whether it grows over the horizon. One
      with an eigenvalue of zero does not count where forecasts are lifted at each step;
    - an observable's own one-step error is above 10 % (the dictionary is not invariant);
    - the errors on held-out episodes are more than twice those on the training episodes;
    - more than 5 % of the held-out samples lie in cells without training data;
    - the inputs do not excite to order 2, or ψ(x) explains more than 90 % of an input (feedback), and
      more than a tenth of what the two rows before leave open;
    - past rows tell what the present one does not, so that a state is hidden, and the model does not see them;
    - the conformal band is infinite because there are too few episodes;
    - closed-loop forecasts stay in the band significantly less often than its level.

    An example on a pendulum over 12 steps (docs/how/trust.md):

    - A good model, fitted to the region where it is used, has a band of 4.6 % of the range at the last step, and 0.13
      times the error of x̂ = x_k.
    - A bad model, fitted near rest to many monomials, has 19 % and 3.5 times. Its held-out error is 85 times its
      training error, 83 % of the held-out samples are unseen, and spurious eigenpairs grow 21-fold. Nine steps of it
      are trusted.

    Parameters
    ----------
    predictor
        Linear or bilinear.
    held_out
        Two episodes or more, each at least `horizon` steps long; 12 or more for a finite band at 90 %.
    horizon
        Steps ahead; use the controller's horizon.
    train
        The episodes of the fit; with them the report states their coverage and excitation, and detects overfitting.
    closed_loop
        Episodes recorded with the controller. The band's level holds for the inputs of the held-out episodes; with
        these episodes the report states how often it holds in closed loop.
    level
        Share of the forecasts that the conformal band contains.
    rng
        Random generator or seed for the split and the starts of the conformal calibration.

    Raises
    ------
    ShapeError
        Episodes and predictor differ in states or inputs.
    DataError
        They differ in dt, an episode is shorter than the horizon, or there is only one held-out episode.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> train, held_out = data.split(0.6, rng=0)
    >>> model = km.edmd(train, km.State() + km.Fourier(1, states="theta"))
    >>> report = km.trust(model, held_out, horizon=5, train=train)
    >>> report.trusted
    True
    """
    horizon, source = checks.count(horizon, "horizon"), checks.generator(rng)
    relift = isinstance(predictor, BilinearPredictor)
    errors = score(predictor, episodes_of(held_out), horizon, relift=relift)
    held_out = cut_record(predictor, episodes_of(held_out), horizon)
    if len(held_out) < 2:
        raise DataError(
            "there is 1 held-out episode, too short for two blocks of the horizon and the model's past; the conformal "
            "band needs 2 or more"
        )
    band = conformal(predictor, held_out, horizon, level=level, relift=relift, rng=source)
    total = compute_moments(held_out, predictor)
    judged = held_out if train is None else episodes_of(train)
    low, high = _find_range(held_out)
    past = 0 if predictor.embedding is None else predictor.embedding.steps
    covered = coverage(judged) if train is None else coverage(judged, low=low, high=high)
    judged_total = total if train is None else compute_moments(train, predictor)
    driven = judged if isinstance(predictor, BilinearPredictor) and not predictor.nw else judged.driven()
    order = min(LIMITS.most_order, max(len(episode) for episode in driven))
    return TrustReport(
        score=errors,
        holding=score(_constant_predictor(predictor), held_out, horizon),
        spread=(high - low)[: predictor.nx],
        residuals=measure_eigenpairs(predictor, total),
        invariance=measure_invariance(total),
        coverage=covered,
        persistency=persistency(driven, order) if driven.nu else None,
        feedback=_find_feedback(predictor, judged, explain_inputs(judged_total)) if driven.nu else None,
        band=band,
        train_score=None if train is None else score(predictor, train, horizon, relift=relift),
        unseen=None if train is None else _unseen_share(covered, held_out),
        closed_loop=None if closed_loop is None else band.measure_coverage(predictor, closed_loop, rng=source),
        recalibrated=None if closed_loop is None else band.recalibrate(predictor, closed_loop, rng=source),
        radius=float(np.abs(predictor.eigenvalues[0])),
        dt=predictor.dt,
        inputs=total.inputs,
        memory=find_hidden_state(judged) if predictor.embedding is None else None,
        divisible=max(map(len, held_out)) >= 2 * (horizon + past),
    )


def _find_feedback(
    predictor: AnyPredictor, episodes: Episodes, shares: Float[np.ndarray, " nu"]
) -> Float[np.ndarray, " nu"]:
    """Return the shares of inputs that ψ explains; of slow ones the share of what their own past leaves open."""
    nu = predictor.nu
    if not (shares[:nu] > LIMITS.feedback).any():
        return shares
    beyond = explain_beyond_past(episodes, predictor)
    slow = (shares[:nu] > LIMITS.feedback) & (beyond < LIMITS.beyond)
    return np.append(np.where(slow, beyond, shares[:nu]), shares[nu:])


def _constant_predictor(predictor: AnyPredictor) -> LinearPredictor:
    """Return the predictor x̂_{k+h} = x_k of the same states and inputs."""
    nx, nu = predictor.nx, predictor.nu
    return LinearPredictor(
        np.eye(nx), np.zeros((nx, nu)), np.eye(nx), State(), predictor.dt, predictor.states, predictor.inputs
    )


def _find_range(episodes: Episodes) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the smallest and the largest value of each state and input."""
    low = [np.concatenate([e.X.min(axis=0), e.U.min(axis=0)]) for e in episodes]
    high = [np.concatenate([e.X.max(axis=0), e.U.max(axis=0)]) for e in episodes]
    return np.min(low, axis=0), np.max(high, axis=0)


def _unseen_share(covered: Coverage, episodes: Episodes) -> float:
    unseen = [np.sum(~covered.seen(episode.X[:-1], episode.U)) for episode in episodes]
    return float(sum(unseen) / sum(len(episode) for episode in episodes))
