"""The predictors: z⁺ = A z + B u + E w, and z⁺ = A z + B u + Σ uᵢ Nᵢ z; x ≈ C z, z₀ = ψ(x₀).

`load_model` reads one from a file.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from scipy.linalg.blas import dgemv

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import freeze
from koopmpc.data.episodes import Episode
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected
from koopmpc.lifting.state import Constant, State
from koopmpc.models import hidden_state as hidden_state  # a file names its class, which must be known by then
from koopmpc.models.base import FitReport, Predictor, load_value
from koopmpc.models.parts import (
    BilinearFields,
    LinearFields,
    build_step_map,
    check_drift,
    read_state_space,
    refuse_unknown,
    store_fields,
)
from koopmpc.plants.step_map import StepMap


@dataclass(frozen=True, eq=False, init=False)
class LinearPredictor(Predictor):
    """A lifted linear predictor z⁺ = A z + B u + E w, x ≈ C z, z₀ = ψ(x₀), with measured disturbances w.

    Attributes
    ----------
    A, B, C, lifting, dt, states, inputs, report, embedding, scale
        Those of every `Predictor`: A is (nz, nz), B (nz, nu), C (nx, nz), names have units, dt is in seconds.
    exact_modes
        (nl, nz) exact DMD modes X′ V Σ⁻¹ W of a rank-truncated fit, one a column, in the observables of the unreduced
        lifting; `lifting` is then a Projected one. None for other models.
    E
        (nz, nw); (nz, 0) without measured disturbances.
    disturbances
        Names of w with units; ``w0, w1, …`` by default.
    nw
        How many disturbances there are.

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
    nw: int = field(init=False)

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
        **parts: Unpack[LinearFields],
    ) -> None:
        refuse_unknown(parts, LinearFields)
        store_fields(self, (A, B, C), lifting, dt, (states, inputs), report, parts)
        modes = parts.get("exact_modes")
        if modes is not None:
            if not isinstance(self.lifting, Projected) or modes.shape != self.lifting.basis.shape:
                raise ShapeError(
                    f"exact_modes has shape {modes.shape}; it needs a Projected lifting with a basis of that shape"
                )
            modes = np.array(modes, dtype=np.complex128, order="C")
        freeze(self, exact_modes=modes, **check_drift(self.nz, parts))

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
        for z, z_next in pairwise(rows):  # z_next += A z in place, the fastest BLAS call for one vector
            dgemv(1.0, transposed, z, 1.0, z_next, 0, 1, 0, 1, 1, 1)
        X = self._clip(Z @ self.C.T)
        X[0] = start[: self.nx]
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C (A ψ(x) + B u + E w) as a StepMap, for simulation and nonlinear MPC.

        With an embedding it is a map of ζ: ζ⁺ = [C (A ψ(ζ) + B u + E w), u, ζ without its oldest step].
        """
        return build_step_map(self, self.E, self.disturbances)

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

    @classmethod
    def from_state_space(
        cls,
        system: Any,
        *,
        dt: float | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
    ) -> "LinearPredictor":
        """Return x⁺ = A x + B u of a system of scipy.signal or python-control as a predictor.

        The state is x itself, measured as a whole: C of the system chooses nothing here. Track its outputs y = C x by a
        `Cost` with Q = CᵀQ_y C. Names are those of python-control, or ``x0, …`` and ``u0, …``.

        Parameters
        ----------
        system
            Discrete, or continuous with `dt`: then it is sampled with a zero-order hold.
        dt
            Sample time [s] of a continuous system.
        states, inputs
            Names with units.

        Raises
        ------
        DataError
            It is no state-space system, has feedthrough, or its sample time is unknown.

        Examples
        --------
        >>> import koopmpc as km
        >>> import scipy.signal
        >>> mass = scipy.signal.StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
        >>> model = km.LinearPredictor.from_state_space(mass, dt=0.1)
        >>> model.A.tolist()
        [[1.0, 0.1], [0.0, 1.0]]
        """
        A, B, step, names, pushes = read_state_space(system, dt, states, inputs)
        return cls(A, B, np.eye(len(A)), State(), step, names, pushes)

    def to_state_space(self) -> Any:
        """Return z⁺ = A z + B u, x = C z as a scipy.signal.dlti; ``control.ss(system)`` takes its matrices."""
        from scipy.signal import dlti  # slow to import

        make: Any = dlti  # its stubs call it abstract
        return make(self.A, self.B, self.C, np.zeros((self.nx, self.nu)), dt=self.dt)

    @classmethod
    def local(cls, step_map: StepMap, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None) -> "LinearPredictor":
        """Return the linearisation x⁺ = A x + B u + E w + c at (x, u, w) as a predictor on State() + Constant().

        Exact Jacobians of `step_map`; c = F(x, u, w) − A x − B u − E w, so (x, u) need not be an equilibrium.
        """
        affine = step_map.linearize(x, u, w)
        nx, nu = affine.B.shape
        A = np.eye(nx + 1)
        A[:nx, :nx], A[:nx, nx] = affine.A, affine.c
        B = np.vstack([affine.B, np.zeros((1, nu))])
        C = np.eye(nx, nx + 1)
        E = np.vstack([affine.E, np.zeros((1, step_map.nw))])
        names = step_map.dt, step_map.states, step_map.inputs
        return cls(A, B, C, State() + Constant(), *names, E=E, disturbances=step_map.disturbances)


@dataclass(frozen=True, eq=False, init=False)
class BilinearPredictor(Predictor):
    """A lifted bilinear predictor z⁺ = A z + (B + Σ wⱼ Mⱼ) u + E w + Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z, x ≈ C z, z₀ = ψ(x₀).

    The effect of an input may depend on the state, as for a force that turns with the body on which it acts. A linear
    predictor has one B for all states. Measured disturbances w act alike: with S and M they are scheduling signals of
    a linear parameter-varying model, A(w) and B(w).

    Attributes
    ----------
    A, B, C, lifting, dt, states, inputs, report, embedding, scale
        Those of every `Predictor`: A is (nz, nz), B (nz, nu), C (nx, nz), names have units, dt is in seconds.
    N
        (nu, nz, nz), one matrix for each input.
    E, S, disturbances, nw
        (nz, nw) and (nw, nz, nz), the effects of the measured disturbances w, their names, and how many there are.
    M
        (nw, nz, nu), how w changes B.

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
    E: Float[np.ndarray, "nz nw"]
    S: Float[np.ndarray, "nw nz nz"]
    M: Float[np.ndarray, "nw nz nu"]
    disturbances: tuple[str, ...]
    nw: int = field(init=False)

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
        **parts: Unpack[BilinearFields],
    ) -> None:
        refuse_unknown(parts, BilinearFields)
        store_fields(self, (A, B, C), lifting, dt, (states, inputs), report, parts)
        nz, nu, drift, S, M = self.nz, self.nu, check_drift(self.nz, parts), parts.get("S"), parts.get("M")
        nw = drift["nw"]
        schedule = np.zeros((nw, nz, nz)) if S is None else checks.bounded(S, "S", (nw, nz, nz))
        steer = np.zeros((nw, nz, nu)) if M is None else checks.bounded(M, "M", (nw, nz, nu))
        freeze(self, N=checks.bounded(N, "N", (nu, nz, nz)), S=schedule, M=steer, **drift)

    @property
    def is_scheduled(self) -> bool:
        """Whether a measured disturbance multiplies the state or an input."""
        return bool(self.S.any()) or self.multiplies_inputs

    @property
    def multiplies_inputs(self) -> bool:
        """Whether a measured disturbance multiplies an input."""
        return bool(self.M.any())

    def at(self, w: ArrayLike) -> "BilinearPredictor":
        """Return the model without measured disturbances for constant ones, w: A + Σ wⱼ Sⱼ for A, B + Σ wⱼ Mⱼ for B.

        The part E w is added to it, and needs a `Constant` among the observables.

        Raises
        ------
        DataError
            The lifting has no Constant, and E w is not zero.
        """
        values, constant = checks.array(w, "w", (self.nw,)), self.lifting.constant_index
        A, push = self.A + np.tensordot(values, self.S, 1), self.E @ values
        if constant is None and push.any():
            raise DataError("a constant w pushes the state, which needs a Constant; add km.Constant() to the lifting")
        if constant is not None:
            A[:, constant] += push
        about = (self.C, self.lifting, self.dt, self.states, self.inputs, self.report)
        B = self.B + np.tensordot(values, self.M, 1)
        return BilinearPredictor(A, B, self.N, *about, embedding=self.embedding, scale=self.scale)

    def rollout(
        self, x0: ArrayLike, U: ArrayLike, W: ArrayLike | None = None, *, history: Episode | None = None
    ) -> Float[np.ndarray, "steps nx"]:
        """Return x_k ≈ C z_k of z_{k+1} = (A + Σ uᵢ Nᵢ + Σ wⱼ Sⱼ) z_k + (B + Σ wⱼ Mⱼ) u_k + E w_k, z_0 = ψ(x0).

        Parameters
        ----------
        x0
            (nx,) initial state; with an embedding and no history the point ζ_0.
        U
            (T, nu) inputs.
        W
            (T, nw) measured disturbances; zero by default.
        history
            The steps that led to x0, its last row x0 itself; only with an embedding.
        """
        inputs = checks.array(U, "U", (None, self.nu))
        rows = np.zeros((len(inputs), self.nw)) if W is None else checks.array(W, "W", (len(inputs), self.nw))
        start = self.start(x0, history)
        Z = np.empty((len(inputs) + 1, self.nz))
        Z[0] = self.lifting(start)
        for k, u in enumerate(inputs):
            Z[k + 1] = self.A @ Z[k] + self.B @ u + u @ (self.N @ Z[k])
            if self.nw:
                Z[k + 1] += self.E @ rows[k] + rows[k] @ (self.S @ Z[k] + self.M @ u)
        X = self._clip(Z @ self.C.T)
        X[0] = start[: self.nx]
        return X

    def step_map(self) -> StepMap:
        """Return the re-lifted map x⁺ = C ((A + Σ uᵢ Nᵢ + Σ wⱼ Sⱼ) ψ(x) + (B + Σ wⱼ Mⱼ) u + E w) as a StepMap.

        With an embedding it is a map of ζ, whose past w does not move.
        """
        return build_step_map(self, self.E, self.disturbances, self.N, self.S, self.M)


def relift_rollout(
    predictor: LinearPredictor | BilinearPredictor,
    x0: Float[np.ndarray, " n"],
    U: Float[np.ndarray, "T nu"],
    W: Float[np.ndarray, "T nw"],
) -> Float[np.ndarray, "T1 n"]:
    """Return the states, or points under an embedding, of forecasts that are lifted afresh at every step."""
    return predictor.step_map().rollout(x0, U, W if predictor.nw else None)


def load_model(path: str | Path) -> LinearPredictor | BilinearPredictor:
    """Read a LinearPredictor or a BilinearPredictor that its `save` wrote; this runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or does not hold a predictor.
    """
    return load_value(path, LinearPredictor, BilinearPredictor)
