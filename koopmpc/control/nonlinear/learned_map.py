"""From a model to x⁺ = F(x, u, θ) + E w + d: the re-lifted map of a predictor, or a StepMap."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.plan.tracking import StateTracking
from koopmpc.data.delay import Delay
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.routines import Buffered
from koopmpc.plants.step_map import StepMap

ModelOrMap = BilinearPredictor | LinearPredictor | StepMap
_SHARED = ("lifting", "embedding", "dt", "states", "inputs", "disturbances")


@dataclass(frozen=True)
class LearnedMap:
    """x⁺ = F(x, u, θ) + E w + d, θ being the matrices of the model: another model of the same lifting is another θ.

    Where w multiplies the state, it is the last part of θ, zero in `theta`, and `at` makes the map of another w.

    Of a predictor F is C (A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)), lifted afresh each step, and θ holds C A, C B and C Nᵢ. Under
    an embedding x is the point ζ of the plant's state and its past, the state first; F also shifts the past, which
    neither w nor d moves. The θ of a StepMap is its w.

    Attributes
    ----------
    model
        What the map was made of.
    E
        (nx, nw) gain of the measured disturbances.
    nx, ny, nu, nw
        Entries of x, of the plant's state, of u and of w.
    scheduled
        How many entries of w, the last ones of θ, multiply the state: all or none.
    embedding
        What makes x of the plant's state and its past; None where x is that state.
    center
        (ny,) mean of the plant's states over the data that the model was fitted to, None where it is not known.
    spread
        (ny,) their standard deviation, None where it is not known.
    """

    model: ModelOrMap
    F: ca.Function
    theta: Float[np.ndarray, " nt"]
    E: Float[np.ndarray, "nx nw"]
    nx: int
    ny: int
    nu: int
    nw: int
    embedding: Delay | None
    scheduled: int = 0
    lifting: None = None  # a plan is made of states, and none of them is lifted
    nz: int = field(init=False)  # a plan is made of x
    center: Float[np.ndarray, " ny"] | None = field(init=False)
    spread: Float[np.ndarray, " ny"] | None = field(init=False)

    def __post_init__(self) -> None:
        model, center, spread = self.model, None, None
        if not isinstance(model, StepMap) and model.scale is not None and model.lifting.constant_index is not None:
            center = model.C @ (model.scale.T @ model.scale[:, model.lifting.constant_index])
            spread = np.sqrt(np.maximum(np.sum((model.scale @ model.C.T) ** 2, axis=0) - center**2, 0.0))
        object.__setattr__(self, "nz", self.nx)
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "spread", spread)

    @property
    def dt(self) -> float:
        """Sampling time of the model [s]."""
        return self.model.dt

    def replace_model(self, model: ModelOrMap) -> "LearnedMap":
        """Return the map of another predictor with the same lifting.

        Raises
        ------
        DataError
            The models differ in more than their matrices, or one is a StepMap, which has none.
        """
        if isinstance(model, StepMap) or isinstance(self.model, StepMap):
            raise DataError("a StepMap has no matrices that could be exchanged; make a new controller")
        if type(model) is not type(self.model):
            raise DataError(
                f"the controller was made for {checks.article(self.model)}, and got {checks.article(model)}; "
                "pass a predictor of the same kind, or make a new controller"
            )
        for name in _SHARED:
            if getattr(model, name, None) != getattr(self.model, name, None):
                raise DataError(f"the predictor has another {name} than the controller's; make a new controller")
        return replace(self, model=model, theta=_theta(model), E=_gain(model, self.nx))

    def at(self, w: Float[np.ndarray, " nw"]) -> "LearnedMap":
        """Return the map for which w multiplies the state; itself where w only adds to it."""
        return self if not self.scheduled else replace(self, theta=self.schedule(w))

    def schedule(self, w: Float[np.ndarray, " nw"]) -> Float[np.ndarray, " nt"]:
        """Return θ with this w."""
        return np.concatenate([self.theta[: len(self.theta) - self.scheduled], w[: self.scheduled]])

    def step(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"] | None = None
    ) -> Float[np.ndarray, " nx"]:
        """Return F(x, u, θ), with the products of w where it has some; NaN where a step has no solution."""
        try:
            return self._buffer(x, u, self.theta if w is None or not self.scheduled else self.schedule(w))[0]
        except RuntimeError:  # an implicit step does not converge, or CVODES gives up
            return np.full(len(x), np.nan)

    def slope(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> Float[np.ndarray, "nx nx"]:
        """Return ∂F/∂x."""
        return np.array(self._slope(x, u, self.schedule(w)), dtype=np.float64)

    @cached_property
    def _slope(self) -> Any:
        x, u, t = (ca.SX.sym(name, self.F.size1_in(i)) for i, name in enumerate("xut"))
        return ca.Function("slope", [x, u, t], [ca.densify(ca.jacobian(self.F(x, u, t), x))])

    def advance(
        self,
        z: Float[np.ndarray, " nx"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nx"],
    ) -> Float[np.ndarray, " nx"]:
        """Return F(z, u, θ) + E w + d, as observers ask for it."""
        return self.step(z, u, w) + self.E @ w + d

    @cached_property
    def _buffer(self) -> Buffered:
        return Buffered(self.F)


@raise_swallowed()
def learned_map(model: ModelOrMap) -> LearnedMap:
    """Return the map of a predictor or of a StepMap.

    Raises
    ------
    DataError
        The model is something else.
    """
    kinds = (BilinearPredictor, LinearPredictor, StepMap)
    checks.kind(model, "model", kinds, "fit one with bilinear_edmd or edmd, or pass a StepMap")
    ny = len(model.states)
    if isinstance(model, StepMap):
        nw = model.nw
        x, u, w = ca.MX.sym("x", ny), ca.MX.sym("u", model.nu), ca.MX.sym("theta", nw)
        F = ca.Function("F", [x, u, w], [ca.densify(model.F(x, u, w) if nw else model.F(x, u))])
        F = F.expand("F") if model.F.is_a("SXFunction") else F
        return LearnedMap(model, F, np.zeros(nw), np.zeros((ny, nw)), ny, ny, model.nu, nw, None, nw)
    nu, nz = model.nu, model.nz
    nx = ny if model.embedding is None else len(model.embedding.names)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    A, B = ca.SX.sym("CA", ny, nz), ca.SX.sym("CB", ny, nu)
    theta, z = [A, B], model.lifting.symbolic(x)
    for i in range(nu if isinstance(model, BilinearPredictor) else 0):
        theta.append(ca.SX.sym(f"CN{i}", ny, nz))
        A = A + u[i] * theta[-1]
    scheduled = model.nw if isinstance(model, BilinearPredictor) and model.is_scheduled else 0
    if scheduled:
        w = ca.SX.sym("w", scheduled)
        for j in range(scheduled):
            theta.append(ca.SX.sym(f"CS{j}", ny, nz))
            A = A + w[j] * theta[-1]
        for j in range(scheduled):
            theta.append(ca.SX.sym(f"CM{j}", ny, nu))
            B = B + w[j] * theta[-1]
        theta.append(w)
    x_next = A @ z + B @ u
    if model.embedding is not None:
        x_next = model.embedding.without_rails().symbolic(x, u, x_next)
    F = ca.Function("F", [x, u, ca.vertcat(*map(ca.vec, theta))], [ca.densify(x_next)], {"cse": True})
    E = _gain(model, nx)
    return LearnedMap(model, F, _theta(model), E, nx, ny, nu, E.shape[1], model.embedding, scheduled)


def _theta(model: LinearPredictor | BilinearPredictor) -> Float[np.ndarray, " nt"]:
    parts = [model.A, model.B, *(model.N if isinstance(model, BilinearPredictor) else ())]
    schedule = isinstance(model, BilinearPredictor) and model.is_scheduled
    parts += [*model.S, *model.M] if isinstance(model, BilinearPredictor) and schedule else []
    theta = np.concatenate([(model.C @ part).ravel("F") for part in parts])
    return np.concatenate([theta, np.zeros(model.nw)]) if schedule else theta


def _gain(model: LinearPredictor | BilinearPredictor, nx: int) -> Float[np.ndarray, "nx nw"]:
    E = np.zeros((nx, model.nw))
    E[: model.nx] = model.C @ model.E
    return E


def point_sizes(model: LearnedMap, outputs: StateTracking) -> Float[np.ndarray, " nx"]:
    """Return the sizes of the entries of x, under an embedding those of the state and of its past."""
    sizes = outputs.sizes
    return sizes.states if model.embedding is None else model.embedding.spread(sizes.states, sizes.inputs)
