"""Cart-pole swing-up: from any angle to upright within a short rail, with a force too weak to do it at once.

A cart of 1 kg on a rail of ±2.4 m, pushed by at most 12 N, carries a pole of L = 0.5 m with a point mass of 0.2 kg at
its tip. θ = 0 is upright. The sign of the angular acceleration that a force gives turns with the pole, so no linear
predictor, with its one B, can swing it up; a bilinear one, learned from random pushes, can. The cost is on sin θ and
cos θ, which together weigh 2 (1 − cos θ): every turn of the pole counts the same.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class CartPole(km.Dynamics):
    """(M + m sin²θ) v̇ = u + m sin θ (L ω² − g cos θ),  L ω̇ = g sin θ − v̇ cos θ."""

    states = ("position [m]", "velocity [m/s]", "theta [rad]", "omega [rad/s]")
    inputs = ("force [N]",)

    M: float = 1.0  # cart mass [kg]
    m: float = 0.2  # pole mass, at the tip [kg]
    L: float = 0.5  # pole length [m]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, v̇, ω, ω̇]."""
        velocity, theta, omega = x[1], x[2], x[3]
        S, C = ca.sin(theta), ca.cos(theta)
        force = u[0] + self.m * S * (self.L * omega**2 - self.g * C)
        acceleration = force / (self.M + self.m * S**2)
        return ca.vertcat(velocity, acceleration, omega, (self.g * S - acceleration * C) / self.L)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the rail with its ends, the cart, the pole, and the force as a bar of 1 m for 12 N."""
        position, theta, L = float(x[0]), float(x[2]), self.L
        tip = (position + L * float(np.sin(theta)), L * float(np.cos(theta)))
        rail = [(-2.4, 0.15), (-2.4, -0.1), (2.4, -0.1), (2.4, 0.15)]
        return [
            km.scene.Line("rail", rail, width=0.02, color=(150, 160, 170)),
            km.scene.Box("cart", (position, 0.0), (0.3, 0.15)),
            km.scene.Line("pole", [(position, 0.0), tip], width=0.03, color=(120, 130, 150)),
            km.scene.Disk("tip", tip, 0.05),
            km.scene.Line(
                "force", [(position, 0.0), (position + float(u[0]) / 12.0, 0.0)], width=0.04, color=(40, 120, 200)
            ),
        ]


cart_pole = CartPole()
HARMONICS = (1, 2, 3, 4)


def products(x: ca.SX) -> list[ca.SX]:
    """Return ω and ω² times the harmonics of θ, ω² and ω³."""
    theta, omega = x[2], x[3]
    waves = [f(k * theta) for k in HARMONICS for f in (ca.sin, ca.cos)]
    return [omega**n * wave for n in (1, 2) for wave in waves] + [omega**2, omega**3]


names = [f"omega^{n} {f}({k} theta)" for n in (1, 2) for k in HARMONICS for f in ("sin", "cos")]
tracked = ("position [m]", "velocity [m/s]", "sin(theta)", "cos(theta)", "omega [rad/s]")


problem = km.Problem(
    dynamics=cart_pole,
    dt=0.05,
    equilibrium=([0.0, 0.0, 0.0, 0.0], [0.0]),
    training=km.Training(
        x0=km.Uniform([-2.4, -4.0, -np.pi, -12.0], [2.4, 4.0, np.pi, 12.0]),
        excitation=km.Noise(-12.0, 12.0),
        episodes=8000,
        steps=10,
    ),
    lifting=km.State()
    + km.Fourier(4, states="theta")
    + km.Expressions(products, [*names, "omega^2", "omega^3"])
    + km.Constant(),
    cost=km.Cost(
        Q=[1.0, 0.1, 5.0, 5.0, 0.1],
        R=0.01,
        of=km.Expressions(lambda x: [x[0], x[1], ca.sin(x[2]), ca.cos(x[2]), x[3]], tracked).bind(CartPole.states),
    ),
    limits=km.Limits(
        u_min=-12.0, u_max=12.0, x_min=[-2.4, -np.inf, -np.inf, -np.inf], x_max=[2.4, np.inf, np.inf, np.inf]
    ),
    horizon=40,
    cases={
        "hang": km.Case(x0=[0.0, 0.0, np.pi, 0.1], reference=[0.0, 0.0, 0.0, 1.0, 0.0], steps=200),
        "aside": km.Case(x0=[0.4, 0.0, -2.0, 0.8], reference=[0.0, 0.0, 0.0, 1.0, 0.0], steps=200),
    },
    angles=(2,),
    controllers=("koopman-mpc", "bilinear-mpc", "nonlinear-mpc"),
)
