"""BilinearPredictor: z⁺ = A z + B u + Σ uᵢ Nᵢ z, x ≈ C z, z₀ = ψ(x₀)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode
from koopmpc.lifting.base import Lifting
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.base import FitReport, Predictor, load_value
from koopmpc.predict.linear import LinearPredictor, eigen


@dataclass(frozen=True, eq=False, init=False)
class BilinearPredictor(Predictor):
    """A lifted bilinear predictor z⁺ = A z + B u + Σ uᵢ Nᵢ z, x ≈ C z, z₀ = ψ(x₀).

    What an input does may depend on the state, as it does wherever a force turns with the body that it acts on;
    a linear predictor has one B for all states.

    Attributes
    ----------
    A
        (nz, nz), one step of `dt`.
    B
        (nz, nu).
    N
        (nu, nz, nz), one matrix for each input.
    C
        (nx, nz), back to the state.
    lifting
        ψ, bound to `states`.
    dt
        Sampling time [s].
    states, inputs
        Names with units.
    report
        How it was fitted; None for a model that was not.
    embedding
        Makes ζ of x and its past; the lifting is then bound to the names of ζ, and z₀ = ψ(ζ₀).

    Raises
    ------
    ShapeError
        A, B, N, C, the lifting and the names do not fit together.

    References
    ----------
    Bruder, Fu & Vasudevan, "Advantages of bilinear Koopman realizations for the modeling and control of systems
    with unknown dynamics", IEEE Robot. Autom. Lett. 6, 2021.
    """

    N: Float[np.ndarray, "nu nz nz"]

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        N: ArrayLike,
        C: ArrayLike,
        lifting: Lifting,
        dt: float,
        states: Sequence[str],
        inputs: Sequence[str],
        report: FitReport | None = None,
        embedding: Delay | None = None,
    ) -> None:
        super().__init__(A, B, C, lifting, dt, states, inputs, report, embedding)
        self._set(N=checks.array(N, "N", (self.nu, self.nz, self.nz)))

    def rollout(self, x0: ArrayLike, U: ArrayLike, *, history: Episode | None = None) -> Float[np.ndarray, "steps nx"]:
        """Return x_k ≈ C z_k of z_{k+1} = (A + Σ uᵢ Nᵢ) z_k + B u_k, z_0 = ψ(x0), lifted once at the start.

        Parameters
        ----------
        x0
            (nx,) initial state; with an embedding and no history the point ζ_0.
        U
            (T, nu) inputs.
        history
            The steps that led to x0, its last row x0 itself; only with an embedding.
        """
        inputs = checks.array(U, "U", (None, self.nu))
        start = self.start(x0, history)
        Z = np.empty((len(inputs) + 1, self.nz))
        Z[0] = self.lifting(start)
        for k, u in enumerate(inputs):
            Z[k + 1] = self.A @ Z[k] + self.B @ u + u @ (self.N @ Z[k])
        X = Z @ self.C.T
        X[0] = start[: self.nx]
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C (A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)) as a StepMap; with an embedding, of ζ."""
        x, u = ca.SX.sym("x", len(self.point_names)), ca.SX.sym("u", self.nu)
        z = self.lifting.symbolic(x)
        x_next = ca.DM(self.C @ self.A) @ z + ca.DM(self.C @ self.B) @ u
        for i in range(self.nu):
            x_next += u[i] * (ca.DM(self.C @ self.N[i]) @ z)
        return self.as_step_map(x, u, x_next)

    @cached_property
    def eigenvalues(self) -> Complex[np.ndarray, " nz"]:
        """Eigenvalues of A, the motion without input, the largest magnitude first."""
        return eigen(self.A)[0]


def load_model(path: str | Path) -> LinearPredictor | BilinearPredictor:
    """Read a predictor that its `save` wrote, of whichever kind; runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or no predictor.
    """
    return load_value(path, LinearPredictor, BilinearPredictor)
