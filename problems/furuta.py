"""Furuta pendulum: an arm turns in the plane so that the pendulum at its end stands upright.

K. Furuta, M. Yamakita and S. Kobayashi, "Swing-up control of inverted pendulum using pseudo-state feedback", J.
Systems and Control Engineering 206 (1992); equations of motion of B. Cazzolato and Z. Prime, "On the dynamics of the
Furuta pendulum", J. Control Science and Engineering (2011), with a slender rod on an arm without mass of its own. θ = 0
is upright. The torque is too weak to save the pendulum from more than 0.5 rad.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Furuta(km.Dynamics):
    """M(θ) [φ̈, θ̈] = [u − c φ̇ − J sin 2θ φ̇ θ̇ + h sin θ θ̇², ½ J sin 2θ φ̇² + G sin θ − b θ̇]."""

    states = ("arm [rad]", "theta [rad]", "arm rate [rad/s]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 0.1  # pendulum [kg]
    L: float = 0.25  # arm [m]
    l: float = 0.15  # pivot to centre of mass [m]  # noqa: E741
    I: float = 0.004  # inertia of arm and hub [kg m²]  # noqa: E741
    c: float = 0.002  # friction of the arm [N m s]
    b: float = 0.0002  # friction of the pendulum [N m s]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [φ̇, θ̇, φ̈, θ̈] with J = 4/3 m l², h = m L l, G = m g l and M = [I + m L² + J sin²θ, h cos θ; ·, J]."""
        turn, rate, S, C = x[2], x[3], ca.sin(x[1]), ca.cos(x[1])
        J, h = 4 / 3 * self.m * self.l**2, self.m * self.L * self.l
        arm = u[0] - self.c * turn - 2 * J * S * C * turn * rate + h * S * rate**2
        fall = J * S * C * turn**2 + self.m * self.g * self.l * S - self.b * rate
        outer = self.I + self.m * self.L**2 + J * S**2
        det = outer * J - (h * C) ** 2
        return ca.vertcat(turn, rate, (J * arm - h * C * fall) / det, (outer * fall - h * C * arm) / det)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw arm and pendulum in space, the circle of the arm's end, and the torque as an arc."""

        def around(angle: float, radius: float) -> np.ndarray:
            return np.array([radius * np.sin(angle), -radius * np.cos(angle), 0.0])

        arm, theta = float(x[0]), float(x[1])
        sideways = np.array([np.cos(arm), np.sin(arm), 0.0])
        end = around(arm, self.L)
        tip = end + 2 * self.l * (np.sin(theta) * sideways + np.array([0.0, 0.0, np.cos(theta)]))
        ring = [around(a, self.L) for a in np.linspace(-np.pi, np.pi, 49)]
        sweep = np.linspace(0.0, float(np.clip(u[0] / 0.3, -1, 1)) * np.pi, 20)
        return [
            km.scene.Line("circle", ring, width=0.004, color=(150, 160, 170)),
            km.scene.Line("torque", [around(a, 0.08) for a in sweep], width=0.012, color=(40, 120, 200)),
            km.scene.Line("arm", [0 * end, end], width=0.015),
            km.scene.Line("pendulum", [end, tip], width=0.012, color=(120, 130, 150)),
            km.scene.Disk("tip", tip, 0.02),
        ]


furuta, rest = Furuta(), [0.0, 0.0, 0.0, 0.0]
near = km.discretize(furuta, 0.02).linearize(rest, [0.0])
hold = km.dlqr(near.A, near.B, [1.0, 10.0, 0.1, 0.1], [50.0]).K
box = km.Limits(u_min=-0.3, u_max=0.3)
t = 0.02 * np.arange(301)
swing = np.column_stack([0.8 * np.sin(2 * t), 0 * t, 1.6 * np.cos(2 * t), 0 * t])
turned = [1.5, 0.0, 0.0, 0.0]


def products(x: ca.SX) -> list[ca.SX]:
    """Return the terms of the equations of motion, and those of them that turn with the pendulum."""
    S, C = ca.sin(x[1]), ca.cos(x[1])
    return [S * C, x[2] * C, x[3] * C, x[2] * S, x[3] * S, S * C * x[2] ** 2, S * C * x[2] * x[3], S * x[3] ** 2]


problem = km.Problem(
    dynamics=furuta,
    dt=0.02,
    equilibrium=(rest, [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.5, -0.4, -2.0, -2.0], [1.5, 0.4, 2.0, 2.0]),
        excitation=km.Feedback(hold, km.Noise(-0.1, 0.1), u_min=-0.6, u_max=0.6),
        episodes=300,
        steps=50,
    ),
    lifting=km.State()
    + km.Fourier(1, states="theta")
    + km.Expressions(products, ["S C", "φ̇ C", "ω C", "φ̇ S", "ω S", "S C φ̇²", "S C φ̇ ω", "S ω²"])
    + km.Constant(),
    cost=km.Cost(Q=[1.0, 10.0, 0.1, 0.1], R=20.0),
    limits=box,
    horizon=40,
    cases={
        "recover": km.Case(x0=[0.0, 0.4, 0.0, 0.0], reference=rest, steps=250),
        "turn": km.Case(x0=rest, reference=turned, steps=250),
        "track": km.Case(x0=rest, reference=swing, steps=300),
        "beyond": km.Case(
            x0=rest,
            reference=turned,
            steps=250,
            limits=km.Limits(u_min=-0.3, u_max=0.3, x_max=[1.0, np.inf, np.inf, np.inf]),
        ),
        "wrong": km.Case(x0=[0.0, 0.3, 0.0, 0.0], reference=rest, steps=250, plant=Furuta(m=0.12, l=0.18, I=0.0032)),
        "noise": km.Case(x0=[0.0, 0.3, 0.0, 0.0], reference=rest, steps=250, noise=[0.002, 0.002, 0.02, 0.02]),
        "delay": km.Case(x0=[0.0, 0.2, 0.0, 0.0], reference=rest, steps=250, faults=[km.faults.ActuatorDelay(1)]),
    },
    angles=(1,),
)
