"""LinearPredictor: z⁺ = A z + B u (+ E w), x ≈ C z, z₀ = ψ(x₀)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.projected import Projected
from koopmpc.lifting.state import State
from koopmpc.plant.step_map import StepMap
from koopmpc.predict.files import load_value, save_value
from koopmpc.predict.report import FitReport
from koopmpc.values import Value

_DEFECTIVE = 1e14  # condition number of eigenvectors beyond which they are dependent


@dataclass(frozen=True, eq=False, init=False)
class LinearPredictor(Value):
    """A lifted linear predictor z⁺ = A z + B u + E w, x ≈ C z, z₀ = ψ(x₀), w disturbances that are measured.

    Attributes
    ----------
    A
        (nz, nz), one step of `dt`.
    B
        (nz, nu); (nz, 0) for an autonomous system.
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
    exact_modes
        (nl, nz) exact DMD modes X′ V Σ⁻¹ W in the observables of the unreduced lifting, one a column, where a
        rank-truncated fit computed them; its `lifting` is then a Projected one.
    E
        (nz, nw); (nz, 0) without measured disturbances.
    disturbances
        Names of w with units; ``w0, w1, …`` by default.

    Raises
    ------
    ShapeError
        A, B, C, E, the lifting and the names do not fit together.

    References
    ----------
    Korda & Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
    control", Automatica 93, 2018.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    C: Float[np.ndarray, "nx nz"]
    lifting: Lifting
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    report: FitReport | None
    exact_modes: Complex[np.ndarray, "nl nz"] | None
    E: Float[np.ndarray, "nz nw"]
    disturbances: tuple[str, ...]

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        lifting: Lifting,
        dt: float,
        states: Sequence[str],
        inputs: Sequence[str],
        report: FitReport | None = None,
        exact_modes: Complex[np.ndarray, "nl nz"] | None = None,
        E: ArrayLike | None = None,
        disturbances: Sequence[str] | None = None,
    ) -> None:
        bound = lifting.bind(tuple(states))
        nz, nx, nu = bound.nz, len(states), len(inputs)
        transition = checks.array(A, "A")
        if transition.shape != (nz, nz):
            raise ShapeError(
                f"A has shape {transition.shape}, but the lifting returns {nz} observables; "
                "pass the lifting used in the fit"
            )
        modes = exact_modes
        if modes is not None:
            if not isinstance(bound, Projected) or modes.shape != bound.basis.shape:
                raise ShapeError(
                    f"exact_modes has shape {modes.shape}; it needs a Projected lifting with a basis of that shape"
                )
            modes = np.array(modes, dtype=np.complex128, order="C")
        drift = np.zeros((nz, 0)) if E is None else checks.array(E, "E", (nz, None))
        nw = drift.shape[1]
        names = tuple(f"w{i}" for i in range(nw)) if disturbances is None else tuple(disturbances)
        if len(names) != nw:
            raise ShapeError(f"disturbances has {len(names)} names and E {nw} columns; give one name each")
        for name, value in {
            "A": transition,
            "B": checks.array(B, "B", (nz, nu)),
            "C": checks.array(C, "C", (nx, nz)),
            "lifting": bound,
            "dt": checks.positive(dt, "dt", "s"),
            "states": tuple(states),
            "inputs": tuple(inputs),
            "report": report,
            "exact_modes": modes,
            "E": drift,
            "disturbances": names,
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

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return self.E.shape[1]

    def lift(self, x: ArrayLike) -> Float[np.ndarray, "*batch nz"]:
        """Return z = ψ(x) for one state (nx,) or rows of states (M, nx)."""
        return self.lifting(checks.array(x, "x"))

    def rollout(
        self, x0: ArrayLike, U: ArrayLike, W: ArrayLike | None = None
    ) -> Float[np.ndarray, "steps nx"]:
        """Return x_k ≈ C z_k of z_{k+1} = A z_k + B u_k + E w_k, z_0 = ψ(x0), lifted once at the start.

        Parameters
        ----------
        x0
            (nx,) initial state.
        U
            (T, nu) inputs; (T, 0) for an autonomous predictor.
        W
            (T, nw) measured disturbances; zero by default.
        """
        inputs = checks.array(U, "U", (None, self.nu))
        start = checks.array(x0, "x0", (self.nx,))
        Z = np.empty((len(inputs) + 1, self.nz))
        Z[0] = self.lift(start)
        forced = inputs @ self.B.T
        if W is not None:
            forced += checks.array(W, "W", (len(inputs), self.nw)) @ self.E.T
        for k in range(len(inputs)):
            np.dot(self.A, Z[k], out=Z[k + 1])
            Z[k + 1] += forced[k]
        X = Z @ self.C.T
        X[0] = start
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C (A ψ(x) + B u) as a StepMap, for simulation and nonlinear MPC; w is 0."""
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        CA, CB = ca.DM(self.C @ self.A), ca.DM(self.C @ self.B)
        x_next = CA @ self.lifting.symbolic(x) + CB @ u
        F = ca.Function("F", [x, u], [ca.densify(x_next)], ["x", "u"], ["x_next"])
        return StepMap(F, self.dt, states=self.states, inputs=self.inputs)

    @cached_property
    def eigenvalues(self) -> Complex[np.ndarray, " nz"]:
        """Eigenvalues of A, the largest magnitude first."""
        return self._eigen[0]

    @cached_property
    def modes(self) -> Complex[np.ndarray, "nx nz"]:
        """Modes in the state's coordinates, one a column: exact DMD modes, or C times A's eigenvectors."""
        if self.exact_modes is None or not isinstance(self.lifting, Projected):
            return self.C @ self.eigenvectors
        whole = self.lifting.lifting
        place = {name: i for i, name in enumerate(whole.names)}
        if set(self.states) <= set(place):
            return self.exact_modes[[place[name] for name in self.states]]
        return self.C @ (self.lifting.basis.T @ self.exact_modes)

    @property
    def eigenvectors(self) -> Complex[np.ndarray, "nz nz"]:
        """Right eigenvectors v_j of A, one a column, of length 1, in the order of `eigenvalues`."""
        return self._eigen[1]

    @cached_property
    def left_eigenvectors(self) -> Complex[np.ndarray, "nz nz"]:
        """Left eigenvectors ξ_jᴴ of A, one a row: ξ_jᴴ A = λ_j ξ_jᴴ, scaled so that ξ_jᴴ v_j = 1.

        Raises
        ------
        DataError
            A is defective: its eigenvectors do not span the lifted space.
        """
        if np.linalg.cond(self.eigenvectors) > _DEFECTIVE:
            raise DataError(
                "A is defective: its eigenvectors do not span the lifted space, so it has no complete set of "
                "eigenfunctions; perturb A or lift to other observables"
            )
        return np.linalg.inv(self.eigenvectors)

    def eigenfunctions(self, X: ArrayLike) -> Complex[np.ndarray, "M nz"]:
        """Return φ_j(x) = ξ_jᴴ ψ(x) at rows of states (M, nx): φ_j(x⁺) = λ_j φ_j(x) without input.

        Raises
        ------
        DataError
            A is defective.
        """
        Z = self.lifting(checks.array(X, "X", (None, self.nx)))
        return Z @ self.left_eigenvectors.T

    @cached_property
    def _eigen(self) -> tuple[Complex[np.ndarray, " nz"], Complex[np.ndarray, "nz nz"]]:
        return eigen(self.A)

    def save(self, path: str | Path) -> None:
        """Write the predictor as data (.npz: arrays and one JSON text); `load_predictor` reads it."""
        save_value(self, path)

    @classmethod
    def local(cls, step_map: StepMap, x: ArrayLike, u: ArrayLike) -> "LinearPredictor":
        """Return the linearisation x⁺ = A x + B u + c at (x, u) as a predictor on State() + Constant().

        Exact Jacobians of `step_map`; c = F(x, u) − A x − B u, so (x, u) need not be an equilibrium.
        """
        affine = step_map.linearize(x, u)
        nx, nu = affine.B.shape
        A = np.eye(nx + 1)
        A[:nx, :nx], A[:nx, nx] = affine.A, affine.c
        B = np.vstack([affine.B, np.zeros((1, nu))])
        C = np.eye(nx, nx + 1)
        return cls(A, B, C, State() + Constant(), step_map.dt, step_map.states, step_map.inputs)


def eigen(
    A: Float[np.ndarray, "nz nz"],
) -> tuple[Complex[np.ndarray, " nz"], Complex[np.ndarray, "nz nz"]]:
    """Return eigenvalues of A, the largest magnitude first, and its right eigenvectors, one a column."""
    result = np.linalg.eig(A)
    values, vectors = np.asarray(result.eigenvalues, complex), np.asarray(result.eigenvectors, complex)
    order = np.lexsort((np.imag(values), -np.abs(values)))
    return values[order], vectors[:, order]


def load_predictor(path: str | Path) -> LinearPredictor:
    """Read a predictor that `LinearPredictor.save` wrote; runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or no predictor.
    """
    return load_value(path, LinearPredictor)
