"""The base class of lifted predictors: x ≈ C z, z₀ = ψ(x₀), the eigenvalues of A, the fit report, the file format."""

import json
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks, disk
from koopmpc.base.errors import DataError, Hint, LogError, ShapeError
from koopmpc.base.values import Arrays, Value, freeze, from_data, to_data
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import Lifting

V = TypeVar("V", bound=Value)
_FORMAT = "koopmpc-1"


def save_value(value: Value, path: str | Path) -> None:
    """Write `value` as .npz: float arrays as they are, everything else as JSON; nothing is pickled."""
    arrays: Arrays = {}
    tree = {"format": _FORMAT, "value": to_data(value, arrays)}
    text = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
    with disk.writing(path) as file:
        np.savez_compressed(file, allow_pickle=False, tree=text, **arrays)


def load_value(path: str | Path, *kinds: type[V]) -> V:
    """Read a Value of one of these kinds that `save_value` wrote."""
    wanted = " or ".join(kind.__name__.removeprefix("Saved") for kind in kinds)
    advice = f"pass the .npz of a saved {wanted}"
    source = disk.existing(path, advice)
    try:
        with disk.Members(source) as arrays:
            arrays.require("tree")
            value = _build_value(arrays)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise LogError(f"{path} is damaged: the text in it cannot be read; {advice}") from error
    except (OSError, ValueError) as error:
        raise LogError(f"{path} is damaged, or koopmpc did not save it: {error}; {advice}") from error
    if not isinstance(value, kinds):
        raise LogError(f"{path} holds {checks.article(value)}, not a {wanted}")
    return value


def _build_value(arrays: disk.Members) -> object:
    """Return the object that the file's JSON text describes, with the arrays that it names."""
    tree = cast("object", json.loads(arrays["tree"].tobytes().decode()))
    node = cast("dict[str, object]", tree) if isinstance(tree, dict) else {}
    if node.get("format") != _FORMAT:
        raise LogError(f"it is not a {_FORMAT} file; save it again with this version")
    try:
        return from_data(node.get("value"), arrays)
    except LogError:
        raise
    except Exception as error:  # a damaged file passed a class wrong arguments
        raise LogError(f"it is damaged, or was made by hand: {error}") from error


_DEFECTIVE = 1e14  # A counts as defective if the condition number of its eigenvectors is above this


@dataclass(frozen=True, eq=False)
class FitReport(Value):
    """The report of a fit of z⁺ = A z + B u: method, conditioning, residuals and doubts.

    Attributes
    ----------
    method
        The function that fitted the model: "dmd", "dmdc", "edmd", "bilinear_edmd", ….
    route
        How the least squares was solved: "gram", "qr" or "svd", then the ridge, or the cut of singular values.
    samples
        Snapshot pairs M.
    condition
        Condition number of the regressors on unit-norm columns; inf if they are dependent.
    rank, columns
        Numerical rank of the regressors, and how many columns they have.
    ridge
        The Tikhonov weight, as in `edmd`.
    residual
        Root-mean-square one-step residual of each state, in the state's unit; the "gram" route resolves it to
        about 1e-8 of the state's size.
    state_residual
        Root-mean-square of x − C ψ(x) for each state: zero if the lifting holds the state itself.
    warnings
        Sentences, one for each doubt.
    changes
        Sentences, one for each change that a prior, a limit on the spectral radius or a penalty made.
    input_lead
        Rows by which the inputs of the log were moved up before the fit: the model's u_k is row k + input_lead of the
        log. 0 where a log's row holds the input that acts next.
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
    input_lead: int = 0


@dataclass(frozen=True, eq=False)
class Predictor(Value):
    """A model on lifted coordinates: z = ψ(x), x ≈ C z, and A z is the motion without input.

    Attributes
    ----------
    A
        (nz, nz), one step of `dt`.
    B
        (nz, nu); (nz, 0) for an autonomous system.
    C
        (nx, nz), back to the state.
    lifting
        ψ, bound to `states`, or to the names of ζ under an embedding.
    dt
        Sampling time [s].
    states, inputs
        Names with units.
    report
        Report of the fit; None for a model that was not fitted.
    embedding
        Makes the point ζ of x and its past; then z₀ = ψ(ζ₀). None without delays.
    scale
        (nz, nz) upper triangular R with RᵀR = Σ w z zᵀ / Σ w over the lifted data of the fit: R⁻ᵀ z has
        root-mean-square 1 in every direction. None for a model that was not fitted.
    nx, nu, nz
        How many states, inputs and lifted coordinates there are.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    C: Float[np.ndarray, "nx nz"]
    lifting: Lifting
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    report: FitReport | None
    embedding: Delay | None
    scale: Float[np.ndarray, "nz nz"] | None
    nx: int = field(init=False)
    nu: int = field(init=False)
    nz: int = field(init=False)

    predict = Hint("model.rollout(x0, U) forecasts from x0 under the rows of U")
    simulate = Hint("model.rollout(x0, U) forecasts from x0 under the rows of U")
    fit = Hint("a model is a result: km.edmd(episodes, lifting) returns one")
    score = Hint("km.score(model, episodes, horizon) measures its forecasts")

    @property
    def point_names(self) -> tuple[str, ...]:
        """Names of the arguments of ψ: the states, or the entries of ζ under an embedding."""
        return self.states if self.embedding is None else self.embedding.names

    def lift(self, x: ArrayLike, history: Episode | None = None) -> Float[np.ndarray, "*batch nz"]:
        """Return z = ψ(x) for one state (nx,) or rows of states (M, nx); with an embedding ψ(ζ).

        Parameters
        ----------
        x
            With an embedding one state (nx,) and its history, or points ζ, (nζ,) or (M, nζ).
        history
            The steps that led to x; its last row is x. Only with an embedding.

        Raises
        ------
        DataError
            There is an embedding and no history, or a history and no embedding.
        """
        return self.lifting(self._point(checks.array(x, "x"), history))

    def rest_point(self, x: ArrayLike) -> Float[np.ndarray, " npoint"]:
        """Return the point ζ of a plant that has rested in x without input; without an embedding it is x itself."""
        state = checks.array(x, "x", (self.nx,))
        return state if self.embedding is None else self.embedding.repeat(state, np.zeros(self.nu))

    def embed(self, episodes: Episodes) -> Episodes:
        """Return the episodes of points ζ, the states first in each row; without an embedding, the same episodes."""
        return episodes if self.embedding is None else self.embedding(episodes)

    @property
    def input_lead(self) -> int:
        """Rows by which inputs of logs like those of the fit are moved up, see `align`; 0 for most logs."""
        return 0 if self.report is None else self.report.input_lead

    def align(self, episodes: Episodes) -> Episodes:
        """Return episodes of a log with the model's timing: their inputs are moved up by `input_lead` rows."""
        return episodes.with_inputs_advanced(self.input_lead)

    def save(self, path: str | Path) -> None:
        """Write the predictor as data (.npz: arrays and one JSON text); `load_model` reads it."""
        save_value(self, path)

    def start(self, x0: ArrayLike, history: Episode | None = None) -> Float[np.ndarray, " npoint"]:
        """Return the first point of a rollout: x0, or with an embedding ζ_0, which x0 is or x0 and its history give."""
        point = self._point(checks.array(x0, "x0"), history)
        return checks.array(point, "x0", (len(self.point_names),))

    @cached_property
    def eigenvalues(self) -> Complex[np.ndarray, " nz"]:
        """Eigenvalues of A, the motion without input, the largest magnitude first."""
        return self._eigen[0]

    @property
    def eigenvectors(self) -> Complex[np.ndarray, "nz nz"]:
        """Right eigenvectors v_j of A, one a column, with norm 1, in the order of `eigenvalues`."""
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
        return sorted_eigen(self.A)

    def _clip(self, X: Float[np.ndarray, "rows nx"]) -> Float[np.ndarray, "rows nx"]:
        return X if self.embedding is None else self.embedding.clip(X)

    def _point(self, x: Float[np.ndarray, "..."], history: Episode | None) -> Float[np.ndarray, "..."]:
        if self.embedding is None:
            if history is not None:
                raise DataError("history was passed, but the predictor has no embedding; leave it out")
            return x
        if history is not None:
            if x.shape != (self.nx,):
                raise ShapeError(f"x has shape {x.shape}, expected ({self.nx},) with a history")
            return self.embedding.point(x, history)
        if x.shape[-1:] == (self.nx,):
            raise DataError(
                f"the predictor remembers {self.embedding.steps} steps: pass history=Episode(X=…, U=…) that ends at x, "
                "or predictor.rest_point(x) for a plant at rest there"
            )
        return x


P = TypeVar("P", bound=Predictor)


def change_model(model: P, **fields: object) -> P:
    """Return the same model with other matrices or another report; what was computed from the old ones goes."""
    other, kind = copy(model), type(model)
    for name in [name for name in vars(other) if isinstance(getattr(kind, name, None), cached_property)]:
        del vars(other)[name]
    freeze(other, **fields)
    return other


def sorted_eigen(A: Float[np.ndarray, "nz nz"]) -> tuple[Complex[np.ndarray, " nz"], Complex[np.ndarray, "nz nz"]]:
    """Return eigenvalues of A, the largest magnitude first, and its right eigenvectors, one a column."""
    result = np.linalg.eig(A)
    values, vectors = np.asarray(result.eigenvalues, complex), np.asarray(result.eigenvectors, complex)
    order = np.lexsort((np.imag(values), -np.abs(values)))
    return values[order], vectors[:, order]
