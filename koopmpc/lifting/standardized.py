"""Standardized: a lifting of states that are centred and scaled."""

from collections.abc import Sequence
from dataclasses import dataclass
from zlib import crc32

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import CONSTANT, Lifting, lifting_of
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False, init=False)
class Standardized(Lifting):
    """ψ(x) = inner((x − mean) / scale): the inner lifting sees states of mean 0 and spread 1.

    A lifting with a width or a distance (Gaussian, ThinPlate, RandomFourier) then weighs every state alike, whatever
    its unit, and its centres and widths are in standard deviations. `Standardized.of(episodes, lifting)` computes mean
    and scale from data.

    Parameters
    ----------
    lifting
        The inner lifting.
    mean, scale
        (nx,) in the states' units; scale above zero.

    Raises
    ------
    ShapeError
        Mean and scale have not one entry for each state.
    DataError
        A scale is not above zero.
    """

    lifting: Lifting
    mean: Float[np.ndarray, " nx"]
    scale: Float[np.ndarray, " nx"]

    def __init__(
        self, lifting: Lifting, mean: ArrayLike, scale: ArrayLike, *, bound: tuple[str, ...] | None = None
    ) -> None:
        center = checks.array(mean, "mean", (None,))
        spread = checks.array(scale, "scale", center.shape)
        if (spread <= 0).any():
            raise DataError(f"scale holds {spread.min():g}; it must be above zero for every state")
        freeze(self, lifting=lifting_of(lifting), mean=center, scale=spread, bound=bound)

    @classmethod
    def of(cls, episodes: Episodes | Source, lifting: Lifting) -> "Standardized":
        """Return the lifting standardized by the mean and the standard deviation of the states in these data.

        The states are x_0 … x_{T−1} of each episode, read part by part. A state that does not move keeps its unit:
        its scale is 1.

        Raises
        ------
        DataError
            The source can be read once only, and the fit needs it too.
        """
        source = source_of(episodes)
        if not source.replayable:
            raise DataError("a stream is read once, by the fit; take Standardized.of from some episodes of it")
        rows, mean, squares = 0, np.zeros(source.nx), np.zeros(source.nx)
        for part in source.parts():
            for episode in part.load():  # Chan, Golub & LeVeque 1983: two means and sums of squares become one
                X = episode.X[:-1]
                own, rows = X.mean(axis=0), rows + len(X)
                step = (own - mean) * len(X) / rows
                squares += ((X - own) ** 2).sum(axis=0) + (own - mean) * step * (rows - len(X))
                mean = mean + step
        scale = np.sqrt(squares / max(rows, 1))
        still = scale <= 1e-12 * np.abs(mean)
        return cls(lifting, mean, np.where(still, 1.0, scale))

    def bind(self, states: Sequence[str]) -> "Standardized":
        """Return the copy on the bound inner lifting."""
        if len(states) != len(self.mean):
            raise ShapeError(
                f"mean and scale have {len(self.mean)} entries and there are {len(states)} states "
                f"({', '.join(states)}); standardize by data of these states"
            )
        bound = Standardized(self.lifting.bind(states), self.mean, self.scale, bound=tuple(states))
        _ = bound.names
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the inner names with ``~`` and a checksum of mean and scale: other numbers give other observables."""
        tag = f"~{crc32(self.mean.tobytes() + self.scale.tobytes()):08x}"
        return tuple(name if name == CONSTANT else name + tag for name in self.lifting.bind(states).names)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the inner formula of the standardized states."""
        return self.lifting.formula((x - ca.DM(self.mean)) / ca.DM(self.scale))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill((x - self.mean[:, None]) / self.scale[:, None], Z)
