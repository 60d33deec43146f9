"""From the evidence on a predictor to sentences: what is wrong, and what to do."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import short
from koopmpc.validate.bands import ConformalBand, Covered
from koopmpc.validate.identifiability import Persistency
from koopmpc.validate.regions import Coverage
from koopmpc.validate.residuals import Invariance, ResidualDMD
from koopmpc.validate.scoring import Score
from koopmpc.validate.text import observable, percent
from koopmpc.values import Value

USABLE = 0.2  # share of a state's range beyond which the band of its errors is of no use
SMALL = 0.05  # share up to which it need not beat x̂ = x_k


@dataclass(frozen=True, eq=False)
class CheckResults(Value):
    """The results of all checks of a predictor on episodes that it was not fitted to.

    Attributes
    ----------
    score, holding
        Errors of the predictor, and those of x̂_{k+h} = x_k, which needs no model.
    spread
        (nx,) range of each state in the held-out episodes, in its unit.
    residuals
        Residual of each eigenpair on the held-out episodes; for a linear predictor the same as `linearity_error`.
    invariance
        Invariance of the dictionary on the held-out episodes.
    coverage
        Where the training episodes lie, or the held-out episodes where no training episodes were given.
    persistency, feedback
        Excitation of the inputs, and the share of them that ψ(x) explains, on the same episodes as `coverage`; None
        without inputs.
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
        Names of the inputs that `feedback` is about.
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
        """The number of steps ahead for which all states can be trusted."""
        return int(self.usable.min())


_INVARIANT = 0.1  # one-step error of an observable above which the dictionary is not invariant, as a share of its size
_OVERFIT = 2.0  # ratio of held-out to training error above which a model is overfitted
_UNSEEN = 0.05  # share of held-out samples in unseen cells that asks for care
_GROWS = 2.0  # growth of a spurious eigenfunction over the horizon that is worth a word
_EXPLAINED = 0.9  # share of an input's energy that ψ(x) explains, above which it counts as feedback
_NAMED = 3  # names that one sentence lists


@dataclass(frozen=True, eq=False)
class Finding(Value):
    """One reason for distrust or care.

    Attributes
    ----------
    grave
        True where the model cannot be trusted over the whole horizon; False where care is needed.
    says
        What is wrong, with the number.
    do
        What to do about it.
    """

    grave: bool
    says: str
    do: str


def findings(evidence: CheckResults) -> tuple[Finding, ...]:
    """Return the findings against the predictor, the gravest first."""
    checks = (_errors, _spectrum, _dictionary, _fit, _inputs, _band, _closed_loop)
    found = [finding for check in checks for finding in check(evidence)]
    return tuple(sorted(found, key=lambda finding: not finding.grave))


def _errors(evidence: CheckResults) -> Iterator[Finding]:
    horizon, steps = evidence.score.horizon, evidence.steps
    if steps == horizon:
        return
    state = int(np.argmin(evidence.usable))
    name, there = evidence.score.states[state], evidence.error[:, state]
    far = f"{percent(there[steps])} of its range at step {steps + 1} and {percent(there[-1])} at step {horizon}"
    says = f"the errors of {short(name)} reach {far} (5 % and 95 % quantiles)"
    if there[steps] <= USABLE:
        says += ", and the guess that nothing changes is no worse"
    if evidence.unseen is not None and evidence.unseen > _UNSEEN:
        do = "collect data where the model will be used"
    elif _overfit(evidence):
        do = "collect more data, take fewer observables or a larger ridge"
    else:
        do = "take richer observables or bilinear_edmd, and compare their scores over this horizon"
    shorten = f"; a horizon of {steps} steps is within reach" if steps else ""
    yield Finding(True, says, do + shorten)


def _spectrum(evidence: CheckResults) -> Iterator[Finding]:
    of = evidence.residuals
    bad = of.spurious
    if not bad.any():
        return
    with np.errstate(over="ignore"):
        growth = np.abs(of.eigenvalues) ** evidence.score.horizon
    growing = bad & (growth > _GROWS)
    worst = int(np.argmax(np.where(growing, growth, 0.0) if growing.any() else of.residuals))
    told = f"λ = {_complex(complex(of.eigenvalues[worst]))} (residual {percent(float(of.residuals[worst]))})"
    says = f"{int(bad.sum())} of {len(bad)} eigenpairs are spurious (residual above {percent(of.tolerance)} a step)"
    if growing.any():
        n = int(growing.sum())
        says += f", and {n} of them grow{'s' * (n == 1)}: {told} grows {growth[worst]:.2g}-fold over the horizon"
        yield Finding(False, says, "drop observables, raise the ridge, or truncate the rank")
    else:
        do = "read no modes or frequencies from these; predictions may still be good"
        yield Finding(False, f"{says}; the worst is {told}", do)


def _dictionary(evidence: CheckResults) -> Iterator[Finding]:
    errors = evidence.invariance.errors
    bad = np.flatnonzero(errors > _INVARIANT)
    if not bad.size:
        return
    worst = bad[np.argsort(-errors[bad], kind="stable")]
    names = ", ".join(
        f"{observable(evidence.invariance.names[int(i)])} {percent(float(errors[i]))}" for i in worst[:_NAMED]
    )
    says = (
        f"the dictionary is not invariant: the next value of {bad.size} of {len(errors)} observables is off by "
        f"more than {percent(_INVARIANT)} of its size ({names}{', …' if bad.size > _NAMED else ''})"
    )
    yield Finding(
        False, says, "for a longer horizon add what their next values depend on; compare scores before dropping one"
    )


def _fit(evidence: CheckResults) -> Iterator[Finding]:
    if evidence.train_score is not None and _overfit(evidence):
        ratio = evidence.score.total / max(evidence.train_score.total, np.finfo(float).tiny)
        says = f"errors on held-out episodes are {ratio:.3g} times those on the training episodes"
        yield Finding(False, says, "collect more data, take fewer observables or a larger ridge")
    if evidence.unseen is not None and evidence.unseen > _UNSEEN:
        said = "; ".join(str(region) for region in evidence.coverage.empty[:_NAMED])
        yield Finding(
            False,
            f"{percent(evidence.unseen)} of the held-out samples lie where the training data never were"
            + (f": {said}" if said else ""),
            "collect data there, or keep the controller away from there",
        )


def _inputs(evidence: CheckResults) -> Iterator[Finding]:
    if evidence.persistency is not None and evidence.persistency.order < min(2, evidence.persistency.asked):
        yield Finding(
            False,
            f"the inputs are exciting to order {evidence.persistency.order} only, so B cannot be identified",
            "excite every input, with noise or PRBS",
        )
    if evidence.feedback is not None:
        bad = np.flatnonzero(evidence.feedback > _EXPLAINED)
        names = ", ".join(
            f"{percent(float(evidence.feedback[i]))} of {short(evidence.inputs[int(i)])}" for i in bad[:_NAMED]
        )
        if bad.size:
            yield Finding(
                False,
                f"feedback: the observables explain most of the inputs ({names}), so A and B are hard to separate",
                "add noise to the inputs",
            )


def _band(evidence: CheckResults) -> Iterator[Finding]:
    band = evidence.band
    if np.isfinite(band.quantile):
        return
    if band.episodes >= band.needed:
        yield Finding(False, "forecasts leave the finite numbers", "look at the spectrum of A")
    else:
        there = f"there are {band.episodes} calibration episodes, at least {band.needed} are needed"
        says = f"there is no band at {percent(band.level)}: {there}"
        yield Finding(False, says, "hold out more episodes, or ask for a lower level")


def _closed_loop(evidence: CheckResults) -> Iterator[Finding]:
    loop, band = evidence.closed_loop, evidence.band
    if loop is None:
        return
    chance = 2 * np.sqrt(band.level * (1 - band.level) * (1 / band.episodes + 1 / loop.episodes))
    if loop.share >= band.level - chance:
        return
    yield Finding(
        False,
        f"in closed loop {percent(loop.share)} of the forecasts stay in the {percent(band.level)} band",
        "use the band that is recalibrated on closed-loop episodes, or fit with closed-loop data",
    )


def _overfit(evidence: CheckResults) -> bool:
    train = evidence.train_score
    return train is not None and evidence.score.total > max(_OVERFIT * train.total, 1e-6)


def _complex(value: complex) -> str:
    return f"{value.real:.3g}" if abs(value.imag) < 1e-12 else f"{value.real:.3g} ± {abs(value.imag):.3g}i"
