"""Residual DMD: ‖K φ − λ φ‖ / ‖φ‖ of each eigenpair, from the moments alone; large ones are spurious."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.moments.moments import Moments, both_sides
from koopmpc.predict.base import eigen
from koopmpc.predict.predictors import BilinearPredictor
from koopmpc.validate.scoring import Predictor
from koopmpc.values import Value

TOLERANCE = 0.05  # residual of one step beyond which an eigenpair is spurious


@dataclass(frozen=True, eq=False)
class ResidualDMD(Value):
    """How far each eigenfunction of a predictor is from one of the Koopman operator.

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
        """Eigenpairs whose residual is above the tolerance: in a step more than that share of φ is not λ φ."""
        return self.residuals > self.tolerance


def residual_dmd(predictor: Predictor, total: Moments, *, tolerance: float = TOLERANCE) -> ResidualDMD:
    """Return ‖Ψ(x⁺) v − λ Ψ(x) v − U Bᵀ v‖ / ‖Ψ(x) v‖ for each left eigenvector v of A, φ = ψ · v.

    The squared norm is v*(Ψy*Ψy − λ Ψy*Ψx − λ̄ Ψx*Ψy + |λ|² Ψx*Ψx)v, which the moments hold: no data are read
    again. It is taken as a norm, on a factor of the moments, since as a difference of squares it would lose
    half the digits. Without inputs it bounds the distance from λ to the (pseudo)spectrum of the Koopman operator.
    With inputs the operator is that of the drift ψ(x⁺) − B u: what the inputs do by the predictor's own B (E, Nᵢ)
    is taken off, and the residual is the energy of what is left, whether λ, v or B is to blame.

    Parameters
    ----------
    predictor
        Linear or bilinear; its A gives λ and v.
    total
        ``moments(episodes, predictor.lifting)`` of any episodes: those of the fit, or better those held out;
        ``bilinear=True`` for a bilinear predictor, ``episodes.driven()`` where it knows disturbances. Gram sums
        resolve residuals to about 1e-8, ``route="qr"`` to rounding.
    tolerance
        For `ResidualDMD.spurious`.

    Raises
    ------
    DataError
        The moments are those of another lifting or dt, or bilinear where the predictor is not.
    ShapeError
        They have other inputs.

    References
    ----------
    Colbrook & Townsend, "Rigorous data-driven computation of spectral properties of Koopman operators for
    dynamical systems", Commun. Pure Appl. Math. 77, 2024.
    """
    tolerance = checks.positive(tolerance, "tolerance")
    bilinear = isinstance(predictor, BilinearPredictor)
    driving = predictor.inputs if bilinear else predictor.inputs + predictor.disturbances
    if total.inputs != driving:
        raise ShapeError(
            f"the moments have inputs ({', '.join(total.inputs)}), the predictor has ({', '.join(driving)}); "
            "pass moments of data of the same plant, episodes.driven() where it knows disturbances"
        )
    mine = (predictor.lifting, predictor.embedding, predictor.dt, bilinear)
    if (total.lifting, total.embedding, total.dt, total.bilinear) != mine:
        how = ", embedding=predictor.embedding" if predictor.embedding else ""
        how += ", bilinear=True" if bilinear else ""
        raise DataError(
            "the moments and the predictor differ in lifting, embedding or dt, or one is bilinear; "
            f"pass moments(episodes, predictor.lifting{how})"
        )
    values, V = eigen(np.ascontiguousarray(predictor.A.T))
    P, T, _ = both_sides(total)
    with np.errstate(over="ignore", invalid="ignore"):
        gap = _norms((T - P @ _one_step(predictor, total)) @ V)
    gap[np.isnan(gap)] = np.inf  # of an A beyond the finite numbers
    size = _norms(P[:, : total.nz] @ V)
    floor = np.finfo(float).eps * _norms(np.abs(P[:, : total.nz]) @ np.abs(V))  # below it φ is 0 but for rounding
    live = size > floor
    residuals = np.divide(gap, size, out=np.full(len(size), np.inf), where=live)
    return ResidualDMD(values, residuals, tolerance, total.samples)


def _one_step(predictor: Predictor, total: Moments) -> Float[np.ndarray, "n nz"]:
    """Return K with z⁺ = [z u u⊗z] K as the predictor has it."""
    A = predictor.A.T
    if not isinstance(predictor, BilinearPredictor):
        return np.vstack([A, predictor.B.T, predictor.E.T])
    products = total.products
    constant = np.setdiff1d(np.arange(total.nz), products)  # u times 1 is among the inputs already
    B = predictor.B.T + predictor.N[:, :, constant].sum(axis=2)
    N = predictor.N[:, :, products].transpose(0, 2, 1).reshape(-1, total.nz)
    return np.vstack([A, B, N])


def _norms(columns: np.ndarray) -> Float[np.ndarray, " n"]:
    return np.asarray(np.linalg.norm(columns, axis=0), dtype=np.float64)


Residuals = ResidualDMD | ArrayLike


def eigenpairs(predictor: Predictor, residuals: Residuals) -> ResidualDMD:
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
