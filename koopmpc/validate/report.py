"""`trust` checks a predictor on held-out episodes, and reports the verdict, the findings and the evidence."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from rich.table import Table

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.terminal import build_table, label_lines, render_text
from koopmpc.text import shorten_observable, to_percent, with_unit
from koopmpc.validate.bands import BandCoverage, ConformalBand, conformal, cut_record
from koopmpc.validate.closed_loop import explain_beyond_past, explain_inputs
from koopmpc.validate.memory import Memory, find_hidden_state
from koopmpc.validate.residuals import Invariance, ResidualDMD, compute_moments, measure_eigenpairs, measure_invariance
from koopmpc.validate.scoring import AnyPredictor, Score, score
from koopmpc.validate.sufficiency import (
    Coverage,
    Persistency,
    coverage,
    persistency,
)
from koopmpc.values import Value


@dataclass(frozen=True)
class _Limits:
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


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class Finding(Value):
    """One finding of `trust` against a model.

    Attributes
    ----------
    grave
        True if the model cannot be trusted over the whole horizon; False if it needs care.
    says
        The finding, with its number.
    do
        The remedy.
    """

    grave: bool
    says: str
    do: str


@dataclass(frozen=True, eq=False)
class TrustReport(Value):
    """All checks of a predictor on episodes that it was not fitted to; `print` shows the verdict first.

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
        good = (self.error <= _LIMITS.small) | ((self.error <= _LIMITS.usable) & better)
        return np.cumprod(good, axis=0).sum(axis=0)

    @property
    def steps(self) -> int:
        """The number of steps ahead for which all states can be trusted."""
        return int(self.usable.min())

    @property
    def trusted(self) -> bool:
        """True if the predictor can be trusted over the whole horizon; `findings` may still ask for care."""
        return self.steps == self.score.horizon

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the predictor, grave ones first."""
        checks_for_care = (
            _check_spectrum,
            _check_dictionary,
            _check_fit,
            _check_inputs,
            _check_memory,
            _check_band,
            _check_closed_loop,
        )
        grave = [Finding(True, says, do) for says, do in _check_errors(self)]
        return (*grave, *(Finding(False, says, do) for check in checks_for_care for says, do in check(self)))

    def __str__(self) -> str:
        """Return the verdict, each finding with its remedy, and the evidence."""
        return render_text(
            _format_verdict(self),
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
            _build_error_table(self),
            "",
            label_lines(_list_evidence(self)),
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
    order = min(_LIMITS.most_order, max(len(episode) for episode in driven))
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
    if not (shares[:nu] > _LIMITS.feedback).any():
        return shares
    beyond = explain_beyond_past(episodes, predictor)
    slow = (shares[:nu] > _LIMITS.feedback) & (beyond < _LIMITS.beyond)
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


# Each _check function yields pairs (finding, remedy) about one kind of evidence.


def _check_errors(report: TrustReport) -> Iterator[tuple[str, str]]:
    horizon, steps = report.score.horizon, report.steps
    if steps == horizon:
        return
    state = int(np.argmin(report.usable))
    name, error = report.score.states[state], report.error[:, state]
    reached = (
        f"{to_percent(error[steps])} of its range at step {steps + 1} and {to_percent(error[-1])} at step {horizon}"
    )
    says = f"the errors of {strip_unit(name)} reach {reached} (5 % and 95 % quantiles)"
    if error[steps] <= _LIMITS.usable:
        says += ", and the guess that nothing changes is at least as accurate"
    if report.unseen is not None and report.unseen > _LIMITS.unseen:
        do = "collect data where the model will be used"
    elif _is_overfitted(report):
        do = "collect more data, take fewer observables or a larger ridge"
    else:
        do = "take richer observables or bilinear_edmd, and compare their scores over this horizon"
    yield says, do + (f"; a horizon of {steps} steps is within reach" if steps else "")


def _check_spectrum(report: TrustReport) -> Iterator[tuple[str, str]]:
    pairs = report.residuals
    bad = pairs.spurious
    if report.band.relift:  # a forecast that is lifted at each step never reads what the model forgets at once
        bad = bad & (np.abs(pairs.eigenvalues) > _LIMITS.forgotten)
    if not bad.any():
        return
    with np.errstate(over="ignore"):
        growth = np.abs(pairs.eigenvalues) ** report.score.horizon
    growing = bad & (growth > _LIMITS.notable_growth)
    worst = int(np.argmax(np.where(growing, growth, 0.0) if growing.any() else pairs.residuals))
    value = _format_complex(complex(pairs.eigenvalues[worst]))
    pair = f"λ = {value} (residual {to_percent(float(pairs.residuals[worst]))})"
    says = (
        f"{int(bad.sum())} of {len(bad)} eigenpairs are spurious (residual above {to_percent(pairs.tolerance)} a step)"
    )
    if growing.any():
        n = int(growing.sum())
        says += f", and {n} of them grow{'s' * (n == 1)}: {pair} grows {growth[worst]:.2g}-fold over the horizon"
        yield says, "drop observables, raise the ridge, or truncate the rank"
    else:
        yield f"{says}; the worst is {pair}", "read no modes or frequencies from these; predictions may still be good"


def _check_dictionary(report: TrustReport) -> Iterator[tuple[str, str]]:
    names, errors = report.invariance.names, report.invariance.errors
    bad = np.flatnonzero(errors > _LIMITS.invariant)
    if bad.size:
        worst: list[int] = bad[np.argsort(-errors[bad], kind="stable")].tolist()
        named = ", ".join(
            f"{shorten_observable(names[i])} {to_percent(float(errors[i]))}" for i in worst[: _LIMITS.most_names]
        )
        more = ", …" if bad.size > _LIMITS.most_names else ""
        yield (
            f"the dictionary is not invariant: the next value of {bad.size} of {len(errors)} observables is off by "
            f"more than {to_percent(_LIMITS.invariant)} of its size ({named}{more})",
            "for a longer horizon add observables that their next values depend on; compare scores before dropping one",
        )


def _check_fit(report: TrustReport) -> Iterator[tuple[str, str]]:
    if report.train_score is not None and _is_overfitted(report):
        ratio = report.score.total / max(report.train_score.total, np.finfo(float).tiny)
        says = f"errors on held-out episodes are {ratio:.3g} times those on the training episodes"
        yield says, "collect more data, take fewer observables or a larger ridge"
    if report.unseen is not None and report.unseen > _LIMITS.unseen:
        regions = "; ".join(region.where for region in report.coverage.empty[: _LIMITS.most_names])
        says = f"{to_percent(report.unseen)} of the held-out samples lie where there are no training data"
        yield (
            says + (f", such as {regions}" if regions else ""),
            "collect data there, or keep the controller away from there",
        )


def _check_inputs(report: TrustReport) -> Iterator[tuple[str, str]]:
    if report.persistency is not None and report.persistency.order < min(2, report.persistency.asked):
        says = f"the inputs are exciting to order {report.persistency.order} only, so B cannot be identified"
        yield says, "excite every input, with noise or PRBS"
    if report.feedback is not None:
        bad = np.flatnonzero(report.feedback > _LIMITS.feedback).tolist()
        names = ", ".join(
            f"{to_percent(report.feedback[i])} of {strip_unit(report.inputs[i])}" for i in bad[: _LIMITS.most_names]
        )
        if bad:
            yield (
                f"feedback: the observables explain most of the inputs ({names}), so A and B are hard to separate",
                "add noise to the inputs",
            )


def _check_memory(report: TrustReport) -> Iterator[tuple[str, str]]:
    if report.memory is not None and report.memory.shows_hidden_state:
        yield str(report.memory), "fit with delays (embedding=km.Delay(2)), with a hidden state, or measure that state"


def _check_band(report: TrustReport) -> Iterator[tuple[str, str]]:
    band = report.band
    if np.isfinite(band.quantile):
        return
    if band.episodes >= band.needed:
        yield "forecasts overflow", "look at the spectrum of A"
    else:
        reason = f"there are {band.episodes} calibration episodes, at least {band.needed} are needed"
        more = (
            f"record more episodes, or cut long files into several: `koopmpc fit` holds out enough of "
            f"{_LIMITS.episodes} in all for a level of 90 %"
            if report.divisible
            else f"record more rows, or judge fewer than {report.score.horizon} steps ahead"
        )
        yield (
            f"there is no band at {to_percent(band.level)}: {reason}",
            f"{more}; in Python hold out more by hand, or pass a lower level=",
        )


def _check_closed_loop(report: TrustReport) -> Iterator[tuple[str, str]]:
    loop, band = report.closed_loop, report.band
    if loop is None:
        return
    chance = 2 * np.sqrt(band.level * (1 - band.level) * (1 / band.episodes + 1 / loop.episodes))
    if loop.share < band.level - chance:
        yield (
            f"in closed loop {to_percent(loop.share)} of the forecasts stay in the {to_percent(band.level)} band",
            "use the band that is recalibrated on closed-loop episodes, or fit with closed-loop data",
        )


def _is_overfitted(report: TrustReport) -> bool:
    train = report.train_score
    return train is not None and report.score.total > max(_LIMITS.overfit * train.total, 1e-6)


def _format_complex(value: complex) -> str:
    return f"{value.real:.3g}" if abs(value.imag) < 1e-12 else f"{value.real:.3g} ± {abs(value.imag):.3g}i"


def _format_verdict(report: TrustReport) -> str:
    horizon, steps, dt = report.score.horizon, report.steps, report.dt
    if steps == 0:
        return f"DO NOT TRUST, not even for one step ({dt:g} s)"
    if steps < horizon:
        return f"DO NOT TRUST beyond {steps} of {horizon} steps ({steps * dt:.3g} s)"
    care = " WITH CARE" if report.findings else ""
    return f"TRUST{care} over {horizon} steps ({horizon * dt:.3g} s)"


def _build_error_table(report: TrustReport) -> Table:
    """Return a table of the errors of each state at a few horizons."""
    errors = report.score
    ahead = sorted({1, max(errors.horizon // 4, 1), max(errors.horizon // 2, 1), errors.horizon})
    rows: list[list[str]] = []
    for i, name in enumerate(errors.states):
        for h in ahead:
            constant = report.holding.rmse[h - 1, i]
            numbers = (errors.rmse[h - 1, i], errors.low[h - 1, i], errors.high[h - 1, i])
            ratio = f"{numbers[0] / constant:.2g}" if constant > 0 else "–"
            share = to_percent(report.error[h - 1, i])
            rows.append([name if h == ahead[0] else "", str(h), *(f"{v:.3g}" for v in numbers), share, ratio])
    return build_table(
        ("state", "steps\nahead", "RMSE", "5 %\nquantile", "95 %\nquantile", "share of\nrange", "RMSE over\nno change"),
        rows,
    )


def _list_evidence(report: TrustReport) -> Iterator[tuple[str, str]]:
    """Yield label and text of each line below the table."""
    pairs, dictionary, covered = report.residuals, report.invariance, report.coverage
    yield (
        "spectrum",
        f"{int(pairs.spurious.sum())} of {len(pairs.residuals)} eigenpairs are spurious (residual above "
        f"{to_percent(pairs.tolerance)} a step), the median residual is {to_percent(float(np.median(pairs.residuals)))}"
        f"; the spectral radius is {report.radius:.4g}",
    )
    worst = int(np.argmax(dictionary.errors))
    yield (
        "dictionary",
        f"the observable with the largest error after one step is {shorten_observable(dictionary.names[worst])}, with "
        f"{to_percent(dictionary.errors[worst])} of its size; the combination of observables with the largest has "
        f"{to_percent(dictionary.proximity)}",
    )
    fill = covered.occupied
    split = "held-out" if report.train_score is None else "training"
    least = strip_unit(covered.names[int(fill.argmin())])
    filled = f"{to_percent(fill.min())} of the {covered.bins} bins of {least}, the fewest"
    if fill.min() == 1:
        filled = f"all {covered.bins} bins of each coordinate"
    text = f"{covered.samples} {split} samples fill {filled}"
    if report.unseen is not None:
        text += f"; {to_percent(report.unseen)} of the held-out samples lie where there are no training samples"
    yield "coverage", text
    for region in covered.empty[: _LIMITS.most_regions]:
        yield "", f"{region} ({to_percent(region.share)} of the area)"
    if report.persistency is not None and report.feedback is not None:
        order, asked = report.persistency.order, report.persistency.asked
        shares = ", ".join(
            f"{to_percent(share)} of {strip_unit(name)}"
            for name, share in zip(report.inputs, report.feedback, strict=True)
        )
        yield (
            "inputs",
            f"persistently exciting of order {order}{' or more' if order == asked else ''}; the observables explain "
            f"{shares}",
        )
    band = report.band
    if np.isfinite(band.width[-1]).all():
        widths = ", ".join(with_unit(name, f"± {w:.3g}") for name, w in zip(band.states, band.width[-1], strict=True))
        yield (
            "band",
            f"{to_percent(band.level)} of forecasts stay within a band at all of their steps, at the last one {widths}"
            f"; calibrated on {band.episodes} episodes, and valid for inputs of the same distribution only",
        )
    else:
        yield (
            "band",
            f"no finite band holds {to_percent(band.level)} of forecasts ({band.episodes} calibration episodes)",
        )
    loop, recalibrated = report.closed_loop, report.recalibrated
    if loop is not None and recalibrated is not None:
        text = (
            f"{to_percent(loop.share)} of {loop.episodes} forecasts stay in that band "
            f"(95 % interval {to_percent(loop.low)} to {to_percent(loop.high)})"
        )
        if np.isfinite(band.quantile):
            text += f"; calibrated on them it is {recalibrated.quantile / band.quantile:.3g} times as wide"
        yield "closed loop", text
