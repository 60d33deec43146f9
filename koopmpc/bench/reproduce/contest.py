"""Controllers of one plant under one cost: what a lifted model is worth beside a linearisation, and beside the best."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.koopman_mpc import KoopmanMPC
from koopmpc.control.limits import Limits
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear_mpc import NonlinearMPC
from koopmpc.loop.metrics import metrics
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import simulate
from koopmpc.plant.step_map import StepMap
from koopmpc.predict.linear import LinearPredictor

ORACLE = "nonlinear MPC"
_LOST = 1e3  # a cost so many times the best: the loop diverged


@dataclass(frozen=True, eq=False)
class Contest:
    """One start, one reference, one cost, with and without input limits.

    Attributes
    ----------
    title
        What the plant has to do.
    plant
        x⁺ = F(x, u).
    x_eq
        (nx,) where the linearisation is taken, u = 0.
    models
        Lifted or identified models by name.
    cost, limits
        The same for all; each controller runs once without the limits, and once within them.
    x0, reference
        (nx,) each.
    steps, horizon
        Of the run, and of the model predictive controllers.
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
        """Return the run of each controller, by its name and whether the inputs are limited."""
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
        """Return LQR by model, with limits the predictive ones too, and the oracle."""
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
