"""Small plants for the tests of this room."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km

GRAVITY = 9.81


@dataclass(frozen=True)
class Pendulum(km.Dynamics):
    damping: float = 0.0  # [1/s]

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], -GRAVITY * ca.sin(x[0]) - self.damping * x[1] + u)


def energy(X: np.ndarray) -> np.ndarray:
    """Energy a unit of mass of the undamped pendulum of 1 m, (…, 2) -> (…)."""
    return 0.5 * X[..., 1] ** 2 + GRAVITY * (1 - np.cos(X[..., 0]))


@dataclass(frozen=True)
class CartPole(km.Dynamics):
    cart: float = 1.0  # [kg]
    pole: float = 0.2  # [kg]
    length: float = 0.5  # [m]

    states = ("p [m]", "theta [rad]", "v [m/s]", "omega [rad/s]")
    inputs = ("force [N]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        s, c = ca.sin(x[1]), ca.cos(x[1])
        pull = u + self.pole * self.length * x[3] ** 2 * s
        total = self.cart + self.pole
        alpha = (GRAVITY * s * total - pull * c) / (self.length * (total - self.pole * c**2))
        return ca.vertcat(x[2], x[3], (pull - self.pole * self.length * alpha * c) / total, alpha)


@dataclass(frozen=True)
class Spring(km.Dynamics):
    """A linear plant of which one mixed output is measured."""

    states = ("x [m]", "v [m/s]")
    inputs = ()

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], -x[0])

    def measure(self, x: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], x[0] + 2 * x[1])
