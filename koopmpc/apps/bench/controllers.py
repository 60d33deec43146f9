"""The controllers of the bench, and what they share of one problem: step map, plant, data and models."""

import dataclasses
import json
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.apps.bench.problem import Problem
from koopmpc.base import disk
from koopmpc.base.checks import nearest
from koopmpc.base.errors import DataError, ProblemError, hide_fit_warnings
from koopmpc.control.ask.limits import Limits
from koopmpc.control.function import as_controller
from koopmpc.control.kinds import BenchEntry, list_bench
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear.equilibrium import Equilibria
from koopmpc.control.nonlinear.stages import learned_map
from koopmpc.control.plan.tracking import state_tracking
from koopmpc.data.collect import Uniform, collect
from koopmpc.data.episodes import Episodes
from koopmpc.loop.monitor import Monitor
from koopmpc.models.fits.bilinear import bilinear_edmd
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor, load_model
from koopmpc.plants.dynamics import Dynamics
from koopmpc.plants.plant import Plant, SimulatedPlant
from koopmpc.plants.step_map import StepMap, discretize
from koopmpc.synthesis.design import design
from koopmpc.synthesis.designed import Design, load_controller, rebuild_controller
from koopmpc.synthesis.options import DesignOptions


class Prepared:
    """The parts of a problem; each is built when it is first used and then kept.

    Koopman controllers get `model` or `bilinear`, which are fitted to data alone; the others get `step_map`.

    Parameters
    ----------
    problem
        The problem.
    monitored
        Whether controllers of learned models have a monitor, which says at each step whether it is like the data.
    seed
        Added to the seed of the training data.
    kept
        The folder of `save_models`; models in it are read and not learned again.
    """

    def __init__(self, problem: Problem, seed: int = 0, kept: Path | None = None, *, monitored: bool = False) -> None:
        self.problem, self.seed, self._monitored = problem, seed, monitored
        self._controllers: dict[tuple[str, str], Controller] = {}
        self._kept = None if kept is None else kept / f"{problem.name}-{seed}"
        self._designs: list[tuple[Limits, Design]] = []
        self.training_time = 0.0
        self._held: dict[str, Float[np.ndarray, "T nu"]] = {}
        self._plants: dict[str, StepMap | Plant] = {}  # of the cases that have one of their own

    def save_models(self, names: Iterable[str]) -> None:
        """Learn what these controllers need, and write it into the folder `kept`, for all workers.

        A model that cannot be written as data is learned by each worker itself.
        """
        kept, names = self._kept, set(names)
        if kept is None:
            return
        numbers = {"training_time": 0.0, "spread": self.spread.tolist()}
        with suppress(DataError):
            models = {CONTROLLERS[name].model for name in names}
            if "linear" in models:
                self.model.save(f"{kept}-linear.npz")
                numbers["training_time"] = self.training_time
            if "bilinear" in models:
                self.bilinear.save(f"{kept}-bilinear.npz")
            if "designed" in models:
                for case in self.problem.cases:
                    self.design(self.problem.limits_of(case)).save(f"{kept}-{case}.npz")
        with disk.writing(f"{kept}.json") as stream:
            stream.write(json.dumps(numbers).encode())

    def _file(self, ending: str) -> Path | None:
        """Return the file of this ending that `save_models` wrote; None where it did not."""
        if self._kept is None:
            return None
        path = Path(f"{self._kept}{ending}")
        return path if path.is_file() else None

    @cached_property
    def _numbers(self) -> dict[str, Any]:
        """Numbers that `save_models` wrote beside the models."""
        file = self._file(".json")
        return {} if file is None else json.loads(file.read_bytes())

    @cached_property
    def spread(self) -> Float[np.ndarray, " ny"]:
        """Standard deviation of each measured output in the training data."""
        known = self._numbers.get("spread")
        return np.vstack([e.X for e in self.data]).std(axis=0) if known is None else np.array(known)

    def controller(self, name: str, case: str) -> Controller:
        """Return the controller of this name for the limits of a case; it is built once, and `simulate` resets it.

        A controller that learns while it runs is built for each run.
        """
        if (name, case) not in self._controllers or name == "adaptive":
            self._controllers[name, case] = CONTROLLERS[name].build(self, self.problem.limits_of(case))
        return self._controllers[name, case]

    @cached_property
    def step_map(self) -> StepMap:
        """x⁺ = F(x, u) of the problem's dynamics."""
        return discretize(self.problem.dynamics, self.problem.dt, self.problem.integrator)

    @cached_property
    def local_model(self) -> LinearPredictor:
        """The problem's equations, linearised at the equilibrium: x⁺ ≈ A x + B u + E w + c."""
        return LinearPredictor.local(self.step_map, *self.problem.equilibrium)

    @cached_property
    def truth(self) -> StepMap | Plant:
        """The problem's `plant`, by default its model."""
        plant = self.problem.plant
        return self.step_map if plant is None else _discretize(plant, self.problem)

    def truth_of(self, case: str) -> StepMap | Plant:
        """Return the plant of this case, by default the problem's."""
        plant = self.problem.cases[case].plant
        if plant is None:
            return self.truth
        if case not in self._plants:
            self._plants[case] = _discretize(plant, self.problem)
        return self._plants[case]

    def perturb_plant(self, case: str, wrong: float, start: int) -> StepMap | Plant:
        """Return the plant of a case with each parameter times 1 + e, e uniform in ±`wrong`.

        Raises
        ------
        ProblemError
            The plant is no Dynamics whose fields are numbers.
        """
        problem = self.problem
        given = (problem.cases[case].plant, problem.plant)
        own = next((plant for plant in given if plant is not None), problem.dynamics)
        fields = dataclasses.fields(own) if isinstance(own, Dynamics) and dataclasses.is_dataclass(own) else ()
        values = {f.name: getattr(own, f.name) for f in fields if type(getattr(own, f.name)) in (int, float)}
        if not values:
            raise ProblemError(
                f"{problem.name}:{case}: its plant has no numbers as fields, so none can be wrong; leave out wrong=, or"
                " make the plant a dataclass with its parameters as fields"
            )
        e = np.random.default_rng([start, 1]).uniform(-wrong, wrong, len(values)).tolist()
        changed = {name: value * (1.0 + share) for (name, value), share in zip(values.items(), e, strict=True)}
        return _discretize(dataclasses.replace(cast("Any", own), **changed), problem)

    def initial_state(self, case: str, start: int) -> Float[np.ndarray, " nx"]:
        """Return an initial state: the case's own for 0, else one of the box that training data begin in."""
        given = np.asarray(self.problem.cases[case].x0, dtype=np.float64)
        if start == 0:
            return given
        begin = self.problem.training.x0
        rng = np.random.default_rng([start, 2])
        ends = (
            np.vstack([begin.low, begin.high])
            if isinstance(begin, Uniform)
            else np.atleast_2d(np.array(begin, dtype=np.float64))
        )
        low, high = np.asarray(ends.min(axis=0)), np.asarray(ends.max(axis=0))
        return low + (high - low) * rng.random(len(low))

    def u_reference(self, case: str) -> Float[np.ndarray, "T nu"]:
        """Return the inputs that hold the references of a case on its plant.

        For a plant without equations they are those of the model; for a cost whose u_target is "zero" they are zero.
        They are computed once, for all controllers.
        """
        if case not in self._held:
            self._held[case] = self.find_held_inputs(case, self.truth_of(case))
        return self._held[case]

    def find_held_inputs(self, case: str, truth: StepMap | Plant) -> Float[np.ndarray, "T nu"]:
        """Return the inputs that hold the references of a case on this plant."""
        problem, steps = self.problem, self.problem.cases[case].steps
        known = truth.step_map if isinstance(truth, SimulatedPlant) else truth
        plant = known if isinstance(known, StepMap) else self.step_map
        given = problem.cost.given_inputs(plant.nu)
        if given is not None:
            return given[np.minimum(np.arange(steps), len(given) - 1)]
        if problem.cost.u_target == "zero":
            return np.zeros((steps, plant.nu))
        seen = state_tracking(plant.states, plant.inputs, problem.cost, problem.limits_of(case))
        rows = np.broadcast_to(np.asarray(problem.cases[case].reference), (steps + 1, len(seen.Q)))[:steps]
        W = problem.measured_of(case) if plant.nw else None
        W = np.empty((steps, 0)) if W is None else W

        @cache
        def search(*w: float) -> Equilibria:
            return Equilibria(learned_map(plant.at(w) if w else plant), seen)

        distinct, of = np.unique(np.hstack([W, rows]), axis=0, return_inverse=True)
        held = [(search(*each[: plant.nw]), each[plant.nw :]) for each in distinct]
        inputs = [(equilibria.find(row) or equilibria.guess(row)).u for equilibria, row in held]
        return np.array(inputs)[of.ravel()]

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
            rng=training.seed + self.seed,
            measured=training.measured,
        )

    @cached_property
    def model(self) -> LinearPredictor:
        """z⁺ = A z + B u + E w fitted to the data; `training_time` [s] is how long data and fit took."""
        if (file := self._file("-linear.npz")) is not None:
            self.training_time = self._numbers.get("training_time", 0.0)
            return cast("LinearPredictor", load_model(file))
        start = time.perf_counter()
        model = edmd(self.data, self.problem.lifting, ridge=self.problem.ridge)
        self.training_time = time.perf_counter() - start
        return model

    @property
    def monitor_data(self) -> Episodes | None:
        """The data for a monitor; None where no controller has one."""
        return self.data if self._monitored else None

    def design(self, limits: Limits) -> Design:
        """Return the design for the first case's reference and the starts of all cases."""
        known = next((found for own, found in self._designs if own == limits), None)
        if known is not None:
            return known
        problem = self.problem
        cases = list(problem.cases.values())
        with hide_fit_warnings():  # a case may ask for states that the data do not hold
            found = design(
                self.data,
                problem.cost,
                limits,
                horizon=problem.horizon,
                reference=cases[0].reference,
                starts=np.array([case.x0 for case in cases]),
                options=DesignOptions(angles=problem.angles),
            )
        self._designs.append((limits, found))
        return found

    @cached_property
    def bilinear(self) -> BilinearPredictor:
        """z⁺ = A z + B u + Σ uᵢ Nᵢ z, with every product of w, fitted to the same data with the same lifting."""
        if (file := self._file("-bilinear.npz")) is not None:
            return cast("BilinearPredictor", load_model(file))
        own: dict[str, Any] = {"scheduled_inputs": True} if self.data.nw else {}  # w changes B, too
        return bilinear_edmd(self.data, self.problem.lifting, ridge=self.problem.ridge, difference=True, **own)

    def load_design(self, limits: Limits) -> Any:
        """Return the designed controller for these limits that `save_models` wrote; None where it did not."""
        case = next((case for case in self.problem.cases if self.problem.limits_of(case) == limits), None)
        file = None if case is None else self._file(f"-{case}.npz")
        return None if file is None else load_controller(file)


def _discretize(plant: Dynamics | StepMap | Plant, problem: Problem) -> StepMap | Plant:
    return discretize(plant, problem.dt, problem.integrator) if isinstance(plant, Dynamics) else plant


def _build_designed(parts: Prepared, limits: Limits) -> Controller:
    """Return the designed controller; one design serves all cases with these limits."""
    kept = parts.load_design(limits)
    saved = (parts.design(limits).controller if kept is None else kept).as_data()
    if parts.monitor_data is not None:
        assert saved.model is not None, "design chooses controllers of learned models"
        saved = replace(saved, monitor=Monitor.of(saved.model, parts.monitor_data))
    return rebuild_controller(saved, "the design")


CONTROLLERS = list_bench()
"""Name → `BenchEntry` of all controllers."""
CONTROLLERS["designed"] = BenchEntry(
    "designed",
    "The controller that km.design chooses, by closed loops on models learned from the same data.",
    "designed",
    _build_designed,
    on_request=True,  # a design takes up to a minute
)


def register_law(name: str, law: Callable[..., ArrayLike], explanation: str = "A function u = f(y, r).") -> None:
    """Register a plain function u = f(y, r) as a controller of the bench, which runs where it is named.

    Call it in the file of a problem, so that each worker process of a sweep calls it too.

    Parameters
    ----------
    name, explanation
        For ``koopmpc run -c`` and for ``koopmpc explain``.
    law
        (ny,) measurement and (nr,) reference row to (nu,) inputs. Nothing clips them: a sweep reports an input that is
        beyond a limit.
    """

    def build(parts: Any, limits: Limits) -> Controller:
        del limits
        return as_controller(law, parts.problem.dt, len(parts.step_map.inputs))

    CONTROLLERS[name] = BenchEntry(name, explanation, "equations", build, on_request=True)


def is_learned(name: str) -> bool:
    """Return whether a controller of the bench learns its model from data."""
    return name in CONTROLLERS and CONTROLLERS[name].model != "equations"


def controller_names(names: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names as a tuple, by default all but "adaptive" and "designed", which have to be named.

    Raises
    ------
    ProblemError
        There is no such controller, and the message names the nearest; one is named twice.
    """
    names = tuple(names or (name for name, entry in CONTROLLERS.items() if not entry.on_request))
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
