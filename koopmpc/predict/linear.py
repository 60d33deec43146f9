"""LinearPredictor: z⁺ = A z + B u (+ E w), x ≈ C z, z₀ = ψ(x₀)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from scipy.linalg.blas import dgemv

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.reduced import Projected
from koopmpc.lifting.state import Constant, State
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.base import FitReport, Predictor

_DEFECTIVE = 1e14  # condition number of eigenvectors beyond which they are dependent


@dataclass(frozen=True, eq=False, init=False)
class LinearPredictor(Predictor):
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
    embedding
        Makes ζ of x and its past; the lifting is then bound to the names of ζ, and z₀ = ψ(ζ₀).

    Raises
    ------
    ShapeError
        A, B, C, E, the lifting and the names do not fit together.

    References
    ----------
    Korda & Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
    control", Automatica 93, 2018.
    """

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
        embedding: Delay | None = None,
    ) -> None:
        super().__init__(A, B, C, lifting, dt, states, inputs, report, embedding)
        modes = exact_modes
        if modes is not None:
            if not isinstance(self.lifting, Projected) or modes.shape != self.lifting.basis.shape:
                raise ShapeError(
                    f"exact_modes has shape {modes.shape}; it needs a Projected lifting with a basis of that shape"
                )
            modes = np.array(modes, dtype=np.complex128, order="C")
        drift = np.zeros((self.nz, 0)) if E is None else checks.array(E, "E", (self.nz, None))
        nw = drift.shape[1]
        names = tuple(f"w{i}" for i in range(nw)) if disturbances is None else tuple(disturbances)
        if len(names) != nw:
            raise ShapeError(f"disturbances has {len(names)} names and E {nw} columns; give one name each")
        self._set(exact_modes=modes, E=drift, disturbances=names)

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return self.E.shape[1]

    def rollout(
        self, x0: ArrayLike, U: ArrayLike, W: ArrayLike | None = None, *, history: Episode | None = None
    ) -> Float[np.ndarray, "steps nx"]:
        """Return x_k ≈ C z_k of z_{k+1} = A z_k + B u_k + E w_k, z_0 = ψ(x0), lifted once at the start.

        Parameters
        ----------
        x0
            (nx,) initial state; with an embedding and no history the point ζ_0.
        U
            (T, nu) inputs; (T, 0) for an autonomous predictor.
        W
            (T, nw) measured disturbances; zero by default.
        history
            The steps that led to x0, its last row x0 itself; only with an embedding.
        """
        inputs = checks.array(U, "U", (None, self.nu))
        start = self.start(x0, history)
        Z = np.empty((len(inputs) + 1, self.nz))
        Z[0] = self.lifting(start)
        Z[1:] = inputs @ self.B.T
        if W is not None:
            Z[1:] += checks.array(W, "W", (len(inputs), self.nw)) @ self.E.T
        transposed, rows = self.A.T, list(Z)
        for z, z_next in pairwise(rows):  # z_next += A z in place: BLAS has no faster way for one vector
            dgemv(1.0, transposed, z, 1.0, z_next, 0, 1, 0, 1, 1, 1)
        X = Z @ self.C.T
        X[0] = start[: self.nx]
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C (A ψ(x) + B u) as a StepMap, for simulation and nonlinear MPC; w is 0.

        With an embedding it is a map of ζ: ζ⁺ = [C (A ψ(ζ) + B u), u, ζ without its oldest step].
        """
        x, u = ca.SX.sym("x", len(self.point_names)), ca.SX.sym("u", self.nu)
        x_next = ca.DM(self.C @ self.A) @ self.lifting.symbolic(x) + ca.DM(self.C @ self.B) @ u
        return self.as_step_map(x, u, x_next)

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
        """Return φ_j(x) = ξ_jᴴ ψ(x) at rows of states (M, nx), or of ζ: φ_j(x⁺) = λ_j φ_j(x) without input.

        Raises
        ------
        DataError
            A is defective.
        """
        Z = self.lifting(checks.array(X, "X", (None, len(self.point_names))))
        return Z @ self.left_eigenvectors.T

    @cached_property
    def _eigen(self) -> tuple[Complex[np.ndarray, " nz"], Complex[np.ndarray, "nz nz"]]:
        return eigen(self.A)

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
