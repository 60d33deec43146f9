"""The nine controllers of the bench, and what they share of one problem: step map, plant, data and models."""

import time
import warnings
from collections.abc import Callable, Iterable
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.bench.problem import Problem
from koopmpc.checks import nearest
from koopmpc.control.cost import state_tracking
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.linear.linear_mpc import LinearMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.control.nonlinear.equilibrium import Equilibria
from koopmpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from koopmpc.control.nonlinear.problem import learned_map
from koopmpc.data.collect import collect
from koopmpc.data.episodes import Episodes
from koopmpc.errors import FitWarning, ProblemError
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.identify.fits.bilinear import bilinear_edmd
from koopmpc.identify.fits.edmd import edmd
from koopmpc.plants.dynamics import Dynamics, Plant
from koopmpc.plants.step_map import SimulatedPlant, StepMap, discretize
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.design import design


class Prepared:
    """The parts of a problem; each is built when it is first used and then kept.

    Koopman controllers get `model` or `bilinear`, which are fitted to data alone; the others get `step_map`.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.training_time = 0.0
        self._held: dict[str, Float[np.ndarray, "T nu"]] = {}

    @cached_property
    def step_map(self) -> StepMap:
        """x⁺ = F(x, u) of the problem's dynamics."""
        return discretize(self.problem.dynamics, self.problem.dt, self.problem.integrator)

    @cached_property
    def truth(self) -> StepMap | Plant:
        """The plant that is driven: the problem's `plant`, by default its model."""
        return self._driven(self.problem.plant)

    def truth_of(self, case: str) -> StepMap | Plant:
        """Return the plant that is driven in this case, by default the problem's."""
        plant = self.problem.cases[case].plant
        return self.truth if plant is None else self._driven(plant)

    def _driven(self, plant: Dynamics | StepMap | Plant | None) -> StepMap | Plant:
        if plant is None:
            return self.step_map
        if isinstance(plant, Dynamics):
            return discretize(plant, self.problem.dt, self.problem.integrator)
        return plant

    def u_reference(self, case: str) -> Float[np.ndarray, "T nu"]:
        """Return the inputs that hold the references of a case on the plant that is driven.

        Where that plant has no equations they are found on the model; where the cost's u_target is "zero" they are
        zero. They are found once and serve all controllers.
        """
        if case not in self._held:
            self._held[case] = self._find(case)
        return self._held[case]

    def _find(self, case: str) -> Float[np.ndarray, "T nu"]:
        problem, steps = self.problem, self.problem.cases[case].steps
        truth = self.truth_of(case)
        truth = truth.step_map if isinstance(truth, SimulatedPlant) else truth
        plant = truth if isinstance(truth, StepMap) else self.step_map
        given = problem.cost.given_inputs(plant.nu)
        if given is not None:
            return given[np.minimum(np.arange(steps), len(given) - 1)]
        if problem.cost.u_target == "zero":
            return np.zeros((steps, plant.nu))
        seen = state_tracking(plant.states, plant.nu, problem.cost, problem.limits_of(case))
        equilibria = Equilibria(learned_map(plant), problem.cost, seen)
        rows = np.broadcast_to(np.asarray(problem.cases[case].reference), (steps + 1, len(seen.Q)))
        distinct, of = np.unique(rows[:steps], axis=0, return_inverse=True)
        held = [equilibria.find(row) or equilibria.guess(row) for row in distinct]
        return np.array([each.u for each in held])[of.ravel()]

    @cached_property
    def data(self) -> Episodes:
        """Episodes of the plant under the problem's excitation."""
        training = self.problem.training
        return collect(
            self.truth,
            training.x0,
            training.excitation,
            episodes=training.episodes,
            steps=training.steps,
            rng=training.seed,
        )

    @cached_property
    def model(self) -> LinearPredictor:
        """z⁺ = A z + B u fitted to the data; `training_time` [s] is how long data and fit took."""
        start = time.perf_counter()
        model = edmd(self.data, self.problem.lifting, ridge=self.problem.ridge)
        self.training_time = time.perf_counter() - start
        return model

    @cached_property
    def bilinear(self) -> BilinearPredictor:
        """z⁺ = A z + B u + Σ uᵢ Nᵢ z fitted to the same data with the same lifting."""
        return bilinear_edmd(self.data, self.problem.lifting, ridge=self.problem.ridge, difference=True)


Build = Callable[[Prepared, Limits], Controller]


def _lqr(parts: Prepared, limits: Limits) -> Controller:
    """LQR on the model's linearisation at the equilibrium."""
    model = LinearPredictor.local(parts.step_map, *parts.problem.equilibrium)
    return LQR(model, parts.problem.cost, limits)


def _koopman_lqr(parts: Prepared, limits: Limits) -> Controller:
    """LQR on the lifted predictor, learned from data."""
    return LQR(parts.model, parts.problem.cost, limits)


def _linear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the model's linearisation at the equilibrium."""
    problem = parts.problem
    return LinearMPC(parts.step_map, *problem.equilibrium, problem.cost, limits, problem.horizon)


def _koopman_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the lifted predictor, learned from data."""
    return KoopmanMPC(parts.model, parts.problem.cost, limits, parts.problem.horizon)


def _offset_free(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the lifted predictor, with an estimated disturbance of every lifted coordinate."""
    problem = parts.problem
    return KoopmanMPC(parts.model, problem.cost, limits, problem.horizon, estimator=LiftedDisturbance())


def _bilinear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """Real-time iteration on the bilinear predictor, which is lifted anew at every step of the plan."""
    return BilinearMPC(parts.bilinear, parts.problem.cost, limits, parts.problem.horizon)


def _bilinear_offset(parts: Prepared, limits: Limits) -> Controller:
    """The same on the bilinear predictor, with an estimated disturbance of every state."""
    problem = parts.problem
    return BilinearMPC(parts.bilinear, problem.cost, limits, problem.horizon, estimator=LiftedDisturbance())


def _designed(parts: Prepared, limits: Limits) -> Controller:
    """What `design` makes of the data, for the first case's reference and the starts of all cases."""
    problem = parts.problem
    cases = list(problem.cases.values())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # of cases that ask for what the data do not hold
        return design(
            parts.data,
            problem.cost,
            limits,
            horizon=problem.horizon,
            reference=cases[0].reference,
            starts=np.array([case.x0 for case in cases]),
            angles=problem.angles,
        ).controller


def _nonlinear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the model itself, the best of twelve initial guesses: the oracle where the model is the plant."""
    return NonlinearMPC(parts.step_map, parts.problem.cost, limits, parts.problem.horizon, starts=12)


CONTROLLERS: dict[str, Build] = {
    "lqr": _lqr,
    "koopman-lqr": _koopman_lqr,
    "linear-mpc": _linear_mpc,
    "koopman-mpc": _koopman_mpc,
    "offset-free": _offset_free,
    "bilinear-mpc": _bilinear_mpc,
    "bilinear-offset": _bilinear_offset,
    "nonlinear-mpc": _nonlinear_mpc,
    "designed": _designed,
}
ASKED = ("designed",)  # a design takes up to a minute, so it runs where it is named

LEARNED = ("koopman-lqr", "koopman-mpc", "offset-free", "bilinear-mpc", "bilinear-offset", "designed")


def controller_names(names: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names as a tuple, by default all but "designed", which has to be named.

    Raises
    ------
    ProblemError
        There is no such controller, and the message names the nearest; one is named twice.
    """
    names = tuple(names or (name for name in CONTROLLERS if name not in ASKED))
    for name in names:
        if name not in CONTROLLERS:
            raise ProblemError(
                f"there is no controller {name!r}{nearest(name, CONTROLLERS)}; there are {', '.join(CONTROLLERS)}"
            )
        if names.count(name) > 1:
            raise ProblemError(
                f"the controller {name!r} is named twice, and its logs would have one name; name it once"
            )
    return names
