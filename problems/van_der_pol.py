"""Van der Pol: an oscillator that leaves its rest by itself is brought to it, and along a sine.

The first example of M. Korda and I. Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets
model predictive control", Automatica 93 (2018), with their coefficients. The origin is unstable; without input every
run ends on a limit cycle. Data with inputs within ±1 from random states, as theirs.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class VanDerPol(km.Dynamics):
    """ẋ₁ = 2 x₂,  ẋ₂ = −k x₁ + μ x₂ − c x₁² x₂ + u."""

    states = ("x1 [1]", "x2 [1]")
    inputs = ("u [1/s]",)

    k: float = 0.8  # stiffness [1/s]
    mu: float = 2.0  # negative damping at rest [1/s]
    c: float = 10.0  # damping far from it [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [2 x₂, −k x₁ + μ x₂ − c x₁² x₂ + u]."""
        return ca.vertcat(2 * x[1], -self.k * x[0] + self.mu * x[1] - self.c * x[0] ** 2 * x[1] + u[0])

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the phase plane, x₁ to the right and x₂ up, with the axes, the state and the input as a bar."""
        at = (float(x[0]), float(x[1]))
        return [
            km.scene.Line("x1_axis", [(-1.2, 0.0), (1.2, 0.0)], width=0.01, color=(150, 160, 170)),
            km.scene.Line("x2_axis", [(0.0, -1.2), (0.0, 1.2)], width=0.01, color=(150, 160, 170)),
            km.scene.Line("u", [at, (at[0], at[1] + 0.3 * float(u[0]))], width=0.03, color=(40, 120, 200)),
            km.scene.Disk("state", at, 0.05),
        ]


plant, rest = VanDerPol(), [0.0, 0.0]
t = 0.05 * np.arange(241)  # x₁ = 0.5 sin t, and x₂ = ẋ₁ / 2
sine = np.column_stack([0.5 * np.sin(t), 0.25 * np.cos(t)])


problem = km.Problem(
    dynamics=plant,
    dt=0.05,
    equilibrium=(rest, [0.0]),
    training=km.Training(x0=km.Uniform([-1, -1], [1, 1]), excitation=km.Noise(-1.0, 1.0), episodes=400, steps=25),
    lifting=km.State() + km.Monomials(5) + km.Constant(),
    cost=km.Cost(Q=[10.0, 1.0], R=0.1),
    limits=km.Limits(u_min=-1.0, u_max=1.0),
    horizon=30,
    cases={
        "rest": km.Case(x0=[0.8, -0.6], reference=rest, steps=160),
        "reach": km.Case(x0=rest, reference=[0.6, 0.0], steps=160),
        "track": km.Case(x0=rest, reference=sine, steps=240),
        "beyond": km.Case(
            x0=rest, reference=[0.6, 0.0], steps=160, limits=km.Limits(u_min=-1, u_max=1, x_max=[0.5, np.inf])
        ),
        "wrong": km.Case(x0=[0.8, -0.6], reference=[0.4, 0.0], steps=160, plant=VanDerPol(k=0.96, mu=2.4, c=8.0)),
        "noise": km.Case(x0=[0.8, -0.6], reference=rest, steps=160, noise=[0.01, 0.01]),
        "delay": km.Case(x0=[0.8, -0.6], reference=rest, steps=160, faults=[km.faults.ActuatorDelay(1)]),
    },
)
