"""The regression of ψ(x⁺) on [ψ(x) u], as a few rows, with all that a predictor of it needs."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar, Unpack

import numpy as np
from jaxtyping import Complex, Float, Int

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import FitWarning
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.read import How, second_moments
from koopmpc.identify.solve import Rows, scaled_rank, solve
from koopmpc.lifting.base import Lifting
from koopmpc.predict.base import FitReport
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor


@dataclass(frozen=True, eq=False)
class Regression:
    """ψ(x⁺) on [ψ(x) u], ready to be solved.

    Attributes
    ----------
    method, route
        For the report.
    rows
        P = [ψ(x) u]; T begins with ψ(x⁺).
    x_next
        The columns of T that hold x⁺.
    lifting, states, inputs, dt
        As in the predictor.
    C, state_residual
        (nx, nz), None where ψ(x) is x; and the root-mean-square of x − C ψ(x).
    disturbances
        Names of w, the last of the inputs.
    B
        (nz, nu) where it is known.
    scaled
        Solve on columns of unit norm.
    embedding
        As in the predictor.
    """

    method: str
    route: str
    rows: Rows
    x_next: Int[np.ndarray, " nx"]
    lifting: Lifting
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float
    C: Float[np.ndarray, "nx nz"] | None
    state_residual: Float[np.ndarray, " nx"]
    B: Float[np.ndarray, "nz nu"] | None = None
    scaled: bool = True
    embedding: Delay | None = None
    disturbances: tuple[str, ...] = ()

    @property
    def columns(self) -> int:
        """Number of regressors."""
        return self.rows.P.shape[1] - (0 if self.B is None else self.B.shape[1])

    def decoded(self, K: Float[np.ndarray, "n nz"]) -> Float[np.ndarray, "n nx"]:
        """Return K Cᵀ, the coefficients of C ψ(x⁺)."""
        return K if self.C is None else K @ self.C.T


def read(
    episodes: Episodes | Source,
    lifting: Lifting,
    embedding: Delay | None,
    method: str,
    *,
    noisy: bool = False,
    **how: Unpack[How],
) -> Regression:
    """Return the regression on [ψ(x) u w] that these episodes hold, read as `moments` says."""
    source = source_of(episodes)
    sized = None if embedding is None else embedding.fitted(source.states, source.inputs)
    total = second_moments(source.driven(), lifting, embedding=sized, **how)
    return regression(total, method, noisy=noisy, disturbances=source.disturbances)


def regression(total: Moments, method: str, *, noisy: bool = False, disturbances: tuple[str, ...] = ()) -> Regression:
    """Return the regression of ψ(x⁺) on [ψ(x) u] that these moments hold, C included; `noisy` keeps all of T."""
    states = total.states
    place = {name: i for i, name in enumerate(total.full.names)}
    where = np.array([place[name] for name in states])
    C, residual = _decoder(total, where)
    regressors = total.regressors
    return Regression(
        method=method,
        route=total.route,
        rows=(total.complete if noisy else total.rows)(regressors, total.targets),
        x_next=where,
        lifting=total.lifting,
        states=states,
        inputs=total.inputs,
        dt=total.dt,
        C=C,
        state_residual=residual,
        embedding=total.embedding,
        disturbances=disturbances,
    )


def _decoder(total: Moments, where: np.ndarray) -> tuple[Float[np.ndarray, "nx nz"], Float[np.ndarray, " nx"]]:
    """Return C = argmin Σ ‖x − C ψ(x)‖² and its root-mean-square residual; a row that ψ holds is picked."""
    nz = total.nz
    C = np.zeros((len(where), nz))
    residual = np.zeros(len(where))
    held = where < nz
    C[held, where[held]] = 1.0
    if not held.all():
        rows = total.rows(np.arange(nz), where[~held])
        K = solve(rows).K
        C[~held] = K.T
        residual[~held] = rows.residual(np.arange(len(rows.rest)), K)
    return C, residual


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
    found = whole(task, K, rank=rank, condition=condition, rule=rule, ridge=ridge, doubts=doubts, changes=changes)
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
