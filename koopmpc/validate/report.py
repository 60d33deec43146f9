"""trust: all checks of a predictor on held-out episodes in one call, and their report."""

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
from koopmpc.validate.bands import conformal
from koopmpc.validate.identifiability import explained_inputs, persistency
from koopmpc.validate.regions import Coverage, coverage
from koopmpc.validate.residuals import eigen_residuals, moments_of, proximity_of
from koopmpc.validate.scoring import AnyPredictor, score
from koopmpc.validate.text import labelled, observable, percent, quantity, table, written
from koopmpc.validate.verdict import CheckResults, Finding, findings

_ORDER = 20  # persistency of excitation is looked at up to this order
_REGIONS = 3  # empty regions that are named


@dataclass(frozen=True, eq=False)
class TrustReport(CheckResults):
    """All checks of a predictor on episodes that it was not fitted to; `print` shows them, the verdict first.

    Its attributes are those of `CheckResults`.
    """

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the predictor, the gravest first; empty where there are none."""
        return findings(self)

    @property
    def trusted(self) -> bool:
        """True where the predictor can be trusted over the whole horizon; `findings` may still ask for care."""
        return self.steps == self.score.horizon

    def __str__(self) -> str:
        """Return the report: verdict, what to do, evidence."""
        return _layout(self)


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


def _layout(report: TrustReport) -> str:
    """Return the verdict, each finding with what to do about it, and the evidence."""
    return written(
        _verdict(report),
        labelled(
            pair
            for finding in report.findings
            for pair in (("✗" if finding.grave else "!", finding.says), ("", f"→ {finding.do}"))
        ),
        "",
        f"Errors x − x̂ of {report.score.starts} forecasts of held-out episodes. Of the 5 % and 95 % quantiles the one "
        "of larger size is also shown as a share of the range of the state. The last column divides the RMSE by that "
        "of the guess that nothing changes, x̂ = x_k.",
        "",
        _errors(report),
        "",
        labelled(_evidence(report)),
    )


def _verdict(report: TrustReport) -> str:
    horizon, steps, dt = report.score.horizon, report.steps, report.dt
    if steps == 0:
        return f"DO NOT TRUST, not even for one step ({dt:g} s)"
    if steps < horizon:
        return f"DO NOT TRUST beyond {steps} of {horizon} steps ({steps * dt:.3g} s)"
    care = " WITH CARE" if report.findings else ""
    return f"TRUST{care} over {horizon} steps ({horizon * dt:.3g} s)"


def _errors(report: TrustReport) -> Table:
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
