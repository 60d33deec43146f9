"""trust: all checks of a predictor on held-out episodes in one call, what they say against it, and their report."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from rich.table import Table

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.lifting.base import short
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.bands import ConformalBand, Covered, conformal
from koopmpc.validate.residuals import Invariance, ResidualDMD, eigen_residuals, moments_of, proximity_of
from koopmpc.validate.scoring import AnyPredictor, Score, score
from koopmpc.validate.sufficiency import Coverage, Persistency, coverage, explained_inputs, persistency
from koopmpc.validate.text import labelled, observable, percent, quantity, table, written
from koopmpc.values import Value

_ORDER = 20  # persistency of excitation is looked at up to this order
_REGIONS = 3  # empty regions that are named
_USABLE = 0.2  # share of a state's range beyond which the band of its errors is of no use
_SMALL = 0.05  # share up to which it need not beat x̂ = x_k
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


@dataclass(frozen=True, eq=False)
class TrustReport(Value):
    """All checks of a predictor on episodes that it was not fitted to; `print` shows them, the verdict first.

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
        good = (self.error <= _SMALL) | ((self.error <= _USABLE) & beaten)
        return np.cumprod(good, axis=0).sum(axis=0)

    @property
    def steps(self) -> int:
        """The number of steps ahead for which all states can be trusted."""
        return int(self.usable.min())

    @property
    def trusted(self) -> bool:
        """True where the predictor can be trusted over the whole horizon; `findings` may still ask for care."""
        return self.steps == self.score.horizon

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the predictor, the gravest first; empty where there are none."""
        care = _spectrum, _dictionary, _fit, _inputs, _band, _closed_loop
        grave = [Finding(True, says, do) for says, do in _errors(self)]
        return (*grave, *(Finding(False, says, do) for check in care for says, do in check(self)))

    def __str__(self) -> str:
        """Return the verdict, each finding with what to do about it, and the evidence."""
        return written(
            _verdict(self),
            labelled(
                pair
                for finding in self.findings
                for pair in (("✗" if finding.grave else "!", finding.says), ("", f"→ {finding.do}"))
            ),
            "",
            f"Errors x − x̂ of {self.score.starts} forecasts of held-out episodes. Of the 5 % and 95 % quantiles the "
            "one of larger size is also shown as a share of the range of the state. The last column divides the RMSE "
            "by that of the guess that nothing changes, x̂ = x_k.",
            "",
            _error_table(self),
            "",
            labelled(_evidence(self)),
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
        Share of the errors that the conformal band holds.
    rng
        Draws the split and the starts of the conformal calibration.

    Raises
    ------
    ShapeError
        Episodes and predictor differ in states or inputs.
    DataError
        They differ in dt, an episode is shorter than the horizon, or there is one alone.

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
    errors = score(predictor, episodes_of(held_out), horizon)
    if len(held_out) < 2:
        raise DataError("there is 1 held-out episode; the conformal band needs 2 or more")
    band = conformal(predictor, held_out, horizon, level=level, rng=source)
    total = moments_of(held_out, predictor)
    fitted = held_out if train is None else episodes_of(train)
    low, high = _range(held_out)
    seen = coverage(fitted) if train is None else coverage(fitted, low=low, high=high)
    total_fitted = total if train is None else moments_of(train, predictor)
    driven = fitted if isinstance(predictor, BilinearPredictor) else fitted.driven()
    order = min(_ORDER, max(len(episode) for episode in driven))
    return TrustReport(
        score=errors,
        holding=score(_hold(predictor), held_out, horizon),
        spread=(high - low)[: predictor.nx],
        residuals=eigen_residuals(predictor, total),
        invariance=proximity_of(total),
        coverage=seen,
        persistency=persistency(driven, order) if driven.nu else None,
        feedback=explained_inputs(total_fitted) if driven.nu else None,
        band=band,
        train_score=None if train is None else score(predictor, train, horizon),
        unseen=None if train is None else _unseen(seen, held_out),
        closed_loop=None if closed_loop is None else band.measured(predictor, closed_loop, rng=source),
        recalibrated=None if closed_loop is None else band.recalibrated(predictor, closed_loop, rng=source),
        radius=float(np.abs(predictor.eigenvalues[0])),
        dt=predictor.dt,
        inputs=total.inputs,
    )


def _hold(predictor: AnyPredictor) -> LinearPredictor:
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


def _errors(report: TrustReport) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the errors, and what to do; the same of other evidence in the functions below."""
    horizon, steps = report.score.horizon, report.steps
    if steps == horizon:
        return
    state = int(np.argmin(report.usable))
    name, there = report.score.states[state], report.error[:, state]
    far = f"{percent(there[steps])} of its range at step {steps + 1} and {percent(there[-1])} at step {horizon}"
    says = f"the errors of {short(name)} reach {far} (5 % and 95 % quantiles)"
    if there[steps] <= _USABLE:
        says += ", and the guess that nothing changes is no worse"
    if report.unseen is not None and report.unseen > _UNSEEN:
        do = "collect data where the model will be used"
    elif _overfit(report):
        do = "collect more data, take fewer observables or a larger ridge"
    else:
        do = "take richer observables or bilinear_edmd, and compare their scores over this horizon"
    yield says, do + (f"; a horizon of {steps} steps is within reach" if steps else "")


def _spectrum(report: TrustReport) -> Iterator[tuple[str, str]]:
    of = report.residuals
    bad = of.spurious
    if not bad.any():
        return
    with np.errstate(over="ignore"):
        growth = np.abs(of.eigenvalues) ** report.score.horizon
    growing = bad & (growth > _GROWS)
    worst = int(np.argmax(np.where(growing, growth, 0.0) if growing.any() else of.residuals))
    told = f"λ = {_complex(complex(of.eigenvalues[worst]))} (residual {percent(float(of.residuals[worst]))})"
    says = f"{int(bad.sum())} of {len(bad)} eigenpairs are spurious (residual above {percent(of.tolerance)} a step)"
    if growing.any():
        n = int(growing.sum())
        says += f", and {n} of them grow{'s' * (n == 1)}: {told} grows {growth[worst]:.2g}-fold over the horizon"
        yield says, "drop observables, raise the ridge, or truncate the rank"
    else:
        yield f"{says}; the worst is {told}", "read no modes or frequencies from these; predictions may still be good"


def _dictionary(report: TrustReport) -> Iterator[tuple[str, str]]:
    names, errors = report.invariance.names, report.invariance.errors
    bad = np.flatnonzero(errors > _INVARIANT)
    if bad.size:
        worst: list[int] = bad[np.argsort(-errors[bad], kind="stable")].tolist()
        named = ", ".join(f"{observable(names[i])} {percent(float(errors[i]))}" for i in worst[:_NAMED])
        yield (
            f"the dictionary is not invariant: the next value of {bad.size} of {len(errors)} observables is off by "
            f"more than {percent(_INVARIANT)} of its size ({named}{', …' if bad.size > _NAMED else ''})",
            "for a longer horizon add what their next values depend on; compare scores before dropping one",
        )


def _fit(report: TrustReport) -> Iterator[tuple[str, str]]:
    if report.train_score is not None and _overfit(report):
        ratio = report.score.total / max(report.train_score.total, np.finfo(float).tiny)
        says = f"errors on held-out episodes are {ratio:.3g} times those on the training episodes"
        yield says, "collect more data, take fewer observables or a larger ridge"
    if report.unseen is not None and report.unseen > _UNSEEN:
        said = "; ".join(str(region) for region in report.coverage.empty[:_NAMED])
        says = f"{percent(report.unseen)} of the held-out samples lie where the training data never were"
        yield says + (f": {said}" if said else ""), "collect data there, or keep the controller away from there"


def _inputs(report: TrustReport) -> Iterator[tuple[str, str]]:
    if report.persistency is not None and report.persistency.order < min(2, report.persistency.asked):
        says = f"the inputs are exciting to order {report.persistency.order} only, so B cannot be identified"
        yield says, "excite every input, with noise or PRBS"
    if report.feedback is not None:
        bad = np.flatnonzero(report.feedback > _EXPLAINED).tolist()
        names = ", ".join(f"{percent(report.feedback[i])} of {short(report.inputs[i])}" for i in bad[:_NAMED])
        if bad:
            yield (
                f"feedback: the observables explain most of the inputs ({names}), so A and B are hard to separate",
                "add noise to the inputs",
            )


def _band(report: TrustReport) -> Iterator[tuple[str, str]]:
    band = report.band
    if np.isfinite(band.quantile):
        return
    if band.episodes >= band.needed:
        yield "forecasts leave the finite numbers", "look at the spectrum of A"
    else:
        there = f"there are {band.episodes} calibration episodes, at least {band.needed} are needed"
        yield f"there is no band at {percent(band.level)}: {there}", "hold out more episodes, or ask for a lower level"


def _closed_loop(report: TrustReport) -> Iterator[tuple[str, str]]:
    loop, band = report.closed_loop, report.band
    if loop is None:
        return
    chance = 2 * np.sqrt(band.level * (1 - band.level) * (1 / band.episodes + 1 / loop.episodes))
    if loop.share < band.level - chance:
        yield (
            f"in closed loop {percent(loop.share)} of the forecasts stay in the {percent(band.level)} band",
            "use the band that is recalibrated on closed-loop episodes, or fit with closed-loop data",
        )


def _overfit(report: TrustReport) -> bool:
    train = report.train_score
    return train is not None and report.score.total > max(_OVERFIT * train.total, 1e-6)


def _complex(value: complex) -> str:
    return f"{value.real:.3g}" if abs(value.imag) < 1e-12 else f"{value.real:.3g} ± {abs(value.imag):.3g}i"


def _verdict(report: TrustReport) -> str:
    horizon, steps, dt = report.score.horizon, report.steps, report.dt
    if steps == 0:
        return f"DO NOT TRUST, not even for one step ({dt:g} s)"
    if steps < horizon:
        return f"DO NOT TRUST beyond {steps} of {horizon} steps ({steps * dt:.3g} s)"
    care = " WITH CARE" if report.findings else ""
    return f"TRUST{care} over {horizon} steps ({horizon * dt:.3g} s)"


def _error_table(report: TrustReport) -> Table:
    """Return the errors of each state at a few horizons."""
    of = report.score
    ahead = sorted({1, max(of.horizon // 4, 1), max(of.horizon // 2, 1), of.horizon})
    rows: list[list[str]] = []
    for i, name in enumerate(of.states):
        for h in ahead:
            still = report.holding.rmse[h - 1, i]
            numbers = (of.rmse[h - 1, i], of.low[h - 1, i], of.high[h - 1, i])
            ratio = f"{numbers[0] / still:.2g}" if still > 0 else "–"
            share = percent(report.error[h - 1, i])
            rows.append([name if h == ahead[0] else "", str(h), *(f"{v:.3g}" for v in numbers), share, ratio])
    return table(
        ("state", "steps\nahead", "RMSE", "5 %\nquantile", "95 %\nquantile", "share of\nrange", "RMSE over\nno change"),
        rows,
    )


def _evidence(report: TrustReport) -> Iterator[tuple[str, str]]:
    """Yield label and text of each line below the table."""
    pairs, dictionary, seen = report.residuals, report.invariance, report.coverage
    yield (
        "spectrum",
        f"{int(pairs.spurious.sum())} of {len(pairs.residuals)} eigenpairs are spurious (residual above "
        f"{percent(pairs.tolerance)} a step), the median residual is {percent(float(np.median(pairs.residuals)))}; "
        f"the spectral radius is {report.radius:.4g}",
    )
    worst = int(np.argmax(dictionary.errors))
    yield (
        "dictionary",
        f"the observable with the largest error after one step is {observable(dictionary.names[worst])}, with "
        f"{percent(dictionary.errors[worst])} of its size; the combination of observables with the largest has "
        f"{percent(dictionary.proximity)}",
    )
    fill = seen.occupied
    whose = "held-out" if report.train_score is None else "training"
    filled = f"{percent(fill.min())} of the {seen.bins} bins of {short(seen.names[int(fill.argmin())])}, the fewest"
    if fill.min() == 1:
        filled = f"all {seen.bins} bins of each coordinate"
    text = f"{seen.samples} {whose} samples fill {filled}"
    if report.unseen is not None:
        text += f"; {percent(report.unseen)} of the held-out samples lie where there are no training samples"
    yield "coverage", text
    for region in seen.empty[:_REGIONS]:
        yield "", f"{region} ({percent(region.share)} of the area)"
    if report.persistency is not None and report.feedback is not None:
        order, asked = report.persistency.order, report.persistency.asked
        shares = ", ".join(
            f"{percent(share)} of {short(name)}" for name, share in zip(report.inputs, report.feedback, strict=True)
        )
        yield (
            "inputs",
            f"persistently exciting of order {order}{' or more' if order == asked else ''}; the observables explain "
            f"{shares}",
        )
    band = report.band
    if np.isfinite(band.width[-1]).all():
        widths = ", ".join(quantity(name, f"± {w:.3g}") for name, w in zip(band.states, band.width[-1], strict=True))
        yield (
            "band",
            f"{percent(band.level)} of forecasts stay within a band at all of their steps, at the last one {widths}; "
            f"calibrated on {band.episodes} episodes, and promised for inputs of the same distribution only",
        )
    else:
        yield "band", f"no finite band holds {percent(band.level)} of forecasts ({band.episodes} calibration episodes)"
    loop, again = report.closed_loop, report.recalibrated
    if loop is not None and again is not None:
        text = (
            f"{percent(loop.share)} of {loop.episodes} forecasts stay in that band "
            f"(95 % interval {percent(loop.low)} to {percent(loop.high)})"
        )
        if np.isfinite(band.quantile):
            text += f"; calibrated on them it is {again.quantile / band.quantile:.3g} times as wide"
        yield "closed loop", text
