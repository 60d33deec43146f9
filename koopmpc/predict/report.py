"""FitReport: what a fit says about itself."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class FitReport(Value):
    """How z⁺ = A z + B u was fitted, and how far the fit can be trusted.

    Attributes
    ----------
    method
        The function that made it: "dmd", "dmdc", "edmd", "bilinear_edmd".
    route
        How the least squares was solved: "gram", "qr", "svd", and what was cut or added.
    samples
        Snapshot pairs M.
    condition
        Condition number of the regressors on unit-norm columns; inf where they are dependent.
    rank, columns
        Numerical rank of the regressors, and how many columns they have.
    ridge
        The Tikhonov weight on unit-norm columns.
    residual
        Root-mean-square one-step residual of each state, in the state's unit; the "gram" route resolves it to
        about 1e-8 of the state's size.
    state_residual
        Root-mean-square of x − C ψ(x) for each state: zero where the lifting holds the state itself.
    warnings
        Sentences, one for each doubt.
    changes
        Sentences, one for each thing that a prior, a limit on the spectral radius or a penalty changed.
    """

    method: str
    route: str
    samples: int
    condition: float
    rank: int
    columns: int
    ridge: float
    residual: Float[np.ndarray, " nx"]
    state_residual: Float[np.ndarray, " nx"]
    warnings: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
