"""The predictors: z⁺ = A z + B u + E w, and z⁺ = A z + B u + Σ uᵢ Nᵢ z; x ≈ C z, z₀ = ψ(x₀).

`load_model` reads one from a file, `from_peer` takes one over from another package.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from scipy.linalg.blas import dgemv

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.lifting.composed import Projected
from koopmpc.lifting.state import Constant, Numeric, State
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.base import FitReport, Predictor, load_value
from koopmpc.values import freeze

_PROBES = 7  # states at which liftings of two packages are compared
_LARGEST = 1e300  # entry of A: sums of as many as it has are finite


@dataclass(frozen=True, eq=False, init=False)
class LinearPredictor(Predictor):
    """A lifted linear predictor z⁺ = A z + B u + E w, x ≈ C z, z₀ = ψ(x₀), w disturbances that are measured.

    Attributes
    ----------
    A, B, C, lifting, dt, states, inputs, report, embedding, scale
        Those of every `Predictor`: A is (nz, nz), B (nz, nu), C (nx, nz), names have units, dt is in seconds.
    exact_modes
        (nl, nz) exact DMD modes X′ V Σ⁻¹ W in the observables of the unreduced lifting, one a column, where a
        rank-truncated fit computed them; its `lifting` is then a Projected one.
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
        exact_modes: Complex[np.ndarray, "nl nz"] | None = None,
        E: ArrayLike | None = None,
        disturbances: Sequence[str] | None = None,
        embedding: Delay | None = None,
        scale: ArrayLike | None = None,
    ) -> None:
        _store(self, A, B, C, lifting, dt, states, inputs, report, embedding, scale)
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
        freeze(self, exact_modes=modes, E=drift, disturbances=names, nw=nw)

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
        return _re_lifted(self, ())

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


@dataclass(frozen=True, eq=False, init=False)
class BilinearPredictor(Predictor):
    """A lifted bilinear predictor z⁺ = A z + B u + Σ uᵢ Nᵢ z, x ≈ C z, z₀ = ψ(x₀).

    What an input does may depend on the state, as it does wherever a force turns with the body that it acts on;
    a linear predictor has one B for all states.

    Attributes
    ----------
    A, B, C, lifting, dt, states, inputs, report, embedding, scale
        Those of every `Predictor`: A is (nz, nz), B (nz, nu), C (nx, nz), names have units, dt is in seconds.
    N
        (nu, nz, nz), one matrix for each input.

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
        scale: ArrayLike | None = None,
    ) -> None:
        _store(self, A, B, C, lifting, dt, states, inputs, report, embedding, scale)
        freeze(self, N=checks.array(N, "N", (len(inputs), self.nz, self.nz)))

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
        return _re_lifted(self, self.N)


def load_model(path: str | Path) -> LinearPredictor | BilinearPredictor:
    """Read a predictor that its `save` wrote, of whichever kind; runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or no predictor.
    """
    return load_value(path, LinearPredictor, BilinearPredictor)


def _store(
    predictor: Predictor,
    A: ArrayLike,
    B: ArrayLike,
    C: ArrayLike,
    lifting: Lifting,
    dt: float,
    states: Sequence[str],
    inputs: Sequence[str],
    report: FitReport | None,
    embedding: Delay | None,
    scale: ArrayLike | None,
) -> None:
    """Check the fields that all predictors share and store them."""
    states, inputs = checks.texts(states, "states"), checks.texts(inputs, "inputs")
    embedded = None if embedding is None else embedding.bind(states, inputs)
    bound = lifting_of(lifting).bind(states if embedded is None else embedded.names)
    nz, nx, nu = bound.nz, len(states), len(inputs)
    transition = checks.array(A, "A")
    largest = float(np.abs(transition).max(initial=0.0))
    if largest > _LARGEST:
        raise DataError(f"A holds {largest:.3g}, with which nothing can be computed; scale the states, or fit anew")
    if transition.shape != (nz, nz):
        raise ShapeError(
            f"A has shape {transition.shape}, but the lifting returns {nz} observables; "
            "pass the lifting used in the fit"
        )
    freeze(
        predictor,
        A=transition,
        B=checks.array(B, "B", (nz, nu)),
        C=checks.array(C, "C", (nx, nz)),
        lifting=bound,
        dt=checks.positive(dt, "dt", "s"),
        states=states,
        inputs=inputs,
        report=report,
        embedding=embedded,
        scale=None if scale is None else _triangular(scale, nz),
        nx=nx,
        nu=nu,
        nz=nz,
    )


def _triangular(scale: ArrayLike, nz: int) -> Float[np.ndarray, "nz nz"]:
    """Return the scale, checked: upper triangular, with no zero on its diagonal."""
    R = checks.array(scale, "scale", (nz, nz))
    if np.tril(R, -1).any() or not R.diagonal().all():
        raise DataError(
            "scale is not upper triangular with a diagonal that nowhere is 0; pass the triangular factor of the lifted "
            "data, np.linalg.qr(Z, mode='r') / sqrt(len(Z)), or leave it out"
        )
    return R


def _re_lifted(predictor: Predictor, N: Sequence[Float[np.ndarray, "nz nz"]] | np.ndarray) -> StepMap:
    """Return x⁺ = C (A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)) as a StepMap of the point that ψ acts on."""
    x, u = ca.SX.sym("x", len(predictor.point_names)), ca.SX.sym("u", predictor.nu)
    C, z = predictor.C, predictor.lifting.symbolic(x)
    x_next = ca.DM(C @ predictor.A) @ z + ca.DM(C @ predictor.B) @ u
    for i, Ni in enumerate(N):
        x_next += u[i] * (ca.DM(C @ Ni) @ z)
    moved = x_next if predictor.embedding is None else predictor.embedding.symbolic(x, u, x_next)
    F = ca.Function("F", [x, u], [ca.densify(moved)], ["x", "u"], ["x_next"], {"cse": True})
    return StepMap(F, predictor.dt, states=predictor.point_names, inputs=predictor.inputs)


def from_peer(
    fitted: Any,
    *,
    dt: float,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    lifting: Lifting | None = None,
) -> LinearPredictor:
    """Return a model of PyDMD (DMD and its kin, DMDc) or a KoopmanPipeline of pykoop as a LinearPredictor.

    A model that was found by hand needs no help: ``km.LinearPredictor(A, B, C, lifting, dt, states, inputs)``.

    Parameters
    ----------
    fitted
        The fitted object. Of PyDMD A = Φ Λ Φ⁺ and B are taken, on the state; of pykoop A and B of its regressor, on
        its lifting.
    dt
        Sample time [s], of which these packages know nothing.
    states, inputs
        Names with units; by default ``x0, x1, …`` and ``u0, u1, …``.
    lifting
        The same lifting in the families of koopmpc, where a formula is needed or the model is to be saved. It is
        compared with the package's own at a few states.

    Raises
    ------
    DataError
        It is of no known package or not fitted; it has delays, or lifts its inputs; its lifting does not hold the
        states; `lifting` is another function.
    """
    if hasattr(fitted, "regressor_") and hasattr(fitted, "lift_state"):
        return _of_pykoop(fitted, dt, states, inputs, lifting)
    if hasattr(fitted, "eigs") and hasattr(fitted, "modes"):
        return _of_pydmd(fitted, dt, states, inputs)
    raise DataError(
        f"a {type(fitted).__name__} is no fitted DMD of PyDMD nor a fitted KoopmanPipeline of pykoop; with its "
        "matrices km.LinearPredictor(A, B, C, lifting, dt, states, inputs) is the model"
    )


def _of_pydmd(fitted: Any, dt: float, states: Sequence[str] | None, inputs: Sequence[str] | None) -> LinearPredictor:
    """Return x⁺ = Φ Λ Φ⁺ x + B u."""
    try:
        modes, eigenvalues = np.asarray(fitted.modes), np.asarray(fitted.eigs)
    except (ValueError, AttributeError) as error:
        raise DataError(f"the {type(fitted).__name__} is not fitted; call its fit first") from error
    A = (modes * eigenvalues) @ np.linalg.pinv(modes)
    nx = len(A)
    if np.abs(A.imag).max() > 1e-9 * np.abs(A).max():
        raise DataError("its operator Φ Λ Φ⁺ is not real; fit it to real snapshots")
    known = getattr(fitted, "B", None)
    B = np.zeros((nx, 0)) if known is None else np.asarray(known, dtype=np.float64)
    return LinearPredictor(A.real, B, np.eye(nx), State(), dt, _names(states, "x", nx), _names(inputs, "u", B.shape[1]))


def _of_pykoop(
    fitted: Any, dt: float, states: Sequence[str] | None, inputs: Sequence[str] | None, lifting: Lifting | None
) -> LinearPredictor:
    """Return z⁺ = A z + B u of the regressor, z = ψ(x) of the pipeline's lifting functions."""
    nx, nu, nz = fitted.n_states_in_, fitted.n_inputs_in_, fitted.n_states_out_
    if fitted.min_samples_ > 1:
        raise DataError(
            "the pipeline has delays; fit km.edmd(data, lifting, embedding=km.Delay(…)), which has them too"
        )
    if fitted.n_inputs_out_ != nu:
        raise DataError(
            f"the pipeline makes {fitted.n_inputs_out_} inputs of {nu}: it lifts them. Lift the states alone, in a "
            "pykoop.SplitPipeline with lifting_functions_input=None"
        )
    matrix = np.asarray(fitted.regressor_.coef_, dtype=np.float64).T
    named = _names(states, "x", nx)

    def lift(X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M nz"]:
        return np.asarray(fitted.lift_state(X, episode_feature=False), dtype=np.float64)

    probes = np.random.default_rng(0).uniform(-1.0, 1.0, (_PROBES, nx))
    Z = lift(probes)
    C = np.zeros((nx, nz))
    for i, column in enumerate(probes.T):
        equal = np.flatnonzero(np.abs(Z - column[:, None]).max(axis=0) < 1e-9)
        if not len(equal):
            raise DataError(f"the pipeline's lifting does not hold {named[i]}; keep the states among its observables")
        C[i, equal[0]] = 1.0
    if lifting is None:
        lifting = Numeric(lift, tuple(f"z{j}" for j in range(nz)))
    else:
        own = lifting.bind(named)(probes)
        if own.shape != Z.shape or not np.allclose(own, Z, rtol=1e-9, atol=1e-9):
            raise DataError(
                "lifting has other observables than the pipeline, or another order: "
                f"{', '.join(lifting.bind(named).names)}"
            )
    return LinearPredictor(matrix[:, :nz], matrix[:, nz:], C, lifting, dt, named, _names(inputs, "u", nu))


def _names(given: Sequence[str] | None, letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i}" for i in range(count)) if given is None else tuple(given)
