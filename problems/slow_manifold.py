"""Slow manifold: a polynomial plant that three observables make linear, driven to rest along x₂ = x₁².

On z = [x₁, x₂, x₁²] the plant is linear: S. Brunton, B. Brunton, J. Proctor and N. Kutz, "Koopman Invariant
Subspaces and Finite Linear Representations of Nonlinear Dynamical Systems for Control", PLoS ONE 11 (2016), with
their μ = −0.1, λ = 1, Q = I and R = 1. `brunton` is their run, from [−5, 5]: an LQR of the linearisation costs more
than four times that of the lifted plant. x₂ is unstable, so bounded inputs hold it in a part of the plane alone.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class SlowManifold(km.Dynamics):
    """ẋ₁ = μ x₁,  ẋ₂ = λ (x₂ − x₁²) + u."""

    states = ("x1 [1]", "x2 [1]")
    inputs = ("u [1/s]",)

    mu: float = -0.1  # rate along the manifold [1/s]
    lam: float = 1.0  # rate away from it [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [μ x₁, λ (x₂ − x₁²) + u]."""
        return ca.vertcat(self.mu * x[0], self.lam * (x[1] - x[0] ** 2) + u[0])

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the plane, x₁ to the right and x₂ / 5 up: the manifold, the state, and the input as a bar, 1 for 10."""
        curve = [(float(a), float(a) ** 2 / 5.0) for a in np.linspace(-5.5, 5.5, 45)]
        at = (float(x[0]), float(x[1]) / 5.0)
        return [
            km.scene.Line("axis", [(-6.0, 0.0), (6.0, 0.0)], width=0.04, color=(150, 160, 170)),
            km.scene.Line("manifold", curve, width=0.06, color=(120, 130, 150)),
            km.scene.Line("u", [at, (at[0], at[1] + float(u[0]) / 10.0)], width=0.1, color=(40, 120, 200)),
            km.scene.Disk("state", at, 0.2),
        ]


def square(x: ca.SX) -> list[ca.SX]:
    """Return x₁², which closes the plant under its own flow."""
    return [x[0] ** 2]


rest, plant = [0.0, 0.0], SlowManifold()
sine = np.column_stack([np.zeros(401), np.sin(2 * np.pi * np.arange(401) / 200)])
bounded = km.Limits(u_min=-8.0, u_max=8.0)


problem = km.Problem(
    dynamics=plant,
    dt=0.05,
    equilibrium=(rest, [0.0]),
    training=km.Training(
        x0=km.Uniform([-6.0, -6.0], [6.0, 12.0]), excitation=km.Noise(-20.0, 20.0), episodes=200, steps=10
    ),
    lifting=km.State() + km.Expressions(square, ["x1²"]),
    cost=km.Cost(Q=[1.0, 1.0], R=1.0),
    limits=km.Limits(u_min=-40.0, u_max=40.0),
    horizon=40,
    cases={
        "brunton": km.Case(x0=[-5.0, 5.0], reference=rest, steps=400),
        "bounded": km.Case(x0=[-2.8, 4.0], reference=rest, steps=400, limits=bounded),
        "track": km.Case(x0=[2.0, 0.0], reference=sine, steps=400),
        "beyond": km.Case(  # x₂ is asked to rest where it must not be
            x0=[-2.0, 0.0], reference=[0.0, 2.0], steps=300, limits=km.Limits(u_min=-8, u_max=8, x_max=[np.inf, 1.5])
        ),
        "wrong": km.Case(x0=[-4.0, 4.0], reference=rest, steps=400, plant=SlowManifold(mu=-0.08, lam=1.2)),
        "noise": km.Case(x0=[-4.0, 4.0], reference=rest, steps=400, noise=[0.05, 0.05]),
        "delay": km.Case(x0=[-4.0, 4.0], reference=rest, steps=400, faults=[km.faults.ActuatorDelay(1)]),
    },
)
