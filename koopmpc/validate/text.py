"""A trust report as an engineer reads it in a terminal."""

import textwrap
from collections.abc import Sequence

import numpy as np

from koopmpc.validate.regions import Region
from koopmpc.validate.verdict import Evidence, Finding, percent, shown

_WIDTH = 100
_LABEL = 13  # columns of the labels
_REGIONS = 3  # empty regions that are named


def written(evidence: Evidence, found: Sequence[Finding]) -> str:
    """Return the verdict, the findings each with what to do, and the evidence."""
    lines = [_verdict(evidence, found)]
    for finding in found:
        lines += _wrapped(finding.says, "  ✗ " if finding.grave else "  ! ")
        lines += _wrapped(finding.do, "    → ")
    lines += ["", *_errors(evidence), ""]
    for label, text in _checks(evidence):
        lines += _wrapped(text, f"{label:<{_LABEL}}")
    return "\n".join(lines)


def _verdict(evidence: Evidence, found: Sequence[Finding]) -> str:
    horizon, steps, dt = evidence.score.horizon, evidence.steps, evidence.dt
    if steps == 0:
        return f"DO NOT TRUST, not even for one step ({dt:g} s)"
    if steps < horizon:
        return f"DO NOT TRUST beyond {steps} of {horizon} steps ({steps * dt:.3g} s)"
    care = " WITH CARE" if found else ""
    return f"TRUST{care} over {horizon} steps ({horizon * dt:.3g} s)"


def _errors(evidence: Evidence) -> list[str]:
    """Return a table of the errors at a few horizons."""
    of = evidence.score
    shown = sorted({1, max(of.horizon // 4, 1), max(of.horizon // 2, 1), of.horizon})
    name_width = max(5, *map(len, of.states)) + 1
    lines = [
        f"errors x − x̂ of {of.starts} held-out forecasts, with their 5 and 95 % quantiles; the larger as a share",
        "of the state's range; RMSE over that of x̂ = x_k, which needs no model",
        f"{'state':<{name_width}}{'step':>5}{'RMSE':>10}{'5 %':>11}{'95 %':>11}{'of range':>10}{'/ hold':>9}",
    ]
    for i, name in enumerate(of.states):
        for h in shown:
            hold = evidence.holding.rmse[h - 1, i]
            ratio = f"{of.rmse[h - 1, i] / hold:.2g}" if hold > 0 else "-"
            lines.append(
                f"{name if h == shown[0] else '':<{name_width}}{h:>5}{of.rmse[h - 1, i]:>10.3g}"
                f"{of.low[h - 1, i]:>11.3g}{of.high[h - 1, i]:>11.3g}{percent(evidence.error[h - 1, i]):>10}{ratio:>9}"
            )
    return lines


def _checks(evidence: Evidence) -> list[tuple[str, str]]:
    """Return label and text of each line below the table."""
    pairs = [_spectrum(evidence), _dictionary(evidence), _coverage(evidence)]
    pairs += [("", f"{region} ({percent(region.share)} of their box)") for region in _regions(evidence)]
    if evidence.persistency is not None and evidence.feedback is not None:
        order, asked = evidence.persistency.order, evidence.persistency.asked
        told = ", ".join(
            f"{percent(share)} of {name}" for name, share in zip(evidence.inputs, evidence.feedback, strict=True)
        )
        more = " or more" if order == asked else ""
        pairs.append(("inputs", f"exciting to order {order}{more}; ψ(x) explains {told}"))
    return [*pairs, _band(evidence), *_closed_loop(evidence)]


def _spectrum(evidence: Evidence) -> tuple[str, str]:
    of = evidence.residuals
    return "spectrum", (
        f"{int(of.spurious.sum())} of {len(of.residuals)} eigenpairs spurious, median residual "
        f"{percent(float(np.median(of.residuals)))} a step; spectral radius {evidence.radius:.4g}"
    )


def _dictionary(evidence: Evidence) -> tuple[str, str]:
    of = evidence.invariance
    worst = int(np.argmax(of.errors))
    return "dictionary", (
        f"worst observable {shown(of.names[worst])}, off by {percent(of.errors[worst])} in a step; "
        f"worst function in its span {percent(of.proximity)}"
    )


def _coverage(evidence: Evidence) -> tuple[str, str]:
    of = evidence.coverage
    whose = "held-out" if evidence.train_score is None else "training"
    least = int(np.argmin(of.occupied))
    text = f"{of.samples} {whose} samples in {of.bins} bins each; fewest held: {percent(of.occupied[least])} of "
    text += of.names[least]
    if evidence.unseen is not None:
        text += f"; {percent(evidence.unseen)} of the held-out samples lie where these never were"
    return "coverage", text


def _regions(evidence: Evidence) -> tuple[Region, ...]:
    return evidence.coverage.empty[:_REGIONS]


def _band(evidence: Evidence) -> tuple[str, str]:
    band = evidence.band
    widths = ", ".join(f"{name} ± {w:.3g}" for name, w in zip(band.states, band.width[-1], strict=True))
    return "band", (
        f"{percent(band.level)} of whole forecasts stay within a band, at its last step {widths} "
        f"({band.episodes} episodes); promised for inputs of the same law alone"
    )


def _closed_loop(evidence: Evidence) -> list[tuple[str, str]]:
    loop, again = evidence.closed_loop, evidence.recalibrated
    if loop is None or again is None:
        return []
    text = (
        f"{percent(loop.share)} of {loop.episodes} forecasts stay in that band "
        f"(95 % interval {percent(loop.low)} to {percent(loop.high)})"
    )
    if np.isfinite(evidence.band.quantile):
        text += f"; calibrated on them it is {again.quantile / evidence.band.quantile:.3g} times as wide"
    return [("closed loop", text)]


def _wrapped(text: str, label: str) -> list[str]:
    """Return `label` and beside it the text, broken at spaces to a terminal's width."""
    return textwrap.wrap(text, _WIDTH, initial_indent=label, subsequent_indent=" " * len(label))
