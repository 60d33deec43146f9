"""The regression of ψ(x⁺) on [ψ(x) u], as a few rows, with all that a predictor of it needs."""

from dataclasses import dataclass
from typing import Unpack

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.identify.gather import How, moments
from koopmpc.identify.moments import Moments
from koopmpc.identify.solve import Rows, solve
from koopmpc.lifting.base import Lifting


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
    total = moments(source.driven(), lifting, embedding=sized, **how)
    return regression(total, method, noisy=noisy, disturbances=source.disturbances)


def regression(
    total: Moments, method: str, *, noisy: bool = False, disturbances: tuple[str, ...] = ()
) -> Regression:
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


def _decoder(
    total: Moments, where: np.ndarray
) -> tuple[Float[np.ndarray, "nx nz"], Float[np.ndarray, " nx"]]:
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
