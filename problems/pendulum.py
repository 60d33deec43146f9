"""Pendulum: driven upright from π/4, and from hanging with a torque too weak to lift it.

Undamped, m = 1 kg on a massless rod of L = 2 m, driven by a torque at the pivot: the plant of G. Snyder and
Z. Song, "Koopman Operator Theory for Nonlinear Dynamic Modeling using Dynamic Mode Decomposition" (2021). θ = 0 is
upright. Holding the rod level takes m g L = 19.6 N m, so `hang` with its 10 N m has to swing.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Pendulum(km.Dynamics):
    """θ̈ = (g/L) sin θ + u / (m L²)."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 1.0  # mass [kg]
    L: float = 2.0  # length [m]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ω, (g/L) sin θ + u / (m L²)]."""
        theta, omega = x[0], x[1]
        return ca.vertcat(omega, self.g / self.L * ca.sin(theta) + u[0] / (self.m * self.L**2))

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the rod, the bob, the pivot and the torque as an arc."""
        theta, L = float(x[0]), self.L
        bob = (L * float(np.sin(theta)), L * float(np.cos(theta)))
        sweep = np.linspace(0.0, float(np.clip(u[0] / 25.0, -1.0, 1.0)) * np.pi, 24)
        arc = [(0.5 * float(np.sin(a)), 0.5 * float(np.cos(a))) for a in sweep]
        return [
            km.scene.Line("rod", [(0.0, 0.0), bob], width=0.05),
            km.scene.Disk("pivot", (0.0, 0.0), 0.07, color=(70, 90, 110)),
            km.scene.Disk("bob", bob, 0.16),
            km.scene.Line("torque", arc, width=0.05, color=(40, 120, 200)),
        ]


pendulum = Pendulum()


def products(x: ca.SX) -> list[ca.SX]:
    """Return ω sin kθ and ω cos kθ for k = 1, 2, and ω²."""
    theta, omega = x[0], x[1]
    return [
        omega * ca.sin(theta),
        omega * ca.cos(theta),
        omega * ca.sin(2 * theta),
        omega * ca.cos(2 * theta),
        omega**2,
    ]


names = ["omega sin(theta)", "omega cos(theta)", "omega sin(2 theta)", "omega cos(2 theta)", "omega²"]


problem = km.Problem(
    dynamics=pendulum,
    dt=0.05,
    equilibrium=([0.0, 0.0], [0.0]),
    # An upright plant is identified in closed loop: without feedback it falls, and data of falling spoil the fit.
    training=km.Training(
        x0=km.Uniform([-1.0, -1.0], [1.0, 1.0]),
        excitation=km.Feedback([[40.0, 15.0]], km.Noise(-20.0, 20.0), u_min=-25.0, u_max=25.0),
        episodes=200,
        steps=60,
    ),
    lifting=km.State() + km.Fourier(2, states="theta") + km.Expressions(products, names) + km.Constant(),
    cost=km.Cost(Q=[10.0, 1.0], R=0.1),
    limits=km.Limits(u_min=-25.0, u_max=25.0),
    horizon=40,
    cases={
        "upright": km.Case(x0=[np.pi / 4, 0.0], reference=[0.0, 0.0], steps=200),
        "hang": km.Case(x0=[np.pi, 0.0], reference=[0.0, 0.0], steps=300, limits=km.Limits(u_min=-10.0, u_max=10.0)),
        # The bob weighs a fifth more than the controllers know; it takes 17 N m to hold it there.
        "hold": km.Case(x0=[np.pi / 4, 0.0], reference=[0.8, 0.0], steps=200, plant=Pendulum(m=1.2)),
    },
    angles=(0,),
)
