"""Residuals of one step: of each eigenpair, and of the invariance of the dictionary.

Both are read from the second moments of the rows [ψ(x) u ψ(x⁺)], so that a pass over the data serves all of them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.moments.moments import Moments, both_sides
from koopmpc.identify.moments.read import second_moments
from koopmpc.identify.solve import norms, orthonormal
from koopmpc.lifting.base import Lifting
from koopmpc.predict.base import eigen
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.predict.spectrum import same_names
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.values import Value

TOLERANCE = 0.05  # residual of one step beyond which an eigenpair is spurious


def moments_of(
    episodes: Episodes | Source,
    model: Lifting | AnyPredictor,
    *,
    embedding: Delay | None = None,
    bilinear: bool = False,
) -> Moments:
    """Return the second moments of these episodes in a lifting, or in the lifting and the inputs of a predictor.

    They are triangular factors (``route="qr"``), which resolve residuals down to rounding. Measured disturbances
    count as inputs; for a predictor only where it knows them, and for a bilinear model not.

    Parameters
    ----------
    episodes
        Episodes, or a source of them.
    model
        A lifting ψ, or a predictor, which brings its own embedding and kind.
    embedding
        What ψ acts on where it is a lifting of the state and its past.
    bilinear
        The rows hold the products u⊗ψ(x) too.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.
    """
    if isinstance(model, Lifting):
        lifting, driven = model, not bilinear
    else:
        same_names(model, episodes)
        lifting, embedding, bilinear = model.lifting, model.embedding, isinstance(model, BilinearPredictor)
        driven = isinstance(model, LinearPredictor) and model.nw > 0
    rows = episodes.driven() if driven else episodes
    return second_moments(rows, lifting, embedding=embedding, route="qr", bilinear=bilinear)


@dataclass(frozen=True, eq=False)
class ResidualDMD(Value):
    """The distance of each eigenfunction of a predictor from one of the Koopman operator.

    Attributes
    ----------
    eigenvalues
        (nz,) λ of A, the largest magnitude first.
    residuals
        (nz,) ‖φ(x⁺) − λ φ(x) − (what the inputs do)‖ / ‖φ(x)‖ over the snapshots; infinite where φ was 0
        throughout.
    tolerance
        Beyond it an eigenpair is `spurious`.
    samples
        M.
    """

    eigenvalues: Complex[np.ndarray, " nz"]
    residuals: Float[np.ndarray, " nz"]
    tolerance: float
    samples: int

    @property
    def spurious(self) -> Bool[np.ndarray, " nz"]:
        """Eigenpairs whose residual is above the tolerance: in one step φ differs from λ φ by more than that share."""
        return self.residuals > self.tolerance


def residual_dmd(predictor: AnyPredictor, episodes: Episodes | Source, *, tolerance: float = TOLERANCE) -> ResidualDMD:
    """Return ‖Ψ(x⁺) v − λ Ψ(x) v − U Bᵀ v‖ / ‖Ψ(x) v‖ for each left eigenvector v of A, φ = ψ · v.

    The squared norm is v*(Ψy*Ψy − λ Ψy*Ψx − λ̄ Ψx*Ψy + |λ|² Ψx*Ψx)v, which the second moments of the data hold. It
    is taken as a norm, on a factor of the moments, since a difference of squares would lose half the digits. Without
    inputs it bounds the distance from λ to the (pseudo)spectrum of the Koopman operator. With inputs the operator is
    that of the drift ψ(x⁺) − B u: what the inputs do by the predictor's own B (E, Nᵢ) is subtracted, and the residual
    is the energy of what is left, whether λ, v or B is to blame.

    Parameters
    ----------
    predictor
        Linear or bilinear; its A gives λ and v.
    episodes
        Episodes, or a source of them: those of the fit, or better others.
    tolerance
        Residual above which `ResidualDMD.spurious` calls an eigenpair spurious.

    Raises
    ------
    ShapeError
        The episodes have other states, inputs or disturbances than the predictor.
    DataError
        They have another dt, or the tolerance is not above zero.

    References
    ----------
    Colbrook & Townsend, "Rigorous data-driven computation of spectral properties of Koopman operators for
    dynamical systems", Commun. Pure Appl. Math. 77, 2024.
    """
    tolerance = checks.positive(tolerance, "tolerance")
    return eigen_residuals(predictor, moments_of(episodes, predictor), tolerance)


def eigen_residuals(predictor: AnyPredictor, total: Moments, tolerance: float = TOLERANCE) -> ResidualDMD:
    """Return the result of `residual_dmd` from the moments in the predictor's own lifting."""
    values, V = eigen(np.ascontiguousarray(predictor.A.T))
    P, T, _ = both_sides(total)
    with np.errstate(over="ignore", invalid="ignore"):
        gap = _sizes((T - P @ _one_step(predictor, total)) @ V)
    gap[np.isnan(gap)] = np.inf  # A held entries so large that the product is no number
    size = _sizes(P[:, : total.nz] @ V)
    floor = np.finfo(float).eps * _sizes(np.abs(P[:, : total.nz]) @ np.abs(V))  # a φ below it is 0 but for rounding
    live = size > floor
    residuals = np.divide(gap, size, out=np.full(len(size), np.inf), where=live)
    return ResidualDMD(values, residuals, tolerance, total.samples)


def _one_step(predictor: AnyPredictor, total: Moments) -> Float[np.ndarray, "n nz"]:
    """Return K with z⁺ = [z u u⊗z] K as the predictor has it."""
    A = predictor.A.T
    if not isinstance(predictor, BilinearPredictor):
        return np.vstack([A, predictor.B.T, predictor.E.T])
    products = total.products
    constant = np.setdiff1d(np.arange(total.nz), products)  # u times the Constant is u, which stands among the inputs
    B = predictor.B.T + predictor.N[:, :, constant].sum(axis=2)
    N = predictor.N[:, :, products].transpose(0, 2, 1).reshape(-1, total.nz)
    return np.vstack([A, B, N])


def _sizes(columns: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the Euclidean norms of real or complex columns."""
    return np.asarray(np.linalg.norm(columns, axis=0), dtype=np.float64)


def eigenpairs(predictor: AnyPredictor, residuals: "ResidualDMD | ArrayLike") -> ResidualDMD:
    """Return the residuals as a ResidualDMD; an array is in the order of ``predictor.eigenvalues``.

    Raises
    ------
    ShapeError
        There is not one residual for each eigenvalue.
    DataError
        A residual is negative or NaN, or they are those of another predictor.
    """
    if isinstance(residuals, ResidualDMD):
        if len(residuals.residuals) != predictor.nz:
            raise ShapeError(
                f"there are {len(residuals.residuals)} residuals and {predictor.nz} eigenvalues; "
                "pass the residuals of this predictor"
            )
        mine, theirs = (np.sort_complex(v) for v in (predictor.eigenvalues, residuals.eigenvalues))
        if not np.allclose(np.abs(mine), np.abs(theirs), rtol=1e-3, atol=1e-6):
            raise DataError("the residuals are those of another predictor; pass residual_dmd(predictor, …)")
        return residuals
    known = checks.array(residuals, "residuals", (predictor.nz,), infinite=True, finite=False)
    if np.isnan(known).any() or (known < 0).any():
        raise DataError(f"residuals holds {known.min():g}; they are norms, from 0 on")
    return ResidualDMD(predictor.eigenvalues, known, TOLERANCE, 0)


@dataclass(frozen=True, eq=False)
class Invariance(Value):
    """The distance of span ψ from invariance, by the data.

    Attributes
    ----------
    proximity
        sup over f in span ψ of min_g ‖f(x⁺) − g‖ / ‖f(x⁺)‖, g in the span of ψ(x) (and of u, and of u⊗ψ(x) for a
        bilinear model): the sine of the largest principal angle, 0 … 1. 0: the dictionary is invariant. 1: it
        holds a function of whose next value nothing is known.
    worst
        (nz,) that function, f = ψ · worst, of root-mean-square 1.
    errors
        (nz,) the same error for each observable itself; 0 for one that is 0 throughout.
    names
        Names of the observables.
    """

    proximity: float
    worst: Float[np.ndarray, " nz"]
    errors: Float[np.ndarray, " nz"]
    names: tuple[str, ...]

    @property
    def index(self) -> float:
        """Consistency index ρ = λ_max(I − M_f M_b) = proximity², M_f and M_b the EDMD forward and backward in time."""
        return self.proximity**2


def invariance(
    episodes: Episodes | Source,
    lifting: Lifting | AnyPredictor,
    *,
    embedding: Delay | None = None,
    bilinear: bool = False,
) -> Invariance:
    """Return the invariance proximity of a dictionary on these episodes; no choice of its basis changes it.

    With inputs the dictionary predicts with their help: what u explains is no lack of invariance. Directions of
    span ψ that are rounding on the data (relative size eps · M) are left out. Measurement noise counts, for noise is
    not predictable: a nearly dependent dictionary holds a function that is mostly noise, and its proximity is near 1
    even where `errors` are small.

    Parameters
    ----------
    episodes
        Episodes, or a source of them.
    lifting
        The dictionary ψ; or a predictor, for its dictionary, embedding and kind.
    embedding
        What a lifting of the state and its past acts on.
    bilinear
        Predict with u⊗ψ(x) too, as a bilinear model does.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.

    References
    ----------
    Haseli & Cortés, "Temporal forward-backward consistency, not residual error, measures the prediction accuracy
    of extended dynamic mode decomposition", IEEE Control Syst. Lett. 7, 2023; the same, "Invariance proximity:
    closed-form error bounds for finite-dimensional Koopman-based models", 2023.
    """
    return proximity_of(moments_of(episodes, lifting, embedding=embedding, bilinear=bilinear))


def proximity_of(total: Moments) -> Invariance:
    """Return the result of `invariance` from the moments; Gram sums resolve it to 1e-8 times the condition number."""
    P, T, cut = both_sides(total)
    known = orthonormal(P, cut)
    size = norms(T)
    scale = np.where(size > 0, size, 1.0)
    unexplained = T / scale - known @ (known.T @ (T / scale))
    U, s, Vt = np.linalg.svd(T / scale, full_matrices=False)
    held = s > cut * s.max(initial=0.0)
    span = U[:, held]
    _, angles, directions = np.linalg.svd(span - known @ (known.T @ span), full_matrices=False)
    nz = total.nz
    if not held.any():
        return Invariance(0.0, np.zeros(nz), np.zeros(nz), total.lifting.names)
    worst = (Vt[held].T / s[held]) @ directions[0] / scale * np.sqrt(total.samples)
    return Invariance(float(min(angles[0], 1.0)), worst, np.minimum(norms(unexplained), 1.0), total.lifting.names)
