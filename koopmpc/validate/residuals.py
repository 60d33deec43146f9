"""One-step residuals of each eigenpair, and the invariance of the dictionary.

Both follow from the second moments of the rows [ψ(x) u ψ(x⁺)], so one pass over the data suffices.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting
from koopmpc.models.base import sorted_eigen
from koopmpc.models.moments.moments import Moments, both_sides
from koopmpc.models.moments.read import second_moments
from koopmpc.models.moments.solve import column_norms, orthonormal_basis
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.spectrum import check_same_names
from koopmpc.validate.scoring import AnyPredictor

_SPURIOUS = 0.05  # an eigenpair with a larger one-step residual is spurious, unless the caller sets a tolerance


def compute_moments(
    episodes: Episodes | Source,
    model: Lifting | AnyPredictor,
    *,
    embedding: Delay | None = None,
    bilinear: bool = False,
) -> Moments:
    """Return the second moments of these episodes in a lifting, or in the lifting and the inputs of a predictor.

    They are triangular factors (``route="qr"``), which resolve residuals down to rounding. Measured disturbances
    count as inputs for a lifting and for a linear predictor with disturbances, not for a bilinear model.

    Parameters
    ----------
    episodes
        Episodes, or a source of them.
    model
        A lifting ψ, or a predictor; a predictor has its own embedding and kind.
    embedding
        The delay embedding that a lifting ψ acts on.
    bilinear
        With a lifting: include the products u⊗ψ(x) in the rows.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.
    """
    source_of(episodes)
    if isinstance(model, Lifting):
        lifting, driven, crossed = model, not bilinear, False
    else:
        checks.kind(model, "model", (LinearPredictor, BilinearPredictor), "pass a model, or a lifting")
        check_same_names(model, episodes)
        lifting, embedding, bilinear = model.lifting, model.embedding, isinstance(model, BilinearPredictor)
        driven, crossed = model.nw > 0, isinstance(model, BilinearPredictor) and model.multiplies_inputs
    rows = episodes.driven(products=crossed) if driven else episodes
    return second_moments(rows, lifting, embedding=embedding, route="qr", bilinear=bilinear)


@dataclass(frozen=True, eq=False)
class ResidualDMD(Value):
    """One-step residuals of the eigenpairs of a predictor.

    Attributes
    ----------
    eigenvalues
        (nz,) λ of A, the largest magnitude first.
    residuals
        (nz,) ‖φ(x⁺) − λ φ(x) − (effect of the inputs)‖ / ‖φ(x)‖ over the snapshots; infinite if φ is 0 on all of
        them.
    tolerance
        An eigenpair with a larger residual is `spurious`.
    samples
        M, the number of snapshots.
    """

    eigenvalues: Complex[np.ndarray, " nz"]
    residuals: Float[np.ndarray, " nz"]
    tolerance: float
    samples: int

    @property
    def spurious(self) -> Bool[np.ndarray, " nz"]:
        """(nz,) True for each eigenpair whose residual is above the tolerance."""
        return self.residuals > self.tolerance


def residual_dmd(predictor: AnyPredictor, episodes: Episodes | Source, *, tolerance: float = _SPURIOUS) -> ResidualDMD:
    """Return ‖Ψ(x⁺) v − λ Ψ(x) v − U Bᵀ v‖ / ‖Ψ(x) v‖ for each left eigenvector v of A, φ = ψ · v.

    The squared norm v*(Ψy*Ψy − λ Ψy*Ψx − λ̄ Ψx*Ψy + |λ|² Ψx*Ψx)v follows from the second moments of the data. The code
    computes the norm on a factor of the moments, because a difference of squares would lose half the digits. Without
    inputs it bounds the distance from λ to the (pseudo)spectrum of the Koopman operator. With inputs the operator is
    that of the drift ψ(x⁺) − B u, where B (and E, Nᵢ) are the predictor's own. The residual then contains the errors of
    λ, v and B.

    Parameters
    ----------
    predictor
        Linear or bilinear; its A determines λ and v.
    episodes
        Episodes, or a source of them; best episodes that the model was not fitted to.
    tolerance
        `ResidualDMD.spurious` marks the eigenpairs with a larger residual.

    Raises
    ------
    ShapeError
        The episodes have other states, inputs or disturbances than the predictor.
    DataError
        The episodes have another dt, or the tolerance is not above zero.

    References
    ----------
    Colbrook & Townsend, "Rigorous data-driven computation of spectral properties of Koopman operators for
    dynamical systems", Commun. Pure Appl. Math. 77, 2024.
    """
    tolerance = checks.positive(tolerance, "tolerance")
    return measure_eigenpairs(predictor, compute_moments(episodes, predictor), tolerance)


def measure_eigenpairs(predictor: AnyPredictor, total: Moments, tolerance: float = _SPURIOUS) -> ResidualDMD:
    """Return the result of `residual_dmd` from moments in the predictor's own lifting."""
    values, V = sorted_eigen(np.ascontiguousarray(predictor.A.T))
    P, T, _ = both_sides(total)
    with np.errstate(over="ignore", invalid="ignore"):
        gap = _column_norms((T - P @ _step_matrix(predictor, total)) @ V)
    gap[np.isnan(gap)] = np.inf  # the product with very large entries of A overflowed
    size = _column_norms(P[:, : total.nz] @ V)
    floor = np.finfo(float).eps * _column_norms(np.abs(P[:, : total.nz]) @ np.abs(V))  # a smaller φ is rounding
    nonzero = size > floor
    residuals = np.divide(gap, size, out=np.full(len(size), np.inf), where=nonzero)
    return ResidualDMD(values, residuals, tolerance, total.samples)


def _step_matrix(predictor: AnyPredictor, total: Moments) -> Float[np.ndarray, "n nz"]:
    """Return the predictor's K in z⁺ = [z u u⊗z] K."""
    A = predictor.A.T
    if not isinstance(predictor, BilinearPredictor):
        return np.vstack([A, predictor.B.T, predictor.E.T])
    products = total.products
    constant = np.setdiff1d(np.arange(total.nz), products)  # u times the Constant is u: add it to the inputs
    crossed = len(total.inputs) - predictor.nu - predictor.nw  # the products of u and w multiply no observable
    every = np.concatenate([predictor.N, predictor.S, np.zeros((crossed, total.nz, total.nz))])
    M = predictor.M.transpose(0, 2, 1).reshape(-1, total.nz)[:crossed]
    B = np.vstack([predictor.B.T, predictor.E.T, M]) + every[:, :, constant].sum(axis=2)
    N = every[:, :, products].transpose(0, 2, 1).reshape(-1, total.nz)
    return np.vstack([A, B, N])


def _column_norms(columns: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the Euclidean norms of real or complex columns."""
    return np.asarray(np.linalg.norm(columns, axis=0), dtype=np.float64)


def check_residuals(predictor: AnyPredictor, residuals: "ResidualDMD | ArrayLike") -> ResidualDMD:
    """Return the residuals as a ResidualDMD; an array is in the order of ``predictor.eigenvalues``."""
    if isinstance(residuals, ResidualDMD):
        if len(residuals.residuals) != predictor.nz:
            raise ShapeError(
                f"there are {len(residuals.residuals)} residuals and {predictor.nz} eigenvalues; "
                "pass the residuals of this predictor"
            )
        expected, received = (np.sort_complex(v) for v in (predictor.eigenvalues, residuals.eigenvalues))
        if not np.allclose(np.abs(expected), np.abs(received), rtol=1e-3, atol=1e-6):
            raise DataError("the residuals are those of another predictor; pass residual_dmd(predictor, …)")
        return residuals
    values = checks.array(residuals, "residuals", (predictor.nz,), infinite=True, finite=False)
    if np.isnan(values).any() or (values < 0).any():
        raise DataError(f"residuals holds {values.min():g}; residuals are norms, 0 or above")
    return ResidualDMD(predictor.eigenvalues, values, _SPURIOUS, 0)


@dataclass(frozen=True, eq=False)
class Invariance(Value):
    """Distance of span ψ from an invariant subspace, on the data.

    Attributes
    ----------
    proximity
        sup over f in span ψ of min_g ‖f(x⁺) − g‖ / ‖f(x⁺)‖, g in the span of ψ(x) (and of u, and of u⊗ψ(x) for a
        bilinear model): the sine of the largest principal angle, 0 … 1. At 0 the dictionary is invariant. At 1 the
        data do not predict the next value of `worst` at all.
    worst
        (nz,) coefficients of the f that attains the supremum, f = ψ · worst, of root-mean-square 1.
    errors
        (nz,) min_g ‖f(x⁺) − g‖ / ‖f(x⁺)‖ of each observable f; 0 for an observable that is always 0.
    names
        Names of the observables.
    """

    proximity: float
    worst: Float[np.ndarray, " nz"]
    errors: Float[np.ndarray, " nz"]
    names: tuple[str, ...]

    @property
    def index(self) -> float:
        """Consistency index ρ = λ_max(I − M_f M_b) = proximity²; M_f, M_b are EDMD forward and backward in time."""
        return self.proximity**2


def invariance(
    episodes: Episodes | Source,
    lifting: Lifting | AnyPredictor,
    *,
    embedding: Delay | None = None,
    bilinear: bool = False,
) -> Invariance:
    """Return the invariance proximity of a dictionary on these episodes; it does not depend on the basis.

    With inputs, g may also use u: the part of f(x⁺) that u explains does not count as an error. Directions of span ψ
    that are rounding on the data (relative size eps · M) are left out. Measurement noise counts as an error. The span
    of a nearly dependent dictionary contains a function that is mostly noise. Its proximity is then near 1, although
    its `errors` may be small.

    Parameters
    ----------
    episodes
        Episodes, or a source of them.
    lifting
        The dictionary ψ; or a predictor, for its dictionary, embedding and kind.
    embedding
        The delay embedding that a lifting ψ acts on.
    bilinear
        Predict with u⊗ψ(x) too, as a bilinear model does.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.

    References
    ----------
    Haseli & Cortés, "Temporal forward-backward consistency, not residual error, measures the prediction accuracy
    of extended dynamic mode decomposition", IEEE Control Syst. Lett. 7, 2023; by the same authors "Invariance
    proximity: closed-form error bounds for finite-dimensional Koopman-based models", 2023.
    """
    return measure_invariance(compute_moments(episodes, lifting, embedding=embedding, bilinear=bilinear))


def measure_invariance(total: Moments) -> Invariance:
    """Return the result of `invariance` from moments; Gram sums resolve it to 1e-8 times the condition number."""
    P, T, cut = both_sides(total)
    basis = orthonormal_basis(P, cut)
    size = column_norms(T)
    scale = np.where(size > 0, size, 1.0)
    unexplained = T / scale - basis @ (basis.T @ (T / scale))
    U, s, Vt = np.linalg.svd(T / scale, full_matrices=False)
    resolved = s > cut * s.max(initial=0.0)
    span = U[:, resolved]
    _, angles, directions = np.linalg.svd(span - basis @ (basis.T @ span), full_matrices=False)
    nz = total.nz
    if not resolved.any():
        return Invariance(0.0, np.zeros(nz), np.zeros(nz), total.lifting.names)
    worst = (Vt[resolved].T / s[resolved]) @ directions[0] / scale * np.sqrt(total.samples)
    return Invariance(
        float(min(angles[0], 1.0)), worst, np.minimum(column_norms(unexplained), 1.0), total.lifting.names
    )
