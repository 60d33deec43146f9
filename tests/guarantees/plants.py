"""Plants and data of SafEDMD's two published examples (arXiv 2402.03145), and of the library."""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Invariant(km.Dynamics):
    """ẋ₁ = −2 x₁, ẋ₂ = x₂ − x₁² + u: linear in x₁, x₂ and x₂ − x₁²/5."""

    states: ClassVar[tuple[str, ...]] = ("x1", "x2")
    inputs: ClassVar[tuple[str, ...]] = ("u",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(-2 * x[0], x[1] - x[0] ** 2 + u[0])


@dataclass(frozen=True)
class Upright(km.Dynamics):
    """A pendulum of 1 kg and 1 m, damping 0.5, upright at 0."""

    states: ClassVar[tuple[str, ...]] = ("theta [rad]", "omega [rad/s]")
    inputs: ClassVar[tuple[str, ...]] = ("torque [N m]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - 0.5 * x[1] + u[0])


INVARIANT = km.State() + km.Expressions(lambda x: [x[1] - 0.2 * x[0] ** 2], ["e"])
SINE = km.State() + km.Expressions(lambda x: [ca.sin(x[0])], ["sin"])


def published_data(dynamics, low, high, count, noise, seed=0):
    """Return pairs for u = 0 and for u = 1, as in the authors' code; noise is on the second state of a pair."""
    plant, rng, episodes = km.discretize(dynamics, dt=0.01), np.random.default_rng(seed), []
    for u in (0.0, 1.0):
        X = rng.uniform(low, high, (count, 2))
        X_next = plant.rollouts(X, np.full((count, 1, 1), u))[:, 1]
        X_next += noise * rng.uniform(-1, 1, X.shape)
        episodes += [km.Episode(X=np.stack(pair), U=[[u]]) for pair in zip(X, X_next, strict=True)]
    return plant, km.Episodes(episodes, dt=plant.dt, states=plant.states, inputs=plant.inputs)


def library_task(name, share=0.5, episodes=2000):
    """Return the plant, a bilinear model, fresh pairs, input limits and the set point of a problem of the library."""
    problem = km.load_problem(name)
    plant = km.discretize(problem.dynamics, dt=problem.dt)
    x, u = (np.asarray(part, dtype=float) for part in problem.equilibrium)
    low, high = np.asarray(problem.training.x0.low), np.asarray(problem.training.x0.high)
    u_low, u_high = problem.limits.inputs(plant.nu)
    u_low = np.where(np.isfinite(u_low), u_low, u - 10)
    u_high = np.where(np.isfinite(u_high), u_high, u + 10)
    width = share * np.minimum(x - low, high - x)
    if (width <= 0).any():
        width = share * (high - low) / 4

    def gather(seed):
        return km.collect(
            plant, km.Uniform(x - width, x + width), km.Noise(u_low, u_high), episodes=episodes, steps=1, rng=seed
        )

    model = km.bilinear_edmd(gather(0), problem.lifting)
    return plant, model, gather(1), km.Limits(u_min=u_low, u_max=u_high), x, u
