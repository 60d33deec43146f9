"""Two-link arm: shoulder and elbow carry the hand against gravity, to a point and along a path.

Two slender links of 0.5 m and 1 kg in a vertical plane, a torque at each joint: the manipulator of M. Spong,
S. Hutchinson and M. Vidyasagar, "Robot Modeling and Control", section 7.3. q₁ = 0 is level, q₂ = 0 straight. The
inertia that the shoulder feels depends on the elbow, and every posture needs torques of its own.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Arm(km.Dynamics):
    """M(q) q̈ + C(q, q̇) q̇ + G(q) + d q̇ = u, of links with the mass in their middle and inertia m l² / 12."""

    states = ("shoulder [rad]", "elbow [rad]", "shoulder rate [rad/s]", "elbow rate [rad/s]")
    inputs = ("shoulder torque [N m]", "elbow torque [N m]")

    m1: float = 1.0  # upper arm [kg]
    m2: float = 1.0  # forearm, with what the hand holds [kg]
    l: float = 0.5  # each link [m]  # noqa: E741
    d: float = 0.2  # friction of each joint [N m s]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [q̇, M⁻¹ (u − C q̇ − G − d q̇)], with b = m₂ l² / 2."""
        q1, q2, w1, w2 = x[0], x[1], x[2], x[3]
        b, own = self.m2 * self.l**2 / 2, self.m2 * self.l**2 / 3
        upper = self.m1 * self.l**2 / 3 + self.m2 * self.l**2
        m11, m12 = upper + own + 2 * b * ca.cos(q2), own + b * ca.cos(q2)
        pull = self.m2 * self.l / 2 * self.g * ca.cos(q1 + q2)
        whole = (self.m1 / 2 + self.m2) * self.l * self.g * ca.cos(q1) + pull
        f1 = u[0] + b * ca.sin(q2) * (2 * w1 * w2 + w2**2) - whole - self.d * w1
        f2 = u[1] - b * ca.sin(q2) * w1**2 - pull - self.d * w2
        det = m11 * own - m12**2
        return ca.vertcat(w1, w2, (own * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw both links, the joints and the hand, and the torques as arcs of a turn for 30 N m."""
        q1, q2 = float(x[0]), float(x[1])
        elbow = (self.l * float(np.cos(q1)), self.l * float(np.sin(q1)))
        hand = (elbow[0] + self.l * float(np.cos(q1 + q2)), elbow[1] + self.l * float(np.sin(q1 + q2)))
        shapes: list[km.scene.Shape] = [
            km.scene.Line("upper_arm", [(0.0, 0.0), elbow], width=0.06),
            km.scene.Line("forearm", [elbow, hand], width=0.05, color=(120, 130, 150)),
            km.scene.Disk("hand", hand, 0.04),
        ]
        for name, (a, b), torque in (("shoulder", (0.0, 0.0), u[0]), ("elbow", elbow, u[1])):
            sweep = np.linspace(0.0, 2 * np.pi * float(np.clip(torque / 30.0, -1, 1)), 24)
            arc = [(a + 0.1 * float(np.cos(s)), b + 0.1 * float(np.sin(s))) for s in sweep]
            shapes.append(km.scene.Line(name, arc, width=0.02, color=(40, 120, 200)))
        return shapes


arm = Arm()
bent, raised = [-0.8, 0.8, 0.0, 0.0], [0.5, -0.6, 0.0, 0.0]
level = (arm.m1 / 2 + arm.m2) * arm.l * arm.g, arm.m2 * arm.l / 2 * arm.g
hold = [level[0] * np.cos(-0.8) + level[1], level[1]]  # holds `bent`, whose forearm is level
box = km.Limits(u_min=[-25.0, -10.0], u_max=[25.0, 10.0])
fence = km.Limits(u_min=[-25.0, -10.0], u_max=[25.0, 10.0], x_max=[0.2, np.inf, np.inf, np.inf])
t = 0.03 * np.arange(301)
path = np.column_stack([0.5 * np.sin(t), 0.6 * np.cos(t), 0.5 * np.cos(t), -0.6 * np.sin(t)])


def terms(x: ca.SX) -> list[ca.SX]:
    """Return the terms of gravity and of the Coriolis forces, and what turns with the elbow."""
    q1, q2, w1, w2 = x[0], x[1], x[2], x[3]
    C = ca.cos(q2)
    gravity = [ca.cos(q1), ca.cos(q1 + q2), C * ca.cos(q1), C * ca.cos(q1 + q2), ca.sin(q1), ca.sin(q1 + q2)]
    coriolis = [ca.sin(q2) * w for w in (w1**2, w1 * w2, w2**2)]
    return [*gravity, *coriolis, C, ca.sin(q2), C * w1, C * w2]


named = ["C1", "C12", "C2 C1", "C2 C12", "S1", "S12", "S2 ω1²", "S2 ω1 ω2", "S2 ω2²", "C2", "S2", "C2 ω1", "C2 ω2"]


problem = km.Problem(
    dynamics=arm,
    dt=0.03,
    equilibrium=(bent, hold),
    training=km.Training(
        x0=km.Uniform([-1.4, -1.3, -2.5, -2.5], [0.9, 1.3, 2.5, 2.5]),
        excitation=km.Noise([-25.0, -10.0], [25.0, 10.0]),
        episodes=600,
        steps=10,
    ),
    lifting=km.State() + km.Expressions(terms, named) + km.Constant(),
    cost=km.Cost(Q=[20.0, 20.0, 0.5, 0.5], R=[0.01, 0.02]),
    limits=box,
    horizon=25,
    cases={
        "raise": km.Case(x0=bent, reference=raised, steps=120),
        "track": km.Case(x0=[-0.3, 0.3, 0.0, 0.0], reference=path, steps=300),
        "beyond": km.Case(x0=bent, reference=raised, steps=120, limits=fence),  # the shoulder may not rise so far
        "wrong": km.Case(x0=bent, reference=raised, steps=150, plant=replace(arm, m2=1.2, d=0.16)),
        "noise": km.Case(x0=bent, reference=raised, steps=120, noise=[0.005, 0.005, 0.02, 0.02]),
        "delay": km.Case(x0=bent, reference=raised, steps=120, faults=[km.faults.ActuatorDelay(1)]),
    },
)
