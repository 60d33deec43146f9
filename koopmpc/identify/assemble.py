"""A LinearPredictor and its report from coefficients that were found under priors, limits or penalties."""

import warnings
from collections.abc import Sequence
from typing import Unpack

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.fit import Regression
from koopmpc.identify.moments import How, Moments, moments
from koopmpc.identify.solve import Rows, scaled_rank
from koopmpc.lifting.base import Lifting
from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.report import FitReport


def read(
    episodes: Episodes | Source, lifting: Lifting, embedding: Delay | None, **how: Unpack[How]
) -> tuple[Moments, tuple[str, ...]]:
    """Return the moments of the rows [ψ(x) u w ψ(x⁺)], and the names of w."""
    source = source_of(episodes)
    sized = None if embedding is None else embedding.fitted(source.states, source.inputs)
    return moments(source.driven(), lifting, embedding=sized, **how), source.disturbances


def tikhonov(ridge: float) -> float:
    """Return the ridge, or raise where it is negative."""
    value = float(checks.array(ridge, "ridge", ()))
    if value < 0:
        raise DataError(f"ridge is {value:g}; it must be 0 or above")
    return value


def growth(rows: Rows, K: Float[np.ndarray, "n nz"], plain: Float[np.ndarray, "n nz"]) -> str:
    """Return in words how much of the observables, each relative to its size, K and the plain fit miss."""
    before, after = relative_misfit(rows, plain), relative_misfit(rows, K)
    return f"relative one-step misfit of the observables {after:.3g}, of the plain fit {before:.3g}"


def relative_misfit(rows: Rows, K: Float[np.ndarray, "n nz"]) -> float:
    """Return the root-mean-square over observables i of ‖tᵢ − P kᵢ‖ / ‖tᵢ‖."""
    which = np.arange(len(K.T))
    energy = (np.sum(rows.T[:, which] ** 2, axis=0) + rows.rest[which]) / rows.samples
    error = rows.residual(which, K) ** 2
    return float(np.sqrt(np.mean(error / np.where(energy > 0, energy, 1.0))))


def assembled(
    task: Regression,
    K: Float[np.ndarray, "n nz"],
    disturbances: Sequence[str],
    *,
    rule: str,
    ridge: float = 0.0,
    sentences: Sequence[str] = (),
    changes: Sequence[str] = (),
    warn: bool = True,
) -> LinearPredictor:
    """Return z⁺ = A z + B u + E w with [A B E] = Kᵀ; each sentence of doubt warns once.

    Parameters
    ----------
    task
        The regression that K solves.
    K
        Coefficients of ψ(x⁺) on [ψ(x) u w].
    disturbances
        Names of w, the last of the task's inputs.
    rule
        What solved it, in words.
    ridge, sentences, changes
        For the report.
    warn
        Warn; online fits only report.
    """
    rows, nz = task.rows, task.lifting.nz
    C = np.eye(nz) if task.C is None else task.C
    rank, condition = scaled_rank(rows, rows.P)
    report = FitReport(
        method=task.method,
        route=f"{task.route}, {rule}",
        samples=rows.samples,
        condition=condition,
        rank=rank,
        columns=rows.P.shape[1],
        ridge=ridge,
        residual=rows.residual(task.x_next, K @ C.T),
        state_residual=task.state_residual,
        warnings=tuple(sentences),
        changes=tuple(changes),
    )
    for sentence in sentences if warn else ():
        warnings.warn(sentence, FitWarning, stacklevel=3)
    nu = len(task.inputs) - len(disturbances)
    return LinearPredictor(
        K[:nz].T,
        K[nz : nz + nu].T,
        C,
        task.lifting,
        task.dt,
        task.states,
        task.inputs[:nu],
        report,
        E=K[nz + nu :].T,
        disturbances=disturbances,
        embedding=task.embedding,
    )
