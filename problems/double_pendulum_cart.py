"""Double pendulum on a cart: two poles, one on the other, are held upright while the cart is moved.

A cart of 1 kg on a rail without friction, two massless poles of 0.5 m with point masses of 0.2 kg: the equations of
motion of A. Bogdanov, "Optimal control of a double inverted pendulum on a cart", OGI School of Science (2004), for
point masses. Six states, one force; angles are absolute, and zero is upright. Data are short pieces near upright: most
of longer ones show falling poles, and models of these let them fall.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class DoublePendulum(km.Dynamics):
    """M(q) q̈ = [u + m l (ω₁² sin θ₁) + …], from the Lagrangian of three point masses."""

    states = ("position [m]", "theta1 [rad]", "theta2 [rad]", "velocity [m/s]", "omega1 [rad/s]", "omega2 [rad/s]")
    inputs = ("force [N]",)

    M: float = 1.0  # cart [kg]
    m1: float = 0.2  # end of the lower pole [kg]
    m2: float = 0.2  # end of the upper pole [kg]
    l1: float = 0.5  # lower pole [m]
    l2: float = 0.5  # upper pole [m]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [q̇, M(q)⁻¹ (forces)], with a₁ = (m₁ + m₂) l₁, a₂ = m₂ l₂ and b = m₂ l₁ l₂."""
        lower, upper, w1, w2 = x[1], x[2], x[4], x[5]
        a1, a2, b = (self.m1 + self.m2) * self.l1, self.m2 * self.l2, self.m2 * self.l1 * self.l2
        c1, c2, c12, s12 = ca.cos(lower), ca.cos(upper), ca.cos(lower - upper), ca.sin(lower - upper)
        mass = ca.vertcat(
            ca.horzcat(self.M + self.m1 + self.m2, a1 * c1, a2 * c2),
            ca.horzcat(a1 * c1, a1 * self.l1, b * c12),
            ca.horzcat(a2 * c2, b * c12, a2 * self.l2),
        )
        forces = ca.vertcat(
            u[0] + a1 * ca.sin(lower) * w1**2 + a2 * ca.sin(upper) * w2**2,
            a1 * self.g * ca.sin(lower) - b * s12 * w2**2,
            a2 * self.g * ca.sin(upper) + b * s12 * w1**2,
        )
        return ca.vertcat(x[3], w1, w2, ca.solve(mass, forces))

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the rail, the cart, both poles, and the force as a bar of 1 m for 20 N."""
        at, lower, upper = (float(value) for value in x[:3])
        knee = (at + self.l1 * float(np.sin(lower)), self.l1 * float(np.cos(lower)))
        tip = (knee[0] + self.l2 * float(np.sin(upper)), knee[1] + self.l2 * float(np.cos(upper)))
        return [
            km.scene.Line("rail", [(-1.5, -0.08), (2.5, -0.08)], width=0.02, color=(150, 160, 170)),
            km.scene.Box("cart", (at, 0.0), (0.3, 0.14)),
            km.scene.Line("force", [(at, 0.0), (at + float(u[0]) / 20, 0.0)], width=0.04, color=(40, 120, 200)),
            km.scene.Line("lower_pole", [(at, 0.0), knee], width=0.03, color=(120, 130, 150)),
            km.scene.Line("upper_pole", [knee, tip], width=0.03, color=(120, 130, 150)),
            km.scene.Disk("knee", knee, 0.045),
            km.scene.Disk("tip", tip, 0.045),
        ]


cart, rest, there = DoublePendulum(), [0.0] * 6, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
near = km.discretize(cart, 0.02).linearize(rest, [0.0])
hold = km.dlqr(near.A, near.B, [5.0, 50.0, 50.0, 1.0, 1.0, 1.0], [0.1]).K
box = km.Limits(u_min=-20.0, u_max=20.0)
t = 0.02 * np.arange(401)
sway = np.column_stack([0.5 * np.sin(1.5 * t), 0 * t, 0 * t, 0.75 * np.cos(1.5 * t), 0 * t, 0 * t])
fence = km.Limits(u_min=-20.0, u_max=20.0, x_max=[0.8, *[np.inf] * 5])


def products(x: ca.SX) -> list[ca.SX]:
    """Return the terms of the equations of motion that are not linear upright."""
    lower, upper, w1, w2 = x[1], x[2], x[4], x[5]
    bent = [ca.sin(lower - upper) * w**2 for w in (w1, w2)]
    turned = [f(a) * w for a, w in ((lower, w1), (upper, w2)) for f in (ca.cos,)]
    return [ca.sin(lower), ca.sin(upper), *bent, *turned, ca.sin(lower) * w1**2, ca.sin(upper) * w2**2]


problem = km.Problem(
    dynamics=cart,
    dt=0.02,
    equilibrium=(rest, [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.0, -0.15, -0.15, -1.0, -0.3, -0.3], [1.0, 0.15, 0.15, 1.0, 0.3, 0.3]),
        excitation=km.Feedback(hold, km.Noise(-10.0, 10.0), u_min=-20.0, u_max=20.0),
        episodes=1500,
        steps=5,
    ),
    lifting=km.State()
    + km.Expressions(products, ["S1", "S2", "S12 ω1²", "S12 ω2²", "ω1 C1", "ω2 C2", "S1 ω1²", "S2 ω2²"])
    + km.Constant(),
    cost=km.Cost(Q=[5.0, 50.0, 50.0, 1.0, 1.0, 1.0], R=0.1),
    limits=box,
    horizon=40,
    cases={
        "recover": km.Case(x0=[0.0, 0.15, 0.1, 0.0, 0.0, 0.0], reference=rest, steps=300),
        "shift": km.Case(x0=rest, reference=there, steps=300),
        "track": km.Case(x0=rest, reference=sway, steps=400),
        "beyond": km.Case(x0=rest, reference=there, steps=300, limits=fence),
        "wrong": km.Case(x0=rest, reference=there, steps=300, plant=DoublePendulum(M=1.2, m1=0.16, m2=0.24)),
        "noise": km.Case(x0=rest, reference=there, steps=300, noise=[0.001, 0.001, 0.001, 0.005, 0.005, 0.005]),
        "delay": km.Case(x0=rest, reference=there, steps=300, faults=[km.faults.ActuatorDelay(1)]),
    },
    angles=(1, 2),
)
