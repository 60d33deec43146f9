"""Duffing: a beam between two magnets is carried from one well to the other, and held on the ridge between them.

A particle in the double well V = −x²/2 + x⁴/4 with damping, a model of F. Moon and P. Holmes, "A magnetoelastic
strange attractor", J. Sound and Vibration 65 (1979), with the damping of Q. Li et al., "Extended dynamic mode
decomposition with dictionary learning", Chaos 27 (2017). The ridge at x = 0 is unstable, the wells at ±1 are stable;
crossing from rest in a well takes more than 0.385 m/s² where there is no swing.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Duffing(km.Dynamics):
    """ẍ = a x − b x³ − c ẋ + u."""

    states = ("x [m]", "v [m/s]")
    inputs = ("u [m/s²]",)

    a: float = 1.0  # push away from the ridge [1/s²]
    b: float = 1.0  # pull back from far out [1/(m² s²)]
    c: float = 0.5  # damping [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, a x − b x³ − c v + u]."""
        return ca.vertcat(x[1], self.a * x[0] - self.b * x[0] ** 3 - self.c * x[1] + u[0])

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the potential, four times as high as it is, a ball in it, and the input as a bar of 1 m for 2 m/s²."""

        def height(s: float) -> float:
            return 4.0 * (-self.a * s**2 / 2 + self.b * s**4 / 4)

        at = (float(x[0]), height(float(x[0])) + 0.12)
        well = [(float(s), height(float(s))) for s in np.linspace(-1.7, 1.7, 60)]
        return [
            km.scene.Line("potential", well, width=0.04, color=(120, 130, 150)),
            km.scene.Line("u", [at, (at[0] + float(u[0]) / 2, at[1])], width=0.05, color=(40, 120, 200)),
            km.scene.Disk("ball", at, 0.12),
        ]


plant, left, right, ridge = Duffing(), [-1.0, 0.0], [1.0, 0.0], [0.0, 0.0]
t = 0.1 * np.arange(201)
sine = np.column_stack([np.sin(0.8 * t), 0.8 * np.cos(0.8 * t)])


problem = km.Problem(
    dynamics=plant,
    dt=0.1,
    equilibrium=(ridge, [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.6, -1.6], [1.6, 1.6]), excitation=km.Noise(-2.0, 2.0), episodes=400, steps=15
    ),
    lifting=km.State() + km.Monomials(5) + km.Constant(),
    cost=km.Cost(Q=[10.0, 1.0], R=1.0),
    limits=km.Limits(u_min=-2.0, u_max=2.0),
    horizon=20,
    cases={
        "cross": km.Case(x0=left, reference=right, steps=120),
        "ridge": km.Case(x0=[-1.2, 0.5], reference=ridge, steps=120),
        "track": km.Case(x0=left, reference=sine, steps=200),
        "beyond": km.Case(
            x0=left, reference=right, steps=120, limits=km.Limits(u_min=-2, u_max=2, x_max=[0.8, np.inf])
        ),
        "wrong": km.Case(x0=left, reference=ridge, steps=120, plant=Duffing(a=1.2, b=0.8, c=0.4)),
        "noise": km.Case(x0=left, reference=ridge, steps=120, noise=[0.02, 0.02]),
        "delay": km.Case(x0=left, reference=ridge, steps=120, faults=[km.faults.ActuatorDelay(1)]),
    },
)
