"""Findings against a predictor, each with its remedy, and the evidence in words."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from koopmpc.base.terminal import build_table
from koopmpc.base.text import shorten_observable, to_percent, with_unit
from koopmpc.base.values import Value
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.evidence import LIMITS, TrustEvidence


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


# Each _check function yields pairs (finding, remedy) about one kind of evidence.


def _check_errors(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    horizon, steps = report.score.horizon, report.steps
    if steps == horizon:
        return
    state = int(np.argmin(report.usable))
    name, error = report.score.states[state], report.error[:, state]
    reached = (
        f"{to_percent(error[steps])} of its range at step {steps + 1} and {to_percent(error[-1])} at step {horizon}"
    )
    says = f"the errors of {strip_unit(name)} reach {reached} (5 % and 95 % quantiles)"
    if error[steps] <= LIMITS.usable:
        says += ", and the guess that nothing changes is at least as accurate"
    if report.unseen is not None and report.unseen > LIMITS.unseen:
        do = "collect data where the model will be used"
    elif _is_overfitted(report):
        do = "collect more data, take fewer observables or a larger ridge"
    else:
        do = "take richer observables or bilinear_edmd, and compare their scores over this horizon"
    yield says, do + (f"; a horizon of {steps} steps is within reach" if steps else "")


def _check_spectrum(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    pairs = report.residuals
    bad = pairs.spurious
    if report.band.relift:  # a forecast that is lifted at each step never reads what the model forgets at once
        bad = bad & (np.abs(pairs.eigenvalues) > LIMITS.forgotten)
    if not bad.any():
        return
    with np.errstate(over="ignore"):
        growth = np.abs(pairs.eigenvalues) ** report.score.horizon
    growing = bad & (growth > LIMITS.notable_growth)
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


def _check_dictionary(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    names, errors = report.invariance.names, report.invariance.errors
    bad = np.flatnonzero(errors > LIMITS.invariant)
    if bad.size:
        worst: list[int] = bad[np.argsort(-errors[bad], kind="stable")].tolist()
        named = ", ".join(
            f"{shorten_observable(names[i])} {to_percent(float(errors[i]))}" for i in worst[: LIMITS.most_names]
        )
        more = ", …" if bad.size > LIMITS.most_names else ""
        yield (
            f"the dictionary is not invariant: the next value of {bad.size} of {len(errors)} observables is off by "
            f"more than {to_percent(LIMITS.invariant)} of its size ({named}{more})",
            "for a longer horizon add observables that their next values depend on; compare scores before dropping one",
        )


def _check_fit(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    if report.train_score is not None and _is_overfitted(report):
        ratio = report.score.total / max(report.train_score.total, np.finfo(float).tiny)
        says = f"errors on held-out episodes are {ratio:.3g} times those on the training episodes"
        yield says, "collect more data, take fewer observables or a larger ridge"
    if report.unseen is not None and report.unseen > LIMITS.unseen:
        regions = "; ".join(region.where for region in report.coverage.empty[: LIMITS.most_names])
        says = f"{to_percent(report.unseen)} of the held-out samples lie where there are no training data"
        yield (
            says + (f", such as {regions}" if regions else ""),
            "collect data there, or keep the controller away from there",
        )


def _check_inputs(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    if report.persistency is not None and report.persistency.order < min(2, report.persistency.asked):
        says = f"the inputs are exciting to order {report.persistency.order} only, so B cannot be identified"
        yield says, "excite every input, with noise or PRBS"
    if report.feedback is not None:
        bad = np.flatnonzero(report.feedback > LIMITS.feedback).tolist()
        names = ", ".join(
            f"{to_percent(report.feedback[i])} of {strip_unit(report.inputs[i])}" for i in bad[: LIMITS.most_names]
        )
        if bad:
            yield (
                f"feedback: the observables explain most of the inputs ({names}), so A and B are hard to separate",
                "add noise to the inputs",
            )


def _check_memory(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    if report.memory is not None and report.memory.shows_hidden_state:
        yield str(report.memory), "fit with delays (embedding=km.Delay(2)), with a hidden state, or measure that state"


def _check_band(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    band = report.band
    if np.isfinite(band.quantile):
        return
    if band.episodes >= band.needed:
        yield "forecasts overflow", "look at the spectrum of A"
    else:
        reason = f"there are {band.episodes} calibration episodes, at least {band.needed} are needed"
        more = (
            f"record more episodes, or cut long files into several: `koopmpc fit` holds out enough of "
            f"{LIMITS.episodes} in all for a level of 90 %"
            if report.divisible
            else f"record more rows, or judge fewer than {report.score.horizon} steps ahead"
        )
        yield (
            f"there is no band at {to_percent(band.level)}: {reason}",
            f"{more}; in Python hold out more by hand, or pass a lower level=",
        )


def _check_closed_loop(report: TrustEvidence) -> Iterator[tuple[str, str]]:
    loop, band = report.closed_loop, report.band
    if loop is None:
        return
    chance = 2 * np.sqrt(band.level * (1 - band.level) * (1 / band.episodes + 1 / loop.episodes))
    if loop.share < band.level - chance:
        yield (
            f"in closed loop {to_percent(loop.share)} of the forecasts stay in the {to_percent(band.level)} band",
            "use the band that is recalibrated on closed-loop episodes, or fit with closed-loop data",
        )


def _is_overfitted(report: TrustEvidence) -> bool:
    train = report.train_score
    return train is not None and report.score.total > max(LIMITS.overfit * train.total, 1e-6)


def _format_complex(value: complex) -> str:
    return f"{value.real:.3g}" if abs(value.imag) < 1e-12 else f"{value.real:.3g} ± {abs(value.imag):.3g}i"


def format_verdict(report: TrustEvidence) -> str:
    """Return the verdict: over how many steps the model can be trusted."""
    horizon, steps, dt = report.score.horizon, report.steps, report.dt
    if steps == 0:
        return f"DO NOT TRUST, not even for one step ({dt:g} s)"
    if steps < horizon:
        return f"DO NOT TRUST beyond {steps} of {horizon} steps ({steps * dt:.3g} s)"
    care = " WITH CARE" if list_findings(report) else ""
    return f"TRUST{care} over {horizon} steps ({horizon * dt:.3g} s)"


def build_error_table(report: TrustEvidence) -> Table:
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


def list_evidence(report: TrustEvidence) -> Iterator[tuple[str, str]]:
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
    for region in covered.empty[: LIMITS.most_regions]:
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


def list_findings(report: TrustEvidence) -> tuple[Finding, ...]:
    """Return the findings against the predictor, grave ones first."""
    checks_for_care = (
        _check_spectrum,
        _check_dictionary,
        _check_fit,
        _check_inputs,
        _check_memory,
        _check_band,
        _check_closed_loop,
    )
    grave = [Finding(True, says, do) for says, do in _check_errors(report)]
    return (*grave, *(Finding(False, says, do) for check in checks_for_care for says, do in check(report)))
