"""The regression of ψ(x⁺) on [ψ(x) u]: its rows, its result, and the predictor and the report made of them."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import currentframe
from typing import Required, TypedDict, Unpack

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.linalg import qr

from koopmpc.base import checks
from koopmpc.base.errors import DataError, FitWarning
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import CONSTANT, Lifting
from koopmpc.models.base import FitReport
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import ReadOptions, second_moments
from koopmpc.models.moments.solve import BilinearParts, RegressionRows, column_norms, scaled_rank
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

_HALF = float(
    np.sqrt(np.finfo(float).eps)
)  # added to unit-norm columns: a scale then keeps at least half of the digits


@dataclass(frozen=True, eq=False)
class Regression:
    """The regression of ψ(x⁺) on [ψ(x) u], before it is solved."""

    # name of the fit, and how the data were read, as in the report
    method: str
    route: str
    rows: RegressionRows  # P = [ψ(x) u]; T begins with ψ(x⁺)
    x_next: Int[np.ndarray, " nx"]  # the columns of T that hold x⁺
    # as in the predictor
    lifting: Lifting
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float
    # (nx, nz), or None if ψ(x) is x; and the root-mean-square of x − C ψ(x)
    C: Float[np.ndarray, "nx nz"] | None
    state_residual: Float[np.ndarray, " nx"]
    B: Float[np.ndarray, "nz nu"] | None = None  # (nz, nu) if it is known; None if it is fitted
    scaled: bool = True  # true if the regression is solved on columns of unit norm
    embedding: Delay | None = None  # as in the predictor
    disturbances: tuple[str, ...] = ()  # names of the measured disturbances w, the last of the inputs

    @property
    def columns(self) -> int:
        """Number of regressors."""
        return self.rows.P.shape[1] - (0 if self.B is None else self.B.shape[1])

    @property
    def affine_columns(self) -> list[int]:
        """The columns of P that hold states, the Constant and inputs: those of x⁺ = A x + B u + c."""
        names = self.lifting.names
        affine = [i for i, name in enumerate(names) if name == CONSTANT or name in self.states]
        return [*affine, *range(len(names), self.rows.P.shape[1])]

    def decode(self, K: Float[np.ndarray, "n nz"]) -> Float[np.ndarray, "n nx"]:
        """Return K Cᵀ, the coefficients of C ψ(x⁺)."""
        return K if self.C is None else K @ self.C.T


def read_regression(
    episodes: Episodes | Source,
    lifting: Lifting,
    embedding: Delay | None,
    method: str,
    *,
    noisy: bool = False,
    **options: Unpack[ReadOptions],
) -> Regression:
    """Return the regression on [ψ(x) u w] of these episodes; `second_moments` explains the options."""
    if "bilinear" in options:  # which second_moments takes, and no fit on [ψ(x) u w]
        raise DataError(f"{method} fits a linear model; km.bilinear_edmd fits a bilinear one")
    source = source_of(episodes)
    if embedding is not None:
        checks.kind(embedding, "embedding", Delay, "pass km.Delay(2), or leave it out")
    bound_embedding = None if embedding is None else embedding.match(source.states, source.inputs)
    total = second_moments(source.driven(), lifting, embedding=bound_embedding, **options)
    return build_regression(total, method, noisy=noisy, disturbances=source.disturbances)


def build_regression(
    total: Moments, method: str, *, noisy: bool = False, disturbances: tuple[str, ...] = ()
) -> Regression:
    """Return the regression of ψ(x⁺) on [ψ(x) u] with these moments, and its C.

    With `noisy`, for methods that treat noise in x and x⁺ alike, the rows hold all of ψ(x⁺), not only its projection
    on ψ(x) and u.
    """
    columns, states = total.columns, total.states
    place = {name: i for i, name in enumerate(columns.full.names)}
    where = np.array([place[name] for name in states])
    C, residual = total.decoder(where)
    return Regression(
        method=method,
        route=total.route,
        rows=(total.complete_rows if noisy else total.rows)(columns.regressors, columns.targets),
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


class FitNotes(TypedDict, total=False):
    """What a fit tells its report."""

    rule: Required[str]  # how the regression was solved, in words
    # those of the regressors; computed if they are left out
    rank: int
    condition: float
    columns: int  # number of regressors, if it is not that of the rows
    ridge: float  # the Tikhonov weight
    # sentences of the report: its warnings, and the changes by a prior, a limit or a penalty
    doubts: Sequence[str]
    changes: Sequence[str]
    silent: bool  # raise no warning


def build_report(regression: Regression, K: Float[np.ndarray, "n nz"], notes: FitNotes) -> FitReport:
    """Return the report of the fit K. Each doubt also becomes a FitWarning at the user's line that called the fit."""
    rows, doubts = regression.rows, tuple(notes.get("doubts", ()))
    for sentence in () if notes.get("silent") else doubts:
        warnings.warn(sentence, FitWarning, stacklevel=_level_outside())
    rank, condition = notes.get("rank"), notes.get("condition", np.inf)
    if rank is None:
        rank, condition = scaled_rank(rows, rows.P)
    return FitReport(
        method=regression.method,
        route=f"{regression.route}, {notes['rule']}",
        samples=rows.samples,
        condition=condition,
        rank=rank,
        columns=notes.get("columns", regression.columns),
        ridge=notes.get("ridge", 0.0),
        residual=rows.residual(regression.x_next, regression.decode(K)),
        state_residual=regression.state_residual,
        warnings=doubts,
        changes=tuple(notes.get("changes", ())),
    )


def _level_outside() -> int:
    """Return the stacklevel by which a warning of the caller points at the first line outside of koopmpc."""
    frame, level = currentframe(), 0
    while frame is not None and frame.f_globals.get("__name__", "").startswith("koopmpc."):
        frame, level = frame.f_back, level + 1
    return level


def build_predictor(
    regression: Regression,
    K: Float[np.ndarray, "n nz"],
    *,
    modes: Complex[np.ndarray, "nl nz"] | None = None,
    **notes: Unpack[FitNotes],
) -> LinearPredictor:
    """Return z⁺ = A z + B u + E w with [A B E]ᵀ = K, and its report."""
    nz, nu = regression.lifting.nz, len(regression.inputs) - len(regression.disturbances)
    scale = compute_scale_factor(regression.rows.P[:, :nz], regression.rows.samples)
    return LinearPredictor(
        K[:nz].T,
        K[nz : nz + nu].T,
        np.eye(nz) if regression.C is None else regression.C,
        regression.lifting,
        regression.dt,
        regression.states,
        regression.inputs[:nu],
        build_report(regression, K, notes),
        exact_modes=modes,
        E=K[nz + nu :].T,
        disturbances=regression.disturbances,
        embedding=regression.embedding,
        scale=scale,
    )


def build_bilinear(
    regression: Regression, K: Float[np.ndarray, "n nz"], parts: BilinearParts, **notes: Unpack[FitNotes]
) -> BilinearPredictor:
    """Return the bilinear model with the matrices `parts` of K, and its report."""
    nz, nu = regression.lifting.nz, len(regression.inputs) - len(regression.disturbances)
    scale = compute_scale_factor(regression.rows.P[:, :nz], regression.rows.samples)
    assert regression.C is not None, "an extended regression has its C"
    return BilinearPredictor(
        parts.A,
        parts.B,
        parts.N,
        regression.C,
        regression.lifting,
        regression.dt,
        regression.states,
        regression.inputs[:nu],
        build_report(regression, K, notes),
        E=parts.E,
        S=parts.S,
        M=parts.M,
        disturbances=regression.disturbances,
        embedding=regression.embedding,
        scale=scale,
    )


def compute_scale_factor(P: Float[np.ndarray, "m n"], samples: int) -> Float[np.ndarray, "n n"]:
    """Return the upper triangular R with RᵀR = PᵀP / M and a positive diagonal, so that P R⁻¹ has orthogonal columns.

    R is invertible even if columns are dependent: on columns of unit norm eps is added to PᵀP, so that R and R⁻¹
    together lose at most half of the digits. A column of zeros counts as one of size 1.
    """
    size = column_norms(P)
    live = size > 0
    size = np.where(live, size, np.sqrt(samples))
    R = np.asarray(qr(np.vstack([P / size, np.diag(np.where(live, _HALF, 1.0))]), mode="r")[0])[: len(size)]
    return np.ascontiguousarray(np.where(R.diagonal() < 0, -1.0, 1.0)[:, None] * R * (size / np.sqrt(samples)))


def describe_misfit(rows: RegressionRows, K: Float[np.ndarray, "n nz"], plain: Float[np.ndarray, "n nz"]) -> str:
    """Return a sentence with the one-step errors of K and of the plain fit, relative to each observable's size."""
    before, after = relative_misfit(rows, plain), relative_misfit(rows, K)
    return f"relative one-step misfit of the observables {after:.3g}, of the plain fit {before:.3g}"


def relative_misfit(rows: RegressionRows, K: Float[np.ndarray, "n nz"]) -> float:
    """Return the root-mean-square over observables i of ‖tᵢ − P kᵢ‖ / ‖tᵢ‖."""
    which = np.arange(len(K.T))
    energy = (np.sum(rows.T[:, which] ** 2, axis=0) + rows.rest[which]) / rows.samples
    error = rows.residual(which, K) ** 2
    return float(np.sqrt(np.mean(error / np.where(energy > 0, energy, 1.0))))
