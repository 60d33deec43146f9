"""Eigenvalues beside their residuals, as the views take them."""

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.residual_dmd import TOLERANCE, ResidualDMD
from koopmpc.predict.score import Predictor

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
