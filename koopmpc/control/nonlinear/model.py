"""LearnedMap: x⁺ = F(x, u, θ) of a predictor that is lifted afresh each step, its matrices θ being arguments.

Under an embedding x is the point ζ of the plant's state and its past, that state first.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.errors import DataError
from koopmpc.plants.buffered import Buffered
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

Source = BilinearPredictor | LinearPredictor | StepMap
_KEPT = ("lifting", "embedding", "dt", "states", "inputs", "disturbances")


@dataclass(frozen=True)
class LearnedMap:
    """x⁺ = F(x, u, θ) + push w + d: another model of the same lifting is another θ, and no other function.

    Of a predictor F is C (A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)), θ holds C A, C B and C Nᵢ, and push is C E; under an
    embedding F goes on with the shift of the past, and push is zero there.
    """

    source: Source
    F: ca.Function
    theta: Float[np.ndarray, " nt"]
    push: Float[np.ndarray, "nx nw"]

    @property
    def nx(self) -> int:
        """Number of entries of x."""
        return self._sizes[0]

    @property
    def embedding(self) -> Delay | None:
        """What makes x of the plant's state and its past; None where x is that state."""
        return None if isinstance(self.source, StepMap) else self.source.embedding

    @property
    def ny(self) -> int:
        """Number of the plant's states, the first entries of x."""
        return len(self.source.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._sizes[1]

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return self.push.shape[1]

    def updated(self, source: Source) -> "LearnedMap":
        """Return the map of another model with the same lifting.

        Raises
        ------
        DataError
            The models differ in more than their matrices.
        """
        if type(source) is not type(self.source) or isinstance(source, StepMap):
            raise DataError(
                f"the controller was made for a {type(self.source).__name__}, and got a {type(source).__name__}; "
                "pass a predictor of the same kind, or make a new controller"
            )
        for name in _KEPT:
            if getattr(source, name, None) != getattr(self.source, name, None):
                raise DataError(f"the predictor has another {name} than the controller's; make a new controller")
        return replace(self, source=source, theta=_theta(source), push=_push(source))

    def fixed(self) -> "LearnedMap":
        """Return the same map with θ inside F."""
        x, u, none = ca.MX.sym("x", self.nx), ca.MX.sym("u", self.nu), ca.MX.sym("theta", 0)
        F = ca.Function("F", [x, u, none], [self.F(x, u, ca.DM(self.theta))])
        return replace(self, F=F.expand("F") if self.F.is_a("SXFunction") else F, theta=np.zeros(0))

    def held(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nx"]:
        """Return the x of a plant that has been in y, under u."""
        return y if self.embedding is None else self.embedding.held(y, u)

    def step(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nx"]:
        """Return F(x, u, θ)."""
        return self._buffered(x, u, self.theta)[0]

    def advance(
        self,
        z: Float[np.ndarray, " nx"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nx"],
    ) -> Float[np.ndarray, " nx"]:
        """Return x⁺, with what disturbs it."""
        return self.step(z, u) + self.push @ w + d

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        return self.F.size1_in(0), self.F.size1_in(1)  # each takes as long as a step of F

    @cached_property
    def _buffered(self) -> Buffered:
        return Buffered(self.F)


def learned_map(source: Source, name: str = "predictor") -> LearnedMap:
    """Return the map of a predictor, or of a StepMap, which has no θ.

    Parameters
    ----------
    source
        The model.
    name
        What an error calls it.

    Raises
    ------
    DataError
        It is something else.
    """
    kinds = (BilinearPredictor, LinearPredictor, StepMap)
    checks.kind(source, name, kinds, "fit one with bilinear_edmd or edmd, or pass a StepMap")
    return LearnedMap(source, _function(source), _theta(source), _push(source))


def _function(source: Source) -> ca.Function:
    if isinstance(source, StepMap):
        x, u, none = ca.MX.sym("x", source.nx), ca.MX.sym("u", source.nu), ca.MX.sym("theta", 0)
        F = ca.Function("F", [x, u, none], [ca.densify(source.F(x, u))])
        return F.expand("F") if source.F.is_a("SXFunction") else F
    nx, nu, nz = source.nx, source.nu, source.nz
    x, u = ca.SX.sym("x", len(source.point_names)), ca.SX.sym("u", nu)
    A, B = ca.SX.sym("CA", nx, nz), ca.SX.sym("CB", nx, nu)
    theta, z = [A, B], source.lifting.symbolic(x)
    for i in range(nu if isinstance(source, BilinearPredictor) else 0):
        theta.append(ca.SX.sym(f"CN{i}", nx, nz))
        A = A + u[i] * theta[-1]
    x_next = A @ z + B @ u
    if source.embedding is not None:
        x_next = source.embedding.symbolic(x, u, x_next)
    return ca.Function("F", [x, u, ca.vertcat(*map(ca.vec, theta))], [ca.densify(x_next)], {"cse": True})


def _theta(source: Source) -> Float[np.ndarray, " nt"]:
    if isinstance(source, StepMap):
        return np.zeros(0)
    parts = [source.A, source.B, *(source.N if isinstance(source, BilinearPredictor) else ())]
    return np.concatenate([(source.C @ part).ravel("F") for part in parts])


def _push(source: Source) -> Float[np.ndarray, "nx nw"]:
    if not isinstance(source, LinearPredictor):
        return np.zeros((source.nx if isinstance(source, StepMap) else len(source.point_names), 0))
    push = np.zeros((len(source.point_names), source.nw))
    push[: source.nx] = source.C @ source.E
    return push
