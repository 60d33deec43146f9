"""Koopman with inputs and control: observables ψ(x, u) that hold the inputs, not only the states."""

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import Lifting, Traced
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.moments.solve import Ridge
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap


def kic(
    episodes: Episodes,
    lifting: Lifting,
    *,
    inputs: Literal["exogenous", "state", "constant"] = "exogenous",
    ridge: Ridge = 0.0,
) -> "InputPredictor":
    """Fit ψ(x⁺, ∗) = K ψ(x, u) by least squares on observables of states and inputs.

    ∗ is the next input, by the kind of data. For an exogenous input it is 0: K holds the effect of one input and
    nothing of the next. For a function of the state it is u⁺: K is the closed loop. For constant signals it is u: K
    holds a family of plants.

    Parameters
    ----------
    episodes
        Episodes with inputs.
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
        The episodes have no inputs; `inputs` is not one of the three; or it is "constant" and a signal changes.

    References
    ----------
    Proctor, Brunton & Kutz, "Generalizing Koopman theory to allow for inputs and control", SIAM J. Appl. Dyn. Syst. 17,
    2018.
    """
    checks.kind(episodes, "episodes", Episodes, "pass Episodes, of km.collect or km.load_episodes")
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

    The observables may mix inputs with states; eigenvalues and eigenfunctions of (x, u) are those of `model`. A
    controller needs a model in which inputs are free: `step_map` returns one for BilinearMPC and NonlinearMPC, for any
    ψ. `linear` returns one for KoopmanMPC and LQR if ψ holds u itself.

    Attributes
    ----------
    model
        K as ``model.A`` and ψ as ``model.lifting``; its states are those of the plant, then the inputs.
    nu
        Number of inputs.
    inputs
        The kind of the data's inputs: "exogenous", "state" or "constant".
    """

    model: LinearPredictor
    nu: int
    inputs: str

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.model.nx - self.nu

    def rollout(self, x0: ArrayLike, U: ArrayLike) -> Float[np.ndarray, "T1 nx"]:
        """Return X (T+1, nx) from x0 under U (T, nu), lifted again at each step."""
        return self.step_map().rollout(x0, U)

    @raise_swallowed()
    def step_map(self) -> StepMap:
        """Return x⁺ = C K ψ(x, u)."""
        m = self.model
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        ahead = ca.DM(m.C[: self.nx] @ m.A) @ m.lifting.symbolic(ca.vertcat(x, u))
        return StepMap(
            ca.Function("F", [x, u], [ca.densify(ahead)]), m.dt, states=m.states[: self.nx], inputs=m.states[self.nx :]
        )

    @raise_swallowed()
    def linear(self) -> LinearPredictor:
        """Return z⁺ = A z + B u on the observables of the state alone, from the rows and columns of K.

        Raises
        ------
        DataError
            An observable mixes states and inputs, or is a function of u other than u itself; or the inputs of the data
            were not exogenous, so that K does not hold the effect of a free input.
        """
        m, names = self.model, self.model.lifting.names
        if self.inputs != "exogenous":
            raise DataError(
                f'the inputs of the data are "{self.inputs}", and a controller needs free ones; fit exogenous inputs'
            )
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        z = m.lifting.symbolic(ca.vertcat(x, u))
        of_state = [i for i in range(m.nz) if not ca.depends_on(z[i], u)]
        of_input = [names.index(name) for name in m.states[self.nx :] if name in names]
        other = [names[i] for i in range(m.nz) if i not in of_state and i not in of_input]
        if other or len(of_input) < self.nu:
            what = f"{other[0]!r} is not linear in the inputs" if other else "ψ lacks an input"
            raise DataError(f"{what}; use step_map() with BilinearMPC or NonlinearMPC, or fit bilinear_edmd")
        return LinearPredictor(
            A=m.A[np.ix_(of_state, of_state)],
            B=m.A[np.ix_(of_state, of_input)],
            C=m.C[: self.nx, of_state],
            lifting=Traced(
                Graph.trace(ca.Function("lifting", [x], [ca.substitute(z[of_state], u, 0)])),
                tuple(names[i] for i in of_state),
                bound=m.states[: self.nx],
            ),
            dt=m.dt,
            states=m.states[: self.nx],
            inputs=m.states[self.nx :],
        )
