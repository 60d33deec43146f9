"""Koopman with inputs and control: observables ψ(x, u) that hold the inputs, not only the states."""

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.solve import Ridge
from koopmpc.lifting.base import Lifting, Traced
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value


def kic(
    episodes: Episodes,
    lifting: Lifting,
    *,
    inputs: Literal["exogenous", "state", "constant"] = "exogenous",
    ridge: Ridge = 0.0,
) -> "InputPredictor":
    """Fit ψ(x⁺, ∗) = K ψ(x, u) by least squares on observables of states and inputs.

    ∗ is what the input becomes, and says what the data are: 0 where u is exogenous, so that K holds what one input does
    and nothing of the next; u⁺ where u is a function of the state, so that K is the closed loop; u where each signal is
    constant, so that K holds a family of plants.

    Parameters
    ----------
    episodes
        With inputs.
    lifting
        ψ over the states and then the inputs, by their names: ``km.State() * km.State("u")`` holds products. It must
        hold the states.
    inputs
        "exogenous", "state" or "constant".
    ridge
        As in `edmd`.

    Raises
    ------
    DataError
        The episodes have no inputs; `inputs` is none of the three; a signal that is said to be constant changes.

    References
    ----------
    Proctor, Brunton & Kutz, "Generalizing Koopman theory to allow for inputs and control", SIAM J. Appl. Dyn. Syst. 17,
    2018.
    """
    if not episodes.nu:
        raise DataError("the episodes have no inputs; fit them with edmd")
    if inputs not in ("exogenous", "state", "constant"):
        raise DataError(f'inputs is {inputs!r}; pass "exogenous", "state" or "constant"')
    pairs: list[Episode] = []
    for i, e in enumerate(episodes):
        now = np.hstack([e.X[:-1], e.U])
        if inputs == "state":
            if len(now) < 2:
                raise DataError(f"episode {i} has one step; u⁺ of a state-dependent input needs two")
            pairs.append(Episode(X=now))
            continue
        if inputs == "constant" and np.ptp(e.U, axis=0).any():
            raise DataError(f'episode {i} has inputs that change; pass inputs="exogenous", or "state" under feedback')
        later = np.hstack([e.X[1:], np.zeros_like(e.U) if inputs == "exogenous" else e.U])
        pairs += [Episode(X=np.stack(pair)) for pair in zip(now, later, strict=True)]
    both = Episodes(pairs, episodes.dt, (*episodes.states, *episodes.inputs))
    return InputPredictor(edmd(both, lifting, ridge=ridge), episodes.nu, inputs)


@dataclass(frozen=True, eq=False)
class InputPredictor(Value):
    """z⁺ = K z with z = ψ(x, u): a model of states and inputs together.

    It answers what an input does to observables that mix it with the state, and its eigenvalues and eigenfunctions are
    those of `model`, of (x, u). A plan needs a model in which inputs are free: `step_map` is one for BilinearMPC and
    NonlinearMPC, whatever ψ does with u; `linear` one for KoopmanMPC and LQR, where u enters as it is.

    Attributes
    ----------
    model
        K as ``model.A`` and ψ as ``model.lifting``; its states are those of the plant, then the inputs.
    nu
        Number of inputs.
    inputs
        What the data were: "exogenous", "state" or "constant".
    """

    model: LinearPredictor
    nu: int
    inputs: str

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.model.nx - self.nu

    def rollout(self, x0: ArrayLike, U: ArrayLike) -> Float[np.ndarray, "T1 nx"]:
        """Return X (T+1, nx) from x0 under U (T, nu), lifted anew at each step."""
        return self.step_map().rollout(x0, U)

    def step_map(self) -> StepMap:
        """Return x⁺ = C K ψ(x, u)."""
        m = self.model
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        ahead = ca.DM(m.C[: self.nx] @ m.A) @ m.lifting.symbolic(ca.vertcat(x, u))
        return StepMap(
            ca.Function("F", [x, u], [ca.densify(ahead)]), m.dt, states=m.states[: self.nx], inputs=m.states[self.nx :]
        )

    def linear(self) -> LinearPredictor:
        """Return z⁺ = A z + B u on the observables of the state alone, from the rows and columns of K.

        Raises
        ------
        DataError
            An observable mixes states and inputs, or is a function of u other than u itself; or the data were not those
            of an exogenous input, so that K does not say what a free input does.
        """
        m, names = self.model, self.model.lifting.names
        if self.inputs != "exogenous":
            raise DataError(
                f'the inputs of the data are "{self.inputs}", and a plan needs free ones; fit exogenous inputs'
            )
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        z = m.lifting.symbolic(ca.vertcat(x, u))
        own = [i for i in range(m.nz) if not ca.depends_on(z[i], u)]
        free = [names.index(name) for name in m.states[self.nx :] if name in names]
        other = [names[i] for i in range(m.nz) if i not in own and i not in free]
        if other or len(free) < self.nu:
            what = f"{other[0]!r} mixes or bends inputs" if other else "ψ lacks an input"
            raise DataError(f"{what}; use step_map() with BilinearMPC or NonlinearMPC, or fit bilinear_edmd")
        return LinearPredictor(
            A=m.A[np.ix_(own, own)],
            B=m.A[np.ix_(own, free)],
            C=m.C[: self.nx, own],
            lifting=Traced(
                Graph.trace(ca.Function("lifting", [x], [ca.substitute(z[own], u, 0)])),
                tuple(names[i] for i in own),
                bound=m.states[: self.nx],
            ),
            dt=m.dt,
            states=m.states[: self.nx],
            inputs=m.states[self.nx :],
        )
