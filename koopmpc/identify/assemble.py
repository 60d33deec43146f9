"""From the coefficients of a regression to a predictor and its report, whatever found them."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Complex, Float

from koopmpc.errors import FitWarning
from koopmpc.identify.regression import Regression
from koopmpc.identify.solve import Rows, scaled_rank
from koopmpc.lifting.base import Lifting
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.report import FitReport

Model = TypeVar("Model", LinearPredictor, BilinearPredictor)


class Found(NamedTuple):
    """What a method found: z⁺ = A z + B u, B with the columns of w, and what it says of it.

    Attributes
    ----------
    rule
        What solved it, in words.
    doubts, changes
        Sentences of the report: its warnings, and what a prior or a limit changed.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    C: Float[np.ndarray, "nx nz"]
    lifting: Lifting
    residual: Float[np.ndarray, " nx"]
    state_residual: Float[np.ndarray, " nx"]
    rank: int
    condition: float
    rule: str
    ridge: float = 0.0
    doubts: Sequence[str] = ()
    changes: Sequence[str] = ()
    modes: Complex[np.ndarray, "nl nz"] | None = None


def whole(
    task: Regression,
    K: Float[np.ndarray, "n nz"],
    *,
    rank: int,
    condition: float,
    rule: str,
    ridge: float = 0.0,
    doubts: Sequence[str] = (),
    changes: Sequence[str] = (),
) -> Found:
    """Return what K = [A B]ᵀ is, in the lifting of the task."""
    nz = task.lifting.nz
    return Found(
        A=K[:nz].T,
        B=K[nz:].T,
        C=np.eye(nz) if task.C is None else task.C,
        lifting=task.lifting,
        residual=task.rows.residual(task.x_next, task.decoded(K)),
        state_residual=task.state_residual,
        rank=rank,
        condition=condition,
        rule=rule,
        ridge=ridge,
        doubts=doubts,
        changes=changes,
    )


def report(task: Regression, found: Found) -> FitReport:
    """Return the report of what was found."""
    return FitReport(
        method=task.method,
        route=f"{task.route}, {found.rule}",
        samples=task.rows.samples,
        condition=found.condition,
        rank=found.rank,
        columns=task.columns,
        ridge=found.ridge,
        residual=found.residual,
        state_residual=found.state_residual,
        warnings=tuple(found.doubts),
        changes=tuple(found.changes),
    )


def linear_predictor(task: Regression, found: Found) -> LinearPredictor:
    """Return z⁺ = A z + B u + E w with its report."""
    nu = len(task.inputs) - len(task.disturbances)
    return LinearPredictor(
        found.A,
        found.B[:, :nu],
        found.C,
        found.lifting,
        task.dt,
        task.states,
        task.inputs[:nu],
        report(task, found),
        found.modes,
        E=found.B[:, nu:],
        disturbances=task.disturbances,
        embedding=task.embedding,
    )


def assembled(
    task: Regression,
    K: Float[np.ndarray, "n nz"],
    *,
    rule: str,
    ridge: float = 0.0,
    doubts: Sequence[str] = (),
    changes: Sequence[str] = (),
) -> LinearPredictor:
    """Return z⁺ = A z + B u + E w with [A B E] = Kᵀ, found under priors, limits or penalties."""
    rank, condition = scaled_rank(task.rows, task.rows.P)
    found = whole(
        task, K, rank=rank, condition=condition, rule=rule, ridge=ridge, doubts=doubts, changes=changes
    )
    return linear_predictor(task, found)


def warned(model: Model) -> Model:
    """Return the model; each doubt of its report is a FitWarning at the line that called the caller."""
    for sentence in model.report.warnings if model.report else ():
        warnings.warn(sentence, FitWarning, stacklevel=3)
    return model


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
