"""Models that another package fitted, or that were found by hand, as predictors that controllers take."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.errors import DataError, ObservableError
from koopmpc.lifting.base import HUGE, Lifting
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value, freeze

_PROBES = 7  # states at which liftings are compared
RowFunction = Callable[[Float[np.ndarray, "M nx"]], Float[np.ndarray, "M nz"]]


@dataclass(frozen=True, eq=False)
class Numeric(Lifting):
    """ψ(x) = fn(x), a function of numbers: rows (M, nx) to rows (M, nz).

    `LQR` and `KoopmanMPC` need no more. What linearises the lifting, such as `BilinearMPC` or an equilibrium that is
    not the origin, and every file needs a formula: write ψ as `Expressions`.

    Parameters
    ----------
    fn
        Takes (M, nx) states and returns (M, nz) observables.
    labels
        The name of each observable.
    """

    fn: RowFunction
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze(self, labels=tuple(self.labels))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names given."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Raise: numbers have no formula."""
        raise ObservableError(
            "this lifting is a function of numbers, and a formula is needed here; write it with km.Expressions or the "
            "families of koopmpc, and pass it as lifting="
        )

    def measured(self) -> ca.Function:
        """Return ψ of one measured state, as a CasADi function that calls Python."""
        return _Called(self)

    def as_saved(self) -> Value:
        """Refuse: a file holds no function."""
        raise DataError("the lifting is a Python function, which no file holds; write it with km.Expressions")

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        found = np.asarray(self.fn(np.ascontiguousarray(x.T)), dtype=np.float64)
        if found.shape != Z.shape:
            raise DataError(f"the lifting returns shape {found.shape} for {Z.shape[0]} states, expected {Z.shape}")
        Z[:] = found


class _Called(ca.Callback):
    """ψ of one state, NaN where the state is NaN or beyond 1e30."""

    def __init__(self, lifting: Numeric) -> None:
        super().__init__()
        self._lifting, self._nx, self._nz = lifting, len(lifting.bound_states), lifting.nz
        self.construct("psi", {})

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return that of a column of states."""
        return ca.Sparsity.dense(self._nx, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Return that of a column of observables."""
        return ca.Sparsity.dense(self._nz, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """Return [ψ(x)]."""
        x = np.array(arg[0]).reshape(1, self._nx)
        z = self._lifting(x)[0] if np.abs(x).sum() < HUGE else np.full(self._nz, np.nan)
        return [ca.DM(z)]


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
