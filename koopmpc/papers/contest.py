"""Controllers of one plant under one cost: what a lifted model is worth beside a linearisation and nonlinear MPC."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.loop.metrics import metrics
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import simulate
from koopmpc.papers.reconstruction import relative
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import LinearPredictor

ORACLE = "nonlinear MPC"
_LOST = 1e3  # times the best cost beyond which a loop has diverged


@dataclass(frozen=True, eq=False)
class Contest:
    """Controllers that start from one state, track one reference and share one cost, with and without input limits.

    Attributes
    ----------
    title
        What the plant has to do.
    plant
        x⁺ = F(x, u).
    x_eq
        (nx,), the equilibrium at u = 0 where the plant is linearised.
    models
        Lifted or identified models by name.
    cost, limits
        The same for all controllers; each runs once without the limits and once within them.
    x0, reference
        (nx,) each.
    steps
        Length of each run.
    horizon
        Horizon of the model predictive controllers, in steps.
    """

    title: str
    plant: StepMap
    x_eq: Float[np.ndarray, " nx"]
    models: Mapping[str, LinearPredictor]
    cost: Cost
    limits: Limits
    x0: Float[np.ndarray, " nx"]
    reference: Float[np.ndarray, " nx"]
    steps: int
    horizon: int

    def runs(self) -> "dict[tuple[str, bool], Run]":
        """Return the run of each controller by its name and by whether the inputs are limited."""
        return {
            (name, limited): simulate(
                self.plant,
                controller,
                x0=self.x0,
                reference=self.reference,
                steps=self.steps,
                cost=self.cost,
                limits=self.limits if limited else None,
                metadata={"problem": self.title, "controller": name},
            )
            for limited in (False, True)
            for name, controller in self._controllers(limited).items()
        }

    def _controllers(self, limited: bool) -> dict[str, Controller]:
        """Return LQR on each model, MPC on each model where inputs are limited, and nonlinear MPC on the plant."""
        limits = self.limits if limited else Limits()
        local = LinearPredictor.local(self.plant, self.x_eq, np.zeros(self.plant.nu))
        models = {"linearisation": local, **self.models}
        found: dict[str, Controller] = {}
        for name, model in models.items():
            found[f"LQR, {name}"] = LQR(model, self.cost, limits)
            if limited:
                found[f"MPC, {name}"] = KoopmanMPC(model, self.cost, limits, self.horizon)
        found[ORACLE] = NonlinearMPC(self.plant, self.cost, limits, self.horizon)
        return found


def costs(runs: "Mapping[tuple[str, bool], Run]", limited: bool) -> dict[str, float]:
    """Return dt Σ (‖x − r‖²_Q + ‖u‖²_R) of each controller; inf where the loop diverged."""
    found = {name: run.dt * metrics(run).cost for (name, kind), run in runs.items() if kind is limited}
    best = found[ORACLE]
    return {name: value if value < _LOST * best else np.inf for name, value in found.items()}


@dataclass(frozen=True)
class Prediction:
    """Errors of one model on two kinds of held-out data: medians of ‖x̂ − x‖ / ‖x‖ over the episodes.

    Attributes
    ----------
    name
        The model and its data.
    feedback
        Error under the feedback of the paper, from other starts.
    excited
        Error under that feedback with noise on top.
    b
        The entry of B whose true value is largest, divided by that value; NaN for a model without B.
    warned
        The warning of the fit, in short.
    """

    name: str
    feedback: float
    excited: float
    b: float
    warned: str


def centred(episodes: Episodes, x_ref: ArrayLike) -> Episodes:
    """Return the same episodes in the coordinates x − x_ref."""
    target = checks.vector(x_ref, "x_ref", episodes.nx)
    return episodes.with_episodes([Episode(X=e.X - target, U=e.U, W=e.W) for e in episodes])


def prediction(
    name: str, model: LinearPredictor, feedback: Episodes, excited: Episodes, B: Float[np.ndarray, "nx nu"]
) -> Prediction:
    """Return the errors of `model` over whole episodes; a model without inputs predicts without them.

    Parameters
    ----------
    name, model
        The model and how the table calls it.
    feedback, excited
        Held-out episodes with inputs.
    B
        (nx, nu), ∂x⁺/∂u of the plant at the equilibrium.
    """
    i, j = np.unravel_index(int(np.abs(B).argmax()), B.shape)
    share = float((model.C @ model.B)[i, j] / B[i, j]) if model.nu else np.nan
    said = () if model.report is None else model.report.warnings
    short = "A and B inseparable" if any("inseparable" in sentence for sentence in said) else "–"
    return Prediction(name, _error(model, feedback), _error(model, excited), share, short)


def _error(model: LinearPredictor, episodes: Episodes) -> float:
    errors = [relative(model.rollout(e.X[0], e.U[:, : model.nu]), e.X) for e in episodes]
    return float(np.median(errors))
