"""The pendulum of problems/pendulum.py, learned once; and true ones of other mass, with a load, seen in part."""

from dataclasses import dataclass, replace
from functools import cache

import casadi as ca

import koopmpc as km

SETPOINT = 0.8  # rad, held by −14.1 N m of the 25 N m there are
PROBLEM = km.load_problem("pendulum")


@dataclass(frozen=True)
class Loaded(km.Dynamics):
    """θ̈ = (g/L) sin θ + (u + load) / (m L²), of which θ alone is measured, or θ and ω."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 1.0
    load: float = 0.0
    seen: int = 2

    def rhs(self, x, u):
        return ca.vertcat(x[1], 9.81 / 2 * ca.sin(x[0]) + (u[0] + self.load) / (4 * self.m))

    def measure(self, x):
        return x[: self.seen]


@cache
def learned():
    training = PROBLEM.training
    plant = km.discretize(PROBLEM.dynamics, PROBLEM.dt)
    data = km.collect(
        plant,
        training.x0,
        training.excitation,
        episodes=training.episodes,
        steps=training.steps,
        rng=training.seed,
    )
    return km.edmd(data, PROBLEM.lifting)


def truth(**changes):
    return km.discretize(replace(Loaded(), **changes), PROBLEM.dt)


def angle():
    """θ alone as the tracked output: one input promises no offset in one output."""
    return km.Expressions(lambda x: [x[0]], ["theta [rad]"])
