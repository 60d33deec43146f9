"""What all lifted predictors share: x ≈ C z, z₀ = ψ(x₀), names, an embedding, and files."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.files.npz import read_arrays
from koopmpc.errors import DataError, LogError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.plants.step_map import StepMap
from koopmpc.values import Arrays, Value, from_data, to_data


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


V = TypeVar("V", bound=Value)
_FORMAT = "koopmpc-1"


def save_value(value: Value, path: str | Path) -> None:
    """Write `value` as .npz: float arrays as they are, everything else as JSON; nothing is pickled.

    Raises
    ------
    LogError
        The path cannot be written.
    """
    arrays: Arrays = {}
    tree = {"format": _FORMAT, "value": to_data(value, arrays)}
    text = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
    with checks.writing(path) as file:
        np.savez_compressed(file, allow_pickle=False, tree=text, **arrays)


def load_value(path: str | Path, *kinds: type[V]) -> V:
    """Read a Value of one of these kinds that `save_value` wrote.

    Raises
    ------
    LogError
        The file is missing, a folder, damaged, or holds something else.
    """
    wanted = " or ".join(kind.__name__ for kind in kinds)
    advice = f"pass the .npz of a saved {wanted}"
    source = checks.existing(path, advice)
    try:
        arrays = read_arrays(source, ("tree",))
        tree = cast("object", json.loads(arrays.pop("tree").tobytes().decode()))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise LogError(f"{path} is damaged: the text in it cannot be read; {advice}") from error
    except (OSError, ValueError) as error:
        raise LogError(f"{path} is no file that koopmpc saved, or is damaged: {error}; {advice}") from error
    node = cast("dict[str, object]", tree) if isinstance(tree, dict) else {}
    if node.get("format") != _FORMAT:
        raise LogError(f"{path} is no {_FORMAT} file; save it again with this version")
    try:
        value = from_data(node.get("value"), arrays)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    except Exception as error:  # a class met something that it was never meant to hold
        raise LogError(f"{path} is damaged, or was made by hand: {error}") from error
    if not isinstance(value, kinds):
        raise LogError(f"{path} holds a {type(value).__name__}, not a {wanted}")
    return value


@dataclass(frozen=True, eq=False, init=False)
class Predictor(Value):
    """z = ψ(x), or z = ψ(ζ) where an embedding makes ζ of x and its past; x ≈ C z, and A and B move z."""

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    C: Float[np.ndarray, "nx nz"]
    lifting: Lifting
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    report: FitReport | None
    embedding: Delay | None

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
        embedding: Delay | None = None,
    ) -> None:
        embedded = None if embedding is None else embedding.bind(states, inputs)
        bound = lifting.bind(tuple(states) if embedded is None else embedded.names)
        nz, nx, nu = bound.nz, len(states), len(inputs)
        transition = checks.array(A, "A")
        if transition.shape != (nz, nz):
            raise ShapeError(
                f"A has shape {transition.shape}, but the lifting returns {nz} observables; "
                "pass the lifting used in the fit"
            )
        self._set(
            A=transition,
            B=checks.array(B, "B", (nz, nu)),
            C=checks.array(C, "C", (nx, nz)),
            lifting=bound,
            dt=checks.positive(dt, "dt", "s"),
            states=tuple(states),
            inputs=tuple(inputs),
            report=report,
            embedding=embedded,
        )

    def _set(self, **values: object) -> None:
        for name, value in values.items():
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
    def point_names(self) -> tuple[str, ...]:
        """Names of what ψ acts on: the states, or those of ζ under an embedding."""
        return self.states if self.embedding is None else self.embedding.names

    def lift(self, x: ArrayLike, history: Episode | None = None) -> Float[np.ndarray, "*batch nz"]:
        """Return z = ψ(x) for one state (nx,) or rows of states (M, nx); with an embedding ψ(ζ).

        Parameters
        ----------
        x
            With an embedding one state (nx,) and its history, or points ζ, (nζ,) or (M, nζ).
        history
            The steps that led to x, its last row x itself; only with an embedding.

        Raises
        ------
        DataError
            There is an embedding and no history, or a history and no embedding.
        """
        return self.lifting(self._point(checks.array(x, "x"), history))

    def held(self, x: ArrayLike) -> Float[np.ndarray, " npoint"]:
        """Return the point of a plant that has been at rest in x without input: x itself without an embedding."""
        state = checks.array(x, "x", (self.nx,))
        return state if self.embedding is None else self.embedding.held(state, np.zeros(self.nu))

    def embed(self, episodes: Episodes) -> Episodes:
        """Return the episodes of what ψ acts on, the states first in each row: themselves without an embedding."""
        return episodes if self.embedding is None else self.embedding(episodes)

    def save(self, path: str | Path) -> None:
        """Write the predictor as data (.npz: arrays and one JSON text); its load function reads it."""
        save_value(self, path)

    def start(self, x0: ArrayLike, history: Episode | None = None) -> Float[np.ndarray, " npoint"]:
        """Return the point that a rollout starts from: x0, or ζ_0 of x0 and its history, or a ζ_0 that x0 is."""
        point = self._point(checks.array(x0, "x0"), history)
        return checks.array(point, "x0", (len(self.point_names),))

    def as_step_map(self, x: ca.SX, u: ca.SX, x_next: ca.SX) -> StepMap:
        """Return x⁺, on symbols of the point x and of u, as a StepMap of the point."""
        moved = x_next if self.embedding is None else self.embedding.symbolic(x, u, x_next)
        F = ca.Function("F", [x, u], [ca.densify(moved)], ["x", "u"], ["x_next"], {"cse": True})
        return StepMap(F, self.dt, states=self.point_names, inputs=self.inputs)

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
                "or predictor.held(x) for a plant at rest there"
            )
        return x
