"""What the controllers and cases of one problem share, built once: the step map, the truth, the data, the model."""

import time
from functools import cached_property

from koopmpc.bench.problem import Problem
from koopmpc.data.collect import collect
from koopmpc.data.episodes import Episodes
from koopmpc.identify.edmd import edmd
from koopmpc.plant.dynamics import Dynamics
from koopmpc.plant.simulated import Plant
from koopmpc.plant.step_map import StepMap, discretize
from koopmpc.predict.linear import LinearPredictor


class Prepared:
    """The parts of a problem, each built when it is first asked for and then kept.

    `model` is made from data alone; `step_map` is what linear and nonlinear controllers are given.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.training_time = 0.0

    @cached_property
    def step_map(self) -> StepMap:
        """x⁺ = F(x, u) of the problem's dynamics."""
        return discretize(self.problem.dynamics, self.problem.dt, self.problem.integrator)

    @cached_property
    def truth(self) -> StepMap | Plant:
        """The plant that is driven: the problem's `plant`, or its model where there is none."""
        plant = self.problem.plant
        if plant is None:
            return self.step_map
        if isinstance(plant, Dynamics):
            return discretize(plant, self.problem.dt, self.problem.integrator)
        return plant

    @cached_property
    def data(self) -> Episodes:
        """Episodes of the truth under the problem's excitation."""
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
        """z⁺ = A z + B u fitted to the data; `training_time` [s] is what data and fit took."""
        start = time.perf_counter()
        model = edmd(self.data, self.problem.lifting, ridge=self.problem.ridge)
        self.training_time = time.perf_counter() - start
        return model
