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
from koopmpc.errors import ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.plant.step_map import StepMap
from koopmpc.predict.files import load_value, save_value
from koopmpc.predict.linear import eigen
from koopmpc.predict.report import FitReport
from koopmpc.values import Value


@dataclass(frozen=True, eq=False, init=False)
class BilinearPredictor(Value):
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

    Raises
    ------
    ShapeError
        A, B, N, C, the lifting and the names do not fit together.

    References
    ----------
    Bruder, Fu & Vasudevan, "Advantages of bilinear Koopman realizations for the modeling and control of systems
    with unknown dynamics", IEEE Robot. Autom. Lett. 6, 2021.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    N: Float[np.ndarray, "nu nz nz"]
    C: Float[np.ndarray, "nx nz"]
    lifting: Lifting
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    report: FitReport | None

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
    ) -> None:
        bound = lifting.bind(tuple(states))
        nz, nx, nu = bound.nz, len(states), len(inputs)
        transition = checks.array(A, "A")
        if transition.shape != (nz, nz):
            raise ShapeError(
                f"A has shape {transition.shape}, but the lifting returns {nz} observables; "
                "pass the lifting used in the fit"
            )
        for name, value in {
            "A": transition,
            "B": checks.array(B, "B", (nz, nu)),
            "N": checks.array(N, "N", (nu, nz, nz)),
            "C": checks.array(C, "C", (nx, nz)),
            "lifting": bound,
            "dt": checks.positive(dt, "dt", "s"),
            "states": tuple(states),
            "inputs": tuple(inputs),
            "report": report,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.C.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def nz(self) -> int:
        """Number of lifted coordinates."""
        return self.A.shape[0]

    def lift(self, x: ArrayLike) -> Float[np.ndarray, "*batch nz"]:
        """Return z = ψ(x) for one state (nx,) or rows of states (M, nx)."""
        return self.lifting(checks.array(x, "x"))

    def rollout(self, x0: ArrayLike, U: ArrayLike) -> Float[np.ndarray, "steps nx"]:
        """Return x_k ≈ C z_k of z_{k+1} = (A + Σ uᵢ Nᵢ) z_k + B u_k, z_0 = ψ(x0), lifted once at the start.

        Parameters
        ----------
        x0
            (nx,) initial state.
        U
            (T, nu) inputs.
        """
        inputs = checks.array(U, "U", (None, self.nu))
        start = checks.array(x0, "x0", (self.nx,))
        Z = np.empty((len(inputs) + 1, self.nz))
        Z[0] = self.lift(start)
        for k, u in enumerate(inputs):
            Z[k + 1] = self.A @ Z[k] + self.B @ u + u @ (self.N @ Z[k])
        X = Z @ self.C.T
        X[0] = start
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C (A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)) as a StepMap."""
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        z = self.lifting.symbolic(x)
        x_next = ca.DM(self.C @ self.A) @ z + ca.DM(self.C @ self.B) @ u
        for i in range(self.nu):
            x_next += u[i] * (ca.DM(self.C @ self.N[i]) @ z)
        F = ca.Function("F", [x, u], [ca.densify(x_next)], ["x", "u"], ["x_next"], {"cse": True})
        return StepMap(F, self.dt, states=self.states, inputs=self.inputs)

    @cached_property
    def eigenvalues(self) -> Complex[np.ndarray, " nz"]:
        """Eigenvalues of A, the motion without input, the largest magnitude first."""
        return eigen(self.A)[0]

    def save(self, path: str | Path) -> None:
        """Write the predictor as data (.npz: arrays and one JSON text); `load_bilinear_predictor` reads it."""
        save_value(self, path)


def load_bilinear_predictor(path: str | Path) -> BilinearPredictor:
    """Read a predictor that `BilinearPredictor.save` wrote; runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or no bilinear predictor.
    """
    return load_value(path, BilinearPredictor)
