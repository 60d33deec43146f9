"""Pendulum swing-up: from any angle to upright with half the torque that would lift it.

The plant of G. Snyder and Z. Song, "Koopman Operator Theory for Nonlinear Dynamic Modeling using Dynamic Mode
Decomposition" (2021): undamped, m = 1 kg on a massless rod of L = 2 m, driven by a torque at the pivot, θ = 0 upright.
Holding the rod level takes m g L = 19.6 N m; the torque is limited to 10 N m. The model is learned from random
torques, and the cost is on sin θ and cos θ, which together weigh 2 (1 − cos θ): every turn counts the same.
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
        sweep = np.linspace(0.0, float(np.clip(u[0] / 10.0, -1.0, 1.0)) * np.pi, 24)
        arc = [(0.5 * float(np.sin(a)), 0.5 * float(np.cos(a))) for a in sweep]
        return [
            km.scene.Line("rod", [(0.0, 0.0), bob], width=0.05),
            km.scene.Disk("pivot", (0.0, 0.0), 0.07, color=(70, 90, 110)),
            km.scene.Disk("bob", bob, 0.16),
            km.scene.Line("torque", arc, width=0.05, color=(40, 120, 200)),
        ]


pendulum = Pendulum()


def products(x: ca.SX) -> list[ca.SX]:
    """Return ω and ω² times sin kθ and cos kθ, k = 1, 2, and ω²."""
    theta, omega = x[0], x[1]
    waves = [f(k * theta) for k in (1, 2) for f in (ca.sin, ca.cos)]
    return [omega**n * wave for n in (1, 2) for wave in waves] + [omega**2]


names = [f"omega^{n} {f}({k} theta)" for n in (1, 2) for k in (1, 2) for f in ("sin", "cos")]
tracked = ("sin(theta)", "cos(theta)", "omega [rad/s]")


problem = km.Problem(
    dynamics=pendulum,
    dt=0.05,
    equilibrium=([0.0, 0.0], [0.0]),
    training=km.Training(
        x0=km.Uniform([-np.pi, -6.0], [np.pi, 6.0]), excitation=km.Noise(-10.0, 10.0), episodes=2000, steps=10
    ),
    lifting=km.State() + km.Fourier(2, states="theta") + km.Expressions(products, [*names, "omega^2"]) + km.Constant(),
    cost=km.Cost(
        Q=[5.0, 5.0, 0.1],
        R=0.01,
        of=km.Expressions(lambda x: [ca.sin(x[0]), ca.cos(x[0]), x[1]], tracked).bind(Pendulum.states),
    ),
    limits=km.Limits(u_min=-10.0, u_max=10.0),
    horizon=50,
    cases={
        "hang": km.Case(x0=[np.pi, 0.1], reference=[0.0, 1.0, 0.0], steps=200),
        "aside": km.Case(x0=[-2.0, 0.8], reference=[0.0, 1.0, 0.0], steps=200),
    },
    angles=(0,),
    controllers=("koopman-mpc", "bilinear-mpc", "nonlinear-mpc"),
)
