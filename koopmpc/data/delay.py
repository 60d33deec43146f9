"""Delay: a state that holds its own past, ζ_k = [x_k, u_{k−1}, x_{k−1}, …, u_{k−d}, x_{k−d}]."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from koopmpc.base import checks
from koopmpc.base.errors import DataError, FitWarning, ShapeError
from koopmpc.base.values import Value, freeze
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Source


@dataclass(frozen=True, eq=False)
class Delay(Value):
    """The embedding ζ_k = [x_k, u_{k−1}, x_{k−1}, …, u_{k−d}, x_{k−d}]: the past replaces states that are not measured.

    A lifting then acts on ζ. No ζ reaches across episodes, so each episode loses d points. Past values have names such
    as ``"theta[k-1] [rad]"``.

    Parameters
    ----------
    steps
        d ≥ 1.
    inputs
        Keep the past inputs too; without them ζ_k = [x_k, x_{k−1}, …, x_{k−d}].
    rails
        (2, nx) the least and the largest reading of each sensor, ±inf where it has no limit. A model with these rails
        forecasts y = min(max(h, low), high), and ζ holds such readings. Plans of a controller ignore them: a limit of
        its own must not hide behind the sensor's. None: no sensor saturates.

    Raises
    ------
    DataError
        steps is below 1; rails are not in order.

    References
    ----------
    Takens, "Detecting strange attractors in turbulence", 1981; with inputs, as here: Korda & Mezić, Automatica 93,
    2018.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> model = km.edmd(data, km.State(), embedding=km.Delay(1))  # acts on [x_k, u_{k−1}, x_{k−1}]
    >>> model.nz
    5
    """

    steps: int
    inputs: bool = True
    rails: Float[np.ndarray, "2 nx"] | None = field(default=None, kw_only=True)
    bound: tuple[tuple[str, ...], tuple[str, ...]] | None = field(default=None, kw_only=True)  # x, u

    def __post_init__(self) -> None:
        checks.count(self.steps, "steps")
        if self.rails is not None:
            rails = checks.array(self.rails, "rails", (2, None), finite=False)
            if not (rails[0] < rails[1]).all():
                raise DataError("rails must hold the least and the largest reading of each output, low below high")
            freeze(self, rails=rails)

    def bind(self, states: Sequence[str], inputs: Sequence[str]) -> "Delay":
        """Return the sized copy, for a plant with these names."""
        return replace(self, bound=(tuple(states), tuple(inputs)))

    def match(self, states: Sequence[str], inputs: Sequence[str]) -> "Delay":
        """Return the copy for data with these names; a bound one keeps only the past of its own inputs."""
        if self.bound is None:
            return self.bind(states, inputs)
        if self.bound != (tuple(states), tuple(inputs)[: len(self.bound[1])]):
            raise DataError(
                f"the embedding is of {', '.join(self.bound[0] + self.bound[1])}; the data hold "
                f"{', '.join((*states, *inputs))}"
            )
        return self

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states x, without their past."""
        return self._names[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of ζ."""
        states, inputs = self._names
        past = (inputs if self.inputs else ()) + states
        return states + tuple(name_past(name, i) for i in range(1, self.steps + 1) for name in past)

    @property
    def _names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        if self.bound is None:
            raise DataError("Delay does not know its plant yet; call .bind(states, inputs) or pass it to edmd")
        return self.bound

    @property
    def _block(self) -> int:
        """Number of entries of ζ that hold one past step."""
        states, inputs = self._names
        return len(states) + len(inputs) * self.inputs

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the episodes of ζ; those of at most d steps are left out, with a warning that counts them.

        Raises
        ------
        DataError
            No episode is long enough.
        """
        d, sized = self.steps, self.match(episodes.states, episodes.inputs)
        long = [episode for episode in episodes if len(episode) > d]
        lost = len(episodes) - len(long)
        if not long:
            raise DataError(
                f"no episode is longer than the {d} steps of the embedding; pass longer ones, or a shorter Delay"
            )
        if lost:
            warnings.warn(
                f"{lost} of {len(episodes)} episodes have {d} steps or less and are left out: Delay({d}) finds no "
                "pair in them",
                FitWarning,
                stacklevel=2,
            )
        parts = [Episode(X=sized._points(e.X, e.U), U=e.U[d:], W=e.W[d:]) for e in long]
        return Episodes(parts, episodes.dt, sized.names, episodes.inputs, episodes.disturbances)

    def source(self, source: Source) -> Source:
        """Return a source whose episodes hold ζ in place of x."""
        sized = self.match(source.states, source.inputs)
        return Changed(source, sized, sized.names, source.inputs, source.disturbances, history=self.steps)

    def point(self, x: Float[np.ndarray, " nx"], history: Episode) -> Float[np.ndarray, " nzeta"]:
        """Return ζ of x, whose last d steps are those of `history`, which ends at x.

        Raises
        ------
        DataError
            The history is shorter than d, or does not end at x.
        ShapeError
            It has other states or inputs.
        """
        states, inputs = self._names
        if history.X.shape[1:] != (len(states),) or history.U.shape[1:] != (len(inputs),):
            raise ShapeError(
                f"history has {history.X.shape[1]} states and {history.U.shape[1]} inputs, expected {len(states)} and "
                f"{len(inputs)}"
            )
        if len(history) < self.steps:
            raise DataError(f"history has {len(history)} steps, Delay({self.steps}) needs the last {self.steps}")
        if not np.array_equal(history.X[-1], x):
            raise DataError("history does not end at x; its last row of X is x itself")
        first = len(history) - self.steps
        return self._points(history.X[first:], history.U[first:])[0]

    def repeat(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ of a plant that has been in x, under u, for d steps."""
        past = np.concatenate([u, x]) if self.inputs else x
        return np.concatenate([x, *[past] * self.steps])

    def shift(
        self,
        zeta: Float[np.ndarray, "*batch nzeta"],
        u: Float[np.ndarray, "*batch nu"],
        x_next: Float[np.ndarray, "*batch nx"],
    ) -> Float[np.ndarray, "*batch nzeta"]:
        """Return ζ⁺ = [x⁺, u, ζ without its oldest step], of one ζ or of rows."""
        kept, x_next = zeta[..., : zeta.shape[-1] - self._block], self.clip(x_next)
        return np.concatenate([x_next, u, kept] if self.inputs else [x_next, kept], axis=-1)

    def bridge(self, zeta: Float[np.ndarray, " nzeta"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ⁺ where no reading has come: the last state takes its place."""
        return self.shift(zeta, u, zeta[: len(self.states)])

    def clip(self, x: Float[np.ndarray, "*batch nx"]) -> Float[np.ndarray, "*batch nx"]:
        """Return what the sensors show of x: no more than their rails."""
        return x if self.rails is None else np.clip(x, *self.rails)

    def is_beyond(
        self, y: Float[np.ndarray, "*batch nx"], predicted: Float[np.ndarray, "*batch nx"]
    ) -> Bool[np.ndarray, "*batch nx"]:
        """Return which readings are at a rail with a prediction at it or beyond: they tell nothing more."""
        if self.rails is None:
            return np.zeros(y.shape, dtype=np.bool_)
        low, high = self.rails
        return ((y <= low) & (predicted <= low)) | ((y >= high) & (predicted >= high))

    def spread(self, states: Float[np.ndarray, " nx"], inputs: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return the sizes of the entries of ζ for these sizes of states and inputs."""
        return self.repeat(states, inputs)

    def without_rails(self) -> "Delay":
        """Return the embedding for sensors without limits, as plans need it."""
        return self if self.rails is None else replace(self, rails=None)

    def symbolic(self, zeta: ca.SX, u: ca.SX, x_next: ca.SX) -> ca.SX:
        """Return ζ⁺ for symbolic columns ζ, u and x⁺."""
        kept, x_next = zeta[: zeta.shape[0] - self._block], self.clip_symbolic(x_next)
        return ca.vertcat(x_next, u, kept) if self.inputs else ca.vertcat(x_next, kept)

    def clip_symbolic(self, x: ca.SX) -> ca.SX:
        """Return `clip` of a symbolic column."""
        if self.rails is None:
            return x
        low, high = self.rails
        entries = [
            ca.fmax(ca.fmin(x[i], high[i]) if np.isfinite(high[i]) else x[i], low[i])
            if np.isfinite(low[i])
            else (ca.fmin(x[i], high[i]) if np.isfinite(high[i]) else x[i])
            for i in range(x.numel())
        ]
        return ca.vertcat(*entries)

    def _points(
        self, X: Float[np.ndarray, "rows nx"], U: Float[np.ndarray, "steps nu"]
    ) -> Float[np.ndarray, "points nzeta"]:
        """Return the rows ζ_d … ζ_T."""
        d = self.steps
        past = np.hstack([U[:, : len(self._names[1])], X[:-1]]) if self.inputs else X[:-1]
        windows = sliding_window_view(past, d, axis=0)[:, :, ::-1]  # (T − d + 1, block, d), the newest first
        return np.hstack([X[d:], windows.transpose(0, 2, 1).reshape(len(windows), -1)])


def name_past(name: str, steps: int) -> str:
    """Return ``"theta[k-1] [rad]"`` for ``"theta [rad]"``."""
    stem, bracket, unit = name.partition(" [")
    return f"{stem}[k-{steps}]{bracket}{unit}"
