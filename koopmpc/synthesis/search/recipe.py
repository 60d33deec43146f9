"""Recipe: how a model and its controller are made of data."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from koopmpc.base.errors import hide_fit_warnings
from koopmpc.base.values import Value
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.kinds import kind_for
from koopmpc.control.kinds.bilinear_mpc import BilinearMPC
from koopmpc.control.kinds.koopman_mpc import KoopmanMPC
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Source
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.extended import ExtendedKalman
from koopmpc.estimate.kalman import LiftedKalman
from koopmpc.estimate.observer import Estimator
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.predictors import LinearPredictor
from koopmpc.synthesis.search.candidates import Candidate, fit_candidate
from koopmpc.validate.scoring import AnyPredictor

_FLOOR = 1e-3  # weight of data that are far from every visited state
_NEAR = 0.3  # this quantile of the squared distances is the square of the weights' width
_VISITED = 300  # visited states that distances are taken to, at most
Designed = KoopmanMPC | BilinearMPC


@dataclass(frozen=True, eq=False)
class Nearness(Value):
    """Weight 1e-3 + exp(−d²/2h²) of each step of an episode, d the distance to the nearest visited state."""

    visited: Float[np.ndarray, "n nx"]  # (n, nx) visited states, divided by `scale`
    scale: Float[np.ndarray, " nx"]  # (nx,) standard deviation of each state in the data
    width: float  # h, in units of `scale`

    @staticmethod
    def of(X: Float[np.ndarray, "m nx"], data: Episodes) -> "Nearness":
        """Return the weights around the states X for these data: h² is the 0.3-quantile of their d²."""
        scale = np.concatenate([episode.X for episode in data]).std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        apart = -(-len(X) // _VISITED)
        around = Nearness(X[::apart] / scale, scale, 1.0)
        squares = np.concatenate([around.squares(episode) for episode in data])
        return replace(around, width=float(np.sqrt(max(np.quantile(squares, _NEAR), 1e-12))))

    def squares(self, episode: Episode) -> Float[np.ndarray, " T"]:
        """Return d² of each step."""
        X = episode.X[:-1, : len(self.scale)] / self.scale  # under an embedding the state comes first
        distance, _ = KDTree(self.visited).query(X)
        return np.asarray(distance) ** 2

    def __call__(self, episode: Episode) -> Float[np.ndarray, " T"]:
        """Return the weight of each step."""
        return _FLOOR + np.exp(-self.squares(episode) / (2 * self.width**2))


def get_model(controller: Any) -> AnyPredictor:
    """Return the learned model of a designed controller."""
    return getattr(controller, "predictor", None) or controller.model


@dataclass(frozen=True, eq=False)
class Recipe(Value):
    """How a controller is made of data.

    Attributes
    ----------
    candidate
        Lifting, embedding and kind of the model: a linear one gives a KoopmanMPC, a bilinear one a BilinearMPC.
    ridge
        Tikhonov weight as in `edmd`.
    estimator
        The estimator of the controller, or None.
    tail
        Steps of the cost's tail where the cost names neither a tail nor Q_N; None for the default, 0 is Q_N = Q.
    weighted
        Fit the model again with weights around the states that its closed loops visit.
    rests
        The reference rests beyond its rows, also where it moved and the cost names no other end; bilinear models only.
    feedthrough
        Inputs act on outputs at once, and the model is one of log rows with the inputs moved up. The estimator is then
        a Kalman filter on [z; d] that knows it: a `LiftedDisturbance` needs the state as the model has it.
    """

    candidate: Candidate
    ridge: float
    estimator: LiftedDisturbance | None = None
    tail: int | None = None
    weighted: bool = False
    rests: bool = False
    feedthrough: bool = False

    def __str__(self) -> str:
        """Return kind, name and delays of the model, and what the controller has besides the default."""
        one, estimator = self.candidate, self.estimator
        parts = [f"{one.kind}: {one.name}"]
        if one.delays:
            parts.append(f"{one.delays} delay{'s' * (one.delays > 1)}")
        if self.tail == 0:
            parts.append("Q_N = Q")
        elif self.tail is not None:
            parts.append(f"a tail of {self.tail} steps")
        if self.rests:
            parts.append("the reference rests at its end")
        if estimator is not None:
            parts.append("offset-free" + ("" if estimator.gain is None else f" (gain {estimator.gain:g})"))
        if self.feedthrough:
            parts.append("offset-free by a filter")
        if self.weighted:
            parts.append("weighted")
        return ", ".join(parts)

    def fit(
        self,
        data: Episodes | Source,
        near: Nearness | None = None,
        *,
        workers: int | None = None,
        scheduler: str | None = None,
    ) -> AnyPredictor:
        """Return the model of these data, with the weights `near`. Doubts about the fit stand in its report."""
        with hide_fit_warnings():
            read = ReadOptions(weights=near, workers=workers, scheduler=scheduler)
            return fit_candidate(self.candidate, data, self.ridge, read)

    def controller(
        self,
        model: AnyPredictor,
        cost: Cost,
        limits: Limits,
        horizon: int,
        *,
        brief: bool = False,
        monitor: Episodes | None = None,
    ) -> Designed:
        """Return the controller of a model; one that is used briefly (`brief`) compiles no machine code of the model.

        With `monitor`, its moves say whether they are `known` to these data.
        """
        if self.tail is not None and cost.Q_N is None and cost.tail is None:
            cost = replace(cost, tail=self.tail)
        kind = kind_for(model)
        if self.rests or not self.candidate.bilinear:
            cost = replace(cost, beyond="rest")
        build: Any = (kind.brief if brief else None) or kind.controller
        estimator: Estimator | None = self.estimator
        if self.feedthrough:
            known = isinstance(model, LinearPredictor)
            estimator = LiftedKalman(model.C, feedthrough=True) if known else ExtendedKalman(feedthrough=True)
        return build(model, cost, limits, horizon, estimator=estimator, monitor=monitor)
