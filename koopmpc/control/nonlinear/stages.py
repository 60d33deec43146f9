"""The map of a model, x⁺ = F(x, u, θ) + E w + d, and the stages s⁺ = F(s, v, θ) of a plan with what they cost."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import Softness
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

    @property
    def nz(self) -> int:
        """Entries of a state of the plan, which is x."""
        return self.nx

    @cached_property
    def cloud(self) -> tuple[Float[np.ndarray, " ny"], Float[np.ndarray, " ny"]] | None:
        """Mean and standard deviation of the plant's states in the data of the fit; None where they are not known."""
        model = self.model
        if isinstance(model, StepMap) or model.scale is None or model.lifting.constant_index is None:
            return None
        center = model.C @ (model.scale.T @ model.scale[:, model.lifting.constant_index])
        squares = np.sum((model.scale @ model.C.T) ** 2, axis=0)
        return center, np.sqrt(np.maximum(squares - center**2, 0.0))

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

    def roll_out(
        self,
        x: Float[np.ndarray, " nx"],
        U: Float[np.ndarray, "N nu"],
        e: Float[np.ndarray, "N nx"],
        W: Float[np.ndarray, "N nw"],
    ) -> Float[np.ndarray, "N1 nx"] | None:
        """Return the states to which U leads under e and w; None where they overflow, or a step has no solution."""
        X = [x]
        for u, moved, w in zip(U, e, W, strict=True):
            X.append(self.step(X[-1], u, w) + moved)
        return np.array(X) if np.abs(X).max() < HUGE else None  # False for NaN

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

    def add(name: str, weight: ca.SX, M: ca.SX) -> ca.SX:
        """Return M + Σ weightᵢ Mᵢ, the Mᵢ being parts of θ."""
        for i in range(weight.numel()):
            theta.append(ca.SX.sym(f"{name}{i}", *M.shape))
            M = M + weight[i] * theta[-1]
        return M

    scheduled = 0
    if isinstance(model, BilinearPredictor):
        A = add("CN", u, A)
        scheduled = model.nw * model.is_scheduled
    if scheduled:
        w = ca.SX.sym("w", scheduled)
        A, B = add("CS", w, A), add("CM", w, B)
        theta.append(w)
    x_next = A @ z + B @ u
    if model.embedding is not None:
        x_next = model.embedding.without_rails().symbolic(x, u, x_next)
    F = ca.Function("F", [x, u, ca.vertcat(*map(ca.vec, theta))], [ca.densify(x_next)], {"cse": True})
    E = _gain(model, nx)
    return LearnedMap(model, F, _theta(model), E, nx, ny, nu, E.shape[1], model.embedding, scheduled)


def _theta(model: LinearPredictor | BilinearPredictor) -> Float[np.ndarray, " nt"]:
    parts, w = [model.A, model.B], np.zeros(0)
    if isinstance(model, BilinearPredictor):
        parts += [*model.N]
        if model.is_scheduled:
            parts, w = [*parts, *model.S, *model.M], np.zeros(model.nw)
    return np.concatenate([*((model.C @ part).ravel("F") for part in parts), w])


def _gain(model: LinearPredictor | BilinearPredictor, nx: int) -> Float[np.ndarray, "nx nw"]:
    E = np.zeros((nx, model.nw))
    E[: model.nx] = model.C @ model.E
    return E


def point_sizes(model: LearnedMap, outputs: StateTracking) -> Float[np.ndarray, " nx"]:
    """Return the sizes of the entries of x, under an embedding those of the state and of its past."""
    sizes = outputs.sizes
    return sizes.states if model.embedding is None else model.embedding.spread(sizes.states, sizes.inputs)


class StagedProblem(NamedTuple):
    """s⁺ = F(s, v, θ) over N stages, what is tracked and limited of s, and the weights.

    Without rates s = x and v = u. Where changes of the inputs are weighed or limited, or moves are blocked, the change
    v_k = u_k − u_{k−1} is the input of s = [x; u_{k−1}; v_{k−1}] with s⁺ = [F(x, u_{k−1} + v); u_{k−1} + v; v]. Then
    `tracked` is [of(x); u_{k−1}], Q holds the weights of both, R is R_delta, the limits of u are limits of s, and a
    held input is v = 0. The part v_{k−1} holds the inputs `soft_rates`, whose changes have soft limits.

    Attributes
    ----------
    nx
        Entries of s.
    inputs
        Limits of v, which are hard.
    box, softness, margin
        Limits of `limited`, what it costs to break them, and by how much each stage moves the last of them inwards.
    free
        Whether a stage has an input; else v is zero there.
    scheduled
        How many of the measured disturbances multiply the state; they are the last entries of θ.
    held_from, own
        The stage whose value of each input each stage takes, and whether some input has blocks of its own.
    sizes, input_sizes, scale
        What the entries of s and v, and the cost, are measured by, see `Sizes`.
    ends
        How many of `limited`, the last ones, are those of a terminal set, and limit the last stage alone.
    stage
        (s_k, v_k) → ℓ of the cost; None where it has no stage of its own.
    timed
        Whether weights move in time: each stage then has diagonals of its own in place of Q, and of R without rates.
    affine
        Whether F, the tracked and the limited outputs are affine in (s, v), so that all starts lead to one plan.
    """

    F: ca.Function
    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Interval
    box: Interval
    softness: Softness
    free: Bool[np.ndarray, " N"]
    held_from: Int[np.ndarray, "N nu"]
    with_rates: bool
    soft_rates: Int[np.ndarray, " nsoft"]
    nx: int
    sizes: Float[np.ndarray, " ns"]
    input_sizes: Float[np.ndarray, " nu"]
    margin: Float[np.ndarray, "N nm"]
    scale: float
    ends: int = 0
    own: bool = False
    scheduled: int = 0
    stage: ca.Function | None = None
    timed: bool = False
    affine: bool = False

    def stage_theta(self, theta: ca.MX, k: int) -> ca.MX:
        """Return the θ of stage k out of [θ; w_0; …; w_{N−1}], all of them where w multiplies no state."""
        if not self.scheduled:
            return theta
        n, s = self.F.size1_in(2) - self.scheduled, self.scheduled
        return ca.vertcat(theta[:n, 0], theta[n + k * s : n + (k + 1) * s, 0])

    @property
    def stage_limits(self) -> Interval:
        """Limits (N, nu + ng) of [v_k; limited(s_{k+1})] of all stages, margins taken off."""
        low, high = (np.tile(np.concatenate([self.inputs[i], self.box[i]]), (len(self.free), 1)) for i in (0, 1))
        first = low.shape[1] - self.margin.shape[1]
        low[:, first:] += self.margin
        high[:, first:] -= self.margin
        return Interval(low, high)

    @property
    def moved(self) -> int:
        """Entries of x, the first ones of s, which disturbances move."""
        return self.nx - self.with_rates * (len(self.R) + len(self.soft_rates))

    def first_stage(
        self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"], inputs: Interval
    ) -> tuple[Float[np.ndarray, " ns"], Interval, bool]:
        """Return s_0, the limits of v_0, and whether rates were widened: where they exclude those of u, these win."""
        if not self.with_rates:
            return x, inputs, False
        low, high = self.inputs
        widened = Interval(np.minimum(low, inputs.high - u_prev), np.maximum(high, inputs.low - u_prev))
        reach = 1e-9 * (np.abs(u_prev) + self.input_sizes)
        conflict = bool((widened.low < low - reach).any() or (widened.high > high + reach).any())
        return np.concatenate([x, u_prev, np.zeros(len(self.soft_rates))]), widened, conflict

    def enter(
        self,
        X: Float[np.ndarray, "N1 nx"],
        U: Float[np.ndarray, "N nu"],
        u_prev: Float[np.ndarray, " nu"],
        box: Interval,
    ) -> tuple[Float[np.ndarray, "N1 ns"], Float[np.ndarray, "N nu"]]:
        """Return a plan of states and inputs in s and v, its inputs inside `box` and held in each block."""
        U = np.minimum(np.maximum(U, box.low), box.high)
        if not self.with_rates:
            return X, U
        before = np.vstack([u_prev, U[self.held_from, np.arange(len(self.R))]])
        V = np.diff(before, axis=0)
        late = np.vstack([np.zeros(len(self.R)), V])[:, self.soft_rates]
        return np.hstack([X, before, late]), V

    def leave(
        self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"], box: Interval
    ) -> tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]:
        """Return the states and the inputs of a plan in s and v, the inputs inside `box`."""
        nx = self.moved
        if self.with_rates:
            V = S[0, nx : nx + len(self.R)] + np.cumsum(V * self.free[:, None], axis=0)
        return S[:, :nx], np.minimum(np.maximum(V, box.low), box.high)

    @property
    def theta_size(self) -> int:
        """Entries of [θ; w_0; …; w_{N−1}]."""
        return self.F.size1_in(2) + self.scheduled * (len(self.free) - 1)


class StageTargets(NamedTuple):
    """Reference rows of s_1 … s_N, reference inputs, and the terminal cost ‖M of(s_N) + L s_N − m‖²."""

    R: Float[np.ndarray, "N nr"]
    U: Float[np.ndarray, "N nu"]
    M: Float[np.ndarray, "nt nr"]  # nt = ns + nr
    L: Float[np.ndarray, "nt ns"]
    m: Float[np.ndarray, " nt"]
